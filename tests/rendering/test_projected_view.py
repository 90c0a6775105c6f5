"""`ProjectedView`, what the lift is built on: local pictures, sums over pixels, and the fused round."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest
import torch

import splatpainter as sp
from splatpainter.cameras import look_at
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import THREADS_VARIABLE, run
from splatpainter.rendering import reference
from splatpainter.rendering.cpu import projected_view, sirt
from splatpainter.rendering.cpu.geometry import GAUSSIANS_PER_BLOCK, StepSizes
from splatpainter.rendering.cpu.projected_view import _depth_order, project, tile_shape, tiles_of_mask
from splatpainter.rendering.cpu.sirt import pairs_of, sirt_steps
from splatpainter.rendering.cpu.views import render_views, render_views_backward
from tests.support.render_scenes import cameras, opaque_stack, scene, with_odd_gaussians


def pixels_of(tiles: np.ndarray, height: int, width: int) -> np.ndarray:
    """[H, W] bool of a [TH, TW] one."""
    return np.kron(tiles, np.ones((16, 16), bool))[:height, :width]


@pytest.mark.parametrize(
    "splats", [with_odd_gaussians(scene(60, 1, 1)), opaque_stack()], ids=["odd Gaussians", "opaque"]
)
def test_accumulate_is_the_sum_over_the_references_weights(splats):
    camera = cameras(45, 37)[0]
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (37, 45, 3))
    mask = rng.uniform(0, 1, (37, 45)) * (rng.uniform(0, 1, (37, 45)) < 0.3)
    mask[:16] = 0  # tiles and blocks without any mask are skipped
    alpha, _, _, ids = (part.numpy() for part in reference.project(splats.torch(dtype=torch.float64), camera))
    weight = reference.composite(torch.tensor(alpha))[0].numpy()
    m = mask.ravel()
    expected = {
        "values": weight @ (m[:, None] * values.reshape(-1, 3)),
        "weight": weight @ m,
        "alpha": alpha @ m,
        "peak": np.where(m > 0, weight, 0).max(1),
    }
    view = project(splats, camera)
    sums = view.backproject(values, mask)
    for name, reference_sums in expected.items():
        full = np.zeros((len(splats), *reference_sums.shape[1:]))
        full[view.gaussian_ids] = getattr(sums, name)
        np.testing.assert_allclose(full[ids], reference_sums, atol=1e-10, err_msg=name)
        full[ids] = 0
        assert not full.any(), name
    assert (sums.weight <= sums.alpha + 1e-12).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_heaviest_gaussian_is_the_references_in_the_drawn_tiles(dtype: type[np.floating]):
    camera = cameras(150, 110)[0]
    splats = with_odd_gaussians(scene(300, seed=4, dtype=dtype))
    alpha, _, _, ids = (part.numpy() for part in reference.project(splats.torch(dtype=torch.float64), camera))
    weight = reference.composite(torch.tensor(alpha))[0].numpy().reshape(len(ids), 110, 150)
    first, second = np.sort(weight, axis=0)[[-1, -2]]
    expected = np.where(first > 0, ids[weight.argmax(0)], -1)
    clear = (first > second + 1e-4) | (first == 0)  # the others are decided by the last bits
    for tiles in (np.ones(tile_shape(camera), bool), np.zeros(tile_shape(camera), bool)):
        if not tiles.any():
            tiles[2:4, 3:7] = True  # off the middle, on no diagonal
        drawn = pixels_of(tiles, 110, 150)
        heaviest = project(splats, camera, tiles=tiles).heaviest_gaussians()
        assert (heaviest[drawn & clear] == expected[drawn & clear]).all() and (
            drawn & clear & (expected >= 0)
        ).sum() > 500
        assert (heaviest[~drawn] == -1).all()


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_two_masks_in_one_walk_are_two_walks(share: float):
    splats, camera = with_odd_gaussians(scene(300, seed=4, dtype=np.float32)), cameras(150, 110)[0]
    rng, view = np.random.default_rng(1), project(splats, camera)
    mask, mask2 = rng.random((110, 150)) < share, np.zeros((110, 150), np.float32)
    mask2[20:60, 30:90] = rng.random((40, 60))  # tiles with one, with the other, with both and with none
    zeros, both = np.zeros((110, 150, 3), np.float32), view.mask_sums(mask, mask2)
    for one, sums in zip((mask, mask2), both, strict=True):
        expected = view.backproject(zeros, one.astype(np.float32))
        for name in ("weight", "alpha", "peak"):
            np.testing.assert_allclose(getattr(sums, name), getattr(expected, name), rtol=1e-6, atol=1e-7)
    assert both[1].peak.max() > 0.5


def test_two_masks_are_two_walks_where_most_is_hidden():
    """Behind the point where all pixels stop a walk of two masks counts alphas alone."""
    near, far = opaque_stack(40, np.float32), scene(400, 0, 7, dtype=np.float32)
    far.means[:, 2] += 3
    far.scales[:] *= 3
    splats, camera = near.append(far), cameras(70, 50)[0]
    view, rng = project(splats, camera), np.random.default_rng(3)
    masks = [(rng.random((50, 70)) < 0.7).astype(np.float32), np.ones((50, 70), np.float32)]
    masks[0][:, 40:] = 0
    hidden = []
    for mask, sums in zip(masks, view.mask_sums(*masks), strict=True):
        expected = view.backproject(np.zeros((50, 70, 3), np.float32), mask)  # which walks all the way
        for name in ("weight", "alpha", "peak"):
            np.testing.assert_array_equal(getattr(sums, name), getattr(expected, name), name)
        hidden.append(int(((sums.weight == 0) & (sums.alpha > 0)).sum()))
    assert min(hidden) > 30


def test_masks_that_change_in_some_tiles_are_walked_there_alone():
    splats, camera = with_odd_gaussians(scene(300, seed=4, dtype=np.float32)), cameras(150, 110)[0]
    rng, view = np.random.default_rng(1), project(splats, camera)
    masks = [rng.random((110, 150)) < share for share in (0.4, 0.9)]
    some = rng.random(view.tiles.shape) < 0.6
    here = pixels_of(some, 110, 150)
    sums = view.pair_mask_sums(masks[0] ^ here, masks[1] & ~here)
    view.sum_again(sums, masks[0], masks[1], some)
    for one, expected in zip(view.reduced_masks(sums), view.mask_sums(*masks), strict=True):
        for name in ("weight", "alpha", "peak"):
            np.testing.assert_array_equal(getattr(one, name), getattr(expected, name), name)
    before = sums.copy()
    view.sum_again(sums, masks[1], masks[0], np.zeros_like(some))
    np.testing.assert_array_equal(sums, before)


def test_a_hidden_gaussian_has_alpha_but_no_weight():
    splats, camera = opaque_stack(), cameras(32, 32)[0]
    view = project(splats, camera)
    sums = view.backproject(np.zeros((32, 32, 3)), np.ones((32, 32)))
    last = np.flatnonzero(view.gaussian_ids == len(splats) - 1)
    assert sums.weight[last] == 0 and sums.alpha[last] > 10


def test_a_local_frame_is_a_window_of_the_whole_view():
    splats, camera = with_odd_gaussians(scene(400, 1, 2, dtype=np.float32)), cameras(90, 70)[0]
    tiles = np.zeros(tile_shape(camera), bool)
    tiles[1:4, 2] = tiles[4, 5] = True
    full, local = project(splats, camera), project(splats, camera, tiles=tiles)
    inside = pixels_of(tiles, 70, 90)
    for all_of_it, window, outside in zip(full.rasterize(), local.rasterize(), (camera.background, 0, 0), strict=True):
        np.testing.assert_array_equal(window[inside], all_of_it[inside])
        assert (window[~inside] == np.asarray(outside, np.float32)).all()

    # Its Gaussians are those whose ellipses reach its tiles, in the same order.
    touching = np.zeros(len(splats), bool)
    for gaussian_id in full.gaussian_ids:
        only = np.zeros(len(splats), bool)
        only[gaussian_id] = True
        touching[gaussian_id] = (full.tiles_of(only) & tiles).any()
    np.testing.assert_array_equal(local.gaussian_ids, full.gaussian_ids[touching[full.gaussian_ids]])
    np.testing.assert_array_equal(np.sort(local.gaussian_ids), np.flatnonzero(touching))
    np.testing.assert_array_equal(local.projected, full.projected[touching[full.gaussian_ids]])

    keep = np.random.default_rng(0).uniform(size=len(splats)) < 0.5
    some = project(splats, camera, gaussian_mask=keep)
    np.testing.assert_array_equal(np.sort(some.gaussian_ids), np.sort(full.gaussian_ids[keep[full.gaussian_ids]]))
    np.testing.assert_array_equal(some.rasterize()[0], project(splats.take(keep), camera).rasterize()[0])


def test_tiles_of_covers_every_pixel_a_gaussian_draws():
    splats, camera = with_odd_gaussians(scene(60, 0, 3)), cameras(77, 61)[0]
    view = project(splats, camera)
    alpha, _, _, ids = (part.numpy() for part in reference.project(splats.torch(dtype=torch.float64), camera))
    loose = 0
    for gaussian_id, drawn in zip(ids, alpha.reshape(-1, 61, 77) > 0, strict=True):
        only = np.arange(len(splats)) == gaussian_id
        tiles = view.tiles_of(only)
        assert not drawn[~pixels_of(tiles, 61, 77)].any()
        loose += (tiles & ~tiles_of_mask(drawn)).sum()
    # Exact culling: an ellipse may graze a tile between pixel centres, and hardly more than that.
    assert loose < 0.15 * len(view.flatten_ids)


@pytest.mark.parametrize("share", [1.1, 0.4, 0.1])
def test_a_part_of_a_view_is_that_view_projected_anew(share: float):
    splats, camera = with_odd_gaussians(scene(300, seed=4, dtype=np.float32)), cameras(150, 110)[0]
    rng = np.random.default_rng(1)
    view, tiles = project(splats, camera), rng.random(tile_shape(camera)) < share
    some = rng.random(len(splats)) < 0.6
    for subset in (np.ones(len(splats), bool), some):
        part, anew = (
            view.part(tiles=tiles, gaussian_mask=subset),
            project(splats, camera, tiles=tiles, gaussian_mask=subset),
        )
        drawn = np.diff(anew.pair_offsets) > 0  # where all tiles are drawn some may touch none
        np.testing.assert_array_equal(part.gaussian_ids, anew.gaussian_ids[drawn])
        np.testing.assert_array_equal(part.projected, anew.projected[drawn])
        np.testing.assert_array_equal(part.gaussian_ids[part.flatten_ids], anew.gaussian_ids[anew.flatten_ids])
        for name in ("tiles", "pair_ids", "tile_ids", "isect_offsets"):
            np.testing.assert_array_equal(getattr(part, name), getattr(anew, name))
        for one, other in zip(part.rasterize(), anew.rasterize(), strict=True):
            np.testing.assert_array_equal(one, other)
        assert part.part() is part and part.part(tiles=tiles) is part


@pytest.mark.parametrize("share", [1.1, 0.4, 0.0])
def test_some_tiles_are_drawn_as_those_of_a_part(share: float):
    splats, camera = with_odd_gaussians(scene(300, seed=4, dtype=np.float32)), cameras(150, 110)[0]
    rng = np.random.default_rng(1)
    view = project(splats, camera, tiles=rng.random(tile_shape(camera)) < 0.8)
    tiles, colors = rng.random(tile_shape(camera)) < share, rng.random((len(view), 3)).astype(np.float32)
    part = view.part(tiles=tiles)
    for one, other in zip(view.rasterize(tiles=tiles), part.rasterize(), strict=True):
        np.testing.assert_array_equal(one, other)
    some = np.isin(view.gaussian_ids, part.gaussian_ids)
    for one, other in zip(view.rasterize(colors, tiles), part.rasterize(colors[some]), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("share", [1.1, 0.3])
def test_two_views_merged_are_that_of_both_projected_anew(share: float):
    splats, camera = with_odd_gaussians(scene(300, seed=6, dtype=np.float32)), cameras(150, 110)[0]
    splats = splats.take(np.concatenate([np.arange(len(splats)), np.arange(40)]))  # some at equal depths
    rng = np.random.default_rng(2)
    tiles, first = rng.random(tile_shape(camera)) < share, rng.random(len(splats)) < 0.5
    parts = [project(splats, camera, tiles=tiles, gaussian_mask=mask) for mask in (first, ~first)]
    merged, anew = parts[0].merged(parts[1]), project(splats, camera, tiles=tiles)
    assert min(map(len, parts)) > 20 and (np.diff(anew.depths) == 0).any()
    of_part = project(splats, camera).merged(parts[1], tiles=tiles, without=np.flatnonzero(~first))
    for name in ("tiles", "gaussian_ids", "projected", "pair_offsets", "flatten_ids", "pair_ids", "isect_offsets"):
        np.testing.assert_array_equal(getattr(merged, name), getattr(anew, name))
        if share < 1:  # where all tiles are drawn some of the Gaussians anew may touch none
            np.testing.assert_array_equal(getattr(of_part, name), getattr(anew, name))
    for one, other in zip(merged.rasterize(), anew.rasterize(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_touched_tiles_are_also_those_that_are_not_drawn():
    splats, camera = scene(200, seed=5, dtype=np.float32), cameras(150, 110)[0]
    tiles = np.zeros(tile_shape(camera), bool)
    tiles[0] = True
    part = project(splats, camera, tiles=tiles)
    chosen = np.arange(len(part)) % 3 == 0
    mask = np.zeros(len(splats), bool)
    mask[part.gaussian_ids[chosen]] = True
    touched = part.touched_tiles(chosen)
    np.testing.assert_array_equal(part.touched_tiles(np.flatnonzero(chosen)[::-1]), touched)
    np.testing.assert_array_equal(touched, project(splats, camera, gaussian_mask=mask).tiles_of(mask))
    assert (touched & ~tiles).any()


def test_entries_are_the_places_of_gaussians_in_a_view():
    splats, camera = scene(200, seed=5, dtype=np.float32), cameras(150, 110)[0]
    tiles = np.zeros(tile_shape(camera), bool)
    tiles[2:4] = True
    view = project(splats, camera, tiles=tiles)
    expected = [list(view.gaussian_ids).index(i) if i in view.gaussian_ids else -1 for i in range(len(splats))]
    np.testing.assert_array_equal(view.entries, expected)
    assert 0 < len(view) < len(splats)


def test_blocks_of_movable_gaussians_are_those_of_their_boxes():
    splats, camera = scene(150, seed=8, dtype=np.float32), cameras(150, 110)[0]
    view = project(splats, camera)
    pairs = np.arange(0, len(view.flatten_ids), 2)
    begins, boxes = np.searchsorted(pairs, view.isect_offsets), np.empty((len(pairs), 4), np.int64)
    lists = (view.projected, view.flatten_ids, view.tile_ids, view.tiles.shape[1], pairs, begins)
    run(kernels.find_block_boxes, *lists, boxes)
    tile = np.repeat(view.tile_ids, np.diff(view.isect_offsets))[pairs]
    entries, corners = view.flatten_ids[pairs], np.stack(np.divmod(tile, view.tiles.shape[1]), 1) * 16
    middle = view.means2d[entries][:, ::-1] - (corners + 0.5).astype(np.float32)
    reach = view.extents[entries][:, ::-1]
    low, high = (np.clip(edge, 0, 15).astype(int) // 4 for edge in (middle - reach, middle + reach))
    np.testing.assert_array_equal(boxes, np.stack([low[:, 0], high[:, 0] + 1, low[:, 1], high[:, 1] + 1], 1))
    assert len(np.unique(boxes, axis=0)) > 20


def test_what_a_frame_exposes():
    splats, camera = scene(30, 2, 4, dtype=np.float32), cameras(40, 30)[0]
    view = project(splats, camera)
    m, ids = len(view), view.gaussian_ids
    assert ids.dtype == np.int64 and view.means2d.shape == (m, 2) and view.conics.shape == (m, 3)
    local = splats.means[ids] @ camera.world_to_camera[:3, :3].T.astype(np.float32) + camera.world_to_camera[:3, 3]
    np.testing.assert_allclose(view.depths, local[:, 2], rtol=1e-5)
    assert (np.diff(view.depths) >= 0).all()
    np.testing.assert_allclose(view.means2d[:, 0], camera.fx * local[:, 0] / local[:, 2] + camera.cx, atol=1e-3)
    # The ellipse that is drawn is where alpha falls to 1/255: sigma at its rightmost point.
    a, b, c = view.conics.T.astype(np.float64)
    x = view.extents[:, 0].astype(np.float64)
    sigma = (a - b * b / c) * x * x / 2
    np.testing.assert_allclose(view.opacities * np.exp(-sigma), 1 / 255, rtol=5e-3)
    np.testing.assert_array_equal(view.colors, np.maximum(view.unclamped_colors, 0))
    assert (view.unclamped_colors < 0).any()
    with pytest.raises(ValueError, match="read-only"):
        view.projected[0, 0] = 1


def test_draw_with_other_colors():
    splats, camera = scene(80, 1, 5, dtype=np.float32), cameras(50, 40)[0]
    view = project(splats, camera)
    before = view.colors.copy()
    ones = np.ones((len(view), 3), np.float32)
    image, alpha, _ = view.rasterize(ones * [0.5, 1, -2])
    for channel, color in enumerate([0.5, 1, -2]):
        expected = color * alpha + (1 - alpha) * np.float32(camera.background[channel])
        np.testing.assert_allclose(image[..., channel], expected, atol=1e-5)
    np.testing.assert_array_equal(view.colors, before)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("profile", ["inria", "playcanvas"])
def test_given_colors_are_drawn_as_those_of_the_view_are(profile, dtype):
    splats, camera = scene(300, 1, 5, dtype=dtype), cameras(50, 40)[0]
    view = project(splats, camera)
    colors = np.random.default_rng(5).random((len(view), 3)).astype(dtype)
    drawn = []
    for drawable, given in ((view, colors), (dataclasses.replace(view, projected=view.with_colors(colors)), None)):
        image, (alpha, depth) = view.empty_picture(), np.zeros((2, camera.height, camera.width), dtype)
        drawn.append((image, alpha, depth, drawable.rasterize_into(image, alpha, depth, given, profile)))
    for one, other in zip(*drawn, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (drawn[0][0] != view.rasterize()[0]).any()
    assert (view.colors_of(np.arange(0, len(view), 3)) == view.colors[::3]).all()


def test_a_round_is_draw_subtract_accumulate():
    splats, camera = with_odd_gaussians(scene(300, 1, 6, dtype=np.float32)), cameras(83, 64)[0]
    rng = np.random.default_rng(1)
    target = rng.uniform(0, 1, (64, 83, 3)).astype(np.float32)
    mask = np.zeros((64, 83), np.float32)
    mask[20:40, 30:70] = rng.uniform(0, 1, (20, 40))
    view = project(splats, camera, tiles=tiles_of_mask(mask))
    colors = rng.uniform(-0.2, 1, (len(view), 3)).astype(np.float32)
    image, _, _ = view.rasterize(colors)
    sums, error = view.sirt_step(target, mask, colors)
    np.testing.assert_allclose(sums, view.backproject(target - image, mask).values, atol=1e-5)
    assert error == pytest.approx(float((mask[..., None] * (target - image) ** 2).sum()), rel=1e-5)
    assert view.sirt_step(image, mask, colors)[1] == pytest.approx(0, abs=1e-8)


@pytest.mark.parametrize(("weights", "groups"), [(1 << 18, 1 << 14), (0, 1 << 14), (160, 1 << 14), (1 << 18, 9)])
def test_a_step_gives_back_what_its_picture_lacks_whether_a_tiles_weights_are_kept_or_not(
    monkeypatch: pytest.MonkeyPatch, weights: int, groups: int
):
    monkeypatch.setattr(projected_view, "STEP_SIZES", StepSizes(tile_weights=weights, tile_groups=groups))
    splats, camera = with_odd_gaussians(scene(300, seed=4, dtype=np.float32)), cameras(150, 110)[0]
    rng, view = np.random.default_rng(1), project(splats, camera)
    target, mask = rng.random((110, 150, 3), np.float32), rng.random((110, 150), np.float32)
    mask[:40] = 0
    image = view.rasterize()[0]
    gain = view.sirt_step(target, mask)[0]
    np.testing.assert_array_equal(gain, view.backproject(target - image, mask).values)
    assert np.abs(gain).max() > 1


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_rounds_of_some_gaussians_are_rounds_of_the_picture(share: float, monkeypatch: pytest.MonkeyPatch):
    splats, camera = with_odd_gaussians(scene(600, 1, 8, dtype=np.float32)), cameras(83, 64)[0]
    rng = np.random.default_rng(2)
    target = rng.uniform(0, 1, (64, 83, 3)).astype(np.float32)
    mask = rng.uniform(0, 1, (64, 83)).astype(np.float32)
    mask[:, 30:50] = 0
    view = project(splats, camera, tiles=tiles_of_mask(mask))
    chosen = rng.uniform(size=len(view)) < share
    colors = view.colors.copy()
    colors[chosen] = rng.uniform(-0.2, 1, (int(chosen.sum()), 3))
    gain, weight = view.sirt_step(target, mask, colors)[0], view.backproject(target, mask).weight
    steps = sirt_steps(view, target, mask, chosen)
    assert isinstance(steps, sirt.CachedWeights)
    monkeypatch.setattr(sirt, "MAX_CACHED_BLOCKS", -1)
    for way in (steps, sirt_steps(view, target, mask, chosen)):
        np.testing.assert_allclose(way.residual(colors[chosen]), gain[chosen], atol=2e-5)
        np.testing.assert_allclose(way.weight, weight[chosen], atol=2e-5)
    assert isinstance(way, sirt.UncachedWeights)


def test_no_gaussian_lists_more_tiles_than_its_bounding_box():
    """Room for a Gaussian's tiles is made before they are listed: one more would be written into the next Gaussian's
    room. The outline of this Gaussian, found among millions, rounds to 304.00003 px and its box to 304, the edge of a
    tile."""
    splats = scene(3000, 0, 11, dtype=np.float32)
    row = {
        "means": [0.31944116950035095, -0.4232747256755829, -0.8478182554244995],
        "quats": [0.1521817147731781, 0.4232747256755829, 0.31944116950035095, 0.0],
        "scales": [0.0072451308369636536, 0.0032653689850121737, 0.0008028619340620935],
        "opacities": 0.5975682735443115,
    }
    for name, values in row.items():
        getattr(splats, name)[7] = values
    view = project(splats, cameras(512, 512)[0])
    assert 7 in view.gaussian_ids and len(view) > 2500
    low = np.clip((view.means2d - view.extents) / np.float32(16), 0, 32).astype(int)
    high = np.clip((view.means2d + view.extents) / np.float32(16) + np.float32(1), 0, 32).astype(int)
    assert (np.diff(view.pair_offsets) <= (high - low).prod(1)).all()
    # Every pair is listed once: `homes` is a permutation, and each tile's Gaussians ascend, front to back.
    np.testing.assert_array_equal(np.sort(view.pair_ids), np.arange(len(view.flatten_ids)))
    inside = np.ones(len(view.flatten_ids), bool)
    inside[view.isect_offsets[:-1][np.diff(view.isect_offsets) > 0]] = False
    assert (np.diff(view.flatten_ids)[inside[1:]] > 0).all()


def everything(splats, camera):
    """Every output of every kernel, as one list of arrays."""
    view = project(splats, camera)
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (camera.height, camera.width, 3)).astype(np.float32)
    mask = rng.uniform(0, 1, (camera.height, camera.width)).astype(np.float32)
    sums, error = view.sirt_step(values, mask)
    drawn = render_views(splats, [camera], contributions=True, keep_views=True)
    back = render_views_backward(splats, drawn, values[None], mask[None, ..., None], mask[None, ..., None])
    total = view.backproject(values, mask)
    chosen = np.arange(len(view)) % 3 > 0
    steps = sirt_steps(view, values, mask, chosen)
    total_of_some = [steps.weight, steps.residual(view.colors[chosen])]
    return [
        *total_of_some,
        view.gaussian_ids,
        view.flatten_ids,
        *view.rasterize(),
        *vars(total).values(),
        *(values for one in view.mask_sums(mask > 0.5, mask) for values in vars(one).values()),
        sums,
        np.array(error),
        *back,
    ]


def test_bits_do_not_depend_on_threads(monkeypatch):
    splats, camera = with_odd_gaussians(scene(5000, 2, 7, dtype=np.float32)), cameras(130, 100)[0]
    results = []
    for count in ("1", "2", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", count)
        results.append(everything(splats, camera))
    for other_run in results[1:]:
        for one, other in zip(results[0], other_run, strict=True):
            np.testing.assert_array_equal(one, other)


def test_bits_do_not_depend_on_how_views_are_shared_out(monkeypatch):
    """Few views are drawn one after the other on all threads, many on one thread each."""
    splats, views = with_odd_gaussians(scene(500, 1, 10, dtype=np.float32)), cameras(40, 50, count=6)
    results = []
    for count in ("1", "2", "4"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", count)
        drawn = render_views(splats, views, contributions=True, keep_views=True)
        back = render_views_backward(splats, drawn, drawn.colors, drawn.depths, drawn.alphas)
        results.append([drawn.colors, drawn.alphas, drawn.depths, drawn.contributions, *back])
    for other_run in results[1:]:
        for one, other in zip(results[0], other_run, strict=True):
            np.testing.assert_array_equal(one, other)


def test_two_python_threads_at_once():
    splats, camera = scene(2000, 1, 8, dtype=np.float32), cameras(100, 100)[0]
    expected = everything(splats, camera)
    results: list[list] = []

    def work():
        for _ in range(10):
            results.append(everything(splats, camera))

    workers = [threading.Thread(target=work) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(results) == 30
    for result in results:
        for one, other in zip(expected, result, strict=True):
            np.testing.assert_array_equal(one, other)


def test_readonly_and_strided_gaussians_draw_the_same():
    splats, camera = scene(50, 1, 9, dtype=np.float32), cameras(30, 30)[0]
    expected = sp.render(splats, camera).colors
    packed = np.concatenate([splats.means, splats.scales], 1)  # [N, 6]: columns of a file
    packed.flags.writeable = False
    sh = np.asfortranarray(splats.sh)
    strided = sp.Splats(packed[:, :3], splats.quats, packed[:, 3:], splats.opacities[::-1][::-1], sh)
    np.testing.assert_array_equal(sp.render(strided, camera).colors, expected)


@pytest.mark.parametrize("count", [0, 1, 5, 700])
@pytest.mark.parametrize("threads", ["1", "2", "3", "7"])
def test_depths_are_sorted_stably_by_any_number_of_threads(count: int, threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    rng, size = np.random.default_rng(count), GAUSSIANS_PER_BLOCK
    blocks = -(-count // 100)
    counts = np.minimum(100, count - 100 * np.arange(blocks)).astype(np.int32)
    slots = np.concatenate([np.arange(0), *(np.arange(c) + b * size for b, c in enumerate(counts))])
    # Of few bits and of many, of few values, of one.
    wide = np.exp(rng.uniform(-70, 70, blocks * size))
    few = rng.integers(1, 4, blocks * size)
    for depths in (rng.uniform(2, 3, blocks * size), wide, few, np.full(blocks * size, 0.2)):
        keys = depths.astype(np.float32)
        expected = slots[np.argsort(keys[slots], kind="stable")]
        tile_counts = rng.integers(0, 9, blocks * size).astype(np.int32)
        order, share_tiles = _depth_order(keys, counts, tile_counts)
        assert np.array_equal(order, expected)
        shares = [expected[count * k // int(threads) : count * (k + 1) // int(threads)] for k in range(int(threads))]
        assert share_tiles.tolist() == [int(tile_counts[share].sum()) for share in shares]


def test_tiles_of_a_mask_are_those_with_any_pixel():
    for shape in ((16, 16), (33, 50), (1, 200)):
        mask = np.random.default_rng(shape[1]).random(shape) < 0.01
        tiles = {(y // 16, x // 16) for y, x in np.argwhere(mask)}
        result = tiles_of_mask(mask)
        assert set(map(tuple, np.argwhere(result))) == tiles and np.array_equal(result, tiles_of_mask(mask * 0.5))


def test_tiles_drawn_anew_leave_the_others():
    splats = scene(60, seed=3)
    camera = look_at([0, 0, 4], [0, 0, 0], width=70, height=50, background=(0.2, 0.4, 0.6))
    view, tiles = project(splats, camera), np.random.default_rng(2).random((4, 5)) < 0.5
    drawn, marked = view.rasterize(), [np.full_like(picture, 7) for picture in view.rasterize()]
    view.redraw(tiles, *marked)
    pixels = tiles.repeat(16, 0).repeat(16, 1)[:50, :70]
    for picture, full in zip(marked, drawn, strict=True):
        assert np.array_equal(picture[pixels], full[pixels]) and (picture[~pixels] == 7).all()
    part = view.rasterize(tiles=tiles)[0]
    assert np.array_equal(part[pixels], drawn[0][pixels])
    assert (part[~pixels] == np.array(camera.background, part.dtype)).all()


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_pairs_of_chosen_entries_are_those_of_plain_lists(share: float) -> None:
    view = project(scene(400, seed=12, dtype=np.float32), cameras(150, 110)[0])
    chosen = np.random.default_rng(13).random(len(view)) < share
    pairs, begins, entries, pair_ids, pair_offsets = pairs_of(view, chosen)
    expected = np.flatnonzero(chosen[view.flatten_ids])
    np.testing.assert_array_equal(pairs, expected)
    np.testing.assert_array_equal(begins, np.searchsorted(expected, view.isect_offsets))
    numbers = (np.cumsum(chosen) - 1)[view.flatten_ids[expected]]
    np.testing.assert_array_equal(entries, numbers)
    # In the order of the entries, and of the tiles' lists within each.
    np.testing.assert_array_equal(np.argsort(numbers, kind="stable")[pair_ids], np.arange(len(pairs)))
    counts = np.bincount(numbers, minlength=int(chosen.sum()))
    np.testing.assert_array_equal(pair_offsets, np.append(0, np.cumsum(counts)))


def test_the_first_residual_comes_with_the_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, camera = scene(200, seed=9, dtype=np.float32), cameras(150, 110)[0]
    view, rng = project(splats, camera), np.random.default_rng(14)
    target, mask = rng.random((110, 150, 3)).astype(np.float32), np.ones((110, 150), np.float32)
    chosen = rng.random(len(view)) < 0.4
    first, second = rng.random((2, int(chosen.sum()), 3)).astype(np.float32)
    steps, begun = sirt_steps(view, target, mask, chosen), sirt_steps(view, target, mask, chosen, first)
    np.testing.assert_array_equal(begun.weight, steps.weight)
    for colors in (first, second, first.copy()):
        np.testing.assert_array_equal(begun.residual(colors), steps.residual(colors))
    assert np.abs(begun.residual(first)).max() > 0.1
    monkeypatch.setattr(sirt, "_step_sums", None)
    begun.residual(first)
    with pytest.raises(TypeError):
        begun.residual(second)
