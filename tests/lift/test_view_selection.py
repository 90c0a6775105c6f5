"""Several views of one edit: each place is painted from the view that sees it best, and the latest wins a conflict."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift import edits
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import lift_local_views
from splatpainter.lift.local.local_edit import NothingPaintableError
from splatpainter.lift.sheets.paint import PaintedView
from splatpainter.lift.view_selection import view_shares, with_joint_colors
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import SH_C0, db, disk, front, sheet

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9)
RADIUS = 0.4


def from_side(degrees: float, size: int = 96) -> Camera:
    """On the plane z = 0 from beside the axis of `front`."""
    angle = np.radians(degrees)
    return look_at((3 * np.sin(angle), 0, 3 * np.cos(angle)), (0, 0, 0), width=size, height=size, fov=42)


def wall() -> Splats:
    return sheet(50, opacity=0.98)


def recolored(splats: Splats, color: Sequence[float], x: float = 0.0, radius: float = RADIUS) -> Splats:
    """The truth of an edit: a disk of Gaussians about (x, 0) of one colour."""
    inside = np.hypot(splats.means[:, 0] - x, splats.means[:, 1]) < radius
    sh = splats.sh.copy()
    sh[inside, 0] = (np.asarray(color) - 0.5) / SH_C0
    return replace(splats, sh=sh)


def draw(splats: Splats, camera: Camera) -> np.ndarray:
    return sp.render(splats, camera).colors[0]


def views_of(splats: Splats, edits: Sequence[tuple[Camera, Splats]]) -> list[EditView]:
    """edits: cameras, each with the truth that its picture shows."""
    cameras, pictures = [camera for camera, _ in edits], [draw(truth, camera) for camera, truth in edits]
    masks = [
        np.abs(picture - draw(splats, camera)).max(-1) > 0.05 for camera, picture in zip(cameras, pictures, strict=True)
    ]
    return edit_views(splats, cameras, pictures, masks)


def shares(splats: Splats, views: Sequence[EditView]) -> list[float]:
    """Of each view's mask, what it paints."""
    parts = view_shares(splats, Surface.of(splats), views)
    return [float(part.painted.sum() / view.mask.sum()) for part, view in zip(parts, views, strict=True)]


def painted(splats: Splats, views: Sequence[EditView]) -> Splats:
    grid = voxelize(splats)
    return lift_local_views(splats, grid, views, "lift", features=False, surface=Surface.of(splats)).splats


def test_the_view_that_sees_a_place_best_paints_it_in_any_order():
    splats = wall()
    truth = recolored(splats, RED)
    straight, grazing = (front(), truth), (from_side(68), truth)
    first, second = shares(splats, views_of(splats, [straight, grazing]))
    assert first == 1 and second < 0.2
    first, second = shares(splats, views_of(splats, [grazing, straight]))
    assert first < 0.2 and second == 1


def test_views_from_the_side_do_not_spoil_what_the_front_painted():
    """In the front view, and in one that nobody painted."""
    splats = wall()
    truth = recolored(splats, RED)
    views = views_of(splats, [(front(), truth), (from_side(68), truth), (from_side(-60), truth)])
    together, alone = painted(splats, views), painted(splats, views[:1])
    for camera in (front(), from_side(30)):
        mask = np.abs(draw(truth, camera) - draw(splats, camera)).max(-1) > 0.05
        first, all_views = (db(draw(result, camera), draw(truth, camera), mask) for result in (alone, together))
        assert all_views > max(28, first - 1)


def test_the_latest_view_wins_where_views_contradict_each_other():
    splats = wall()
    red, blue = recolored(splats, RED), recolored(splats, BLUE)
    for angles in ((0, 25), (25, 0), (0, 0)):
        views = views_of(splats, [(from_side(angles[0]), red), (from_side(angles[1]), blue)])
        assert shares(splats, views)[1] == 1
        result, last = painted(splats, views), views[1]
        core = last.mask & (np.abs(last.edited - BLUE).max(-1) < 0.1)
        assert db(draw(result, last.camera), last.edited, core) > 25, angles


def test_each_view_paints_what_only_it_edits():
    splats = wall()
    left, right = recolored(splats, RED, -0.5, 0.25), recolored(splats, BLUE, 0.5, 0.25)
    views = views_of(splats, [(front(), left), (from_side(20), right)])
    assert shares(splats, views) == [1, 1]
    together = painted(splats, views)
    for camera, truth in ((front(), left), (from_side(20), right)):
        mask = np.abs(draw(truth, camera) - draw(splats, camera)).max(-1) > 0.05
        assert db(draw(together, camera), draw(truth, camera), mask) > 28


