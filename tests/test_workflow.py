"""The workflow file says what is meant: three systems, three Pythons, and commands that the README documents."""

from __future__ import annotations

import importlib.util
import json
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


def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands(job: dict[str, Any]) -> list[str]:
    return [step["run"] for step in job["steps"] if "run" in step]


def test_every_system_and_version_is_run(jobs: dict[str, Any]) -> None:
    matrix = jobs["pip"]["strategy"]["matrix"]
    assert matrix["os"] == ["ubuntu-latest", "macos-latest", "windows-latest"]
    assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"], "as strings: 3.10 would be a number like 3.1"
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
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "CONTRIBUTING.md")]
    readme = " ".join(" ".join(texts).split())
    for line in (
        "pip install -c constraints.txt torch",
        "networks",
        "pip install -c constraints.txt -e",
        "splatpainter demo",
    ):
        assert line in readme and any(line in command for command in commands(jobs["pip"])), line
    assert "python -m pytest" in readme and "python -m pytest" in commands(jobs["pip"])


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize("path", WORKFLOWS, ids=[path.stem for path in WORKFLOWS])
def test_actions_are_pinned_by_hash_and_permissions_are_few(path: Path) -> None:
    """A tag can be moved to other code after it was read; a hash cannot. The version stands beside it for people."""
    yaml = pytest.importorskip("yaml")
    text = path.read_text(encoding="utf-8")
    used = re.findall(r"uses: (.*)", text)
    assert used, path.name
    for line in used:
        assert re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+(\.\d+){0,2}", line), line
    data = yaml.safe_load(text)
    assert data["permissions"] == {"contents": "read"}, "more only for the job that needs it"
    assert all(job["timeout-minutes"] for name, job in data["jobs"].items() if name not in ("deploy", "publish"))


def test_one_action_is_pinned_at_one_version() -> None:
    lines = {line for path in WORKFLOWS for line in re.findall(r"uses: (.*)", path.read_text(encoding="utf-8"))}
    assert len({line.split("@")[0] for line in lines}) == len(lines), sorted(lines)


def test_a_release_is_refused_where_tag_version_and_changelog_differ() -> None:
    module = script("release_check")
    released = "# Changelog\n\n## Unreleased\n\n## 1.2.0 (2030-01-01)\n\n- a\n"
    assert module.faults("v1.2.0", "1.2.0", released) == []
    assert "got v1.3.0" in module.faults("v1.3.0", "1.2.0", released)[0]
    assert "a heading '## 1.3.0'" in module.faults("v1.3.0", "1.3.0", released)[0]
    left = released.replace("Unreleased\n", "Unreleased\n\n- b\n")
    assert module.faults("v1.2.0", "1.2.0", left) == [
        "CHANGELOG.md: 1 lines stand under Unreleased: move them below 1.2.0"
    ]


def test_a_line_is_slower_by_a_factor_and_a_slack_and_only_where_it_is_stored() -> None:
    check = script("speed_check")
    stored = {"render": 10.0, "quick": 0.01}
    bound = check.MAX_FACTOR * 10 + check.SLACK
    assert check.slower({"render": bound, "quick": 0.4, "new": 1e6}, stored) == {}
    assert check.slower({"render": bound + 1, "quick": 5.0}, stored) == {
        "render": pytest.approx((bound + 1) / 10),
        "quick": pytest.approx(500),
    }
    ratios = json.loads(check.STORED.read_text(encoding="utf-8"))
    assert "render" in ratios and all(value >= 0 for value in ratios.values())
