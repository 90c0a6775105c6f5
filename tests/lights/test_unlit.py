"""Lights put on an asset one after the other, in one list of operations: what each gives adds up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.color import base_color, linear_to_srgb, sh_from_color, srgb_to_linear
from splatpainter.lights.unlit import unlit_after
from splatpainter.operations.operation import Operation
from splatpainter.operations.to_file import apply_to_file
from splatpainter.splats import Splats
from tests.support.studio_scenes import ball

SUN = sp.Relight(sun=("60,30,#ffd0a0,0.4",), fill=0.0, add=True)
LAMP = sp.Relight(point=("0.3,-1.8,0.2,#a0c0ff,0.5",), fill=0.0, add=True)
EXACT = 2e-5


@pytest.fixture
def asset() -> Splats:
    dark = ball()
    sh = dark.sh.copy()
    sh[:, 0] = sh_from_color(0.25 + 0.1 * np.sin(3 * dark.means))
    return replace(dark, sh=sh)


def light(splats: Splats) -> np.ndarray:
    return srgb_to_linear(np.maximum(base_color(splats.sh).astype(np.float64), 0))


def lit(asset: Splats, *operations: Operation) -> np.ndarray:
    return light(sp.edit(asset, operations).splats)


def test_lights_of_a_list_are_the_sum_of_each(asset: Splats, tmp_path: Path) -> None:
    dark, sun, lamp = light(asset), lit(asset, SUN), lit(asset, LAMP)
    both = lit(asset, SUN, LAMP)
    assert min(float((each - dark).max()) for each in (sun, lamp)) > 0.01
    np.testing.assert_allclose(both, sun + lamp - dark, atol=EXACT)
    np.testing.assert_allclose(lit(asset, LAMP, SUN), both, atol=EXACT)
    sp.write(tmp_path / "a.ply", asset)
    apply_to_file(tmp_path / "a.ply", [SUN, LAMP], tmp_path / "b.ply")
    np.testing.assert_allclose(light(sp.read(tmp_path / "b.ply")), both, atol=EXACT)


def test_an_asset_that_came_back_knows_its_lights(asset: Splats) -> None:
    first = sp.edit(asset, [SUN])
    np.testing.assert_allclose(light(sp.edit(first, [LAMP]).splats), lit(asset, SUN, LAMP), atol=EXACT)


def test_a_sky_takes_the_place_of_lights_before_it_and_delight_takes_them_out(asset: Splats) -> None:
    for last in (sp.Relight(hdri="dawn", exposure=-1.0), sp.Delight()):
        np.testing.assert_allclose(lit(asset, SUN, LAMP, last), lit(asset, last), atol=EXACT)


def test_a_grade_between_lights_is_seen_as_it_was_made(asset: Splats) -> None:
    grade = sp.Grade(exposure=-0.3)
    sun = replace(SUN, sun=("60,30,#ffd0a0,2",))
    graded = lit(asset, sun, grade)
    gained, expected = lit(asset, sun, grade, LAMP) - graded, graded * (lit(asset, sun, LAMP) / lit(asset, sun) - 1)
    assert float(expected.max()) > 0.02
    assert float(np.abs(gained - expected).max()) < 0.1 * float(expected.max())


def test_new_gaussians_of_no_known_parent_count_as_lit_by_the_captured_light_alone(asset: Splats) -> None:
    """Others lie in the light of the one that each was made from, here twice the captured one on the first."""

    def colored(colors: np.ndarray) -> Splats:
        return replace(asset.take(np.arange(len(colors))), sh=sh_from_color(colors)[:, None].astype(np.float32))

    dark, paint = np.array([[0.2, 0.3, 0.4], [0.1, 0.1, 0.1]]), np.array([[0.5, 0.6, 0.7]])
    below = np.concatenate([linear_to_srgb(2 * srgb_to_linear(dark[:1])), dark[1:]])
    after = np.concatenate([below, paint, paint])
    unlit = unlit_after(colored(below), colored(dark).sh, colored(after), np.array([0, -1]))
    assert unlit is not None
    expected = np.concatenate([dark, linear_to_srgb(srgb_to_linear(paint) / 2), paint])
    np.testing.assert_allclose(base_color(unlit), expected, atol=1e-5)
