"""The local lift by what it promises: paint where the mask is, nothing anywhere else, rows in their places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift.colors import MAX_COLOR, lift_colors, recolor
from splatpainter.lift.local.local_edit import LocalLift, gaussians_in_mask, lift_local
from splatpainter.lift.options import LocalOptions
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from tests.support.lift_scenes import (
    SH_C0,
    back,
    base_colors,
    db,
    dense_weights,
    differing,
    disk,
    front,
    row,
    same_bits,
    sheet,
)
from tests.support.render_scenes import cameras, scene, with_odd_gaussians

RED = (0.9, 0.1, 0.1)


def draw(splats: Splats, camera: Camera) -> np.ndarray:
    return sp.render(splats, camera).colors[0]


def painted(splats: Splats, camera: Camera, mask: np.ndarray, color=RED) -> np.ndarray:
    """The render with one colour inside the mask."""
    return np.where(mask[..., None], np.float32(color), draw(splats, camera))


def stripes(camera: Camera) -> np.ndarray:
    u = np.arange(camera.width)[None, :, None]
    wave = 0.5 + 0.35 * np.sin(u / 4) * np.array([1, 0.5, -1])
    return np.broadcast_to(wave, (camera.height, camera.width, 3)).astype(np.float32)


def outside(mask: np.ndarray, rim: int = 3) -> np.ndarray:
    """Pixels more than `rim` away from the mask; the rim is where a row's own blur may bleed."""
    return np.logical_not(binary_dilation(mask, np.ones((3, 3)), iterations=rim))


