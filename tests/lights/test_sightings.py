"""What views all around tell light of a fitted asset, whose single Gaussians are noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import linear_to_srgb, sh_from_color
from splatpainter.lights import prepared
from splatpainter.lights.facing import facing
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_set import turned_sky
from splatpainter.lights.prepared import captured_light, lit_surface
from splatpainter.lights.relight import delight
from splatpainter.lights.sightings import SeenPixels, Sights, look_around
from splatpainter.lights.skies import sky
from splatpainter.lights.source_light import SourceLight
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball


def product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Hamilton's of quaternions [N, 4], w first."""
    a, b, c, d = first.T
    w, x, y, z = second.T
    columns = (a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y)
    return np.stack([*columns, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w], 1)


def fitted(count: int = 4000, colors: float = 0.0) -> Splats:
    """A grey ball under the sky "noon" as a fit leaves it: axes off by 25 degrees, of any sign, a cloud of some depth,
    colours of single Gaussians off by natural logarithms of `colors`."""
    rng = np.random.default_rng(7)
    splats = ball(count)
    normals = splats.means.astype(np.float64)
    light = LitSurface.of(splats, shadows=False).from_sky(turned_sky(sky("noon"), np.eye(3)))
    light = 0.3 * light / light.mean() * rng.lognormal(0, colors, (count, 1))
    sh = sh_from_color(linear_to_srgb(light))[:, None].astype(np.float32)
    means = normals * (1 + rng.normal(0, 0.015, (count, 1)))
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = np.radians(25) / 2
    turns = np.concatenate([np.full((count, 1), np.cos(half)), np.sin(half) * axes], 1)
    # Half a turn about its x axis changes the sign of the shortest one.
    flips = np.where(rng.random((count, 1)) < 0.5, [1.0, 0, 0, 0], [0.0, 1, 0, 0])
    quats = product(turns, product(splats.quats.astype(np.float64), flips)).astype(np.float32)
    flat = splats.scales * np.array([1, 1, 6], np.float32)
    return replace(splats, means=means.astype(np.float32), quats=quats, scales=flat, sh=sh)


def test_normals_are_those_of_the_surface_that_is_seen() -> None:
    splats = fitted()
    true = splats.means / np.linalg.norm(splats.means, axis=1, keepdims=True)
    sides = facing(splats)
    seen = sides.seen > 1
    assert seen.mean() > 0.5
    degrees = np.degrees(np.arccos(np.clip((sides.normals * true).sum(1)[seen], -1, 1)))
    assert np.median(degrees) < 6 and (degrees < 20).mean() > 0.95, "axes are off by 25"
    assert (sides.front[seen] == 1).mean() > 0.95


def test_the_light_is_found_though_gaussians_are_speckled() -> None:
    splats = fitted(colors=0.3)
    surface = LitSurface.of(splats, shadows=False)
    truth = surface.from_sky(turned_sky(sky("noon"), np.eye(3)))
    believed = surface.from_sky(captured_light(splats, shadows=False, up="+y").coefficients)
    shape, expected = believed / believed.mean(0), truth / truth.mean(0)
    assert np.abs(shape - expected).mean() < 0.3 * np.abs(1 - expected).mean()


def test_delight_of_a_fitted_asset_leaves_less_light_than_was_there() -> None:
    splats = fitted()
    flat = delight(splats, up="+y", shadows=False).splats
    seen = facing(splats).seen > 1
    spread = [float((one.sh[seen, 0] * 0.28209479 + 0.5).std()) for one in (splats, flat)]
    assert spread[1] < 0.4 * spread[0]


def test_pixels_lie_on_the_surface_and_show_its_colour() -> None:
    splats = ball(4000)
    splats = replace(splats, sh=np.full_like(splats.sh[:, :1], sh_from_color(np.array(0.6))))
    pixels = look_around(splats).surface_pixels
    assert len(pixels.views) > 5000
    assert np.abs(np.linalg.norm(pixels.points, axis=1) - 1).max() < 0.05
    outwards = (pixels.normals * pixels.points).sum(1) > 0.95
    assert outwards.mean() > 0.999, "but for what is seen through gaps"
    # Whatever normals Gaussians have, a pixel has those that belong to its colour.
    upright = np.tile(np.array([0, 0.6, 0.8], np.float32), (len(splats), 1))
    light, filled, normals = pixels.witnesses(splats, upright)
    assert filled.mean() > 0.8
    np.testing.assert_allclose(light[filled], ((0.6 + 0.055) / 1.055) ** 2.4, atol=2e-3)
    np.testing.assert_allclose(normals[filled], upright[:1].repeat(filled.sum(), 0), atol=1e-5)
    # Where they cancel out, wholly or nearly, those of the surface stand in.
    for left in (0.0, 0.3):
        _, _, normals = pixels.witnesses(splats, np.float32(left) * upright)
        np.testing.assert_array_equal(normals, pixels.normals.astype(np.float64))


