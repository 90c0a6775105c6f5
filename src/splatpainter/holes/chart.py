"""A hole seen from one side: a picture of the surface around it, and which of its pixels are the hole. Pure.

The camera stands far in front of the border and looks along its normal; only Gaussians near the border are in it, so
nothing that stands farther off hides it. The shell is the visible surface that hangs together with the border. A pixel
belongs to the hole where the shell is missing and encloses it, or lies between parts of the border, and (where
something was removed) that lay before or behind it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.holes.border import Border
from splatpainter.holes.smooth_surface import ThinPlate
from splatpainter.lift.masks import dilated
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface
from splatpainter.voxels.neighbours import components, joined_labels

CELL_PX = 2
"""Pixels of a chart between neighbouring Gaussians."""
MAX_SIDE_PX = 400
"""Longest side of a chart; holes that need more are seen, and filled, more coarsely."""
MARGIN_RADII, MIN_MARGIN_CELLS = 0.8, 16.0
"""Margin around the border, in its radii and at least in cells: where texture comes from."""
DISTANCE_SIDES = 3.0
"""Distance of the camera from the border, in widths of the chart."""
SLAB_RADII, SLAB_CELLS = 1.2, 4.0
"""Gaussians farther above or below the border's centre than this are not in the chart."""
LATTICE_PX = 3
"""Step, pixels, between those at which the surface is estimated."""
MAX_STEP_PX = 3.0
"""Depth by which neighbouring pixels of one shell differ at most, in pixels' widths: a slope of 72 degrees."""
SEED_CELLS = 2.0
"""Depth by which the visible surface may differ from a Gaussian of the border that is seen there."""
SHELL_CELLS = 1.0
"""... and from one that is part of the shell: further ones may be the other side of a thin wall."""
MIN_SEED_SHARE = 0.1
"""Least share of a border's Gaussians that the side must show for the shell to be theirs."""
PART_SEED_SHARE = 0.02
"""... and of those that a separate part of the shell must hold."""
MIN_RIM_SHARE = 0.3
"""Least share of the pixels around a hole that must be shell: else it is the air beside an outline."""
MIN_HOLE_PX = 6
MIN_RIM_ALPHA = 0.3
NEAR_PX = 12
"""Pixels around other sheets, within which the largest one says where it would go on there."""
MIN_KNOTS, MAX_KNOTS = 8, 150
MIN_COVERAGE, MIN_CLEAN_COVERAGE = 0.7, 0.94
"""Alpha of the shell by itself from which it is there, and hides what is behind."""


@dataclass(frozen=True)
class Chart:
    """One side of a border."""

    camera: Camera
    splats: Splats = field(repr=False)
    """Gaussians of the chart."""
    pixel: float
    """World units at the border's centre."""
    picture: np.ndarray = field(repr=False)
    """[H, W, 3] float32 what is there now, in the asset's colour space."""
    depth: np.ndarray = field(repr=False)
    """[H, W] float64 z-depth of the shell, 0 elsewhere."""
    normals: np.ndarray = field(repr=False)
    """[H, W, 3] float64 unit, camera space, of the shell."""
    shell: np.ndarray = field(repr=False)
    """[H, W] bool."""
    hole: np.ndarray = field(repr=False)
    """[H, W] bool."""
    clean: np.ndarray = field(repr=False)
    """[H, W] bool, of the shell: pixels through which nothing behind it is seen."""
    seeds: float
    """Share of the border's Gaussians that lie on the shell."""


