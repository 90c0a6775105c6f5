"""The workflow file says what is meant: three systems, three Pythons, and commands that the README documents."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def jobs() -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    data = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8"))
    assert data["permissions"] == {"contents": "read"} and {"push", "pull_request"} <= set(data[True])  # YAML's "on"
    return data["jobs"]


def commands(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


def test_every_system_and_version_is_run(jobs: dict[str, Any]) -> None:
    matrix = jobs["pip"]["strategy"]["matrix"]
    assert matrix["os"] == ["ubuntu-latest", "macos-latest", "windows-latest"]
    assert matrix["python"] == ["3.11", "3.12", "3.13"], "as strings: 3.10 would be a number like 3.1"
    assert (
        matrix["exclude"] == [{"os": "ubuntu-latest", "python": "3.11"}] and jobs["make"]["runs-on"] == "ubuntu-latest"
    )
    metadata = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert metadata["requires-python"] == ">=3.11"


def test_make_runs_where_it_is_and_its_targets_exist(jobs: dict[str, Any]) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = [line.removeprefix("make ") for line in commands(jobs["make"]) if line.startswith("make ")]
    assert targets == ["check", "test", "demo"]
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)
    assert not any(line.startswith("make") for line in commands(jobs["pip"]))


def test_commands_without_make_are_those_of_the_readme(jobs: dict[str, Any]) -> None:
    readme = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "CONTRIBUTING.md"))
    for line in ("pip install -c constraints.txt torch", "pip install -c constraints.txt -e", "splatpainter demo"):
        assert line in readme and any(line in command for command in commands(jobs["pip"])), line
    assert "python -m pytest" in readme and "python -m pytest" in commands(jobs["pip"])


def test_actions_are_pinned_by_major_version(jobs: dict[str, Any]) -> None:
    used = [step["uses"] for job in jobs.values() for step in job["steps"] if "uses" in step]
    assert used and all(re.fullmatch(r"actions/[a-z-]+@v\d+", name) for name in used), used
