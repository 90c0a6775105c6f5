"""Resurfacing: where the surface under an edit is trusted, a sheet of thin Gaussians takes the place of the old ones.

The sheet lies on the surface of the original, as finely as the picture needs, under the edited pixels and a narrow ring
of unedited ones, so that the paint's edge lies within it. Old Gaussians that lie on the surface under the sheet go;
those that only reach under it are halved until each half is clearly under it or beside it. What lies in front of the
surface at a distance, behind it, or beside it stays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import MIN_CHANGE, lift_colors, recolor
from splatpainter.lift.fringe import FringedSurface, fringe_of, fringe_paint
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.options import LocalOptions
from splatpainter.lift.sheet import SHEET_OPACITY, Cells, SheetGeometry, flat_cells, sheet_geometry
from splatpainter.lift.split import Lattice, projected_sizes
from splatpainter.rendering.cpu.projected_view import ProjectedView, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.surface.visible import PixelSurface, VisibleSurface, depths_along
from splatpainter.transforms import quat_to_matrix, row_max, turned

MIN_COVER = 0.6
"""Alpha of a pixel below which no sheet lies there."""
RING_PX = 2
"""Unedited pixels around the edited ones that the sheet covers too."""
INSIDE = 0.85
"""Share of a Gaussian's footprint under the sheet from which all of it goes, ..."""
OUTSIDE = 0.08
"""... and up to which all of it stays."""
RIM_GOAL_PX = 2.2
"""Gaussians across the sheet's edge are halved until they are no wider than this (standard deviation)."""
MAX_RIM_HALVINGS = 8
NORMAL_SIGMAS = 2.0
"""Standard deviations along the surface's normal within which a Gaussian touches the surface, ..."""
SURFACE_WINDOWS = 0.35
"""... beside this share of the window in which the surface was estimated."""
MAX_CUT_PX = 8.0
"""Gaussians longer than this (standard deviation) are not cut at the sheet's edge, ..."""
MIN_HANDLED = 0.85
"""... and where less than this share of the light comes from those that a sheet replaces there is none, ..."""
FAR_WINDOWS = 3.0
"""... (what lies behind the surface by more than this many of its windows, seen through cracks, does not count, ..."""
MIN_TOUCHING = 0.5
"""... as long as this share of the light comes from the surface), ..."""
CLEAR_RADIUS_PX = 2
"""... by the majority of the pixels around; ..."""
MIN_CLEAR = 0.5
"""... if that leaves less than this share of the pixels, the edit gets no sheet at all."""
UNEDITED_WEIGHT = 0.35
"""Of an unedited pixel in colour rounds, beside an edited one."""
RELAXATION = 0.75
"""Share of a colour round's step that sheets take."""
MIN_PEAK = 0.02
"""Old Gaussians that remain before the sheet, and give some pixel of it more than this share, ..."""
MIN_SHEET_SHARE = 0.6
"""... with this share of their weight before it, ..."""
MIN_VISIBLE = 0.5
"""... and this share of their alpha visible (behind the sheet they are not), take part in the colour rounds."""


MAX_HOST_SIGMAS = 2.5
"""A sheet Gaussian farther than this from the Gaussian whose pixel it takes, in standard deviations of that, lies past
the horizon of a round surface, on a plane that touches it before: it would hang beside the object from other sides."""
MIN_HOST_FLATNESS = 0.3
"""Thickness of a Gaussian over its length, at least, in that distance."""
HOST_REACH_PX = 2
"""Pixels around whose Gaussians count as well."""
HORIZON_DEGREES = 65.0
"""Between line of sight and normal, from which a surface is near its horizon."""


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
    """[A] int64: the old Gaussian that each appended one was split from, or lies in place of."""
    covered: np.ndarray = field(repr=False)
    """[H, W] bool pixels that the sheet covers, ring included."""


