"""Looks against written-out formulas, scipy's splines and finite differences; numpy and torch alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from splatpainter.sources import color, looks
from splatpainter.sources.looks import Look, apply_look

GREYS = np.repeat(np.linspace(0, 1, 101)[:, None], 3, 1)


def some_colors(count: int = 500) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (count, 3))


def test_the_srgb_curve_is_the_one_of_the_picture_reader() -> None:
    colors = some_colors()
    np.testing.assert_allclose(looks.to_display(colors), color.to_display(colors, "linear"), atol=1e-12)
    np.testing.assert_allclose(looks.to_linear(colors), color.from_display(colors, "linear"), atol=1e-12)
    np.testing.assert_allclose(looks.to_linear(looks.to_display(colors)), colors, atol=1e-6)


def test_no_settings_change_nothing_but_what_lies_outside() -> None:
    colors = some_colors()
    assert (apply_look(colors, Look()) == colors).all()
    assert (apply_look(np.array([[-0.2, 0.5, 1.3]]), Look()) == [[0, 0.5, 1]]).all()


def test_one_stop_is_twice_the_light() -> None:
    colors = some_colors() * 0.7
    brighter = apply_look(colors, Look(exposure=1.0))
    wanted = np.minimum(2 * color.from_display(colors, "linear"), 1)
    np.testing.assert_allclose(color.from_display(brighter, "linear"), wanted, atol=1e-9)


def test_white_balance_keeps_the_luminance_of_grey_and_turns_the_right_way() -> None:
    grey = np.full((1, 3), 0.3)
    for temperature, tint in ((1, 0), (-0.7, 0.4), (0, -1)):
        out = looks.white_balanced(grey, temperature, tint)
        assert np.isclose(out @ np.array([0.2126, 0.7152, 0.0722]), 0.3)
    warm, magenta = looks.white_balanced(grey, 1, 0)[0], looks.white_balanced(grey, 0, 1)[0]
    assert np.isclose(warm[0] / warm[2], 2)  # half a stop each way
    assert magenta[0] == magenta[2] > magenta[1]


@pytest.mark.parametrize("slope", [0.5, 1.7])
def test_contrast_has_its_slope_at_the_pivot_and_an_inverse(slope: float) -> None:
    step = 1e-6
    around = np.array([looks.PIVOT - step, looks.PIVOT + step])
    low, high = looks.contrasted(around, slope)
    assert np.isclose((high - low) / (2 * step), slope, rtol=1e-4)
    np.testing.assert_allclose(looks.contrasted(looks.contrasted(GREYS, slope), 1 / slope), GREYS, atol=1e-9)
    np.testing.assert_allclose(looks.contrasted(np.array([0, looks.PIVOT, 1]), slope), [0, looks.PIVOT, 1], atol=1e-12)


def test_saturation_zero_is_luma_and_two_doubles_the_distance_from_it() -> None:
    colors = some_colors()
    luma = colors @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(apply_look(colors, Look(saturation=0.0)), np.repeat(luma[:, None], 3, 1), atol=1e-12)
    np.testing.assert_allclose(looks.saturated(colors, 2) - luma[:, None], 2 * (colors - luma[:, None]), atol=1e-12)


def test_a_curve_is_the_hermite_spline_with_the_limited_slopes() -> None:
    points = ((0.1, 0.2), (0.4, 0.25), (0.6, 0.9), (1.0, 0.9))
    secants = np.diff([0.2, 0.25, 0.9, 0.9]) / np.diff([0.1, 0.4, 0.6, 1.0])
    # Means of the secants, at most three times the smaller; 0 beside the flat piece.
    slopes = [secants[0], min((secants[0] + secants[1]) / 2, 3 * secants[0]), 0, 0]
    spline = CubicHermiteSpline([0.1, 0.4, 0.6, 1.0], [0.2, 0.25, 0.9, 0.9], slopes)
    x = np.linspace(0.1, 1, 200)
    np.testing.assert_allclose(looks.curved(x, points), spline(x), atol=1e-12)
    assert (np.diff(looks.curved(np.linspace(0, 1, 500), points)) >= -1e-12).all()
    np.testing.assert_allclose(looks.curved(np.array([0.0, 0.05]), points), 0.2)


def test_split_toning_leaves_black_and_white_and_goes_opposite_ways() -> None:
    toned = looks.split_toned(GREYS, (0.0, 0.0, 0.3), (0.3, 0.0, 0.0))
    np.testing.assert_allclose(toned[[0, -1]], GREYS[[0, -1]], atol=1e-12)
    tint = (toned - GREYS)[[30, 70]]
    assert tint[0, 2] > 2 * tint[0, 0] > 0 and tint[1, 0] > 2 * tint[1, 2] > 0 and (tint[:, 1] == 0).all()


@pytest.mark.parametrize("seed", range(12))
def test_random_looks_are_equal_in_numpy_and_torch_and_stay_inside(seed: int) -> None:
    look = looks.random_look(np.random.default_rng(seed))
    assert look == looks.random_look(np.random.default_rng(seed)) != Look()
    colors = (some_colors() * 1.2 - 0.1).astype(np.float32)
    ours = apply_look(colors, look)
    assert ours.dtype == np.float32 and ours.min() >= 0 and ours.max() <= 1
    theirs = apply_look(torch.from_numpy(colors), look)
    assert theirs.dtype == torch.float32
    np.testing.assert_allclose(ours, theirs.numpy(), atol=2e-6)


def test_channel_curves_act_on_their_own_channel() -> None:
    same, lifted = ((0.0, 0.0), (1.0, 1.0)), ((0.0, 0.2), (1.0, 1.0))
    out = apply_look(GREYS, Look(channel_curves=(same, lifted, same)))
    np.testing.assert_allclose(out[:, [0, 2]], GREYS[:, [0, 2]], atol=1e-12)
    np.testing.assert_allclose(out[:, 1], 0.2 + 0.8 * GREYS[:, 1], atol=1e-12)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueError, match="contrast above 0, got -1"):
        apply_look(GREYS, Look(contrast=-1.0))
    near = ((1e-45, 0.5), (1e-38, 1.0))  # slopes overflowed
    for points in (((0.5, 0.5),), ((0.5, 0.5), (0.5, 0.7)), ((0.6, 0.5), (0.5, 0.7)), near):
        with pytest.raises(ValueError, match="from left to right, 1e-06 apart"):
            looks.curved(GREYS, points)
