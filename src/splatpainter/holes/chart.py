"""A hole seen from one side: a picture of the surface around it, and which of its pixels are the hole. Pure.

The camera stands far in front of the border and looks along its normal; only Gaussians near the border are in it, so
nothing that stands farther off hides it. The shell is the visible surface that hangs together with the border. A pixel
belongs to the hole where the shell is missing and encloses it, or lies between parts of the border, and (where
something was removed) that lay before or behind it.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.holes.border import Border
from splatpainter.holes.smooth_surface import ThinPlate
from splatpainter.kernels import portable
from splatpainter.lift.masks import dilated
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.neighbours import components, joined_labels


@dataclass(frozen=True)
class ChartThresholds:
    """A hole seen from above its border, as a picture. Source: taste, tried on bodies removed from captures."""

    cell_px: int = 2
    """Pixels of a chart between neighbouring Gaussians."""
    max_side_px: int = 400
    """Longest side of a chart; holes that need more are seen, and filled, more coarsely."""
    margin_radii: float = 0.8
    """Margin around the border, in its radii: where texture comes from."""
    min_margin_cells: float = 16.0
    """The least margin, in cells."""
    distance_sides: float = 3.0
    """Distance of the camera from the border, in widths of the chart."""
    slab_radii: float = 1.2
    """Gaussians farther above or below the border's centre than this, in the border's radii, are not in the chart."""
    slab_cells: float = 4.0
    """The least height of that slab, in cells."""
    lattice_px: int = 3
    """Step, pixels, between those at which the surface is estimated."""
    max_step_px: float = 3.0
    """Depth by which neighbouring pixels of one shell differ at most, in pixels' widths: a slope of 72 degrees."""
    seed_cells: float = 2.0
    """Depth by which the visible surface may differ from a Gaussian of the border that is seen there."""
    shell_cells: float = 1.0
    """Depth by which the visible surface may differ from a Gaussian that is part of the shell: further ones may be the
    other side of a thin wall."""
    min_seed_share: float = 0.1
    """Least share of a border's Gaussians that the side must show for the shell to be theirs."""
    part_seed_share: float = 0.02
    """Least share of them that a separate part of the shell must hold."""
    min_rim_share: float = 0.3
    """Least share of the pixels around a hole that must be shell: else it is the air beside an outline."""
    min_hole_px: int = 6
    """Pixels of a chart below which a hole is none."""
    min_rim_alpha: float = 0.3
    """Alpha of a pixel around a hole from which it can be shell at all."""
    near_px: int = 12
    """Pixels around other sheets, within which the largest one says where it would go on there."""
    min_knots: int = 8
    """Heights that the surface needs to go on at all."""
    max_knots: int = 150
    """Heights that it is continued from, at most: the fit's time grows with their cube."""
    min_coverage: float = 0.7
    """Alpha of the shell by itself from which it is there."""
    min_clean_coverage: float = 0.94
    """Alpha of the shell by itself from which it hides what is behind."""


CHART = ChartThresholds()


@dataclass(frozen=True)
class Chart:
    """One side of a border."""

    camera: Camera
    splats: Splats = field(repr=False)
    """Gaussians of the chart."""
    pixel: float
    """World units at the border's centre."""
    picture: Floats = field(repr=False)
    """[H, W, 3] float32 what is there now, in the asset's colour space."""
    depth: Floats = field(repr=False)
    """[H, W] float64 z-depth of the shell, 0 elsewhere."""
    normals: Floats = field(repr=False)
    """[H, W, 3] float64 unit, camera space, of the shell."""
    shell: Bools = field(repr=False)
    """[H, W] bool."""
    hole: Bools = field(repr=False)
    """[H, W] bool."""
    clean: Bools = field(repr=False)
    """[H, W] bool, of the shell: pixels through which nothing behind it is seen."""
    seeds: float
    """Share of the border's Gaussians that lie on the shell."""