def test_nothing_is_left_unpainted_between_views():
    """Two views from both sides of the paint, each of which sees one half of it better."""
    splats = wall()
    truth = recolored(splats, RED, radius=0.7)
    views = views_of(splats, [(from_side(-40), truth), (from_side(40), truth)])
    result = painted(splats, views)
    for camera in (from_side(-40), front(), from_side(40)):
        core = np.abs(draw(truth, camera) - RED).max(-1) < 0.05
        assert (np.abs(draw(result, camera) - RED).max(-1)[core] < 0.25).mean() > 0.99


def test_what_shows_no_surface_goes_with_the_paint_around_it():
    """A hole in the paint: the view that paints nothing around it paints nothing in it either."""
    splats = wall()
    splats = splats.take(np.flatnonzero(np.hypot(*splats.means[:, :2].T) > 0.2))
    truth, cameras = recolored(splats, RED), [from_side(60), front()]
    pictures = [draw(truth, camera) for camera in cameras]
    ring = [
        np.abs(picture - draw(splats, camera)).max(-1) > 0.05 for camera, picture in zip(cameras, pictures, strict=True)
    ]
    views = edit_views(splats, cameras, pictures, [np.asarray(ndimage.binary_fill_holes(part)) for part in ring])
    grazing, _ = view_shares(splats, Surface.of(splats), views)
    hole = views[0].mask & ~ring[0]
    assert hole.sum() > 20 and not (grazing.painted & hole).any()


def test_a_view_says_nothing_of_what_something_hides_from_it():
    """A plate before the wall, painted alike, fills the nearer view where the other one shows the painted wall."""
    behind, plate = sheet(120, opacity=0.98), sheet(24, z=0.12, half=0.08, opacity=0.98)
    plate.means[:, 0] += 0.12 * np.tan(np.radians(40))
    splats = behind.append(plate)
    splats.sh[:, 0] = 0
    is_plate = np.arange(len(splats)) >= len(behind)
    painted_wall = recolored(splats, RED, radius=0.07)
    painted_wall.sh[is_plate] = splats.sh[is_plate]
    painted_plate = replace(splats, sh=splats.sh.copy())
    painted_plate.sh[is_plate, 0] = (np.asarray(RED) - 0.5) / SH_C0
    near = from_side(40, 240)
    near = look_at(0.7 * near.position, (0, 0, 0), width=240, height=240, fov=42)
    assert shares(splats, views_of(splats, [(front(240), painted_wall), (near, painted_plate)])) == [1, 1]


def test_all_views_paint_what_lies_on_no_surface():
    """Of what another view paints in its stead, where that trusts no surface; not where the two disagree."""
    splats = wall()
    truth = recolored(splats, RED)
    front_view, side = views_of(splats, [(front(), truth), (from_side(60), truth)])
    straight, slanted = view_shares(splats, Surface.of(splats), [front_view, side])
    trusted, untrusted = np.ones_like(side.mask), np.zeros_like(side.mask)
    left = slanted.off_surface([untrusted, untrusted])
    assert left.sum() > 0.6 * side.mask.sum() and not (left & ~side.mask).any()
    assert not slanted.off_surface([trusted, untrusted]).any()
    assert not straight.off_surface([untrusted, untrusted]).any(), "it paints everything itself"
    contradicted = replace(slanted, consistent=np.zeros_like(side.mask))
    assert not contradicted.off_surface([untrusted, untrusted]).any()


def test_joint_colors_leave_what_no_view_edits():
    """Gaussians that reach beyond the paint are held there."""
    splats = sheet(14, opacity=0.98)
    views = views_of(splats, [(front(), recolored(splats, RED)), (from_side(30), recolored(splats, RED))])
    shares_of_all = view_shares(splats, Surface.of(splats), views)
    small = [replace(share, consistent=share.consistent & disk(front(), 48, 48, 8)) for share in shares_of_all]
    result = with_joint_colors(splats, np.ones(len(splats), bool), views, small)
    beside = disk(front(), 48, 48, 16) & ~disk(front(), 48, 48, 8)
    assert db(draw(result, front()), views[0].before, beside) > 12  # 9.4 where nothing holds them


def test_joint_colors_follow_what_views_agree_on():
    """Of Gaussians smaller than a pixel, too, their old colour keeps little."""
    splats = sheet(120, opacity=0.98)
    truth = recolored(splats, RED, radius=0.4)
    views = views_of(splats, [(front(), truth), (from_side(30), truth)])
    shares_of_all = view_shares(splats, Surface.of(splats), views)
    result = with_joint_colors(splats, np.ones(len(splats), bool), views, shares_of_all)
    middle = np.hypot(*splats.means[:, :2].T) < 0.3
    went = (result.sh - splats.sh)[middle, 0] / (truth.sh - splats.sh)[middle, 0]
    assert np.median(went) > 0.8


