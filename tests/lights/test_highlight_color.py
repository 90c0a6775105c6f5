"""The colour of a light by its mirror images, on balls whose look is an integral over a sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import luminance
from splatpainter.lights.highlight_color import HighlightColor, highlight_color
from splatpainter.lights.light_cast import cast
from splatpainter.lights.light_set import turned_sky
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.skies import sky
from splatpainter.splats import Splats
from tests.support.glossy_balls import GREY, captured

RED, BLUE = (0.5, 0.1, 0.05), (0.05, 0.15, 0.4)


def hue(color: np.ndarray) -> np.ndarray:
    """[2] natural logarithms of red and blue over green."""
    logs = np.log(color)
    return np.array([logs[0] - logs[1], logs[2] - logs[1]])


def matte(splats: Splats) -> Splats:
    return replace(splats, sh=splats.sh * np.eye(1, splats.sh.shape[1], dtype=np.float32)[..., None])


def mirrored(splats: Splats, name: str) -> HighlightColor | None:
    return highlight_color(splats, lit_surface(splats), luminance(turned_sky(sky(name), np.eye(3))))


@pytest.mark.parametrize("albedo", [GREY, RED, BLUE])
@pytest.mark.parametrize(("gloss", "noise"), [(0.15, 0.0), (0.05, 0.03)])
def test_a_low_sun_is_told_from_the_colour_of_the_ball(
    albedo: tuple[float, float, float], gloss: float, noise: float
) -> None:
    splats, true = captured(sky("sunset"), gloss, noise, albedo), hue(turned_sky(sky("sunset"), np.eye(3))[0])
    error = np.abs(hue(captured_light(splats, up="+y").coefficients[0]) - true).max()
    without = np.abs(hue(captured_light(matte(splats), up="+y").coefficients[0]) - true).max()
    assert error < 0.3 and error < 0.55 * without


@pytest.mark.parametrize("albedo", [RED, BLUE])
def test_grey_light_is_not_taken_for_the_colour_of_the_ball(albedo: tuple[float, float, float]) -> None:
    splats, true = captured(sky("overcast"), 0.05, 0.03, albedo), hue(turned_sky(sky("overcast"), np.eye(3))[0])
    error = np.abs(hue(captured_light(splats, up="+y").coefficients[0]) - true).max()
    without = np.abs(hue(captured_light(matte(splats), up="+y").coefficients[0]) - true).max()
    assert error < 0.7 * without


def test_it_is_the_colour_of_the_side_that_the_light_comes_from() -> None:
    light = turned_sky(sky("sunset"), np.eye(3))
    side = light[1:4].T @ luminance(light[1:4])
    seen = mirrored(captured(sky("sunset"), 0.15), "sunset")
    assert seen is not None
    np.testing.assert_allclose(hue(seen.color), hue(side), atol=0.2)
    assert np.abs(hue(light[0]) - hue(side)).max() > 0.5, "the mean has another colour"


@pytest.mark.parametrize("name", ["noon", "sunset", "studio"])
def test_noise_is_no_mirror_image(name: str) -> None:
    splats = captured(sky(name), 0, noise=0.06)
    assert mirrored(splats, name) is None
    changed, plain = captured_light(splats, up="+y"), captured_light(matte(splats), up="+y")
    np.testing.assert_array_equal(changed.coefficients, plain.coefficients)


def test_a_highlight_without_an_error_decides_as_far_as_sides_of_lights_differ() -> None:
    """Neither all that it says nor nothing of it: a light's mean differs from its brighter side by that much."""
    grey = np.full((40, 3), 0.2)
    warm = HighlightColor(np.array([0.015, 0.01, 0.006]), np.diag([1e-10] * 3))
    red_blue = hue(cast(grey, np.ones(40), warm))
    assert 0.05 < red_blue[0] < 0.3 and -0.4 < red_blue[1] < 0  # it says 0.41 and -0.51, of a ball that looks grey
    vague = HighlightColor(warm.color, np.diag([1e-2] * 3))
    np.testing.assert_allclose(cast(grey, np.ones(40), vague), cast(grey, np.ones(40)), atol=0.01)


def test_how_bright_the_mirror_image_is_does_not_matter() -> None:
    grey, color, error = np.full((40, 3), 0.2), np.array([0.015, 0.01, 0.006]), np.diag([1e-6, 2e-6, 1e-6])
    faint, bright = (cast(grey, np.ones(40), HighlightColor(k * color, k * k * error)) for k in (1, 30))
    np.testing.assert_allclose(faint, bright, rtol=1e-9)


def test_light_is_estimated_anew_where_view_dependence_changed() -> None:
    splats = captured(sky("sunset"), 0.15)
    assert captured_light(splats) is not captured_light(matte(splats))
    assert captured_light(splats) is captured_light(replace(splats, sh=splats.sh.copy()))
