"""The sliders of a global look on rows: written-out formulas, finite differences, and exact promises."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatpainter.sources.grade import Grade, HueBand, banded, grade
from splatpainter.splats import SH_C0


def rows(count: int = 200, bands: int = 4, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    colors = rng.uniform(0.1, 0.9, (count, 3))
    sh = rng.normal(0, 0.02, (count, bands, 3))
    sh[:, 0] = (colors - 0.5) / SH_C0
    return sh.astype(np.float32)


def base(sh: np.ndarray) -> np.ndarray:
    return 0.5 + SH_C0 * sh[:, 0].astype(np.float64)


@pytest.mark.parametrize(
    "settings", [Grade(), Grade(space="linear"), Grade(strength=0.3), Grade(curve=((0.25, 0.25), (0.5, 0.5)))]
)
def test_zeros_change_nothing_bit_for_bit(settings: Grade) -> None:
    sh = rows()
    sh[:3, 0] = [[9, -9, 0]]  # beyond what screens show, and exactly grey
    assert np.array_equal(grade(sh, settings.to_dict()), sh)


def test_exposure_is_stops_of_light() -> None:
    sh = rows(bands=1) * np.float32(0.3)  # dark: nothing clips
    sh[:, 0] -= np.float32(0.7)
    out = base(grade(sh, {"exposure": 0.75}))
    display = base(sh)
    light = ((display + 0.055) / 1.055) ** 2.4 * 2**0.75
    assert (display > 0.04045).all() and (light < 1).all()
    assert np.allclose(out, 1.055 * light ** (1 / 2.4) - 0.055, atol=1e-5)


def test_saturation_contrast_and_strength_by_formula() -> None:
    sh = rows(bands=1)
    colors = base(sh)
    grey = colors @ [0.2126, 0.7152, 0.0722]
    assert np.allclose(base(grade(sh, {"saturation": -1})), grey[:, None].repeat(3, 1), atol=1e-5)
    half = base(grade(sh, {"saturation": -1, "strength": 0.5}))
    assert np.allclose(half, (colors + grey[:, None]) / 2, atol=1e-5)
    flat = base(grade(sh, {"contrast": -1}))  # slope 2^-1 at the pivot
    assert (np.abs(flat - 0.461) <= np.abs(colors - 0.461) + 1e-6).all() and flat.std() < 0.8 * colors.std()


def test_a_curve_goes_through_its_points_and_the_corners() -> None:
    levels = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    sh = np.repeat(((levels - 0.5) / SH_C0)[:, None, None], 3, 2).astype(np.float32)
    out = base(grade(sh, {"curve": [[0.25, 0.4], [0.75, 0.8]]}))[:, 0]
    assert np.allclose(out[[0, 1, 3, 4]], [0, 0.4, 0.8, 1], atol=1e-5) and 0.4 < out[2] < 0.8


def test_bands_above_the_first_follow_by_the_jacobian() -> None:
    sh = rows(50).astype(np.float64)
    settings = {"exposure": 0.3, "temperature": 0.4, "saturation": 0.3, "contrast": 0.2}
    function = Grade.from_dict(settings)
    out = grade(sh.astype(np.float32), settings)
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


def test_a_hue_band_turns_red_and_leaves_blue_and_grey() -> None:
    colors = np.array([[0.8, 0.2, 0.2], [0.2, 0.2, 0.8], [0.5, 0.5, 0.5], [0.2, 0.8, 0.2]], np.float32)
    out = banded(colors, HueBand(0, 60, shift=120))
    assert np.allclose(out[0], [0.2, 0.8, 0.2], atol=1e-5)  # a third of a turn: red is green
    assert np.array_equal(out[1:], colors[1:])
    lighter = banded(colors, HueBand(240, 60, lightness=-1))
    assert np.allclose(lighter[1], [0.1, 0.1, 0.4], atol=1e-6) and np.array_equal(lighter[[0, 2, 3]], colors[[0, 2, 3]])
    dull = banded(colors, HueBand(120, 60, saturation=-1))
    assert np.ptp(dull[3]) < 1e-6
    edge = banded(np.array([[0.8, 0.5, 0.2]], np.float32), HueBand(0, 60, lightness=-1))  # hue 30: half the weight
    assert np.allclose(edge, [[0.6, 0.375, 0.15]], atol=1e-5)


def test_linear_assets_are_graded_as_they_look() -> None:
    light = np.array([[0.05, 0.2, 0.6]])
    sh = ((light - 0.5) / SH_C0)[:, None].astype(np.float32)
    out = base(grade(sh, {"exposure": 0.5, "space": "linear"}))
    assert np.allclose(out, light * 2**0.5, atol=1e-5)


def test_overshoot_is_kept() -> None:
    sh = np.full((1, 1, 3), (1.4 - 0.5) / SH_C0, np.float32)
    assert np.allclose(base(grade(sh, {"contrast": -0.5})), 1.4, atol=0.02)


def test_parameters_travel_as_json_and_wrong_ones_are_named() -> None:
    settings = Grade(exposure=0.5, curve=((0.2, 0.3),), hues=(HueBand(10, shift=5),))
    assert Grade.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
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
            Grade.from_dict(wrong)
