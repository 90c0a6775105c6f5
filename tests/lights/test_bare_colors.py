"""The colours of materials once light is taken out: what they are in the mean, and what no material can be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatpainter.color import base_color, linear_to_srgb, sh_from_color, srgb_to_linear
from splatpainter.lights.bare_colors import lit_side, white_light
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_set import turned_sky
from splatpainter.lights.relight import delight
from splatpainter.lights.skies import sky
from splatpainter.lights.source_light import uniform_coefficients
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball

GREYS = np.repeat(np.array([0.01, 0.1, 0.3, 0.6, 0.9])[:, None], 3, 1)


def bare(colors: np.ndarray, received: np.ndarray, uncertainty: float = 0.0, brightness: float = 1.0) -> np.ndarray:
    return colors / received * white_light(colors, received, uncertainty, brightness, 0.0)


def posterior_mean(ratio: float, error: float) -> float:
    """Of an albedo that is uniform in 0..1 beforehand, by its sum, seen as `ratio` with a log-normal error."""
    albedo = (np.arange(20_000) + 0.5) / 20_000
    likelihood = np.exp(-0.5 * (np.log(ratio / albedo) / error) ** 2)
    return float((albedo * likelihood).sum() / likelihood.sum())


def painted(splats: Splats, light: np.ndarray) -> Splats:
    sh = np.zeros_like(splats.sh)
    sh[:, 0] = sh_from_color(linear_to_srgb(light))
    return Splats(splats.means, splats.quats, splats.scales, splats.opacities, sh.astype(np.float32))


@pytest.mark.parametrize("error", [0.2, 0.35, 0.5])
def test_a_doubted_albedo_is_the_mean_of_what_it_may_be(error: float) -> None:
    """Light as bright as the lit side is changed by nothing but that doubt."""
    albedos = bare(GREYS, np.ones_like(GREYS), error)[:, 0]
    expected = [posterior_mean(float(grey), error) for grey in GREYS[:, 0]]
    np.testing.assert_allclose(albedos, expected, atol=0.04)
    assert (np.diff(albedos) > 0).all(), "brighter stays brighter"


def test_no_material_gives_back_more_than_it_gets() -> None:
    colors = np.array([[0.8, 0.4, 0.2]])
    for uncertainty in (0.0, 0.4):
        out = bare(colors, np.full((1, 3), 0.05), uncertainty)
        assert 0.7 < out.max() <= 1
        np.testing.assert_allclose(out / out.max(), colors / colors.max(), rtol=1e-9, err_msg="hues stay")


def test_what_is_sure_and_not_changed_stays_as_it_is() -> None:
    lamp = np.full((1, 3), 5.0)
    for colors in (0.99 * GREYS, lamp):
        np.testing.assert_allclose(bare(colors, np.ones_like(colors)), colors, rtol=2e-3)


def test_the_lit_side_gets_more_than_most_directions() -> None:
    assert math.isclose(lit_side(2 * uniform_coefficients()), 2.0, rel_tol=1e-6)
    coefficients = uniform_coefficients()
    coefficients[2] = 0.5 * coefficients[0]  # from +z: irradiance 1 + cosine / sqrt(3), a tenth of it above 0.8
    assert math.isclose(lit_side(coefficients), 1 + 0.8 / math.sqrt(3), abs_tol=0.02)


def test_colours_of_the_lit_side_stay_and_dark_ones_come_up_to_them() -> None:
    splats = ball(3000)
    light = LitSurface.of(splats).from_sky(turned_sky(sky("noon"), np.eye(3)))
    lit = painted(splats, 0.3 * light / np.quantile(light, 0.9, axis=0))
    flat = srgb_to_linear(base_color(delight(lit, source=sky("noon"), up="+y").splats.sh))
    luminances = (flat @ np.array([0.2126, 0.7152, 0.0722]))[light[:, 1] > 0.2]
    np.testing.assert_allclose(luminances, 0.3, rtol=0.1)
