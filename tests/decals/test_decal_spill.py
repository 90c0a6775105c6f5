"""Decals on what is cracked, thin, hollow or foggy: they find surface, hold places once and paint where they lie."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.decals import decal_survey, decal_views
from splatpainter.decals.decal_surface import surface_under
from splatpainter.decals.decals import Decal
from splatpainter.painter import Painter
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import unwrap
from tests.decals.test_decals import FRONT, MIDDLE, RED, looking
from tests.support import surface_shapes

AHEAD = np.array([0, 0, 1.0])
SQUARE = np.full((64, 64, 3), RED, np.float32)


def facing(points: np.ndarray, width: float) -> sp.Splats:
    return surface_shapes.patches(points, np.tile(AHEAD, (len(points), 1)), width)


def cracked_box() -> sp.Splats:
    """A box with a hole in the middle of its front, through which a small patch behind it shows."""
    box = surface_shapes.box(10_000)
    hole = (box.means[:, 2] > 0.45) & (np.hypot(box.means[:, 0], box.means[:, 1]) < 0.05)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.04, 0.04, 6), np.linspace(-0.04, 0.04, 6)))
    return box.take(np.flatnonzero(~hole)).append(facing(np.stack([x, y, np.full(len(x), 0.42)], 1), 0.012))


def test_a_click_into_a_crack_lies_on_the_surface_around_it() -> None:
    asset = Painter().encode(cracked_box())
    placement = Decal(SQUARE, MIDDLE, FRONT, 0.8).placed(asset)
    assert abs(placement.point[2] - 0.5) < 0.02 and np.hypot(*placement.point[:2]) < 0.1 * 0.8
    assert placement.surface_share > 0.9


def test_every_pixel_that_shows_the_asset_has_a_place_for_a_decal() -> None:
    """Where no plane fits the preview showed one, and Apply said that there is no surface."""
    rng = np.random.default_rng(0)
    cloud = facing(rng.uniform(-0.5, 0.5, (200, 3)), 0.06)
    scales = (0.06 * rng.uniform(0.3, 2, (200, 3))).astype(np.float32)
    cloud = replace(cloud, scales=scales, quats=rng.normal(size=(200, 4)).astype(np.float32))
    asset, camera = Painter().encode(cloud), FRONT.resized(64, 64)
    surface, alpha = Surface.of(asset.splats), sp.render(cloud, camera).alphas[0][..., 0]
    for x, y in ((16, 36), (16, 40), (36, 20)):
        assert alpha[y, x] > 0.6
        point, normal = surface_under(asset, surface, camera, (x + 0.5, y + 0.5))
        (pixel,), _ = camera.project(point[None])
        assert np.abs(pixel - (x + 0.5, y + 0.5)).max() < 2.5 and normal @ (camera.position - point) > 0
    with pytest.raises(ValueError, match="no surface under"):
        surface_under(asset, surface, camera, (1.5, 1.5))


def test_a_click_on_a_wire_stays_on_the_wire() -> None:
    """Little of a decal lies on it, but the wall behind it is not what was clicked."""
    x = np.linspace(-0.1, 0.1, 60)
    rows = [np.stack([x, np.full(60, y), np.full(60, 1.2)], 1) for y in (-0.008, 0.0, 0.008)]
    asset = Painter().encode(surface_shapes.box(6_000).append(facing(np.concatenate(rows), 0.006)))
    placement = Decal(SQUARE, MIDDLE, FRONT, 0.7).placed(asset)
    assert placement.surface_share < 0.1
    assert abs(placement.point[2] - 1.2) < 0.05


def two_sheets(gap: float, back: float) -> tuple[np.ndarray, np.ndarray]:
    """(points, normals) of a strip along x that turns around a cylinder and comes back `gap` behind itself, `back`
    long."""
    step = 0.02
    y = np.arange(-5, 6) * step
    front = np.arange(-10, 11) * step
    turn = np.arange(step, np.pi * gap / 2, step) / (gap / 2)
    middle = front[-1] + np.zeros_like(turn)
    behind = front[-1] - np.arange(0, back, step)
    x = np.concatenate([front, middle + gap / 2 * np.sin(turn), behind])
    z = np.concatenate([0 * front, gap / 2 * (np.cos(turn) - 1), 0 * behind - gap])
    n = np.concatenate([np.tile([0, 1.0], (len(front), 1)), np.stack([np.sin(turn), np.cos(turn)], 1)])
    n = np.concatenate([n, np.tile([0, -1.0], (len(behind), 1))])
    points = np.stack([np.repeat(x, len(y)), np.tile(y, len(x)), np.repeat(z, len(y))], 1)
    normals = np.stack([np.repeat(n[:, 0], len(y)), np.zeros(len(points)), np.repeat(n[:, 1], len(y))], 1)
    middle_first = np.argsort(np.linalg.norm(points, axis=1), kind="stable")
    return points[middle_first], normals[middle_first]


def test_a_place_of_the_picture_is_held_once() -> None:
    """Around a rim a strip goes on unheld by others; a second sheet that says it holds places of the first is not."""
    points, normals = two_sheets(0.2, 0.3)
    samples = unwrap(points, normals, np.array([0, 1.0, 0]), 0.02, (0.8, 0.2))
    assert samples.reached.all()
    assert not decal_survey.laid_twice(samples).any()
    behind = samples.normals[:, 2] < -0.9
    # As if the way around the rim were none: the back then holds what lies before it.
    uv = samples.uv.copy()
    uv[behind, 0] = samples.points[behind, 0]
    folded = replace(samples, uv=uv)
    twice = decal_survey.laid_twice(folded)
    assert twice[behind].mean() > 0.95 and not twice[~behind].any()
    same_way = replace(folded, normals=np.tile(AHEAD, (len(points), 1)))
    assert not decal_survey.laid_twice(same_way).any(), "a fold that faces the same way"


def test_small_pieces_that_nothing_joins_to_the_middle_are_crumbs() -> None:
    """A plane of 41 x 41 samples; parts of it lie elsewhere, as on another body, though the picture goes on there."""
    step = 0.02
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(-20, 21) * step, np.arange(-20, 21) * step))
    middle_first = np.argsort(u**2 + v**2, kind="stable")
    u, v = u[middle_first], v[middle_first]
    plane = unwrap(np.stack([u, v, 0 * u], 1), np.tile(AHEAD, (len(u), 1)), np.array([0, 1.0, 0]), step, (0.35, 0.35))
    within = plane.reached
    under = within & (np.abs(plane.uv) < 0.35).all(1)
    assert under.sum() == 35**2 and not decal_survey.crumbs(plane, within, under).any()

    def crumbs_where(elsewhere: np.ndarray) -> np.ndarray:
        points = plane.points + np.where(elsewhere[:, None], (0, 0, -8 * step), 0)
        return decal_survey.crumbs(replace(plane, points=points), within, under)

    corner = (u > 0.21) & (v > 0.21)
    assert 20 < (corner & under).sum() < 0.05 * under.sum() < under.sum() - (corner & under).sum()
    np.testing.assert_array_equal(crumbs_where(corner), corner & within)
    assert not crumbs_where(u > 0.1).any(), "the other side of a gap"
    middle = (np.abs(u) < 0.05) & (np.abs(v) < 0.05)
    assert not crumbs_where(middle).any(), "what was clicked stays, however small"


@pytest.mark.parametrize("noise", [0.0, 0.5], ids=["surveyed", "fused"])
def test_crumbs_are_neither_shown_nor_laid(noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    asset = Painter().encode(surface_shapes.box(8_000, noise=noise))
    decal = Decal(SQUARE, MIDDLE, FRONT, 0.6)
    monkeypatch.setattr(decal_survey, "crumbs", lambda samples, within, under: within & (samples.points[:, 0] > 0.15))
    placement = decal.placed(asset)
    assert bool(placement.patch.smoothing) == (noise > 0)
    part = placement.map_on(asset, asset.surface, FRONT)
    ys, xs = np.nonzero(np.isfinite(part[..., 0]))
    points = FRONT.unproject(sp.render(asset.splats, FRONT).depths[0, ..., 0][ys, xs], np.stack([xs, ys], 1) + 0.5)
    assert points[:, 0].min() < -0.25 and 0.1 < points[:, 0].max() < 0.22
    masks = [(edit.camera, np.nonzero(edit.mask)) for edit in decal.views(asset) if edit.mask is not None]
    for camera, (ys, xs) in masks:
        seen = sp.render(asset.splats, camera).depths[0, ..., 0][ys, xs]
        assert camera.unproject(seen, np.stack([xs, ys], 1) + 0.5)[:, 0].max() < 0.25


def test_a_body_before_foggy_surface_does_not_show_its_decal() -> None:
    """A plate as near before a rough box as fog may be, at a slant: it is trusted to be where it is, so it is none."""
    aslant = looking(np.array([0.1, 0, 0.5]), np.array([0.87, 0, 0.5]))
    box = surface_shapes.box(20_000, noise=0.5)
    patch = Decal(SQUARE, MIDDLE, FRONT, 0.8).placed(Painter().encode(box)).patch
    away = 0.85 * patch.smoothing
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 0.3, 50), np.linspace(-0.15, 0.15, 50)))
    plate = facing(np.stack([x, y, np.full(len(x), 0.5 + away)], 1), 0.006)
    pixels, _ = aslant.project(plate.means.astype(np.float64))
    columns, rows = pixels.astype(int).T
    inner = slice(rows.min() + 5, rows.max() - 5), slice(columns.min() + 5, columns.max() - 5)
    shares = []
    for splats in (box, box.append(plate)):
        asset = Painter().encode(splats)
        view = decal_views.mapped_view(asset, asset.surface, patch, patch.under, aslant)
        on = np.zeros((aslant.height, aslant.width), bool)
        on[view.ys, view.xs] = True
        shares.append(float(on[inner].mean()))
    assert patch.smoothing and shares[0] > 0.95 and shares[1] < 0.05, shares


def windowed_plate() -> sp.Splats:
    """A thin rough plate with a window in it, frame and all: the way through the window leads to its back."""
    plate = surface_shapes.box(20_000, (0.6, 0.6, 0.12), noise=0.5)
    window = (np.abs(plate.means - (0.2, 0, 0)) < (0.1, 0.2, 9)).all(1)
    frame = surface_shapes.box(3_000, (0.1, 0.2, 0.12), noise=0.5)
    sides = np.abs(frame.means[:, 2]) < 0.1
    frame = frame.take(np.flatnonzero(sides))
    turned = replace(frame, means=frame.means + np.array([0.2, 0, 0], np.float32))
    return plate.take(np.flatnonzero(~window)).append(turned)


def test_the_back_of_a_plate_does_not_show_a_decal_again() -> None:
    asset = Painter().encode(windowed_plate())
    decal = Decal(SQUARE, MIDDLE, FRONT, 0.9)
    patch = decal.placed(asset).patch
    held, spacing = patch.samples, patch.samples.spacing
    back = patch.under & (held.points[:, 2] < 0)
    front = patch.under & ~back
    twice = [np.linalg.norm(held.uv[front] - uv, axis=1).min() < 0.5 * spacing for uv in held.uv[back]]
    assert patch.smoothing and front.sum() > 1_000
    assert sum(twice) < 100, "247 without it"


def plane_view(direction: np.ndarray, before: float) -> tuple[Any, Any, Any, Any, Any, Any]:
    """What `_strays` is told of a plane of samples at z = 0, seen from a direction, where light comes from `before` it:
    20 x 20 pixels of a larger picture."""
    step = 0.02
    u, v = (axis.ravel() for axis in np.meshgrid(np.arange(-30, 31) * step, np.arange(-30, 31) * step))
    middle_first = np.argsort(u**2 + v**2, kind="stable")
    points = np.stack([u, v, 0 * u], 1)[middle_first]
    samples = unwrap(points, np.tile(AHEAD, (len(points), 1)), np.array([0, 1.0, 0]), step, (0.6, 0.6))
    camera = looking(np.zeros(3), direction / np.linalg.norm(direction))
    xs, ys = (axis.ravel() for axis in np.meshgrid(np.arange(110, 130), np.arange(110, 130)))
    rays = camera.unproject(np.ones(400), np.stack([xs, ys], 1) + 0.5) - camera.position
    length = camera.position[2] / -rays[:, 2]
    uv, nearest = samples.at(camera.position + length[:, None] * rays, np.tile(AHEAD, (400, 1)))
    depth = np.zeros((240, 240))
    depth[ys, xs] = (camera.position[2] - before) / -rays[:, 2]
    return samples, camera, np.stack([xs, ys], 1), uv, nearest, depth


@pytest.mark.parametrize(
    ("direction", "before", "expected"),
    [
        ((0, 0, 1.0), 0.2, 0.0),
        ((1.0, 0, 1.0), 0.2, 0.2),
        ((1.0, 0, 1.0), 0.05, 0.0),
        ((1.0, 0, 0.5), 0.2, 0.4),
        ((1.0, 0, 1.0), -0.2, 0.0),
    ],
    ids=["from the front", "at 45 degrees", "little", "at 63 degrees", "behind it"],
)
def test_fog_before_the_surface_strays_at_a_slant(direction, before: float, expected: float) -> None:
    """By its height times the tangent of the angle; a view whose fog strays less than the limit is as it was."""
    strays = decal_views._strays(*plane_view(np.array(direction), before), 0.1)
    np.testing.assert_allclose(np.median(strays), expected, atol=0.02)


STRAYS = decal_views._strays


def nowhere(camera: sp.Camera) -> bool:
    return False


def painted(edits: Sequence[sp.Edit], of: Callable[[sp.Camera], bool]) -> int:
    """Pixels that some cameras paint."""
    return sum(int(edit.mask.sum()) for edit in edits if edit.mask is not None and of(edit.camera))


def foul(monkeypatch: pytest.MonkeyPatch, fouled: Callable[[sp.Camera], bool]) -> None:
    """All that some cameras paint lands elsewhere."""

    def strays(samples, camera, pixels, *rest):  # type: ignore[no-untyped-def]
        return np.ones(len(pixels)) if fouled(camera) else STRAYS(samples, camera, pixels, *rest)

    monkeypatch.setattr(decal_views, "_strays", strays)


def test_a_view_leaves_what_strays_to_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the edge of a box: both views see some of each face. What strays in all is painted nevertheless."""
    asset = Painter().encode(surface_shapes.box(6_000))
    edge = looking(np.array([0.5, 0, 0.5]), np.array([0.75, 0, 1.0]) / 1.25)
    decal = Decal(SQUARE, MIDDLE, edge, 0.5)
    counts = []
    for fouled in (nowhere, lambda camera: camera.forward[0] < -0.9, lambda camera: True):
        foul(monkeypatch, fouled)
        laid = decal.laid(asset)
        assert laid.coverage > 0.99
        counts.append(painted(laid.edits, lambda camera: camera.forward[0] < -0.9))
    assert counts[0] == counts[2] > 3_000
    assert 0.5 * counts[0] < counts[1] < 0.9 * counts[0], "the view from between the faces lays the rest"


def test_views_from_the_sides_leave_what_strays(monkeypatch: pytest.MonkeyPatch) -> None:
    asset = Painter().encode(surface_shapes.box(4_000))
    monkeypatch.setattr(decal_views, "DECAL_VIEWS", replace(decal_views.DECAL_VIEWS, min_clear=1.01))
    decal = Decal(SQUARE, MIDDLE, FRONT, 0.5)
    assert len(decal.views(asset)) == 3
    foul(monkeypatch, lambda camera: camera.forward[0] < -0.4)
    assert [float(round(edit.camera.forward[0], 1)) for edit in decal.views(asset)] == [0.6, 0.0]
