"""What the input views say about the Gaussians of an asset: how hard they pull at each, and features of the chosen.

The pull is that of AbsGS (Ye et al. 2024) on the mean squared error of each view, summed over the views. Features are
of the Gaussian itself, relative to the asset's cube, and of the pictures where it lies: means over the views, weighted
by how much of it each shows, and a 3 x 3 grid of the difference between picture and render on its own ellipse, in the
view that shows most of it. Views may differ in size. N Gaussians, S chosen ones, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from splatbench.densification.densify_config import DensifyConfig
from splatpainter.cameras import Camera
from splatpainter.fit.gradients import CpuPasses, Target, torch_pass
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from splatpainter.voxels.grid import bounding_cube

ELLIPSE_POINTS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1))
"""Points on the Gaussian's ellipse, in standard deviations along its longest and its second axis."""
PYRAMID_LEVELS = 5
"""Levels of the pyramids that pictures are sampled from: a large Gaussian's points are means of pixels."""
PLAIN_FEATURES = 29 + 3 * len(ELLIPSE_POINTS)
"""Features besides the harmonics, in the order of `gather`: 3 + 3 + 6 + 1, 9, the grid, 3 + 1 + 2 + 1."""


@dataclass(frozen=True)
class ViewMeasurements:
    """What the views say of every Gaussian. Numpy."""

    pull: np.ndarray = field(repr=False)
    """[N] sum over the views of the absolute screen-space gradient's length, loss per pixel."""
    coverage: np.ndarray = field(repr=False)
    """[V, N] pixels of weight of each Gaussian in each view."""
    renders: list[np.ndarray] = field(repr=False)
    """V of [H, W, 3]: the asset from the views' cameras, 0..1."""


def measure_views(
    splats: Splats, cameras: Sequence[Camera], colors: Sequence[np.ndarray], device: str = "cpu"
) -> ViewMeasurements:
    """Render and differentiate every view. splats: numpy; colors: V pictures [H, W, 3] of the cameras' sizes.
    device: with "cuda", gradients are those of the centre alone, not absolute (fit/gradients.py)."""
    on_cpu = torch.device(device).type == "cpu"
    asset: Splats[Any] = replace(splats if on_cpu else splats.torch(device), source=None, origin=None)
    passes = CpuPasses() if on_cpu else torch_pass
    pull = np.zeros(len(splats))
    coverage, renders = [], []
    for camera, color in zip(cameras, colors, strict=True):
        truth = torch.as_tensor(color, dtype=torch.float32).to(device)
        target = Target.of(camera, np.asarray(color), None, 0.0, 1.0)
        with torch.enable_grad():
            pulls = passes(asset, target, lambda image, truth=truth: (image - truth).square().mean(), True, True).pull
        assert pulls is not None
        pull[pulls.gaussian_ids] += np.linalg.norm(pulls.pixels, axis=1)
        drawn = render(asset, [camera], contributions=True)
        coverage.append(torch.as_tensor(drawn.contributions).cpu().numpy()[0])
        renders.append(torch.as_tensor(drawn.colors).cpu().numpy()[0].clip(0, 1))
    return ViewMeasurements(pull.astype(np.float32), np.stack(coverage).astype(np.float32), renders)


def choose(splats: Splats, pull: np.ndarray, config: DensifyConfig) -> np.ndarray:
    """[S] int64 ascending: the `most` Gaussians above min_opacity that views pull at hardest, of equals the first."""
    candidates = np.flatnonzero(splats.drawable & (splats.numpy().opacities > config.min_opacity) & (pull > 0))
    hardest = np.argsort(-pull[candidates], kind="stable")[: config.most]
    return np.sort(candidates[hardest])


@dataclass(frozen=True)
class Chosen:
    """The Gaussians that are to be replaced, as the network takes them. Torch float32."""

    gaussians: Splats[Tensor]
    axes: Tensor = field(repr=False)
    """[S, 3, 3] unit vectors: axes[:, k] is the k-th longest axis of the Gaussian, in world coordinates."""
    ranks: Tensor = field(repr=False)
    """[S, 3] int64: which of its scales belongs to its k-th longest axis."""
    features: Tensor = field(repr=False)
    """[S, F], each of order 1."""
    lo: np.ndarray
    """[3] lowest corner of the asset's cube."""
    size: float
    """Edge of the cube."""


def feature_count(config: DensifyConfig) -> int:
    """F."""
    return PLAIN_FEATURES + 3 * (config.sh_degree + 1) ** 2


