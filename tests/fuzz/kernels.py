"""Extreme values for every kernel, each index checked: in a process that runs another build of the native library,
compiled from the sources as they are (`native/build.py --checked`), or one with sanitizers.

    python tests/fuzz/kernels.py --seconds 600 --seed 0            all kernels, float32 and float64
    python tests/fuzz/kernels.py --count 1 --seed 1234             one input again
    python tests/fuzz/kernels.py --sanitize address,undefined      with g++ or clang++

An input is a pure function of its seed. It fails where a kernel computes an index that is out of bounds, where a
RuntimeWarning or anything but a ValueError of one line comes out, and where a row out of its range changes a picture.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
EXTREMES = (0.0, -0.0, 1e-45, 1e-38, 1e-20, 1e-15, 1e-3, 1.0, 1.0000001, 2.0, 255.0, 1e5, 1e9, 1e12, 1e15, 1.1e15, 1e18)
EXTREMES += (1e19, 1e30, 3.4e38, np.inf, np.nan)
EXTREMES += tuple(-value for value in EXTREMES)
STARTED = "inside"
CHECKED = Path(__file__).with_name("__pycache__") / "checked_kernels"
CURRENT = "current_input.txt"
"""In that folder: the input that runs, for when it ends the process."""


def extreme(rng: np.random.Generator, values: np.ndarray, share: float) -> np.ndarray:
    """The same with about `share` of the values replaced by extremes, and sometimes whole rows of them."""
    out = np.array(values)
    hit = rng.random(out.shape) < share
    if rng.random() < 0.3:
        hit |= (rng.random(len(out)) < share).reshape(-1, *[1] * (out.ndim - 1))
    with np.errstate(over="ignore"):
        out[hit] = rng.choice(EXTREMES, int(hit.sum())).astype(out.dtype)
    return out


def rows(rng: np.random.Generator, dtype: type, share: float):
    """Rows around the origin, some of their values extreme."""
    from splatpainter.splats import Splats

    n, bands = int(rng.integers(1, 40)), int(rng.choice([1, 4, 9, 16, 25]))
    values = {
        "means": rng.normal(0, 0.6, (n, 3)) * rng.choice([1, 1, 1e3, 1e9, 1e15]),
        "quats": rng.normal(0, 1, (n, 4)),
        "scales": np.exp(rng.normal(-2, 2, (n, 3))) * rng.choice([1, 1, 1e-6, 1e4, 1e12]),
        "opacities": rng.uniform(0, 1, n),
        "sh": rng.normal(0, 0.4, (n, bands, 3)),
    }
    fields: dict[str, Any] = {name: extreme(rng, value.astype(dtype), share) for name, value in values.items()}
    return Splats(**fields, antialiased=bool(rng.random() < 0.3))


def view(rng: np.random.Generator):
    """A camera near the origin or far from it, of any lens."""
    from splatpainter.cameras import look_at

    width, height = (int(size) for size in rng.integers(1, 70, 2))
    eye = rng.normal(0, 1, 3) * rng.choice([1e-6, 1, 3, 3, 3, 1e3, 1e15, 1e30])
    if not np.linalg.norm(eye) > 0:
        eye = np.array([0.0, 0, 3])
    camera = look_at(eye, [0, 0, 0], width=width, height=height, fov=float(rng.choice([1, 50, 50, 170])))
    if rng.random() < 0.3:
        from dataclasses import replace

        lens = rng.choice([1e-30, 1e-3, 1, 100, 1e6, 1e30, 1e300], 2)
        middle = rng.choice([-1e30, -1e6, 0, 10, 1e9, 1e300], 2)
        camera = replace(camera, fx=float(lens[0]), fy=float(lens[1]), cx=float(middle[0]), cy=float(middle[1]))
    return camera


def drawing(rng: np.random.Generator, dtype: type) -> None:
    """render, forward and backward, in both profiles."""
    from splatpainter.rendering.cpu.views import render_views, render_views_backward

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1, 0.5])), view(rng)
    profile = "playcanvas" if rng.random() < 0.3 else "inria"
    drawn = render_views(splats, [camera], True, keep_views=profile == "inria", profile=profile)
    valid = splats.take(splats.drawable)
    again = render_views(valid, [camera], True, keep_views=False, profile=profile)
    for name in ("colors", "alphas", "depths"):
        assert np.isfinite(getattr(drawn, name)).all(), f"{name}: a value that is not finite"
        assert getattr(drawn, name).tobytes() == getattr(again, name).tobytes(), f"{name}: rows out of range were drawn"
    assert drawn.contributions is not None and not drawn.contributions[:, ~splats.drawable].any()
    if profile == "inria":
        slopes = [extreme(rng, np.ones_like(a), 0.05) for a in (drawn.colors, drawn.alphas, drawn.depths)]
        render_views_backward(splats, drawn, *slopes)


def forward(rng: np.random.Generator, dtype: type) -> None:
    """Projection, binning and drawing alone: what compiles in little time."""
    from splatpainter.rendering.cpu.projected_view import project

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1, 0.5])), view(rng)
    frame = project(splats, camera)
    assert splats.drawable[frame.gaussian_ids].all(), "rows out of range were drawn"
    assert all(np.isfinite(picture).all() for picture in frame.rasterize()), "a value that is not finite"


def windows(rng: np.random.Generator, dtype: type) -> None:
    """A few tiles of so many Gaussians that those near them are looked for first: none is missed."""
    from splatpainter.rendering.cpu.projected_view import MIN_PRESELECTED, project, tile_shape

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1])), view(rng)
    splats = splats.take(rng.integers(0, len(splats), MIN_PRESELECTED))
    tiles = rng.random(tile_shape(camera)) < 0.2
    frame = project(splats, camera, tiles=tiles)
    every = project(splats, camera, gaussian_mask=np.ones(len(splats), bool), tiles=tiles)
    assert np.array_equal(frame.gaussian_ids, every.gaussian_ids), "a Gaussian that the tiles show was left out"


def frames(rng: np.random.Generator, dtype: type) -> None:
    """What the lifts call on a frame."""
    from splatpainter.lift.depth_normals import surface
    from splatpainter.lift.masks import box_mean
    from splatpainter.rendering.cpu.projected_view import project, tile_shape
    from splatpainter.rendering.cpu.sirt import CachedWeights

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1])), view(rng)
    shape = (camera.height, camera.width)
    tiles = rng.random(tile_shape(camera)) < 0.7 if rng.random() < 0.5 else None
    keep = rng.random(len(splats)) < 0.8 if rng.random() < 0.5 else None
    frame = project(splats, camera, gaussian_mask=keep, tiles=tiles)
    m, p = len(frame), len(frame.flatten_ids)
    # Some operations index past the checks: what they are given must be sound.
    assert frame.isect_offsets[-1] == frame.pair_offsets[-1] == p and (np.diff(frame.isect_offsets) >= 0).all()
    assert np.array_equal(np.sort(frame.pair_ids), np.arange(p))
    assert p == 0 or (0 <= frame.flatten_ids.min() and frame.flatten_ids.max() < m)
    target = extreme(rng, rng.random((*shape, 3)).astype(dtype), rng.choice([0, 0.1]))
    mask = extreme(rng, rng.random(shape).astype(dtype), rng.choice([0, 0.1]))
    with np.errstate(all="ignore"):
        box_mean(target, int(rng.integers(0, 40)))
        box_mean(mask > 0.5, int(rng.integers(0, 9)))
    frame.rasterize(extreme(rng, frame.colors, 0.1))
    frame.backproject(target, mask)
    ids = frame.heaviest_gaussians(rng.choice(["inria", "playcanvas"]))
    assert ids.min() >= -1 and ids.max() < len(splats)
    frame.sirt_step(target, mask)
    chosen = rng.random(m) < 0.5
    cached = CachedWeights.of(frame, target, mask, chosen)
    if cached is not None:
        cached.residual(extreme(rng, frame.colors[chosen], 0.1))
    surface(frame, rng.random(shape) < 0.7)


def cubes(rng: np.random.Generator, dtype: type) -> None:
    """Voxels, footprints and rays."""
    from splatpainter.voxels import grid as voxels
    from splatpainter.voxels import raycast

    splats, camera = rows(rng, np.float32, rng.choice([0, 0.01, 0.1])), view(rng)
    if not splats.drawable.any():
        return
    grid = voxels.voxelize(splats, int(rng.integers(1, 17)))
    origin = extreme(rng, camera.position, 0.1)
    rays = extreme(rng, rng.normal(0, 1, (50, 3)).astype(np.float32), 0.1)
    keys, _ = raycast.first_hits(grid.occupancy, grid, origin, rays)
    assert keys.min() >= -1 and keys.max() < grid.occupancy.size
    raycast.seen_voxels(grid, origin, rays)
    raycast.inside(grid, grid.occupancy, camera.position)
    mask = rng.random((camera.height, camera.width)) < 0.3
    raycast.editable_gaussians(grid, splats, camera, mask, reach=int(rng.integers(0, 3)))


def shadows(rng: np.random.Generator, dtype: type) -> None:
    """Shadow maps."""
    from splatpainter import lighting as visibility

    count = int(rng.integers(1, 60))
    points = rng.normal(0, 1, (count, 3)) * rng.choice([1e-30, 1e-6, 1, 1e9, 1e15])
    points += rng.normal(0, 1, 3) * rng.choice([0, 1, 1e6, 1e15])
    normals = rng.normal(0, 1, (count, 3)).astype(np.float32)
    normals = extreme(rng, normals / np.linalg.norm(normals, axis=1, keepdims=True), rng.choice([0, 0, 0.1]))
    with np.errstate(all="ignore"):  # spherical harmonics of what is no unit vector
        visibility.prt_transfer(points.astype(np.float32), normals)
    visibility.visibility(points.astype(np.float32), normals, float(rng.choice([1e-30, 1e-3, 1, 1e9])), directions=8)


def fitting(rng: np.random.Generator, dtype: type) -> None:
    """What a fit calls beside the renderer."""
    import torch

    from splatpainter.fit.image_loss import picture_loss
    from splatpainter.fit.parameters import Adam
    from splatpainter.fit.start import mean_neighbour_squares

    points = rng.normal(0, 1, (int(rng.integers(0, 80)), 3)) * rng.choice([1e-30, 1, 1, 1e9, 1e15])
    mean_neighbour_squares(extreme(rng, points.astype(np.float32), rng.choice([0, 0.05])), int(rng.integers(1, 6)))
    shape = tuple(int(size) for size in rng.integers(11, 30, 2))
    image, target = (extreme(rng, rng.random((*shape, 3)).astype(np.float32), rng.choice([0, 0.1])) for _ in range(2))
    weights = np.abs(extreme(rng, rng.random(shape).astype(np.float32), 0.1))
    picture_loss(image, target, np.nan_to_num(weights), float(rng.choice([0, 0.2])))
    value = torch.from_numpy(extreme(rng, rng.random((7, 3)).astype(np.float32), 0.1))
    slope = torch.from_numpy(extreme(rng, rng.random((7, 3)).astype(np.float32), 0.1))
    Adam({"means": value}).step({"means": value}, {"means": slope}, {"means": torch.ones(1)})
    arrays, gradients = {"means": value.numpy().copy()}, {"means": slope.numpy()}
    Adam(arrays).step(arrays, gradients, {"means": np.ones(3, np.float32)})


def lifting(rng: np.random.Generator, dtype: type) -> None:
    """A local lift: untouched rows stay, whatever they hold."""
    from splatpainter.lift.local.local_edit import lift_local
    from splatpainter.rendering.cpu.projected_view import project

    splats, camera = rows(rng, np.float32, rng.choice([0, 0.01, 0.05])), view(rng)
    shape = (camera.height, camera.width)
    target = np.clip(project(splats, camera).rasterize()[0] + rng.random(3).astype(np.float32), 0, 1)
    lift_local(splats, camera, target, rng.random(shape) < 0.3)


def shell(rng: np.random.Generator, count: int, share: float):
    """Flat Gaussians on a sphere, some values extreme."""
    from splatpainter.splats import Splats

    where = rng.normal(size=(count, 3))
    where /= np.linalg.norm(where, axis=1, keepdims=True)
    quats = np.concatenate([1 + where[:, 2:], -where[:, 1:2], where[:, :1], np.zeros((count, 1))], 1)  # z to outside
    scales = np.tile([1.6 / np.sqrt(count), 1.6 / np.sqrt(count), 1e-3], (count, 1)) * np.exp(rng.normal(0, 0.2))
    sh = rng.normal(0, 0.3, (count, int(rng.choice([1, 4])), 3))
    values = (where, quats, scales, rng.uniform(0.5, 1, count), sh)
    return Splats(*(extreme(rng, value.astype(np.float32), share) for value in values))  # pyright: ignore[reportArgumentType]


def painting(rng: np.random.Generator, dtype: type) -> None:
    """Whole edits of a surface in each mode: sheets, splits, spreading, receipts. Untouched rows stay."""
    from splatpainter.cameras import look_at
    from splatpainter.painter import Asset, Edit, EditSettings, Painter
    from splatpainter.rendering import render

    splats = shell(rng, int(rng.integers(30, 400)), rng.choice([0, 0.002, 0.02]))
    eye = rng.normal(size=3)
    eye *= rng.uniform(1.5, 4) / np.linalg.norm(eye)
    camera = look_at(eye, [0, 0, 0], width=int(rng.integers(16, 80)), height=int(rng.integers(16, 80)), fov=50)
    picture = np.clip(render(splats, camera).colors[0], 0, 1)
    x, y = (int(rng.integers(0, size - 4)) for size in (camera.width, camera.height))
    mask = np.zeros(picture.shape[:2], bool)
    mask[y : y + int(rng.integers(3, 40)), x : x + int(rng.integers(3, 40))] = True
    mode = str(rng.choice(["local", "local", "global", "spread"]))
    picture[mask] = np.clip(picture[mask] * rng.random(3) + rng.random(3) * 0.5, 0, 1)
    edit = Edit(picture.astype(np.float32), camera, None if mode == "global" else mask)
    edits = [edit]
    if rng.random() < 0.3:  # colours that two pictures agree on
        other = look_at(eye + rng.normal(0, 0.4, 3), [0, 0, 0], width=40, height=40, fov=50)
        edits.append(Edit(np.full((40, 40, 3), rng.random(), np.float32), other, rng.random((40, 40)) < 0.3))
    edited = Painter(settings=EditSettings(aside=bool(rng.random() < 0.3))).apply(Asset(splats), edits, mode)  # pyright: ignore[reportArgumentType]
    assert edited.receipt is not None
    assert edited.receipt.untouched_sha256_before == edited.receipt.untouched_sha256_after


def together(rng: np.random.Generator, dtype: type) -> None:
    """Pictures that were edited all over, lifted together with views from around."""
    from splatpainter.cameras import look_at
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.local.wide_edit import lift_wide
    from splatpainter.lift.options import LocalOptions
    from splatpainter.rendering import render

    splats = shell(rng, int(rng.integers(20, 120)), rng.choice([0, 0.002, 0.02]))
    eye, views = rng.normal(size=3), []
    eye *= rng.uniform(1.5, 4) / np.linalg.norm(eye)
    for _ in range(int(rng.integers(1, 4))):
        width, height = (int(size) for size in rng.integers(16, 48, 2))
        camera = look_at(eye + rng.normal(0, 0.5, 3), [0, 0, 0], width=width, height=height, fov=50)
        drawn = render(splats, camera)
        before = np.clip(drawn.colors[0], 0, 1)
        edited = np.clip(before * rng.random(3) + rng.random(3) * 0.5, 0, 1).astype(np.float32)
        views.append(EditView(camera, edited, rng.random((height, width)) < rng.choice([0.1, 0.9]), before))
    lifted = lift_wide(splats, views, LocalOptions(rounds=int(rng.integers(1, 6))))
    assert np.isfinite(lifted.splats.sh[lifted.touched]).all()


def rounds(rng: np.random.Generator, dtype: type) -> None:
    """Rounds in the colours of all Gaussians, and a view in other colours."""
    from dataclasses import replace

    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run
    from splatpainter.rendering.cpu.geometry import STEP_SIZES
    from splatpainter.rendering.cpu.projected_view import project

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1])), view(rng)
    frame, n = project(splats, camera), len(splats)
    projected = extreme(rng, frame.projected, rng.choice([0, 0.1]))
    sums = extreme(rng, rng.normal(size=(len(frame.flatten_ids), STEP_SIZES.sums)).astype(dtype), 0.1)
    weight = np.abs(extreme(rng, rng.random(n).astype(dtype), 0.2))
    gain, of_entries = np.zeros((n, 3), dtype), np.zeros((len(frame), 3), dtype)
    run(kernels.add_gains, frame.pair_offsets, sums, frame.gaussian_ids, weight, gain)
    run(kernels.add_gains, frame.pair_offsets, sums, None, None, of_entries)
    unseen = np.ones(n, bool)
    unseen[frame.gaussian_ids] = False
    assert not gain[unseen | ~(weight > 0)].any(), "a Gaussian gained that no pixel asks for"
    change = extreme(rng, rng.normal(size=(n, 3)).astype(np.float32), 0.2)
    if dtype == np.float32:
        run(kernels.set_changed_colors, frame.gaussian_ids, change, float(rng.choice([0, 1.3, 1e30])), projected)
        run(kernels.step_changes, gain, weight, abs(float(rng.choice(EXTREMES))), 1.3, change)
        assert not gain.any(), "gains are taken once"
        assert (np.abs(change[~np.isnan(change)]) <= np.float32(1.3)).all(), "a change beyond its limit"
    shaded = frame.recolored(replace(splats, sh=extreme(rng, splats.sh, rng.choice([0, 0.1, 0.5]))))
    assert shaded is None or np.isfinite(shaded.colors).all()
    same = frame.recolored(splats)
    assert same is not None and same.projected.tobytes() == frame.projected.tobytes()


def samples(rng: np.random.Generator, dtype: type) -> None:
    """Gaussians as patches of a surface, as features of a regression, and products of these."""
    from splatpainter.kernels import portable
    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run
    from splatpainter.lift.global_edit import regression_features

    splats = rows(rng, np.float32, rng.choice([0, 0.1, 0.5])).numpy()
    n = len(splats)
    ids = rng.integers(0, n, int(rng.integers(0, 60)))
    patches = np.empty((len(ids), 16), np.float32)
    run(kernels.fill_patches, ids, splats.means, splats.quats, splats.scales, splats.opacities, patches)
    assert np.array_equal(patches[:, :3], splats.means[ids], equal_nan=True)
    normals = extreme(rng, rng.normal(size=(n, 3)).astype(np.float32), rng.choice([0, 0.2]))
    features = regression_features(extreme(rng, rng.random((n, 3)).astype(np.float32), 0.1), normals)
    columns = int(rng.choice([1, 3, 4, 7, 16, 17, 33]))
    solution = extreme(rng, rng.normal(size=(36, columns)), rng.choice([0, 0.05]))
    portable.matmul(features, solution)
    turned, leverage = np.array(splats.sh), np.empty(n, np.float32)
    run(kernels.turn_bands, features, extreme(rng, rng.normal(size=(9, 9)).astype(np.float32), 0.05), turned)
    square = extreme(rng, rng.normal(size=(36, 36)).astype(np.float32), rng.choice([0, 0.05]))
    run(kernels.measure_leverage, features, square, leverage)
    assert np.array_equal(turned[:, 0], splats.sh[:, 0], equal_nan=True), "the constant band turned"
    stacks, inner = (1, n) if rng.random() < 0.5 else (n, 1), int(rng.integers(1, 20))
    first, second = (rng.normal(size=(count, inner, inner)) for count in stacks)
    portable.matmul(extreme(rng, first, 0.05).astype(np.float32), extreme(rng, second, 0.05))


def grades(rng: np.random.Generator, dtype: type) -> None:
    """Bands after a function of colours, the curve of sRGB, and colours as a page's textures hold them."""
    from splatpainter.grading.color_grading import JACOBIAN_STEP, MAX_JACOBIAN_ENTRY, grade_sh
    from splatpainter.kernels import portable
    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run
    from splatpainter.splats import SH_C0

    sh = rows(rng, np.float32, rng.choice([0, 0.1, 0.5])).sh
    ends, out = np.empty((2, len(sh), 3), np.float32), np.empty_like(sh)
    run(kernels.take_base_colors, sh, SH_C0, JACOBIAN_STEP, ends)
    assert (ends >= 0).all() and (ends <= 1).all()
    graded = extreme(rng, rng.random((4, len(sh), 3)).astype(np.float32), rng.choice([0, 0.1]))
    run(kernels.grade_bands, sh, ends[0], graded, SH_C0, JACOBIAN_STEP, MAX_JACOBIAN_ENTRY, out)
    sliders = ("exposure", "temperature", "contrast", "saturation")
    settings = {name: float(rng.uniform(-1, 1)) for name in sliders if rng.random() < 0.5}
    grade_sh(sh, {**settings, "space": str(rng.choice(["srgb", "linear"]))})
    run(kernels.pack_base_colors, sh, SH_C0, np.empty((len(sh), 3), np.uint16))
    run(kernels.pack_harmonic_codes, sh, np.empty((len(sh), sh.shape[1] - 1), np.uint32))
    portable.srgb(extreme(rng, rng.random(50).astype(dtype), 0.3), bool(rng.random() < 0.5))