def rippled(count: int = 6000, tilt: float = 0.5, waves: int = 9) -> tuple[Splats, LitSurface, np.ndarray]:
    """A ball of oriented patches that lean by up to `tilt` radians in rings, which their places do not tell; its true
    surface, and the light of the sky "noon" on it, which is its colour."""
    splats = ball(count)
    outwards = splats.means.astype(np.float64)
    half = tilt * np.sin(waves * np.arccos(outwards[:, 2].clip(-1, 1))) / 2
    axes = np.cross(outwards, [0.0, 0, 1])
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    turns = np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * axes], 1)
    splats = replace(splats, quats=product(turns, splats.quats.astype(np.float64)).astype(np.float32))
    surface = LitSurface.of(splats, shadows=False)
    light = surface.from_sky(turned_sky(sky("noon"), np.eye(3)))
    light = 0.35 * light / light.mean()
    return replace(splats, sh=sh_from_color(linear_to_srgb(light))[:, None].astype(np.float32)), surface, light


def test_patches_that_know_their_normals_are_the_better_witnesses() -> None:
    splats, true, light = rippled()
    surface = lit_surface(splats)
    assert surface.facing.oriented

    def error(source: SourceLight) -> float:
        """Rms of the logarithm of the light on the patches."""
        estimate = true.from_sky(source.coefficients)
        return float(np.sqrt((np.log(estimate / estimate.mean() * light.mean() / light) ** 2).mean()))

    by_patches = error(captured_light(splats))
    assert by_patches < 0.055, "0.042 where this was written"
    doubted = replace(surface, facing=replace(surface.facing, oriented=False))
    assert by_patches < 0.75 * error(prepared._estimate(splats, doubted, "auto")), "0.073 by the surface's normals"


def test_undrawable_gaussians_have_no_part() -> None:
    splats = fitted(1500)
    broken = replace(splats, opacities=np.where(np.arange(1500) % 7 == 0, np.nan, splats.opacities).astype(np.float32))
    full, part = facing(broken), facing(splats.take(np.arange(1500) % 7 != 0))
    np.testing.assert_array_equal(full.normals[np.arange(1500) % 7 != 0], part.normals)
    assert not full.normals[::7].any()


NO_IDS, NO_VECTORS = np.zeros(0, np.int64), np.zeros((0, 3), np.float32)
NO_PIXELS = SeenPixels((), NO_IDS, NO_IDS, NO_VECTORS, NO_VECTORS)
UP = np.array([[0.0, 0.0, 1.0]], np.float32)


def seen_from(*views: tuple[tuple[float, float, float], float]) -> Sights:
    """One Gaussian, by views that see a surface of this normal with this weight."""
    footprints = tuple(
        (
            np.zeros(1, np.int64),
            np.array([normal], np.float32) * weight,
            np.full(1, weight, np.float32),
            np.ones(1, bool),
        )
        for normal, weight in views
    )
    return Sights(np.ones(1, np.float32), UP, footprints, NO_PIXELS)


@pytest.mark.parametrize(("front", "back", "height", "share"), [(2, 1, 1, 2 / 3), (1, 2, -1, 2 / 3), (3, 3, 1, 0.5)])
def test_a_sheet_faces_where_more_of_it_is_seen(front: float, back: float, height: float, share: float) -> None:
    normals, shares, there = seen_from(((0, 0, 1), front), ((0, 0, -1), back)).surface_normals(UP)
    np.testing.assert_allclose(normals, [[0, 0, height]], atol=1e-6)
    np.testing.assert_allclose(shares, [share], atol=1e-6)
    assert there.all()


def test_both_sides_of_a_sheet_are_one_surface() -> None:
    """A slope seen from above, and from below with the opposite normal, is the same slope."""
    normals, _, _ = seen_from(((0.6, 0, 0.8), 1.5), ((-0.6, 0, -0.8), 1.4)).surface_normals(UP)
    np.testing.assert_allclose(normals, [[0.6, 0, 0.8]], atol=1e-6)
    tilted, _, _ = seen_from(((0, 0, 1), 1.5), ((0.6, 0, -0.8), 1.4)).surface_normals(UP)
    assert tilted[0, 0] < -0.2, "the mean of (0, 0, 1) and (-0.6, 0, 0.8)"