def resurface(
    splats: Splats,
    view: ProjectedView,
    around: ProjectedView,
    visible: VisibleSurface,
    before: np.ndarray,
    alpha: np.ndarray,
    target: np.ndarray,
    pixels: np.ndarray,
    options: LocalOptions,
    first_appended: int,
) -> Resurfaced | None:
    """Lay a sheet under some pixels as far as the surface is trusted; None where it is nowhere.

    view: of `splats`, at least the tiles of `pixels`; around: those of all Gaussians that make these pixels;
    visible: the surface at these; before: [H, W, 3] its picture; target: [H, W, 3] float32 the picture to reach
    (equal to `before` in the ring); pixels: [H, W] bool; first_appended: Gaussians from this index on are no part of
    the original, and their indices may take any sheet Gaussian."""
    camera = view.camera
    ys, xs = np.nonzero(pixels)
    depth = np.zeros(pixels.shape)
    depth[ys, xs] = visible.at(np.stack([xs, ys], 1) + 0.5).depth
    covered = without_islands(depth > 0)
    if not covered.any():
        return None
    near = NearSurface.of(visible, covered)
    clear = covered & _is_clear(splats, view, near, covered)
    if clear.sum() < MIN_CLEAR * covered.sum():
        return None
    remaining = without_islands(clear)
    if not remaining.any():
        return None
    if not np.array_equal(remaining, covered):
        covered, near = remaining, NearSurface.of(visible, remaining)
    differs = target != before
    painted = differs[..., 0] | differs[..., 1] | differs[..., 2]
    fringe, surface = fringe_of(painted, covered, depth > 0, alpha), visible
    colors, cover = target, np.ones(alpha.shape, np.float32)
    if fringe.any():
        surface = FringedSurface.of(visible, covered, fringe)
        colors, cover = fringe_paint(target, surface, np.asarray(camera.background, np.float32))
        covered = covered | fringe
        near = NearSurface.of(surface, covered)
        ys, xs = np.nonzero(fringe)
        depth[ys, xs] = surface.at(np.stack([xs, ys], 1) + 0.5).depth
    sums = view.backproject(np.zeros_like(before), covered.astype(np.float32))
    candidates, seen = np.zeros((2, len(splats)), bool)
    candidates[view.gaussian_ids[sums.alpha > 0]] = True
    seen[view.gaussian_ids[sums.peak > options.min_share]] = True
    tiles = view.touched_tiles(sums.alpha > 0) | tiles_of_mask(pixels)
    around = around.part(tiles=tiles)
    ids = np.flatnonzero(candidates)
    base, first = splats.take(ids), _numbered(around.part(gaussian_mask=candidates), candidates)
    lattice, gone = _cut(Lattice.of(base, camera), first, seen[ids], near, covered, options)
    rest = _Rest.of(candidates, ids, lattice, gone)
    cells = flat_cells(target, covered, depth, camera.fx)
    geometry, index = sheet_geometry(surface, cells, target)
    cells = Cells(cells.centers[index], cells.sizes[index])
    replaced = np.flatnonzero(gone)
    if len(replaced):
        hidden, owners = lattice.some(replaced).splats(), ids[lattice.parent[replaced]]
    else:
        hidden, owners = rest.splats(splats, lattice), rest.owners
    sheet, hosts = _sheet(hidden, geometry, cells, colors, cover, tiles, camera)
    goal = np.where(covered[..., None], target, around.rasterize()[0])
    weights = np.where(painted, covered, UNEDITED_WEIGHT).astype(np.float32)
    joined = rest.splats(splats, lattice, sheet)
    joined, moved = _painted(joined, rest.split, camera, tiles, goal, covered, weights, options)
    emptied = ids[lattice.parent[gone & lattice.slot]]
    return _assemble(splats, rest, emptied, joined, moved, owners[hosts], covered, first_appended)


