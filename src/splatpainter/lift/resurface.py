"""Resurfacing: where the surface under an edit is trusted, a sheet of thin Gaussians takes the place of the old ones.

The sheet lies on the surface of the original, as finely as the picture needs. Old Gaussians that lie within the
thickness of the surface and under the sheet go; those that only reach under it are halved until each half is clearly
under it or beside it. Everything else stays: what lies in front at a distance, behind, or beside.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import lift_colors, recolor
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import LocalOptions
from splatpainter.lift.sheet import SHEET_OPACITY, flat_cells, sheet_geometry
from splatpainter.lift.split import Lattice, projected_sizes
from splatpainter.rendering.cpu.projected_view import ProjectedView, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import PixelSurface, VisibleSurface, visible_surface
from splatpainter.transforms import quat_to_matrix

MIN_COVER = 0.6
"""Alpha of a pixel below which no sheet lies there."""
INSIDE = 0.85
"""Share of a Gaussian's footprint under the sheet from which all of it goes."""
OUTSIDE = 0.08
"""... up to which all of it stays."""
RIM_GOAL_PX = 1.0
"""Gaussians across the sheet's edge are halved down to about this width, pixels."""
MAX_RIM_HALVINGS = 8
NORMAL_SIGMAS = 2.0
"""Standard deviations along the surface's normal within which a Gaussian touches the surface, ..."""
SURFACE_WINDOWS = 0.35
"""... beside this share of the window in which the surface was estimated."""
MIN_ISLAND_PX = 12
"""Smaller parts of the trusted surface are left to splitting."""


@dataclass(frozen=True)
class Resurfaced:
    """An edit's trusted part, done."""

    splats: Splats
    """N Gaussians at their old indices, then the appended ones."""
    touched: np.ndarray = field(repr=False)
    """[T] int64 ascending: old Gaussians that changed."""
    replaced: np.ndarray = field(repr=False)
    """[R] int64 ascending, part of `touched`: indices that a sheet Gaussian took."""
    removed: np.ndarray = field(repr=False)
    """[E] int64 ascending, part of `touched`: indices that are empty now (opacity 0)."""
    parents: np.ndarray = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from, or lies in the place of."""
    covered: np.ndarray = field(repr=False)
    """[H, W] bool pixels that the sheet covers."""


def resurface(
    splats: Splats,
    surface: Surface,
    camera: Camera,
    target: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions,
) -> Resurfaced | None:
    """Lay a sheet under the masked pixels as far as the surface is trusted; None where it is nowhere.

    target: [H, W, 3] float32 0..1; mask: [H, W] bool."""
    import os
    ring = int(os.environ.get("RING", 0))
    reach = dilated(mask, ring)
    view = project(splats, camera, tiles=tiles_of_mask(reach))
    before, alpha, _ = view.rasterize()
    visible = visible_surface(surface, splats, view, reach & (alpha > MIN_COVER))
    ys, xs = np.nonzero(reach & (alpha > MIN_COVER))
    pixels = visible.at(np.stack([xs, ys], 1) + 0.5)
    depth = np.zeros(mask.shape)
    depth[ys, xs] = pixels.depth
    covered = without_islands(depth > 0)
    if not covered.any():
        return None
    depth[~covered] = 0
    near = NearSurface.of(visible, covered)
    target = np.where(mask[..., None], target, before)
    candidates = _candidates(splats, view, covered)
    tiles = project(splats, camera, gaussian_mask=candidates).tiles_of(candidates) | tiles_of_mask(reach)
    ids = np.sort(project(splats, camera, tiles=tiles).gaussian_ids)
    lattice = Lattice.of(splats.take(ids), camera)
    lattice, gone = _cut(lattice, candidates[ids], near, covered, camera, tiles)
    return _assemble(splats, ids, lattice, gone, visible, near, covered, depth, target, mask, camera, tiles, options)


def without_islands(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool without parts that nowhere hold a 3 x 3 block and its surroundings."""
    core = ~dilated(~mask, 1)
    return mask & dilated(core, 3)