def chart_of(
    splats: Splats, remaining: np.ndarray, removed: Bools | None, border: Border, outwards: np.ndarray
) -> Chart | None:
    """The chart from one side (outwards: [3] unit). removed: [N] bool; None: every hole of the shell counts. None where
    that side does not show the border."""
    # The picture: as fine as neighbours lie apart, as wide as the border and the texture around it.
    half = border.radius + max(CHART.margin_radii * border.radius, CHART.min_margin_cells * border.cell)
    pixel = max(border.cell / CHART.cell_px, 2 * half / CHART.max_side_px)
    side = int(np.ceil(2 * half / pixel))
    distance = CHART.distance_sides * 2 * half
    # The camera: far away, so that lines of sight are nearly parallel and the shell is seen from one side.
    down = -outwards
    right = border.across
    rotation = np.stack([right, np.cross(down, right), down])
    eye = border.center + distance * outwards
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -portable.matmul(eye, rotation.T)
    focal = distance / pixel
    camera = Camera(side, side, focal, focal, side / 2, side / 2, matrix, offset=None)
    # Only a slab around the border: what stands before or behind it would hide the hole.
    slab = CHART.slab_radii * border.radius + CHART.slab_cells * border.cell
    present = np.flatnonzero(remaining)
    local = portable.matmul(splats.means[present].astype(np.float64) - border.center, rotation.T)
    ids = present[(np.abs(local[:, 2]) < slab) & (np.abs(local[:, :2]) < 1.5 * half).all(1)]
    part = replace(splats.take(ids), source=None, origin=None)
    view = project(part, camera)
    picture, _, _ = view.rasterize()
    # The surface of the slab alone, without what was there before.
    seen = visible_surface(Surface.of(part), part, view, np.ones((side, side), bool), CHART.lattice_px)
    ys, xs = np.mgrid[:side, :side]
    at = seen.at(np.stack([xs, ys], -1).reshape(-1, 2) + 0.5)
    depth, normals = at.depth.reshape(side, side), at.normals.reshape(side, side, 3)

    rim = np.zeros_like(depth, bool)
    if not border.aligned:  # walls around a stump are seen edge-on: what they draw is their rim
        rim_mask = np.isin(ids, border.gaussian_ids)
        _, alpha, drawn_depth = project(part, camera, gaussian_mask=rim_mask).rasterize()
        rim = (alpha > CHART.min_rim_alpha) & (depth == 0)
        depth, normals = np.where(rim, drawn_depth, depth), np.where(rim[..., None], (0.0, 0.0, -1.0), normals)
    # Seeds: where the border's own Gaussians lie on what is seen.
    pixels, z = camera.project(splats.means[border.gaussian_ids])
    index = np.clip(np.floor(pixels).astype(int), 0, side - 1)
    surface_here = depth[index[:, 1], index[:, 0]]
    seeds = (surface_here > 0) & (np.abs(surface_here - z) < CHART.seed_cells * border.cell)
    share = float(seeds.mean())
    if share < CHART.min_seed_share:
        return None
    # The shell: sheets that hold enough seeds, and of these one surface.
    labels = _sheets(depth, CHART.max_step_px * pixel)
    seed_labels = labels[index[seeds, 1], index[seeds, 0]]
    counts = np.bincount(seed_labels, minlength=labels.max() + 1)
    bordering = counts >= max(CHART.part_seed_share * seeds.sum(), 2)
    shell = _one_surface(labels, bordering[labels] & (depth > 0), depth, CHART.seed_cells * border.cell)
    # Thin remains of what was removed look like a surface and cover nothing: they are no shell.
    coverage = _coverage(part, camera, np.where(shell, depth, 0.0), CHART.shell_cells * border.cell)
    shell = (shell & (coverage > CHART.min_coverage)) | rim
    # Which of its holes is meant: the one under what was removed, or every one that was circled.
    guide = np.ones((side, side), bool)
    if removed is not None:
        guide = _shadow(splats, removed, border, camera, rotation, slab)
    hull = _in_hull(index[seeds].astype(np.float64), side)
    between = hull & guide if border.aligned else hull
    hole = _hole(shell, guide, between, 0 if removed is not None else CHART.cell_px)
    depth, normals = np.where(shell, depth, 0.0), np.where(shell[..., None], normals, 0.0)
    clean = shell & (coverage > CHART.min_clean_coverage)
    return Chart(camera, part, pixel, picture, depth, normals, shell, hole, clean, share)


