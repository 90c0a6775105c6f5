"""Few Gaussians that stand for many: what they keep of them, and that light hardly tells the difference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import linear_to_srgb, sh_from_color
from splatpainter.lights import sightings, stand_ins
from splatpainter.lights.facing import facing
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_set import turned_sky
from splatpainter.lights.prepared import _estimate
from splatpainter.lights.sightings import dense_places
from splatpainter.lights.skies import sky
from splatpainter.lights.source_light import SourceLight
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from tests.lights.test_bounds import walls
from tests.support.cli_scenes import ball

COUNT = 24_000


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small assets count as dense, by cells as much larger as their Gaussians lie farther apart."""
    limits = replace(stand_ins.STAND_INS, few=5000, cells=3.0)
    for module in (stand_ins, sightings):
        monkeypatch.setattr(module, "STAND_INS", limits)


def axes_of(splats: Splats) -> np.ndarray:
    return quat_to_matrix(splats.quats)[np.arange(len(splats)), :, splats.scales.argmin(1)]


def area(splats: Splats) -> np.ndarray:
    ordered = np.sort(splats.scales.astype(np.float64), 1)
    return splats.opacities * ordered[:, 1] * ordered[:, 2]


def test_sparse_assets_stand_for_themselves() -> None:
    splats = ball(3000)
    assert dense_places(splats, axes_of(splats)) is None
    assert facing(splats).few is None


@pytest.mark.usefixtures("soon")
def test_those_without_a_size_make_no_disc_of_nothing() -> None:
    splats = ball(COUNT)
    few = dense_places(replace(splats, scales=np.full_like(splats.scales, 1e-30)), axes_of(splats))
    assert few is not None
    assert all(np.isfinite(getattr(few.splats, name)).all() for name in ("means", "quats", "scales", "opacities"))
    # In one place, too, where they do not spread either.
    alike = splats.take(np.zeros(COUNT, np.int64))
    few = dense_places(replace(alike, scales=np.full_like(alike.scales, 1e-30)), axes_of(alike))
    assert few is not None and len(few.splats) == 1 and np.isfinite(few.splats.opacities).all()


@pytest.mark.usefixtures("soon")
def test_one_that_is_large_stays_what_it_is() -> None:
    splats = ball(COUNT)
    large = np.arange(COUNT) % 100 == 7
    splats = replace(splats, scales=np.where(large[:, None], 10, 1).astype(np.float32) * splats.scales)
    few = dense_places(splats, axes_of(splats))
    assert few is not None and len(few.splats) < COUNT / 2
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(getattr(few.splats, name)[few.of[large]], getattr(splats, name)[large])
    assert (few.share[large] == 1).all()


@pytest.mark.usefixtures("soon")
def test_a_disc_has_place_direction_area_and_colour_of_its_gaussians() -> None:
    rng = np.random.default_rng(3)
    splats = ball(COUNT)
    fainter = np.where(rng.random(COUNT) < 0.5, 0.01, 0.05).astype(np.float32)
    splats = replace(splats, opacities=fainter, sh=rng.normal(0, 1, (COUNT, 4, 3)).astype(np.float32))
    few = dense_places(splats, axes_of(splats))
    assert few is not None
    for one in range(0, len(few.splats), 997):
        members = few.of == one
        weight = area(splats)[members]
        share = weight / weight.sum()
        np.testing.assert_allclose(few.splats.means[one], share @ splats.means[members], atol=1e-6)
        np.testing.assert_allclose(few.colored(splats).sh[one, 0], share @ splats.sh[members, 0], atol=1e-5)
        np.testing.assert_allclose(area(few.splats)[one], weight.sum(), rtol=1e-4)
        middle = share @ axes_of(splats)[members]
        assert axes_of(few.splats)[one] @ middle / np.linalg.norm(middle) > 0.9999
        # Across the disc they spread by their places, and each by itself.
        away = splats.means[members] - few.splats.means[one]
        height = away @ axes_of(few.splats)[one]
        deep = share @ (height**2 + splats.scales[members].min(1).astype(np.float64) ** 2)
        np.testing.assert_allclose(few.splats.scales[one].min() ** 2, deep, rtol=1e-2)


@pytest.mark.usefixtures("soon")
def test_a_picture_of_the_few_is_that_of_all() -> None:
    splats = ball(COUNT, degree=0)
    few = dense_places(splats, axes_of(splats))
    assert few is not None
    for camera in sightings._around(splats)[:3]:
        all_of_it, those = (project(one, camera).rasterize() for one in (splats, few.colored(splats)))
        assert np.abs(all_of_it[1] - those[1]).mean() < 0.01, "alpha"
        inside = all_of_it[1] > 0.95
        assert np.abs(all_of_it[0] - those[0])[inside].mean() < 0.01, "colour"