@dataclass(frozen=True)
class NearSurface:
    """The sheet's surface at each pixel, and at the nearest covered one of those beside it."""

    nearest: np.ndarray = field(repr=False)
    """[H, W] int64 flat index of the nearest covered pixel."""
    slot: np.ndarray = field(repr=False)
    """[H, W] int64 entry of `surface` of each covered pixel, -1: not covered."""
    surface: PixelSurface
    camera: Camera

    @staticmethod
    def of(visible: VisibleSurface, covered: np.ndarray) -> NearSurface:
        ys, xs = np.nonzero(covered)
        slot = np.full(covered.shape, -1, np.int64)
        slot[ys, xs] = np.arange(len(ys))
        return NearSurface(nearest_pixel(covered), slot, visible.at(np.stack([xs, ys], 1) + 0.5), visible.camera)

    def touches(self, splats: Splats) -> np.ndarray:
        """[S] bool Gaussians that lie on the surface at the covered pixel nearest to their centre."""
        camera = self.camera
        uv, z = camera.project(splats.means.astype(np.float64))
        with np.errstate(invalid="ignore"):
            x = np.clip(np.nan_to_num(uv[:, 0]), 0, camera.width - 1).astype(np.int64)
            y = np.clip(np.nan_to_num(uv[:, 1]), 0, camera.height - 1).astype(np.int64)
        pixel = self.nearest[y, x]
        at = self.slot.ravel()[pixel]
        py, px = np.divmod(pixel, camera.width)
        ray = np.stack([(px + 0.5 - camera.cx) / camera.fx, (py + 0.5 - camera.cy) / camera.fy, np.ones(len(px))], 1)
        turn = camera.world_to_camera[:3, :3]
        mean = splats.means.astype(np.float64) @ turn.T + camera.world_to_camera[:3, 3]
        normal, point = self.surface.normals[at], ray * self.surface.depth[at][:, None]
        axes = np.einsum("ij,njk->nik", turn, quat_to_matrix(splats.quats.astype(np.float64)))
        extent = np.sqrt(((np.einsum("nik,ni->nk", axes, normal) * splats.scales) ** 2).sum(1))
        height = ((mean - point) * normal).sum(1)
        limit = NORMAL_SIGMAS * extent + SURFACE_WINDOWS * self.surface.windows[at] + 2 * self.surface.residuals[at]
        return (z > 0) & (np.abs(height) < limit)


def nearest_pixel(mask: np.ndarray) -> np.ndarray:
    """[H, W] int64 flat index of the nearest set pixel (by an approximate Euclidean distance: jump flooding; Rong and
    Tan 2006). mask: [H, W] bool with a set pixel."""
    height, width = mask.shape
    ys, xs = np.mgrid[:height, :width]
    best = np.where(mask, ys * width + xs, -1)
    step = 1 << max(int(np.ceil(np.log2(max(height, width)))) - 1, 0)

    def distance(seed: np.ndarray) -> np.ndarray:
        sy, sx = np.divmod(seed, width)
        return np.where(seed >= 0, (sy - ys) ** 2 + (sx - xs) ** 2, np.iinfo(np.int64).max)

    current = distance(best)
    while step:
        for dy in (-step, 0, step):
            for dx in (-step, 0, step):
                if not (dy or dx):
                    continue
                moved = np.full_like(best, -1)
                y0, y1 = max(dy, 0), height + min(dy, 0)
                x0, x1 = max(dx, 0), width + min(dx, 0)
                moved[y0:y1, x0:x1] = best[y0 - dy : y1 - dy, x0 - dx : x1 - dx]
                other = distance(moved)
                better = other < current
                best, current = np.where(better, moved, best), np.where(better, other, current)
        step //= 2
    return best