def _coverage(splats: Splats, camera: Camera, depth: np.ndarray, margin: float) -> np.ndarray:
    """[H, W] alpha of the Gaussians that lie on a shell ([H, W] z-depths, 0: none): where it ends."""
    pixels, z = camera.project(splats.means)
    index = np.floor(pixels).astype(int)
    inside = ((index >= 0) & (index < depth.shape)).all(1)
    chart_depth = np.zeros(len(splats))
    chart_depth[inside] = depth[index[inside, 1], index[inside, 0]]
    return project(splats, camera, gaussian_mask=(chart_depth > 0) & (np.abs(chart_depth - z) < margin)).rasterize()[1]


def _sheets(depth: np.ndarray, step: float) -> Ids:
    """[H, W] int64 which continuous sheet each pixel is of; pixels without a surface each their own."""
    height, width = depth.shape
    number = np.arange(height * width).reshape(height, width)
    one, two = [], []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        joined = (depth[a] > 0) & (depth[b] > 0) & (np.abs(depth[a] - depth[b]) < step)
        one.append(number[a][joined])
        two.append(number[b][joined])
    return joined_labels(height * width, np.concatenate(one), np.concatenate(two)).reshape(height, width)


def _one_surface(labels: np.ndarray, shell: np.ndarray, depth: np.ndarray, margin: float) -> Bools:
    """[H, W] bool: of several sheets ([H, W] labels) the largest one, and those that continue it; through a hole one
    sees the far side of a wall, which is not part of the near one."""
    sizes = np.bincount(labels[shell])
    largest = shell & (labels == sizes.argmax())
    rest = shell & ~largest
    near = largest & dilated(rest, CHART.near_px)
    if not rest.any() or near.sum() < CHART.min_knots:
        return largest
    ys, xs = np.nonzero(near)
    v, u = np.nonzero(rest)
    # Another sheet belongs to this surface if the largest one, continued, passes through it.
    plate = ThinPlate.fit(np.stack([xs, ys], 1).astype(float), depth[near], margin, CHART.max_knots)
    fits = np.abs(plate.at(np.stack([u, v], 1).astype(float)) - depth[v, u]) < margin
    out = largest.copy()
    out[v[fits], u[fits]] = True
    return out


def _shadow(
    splats: Splats, removed: np.ndarray, border: Border, camera: Camera, rotation: np.ndarray, slab: float
) -> Bools:
    """[H, W] bool: pixels under what was removed near the border."""
    means = splats.means[removed].astype(np.float64)
    height = np.abs(((means - border.center) * rotation[2]).sum(1))
    # What was high above the border throws no shadow on it.
    pixels, _ = camera.project(means[height < slab])
    index = np.floor(pixels).astype(int)
    inside = ((index >= 0) & (index < camera.width)).all(1)
    out = np.zeros((camera.height, camera.width), bool)
    out[index[inside, 1], index[inside, 0]] = True
    return dilated(out, 2 * CHART.cell_px)


def _hole(shell: np.ndarray, guide: np.ndarray, between: np.ndarray, margin: int) -> Bools:
    """[H, W] bool: parts that the shell encloses, or that lie `between` parts of the border, where the guide touches
    them and the shell is around. margin: pixels to every side that some pixel of a part must have: what is smaller is a
    gap between neighbours."""
    # One-pixel gaps between Gaussians are closed first, or every hole would leak into the frame.
    closed = ~dilated(~dilated(shell, 1), 1)
    outside = _labels(~closed)
    frame = np.unique(np.concatenate([outside[0], outside[-1], outside[:, 0], outside[:, -1]]))
    enclosed = (outside >= 0) & ~np.isin(outside, frame)
    parts = _labels(~shell & (enclosed | between))
    hole = np.zeros_like(shell)
    for label in range(parts.max() + 1):
        part = parts == label
        # A part whose rim is mostly air is the outside of an outline, not a hole.
        rim = dilated(part, 1) & ~part
        wide = not margin or bool((part & ~dilated(~part, margin)).any())
        if (
            wide
            and part.sum() >= CHART.min_hole_px
            and (part & guide).any()
            and shell[rim].mean() >= CHART.min_rim_share
        ):
            hole |= part
    return hole


def _labels(mask: np.ndarray) -> Ids:
    """[H, W] int64 connected part of each pixel of a mask, -1 elsewhere."""
    out = np.full(mask.shape, -1, np.int64)
    ys, xs = np.nonzero(mask)
    out[ys, xs] = components(np.stack([xs, ys, 0 * xs], 1) + 0.5, 1.0)
    return out


def _in_hull(points: np.ndarray, side: int) -> Bools:
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