def chart_of(
    splats: Splats, remaining: np.ndarray, removed: np.ndarray | None, border: Border, outwards: np.ndarray
) -> Chart | None:
    """The chart from one side (outwards: [3] unit). removed: [N] bool; None: every hole of the shell counts. None where
    that side does not show the border."""
    half = border.radius + max(MARGIN_RADII * border.radius, MIN_MARGIN_CELLS * border.cell)
    pixel = max(border.cell / CELL_PX, 2 * half / MAX_SIDE_PX)
    side = int(np.ceil(2 * half / pixel))
    distance = DISTANCE_SIDES * 2 * half
    down = -outwards
    right = border.across
    rotation = np.stack([right, np.cross(down, right), down])
    eye = border.center + distance * outwards
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ eye
    focal = distance / pixel
    camera = Camera(side, side, focal, focal, side / 2, side / 2, matrix, offset=None)
    slab = SLAB_RADII * border.radius + SLAB_CELLS * border.cell
    present = np.flatnonzero(remaining)
    local = (splats.means[present].astype(np.float64) - border.center) @ rotation.T
    ids = present[(np.abs(local[:, 2]) < slab) & (np.abs(local[:, :2]) < 1.5 * half).all(1)]
    part = replace(splats.take(ids), source=None, origin=None)
    view = project(part, camera)
    picture, _, _ = view.rasterize()
    seen = visible_surface(Surface.of(part), part, view, np.ones((side, side), bool), LATTICE_PX)
    ys, xs = np.mgrid[:side, :side]
    at = seen.at(np.stack([xs, ys], -1).reshape(-1, 2) + 0.5)
    depth, normals = at.depth.reshape(side, side), at.normals.reshape(side, side, 3)

    rim = np.zeros_like(depth, bool)
    if not border.aligned:  # walls around a stump are seen edge-on: what they draw is their rim
        rim_mask = np.isin(ids, border.gaussian_ids)
        _, alpha, drawn_depth = project(part, camera, gaussian_mask=rim_mask).rasterize()
        rim = (alpha > MIN_RIM_ALPHA) & (depth == 0)
        depth, normals = np.where(rim, drawn_depth, depth), np.where(rim[..., None], (0.0, 0.0, -1.0), normals)
    pixels, z = camera.project(splats.means[border.gaussian_ids])
    index = np.clip(np.floor(pixels).astype(int), 0, side - 1)
    surface_here = depth[index[:, 1], index[:, 0]]
    seeds = (surface_here > 0) & (np.abs(surface_here - z) < SEED_CELLS * border.cell)
    share = float(seeds.mean())
    if share < MIN_SEED_SHARE:
        return None
    labels = _sheets(depth, MAX_STEP_PX * pixel)
    seed_labels = labels[index[seeds, 1], index[seeds, 0]]
    counts = np.bincount(seed_labels, minlength=labels.max() + 1)
    bordering = counts >= max(PART_SEED_SHARE * seeds.sum(), 2)
    shell = _one_surface(labels, bordering[labels] & (depth > 0), depth, SEED_CELLS * border.cell)
    coverage = _coverage(part, camera, np.where(shell, depth, 0.0), SHELL_CELLS * border.cell)
    shell = (shell & (coverage > MIN_COVERAGE)) | rim
    guide = np.ones((side, side), bool)
    if removed is not None:
        guide = _shadow(splats, removed, border, camera, rotation, slab)
    hull = _in_hull(index[seeds].astype(np.float64), side)
    between = hull & guide if border.aligned else hull
    hole = _hole(shell, guide, between, 0 if removed is not None else CELL_PX)
    depth, normals = np.where(shell, depth, 0.0), np.where(shell[..., None], normals, 0.0)
    clean = shell & (coverage > MIN_CLEAN_COVERAGE)
    return Chart(camera, part, pixel, picture, depth, normals, shell, hole, clean, share)


def _coverage(splats: Splats, camera: Camera, depth: np.ndarray, margin: float) -> np.ndarray:
    """[H, W] alpha of the Gaussians that lie on a shell ([H, W] z-depths, 0: none): where it ends."""
    pixels, z = camera.project(splats.means)
    index = np.floor(pixels).astype(int)
    inside = ((index >= 0) & (index < depth.shape)).all(1)
    chart_depth = np.zeros(len(splats))
    chart_depth[inside] = depth[index[inside, 1], index[inside, 0]]
    return project(splats, camera, gaussian_mask=(chart_depth > 0) & (np.abs(chart_depth - z) < margin)).rasterize()[1]


def _sheets(depth: np.ndarray, step: float) -> np.ndarray:
    """[H, W] int64 which continuous sheet each pixel is of; pixels without a surface each their own."""
    height, width = depth.shape
    number = np.arange(height * width).reshape(height, width)
    one, two = [], []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = (depth[a] > 0) & (depth[b] > 0) & (np.abs(depth[a] - depth[b]) < step)
        one.append(number[a][joined])
        two.append(number[b][joined])
    return joined_labels(height * width, np.concatenate(one), np.concatenate(two)).reshape(height, width)