def project_by_hand(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([N, 2] pixels, [N] largest standard deviation in pixels, or a little more)."""
    local = splats.means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    return pixels, 1.2 * splats.scales.max(1) * camera.fx / local[:, 2]


def check_bookkeeping(before: Splats, lifted: LocalLift, camera: Camera, joined: bool = True) -> None:
    """Touched rows are those that differ, and lie where they lay; appended ones are drawn over their parents. joined:
    pieces of several may have become one, up to twice as large and with axes of its own."""
    growth = 2.0 if joined else 1.0001
    n, after = len(before), lifted.splats
    np.testing.assert_array_equal(lifted.touched, np.flatnonzero(differing(before, after)))
    assert len(lifted.parents) == len(after) - n and after.sh_degree == before.sh_degree
    if len(lifted.parents):
        assert lifted.parents.min() >= 0 and lifted.parents.max() < n
    parents = np.concatenate([lifted.touched, lifted.parents])
    children = after.take(np.concatenate([lifted.touched, np.arange(n, len(after))]))
    assert children.drawable.all() and (children.opacities > 0).all() and (children.opacities <= 1).all()
    (old, reach), (new, size) = project_by_hand(before.take(parents), camera), project_by_hand(children, camera)
    assert (np.hypot(*(new - old).T) < 5 * (reach + 1)).all()
    smaller = children.scales.max(1) <= growth * before.scales[parents].max(1)
    assert (smaller | (size < 5)).all()  # pixel-sized, or no larger than the parents
    touched_ids = lifted.touched
    assert (
        np.linalg.norm(after.means[touched_ids] - before.means[touched_ids], axis=1)
        < 2 * before.scales[touched_ids].max(1)
    ).all()
    old, new = before.scales[touched_ids], after.scales[touched_ids]
    assert (new.max(1) <= growth * old.max(1)).all() if joined else (new <= growth * old).all()


# What changes


@pytest.mark.parametrize("side", [30, 60])
@pytest.mark.parametrize("what", ["one colour", "stripes"])
def test_the_edit_appears_and_the_rest_of_the_picture_stays(side, what):
    splats, camera = sheet(side, degree=2), front(128)
    mask = disk(camera, 60, 70, 17)
    before = draw(splats, camera)
    target = (
        painted(splats, camera, mask) if what == "one colour" else np.where(mask[..., None], stripes(camera), before)
    )
    lifted = lift_local(splats, camera, target, mask)
    after = draw(lifted.splats, camera)
    assert db(after, target, mask) > max(18, db(before, target, mask) + 10)
    assert db(after, before, outside(mask)) > 45
    assert db(after, before, ~mask) > 30
    check_bookkeeping(splats, lifted, camera)
    # Only rows near the mask: their centres project into it or not far from it.
    pixels, reach = project_by_hand(splats.take(lifted.touched), camera)
    assert (np.hypot(*(pixels - [60, 70]).T) < 17 + 4 * reach + 2).all()
    if side == 30:
        assert len(lifted.parents) > 100  # rows of six pixels cannot carry either edit


def test_pieces_that_are_not_joined_are_no_larger_than_what_they_were():
    splats, camera = sheet(30, degree=1), front(128)
    mask = disk(camera, 60, 70, 17)
    options = LocalOptions(max_error=1.0)  # no error is mended: no detail, and nothing is joined
    lifted = lift_local(splats, camera, painted(splats, camera, mask), mask, options)
    assert len(lifted.parents) > 100
    check_bookkeeping(splats, lifted, camera, joined=False)


def test_paint_shows_from_other_sides_too():
    splats, camera = sheet(60, degree=1), front(128)
    truth = replace(splats, sh=splats.sh.copy())
    inside = np.hypot(*(splats.means[:, :2] - [0.1, -0.2]).T) < 0.35
    truth.sh[inside] = 0
    truth.sh[inside, 0] = (np.array(RED) - 0.5) / SH_C0
    target = draw(truth, camera)
    mask = np.abs(target - draw(splats, camera)).max(-1) > 0.02
    lifted = lift_local(splats, camera, target, mask)
    for eye in ((1.8, 0, 2.4), (-1.2, 1.5, 2.2), (0, -2, 2.2)):
        side = look_at(eye, (0, 0, 0), width=128, height=128, fov=42)
        expected, region = draw(truth, side), np.abs(draw(truth, side) - draw(splats, side)).max(-1) > 0.02
        assert db(draw(lifted.splats, side), expected, region) > db(draw(splats, side), expected, region) + 8
        assert db(draw(lifted.splats, side), expected, outside(region)) > 38


def test_a_picture_that_is_not_made_of_whole_tiles_edited_in_its_corner():
    splats = sheet(40, half=1.6)
    camera = look_at((0.2, 0.1, 3), (0.1, 0, 0), width=90, height=70, fov=40)
    mask = np.zeros((70, 90), bool)
    mask[:9, 75:] = mask[69, 0] = True
    target = painted(splats, camera, mask)
    lifted = lift_local(splats, camera, target, mask)
    before, after = draw(splats, camera), draw(lifted.splats, camera)
    assert db(after, target, mask) > db(before, target, mask) + 8
    assert db(after, before, outside(mask)) > 40
    check_bookkeeping(splats, lifted, camera)


def test_an_edit_that_hangs_over_the_edge_of_the_asset():
    splats, camera = sheet(30, half=0.5), front(96, (1, 1, 1))
    mask = disk(camera, 70, 48, 14)  # the sheet ends at about x = 68
    target = painted(splats, camera, mask)
    lifted = lift_local(splats, camera, target, mask)
    before, after = draw(splats, camera), draw(lifted.splats, camera)
    on = mask & (sp.render(splats, camera).alphas[0, ..., 0] > 0.9)
    assert db(after, target, on) > db(before, target, on) + 8
    # Nothing is painted on the air: the sheet does not grow.
    was, is_ = sp.render(splats, camera).alphas[0, ..., 0], sp.render(lifted.splats, camera).alphas[0, ..., 0]
    assert is_[outside(was > 0.4, 2)].max() < 0.05 and abs(is_.sum() - was.sum()) < 0.03 * was.sum()
    check_bookkeeping(splats, lifted, camera)


# What does not


def test_rows_behind_an_opaque_surface_take_no_paint():
    wall = sheet(50, opacity=0.99)
    behind = sheet(40, z=-0.15).append(sheet(40, z=-0.8))
    camera = front(96)
    for first, splats in ((0, wall.append(behind)), (len(behind), behind.append(wall))):
        mask = disk(camera, 48, 48, 14)
        lifted = lift_local(splats, camera, painted(splats, camera, mask), mask)
        changed = np.flatnonzero(differing(splats, lifted.splats))
        parents = np.concatenate([changed, lifted.parents])
        assert len(changed) > 50 and (parents >= first).all() and (parents < first + len(wall)).all()


def test_what_shines_through_glass_takes_its_share():
    glass, wall = sheet(30, z=0.3, opacity=0.25), sheet(50, opacity=0.99)
    splats, camera = glass.append(wall), front(96)
    mask = disk(camera, 48, 48, 14)
    target = painted(splats, camera, mask)
    lifted = lift_local(splats, camera, target, mask)
    assert (lifted.touched >= len(glass)).sum() > 50
    assert db(draw(lifted.splats, camera), target, mask) > db(draw(splats, camera), target, mask) + 10


@pytest.mark.parametrize("support", [True, False], ids=["on a sheet", "in the air"])
@pytest.mark.parametrize("opacity", [0.5, 0.97])
def test_a_long_row_is_not_painted_along_its_whole_length(support, opacity):
    # A needle across most of the picture, 1 world unit = 55 pixels; the mask covers a tenth of it.
    needle = row((0, 0, 0.05), (0.45, 0.02, 0.005), (0.2, 0.3, 0.8), opacity=opacity, degree=1)
    splats = sheet(60, degree=1, opacity=0.98).append(needle) if support else needle
    camera = front(128)
    mask = disk(camera, 84, 64, 8)
    target = painted(splats, camera, mask, (0.9, 0.8, 0.1))
    lifted = lift_local(splats, camera, target, mask)
    before, after = draw(splats, camera), draw(lifted.splats, camera)
    alpha = sp.render(splats, camera).alphas[0, ..., 0]
    on = mask & (alpha > 0.6 * alpha[mask].max())
    assert db(after, target, on) > db(before, target, on) + (4 if support else 1.5)
    away = outside(mask, 5)
    assert db(after, before, away) > 45
    along = away & (np.abs(np.arange(128)[:, None] - 63.5) < 3)  # the needle's own pixels
    assert db(after, before, along) > 36  # splitting alone may cost this
    paint = np.array([0.9, 0.8, 0.1]) - [0.2, 0.3, 0.8]
    smear = (after - before)[along] @ paint / (paint @ paint)  # 1: the paint's colour
    assert np.abs(smear.mean()) < 0.008 and np.abs(smear).max() < 0.12
    check_bookkeeping(splats, lifted, camera)


def test_rows_that_may_not_change_do_not():
    splats, camera = sheet(50), front(96)
    mask = disk(camera, 48, 48, 14)
    allowed = np.random.default_rng(0).uniform(size=len(splats)) < 0.5
    lifted = lift_local(splats, camera, painted(splats, camera, mask), mask, allowed=allowed)
    assert allowed[lifted.touched].all() and len(lifted.touched) > 20
    check_bookkeeping(splats, lifted, camera)


def test_odd_rows_keep_their_bits():
    splats = with_odd_gaussians(scene(400, 1, 3, dtype=np.float32))
    camera = cameras(96, 96)[0]
    mask = disk(camera, 50, 40, 15)
    lifted = lift_local(splats, camera, painted(splats, camera, mask), mask)
    assert not differing(splats, lifted.splats)[~splats.drawable].any()
    check_bookkeeping(splats, lifted, camera)
    assert db(draw(lifted.splats, camera), painted(splats, camera, mask), mask) > 8 + db(
        draw(splats, camera), painted(splats, camera, mask), mask
    )


def test_arguments_are_not_written_to():
    splats, camera = sheet(40, degree=1), front(96)
    mask = disk(camera, 48, 48, 14)
    target = painted(splats, camera, mask)
    copies = [getattr(splats, name).copy() for name in ("means", "quats", "scales", "opacities", "sh")]
    pictures = target.copy(), mask.copy()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        getattr(splats, name).flags.writeable = False
    lift_local(splats, camera, target, mask)
    for name, copy in zip(("means", "quats", "scales", "opacities", "sh"), copies, strict=True):
        np.testing.assert_array_equal(getattr(splats, name), copy)
    np.testing.assert_array_equal(target, pictures[0])
    np.testing.assert_array_equal(mask, pictures[1])


# Colours


def test_bands_are_damped_and_not_dropped():
    splats, camera = sheet(40, degree=2), front(96)
    mask = disk(camera, 48, 48, 14)
    lifted = lift_local(splats, camera, painted(splats, camera, mask), mask)
    parents = np.concatenate([lifted.touched, lifted.parents])
    children = np.concatenate([lifted.touched, np.arange(len(splats), len(lifted.splats))])
    old, new = (
        part[:, 1:].reshape(len(parents), -1).astype(np.float64)
        for part in (splats.sh[parents], lifted.splats.sh[children])
    )
    factor = (old * new).sum(1) / (old * old).sum(1)
    np.testing.assert_allclose(new, factor[:, None] * old, atol=1e-6)  # one factor for all bands and channels
    assert (factor > 0.05).all() and (factor < 1.0001).all()
    middle = np.hypot(*(project_by_hand(lifted.splats.take(children), camera)[0] - 48).T) < 8
    assert factor[middle].mean() < 0.6


def seen_colors(splats: Splats, camera: Camera) -> np.ndarray:
    """[N, 3] colours towards the camera, SH degree 1 by its formula (signs of 3DGS)."""
    d = splats.means - camera.position
    x, y, z = (d / np.linalg.norm(d, axis=1, keepdims=True)).T[..., None]
    c1 = np.sqrt(3 / (4 * np.pi))
    sh = splats.sh.astype(np.float64)
    return 0.5 + SH_C0 * sh[:, 0] + c1 * (-y * sh[:, 1] + z * sh[:, 2] - x * sh[:, 3])


def test_lifted_colours_can_be_drawn():
    splats, camera = sheet(40, degree=1), front(96)
    mask = disk(camera, 48, 48, 14)
    for color in ((0, 0, 0), (1, 1, 1), (1, 0, 0)):
        lifted = lift_local(splats, camera, painted(splats, camera, mask, color), mask)
        rows = np.concatenate([lifted.touched, np.arange(len(splats), len(lifted.splats))])
        colors = seen_colors(lifted.splats, camera)[rows]
        assert colors.min() > -1e-5 and colors.max() < 1.5
        assert len(rows) > 100


def test_recolor_gives_the_wanted_colour_towards_the_view():
    splats, camera = sheet(6, degree=1), front()
    rng = np.random.default_rng(0)
    seen = seen_colors(splats, camera)
    change = rng.choice([0.02, 0.1, 0.5], (len(splats), 1)) * rng.uniform(-1, 1, seen.shape)
    expected = seen + change
    new = replace(splats, sh=recolor(splats.sh, seen.astype(np.float32), expected.astype(np.float32), 0.3, 0.4))
    np.testing.assert_allclose(seen_colors(new, camera), expected, atol=1e-5)
    factor = 1 - 0.7 * np.minimum(np.abs(change).max(1) / 0.4, 1)
    np.testing.assert_allclose(new.sh[:, 1:], factor[:, None, None] * splats.sh[:, 1:], atol=1e-6)


def small_scene(rows: int = 60) -> tuple[Splats, Camera, np.ndarray]:
    """(rows inside a 24 x 24 picture, camera, w [N, P])."""
    rng = np.random.default_rng(2)
    splats = Splats(
        np.stack([rng.uniform(-0.8, 0.8, rows), rng.uniform(-0.8, 0.8, rows), rng.uniform(-0.3, 0.3, rows)], 1).astype(
            "f4"
        ),
        rng.normal(0, 1, (rows, 4)).astype("f4"),
        np.exp(rng.uniform(-3, -1, (rows, 3))).astype("f4"),
        rng.uniform(0.1, 1, rows).astype("f4"),
        rng.uniform(-1, 1, (rows, 1, 3)).astype("f4"),
    )
    camera = front(24, (0.3, 0.6, 0.1))
    return splats, camera, dense_weights(splats, camera)[0]


@pytest.mark.parametrize("rounds", [0, 1, 6])
def test_colour_rounds_are_sirt_on_the_matrix_of_weights(rounds):
    splats, camera, w = small_scene()
    splats.sh[3] = (-0.4 - 0.5) / SH_C0  # drawn as 0
    splats.sh[4] = (1.7 - 0.5) / SH_C0  # brighter than any lifted colour, and may stay so
    rng = np.random.default_rng(4)
    target = rng.uniform(-0.3, 1.3, (24, 24, 3)).astype(np.float32)
    m = (rng.uniform(0, 1, (24, 24)) * (rng.uniform(0, 1, (24, 24)) < 0.6)).astype(np.float32)
    editable = rng.uniform(size=len(splats)) < 0.7
    left = dense_weights(splats, camera)[1]

    colors = np.maximum(base_colors(splats), 0)
    ceiling = np.maximum(colors, MAX_COLOR)
    total = w @ m.ravel().astype(np.float64)
    step = np.where(editable & (total > 0), 1 / np.maximum(total, 1e-6), 0)[:, None]
    for _ in range(rounds):
        picture = w.T @ colors + left[:, None] * camera.background
        residual = m.ravel()[:, None] * (target.reshape(-1, 3) - picture)
        colors = np.clip(colors + step * (w @ residual), 0, ceiling)

    frame = project(splats, camera)
    lifted_colors = lift_colors(frame, target, m, editable[frame.gaussian_ids], rounds)
    assert len(frame) > 50
    np.testing.assert_allclose(lifted_colors, colors[frame.gaussian_ids], atol=1e-4)
    if rounds == 6:
        assert (lifted_colors == 0).any() and (lifted_colors == MAX_COLOR).any()  # both clamps were met


def test_every_round_lessens_the_error():
    splats, camera, w = small_scene()
    splats.sh[:] = 0  # grey rows on grey and a soft target: no clamp is met
    camera = replace(camera, background=(0.5, 0.5, 0.5))
    left = dense_weights(splats, camera)[1]
    v, u = np.mgrid[:24, :24] / 24
    target = (0.5 + 0.1 * np.stack([np.sin(5 * u), np.cos(4 * v), 2 * u * v - 0.5], -1)).astype(np.float32)
    m = np.where(disk(camera, 12, 12, 8), 1, 0.3).astype(np.float32)
    frame = project(splats, camera)
    errors = []
    for rounds in range(12):
        colors = lift_colors(frame, target, m, np.ones(len(frame), bool), rounds)
        assert 0 < colors.min() and colors.max() < MAX_COLOR
        picture = w[frame.gaussian_ids].T @ colors + left[:, None] * camera.background
        errors.append(float((m.ravel()[:, None] * (picture - target.reshape(-1, 3)) ** 2).sum()))
    assert (np.diff(errors) < 0).all() and errors[-1] < 0.8 * errors[0]


# Always the same


def test_the_same_call_gives_the_same_bits_on_any_number_of_threads(monkeypatch):
    splats, camera = sheet(50, degree=1), front(112)
    mask = disk(camera, 56, 50, 15)
    target = np.where(mask[..., None], stripes(camera), draw(splats, camera))
    results = []
    for count in ("2", "2", "1", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", count)
        results.append(lift_local(splats, camera, target, mask))
    for other in results[1:]:
        assert same_bits(results[0].splats, other.splats)
        np.testing.assert_array_equal(results[0].touched, other.touched)
        np.testing.assert_array_equal(results[0].parents, other.parents)
    assert len(results[0].parents) > 0


# Nothing to paint on


@pytest.mark.parametrize("case", ["no pixel", "on the background", "on rows that may not change", "on nothing but NaN"])
def test_an_edit_that_reaches_no_row_is_an_error(case):
    splats, camera = sheet(20, half=0.4), front(96)
    mask, allowed = disk(camera, 48, 48, 10), np.ones(len(splats), bool)
    if case == "no pixel":
        mask[:] = False
    elif case == "on the background":
        mask = disk(camera, 5, 5, 4)
    elif case == "on rows that may not change":
        allowed[:] = False
    else:
        splats.means[:] = np.nan
    target = np.full((96, 96, 3), 0.2, np.float32)
    with pytest.raises(ValueError, match="edit: ") as error:
        lift_local(splats, camera, target, mask, allowed=allowed)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="edit: "):
        gaussians_in_mask(splats, camera, mask, allowed)


def test_reached_rows_are_those_with_weight_under_the_mask():
    splats, camera, w = small_scene()
    mask = disk(camera, 9, 13, 5)
    reached = gaussians_in_mask(splats, camera, mask)
    peak = np.where(mask.ravel(), w, 0).max(1)
    assert (peak[reached] > 1 / 512).all()  # invisible shares are not written
    assert reached[peak > 0.2].all() and 10 < reached.sum() < len(splats)


def test_a_long_gaussian_that_is_hidden_beside_the_paint_keeps_its_colour() -> None:
    """A streak behind a wall, seen through an opening that is painted: from behind it would show all of it."""
    streak = row((0, 0, -0.1), (0.5, 0.2, 0.01), (0.2, 0.4, 0.3), opacity=0.98)
    wall = sheet(60, opacity=0.98)
    wall = wall.take(np.flatnonzero(np.hypot(*wall.means[:, :2].T) > 0.1))
    splats, camera = streak.append(wall), front(240)
    behind = back(240)
    mask = disk(camera, 120, 120, 12)
    lifted = lift_local(splats, camera, painted(splats, camera, mask), mask, LocalOptions(spares_long=True))
    assert np.array_equal(lifted.splats.sh[0], splats.sh[0]) and lifted.splats.opacities[0] == splats.opacities[0]
    before, after = (draw(s, behind) for s in (splats, lifted.splats))
    changed = np.abs(after - before).max(-1) > 0.1
    assert not (changed & outside(disk(behind, 120, 120, 12))).any()
    assert db(draw(lifted.splats, camera), painted(splats, camera, mask), mask) > 20, "and it is covered"


@pytest.mark.parametrize("degree", [0, 1])
def test_recolor_of_no_gaussians_is_none(degree: int):
    none = np.zeros((0, (degree + 1) ** 2, 3), np.float32)
    out = recolor(none, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert out.shape == none.shape and out.dtype == none.dtype
