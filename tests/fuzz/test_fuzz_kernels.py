"""A short run of tests/fuzz/kernels.py; a long one: its own text."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).with_name("kernels.py")


def test_extreme_values_stay_within_bounds():
    arguments = ["--cases", "forward,cubes", "--base", "--single", "--count", "60", "--seed", "7"]
    command = [sys.executable, str(SCRIPT), *arguments]
    run = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "120 inputs" in run.stdout and "0 failed" in run.stdout, run.stdout
