"""Color grading against written-out formulas, scipy's splines and finite differences; numpy and torch alike."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import torch

from splatpainter import color
from splatpainter.grading.color_grading import (
    PIVOT,
    ColorGrade,
    GradeSettings,
    HueBand,
    adjust_contrast,
    apply_grade,
    apply_to_sh,
    grade_sh,
    random_grade,
    saturate,
    shift_hues,
    split_tone,
    tone_curve,
    white_balance,
)
from splatpainter.kernels import portable
from splatpainter.splats import SH_C0

GREYS = np.repeat(np.linspace(0, 1, 101)[:, None], 3, 1)


def some_colors(count: int = 500) -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 1, (count, 3))


def test_the_srgb_curve_is_the_one_of_the_picture_reader() -> None:
    colors = some_colors()
    np.testing.assert_allclose(color.linear_to_srgb(colors), color.to_display(colors, "linear"), atol=1e-12)
    np.testing.assert_allclose(color.srgb_to_linear(colors), color.from_display(colors, "linear"), atol=1e-12)
    np.testing.assert_allclose(color.srgb_to_linear(color.linear_to_srgb(colors)), colors, atol=1e-6)


def test_no_settings_change_nothing_but_what_lies_outside() -> None:
    colors = some_colors()
    assert (apply_grade(colors, ColorGrade()) == colors).all()
    assert (apply_grade(np.array([[-0.2, 0.5, 1.3]]), ColorGrade()) == [[0, 0.5, 1]]).all()


def test_one_stop_is_twice_the_light() -> None:
    colors = some_colors() * 0.7
    brighter = apply_grade(colors, ColorGrade(exposure=1.0))
    expected = np.minimum(2 * color.from_display(colors, "linear"), 1)
    np.testing.assert_allclose(color.from_display(brighter, "linear"), expected, atol=1e-9)


def test_white_balance_keeps_the_luminance_of_grey_and_turns_the_right_way() -> None:
    grey = np.full((1, 3), 0.3)
    for temperature, tint in ((1, 0), (-0.7, 0.4), (0, -1)):
        out = white_balance(grey, temperature, tint)
        assert np.isclose(out @ np.array([0.2126, 0.7152, 0.0722]), 0.3)
    warm, magenta = white_balance(grey, 1, 0)[0], white_balance(grey, 0, 1)[0]
    assert np.isclose(warm[0] / warm[2], 2)  # half a stop each way
    assert magenta[0] == magenta[2] > magenta[1]


@pytest.mark.parametrize("slope", [0.5, 1.7])
def test_contrast_has_its_slope_at_the_pivot_and_an_inverse(slope: float) -> None:
    step = 1e-6
    around = np.array([PIVOT - step, PIVOT + step])
    low, high = adjust_contrast(around, slope)
    assert np.isclose((high - low) / (2 * step), slope, rtol=1e-4)
    np.testing.assert_allclose(adjust_contrast(adjust_contrast(GREYS, slope), 1 / slope), GREYS, atol=1e-9)
    np.testing.assert_allclose(
        adjust_contrast(np.array([0, PIVOT, 1]), slope),
        [0, PIVOT, 1],
        atol=1e-12,
    )


@pytest.mark.parametrize("slope", [0.4, 1.0, 2.5])
def test_contrast_of_single_precision_is_two_powers_bit_for_bit(slope: float) -> None:
    ends = [0, -0.0, 1, PIVOT, np.inf, -np.inf, np.nan]
    levels = np.append(np.random.default_rng(6).normal(0.5, 0.6, 5999), ends).astype(np.float32).reshape(2, -1, 3)
    value = levels.clip(0, 1)
    dark = value < PIVOT
    bent = portable.power(np.where(dark, value / PIVOT, (1 - value) / (1 - PIVOT)), slope)
    expected = np.where(dark, PIVOT * bent, 1 - (1 - PIVOT) * bent)
    for given in (levels, levels[::-1]):
        out = adjust_contrast(given, slope)
        assert out.dtype == np.float32
        np.testing.assert_array_equal(out, expected if given is levels else expected[::-1])


def test_saturation_zero_is_luma_and_two_doubles_the_distance_from_it() -> None:
    colors = some_colors()
    luma = colors @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(
        apply_grade(colors, ColorGrade(saturation=0.0)), np.repeat(luma[:, None], 3, 1), atol=1e-12
    )
    np.testing.assert_allclose(saturate(colors, 2) - luma[:, None], 2 * (colors - luma[:, None]), atol=1e-12)


def test_a_curve_is_the_hermite_spline_with_the_limited_slopes() -> None:
    points = ((0.1, 0.2), (0.4, 0.25), (0.6, 0.9), (1.0, 0.9))
    secants = np.diff([0.2, 0.25, 0.9, 0.9]) / np.diff([0.1, 0.4, 0.6, 1.0])
    # Means of the secants, at most three times the smaller; 0 beside the flat piece.
    slopes = [secants[0], min((secants[0] + secants[1]) / 2, 3 * secants[0]), 0, 0]
    from scipy.interpolate import CubicHermiteSpline

    spline = CubicHermiteSpline([0.1, 0.4, 0.6, 1.0], [0.2, 0.25, 0.9, 0.9], slopes)
    x = np.linspace(0.1, 1, 200)
    np.testing.assert_allclose(tone_curve(x, points), spline(x), atol=1e-12)
    assert (np.diff(tone_curve(np.linspace(0, 1, 500), points)) >= -1e-12).all()
    np.testing.assert_allclose(tone_curve(np.array([0.0, 0.05]), points), 0.2)


def test_split_toning_leaves_black_and_white_and_goes_opposite_ways() -> None:
    toned = split_tone(GREYS, (0.0, 0.0, 0.3), (0.3, 0.0, 0.0))
    np.testing.assert_allclose(toned[[0, -1]], GREYS[[0, -1]], atol=1e-12)
    tint = (toned - GREYS)[[30, 70]]
    assert tint[0, 2] > 2 * tint[0, 0] > 0 and tint[1, 0] > 2 * tint[1, 2] > 0 and (tint[:, 1] == 0).all()


@pytest.mark.parametrize("seed", range(12))
def test_random_grades_are_equal_in_numpy_and_torch_and_stay_inside(seed: int) -> None:
    grade = random_grade(np.random.default_rng(seed))
    assert grade == random_grade(np.random.default_rng(seed)) != ColorGrade()
    colors = (some_colors() * 1.2 - 0.1).astype(np.float32)
    ours = apply_grade(colors, grade)
    assert ours.dtype == np.float32 and ours.min() >= 0 and ours.max() <= 1
    theirs = apply_grade(torch.from_numpy(colors), grade)
    assert theirs.dtype == torch.float32
    np.testing.assert_allclose(ours, theirs.numpy(), atol=2e-6)


def test_channel_curves_act_on_their_own_channel() -> None:
    same, lifted = ((0.0, 0.0), (1.0, 1.0)), ((0.0, 0.2), (1.0, 1.0))
    out = apply_grade(GREYS, ColorGrade(channel_curves=(same, lifted, same)))
    np.testing.assert_allclose(out[:, [0, 2]], GREYS[:, [0, 2]], atol=1e-12)
    np.testing.assert_allclose(out[:, 1], 0.2 + 0.8 * GREYS[:, 1], atol=1e-12)


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueError, match="contrast above 0, got -1"):
        apply_grade(GREYS, ColorGrade(contrast=-1.0))
    near = ((1e-45, 0.5), (1e-38, 1.0))  # slopes overflowed
    for points in (((0.5, 0.5),), ((0.5, 0.5), (0.5, 0.7)), ((0.6, 0.5), (0.5, 0.7)), near):
        with pytest.raises(ValueError, match="from left to right, 1e-06 apart"):
            tone_curve(GREYS, points)


def some_sh(count: int = 200, bands: int = 4, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    colors = rng.uniform(0.1, 0.9, (count, 3))
    sh = rng.normal(0, 0.02, (count, bands, 3))
    sh[:, 0] = (colors - 0.5) / SH_C0
    return sh.astype(np.float32)


def base(sh: np.ndarray) -> np.ndarray:
    return 0.5 + SH_C0 * sh[:, 0].astype(np.float64)


@pytest.mark.parametrize(
    "settings",
    [
        GradeSettings(),
        GradeSettings(space="linear"),
        GradeSettings(strength=0.3),
        GradeSettings(curve=((0.25, 0.25), (0.5, 0.5))),
    ],
)
def test_zeros_change_nothing_bit_for_bit(settings: GradeSettings) -> None:
    sh = some_sh()
    sh[:3, 0] = [[9, -9, 0]]  # beyond what screens show, and exactly grey
    assert np.array_equal(grade_sh(sh, settings.to_dict()), sh)


def test_exposure_is_stops_of_light() -> None:
    sh = some_sh(bands=1) * np.float32(0.3)  # dark: nothing clips
    sh[:, 0] -= np.float32(0.7)
    out = base(grade_sh(sh, {"exposure": 0.75}))
    display = base(sh)
    light = ((display + 0.055) / 1.055) ** 2.4 * 2**0.75
    assert (display > 0.04045).all() and (light < 1).all()
    assert np.allclose(out, 1.055 * light ** (1 / 2.4) - 0.055, atol=1e-5)


def test_saturation_contrast_and_strength_by_formula() -> None:
    sh = some_sh(bands=1)
    colors = base(sh)
    grey = colors @ [0.2126, 0.7152, 0.0722]
    assert np.allclose(base(grade_sh(sh, {"saturation": -1})), grey[:, None].repeat(3, 1), atol=1e-5)
    half = base(grade_sh(sh, {"saturation": -1, "strength": 0.5}))
    assert np.allclose(half, (colors + grey[:, None]) / 2, atol=1e-5)
    flat = base(grade_sh(sh, {"contrast": -1}))  # slope 2^-1 at the pivot
    assert (np.abs(flat - 0.461) <= np.abs(colors - 0.461) + 1e-6).all() and flat.std() < 0.8 * colors.std()


def test_a_curve_goes_through_its_points_and_the_corners() -> None:
    levels = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    sh = np.repeat(((levels - 0.5) / SH_C0)[:, None, None], 3, 2).astype(np.float32)
    out = base(grade_sh(sh, {"curve": [[0.25, 0.4], [0.75, 0.8]]}))[:, 0]
    assert np.allclose(out[[0, 1, 3, 4]], [0, 0.4, 0.8, 1], atol=1e-5) and 0.4 < out[2] < 0.8


def test_bands_above_the_first_follow_by_the_jacobian() -> None:
    sh = some_sh(50).astype(np.float64)
    settings = {"exposure": 0.3, "temperature": 0.4, "saturation": 0.3, "contrast": 0.2}
    function = GradeSettings.from_dict(settings)
    out = grade_sh(sh.astype(np.float32), settings)
    colors, step = base(sh), 1e-4
    columns = []
    for channel in range(3):
        side = np.zeros(3)
        side[channel] = step
        columns.append((function(colors + side) - function(colors - side)) / (2 * step))
    jacobian = np.stack(columns, 1)  # [N, in, out], central differences in float64
    new = function(colors)
    calm = (np.abs(jacobian) < 3).all((1, 2)) & (new < 0.95).all(1) & (new > 0.05).all(1)  # no kink of clipping near
    expected = sh[:, 1:] @ jacobian
    assert calm.sum() > 15
    assert np.abs(out[calm, 1:] - expected[calm]).max() < 0.03 * np.abs(expected[calm]).max()


def plainly_graded(sh: np.ndarray, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """What `apply_to_sh` does, in float64 and one Gaussian after the other."""
    out = sh.astype(np.float64)
    for i, row in enumerate(sh.astype(np.float64)):
        color = np.clip(np.nan_to_num(0.5 + SH_C0 * row[0]), 0, 1)
        new = function(color[None])[0]
        out[i, 0] = row[0] + (new - color) / SH_C0
        matrix = np.empty((3, 3))
        for channel in range(3):
            step = -1 / 64 if color[channel] > 0.5 else 1 / 64
            matrix[channel] = (function((color + step * np.eye(3)[channel])[None])[0] - new) / step
        out[i, 1:] = row[1:] @ np.clip(matrix, -4, 4)
    return out


def steep(colors: np.ndarray) -> np.ndarray:
    """Steeper than the limit in red, which green and blue follow."""
    return np.stack([np.clip(20 * colors[:, 0] - 9, 0, 1), *(0.7 * colors[:, 1:] + 0.3 * colors[:, :1]).T], 1)


@pytest.mark.parametrize("bands", [4, 9])
@pytest.mark.parametrize(
    "function",
    [
        GradeSettings(exposure=0.4, temperature=-0.3, contrast=0.3),
        GradeSettings(saturation=0.6, strength=0.6, tint=0.5),
        GradeSettings(contrast=-0.4, hues=(HueBand(30, 80, shift=40, lightness=0.2),)),
        steep,
    ],
)
def test_all_bands_are_those_of_a_plain_formula(function: Callable[[np.ndarray], np.ndarray], bands: int) -> None:
    sh = some_sh(300, bands)
    sh[:5, 0] = [[3, -3, 0], [0, 9, -9], [1.7, 1.7, 1.7], [-1.7, 0.1, 0.1], [0, 0, 0]]  # beyond 0 to 1, or at its ends
    np.testing.assert_allclose(apply_to_sh(sh, function), plainly_graded(sh, function), rtol=1e-5, atol=4e-6)


def test_no_numbers_stay_where_they_are() -> None:
    sh = some_sh(8)
    sh[1, 0, 0], sh[2, 2, 1], sh[3, 0] = np.nan, np.nan, np.inf
    out = grade_sh(sh, {"saturation": 0.5})
    assert np.isnan(out[1, 0, 0]) and np.isinf(out[3, 0]).all()
    assert np.isnan(out[2, 2]).all() and np.isfinite(out[2, [0, 1, 3]]).all() and np.isfinite(out[1, 1:]).all()
    rest = [0, 4, 5, 6, 7]
    assert np.array_equal(out[rest], grade_sh(sh[rest], {"saturation": 0.5}))


def test_a_hue_band_turns_red_and_leaves_blue_and_grey() -> None:
    colors = np.array([[0.8, 0.2, 0.2], [0.2, 0.2, 0.8], [0.5, 0.5, 0.5], [0.2, 0.8, 0.2]], np.float32)
    out = shift_hues(colors, HueBand(0, 60, shift=120))
    assert np.allclose(out[0], [0.2, 0.8, 0.2], atol=1e-5)  # a third of a turn: red is green
    assert np.array_equal(out[1:], colors[1:])
    lighter = shift_hues(colors, HueBand(240, 60, lightness=-1))
    assert np.allclose(lighter[1], [0.1, 0.1, 0.4], atol=1e-6) and np.array_equal(lighter[[0, 2, 3]], colors[[0, 2, 3]])
    dull = shift_hues(colors, HueBand(120, 60, saturation=-1))
    assert np.ptp(dull[3]) < 1e-6
    edge = shift_hues(np.array([[0.8, 0.5, 0.2]], np.float32), HueBand(0, 60, lightness=-1))  # hue 30: half the weight
    assert np.allclose(edge, [[0.6, 0.375, 0.15]], atol=1e-5)


def test_linear_assets_are_graded_as_they_look() -> None:
    light = np.array([[0.05, 0.2, 0.6]])
    sh = ((light - 0.5) / SH_C0)[:, None].astype(np.float32)
    out = base(grade_sh(sh, {"exposure": 0.5, "space": "linear"}))
    assert np.allclose(out, light * 2**0.5, atol=1e-5)


def test_overshoot_is_kept() -> None:
    sh = np.full((1, 1, 3), (1.4 - 0.5) / SH_C0, np.float32)
    assert np.allclose(base(grade_sh(sh, {"contrast": -0.5})), 1.4, atol=0.02)


def test_parameters_travel_as_json_and_wrong_ones_are_named() -> None:
    settings = GradeSettings(exposure=0.5, curve=((0.2, 0.3),), hues=(HueBand(10, shift=5),))
    assert GradeSettings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    for wrong, message in (
        ({"glow": 1}, "look: unknown key 'glow'"),
        ({"exposure": "much"}, "look: expected float as 'exposure', got 'much'"),
        ({"exposure": float("nan")}, "finite"),
        ({"curve": [[0.5, 0.5], [0.5, 0.7]]}, "left to right"),
        ({"hues": [{"hue": 1, "glow": 2}]}, r"look: unknown key 'hues\[0\].glow'"),
        ({"hues": [{"shift": 1}]}, r"look: missing key 'hues\[0\].hue'"),
        ({"space": "XYZ"}, "expected one of srgb, linear as 'space', got 'XYZ'"),
    ):
        with pytest.raises(ValueError, match=message):
            GradeSettings.from_dict(wrong)