def gather(
    splats: Splats,
    gaussian_ids: np.ndarray,
    measured: ViewMeasurements,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    config: DensifyConfig,
) -> Chosen:
    """These Gaussians [S] with their features, on the CPU. splats, colors: as `measure_views`."""
    lo, size = bounding_cube(splats)
    chosen = replace(splats.numpy(), source=None, origin=None).take(gaussian_ids)
    ranks = np.argsort(-chosen.scales, axis=1, kind="stable")
    axes = np.take_along_axis(np.swapaxes(quat_to_matrix(chosen.quats), 1, 2), ranks[:, :, None], 1)  # [S, k-th, xyz]
    lengths = np.take_along_axis(chosen.scales, ranks, 1)
    coverage = np.maximum(measured.coverage[:, gaussian_ids], 0)
    total = coverage.sum(0)
    weights = coverage / np.maximum(total, 1e-6)
    means = np.zeros((len(gaussian_ids), 9), np.float32)
    for camera, color, drawn, share in zip(cameras, colors, measured.renders, weights, strict=True):
        seen = np.flatnonzero(share > 0)
        at = project(chosen.means[seen], camera)
        picture, before = (sample(image, at, np.zeros(len(seen), int)) for image in (np.asarray(color), drawn))
        means[seen] += share[seen, None] * np.concatenate([picture - 0.5, picture - before, abs(picture - before)], 1)
    best = coverage.argmax(0)
    grid, pixels, sight = _probe(chosen, axes, lengths, best, cameras, colors, measured.renders)
    typical = float(np.median(measured.pull[gaussian_ids])) or 1.0
    opacity = chosen.opacities.clip(1e-4, 1 - 1e-4)
    harmonics = 3 * (config.sh_degree + 1) ** 2
    sh = chosen.sh.reshape(len(gaussian_ids), -1)[:, :harmonics].clip(-16, 16)
    columns = [
        (chosen.means - (lo + size / 2)) / (size / 2),
        np.log(lengths / size).clip(-14, 2) / 4,
        axes[:, :2].reshape(-1, 6),
        np.log(opacity / (1 - opacity))[:, None] / 4,
        np.pad(sh, ((0, 0), (0, harmonics - sh.shape[1]))),
        2 * means,
        2 * grid,
        sight,
        np.log2(pixels.clip(1e-3, 1e4))[:, None] / 4,
        np.log1p(np.stack([total, coverage.max(0)], 1)) / 4,
        (np.log(measured.pull[gaussian_ids].clip(1e-30) / typical) / 4)[:, None].clip(-2, 2),
    ]
    features = np.concatenate(columns, 1, dtype=np.float32, casting="same_kind")
    tensors = [torch.from_numpy(np.ascontiguousarray(x)) for x in (axes.astype(np.float32), ranks, features)]
    return Chosen(chosen.torch(), *tensors, lo=lo, size=size)


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """[M, 3] world points -> [M, 2] pixels x, y; points behind the camera end far outside."""
    x, y, z = (points.astype(np.float64) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).T
    z = np.where(z > 1e-6, z, np.inf)
    off = np.where(np.isfinite(z), 0.0, -1e6)
    return np.stack([camera.fx * x / z + camera.cx + off, camera.fy * y / z + camera.cy + off], 1)


def sample(image: np.ndarray, at: np.ndarray, level: np.ndarray) -> np.ndarray:
    """[M, C] of an image [H, W, C] at pixels [M, 2] (centres at +0.5), linear between pixels; the edge's beyond it.
    level: [M] int >= 0, halvings of the picture first (each by means of 2 x 2 pixels)."""
    out = np.zeros((len(at), image.shape[2]), np.float32)
    small = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
    height, width = image.shape[:2]
    position = torch.from_numpy((2 * at / (width, height) - 1).clip(-4, 4).astype(np.float32))
    for k in range(int(level.max(initial=0)) + 1):
        if k and min(small.shape[2:]) > 1:
            small = F.avg_pool2d(small, 2, ceil_mode=True, count_include_pad=False)
        here = np.flatnonzero(level == k)
        if len(here):
            values = F.grid_sample(small, position[here][None, None], padding_mode="border", align_corners=False)
            out[here] = values[0, :, 0].T.numpy()
    return out


def _probe(
    chosen: Splats,
    axes: np.ndarray,
    lengths: np.ndarray,
    best: np.ndarray,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    renders: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """([S, 27] picture minus render on ELLIPSE_POINTS, [S] pixels of the longest axis, [S, 3] direction of sight along
    its own axes), in each Gaussian's best view."""
    grid = np.zeros((len(chosen), len(ELLIPSE_POINTS), 3), np.float32)
    pixels, sight = np.ones(len(chosen)), np.zeros((len(chosen), 3))
    for view, (camera, color, drawn) in enumerate(zip(cameras, colors, renders, strict=True)):
        ids = np.flatnonzero(best == view)
        if not len(ids):
            continue
        middle, long, short = chosen.means[ids], *(axes[ids, k] * lengths[ids, k, None] for k in (0, 1))
        center = project(middle, camera)
        pixels[ids] = np.linalg.norm(project(middle + long, camera) - center, axis=1).clip(1e-3, 1e4)
        level = np.floor(np.log2(pixels[ids].clip(1, 2 ** (PYRAMID_LEVELS - 1)))).astype(int)
        change = np.asarray(color, np.float32) - drawn
        for k, (i, j) in enumerate(ELLIPSE_POINTS):
            grid[ids, k] = sample(change, project(middle + i * long + j * short, camera), level)
        ray = middle - camera.position
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-9)
        sight[ids] = np.einsum("nka,na->nk", axes[ids], ray)
    return grid.reshape(len(chosen), -1), pixels, sight
