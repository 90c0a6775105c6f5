"""scripts/interop finds which way another program's numbers stand, and names those that differ; on our own numbers."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from splatpainter.io.axes import flip
from splatpainter.splats import SH_C0, Splats
from tests.support.io_assets import random_splats

FOLDER = Path(__file__).resolve().parents[2] / "scripts" / "interop"


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    """scripts/interop is no package: its folder is where Python looks when it is run."""
    spec = importlib.util.spec_from_file_location("interop_compare", FOLDER / "compare.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


def answer_of(splats: Splats) -> dict[str, Any]:
    """As a program tells its rows, in an order of its own."""
    rows = splats.take(np.random.default_rng(1).permutation(len(splats)))
    return {
        "positions": rows.means.tolist(),
        "quats": (-rows.quats).tolist(),
        "scales": rows.scales.tolist(),
        "opacities": rows.opacities.tolist(),
        "base": rows.sh[:, 0].tolist(),
        "rest": rows.sh[:, 1:].tolist(),
    }


@pytest.mark.parametrize(
    ("signs", "words"),
    [((1, 1, 1), "same"), ((1, -1, -1), "upside down"), ((-1, -1, 1), "turned about z"), ((1, -1, 1), "mirrored")],
)
def test_turns_are_found(signs: tuple[int, int, int], words: str, compare: ModuleType) -> None:
    ours = random_splats(60, 3)
    cell = compare.compared(ours, answer_of(flip(ours, signs)))
    assert (cell.error, cell.signs, cell.differences) == ("", signs, ())
    assert compare.turned(cell, compare.Cell()) == words and compare.turned(cell, cell) == "same"


@pytest.mark.parametrize(("name", "by"), [("opacities", 0.1), ("base", 0.1 / SH_C0), ("scales", 0.02), ("rest", 0.2)])
def test_differences_are_named(name: str, by: float, compare: ModuleType) -> None:
    ours = random_splats(60, 1)
    answer = answer_of(ours)
    answer[name] = (np.asarray(answer[name]) + by).tolist()
    (difference,) = compare.compared(ours, answer).differences
    assert difference.split()[0] == {"base": "colours", "scales": "shapes", "rest": "SH"}.get(name, name)
    answer = answer_of(ours.take(np.arange(50)))
    assert compare.compared(ours, answer).differences == ("50 of 60 Gaussians",)
    assert compare.compared(ours, {"error": "no"}).error == "no"