def _candidates(splats: Splats, view: ProjectedView, covered: np.ndarray) -> np.ndarray:
    """[N] bool Gaussians whose footprint reaches covered pixels."""
    sums = view.backproject(np.zeros((*covered.shape, 3), np.float32), covered.astype(np.float32))
    out = np.zeros(len(splats), bool)
    out[view.gaussian_ids[sums.alpha > 0]] = True
    return out


def _cut(
    lattice: Lattice, candidates: np.ndarray, near: NearSurface, covered: np.ndarray, camera: Camera, tiles: np.ndarray
) -> tuple[Lattice, np.ndarray]:
    """Halve Gaussians that lie across the sheet's edge: (the lattice, [S'] bool those that go). candidates: [S] bool."""
    inside_picture = covered.astype(np.float32)
    everywhere, zeros = np.ones_like(inside_picture), np.zeros((*covered.shape, 3), np.float32)
    active = candidates
    for turn in range(MAX_RIM_HALVINGS + 1):
        splats = lattice.splats()
        view = project(splats, camera, gaussian_mask=active, tiles=tiles)
        share = np.zeros(len(splats))
        ids = view.gaussian_ids
        total = view.backproject(zeros, everywhere).alpha
        share[ids] = view.backproject(zeros, inside_picture).alpha / np.maximum(total, 1e-9)
        touching = np.zeros(len(splats), bool)
        chosen = np.flatnonzero(active & (share > OUTSIDE))
        touching[chosen] = near.touches(splats.take(chosen))
        across = touching & (share < INSIDE)
        wide = across & (lattice.widths.max(1) > 1.4 * RIM_GOAL_PX)
        if turn == MAX_RIM_HALVINGS or not wide.any():
            return lattice, touching & (share > np.where(across, 0.5, INSIDE))
        lattice, source = lattice.halved(wide, 1.4 * RIM_GOAL_PX)
        active = active[source]
    raise AssertionError


def _assemble(
    splats, ids, lattice, gone, visible, near, covered, depth, target, mask, camera, tiles, options
) -> Resurfaced:
    rest = lattice.splats()
    cells = flat_cells(target, covered, depth, camera.fx)
    import os
    padded = np.pad(target, ((1, 1), (1, 1), (0, 0)), mode="edge")
    high, low = target, target
    for dy in range(3):
        for dx in range(3):
            part = padded[dy : dy + target.shape[0], dx : dx + target.shape[1]]
            high, low = np.maximum(high, part), np.minimum(low, part)
    contrast = (high - low).max(-1)
    cx, cy = cells.centers.astype(np.int64).T
    sharp = (contrast[cy, cx] > 0.15) & (cells.sizes == 1)
    edge = np.where(sharp, float(os.environ.get("EDGE", 1)), 1.0)
    geometry, valid = sheet_geometry(visible, cells, edge)
    centers = cells.centers[valid]
    # Hosts: of the Gaussians that go, the one that made most of the pixel.
    xs, ys = centers.astype(np.int64).T
    host_view = project(rest, camera, gaussian_mask=gone, tiles=tiles)
    heaviest = host_view.heaviest_gaussians()
    host = heaviest[ys, xs]
    bare = host < 0
    if bare.all():  # nothing has to go: what the pixels show is what the sheet lies on
        host_view = project(rest, camera, tiles=tiles)
        heaviest = host_view.heaviest_gaussians()
        host = heaviest[ys, xs]
        bare = host < 0
    if bare.any():
        with_host = heaviest >= 0
        index = nearest_pixel(with_host)
        host = np.where(bare, heaviest.ravel()[index[ys, xs]], host)
    dtype = splats.means.dtype
    count = len(centers)
    hosts = rest.take(host)
    toward = np.zeros((len(rest), 3), np.float32)
    toward[host_view.gaussian_ids] = host_view.unclamped_colors
    colors = target[ys, xs]
    sh = recolor(hosts.sh, toward[host], colors, options.damping)
    layer = Splats(
        geometry.means.astype(dtype), geometry.quats.astype(dtype), geometry.scales.astype(dtype),
        np.full(count, SHEET_OPACITY, dtype), sh.astype(dtype), splats.antialiased, splats.color_space,
        splats.source, hosts.origin,
    )  # fmt: skip
    stay = np.flatnonzero(~gone)
    both = rest.take(stay).append(layer)
    first = len(stay)
    full = project(splats.take(ids), camera, tiles=tiles)
    before = full.rasterize()[0]
    goal = np.where(mask[..., None], target, before)
    view = project(both, camera, tiles=tiles)
    added = view.gaussian_ids >= first
    editable = added.copy()
    split = np.zeros(len(both), bool)
    split[:first] = lattice.level[stay].any(1)
    sums = view.backproject(np.zeros((*mask.shape, 3), np.float32), covered.astype(np.float32))
    total = view.backproject(np.zeros((*mask.shape, 3), np.float32), np.ones(mask.shape, np.float32))
    editable |= split[view.gaussian_ids]
    editable |= (sums.peak > 0.02) & (sums.weight > 0.6 * total.weight)
    inside = covered.astype(np.float32)
    if os.environ.get("JOINT"):
        lifted = lift_colors(view, goal, np.ones_like(inside), editable, int(os.environ.get("ROUNDS", options.rounds)))
    else:
        lifted = lift_colors(view, goal, inside, added, int(os.environ.get("ROUNDS", options.rounds)))
        now = replace(view, projected=view.with_colors(lifted))
        rest_colors = lift_colors(now, goal, np.ones(mask.shape, np.float32), editable & ~added, int(os.environ.get("ROUNDS2", options.rounds)))
        lifted = np.where(added[:, None], lifted, rest_colors)
    moved = editable & (np.abs(lifted - np.maximum(view.unclamped_colors, 0)).max(1) > 1 / 1024)
    sh = both.sh.copy()
    at = view.gaussian_ids[moved]
    damping = np.where(added[moved], 1.0, options.damping)
    for value in (1.0, options.damping):
        part = damping == value
        sh[at[part]] = recolor(sh[at[part]], view.unclamped_colors[moved][part], lifted[moved][part], value)
    both = replace(both, sh=sh)
    return _write(splats, ids, lattice, stay, gone, both, first, host, covered)


