"""Thresholds that stand in Python, where they are explained, and in C++, where a kernel needs them at compile time, are
equal."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from splatpainter.io.formats.compressed_ply import GAUSSIANS_PER_CHUNK
from splatpainter.lift.depth_normals import VISIBLE_NORMALS
from splatpainter.lift.local.detail import DETAIL
from splatpainter.lift.local.gaussian_merging import MERGING
from splatpainter.lift.sheets.near_surface import NEAR_SURFACE
from splatpainter.lift.sheets.sheet import SHEET
from splatpainter.spread.nearest_neighbours import SEARCH

NATIVE = Path(__file__).resolve().parents[2] / "native"
MIRRORED = [
    ("packing.cpp", "CHUNK_ROWS", GAUSSIANS_PER_CHUNK),
    ("lift/detail.h", "ONE_COLOR", DETAIL.one_color),
    ("lift/detail.h", "UNIFORM_COLOR_REACHES", DETAIL.uniform_color_reaches),
    ("lift/merging.h", "MAX_LOSS", MERGING.max_loss),
    ("lift/merging.h", "SHAPE_COST", MERGING.shape_cost),
    ("lift/near_surface.h", "NORMAL_SIGMAS", NEAR_SURFACE.normal_sigmas),
    ("lift/near_surface.h", "SURFACE_WINDOWS", NEAR_SURFACE.surface_windows),
    ("lift/near_surface.h", "FAR_WINDOWS", NEAR_SURFACE.far_windows),
    ("lift/sheet.h", "LARGEST_CELL", SHEET.max_cell_px),
    ("lift/visible_depth.h", "SMOOTHING_PX", VISIBLE_NORMALS.smoothing_px),
    ("spread/point_neighbours.h", "NEIGHBOURS", SEARCH.neighbours),
    ("spread/point_neighbours.h", "MAX_RINGS", SEARCH.max_rings),
    ("spread/point_neighbours.h", "MAX_TESTED", SEARCH.max_tested),
]


@pytest.mark.skipif(not NATIVE.is_dir(), reason="an installed package has no C++ sources")
@pytest.mark.parametrize(("header", "name", "value"), MIRRORED, ids=[name for _, name, _ in MIRRORED])
def test_a_kernel_has_the_value_that_python_explains(header: str, name: str, value: float) -> None:
    text = (NATIVE / header).read_text(encoding="utf-8")
    values = re.findall(rf"\b{name} = ([0-9.e-]+)", text)
    assert [float(number) for number in values] == [value]