def sights(rng: np.random.Generator, dtype: type) -> None:
    """What a view sees of a surface: its lattice, depths along its lines, agreement; nearest pixels, differences."""
    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run
    from splatpainter.lift.masks import contrast, largest_difference
    from splatpainter.lift.nearest import nearest_pixels
    from splatpainter.surface.visible import depths_along

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1, 0.5])), view(rng)
    ids = rng.integers(0, len(splats), int(rng.integers(0, 70)))
    lines = extreme(rng, rng.normal(size=(len(ids), 3)), rng.choice([0, 0.1]))
    depths_along(splats.numpy() if dtype == np.float32 else splats, ids, camera, lines)
    height, width, step = (int(size) for size in rng.integers(1, [70, 70, 6]))
    entry = np.where(rng.random((height, width)) < rng.random(), rng.integers(0, 9, (height, width)), -1)
    order, chosen = rng.permutation(step * step), np.empty((-(-height // step), -(-width // step)), np.int32)
    run(kernels.choose_lattice_pixels, entry.astype(np.int32), order, step, chosen)
    index = np.full(chosen.shape, -1, np.int32)
    count = int((chosen >= 0).sum())
    index[chosen >= 0] = rng.permutation(count)
    points, normals = (extreme(rng, rng.normal(size=(count, 3)), rng.choice([0, 0.1])) for _ in range(2))
    windows, agreeing = extreme(rng, rng.random(count), 0.1), np.full(count, -1)
    run(kernels.count_agreeing, index, points, normals, windows, rng.random(count) < 0.7, 0.6, agreeing)
    assert count == 0 or 0 <= agreeing.min() <= agreeing.max() <= 8
    mask = rng.random((height, width)) < rng.choice([0, 0.01, 0.5, 1])
    sheet(rng, splats, mask)
    nearest = nearest_pixels(mask)
    assert (mask.ravel()[nearest] if mask.any() else nearest == -1).all(), "a pixel that is not set is the nearest"
    one, other = (extreme(rng, rng.random((height, width, 3)).astype(dtype), 0.1) for _ in range(2))
    with np.errstate(all="ignore"):
        largest_difference(one, other)
        contrast(other)


def sheet(rng: np.random.Generator, splats, mask: np.ndarray) -> None:
    """Cells of a mask, Gaussians in them, and which of these hang past the horizon of some splats."""
    from splatpainter.kernels.library import kernels
    from splatpainter.kernels.parallel import run

    colors = extreme(rng, (rng.random((*mask.shape, 3)) * rng.choice([0.01, 1])).astype(np.float32), 0.01)
    depth, edges = extreme(rng, np.ones(mask.shape), rng.choice([0, 0.01])), np.zeros(mask.shape, np.uint8)
    run(kernels.choose_cells, colors, mask, depth, 0.03, 0.08, float(rng.choice(EXTREMES)), edges)
    assert int((edges.astype(np.int64) ** 2).sum()) == mask.sum(), "a pixel in two cells, or in none"
    count = int(rng.integers(0, 50))
    rays, normals, layout = (extreme(rng, rng.normal(size=(count, columns)), 0.1) for columns in (3, 3, 5))
    lens, out = (extreme(rng, np.eye(4), 0.05), float(rng.choice(EXTREMES))), [np.empty((count, n)) for n in (3, 4, 3)]
    run(kernels.lay_gaussians, rays, extreme(rng, rng.random(count), 0.1), normals, layout, *lens, 0.1, *out)
    arrays = [np.ascontiguousarray(values, np.float64) for values in (splats.means, splats.quats, splats.scales)]
    hosts, heaviest = rng.integers(0, len(splats), count), rng.integers(-1, len(splats), mask.shape)
    pixels = extreme(rng, rng.uniform(-2, 80, (count, 2)), 0.1)
    limits, past = (float(rng.choice(EXTREMES)), 2.5, 0.3, 2), np.empty(count, bool)
    run(kernels.mark_past_horizon, *arrays, *out[:2], hosts, pixels, heaviest, rng.normal(size=3), *limits, past)


def stickers(rng: np.random.Generator, dtype: type) -> None:
    """The surface unwrapped around a point, and how much it bends."""
    from splatpainter.session.measures.curvature import bend_degrees
    from splatpainter.surface.estimate import Surface
    from splatpainter.surface.unwrap import smoothed, thinned, unwrap

    splats = shell(rng, int(rng.integers(20, 300)), rng.choice([0, 0.01, 0.1]))
    bend_degrees(splats)
    surface = Surface.of(splats)
    queries = extreme(rng, rng.normal(size=(40, 3)) * rng.choice([0.01, 1]), 0.1)  # of one place, or of many
    directions = rng.normal(size=queries.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface.at(queries, directions, np.abs(extreme(rng, rng.random(len(queries)), 0.1)))
    points = rng.normal(size=(int(rng.integers(1, 200)), 3)) * rng.choice([1e-6, 1, 1, 1e6])
    normals = rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spacing = float(rng.choice([1e-9, 0.05, 0.3, 1e3])) * np.abs(points).max()
    ids = thinned(points, normals, spacing)
    points, normals = smoothed((points, normals), (points[ids], normals[ids]), 3 * spacing)
    half = (float(rng.choice([0.1, 1, 1e6])) * spacing, 3 * spacing)
    unwrap(points, normals, rng.normal(size=3), spacing, half).at(queries, np.tile(normals[:1], (40, 1)))


def views(rng: np.random.Generator, dtype: type) -> None:
    """Parts of projected views, and two as one, against what projecting gives."""
    from splatpainter.rendering.cpu.projected_view import project, tile_shape

    splats, camera = rows(rng, dtype, rng.choice([0, 0.01, 0.1])), view(rng)
    other = splats.take(rng.integers(0, len(splats), 7))
    frame = project(splats, camera)
    tiles, some = rng.random(tile_shape(camera)) < 0.6, rng.random(len(splats)) < 0.7
    part = frame.part(tiles=tiles, gaussian_mask=some)
    direct = project(splats, camera, tiles=tiles, gaussian_mask=some)
    exact = direct.part()
    assert part.projected.tobytes() == exact.projected.tobytes() and np.array_equal(part.flatten_ids, exact.flatten_ids)
    second = project(other, camera)
    from dataclasses import replace

    second = replace(second, gaussian_ids=second.gaussian_ids + len(splats), num_gaussians=len(splats) + len(other))
    joined = frame.merged(second)
    assert len(joined) == len(frame.part()) + len(second)
    joined.rasterize()


def files(rng: np.random.Generator, dtype: type) -> None:
    """Rows put into records and taken out of them; what a file lost, measured."""
    import tempfile

    from splatpainter.io import read, write
    from splatpainter.io.losses import measure, moved_share_sorted
    from splatpainter.kernels.row_bits import differing
    from splatpainter.kernels.rows import MIN_ROWS, take
    from splatpainter.splats import ATTRIBUTES

    splats = shell(rng, int(rng.integers(1, 200)), rng.choice([0, 0.01, 0.1]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a" + str(rng.choice([".ply", ".spz", ".splat", ".sog", ".compressed.ply"])))
        write(path, splats)
        again = read(path)
        measure(splats, again)
        moved_share_sorted(splats)
        write(path, again.take(rng.integers(0, len(again), 50)), overwrite=True)
    ids = np.sort(rng.integers(0, len(splats), 9))
    take(splats, ids)
    many = rng.integers(0, len(splats), MIN_ROWS)
    taken = take(splats, many)
    assert all(getattr(taken, name).tobytes() == getattr(splats, name)[many].tobytes() for name in ATTRIBUTES)
    assert not differing(splats.sh, splats.sh.copy(), ids).any()


def numbers(rng: np.random.Generator, dtype: type) -> None:
    """Functions, products and solved systems of extreme numbers."""
    from splatpainter.kernels import portable

    x, y = (extreme(rng, rng.normal(size=50).astype(dtype), 0.3) for _ in range(2))
    with np.errstate(all="ignore"):
        for function in (portable.exp, portable.log, portable.sin, portable.cos, portable.arccos):
            function(x)
        portable.arctan2(y, x)
        portable.silu(x)
        portable.power(np.abs(x), 2.4)
        portable.hypot(x, y)
        k = int(rng.integers(0, 40))
        first, second = (extreme(rng, rng.normal(size=size).astype(dtype), 0.05) for size in ((k, 7), (7, 5)))
        portable.matmul(first, second)
        portable.gram(first, rng.random(k))
        portable.transposed_product(first, rng.random((k, 3)))
        portable.solved(np.eye(7) * rng.choice([1e-30, 1, 1e30]) + 0.1, rng.random((7, 2)))


def meshes(rng: np.random.Generator, dtype: type) -> None:
    """What makes training data of meshes: points thrown and found again, textures; and neighbours of points."""
    from splatpainter.voxels.neighbours import components, nearest_within
    from splattrain.data import poisson_disk
    from splattrain.data.materials import Material, sample_texture
    from splattrain.data.mesh_visibility import visible_points
    from splattrain.data.meshes import Mesh

    count = int(rng.integers(5, 200))
    points = (rng.normal(size=(count, 3)) * rng.choice([1e-6, 1, 1, 1e6])).astype(np.float32)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    typical = float(np.abs(points).max()) * float(rng.choice([1e-3, 0.1, 1]))
    poisson_disk.select(points, normals, int(rng.integers(1, count)), typical, rng)
    poisson_disk.spacing_around(points, normals, typical)
    poisson_disk.nearest(points, normals, points[::3], normals[::3], typical)
    components(points, typical)
    nearest_within(points, extreme(rng, points, 0.02), typical)
    pixels = rng.integers(0, 256, (int(rng.integers(1, 9)), int(rng.integers(1, 9)), 3)).astype(np.uint8)
    sample_texture(pixels, (rng.normal(size=(60, 2)) * rng.choice([1, 1e3, 1e6])).astype(np.float32))
    faces = rng.integers(0, count, (int(rng.integers(1, 60)), 3))
    cut_out = np.where(rng.random((4, 4)) < 0.5, 255, 0).astype(np.uint8)
    materials = (Material(), Material(alpha=cut_out))
    uvs = (rng.normal(size=(count, 2)) * rng.choice([1, 1e3, 1e9])).astype(np.float32)
    mesh = Mesh("fuzz", points, faces, normals, uvs, rng.integers(0, 2, len(faces)), materials)
    visible_points(mesh, view(rng), points)


def pictures(rng: np.random.Generator, dtype: type) -> None:
    """Packed pictures, whole and damaged."""
    import io

    from PIL import Image

    from splatpainter.pictures.jpeg_data import damage_of_jpeg
    from splatpainter.pictures.whole_files import _bytes_of_lzw

    height, width = rng.integers(1, 70, 2)
    pixels = rng.normal(128, rng.choice([0, 5, 60]), (height, width, 3)).clip(0, 255).astype(np.uint8)
    file = io.BytesIO()
    options = {"quality": int(rng.choice([1, 60, 95])), "progressive": bool(rng.random() < 0.5)}
    restarts = {"restart_marker_blocks": int(rng.integers(1, 5))} if rng.random() < 0.4 else {}
    Image.fromarray(pixels).save(file, "JPEG", subsampling=int(rng.integers(0, 3)), **options, **restarts)
    data = np.frombuffer(file.getvalue(), np.uint8).copy()
    assert not damage_of_jpeg(data.tobytes())
    for _ in range(8):
        broken = data.copy()
        at = rng.integers(2, len(data), int(rng.integers(1, 9)))
        broken[at] = rng.integers(0, 256, len(at))
        damage_of_jpeg(broken[: int(rng.integers(2, len(data) + 1))].tobytes())
        _bytes_of_lzw(rng.integers(0, 256, int(rng.integers(0, 9000)), np.uint8).tobytes(), 1 << 20)


CASES: dict[str, Callable[[np.random.Generator, type], None]] = {
    "forward": forward,
    "drawing": drawing,
    "windows": windows,
    "frames": frames,
    "cubes": cubes,
    "shadows": shadows,
    "fitting": fitting,
    "lifting": lifting,
    "painting": painting,
    "together": together,
    "rounds": rounds,
    "samples": samples,
    "grades": grades,
    "sights": sights,
    "stickers": stickers,
    "views": views,
    "files": files,
    "numbers": numbers,
    "meshes": meshes,
    "pictures": pictures,
}
ALL = ",".join(name for name in CASES if name != "forward")
"""But "forward", which "drawing" does too."""


def inside(names: list[str], seconds: float, count: int, seed: int, doubles: bool) -> int:
    """In the process whose bounds are checked. Returns how many inputs failed."""
    warnings.simplefilter("error", RuntimeWarning)
    start, done, failures, refused = time.monotonic(), Counter(), 0, Counter()
    current = Path(os.environ["SPLATPAINTER_KERNELS"]).with_name(CURRENT)
    for number in range(seed, seed + count):
        if time.monotonic() - start > seconds:
            break
        for name in names:
            current.write_text(f"{name}, seed {number}", encoding="utf-8")
            rng = np.random.default_rng([number, sorted(CASES).index(name)])
            try:
                CASES[name](rng, np.float64 if doubles and number % 4 == 0 else np.float32)
            except ValueError as error:
                refused[name] += 1
                if "\n" in str(error) or "broadcast" in str(error):
                    failures += report(name, number)
            except Exception:
                failures += report(name, number)
            done[name] += 1
            if failures >= 20:
                return failures
    counts = ", ".join(f"{name} {done[name]:,} ({refused[name]:,} refused)" for name in names)
    print(f"{sum(done.values()):,} inputs in {time.monotonic() - start:.0f} s: {counts}; {failures} failed", flush=True)
    return failures


def report(name: str, number: int) -> int:
    print(f"--- {name}, seed {number}", file=sys.stderr)
    traceback.print_exc(limit=-6)
    return 1


def main() -> int:
    parser = argparse.ArgumentParser(description="Extreme values for every kernel, bounds checked.")
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--count", type=int, default=10**9, help="seeds, at most")
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--cases", default=ALL, help=", ".join(CASES))
    parser.add_argument("--sanitize", default="", help="address,undefined: sanitizers in place of checked indices")
    parser.add_argument(
        "--base", action="store_true", help="the copy for the oldest machines: a third of the compiling"
    )
    parser.add_argument("--single", action="store_true", help="float32 only")
    parser.add_argument(f"--{STARTED}", action="store_true", help=argparse.SUPPRESS)
    config = parser.parse_args()
    if config.inside:
        names = config.cases.split(",")
        return min(inside(names, config.seconds, config.count, config.seed, not config.single), 100)
    library = build(config.sanitize, config.base)
    environment = {
        **os.environ,
        "SPLATPAINTER_KERNELS": str(library),
        "SPLATPAINTER_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])),
        "PYTHONFAULTHANDLER": "1",
    }
    if "address" in config.sanitize:
        # Python itself is not built for it: its runtime comes first, and C++'s for the exceptions of torch; what Python
        # leaves behind is not looked at.
        compiler = os.environ.get("CXX", "g++").split()
        paths = [[*compiler, f"-print-file-name={name}"] for name in ("libasan.so", "libstdc++.so.6")]
        runtimes = [subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip() for words in paths]
        environment |= {"LD_PRELOAD": " ".join(runtimes), "ASAN_OPTIONS": "detect_leaks=0"}
    code = subprocess.run([sys.executable, *sys.argv, f"--{STARTED}"], env=environment, check=False).returncode
    if code < 0:
        print(f"--- the process ended by signal {-code} in {library.with_name(CURRENT).read_text()}", file=sys.stderr)
    return 1 if code < 0 else code


def build(sanitize: str, only_base: bool) -> Path:
    """The library with checked indices, from the sources as they are; nothing is compiled where it is there already."""
    kind = ["--sanitize", sanitize, "--compiler", os.environ.get("CXX", "g++")] if sanitize else ["--checked"]
    kind += ["--base"] if only_base else []
    folder = CHECKED / ((sanitize.replace(",", "-") or "checked") + ("-base" if only_base else ""))
    command = [sys.executable, str(ROOT / "native" / "build.py"), "--out", str(folder), *kind]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return next(folder.glob("splatpainter_kernels.*"))


if __name__ == "__main__":
    sys.exit(main())
