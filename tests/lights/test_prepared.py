"""What is computed once per asset, and the mirror image of light in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import linear_to_srgb, sh_from_color
from splatpainter.lights import prepared
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_cast import cast
from splatpainter.lights.light_set import Lights, axes_of, turned_sky
from splatpainter.lights.mirror_images import mirrored_light
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import relight
from splatpainter.lights.skies import sky
from splatpainter.transforms import fibonacci_sphere, sh_basis
from tests.support.cli_scenes import ball, with_bad_gaussians


def test_a_surface_is_computed_once_for_equal_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    of = LitSurface.of

    def counted(*arguments: object) -> LitSurface:
        made.append(1)
        return of(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(LitSurface, "of", staticmethod(counted))
    splats = with_bad_gaussians(ball(700))
    first = prepared.lit_surface(splats)
    copied = replace(splats, means=splats.means.copy(), sh=splats.sh * np.float32(0.5))
    assert prepared.lit_surface(copied) is first and len(made) == 1, "colours do not move a surface"
    moved = replace(splats, means=splats.means + np.float32(0.25))
    assert prepared.lit_surface(moved) is not first and len(made) == 2
    assert prepared.lit_surface(splats, shadows=False) is not first


@pytest.mark.parametrize("name", ["means", "scales", "quats", "opacities"])
def test_a_change_of_any_part_of_the_shape_is_another_surface(name: str) -> None:
    splats = ball(400)
    values = getattr(splats, name).copy()
    values[0] = values[1]
    if np.array_equal(values, getattr(splats, name)):  # all Gaussians of the ball are equal in it
        values[0] *= np.float32(0.5)
    assert prepared.lit_surface(replace(splats, **{name: values})) is not prepared.lit_surface(splats)


def test_light_before_is_estimated_anew_where_colours_changed() -> None:
    splats = ball(900)
    darker = replace(splats, sh=splats.sh - np.float32(0.3))
    assert prepared.captured_light(splats) is prepared.captured_light(replace(splats, sh=splats.sh.copy()))
    assert prepared.captured_light(darker) is not prepared.captured_light(splats)


def test_what_is_prepared_changes_no_bit() -> None:
    splats, lights = ball(800), Lights(sky=sky("sunset"), up="+y")
    once, again = relight(splats, lights).splats, relight(splats, lights).splats
    prepared._SURFACES.items.clear()
    prepared._SOURCES.items.clear()
    fresh = relight(splats, lights).splats
    np.testing.assert_array_equal(once.sh, again.sh)
    np.testing.assert_array_equal(once.sh, fresh.sh)


@pytest.mark.parametrize("row", range(9))
def test_each_coefficient_has_its_mirror_image(row: int) -> None:
    """Against the definition: what is seen along d is the light of d - 2 (n . d) n."""
    normals = fibonacci_sphere(11, 0.3)
    light = np.zeros((9, 3))
    light[row] = (1.0, -0.5, 2.0)
    sights = fibonacci_sphere(23, 0.1)
    for normal, bands in zip(normals, mirrored_light(light, normals), strict=True):
        seen = sights - 2 * (sights @ normal)[:, None] * normal
        np.testing.assert_allclose(sh_basis(sights, 2) @ bands, sh_basis(seen, 2) @ light, atol=1e-12)


@pytest.mark.parametrize("tint", [(1.2, 1.0, 0.75), (0.8, 1.0, 1.3)])
def test_a_cast_on_neutral_materials_is_seen(tint: tuple[float, float, float]) -> None:
    """Greys under a tinted light, a few coloured ones among them."""
    rng = np.random.default_rng(0)
    greys = rng.uniform(0.2, 0.7, (300, 1)) * np.ones(3)
    reds = np.full((60, 3), (0.5, 0.1, 0.08))
    color = cast(np.concatenate([greys, reds]) * tint, np.ones(360))
    believed, truth = np.log(color / color[1]), np.log(np.array(tint))
    assert color.mean() == pytest.approx(1)
    assert np.abs(believed - truth).max() < 0.8 * np.abs(truth).max()  # warm greys may be warm materials


def test_a_cast_without_witnesses_is_white() -> None:
    np.testing.assert_array_equal(cast(np.zeros((0, 3)), np.zeros(0)), np.ones(3))


@pytest.mark.parametrize("name", ["overcast", "noon"])
def test_what_blocks_the_sky_is_not_taken_for_black(name: str) -> None:
    """Of five balls that touch each other, lit as `from_sky` lights them, the light is told to 5 % of its shading."""
    middle = ball(3000)
    splats = middle
    for step in ((2.05, 0, 0), (-2.05, 0, 0), (0, 0, 2.05), (0, 0, -2.05)):
        splats = splats.append(replace(middle, means=middle.means + np.array(step, np.float32)))
    surface = lit_surface(splats)
    received = surface.from_sky(turned_sky(sky(name), axes_of("+y")))
    albedo = np.where(np.sin(9 * splats.means[:, :1]) > 0, [0.35, 0.2, 0.12], [0.1, 0.2, 0.35])
    sh = splats.sh.copy()
    sh[:, 0] = sh_from_color(linear_to_srgb((albedo * received).clip(0, 1)))
    believed = surface.from_sky(captured_light(replace(splats, sh=sh.astype(np.float32)), up="+y").coefficients)
    shape, expected = believed / believed.mean(0), received / received.mean(0)
    assert np.abs(shape - expected).mean() < 0.055 * np.abs(1 - expected).mean(), "0.07 with black blockers"
