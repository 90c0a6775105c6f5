"""Colours at the seam: a look that was put on one half of a surface is taken back, whatever strays say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import base_color, linear_to_srgb, sh_from_color, srgb_to_linear
from splatpainter.scene.seam import SEAM, SeamMatch, light_sh, match_seam, seam_weights
from splatpainter.splats import Splats
from tests.support.lift_scenes import same_bits, sheet

GAIN, OFFSET = np.array([0.7, 0.8, 0.6]), np.array([0.02, 0.01, 0.03])


def halves() -> tuple[Splats, Splats]:
    """A textured sheet, cut in the middle."""
    surface = sheet(50)
    left = surface.means[:, 0] < 0
    return surface.take(left), surface.take(~left)


def recolored(splats: Splats, gain: np.ndarray, offset: np.ndarray) -> Splats:
    """Another exposure and white balance, by hand."""
    sh = splats.sh.copy()
    light = srgb_to_linear(np.clip(base_color(sh), 0, 1)) * gain + offset
    sh[:, 0] = sh_from_color(linear_to_srgb(light))
    return replace(splats, sh=sh.astype(np.float32))


def error(one: Splats, two: Splats) -> float:
    return float(np.abs(base_color(one.sh) - base_color(two.sh)).mean())


def test_another_exposure_is_taken_back() -> None:
    left, right = halves()
    darker = recolored(right, GAIN, OFFSET)
    match = match_seam(darker, left)
    assert match.pairs >= SEAM.min_pairs
    matched = match.apply(darker, left)
    assert error(darker, right) > 0.07
    assert error(matched, right) < 0.25 * error(darker, right)
    for name in ("means", "quats", "scales", "opacities"):
        assert getattr(matched, name) is getattr(darker, name)


def test_strays_and_paint_at_the_seam_count_little() -> None:
    left, right = halves()
    darker = recolored(right, GAIN, 0 * OFFSET)
    clean = match_seam(darker, left)
    near = np.argsort(darker.means[:, 0])[:100]
    painted = darker.sh.copy()
    painted[near[::6], 0] = sh_from_color(np.array([1.0, 0.0, 1.0]))
    match = match_seam(replace(darker, sh=painted), left)
    np.testing.assert_allclose(match.gain, clean.gain, rtol=0.25)


def test_a_seam_of_one_colour_asks_for_a_gain() -> None:
    left, right = (replace(half, sh=np.full_like(half.sh, -0.5)) for half in halves())
    match = match_seam(recolored(right, np.full(3, 0.5), np.zeros(3)), left)
    np.testing.assert_allclose(match.gain, 2.0, rtol=0.05)
    np.testing.assert_allclose(match.offset, 0.0, atol=0.01)


def test_it_fades_out_from_the_seam() -> None:
    left, right = halves()
    darker = recolored(right, GAIN, OFFSET)
    match = match_seam(darker, left, falloff=0.4)
    weights = seam_weights(darker, left, 0.4)
    far = darker.means[:, 0] > 0.7
    assert far.any() and not weights[far].any() and weights.max() == 1
    matched = match.apply(darker, left)
    assert same_bits(matched.take(far), darker.take(far))
    assert not same_bits(matched, darker)
    assert SeamMatch.from_record(match.record()) == match


def test_assets_that_are_apart_have_no_seam() -> None:
    left, right = halves()
    with pytest.raises(ValueError, match="not near to each other"):
        match_seam(replace(right, means=right.means + np.float32(50)), left)
    with pytest.raises(ValueError, match="srgb"):
        match_seam(replace(right, color_space="linear"), left)
    with pytest.raises(ValueError, match="shows nothing"):
        match_seam(right, replace(left, opacities=np.zeros_like(left.opacities)))
    with pytest.raises(ValueError, match="falloff"):
        match_seam(right, left, falloff=float("nan"))


@pytest.mark.parametrize("value", [None, [1, 1], [1, 1, True], ["1", "1", "1"], [1, 1, float("nan")], [1e9, 1, 1]])
def test_bad_parameters_are_refused(value: object) -> None:
    sh = halves()[0].sh
    with pytest.raises(ValueError, match="look: expected"):
        light_sh(sh, {"gain": value, "offset": [0, 0, 0]})
    with pytest.raises(ValueError):
        SeamMatch.from_record({"gain": value, "offset": [0, 0, 0], "pairs": 30, "falloff": 0})
