"""New light on assets: irradiance against integrals and formulas, and what the transfer promises."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import UpAxis
from splatpainter.color import base_color, linear_to_srgb, sh_from_color, srgb_to_linear
from splatpainter.lights import gloss, irradiance
from splatpainter.lights import relight as relighting
from splatpainter.lights.facing import facing
from splatpainter.lights.irradiance import LitSurface, sun_light
from splatpainter.lights.lamps import Lamp, Sun, kelvin_color
from splatpainter.lights.light_prior import likely_light
from splatpainter.lights.light_set import Lights, axes_of, turned_sky
from splatpainter.lights.mirror_images import mirrored_light
from splatpainter.lights.relight import delight, relight
from splatpainter.lights.skies import SKIES, direction, sky
from splatpainter.lights.sky_maps import SkyMap, lat_long
from splatpainter.lights.source_light import estimate_source
from splatpainter.operations.region import Region
from splatpainter.splats import Splats
from splatpainter.transforms import fibonacci_sphere, sh_basis
from tests.support.cli_scenes import ball, with_bad_gaussians

UP = Lights(up="+y")


def painted(splats: Splats, light: np.ndarray) -> Splats:
    """The same with linear colours [N, 3] as its base colours."""
    sh = splats.sh.copy()
    sh[:, 0] = sh_from_color(linear_to_srgb(light))
    return replace(splats, sh=sh.astype(np.float32))


def linear(splats: Splats) -> np.ndarray:
    return srgb_to_linear(base_color(splats.sh))


def slow_sky() -> SkyMap:
    """Radiance that SH of degree 2 holds exactly: 2 + x + y z."""
    towards, _ = lat_long(32, 64)
    value = 2 + towards[..., 0] + towards[..., 1] * towards[..., 2]
    return SkyMap((value[..., None] * np.array([1.0, 0.8, 0.5])).astype(np.float32), "slow")


def integral(picture: SkyMap, normal: np.ndarray) -> np.ndarray:
    """[3] irradiance over pi by summing the pixels of an environment of mean 1 over all channels."""
    towards, areas = lat_long(*picture.radiance.shape[:2])
    radiance = picture.radiance.astype(np.float64)
    mean = (radiance * areas[..., None]).sum((0, 1)) / (4 * np.pi)
    cosine = np.maximum(towards @ normal, 0) * areas
    return (radiance * cosine[..., None]).sum((0, 1)) / np.pi / mean.mean()


def test_irradiance_is_the_integral_of_the_environment() -> None:
    surface = LitSurface.of(ball(800), shadows=False)
    received = surface.from_sky(turned_sky(slow_sky(), np.eye(3)))
    for row in (0, 200, 400, 799):
        expected = integral(slow_sky(), surface.facing.normals[row])
        np.testing.assert_allclose(received[row], expected, rtol=0.02)


def test_a_sky_turns_as_azimuths_do() -> None:
    """A lamp at azimuth 0 that is turned by 90 degrees is a lamp at azimuth 90."""
    towards, _ = lat_long(32, 64)

    def lamp_at(azimuth: float) -> SkyMap:
        spot = np.maximum(towards @ direction(azimuth, 20), 0)[..., None] ** 4 * np.ones(3) + 0.1
        return SkyMap(spot.astype(np.float32), "lamp")

    for up in ("+y", "-y", "+z", "-x"):
        axes = axes_of(up)
        assert np.linalg.det(axes) == pytest.approx(1)
        turned = turned_sky(lamp_at(0), axes, 90)
        np.testing.assert_allclose(turned, turned_sky(lamp_at(90), axes), atol=1e-4)
        towards_lamp = axes.T @ direction(90, 20)  # of the asset's axes
        band_1 = np.array([-turned[3, 0], -turned[1, 0], turned[2, 0]])
        np.testing.assert_allclose(band_1 / np.linalg.norm(band_1), towards_lamp, atol=1e-3)


def test_white_light_from_all_around_changes_nothing() -> None:
    white = SkyMap(np.ones((16, 32, 3), np.float32), "white")
    splats = ball(1000)
    edited = relight(splats, replace(UP, sky=white, exposure=1.0), source=white).splats
    same = relight(splats, replace(UP, sky=white, exposure=1e-6), source=white).splats
    np.testing.assert_allclose(same.sh, splats.sh, atol=1e-4)
    np.testing.assert_allclose(linear(edited), 2 * linear(splats), rtol=0.02)


def test_light_is_the_same_in_pieces_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, lights = ball(1000), replace(UP, sky=sky("sunset"), suns=(Sun(30, 40),))
    sh, transfer = relight(splats, lights).splats.sh, LitSurface.of(splats).transfer
    for module in (gloss, relighting):
        monkeypatch.setattr(module, "GLOSS", replace(gloss.GLOSS, piece=130))
    monkeypatch.setattr(irradiance, "STAND_INS", replace(irradiance.STAND_INS, piece=130))
    np.testing.assert_array_equal(relight(splats, lights).splats.sh, sh)
    np.testing.assert_array_equal(LitSurface.of(splats).transfer, transfer)


@pytest.mark.parametrize("intensity, color", [(1.0, (1.0, 1.0, 1.0)), (2.5, (1.0, 0.5, 0.25))])
def test_a_ball_under_a_sun_follows_lamberts_law(intensity: float, color: tuple[float, float, float]) -> None:
    splats = painted(ball(3000), np.full((3000, 3), 0.2))
    white = SkyMap(np.ones((16, 32, 3), np.float32), "white")
    sun = Sun(30, 40, color=color, intensity=intensity)
    edited = relight(splats, Lights(suns=(sun,), fill=0.0, up="+y"), source=white).splats
    cosine = np.maximum(splats.means @ direction(30, 40), 0)[:, None]
    expected = 0.2 * (cosine * intensity * np.array(color) + 0.02) / 1.02
    error = np.abs(linear(edited) - expected) / (0.2 * intensity)
    assert np.median(error) < 0.01 and np.quantile(error, 0.99) < 0.12  # at the terminator a map sees no finer


def test_a_point_lights_by_the_inverse_square_of_its_distance() -> None:
    splats = ball(3000)
    position = np.array([0.0, 0.0, 3.0])
    received = LitSurface.of(splats).from_lamp(Lamp("point", (0.0, 0.0, 3.0)))
    line = position - splats.means
    distance = np.linalg.norm(line, axis=1)
    expected = np.maximum((line * splats.means).sum(1) / distance, 0) / distance**2
    assert np.quantile(np.abs(received - expected), 0.99) < 0.02 and received[splats.means[:, 2] < 0].max() == 0


def plates(gap: float, side: int = 70) -> Splats:
    """Two square plates of edge 2 across y, `gap` apart; the upper one half as wide."""
    x, z = (v.ravel() for v in np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side)))
    floor = np.stack([x, 0 * x, z], 1)
    roof = np.stack([x / 2, 0 * x + gap, z / 2], 1)
    means = np.concatenate([floor, roof]).astype(np.float32)
    count = len(means)
    quats = np.tile([math.sqrt(0.5), -math.sqrt(0.5), 0, 0], (count, 1))  # turns z to y
    scales = np.tile([1.2 / side, 1.2 / side, 0.05 / side], (count, 1))
    arrays = (means, quats, scales, np.full(count, 0.95), np.zeros((count, 1, 3)))
    means, quats, scales, opacities, sh = (array.astype(np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def from_above(splats: Splats, shadows: bool = True) -> LitSurface:
    """The surface of plates that face up, whatever is seen of their undersides."""
    surface = LitSurface.of(splats, shadows)
    up = np.tile(np.array([0, 1, 0], np.float32), (len(splats), 1))
    return replace(surface, facing=replace(surface.facing, normals=up, front=np.ones(len(splats), np.float32)))


@pytest.mark.parametrize("gap", [0.15, 0.5])
def test_what_stands_in_the_way_throws_a_shadow(gap: float) -> None:
    splats = plates(gap)
    surface = from_above(splats)
    floor = np.arange(len(splats)) < len(splats) // 2
    x, _, z = np.abs(splats.means).T
    under, beside = floor & (np.maximum(x, z) < 0.4), floor & (np.minimum(x, z) > 0.65)
    sun = sun_light(surface, Sun(0, 90), np.eye(3))
    lamp = surface.from_lamp(Lamp("point", (0.0, 8.0, 0.0)))
    inside = surface.from_lamp(Lamp("point", (0.0, 0.6 * gap, 0.0)))
    for received in (sun, lamp * 64):
        assert received[under].max() < 0.02, "light leaks through the roof"
        assert received[beside].min() > 0.9
    if gap > 0.3:
        assert inside[~floor].max() == 0 and inside[under].min() > 0.1
    free = sun_light(from_above(splats, shadows=False), Sun(0, 90), np.eye(3))
    np.testing.assert_allclose(free, 1, atol=1e-6)


def test_an_area_is_softer_than_a_point() -> None:
    splats = plates(0.5)
    surface, free = from_above(splats), from_above(splats, shadows=False)
    floor = np.arange(len(splats)) < len(splats) // 2

    def half_lit(lamp: Lamp) -> float:
        share = surface.from_lamp(lamp)[floor] / free.from_lamp(lamp)[floor]
        assert share.min() < 0.02 and share.max() > 0.98
        return float(((share > 0.2) & (share < 0.8)).mean())

    hard = half_lit(Lamp("point", (0.0, 4.0, 0.0)))
    disk = half_lit(Lamp("disk", (0.0, 4.0, 0.0), target=(0.0, 0.0, 0.0), sizes=(1.5,)))
    assert disk > 2 * hard


def test_there_and_back_is_where_it_began() -> None:
    # Dark enough that nothing reaches the limit of what is lit, which has no way back.
    splats = painted(ball(1500), np.random.default_rng(0).uniform(0.02, 0.1, (1500, 3)))
    noon, sunset = sky("noon"), sky("sunset")
    there = relight(splats, replace(UP, sky=sunset), source=noon).splats
    back = relight(there, replace(UP, sky=noon), source=sunset).splats
    assert np.abs(linear(there) - linear(splats)).mean() > 0.01
    np.testing.assert_allclose(base_color(back.sh), base_color(splats.sh), atol=2e-3)


def test_outside_the_region_nothing_changes_by_a_bit() -> None:
    splats = with_bad_gaussians(ball(1200))
    region = Region.parse(["y=..0"])
    edited = relight(splats, replace(UP, sky=sky("sunset")), region)
    assert edited.receipt is not None
    outside = ~(region.weights(splats) > 0)
    np.testing.assert_array_equal(edited.splats.sh[outside].view(np.uint32), splats.sh[outside].view(np.uint32))
    assert edited.receipt.untouched_sha256_before == edited.receipt.untouched_sha256_after
    assert len(edited.receipt.touched) > 0.9 * (~outside).sum() and edited.receipt.method == "ratio"
    for name in ("means", "quats", "scales", "opacities"):
        assert getattr(edited.splats, name) is getattr(splats, name)


def test_half_a_mix_is_half_of_the_light() -> None:
    splats, target = ball(800), replace(UP, sky=sky("noon"))
    full, half = (relight(splats, target, mix=mix).splats for mix in (1.0, 0.5))
    np.testing.assert_allclose(linear(half), (linear(splats) + linear(full)) / 2, atol=1e-4)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", SKIES)
def test_no_sky_makes_sparks_or_holes(name: str, degree: int) -> None:
    splats = ball(600, degree=degree)
    noise = np.random.default_rng(degree).normal(0, 0.1, splats.sh.shape)
    splats = replace(splats, sh=(splats.sh + noise).astype(np.float32))
    edited = relight(splats, replace(UP, sky=sky(name), exposure=3.0)).splats
    assert np.isfinite(edited.sh).all() and np.abs(edited.sh).max() < 12
    lit = linear(edited)[linear(splats).min(1) > 0.02]
    assert lit.min() > 1e-3


def test_a_sun_below_the_horizon_lights_from_below() -> None:
    splats = ball(1000)
    edited = relight(splats, Lights(suns=(Sun(0, -90),), up="+y")).splats
    gain = (linear(edited) / linear(splats))[:, 1]
    assert gain[splats.means[:, 1] < -0.9].min() > 3 * gain[splats.means[:, 1] > 0.9].max()


def test_the_light_of_a_textured_ball_is_estimated() -> None:
    """Albedos at random in patches, two materials, a known sky."""
    rng = np.random.default_rng(1)
    splats = ball(6000)
    surface = LitSurface.of(splats, shadows=False)
    truth = turned_sky(sky("noon"), np.eye(3))
    received = surface.from_sky(truth)
    material = np.where(splats.means[:, :1] > 0, [0.3, 0.25, 0.2], [0.12, 0.2, 0.3])
    colors = (material * rng.lognormal(0, 0.2, (6000, 1)) * received).clip(0, 1)
    estimate = estimate_source(colors, surface.transfer, surface.points, surface.facing.trusted)
    believed = surface.from_sky(estimate.coefficients)
    # Colour and level in the mean belong to the albedo.
    shape, expected = believed / believed.mean(0), received / received.mean(0)
    assert np.abs(shape - expected).mean() < 0.4 * np.abs(1 - expected).mean()
    assert 0 < estimate.uncertainty < 0.6 and "estimated" in estimate.note


def test_without_witnesses_the_light_is_grey_and_says_so() -> None:
    splats = painted(ball(1000), np.ones((1000, 3)))  # clipped to white: no shading to see
    edited = relight(splats, replace(UP, sky=sky("noon")))
    assert edited.receipt is not None and "uniform grey" in edited.receipt.note


def test_a_light_like_the_doubted_one_before_is_remarked() -> None:
    """A ball of one colour in noon's light: the estimate is known within some 30 %, and the same light again differs by
    less than that."""
    light = LitSurface.of(ball(3000), shadows=False).from_sky(turned_sky(sky("noon"), np.eye(3)))
    splats = painted(ball(3000), 0.4 * light)
    doubted = "by less than that is doubted"
    assert doubted in relight(splats, Lights(sky=sky("noon"), up="+y")).receipt.note
    assert doubted not in relight(splats, Lights(suns=(Sun(90, 20),), fill=0.0, up="+y")).receipt.note
    given = relight(splats, Lights(sky=sky("overcast"), up="+y"), source=sky("noon"))
    assert doubted not in given.receipt.note, "what is given is not doubted"


def test_delight_flattens_what_a_sky_had_shaded() -> None:
    splats = painted(ball(4000), np.full((4000, 3), 0.15))
    lit = relight(splats, replace(UP, sky=sky("noon")), source=SkyMap(np.ones((16, 32, 3), np.float32), "white")).splats
    for source, limit in ((sky("noon"), 0.01), (None, 0.5)):
        flat = linear(delight(lit, source=source, up="+y").splats)[:, 1]
        assert flat.std() / flat.mean() < limit * linear(lit)[:, 1].std() / linear(lit)[:, 1].mean() + 0.01


def test_gloss_moves_with_the_light() -> None:
    """Bands that are the mirror image of the old light become that of the new one."""
    normals = np.random.default_rng(0).normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    light = np.random.default_rng(1).normal(size=(9, 3))
    sights = fibonacci_sphere(7, 0.2)
    mirrored = mirrored_light(light, normals)
    for normal, bands in zip(normals, mirrored, strict=True):
        seen = sights - 2 * (sights @ normal)[:, None] * normal
        np.testing.assert_allclose(sh_basis(sights, 2) @ bands, sh_basis(seen, 2) @ light, atol=1e-9)


def test_a_leaf_that_is_seen_from_both_sides_is_not_speckled() -> None:
    splats = plates(0.5)
    floor = np.arange(len(splats)) < len(splats) // 2
    flipped = np.random.default_rng(0).random(len(splats)) < 0.5
    quats = np.where(flipped[:, None], splats.quats * np.array([1, -1, 1, 1], np.float32), splats.quats)
    leaf = replace(splats, quats=quats).take(floor)
    means = leaf.means.copy()  # a little above and below each other: each for itself is seen from one side
    means[:, 1] += np.random.default_rng(1).normal(0, 0.002, len(means))
    leaf = replace(leaf, means=means)
    received = sun_light(LitSurface.of(leaf), Sun(0, 60), np.eye(3))
    inner = np.abs(leaf.means).max(1) < 0.8
    assert received[inner].std() < 0.08 and 0.3 < received[inner].mean() < 0.6  # as much as both sides on average


def test_a_ball_of_any_quaternions_faces_outwards() -> None:
    splats = ball(1500)
    flipped = splats.quats.copy()
    turn = np.random.default_rng(3).random(1500) < 0.5
    w, x, y, z = flipped[turn].T
    flipped[turn] = np.stack([-x, w, z, -y], 1)  # half a turn about its x axis: the shortest axis changes its sign
    sides = facing(replace(splats, quats=flipped))
    assert ((sides.normals * splats.means).sum(1) > 0.99).all() and sides.flat_share == 1


@pytest.mark.parametrize("kelvin, warm", [(1900, True), (2700, True), (6504, None), (15000, False)])
def test_temperatures_are_colours(kelvin: float, warm: bool | None) -> None:
    red, green, blue = kelvin_color(kelvin)
    assert 0.2126 * red + 0.7152 * green + 0.0722 * blue == pytest.approx(1, abs=0.02)
    assert abs(red - blue) < 0.06 if warm is None else (red > blue) is warm


def test_lights_add() -> None:
    splats, white = painted(ball(600), np.full((600, 3), 0.05)), SkyMap(np.ones((16, 32, 3), np.float32), "white")
    suns = (Sun(0, 30), Sun(120, 10, intensity=0.5))

    def lit(*chosen: Sun) -> np.ndarray:
        return linear(relight(splats, Lights(suns=chosen, add=True, up="+y"), source=white).splats)

    both, one, other = lit(*suns), lit(suns[0]), lit(suns[1])
    np.testing.assert_allclose(both, one + other - linear(splats), atol=2e-4)


def test_a_turning_sun_does_not_flicker() -> None:
    surface = LitSurface.of(ball(2000))
    steps = [sun_light(surface, Sun(azimuth, 35, size=4), np.eye(3)) for azimuth in (0, 1, 2, 3)]
    for one, next_one in zip(steps, steps[1:], strict=False):
        change = np.abs(next_one - one)
        assert change.mean() < 0.01 and change.max() < 0.12


def test_names_of_the_package() -> None:
    import splatpainter as sp

    asset = sp.light(ball(300), sp.Lights(sky=sp.sky("overcast"), suns=(sp.Sun(0, 45),), up="+y"))
    assert asset.receipt is not None and asset.receipt.mode == "light"


def test_light_that_colours_do_not_tell_of_comes_from_above() -> None:
    """`likely_light` against the definition: the product of two Gaussians by their inverses."""
    rng = np.random.default_rng(4)
    estimate = 0.2 * rng.normal(size=8)
    down = np.array([[0.0, -1.0, 0.0]])
    ways: tuple[tuple[UpAxis, np.ndarray], ...] = (("+y", -down), ("-y", down))
    for up, towards in ways:
        mean, covariance, belief = likely_light(estimate, 1e6, up)
        basis = sh_basis(np.concatenate([towards, -towards]), 2)[:, 1:]
        above, below = basis @ mean
        assert above > below + 0.3 and belief < 1e-3
        posterior, narrow, belief = likely_light(estimate, 0.05, up)
        expected = np.linalg.inv(np.linalg.inv(covariance) + np.eye(8) / 0.05)
        np.testing.assert_allclose(narrow, expected, atol=1e-5)
        np.testing.assert_allclose(
            posterior, expected @ (np.linalg.solve(covariance, mean) + estimate / 0.05), atol=1e-5
        )
        assert 0 < belief < 1
    np.testing.assert_allclose(likely_light(estimate, 1e-9, "auto")[0], estimate, atol=1e-6)


def test_where_nobody_says_which_way_is_up_the_estimate_does() -> None:
    towards = {"+y": [0.0, 1.0, 0.0], "-y": [0.0, -1.0, 0.0], "+z": [0.0, 0.0, 1.0]}
    for up, axis in towards.items():
        clear = 0.6 * sh_basis(np.array([axis]), 2)[0, 1:]
        mean, _, _ = likely_light(clear, 0.02, "auto")
        given, _, _ = likely_light(clear, 0.02, up)  # type: ignore[arg-type]
        assert np.abs(mean - given).max() < 0.1, up


def test_materials_of_one_hue_are_told_apart_by_brightness() -> None:
    """A grey and a white paint side by side in every patch, the white one on top: paint that looks like light."""
    rng = np.random.default_rng(2)
    splats = ball(6000)
    surface = LitSurface.of(splats, shadows=False)
    received = surface.from_sky(turned_sky(sky("noon"), np.eye(3)))
    white = rng.uniform(size=(6000, 1)) < 0.2 + 0.6 * (splats.means[:, 1:2] > 0)
    colors = (np.where(white, 0.5, 0.15) * received).clip(0, 1)
    estimate = estimate_source(colors, surface.transfer, surface.points, surface.facing.trusted, "+y")
    believed = surface.from_sky(estimate.coefficients)
    shape, expected = believed / believed.mean(0), received / received.mean(0)
    assert np.abs(shape - expected).mean() < 0.2 * np.abs(1 - expected).mean()


def test_a_lamp_inside_an_object_is_remarked() -> None:
    """A ball around the lamp, and a little one beside it that it reaches as nothing is in the way."""
    large, small = ball(1000), ball(60)
    small = replace(small, means=small.means * np.float32(0.1) + np.array([3, 0, 0], np.float32))
    both = large.append(small)
    notes = []
    for position in ((0.0, 0.0, 0.0), (0.0, 3.0, 0.0)):
        lit = relight(both, Lights(lamps=(Lamp("point", position),), up="+y"), shadows=False)
        assert lit.receipt is not None
        notes.append(lit.receipt.note)
    assert "point light at 0,0,0 reaches 3% of what can be seen" in notes[0]
    assert "inside the object" not in notes[1]
