"""kill -9 at any moment loses nothing that was acknowledged, and the file opens again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(not hasattr(os, "fork"), reason="writers are forked, which this system cannot do")
@pytest.mark.parametrize(("rounds", "how"), [(105, []), (60, ["journal"])])
def test_killed_writers_lose_nothing(tmp_path: Path, rounds: int, how: list[str]) -> None:
    script = Path(__file__).parents[1] / "support" / "session_killer.py"
    # A process of its own: forking this one, with its threads, would not be sound.
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(script.parents[2]), os.environ.get("PYTHONPATH", "")]),
    }
    command = [sys.executable, str(script), str(tmp_path), str(rounds), "7", *how]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["wrong"] is None, result
    assert result["problems"] == []
    assert result["kills"] >= rounds - 5 and result["acknowledged"] >= rounds - 5, result
    assert result["files"] == ["killed.splatproj"]