@dataclass(frozen=True)
class _Rest:
    """The R Gaussians that remain beside a sheet, pieces of those that were cut at the place of their parents."""

    owners: np.ndarray = field(repr=False)
    """[R] int64 ascending: the Gaussian that each is, or is a piece of."""
    pieces: np.ndarray = field(repr=False)
    """[R] int64 index in the lattice; -1: not in it."""
    split: np.ndarray = field(repr=False)
    """[R] bool: pieces."""
    slot: np.ndarray = field(repr=False)
    """[R] bool: those that stay at their owner's index."""

    @staticmethod
    def of(candidates: np.ndarray, ids: np.ndarray, lattice: Lattice, gone: np.ndarray) -> _Rest:
        """candidates: [N] bool, those of the lattice; ids: [C] their indices; gone: [S'] bool, which the sheet
        replaces."""
        beside, chosen = np.flatnonzero(~candidates), np.flatnonzero(~gone)
        owners = np.concatenate([beside, ids[lattice.parent[chosen]]])
        pieces = np.concatenate([np.full(len(beside), -1), chosen])
        order = np.argsort(owners, kind="stable")
        owners, pieces = owners[order], pieces[order]
        split, slot = np.append(lattice.level.any(1), False), np.append(lattice.slot, True)  # the latter: of index -1
        return _Rest(owners, pieces, split[pieces], slot[pieces])

    def splats(self, base: Splats, lattice: Lattice, more: Splats | None = None) -> Splats:
        """They, followed by `more`. base: all Gaussians, N."""
        halved = np.flatnonzero(self.split)
        cut = lattice.some(self.pieces[halved]).splats()
        out = base.take(self.owners)
        arrays = {}
        for name in ATTRIBUTES:
            values = getattr(out, name)
            values[halved] = getattr(cut, name)
            arrays[name] = values if more is None else np.concatenate([values, getattr(more, name)])
        origin = out.origin
        if more is not None and origin is not None and more.origin is not None:
            origin = np.concatenate([origin, more.origin])
        return replace(out, **arrays, origin=origin)


def _numbered(view: ProjectedView, gaussian_mask: np.ndarray) -> ProjectedView:
    """A view of some Gaussians ([N] bool) alone, numbered in their order."""
    number = np.cumsum(gaussian_mask) - 1
    return replace(view, gaussian_ids=number[view.gaussian_ids], num_gaussians=int(gaussian_mask.sum()))