def _write(splats, ids, lattice, stay, gone, both, first, host, covered) -> Resurfaced:
    """Gaussians at their indices: remaining slots keep theirs, sheet Gaussians take their hosts', the rest is appended."""
    n = len(splats)
    values = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    touched = np.zeros(n, bool)
    # Remaining pieces of the lattice.
    slot = lattice.slot[stay]
    parent = ids[lattice.parent[stay]]
    for name in ATTRIBUTES:
        new = getattr(both, name)[:first][slot]
        old = values[name][parent[slot]]
        touched[parent[slot]] |= (new != old).reshape(len(new), -1).any(1)
        values[name][parent[slot]] = new
    taken = np.zeros(n, bool)
    taken[parent[slot]] = True
    # Parents all of whose slots went.
    emptied = np.setdiff1d(ids[lattice.parent[gone & lattice.slot]], parent[slot])
    hosts = ids[lattice.parent[host]]
    free = np.zeros(n, bool)
    free[emptied] = True
    order = np.arange(len(hosts))
    can = free[hosts]
    _, at = np.unique(hosts[can], return_index=True)
    winners = order[can][at]
    replaced = hosts[winners]
    left = np.ones(len(hosts), bool)
    left[winners] = False
    for name in ATTRIBUTES:
        values[name][replaced] = getattr(both, name)[first + winners]
    free[replaced] = False
    removed = np.flatnonzero(free)
    values["opacities"][removed] = 0
    touched[emptied] = True
    pieces = np.flatnonzero(~slot)
    appended = both.take(np.concatenate([pieces, first + np.flatnonzero(left)]))
    parents = np.concatenate([parent[pieces], hosts[left]])
    result = replace(splats, **values).append(appended)
    return Resurfaced(result, np.flatnonzero(touched), np.sort(replaced), removed, parents, covered)