def test_joint_colors_of_coarse_gaussians_take_several_rounds():
    """As neighbours share pixels."""
    splats = sheet(14, opacity=0.98)
    truth = recolored(splats, RED)
    views = views_of(splats, [(front(), truth), (from_side(30), truth)])
    shares_of_all = view_shares(splats, Surface.of(splats), views)
    result = with_joint_colors(splats, np.ones(len(splats), bool), views, shares_of_all)
    between = from_side(15)
    # 14.5 dB after one round, 16.5 after two, 17.2 after four.
    assert db(draw(result, between), draw(truth, between), disk(between, 48, 48, 14)) > 16.8


def test_joint_colors_leave_what_one_view_alone_shows():
    """It has its colour from that view already."""
    splats = wall()
    truth = recolored(splats, RED)
    views = views_of(splats, [(front(), truth), (from_side(30), truth)])
    both, other = view_shares(splats, Surface.of(splats), views)
    left_half = np.arange(96)[None] < 48
    other = replace(other, consistent=other.consistent & left_half)
    result = with_joint_colors(splats, np.ones(len(splats), bool), views, [both, other])
    x, inside = splats.means[:, 0], np.hypot(*splats.means[:, :2].T) < 0.3
    assert np.array_equal(result.sh[inside & (x > 0.12)], splats.sh[inside & (x > 0.12)])
    assert np.abs(result.sh - splats.sh)[inside & (x < -0.12), 0].max(-1).mean() > 1


def test_joint_colors_leave_long_gaussians_that_reach_out_of_the_paint():
    """A streak of fog crosses the disk and goes on beyond the tiles that are looked at."""
    long = sheet(2).take(np.zeros(1, np.int64))
    long.means[:], long.scales[:], long.opacities[:] = (0, 0, 0.05), (0.9, 0.03, 0.03), 0.5
    splats = sheet(60, opacity=0.98).append(long)
    truth = recolored(splats, RED, radius=0.2)
    truth.sh[-1] = splats.sh[-1]
    views = views_of(splats, [(front(240), truth), (from_side(30, 240), truth)])
    shares_of_all = view_shares(splats, Surface.of(splats), views)
    result = with_joint_colors(splats, np.ones(len(splats), bool), views, shares_of_all)
    assert np.array_equal(result.sh[-1], splats.sh[-1])
    middle = np.hypot(*splats.means[:-1, :2].T) < 0.15
    moved = np.abs(result.sh - splats.sh)[:-1, 0].max(-1)
    assert moved[middle].mean() > 0.3, "what lies inside takes part"


def test_what_others_left_to_a_view_may_lie_beyond_its_limits():
    """A view that sees the paint at 80 degrees has nothing to add, and says how much it could not paint."""
    splats = wall()
    truth = recolored(splats, RED)
    wide = recolored(splats, RED, radius=RADIUS + 0.1)
    views = views_of(splats, [(front(), truth), (from_side(82), wide)])
    lifted = lift_local_views(splats, voxelize(splats), views, "lift", features=False, surface=Surface.of(splats))
    assert len(lifted.limited) == 2 and lifted.limited[0] == 0
    mask = views[0].mask
    assert db(draw(lifted.splats, front()), views[0].edited, mask) > 28


@pytest.mark.parametrize("nothing", [True, False])
def test_only_views_without_anything_to_paint_are_passed_over(nothing: bool, monkeypatch: pytest.MonkeyPatch):
    """Other errors of a view that has little to add are not lost, and name it."""
    splats = wall()
    truth, wide = recolored(splats, RED), recolored(splats, RED, radius=RADIUS + 0.1)
    views = views_of(splats, [(front(), truth), (from_side(50), wide)])
    views = [replace(view, name=f"view {k + 1}") for k, view in enumerate(views)]
    paint_view = edits.paint_view

    def failing(splats: Splats, surface: Surface, camera: Camera, *arguments, **options) -> PaintedView:
        if camera is views[1].camera:
            raise (NothingPaintableError if nothing else ValueError)("edit: as the test wants it")
        return paint_view(splats, surface, camera, *arguments, **options)

    monkeypatch.setattr(edits, "paint_view", failing)
    with contextlib.nullcontext() if nothing else pytest.raises(ValueError, match="view 2: as the test wants it"):
        assert len(painted(splats, views)) > len(splats)