def without_islands(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool without parts that nowhere hold a 3 x 3 block (those parts' surroundings within 3 pixels stay)."""
    core = ~dilated(~mask, 1)
    return mask & dilated(core, 3)


def _is_clear(splats: Splats, view: ProjectedView, near: NearSurface, covered: np.ndarray) -> np.ndarray:
    """[H, W] bool pixels most of whose light comes from Gaussians that a sheet can take the place of: they lie on the
    surface, and under the sheet, or are small enough to be cut at its edge. Elsewhere, in the fog of captures, a veil
    would stay before the sheet."""
    ids = view.gaussian_ids
    zeros, inside = np.zeros((*covered.shape, 3), np.float32), covered.astype(np.float32)
    sums = view.backproject(zeros, inside)
    share = sums.alpha / np.maximum(view.backproject(zeros, np.ones_like(inside)).alpha, 1e-9)
    handled = sums.weight > 0
    unsure = np.flatnonzero(handled & (share <= INSIDE))
    handled[unsure] = row_max(projected_sizes(splats.geometry(ids[unsure]), view.camera)) < MAX_CUT_PX
    far, reached = np.zeros(len(ids), bool), np.flatnonzero(sums.weight > 0)
    on_surface, far[reached] = near.touches_or_far_behind(splats.geometry(ids[reached]))
    touching = handled.copy()
    touching[reached] &= on_surface
    # One channel for their light, one for that of what the sheet will hide, one for what nothing stops.
    red = view.camera.background[0]
    view = replace(view, camera=replace(view.camera, background=(red, red, red)))
    colors = np.zeros((len(ids), 3), np.float32)
    colors[:, 0], colors[:, 1] = touching, far
    image, alpha, _ = view.rasterize(colors)
    weight, hidden = image[..., 0] - image[..., 2], image[..., 1] - image[..., 2]  # over black
    clear = (weight > MIN_HANDLED * (alpha - hidden)) & (weight > MIN_TOUCHING * alpha)
    return box_mean(clear.astype(np.float32), CLEAR_RADIUS_PX) > 0.5


@dataclass(frozen=True)
class NearSurface:
    """The sheet's surface at each covered pixel, and for those beside at the nearest one."""

    nearest: np.ndarray = field(repr=False)
    """[H, W] int32 flat index of the nearest covered pixel."""
    entry: np.ndarray = field(repr=False)
    """[H, W] int64 entry of `surface` of each covered pixel, -1: not covered."""
    surface: PixelSurface
    camera: Camera

    @staticmethod
    def of(visible: VisibleSurface | FringedSurface, covered: np.ndarray) -> NearSurface:
        ys, xs = np.nonzero(covered)
        entry = np.full(covered.shape, -1, np.int64)
        entry[ys, xs] = np.arange(len(ys))
        return NearSurface(nearest_pixels(covered), entry, visible.at(np.stack([xs, ys], 1) + 0.5), visible.camera)

    def touches(self, splats: Splats) -> np.ndarray:
        """[S] bool Gaussians that lie on the surface at the covered pixel nearest to their centre."""
        height, limit, _ = self._heights(splats)
        return np.abs(height) < limit

    def touches_or_far_behind(self, splats: Splats) -> tuple[np.ndarray, np.ndarray]:
        """([S] bool as `touches`, [S] bool Gaussians that lie so far behind the surface that they are no part of a
        thick or foggy one)."""
        height, limit, window = self._heights(splats)
        return np.abs(height) < limit, height < -limit - FAR_WINDOWS * window

    def _heights(self, splats: Splats) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """([S] over the surface, along its normal; NaN behind the camera; [S] up to which they touch it; [S] window)"""
        camera = self.camera
        uv, z = camera.project(splats.means.astype(np.float64))
        limits = np.array([camera.width - 1.0, camera.height - 1.0])
        x, y = np.clip(np.nan_to_num(uv), 0, limits).astype(np.int64).T
        pixel = self.nearest[y, x].astype(np.int64)
        at = self.entry.ravel()[pixel]
        py, px = np.divmod(pixel, camera.width)
        point = camera.to_camera(camera.unproject(self.surface.depth[at], np.stack([px, py], 1) + 0.5))
        turn, normal = camera.world_to_camera[:3, :3], self.surface.normals[at]
        axes = turned(turn, quat_to_matrix(splats.quats.astype(np.float64)))
        extent = np.sqrt(((np.einsum("nik,ni->nk", axes, normal) * splats.scales) ** 2).sum(1))
        height = ((camera.to_camera(splats.means.astype(np.float64)) - point) * normal).sum(1)
        limit = NORMAL_SIGMAS * extent + SURFACE_WINDOWS * self.surface.windows[at] + 2 * self.surface.residuals[at]
        return np.where(z > 0, height, np.nan), limit, self.surface.windows[at]


def _cut(
    lattice: Lattice,
    view: ProjectedView,
    seen: np.ndarray,
    near: NearSurface,
    covered: np.ndarray,
    options: LocalOptions,
) -> tuple[Lattice, np.ndarray]:
    """Halve Gaussians that lie across the sheet's edge: (the lattice, [S'] bool those that go). lattice: of S that make
    covered pixels, nothing halved; view: of these; seen: [S] bool, those that make the picture: what is hidden behind
    them goes or stays as one."""
    inside, zeros = covered.astype(np.float32), np.zeros((*covered.shape, 3), np.float32)
    ids, splats = np.arange(len(lattice)), lattice.base
    for turn in range(MAX_RIM_HALVINGS + 1):
        share = np.zeros(len(lattice))
        total = view.backproject(zeros, np.ones_like(inside)).alpha
        share[ids[view.gaussian_ids]] = view.backproject(zeros, inside).alpha / np.maximum(total, 1e-9)
        touching = np.zeros(len(lattice), bool)
        chosen = np.flatnonzero(share[ids] > OUTSIDE)
        touching[ids[chosen]] = near.touches(splats.geometry(chosen))
        across = touching & (share < INSIDE)
        wide = across & seen[lattice.parent]
        wide[wide] = row_max(lattice.some(np.flatnonzero(wide)).widths) > RIM_GOAL_PX
        if turn == MAX_RIM_HALVINGS or not wide.any() or (~lattice.slot).sum() > options.max_pieces:
            break
        lattice, source = lattice.halved(wide, RIM_GOAL_PX)
        ids = np.flatnonzero(touching[source])
        splats = lattice.some(ids).splats()
        view = project(splats, view.camera, tiles=view.tiles)
    return lattice, touching & (share > np.where(across, 0.5, INSIDE))


def _sheet(
    hidden: Splats,
    geometry: SheetGeometry,
    cells: Cells,
    colors: np.ndarray,
    cover: np.ndarray,
    tiles: np.ndarray,
    camera: Camera,
) -> tuple[Splats, np.ndarray]:
    """(C Gaussians in the picture's colours, [C] their hosts: those of the `hidden` ones, in place of which the sheet
    lies, that weigh most in their pixels)."""
    xs, ys = cells.centers.astype(np.int64).T
    view = project(hidden, camera, tiles=tiles)
    heaviest = view.heaviest_gaussians()
    hosts = heaviest[ys, xs]
    if (hosts < 0).any():
        nearest = nearest_pixels(heaviest >= 0)
        hosts = heaviest.ravel()[nearest[ys, xs]]
    toward = np.zeros((len(hidden), 3), np.float32)
    toward[view.gaussian_ids] = view.unclamped_colors
    parents, dtype = hidden.take(hosts), hidden.means.dtype
    sheet = Splats(
        _within_horizon(hidden, hosts, heaviest, geometry, cells.centers, camera).astype(dtype),
        geometry.quats.astype(dtype),
        geometry.scales.astype(dtype),
        (SHEET_OPACITY * cover[ys, xs]).astype(dtype),
        recolor(parents.sh, toward[hosts], colors[ys, xs]),
        hidden.antialiased,
        hidden.color_space,
        parents.source,
        parents.origin,
    )
    return sheet, hosts


def _within_horizon(
    hidden: Splats, hosts: np.ndarray, heaviest: np.ndarray, geometry: SheetGeometry, pixels: np.ndarray, camera: Camera
) -> np.ndarray:
    """[C, 3] float64 the means of sheet Gaussians. Those near the horizon and beyond MAX_HOST_SIGMAS of all Gaussians
    that make the pixels around are moved along the lines of sight of their pixels ([C, 2]) to where their host ([C],
    ids of `hidden`) is densest: the edited view stays as it is. heaviest: [H, W] ids of `hidden`, -1: none."""
    means = geometry.means
    normals = quat_to_matrix(geometry.quats)[:, :, 2]
    sight = means - camera.position
    facing = np.abs((normals * sight).sum(1)) / np.maximum(np.linalg.norm(sight, axis=1), 1e-30)
    far = np.flatnonzero(facing < math.cos(math.radians(HORIZON_DEGREES)))
    far = far[_sigmas(hidden, hosts[far], means[far]) > MAX_HOST_SIGMAS]
    height, width = heaviest.shape
    xs, ys = pixels[far].astype(np.int64).T
    for dy in range(-HOST_REACH_PX, HOST_REACH_PX + 1):
        for dx in range(-HOST_REACH_PX, HOST_REACH_PX + 1):
            beside = heaviest[np.clip(ys + dy, 0, height - 1), np.clip(xs + dx, 0, width - 1)]
            outside = (beside < 0) | (_sigmas(hidden, np.maximum(beside, 0), means[far]) > MAX_HOST_SIGMAS)
            far, xs, ys = far[outside], xs[outside], ys[outside]
    x, y = ((pixels[far] - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    depth, _ = depths_along(hidden.geometry(hosts[far]), camera, np.stack([x, y, np.ones(len(far))], 1))
    ahead = depth > 0
    out = means.copy()
    out[far[ahead]] = camera.unproject(depth[ahead], pixels[far[ahead]])
    return out


def _sigmas(splats: Splats, ids: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[Q] distance of points [Q, 3] from Gaussians ids [Q], in standard deviations of these."""
    turn = quat_to_matrix(splats.quats[ids].astype(np.float64))
    scales = splats.scales[ids].astype(np.float64)
    scales = np.maximum(scales, MIN_HOST_FLATNESS * scales.max(1, keepdims=True))
    offset = np.einsum("nji,nj->ni", turn, points - splats.means[ids]) / scales
    return np.sqrt((offset**2).sum(1))


def _painted(
    joined: Splats,
    split: np.ndarray,
    camera: Camera,
    tiles: np.ndarray,
    goal: np.ndarray,
    covered: np.ndarray,
    weights: np.ndarray,
    options: LocalOptions,
) -> tuple[Splats, np.ndarray]:
    """(the Gaussians after colour rounds of the sheet, of the pieces around it and of what hangs before it; bool of
    each, whether its colour changed). split: [S] bool, which of the first S Gaussians are pieces; the ones behind them
    are the sheet."""
    view, first = project(joined, camera, tiles=tiles), len(split)
    added = view.gaussian_ids >= first
    zeros, everywhere = np.zeros_like(goal), np.ones(covered.shape, np.float32)
    inside, total = view.backproject(zeros, covered.astype(np.float32)), view.backproject(zeros, everywhere).weight
    piece = np.append(split, np.zeros(len(joined) - first, bool))[view.gaussian_ids]
    hanging = (inside.peak > MIN_PEAK) & (inside.weight > MIN_SHEET_SHARE * total)
    hanging &= inside.weight > MIN_VISIBLE * inside.alpha
    editable = added | piece | hanging
    lifted = lift_colors(view, goal, weights, editable, options.sheet_rounds, relaxation=RELAXATION)
    before = view.unclamped_colors
    moved = editable & (row_max(np.abs(lifted - np.maximum(before, 0))) > MIN_CHANGE)
    sh = joined.sh.copy()
    for chosen, damping in ((moved & added, 1.0), (moved & ~added, options.damping)):
        ids = view.gaussian_ids[chosen]
        sh[ids] = recolor(sh[ids], before[chosen], lifted[chosen], damping)
    changed = np.zeros(len(joined), bool)
    changed[view.gaussian_ids[moved]] = True
    return replace(joined, sh=sh), changed


def _assemble(
    splats: Splats,
    rest: _Rest,
    emptied_ids: np.ndarray,
    joined: Splats,
    moved: np.ndarray,
    host: np.ndarray,
    covered: np.ndarray,
    first_appended: int,
) -> Resurfaced:
    """Everything at its index: pieces of a Gaussian at that of their parent, one sheet Gaussian at that of its host,
    further ones at emptied indices that are no part of the original; the rest is appended. joined: the rest, then the
    sheet; moved: [R + C] bool those of other colours than before; emptied_ids: indices that nothing of the rest has;
    host: [C]."""
    first = len(rest.owners)
    emptied = np.zeros(len(splats), bool)
    emptied[emptied_ids] = True
    index = np.full(len(host), -1, np.int64)
    fitting = np.flatnonzero(emptied[host])
    _, chosen = np.unique(host[fitting], return_index=True)
    index[fitting[chosen]] = host[fitting[chosen]]
    emptied[host[fitting[chosen]]] = False
    free = np.flatnonzero(emptied[first_appended:]) + first_appended
    homeless = np.flatnonzero(index < 0)[: len(free)]
    index[homeless] = free[: len(homeless)]
    emptied[index[homeless]] = False
    settled = np.flatnonzero(index >= 0)
    removed = np.flatnonzero(emptied)

    changed = np.flatnonzero(rest.slot & (rest.split | moved[:first]))  # the others have the bits that they had
    written = np.concatenate([rest.owners[changed], index[settled], removed])
    source = np.concatenate([changed, first + settled])
    tail = np.concatenate([np.flatnonzero(~rest.slot), first + np.flatnonzero(index < 0)])
    values, touched = {}, np.zeros(len(splats), bool)
    for name in ATTRIBUTES:
        old = getattr(splats, name)
        new = np.concatenate([getattr(joined, name)[source], old[removed]])
        if name == "opacities":
            new[len(source) :] = 0
        differs = (new.view(np.uint32) != old[written].view(np.uint32)).reshape(len(new), -1).any(1)
        if len(tail):
            values[name] = np.concatenate([old, getattr(joined, name)[tail]])
        elif differs.any():
            values[name] = old.copy()
        if differs.any():
            touched[written[differs]] = True
            values[name][written] = new
    origin = splats.origin
    if len(tail) and origin is not None:
        assert joined.origin is not None
        origin = np.concatenate([origin, joined.origin[tail]])
    parents = np.concatenate([rest.owners[~rest.slot], host[index < 0]])
    result = replace(splats, **values, origin=origin)
    return Resurfaced(result, np.flatnonzero(touched), np.sort(index[settled]), removed, parents, covered)