@pytest.mark.usefixtures("soon")
def test_what_is_seen_of_one_is_shared_among_those_it_stands_for(monkeypatch: pytest.MonkeyPatch) -> None:
    splats = ball(COUNT)
    dense = facing(splats)
    assert dense.few is not None and len(dense.few.splats) < COUNT / 2
    for module in (stand_ins, sightings):
        monkeypatch.setattr(module, "STAND_INS", stand_ins.StandInLimits())
    assert dense.seen.sum() == pytest.approx(facing(splats).seen.sum(), rel=0.05)


@pytest.mark.usefixtures("soon")
def test_the_light_before_is_that_of_the_colours_of_today() -> None:
    """The shape is kept for assets in other colours, and the discs with it."""
    splats, light = ball(COUNT, degree=0), turned_sky(sky("sunset"), np.eye(3))
    lit = LitSurface.of(splats).from_sky(light)
    recolored = replace(splats, sh=sh_from_color(linear_to_srgb(0.4 * lit))[:, None].astype(np.float32))
    reused, fresh = (_estimate(recolored, LitSurface.of(one), "+y").coefficients for one in (splats, recolored))
    np.testing.assert_array_equal(reused, fresh)
    before = _estimate(splats, LitSurface.of(splats), "+y").coefficients
    assert np.abs(reused - before).max() > 0.1


@pytest.mark.usefixtures("soon")
def test_light_hardly_tells_them_from_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """A room of walls of two layers, whose axes all point one way, under a sky; with Gaussians that cannot be drawn."""
    gap = 0.12
    splats = walls(count=120, gap=gap)
    splats = replace(splats, sh=np.random.default_rng(5).normal(0, 0.1, splats.sh.shape).astype(np.float32))
    broken = np.arange(len(splats)) % 50 == 3
    splats = replace(splats, opacities=np.where(broken, np.nan, splats.opacities).astype(np.float32))
    dense = LitSurface.of(splats)
    few = dense.facing.few
    assert few is not None and len(few.splats) < 0.5 * len(splats)
    assert not dense.facing.normals[broken].any() and not dense.facing.seen[broken].any()
    for module in (stand_ins, sightings):
        monkeypatch.setattr(module, "STAND_INS", stand_ins.StandInLimits())
    plain = LitSurface.of(splats)
    assert plain.facing.few is None
    light = turned_sky(sky("sunset"), np.eye(3))
    x, y, z = splats.means.T
    # Away from the corners, where walls go into each other.
    middle = (np.abs(x) < 0.7) & (np.abs(y) < 0.3) & (z > 0) & ~broken
    inner, outer = middle & (np.abs(z - 1) < 0.02), middle & (np.abs(z - 1 - gap) < 0.02)
    open_light = plain.from_sky(light)[outer].mean()
    for layer, side in ((inner, -1), (outer, 1)):
        received = [surface.from_sky(light)[layer] for surface in (dense, plain)]
        assert np.abs(received[0] - received[1]).mean() < 0.03 * open_light
        assert abs(received[0].mean() - received[1].mean()) < 0.03 * received[1].mean()
        assert ((dense.facing.normals[layer, 2] * side) > 0.9).mean() > 0.98, "each layer faces its own side"
    # What is estimated of the light before, from the few, is that of all, by its own doubt.
    sources = [_estimate(splats, surface, "+y") for surface in (dense, plain)]
    assert all(isinstance(one, SourceLight) for one in sources)
    by_few, by_all = (plain.from_sky(one.coefficients)[middle] for one in sources)
    assert np.sqrt((by_few / by_all - 1) ** 2).mean() < 0.5 * sources[1].uncertainty


@pytest.mark.usefixtures("soon")
def test_both_sides_of_a_thin_wall_are_not_one() -> None:
    outside = ball(COUNT)
    # Half a turn about its x axis changes the sign of the shortest one.
    w, x, y, z = outside.quats.T
    inside = replace(outside, means=outside.means * np.float32(0.999), quats=np.stack([-x, w, z, -y], 1))
    both = outside.append(inside)
    np.testing.assert_allclose(axes_of(both)[COUNT:], -axes_of(both)[:COUNT], atol=1e-6)
    few = dense_places(both, axes_of(both))
    assert few is not None and len(few.splats) < COUNT
    sides = np.bincount(few.of, np.arange(2 * COUNT) < COUNT) / np.bincount(few.of)
    assert set(sides) == {0.0, 1.0}


def test_discs_lie_across_any_normal() -> None:
    normals = np.random.default_rng(1).normal(size=(500, 3))
    normals = np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    turns = quat_to_matrix(stand_ins._upright(normals))
    np.testing.assert_allclose(turns[:, :, 2], normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-12)