def _one_surface(labels: np.ndarray, shell: np.ndarray, depth: np.ndarray, margin: float) -> np.ndarray:
    """[H, W] bool: of several sheets ([H, W] labels) the largest one, and those that continue it; through a hole one
    sees the far side of a wall, which is not part of the near one."""
    sizes = np.bincount(labels[shell])
    largest = shell & (labels == sizes.argmax())
    rest = shell & ~largest
    near = largest & dilated(rest, NEAR_PX)
    if not rest.any() or near.sum() < MIN_KNOTS:
        return largest
    ys, xs = np.nonzero(near)
    v, u = np.nonzero(rest)
    plate = ThinPlate.fit(np.stack([xs, ys], 1).astype(float), depth[near], margin, MAX_KNOTS)
    fits = np.abs(plate.at(np.stack([u, v], 1).astype(float)) - depth[v, u]) < margin
    out = largest.copy()
    out[v[fits], u[fits]] = True
    return out


def _shadow(
    splats: Splats, removed: np.ndarray, border: Border, camera: Camera, rotation: np.ndarray, slab: float
) -> np.ndarray:
    """[H, W] bool: pixels under what was removed near the border."""
    means = splats.means[removed].astype(np.float64)
    height = np.abs((means - border.center) @ rotation[2])
    pixels, _ = camera.project(means[height < slab])
    index = np.floor(pixels).astype(int)
    inside = ((index >= 0) & (index < camera.width)).all(1)
    out = np.zeros((camera.height, camera.width), bool)
    out[index[inside, 1], index[inside, 0]] = True
    return dilated(out, 2 * CELL_PX)


def _hole(shell: np.ndarray, guide: np.ndarray, between: np.ndarray, margin: int) -> np.ndarray:
    """[H, W] bool: parts that the shell encloses, or that lie `between` parts of the border, where the guide touches
    them and the shell is around. margin: pixels to every side that some pixel of a part must have: what is smaller is a
    gap between neighbours."""
    closed = ~dilated(~dilated(shell, 1), 1)
    outside = _labels(~closed)
    frame = np.unique(np.concatenate([outside[0], outside[-1], outside[:, 0], outside[:, -1]]))
    enclosed = (outside >= 0) & ~np.isin(outside, frame)
    parts = _labels(~shell & (enclosed | between))
    hole = np.zeros_like(shell)
    for label in range(parts.max() + 1):
        part = parts == label
        rim = dilated(part, 1) & ~part
        wide = not margin or bool((part & ~dilated(~part, margin)).any())
        if wide and part.sum() >= MIN_HOLE_PX and (part & guide).any() and shell[rim].mean() >= MIN_RIM_SHARE:
            hole |= part
    return hole


def _labels(mask: np.ndarray) -> np.ndarray:
    """[H, W] int64 connected part of each pixel of a mask, -1 elsewhere."""
    out = np.full(mask.shape, -1, np.int64)
    ys, xs = np.nonzero(mask)
    out[ys, xs] = components(np.stack([xs, ys, 0 * xs], 1) + 0.5, 1.0)
    return out


def _in_hull(points: np.ndarray, side: int) -> np.ndarray:
    """[side, side] bool: pixels in the convex hull of points [P, 2] (Andrew's monotone chain)."""
    points = np.unique(points, axis=0)
    ys, xs = np.mgrid[:side, :side]
    if len(points) < 3:
        return np.zeros((side, side), bool)
    corners: list[np.ndarray] = []
    for sequence in (points, points[::-1]):
        chain: list[np.ndarray] = []
        for p in sequence:
            while len(chain) >= 2 and _cross(chain[-2], chain[-1], p) <= 0:
                chain.pop()
            chain.append(p)
        corners += chain[:-1]
    out = np.ones((side, side), bool)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        out &= (b[0] - a[0]) * (ys - a[1]) - (b[1] - a[1]) * (xs - a[0]) >= 0
    return out


def _cross(o: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    return float((a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]))
