"""scripts/same_bytes.py: what it takes for the same, and that it sees threads that disturb each other."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.session_scenes import BLUE, RED, dab, flat


@pytest.fixture
def same_bytes(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    path = Path(__file__).parents[1] / "scripts/same_bytes.py"
    spec = importlib.util.spec_from_file_location("same_bytes", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "same_bytes", module)
    spec.loader.exec_module(module)
    return module


def test_projects_of_one_content_are_the_same_whatever_their_ids(same_bytes: ModuleType, tmp_path: Path) -> None:
    dumped = []
    for name, color in (("a", RED), ("b", RED), ("c", BLUE)):
        with flat(project=tmp_path / f"{name}.splatproj") as session:
            session.layers.add("paint", [dab(color)], name="Stroke")
        dumped.append(same_bytes.dumped(tmp_path / f"{name}.splatproj"))
    assert dumped[0] == dumped[1] != dumped[2]


def test_what_one_of_several_threads_makes_otherwise_is_told(
    same_bytes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def command(words: list[str]) -> int:
        if words[1] == "raises" and words[-1].startswith("1/"):
            raise RuntimeError("mutated")
        other = words[1] == "differs" and words[-1].startswith("0/")
        Path(words[-1]).write_bytes(b"other" if other else b"same")
        return 0

    names = ("equal", "differs", "raises")
    monkeypatch.setattr(same_bytes, "run_command", command)
    monkeypatch.setattr(same_bytes, "COMMANDS", "\n".join(f"edit {name} --out {name}.ply" for name in names))
    for name in names:
        (tmp_path / f"{name}.ply").write_bytes(b"same")
    differs, raises = same_bytes.made_at_once(tmp_path, 2)
    assert differs == "differs.ply of thread 0: edit differs --out differs.ply (0)"
    assert raises == "raises.ply of thread 1: edit raises --out raises.ply (RuntimeError('mutated'))"
