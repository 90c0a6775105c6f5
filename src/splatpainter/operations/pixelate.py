"""A region made unreadable from all sides: one colour for each cell of a grid, or colours that only know the cells'.

    edited = pixelate(splats, Region.parse(["box=-0.2,0.1,0.8,0.2,0.3,1"]), size="5%")

What is written depends on the old colours through the cells' means alone: SH above degree 0, which holds what is seen
from aside, is cleared, and so are Gaussians that lie hidden behind the region, since whoever opens the file can take
away what covers them. The places, sizes and opacities of Gaussians can show what was there, too (letters that are cut
into a surface, or painted by small Gaussians): `merge` makes one of all in a cell, and writes that one's values into
the rows of the others. A mean is still a mean: words can be guessed from large pixels of them, so for what must stay
secret take cells larger than the letters, or one `color` for all.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera, bounding_sphere, spherical_cameras
from splatpainter.color import base_color, from_display, from_hex, sh_from_color
from splatpainter.decals.decals import parse_width
from splatpainter.grading.color_match import MATCHING
from splatpainter.kernels import portable
from splatpainter.operations.operation import AS_PYTHON, Operation, ReadyOperation, Tools, Wording, parameter
from splatpainter.operations.region import Region, check_terms
from splatpainter.order_statistics import distinct
from splatpainter.painter import Asset
from splatpainter.receipts import Pixelation, Receipt, untouched_hashes
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import ATTRIBUTES, Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import matrix_to_quat, principal_axes, quat_to_matrix
from splatpainter.voxels.neighbours import nearest_within

Style = Literal["cells", "blur"]
MAX_CELLS_ALONG = 1 << 20
"""Cells along an axis of an asset, at most: their numbers fit into 63 bits."""
MIN_VISIBLE = 0.03
"""Share of what a Gaussian covers that a view has to show: it would be visible there, as selections have it."""
HIDDEN_CELLS = 2.0
"""Distance, in cells, up to which hidden Gaussians behind the region change with it. From outside nothing of a room is
seen: there it is how much more than the region changes."""
VIEW_DISTANCE_RADII = 3.2
"""Distance of the views that look for hidden ones, in radii of the asset."""
BLUR_CELLS = 0.75
"""Standard deviation of a blur, in cells."""
MERGED_CELLS = 0.5
"""Standard deviation along the surface that a merged Gaussian has at least, in cells: with less there are gaps between
those of neighbouring cells."""
MAX_MERGED_OPACITY = 0.99
MIN_THICKNESS_CELLS = 1e-3
"""Least standard deviation of a merged Gaussian across the surface, in cells."""
NEIGHBOURS = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
"""[27, 3] steps from a cell to itself and those around it."""


@dataclass(frozen=True)
class Pixelate(Operation):
    """Make a region unreadable from all sides, for good: faces, plates, words. Each cell of a grid takes one colour,
    or the region is blurred, SH above degree 0 is cleared, hidden Gaussians behind it change with it."""

    kind: ClassVar[str] = "pixelate"

    where: tuple[str, ...] = parameter((), metavar="WHERE ...", holds="region")
    """Region that becomes unreadable, in whole cells: mask=M.png@CAM.json, box=, sphere=, selection=NAME@P.splatproj
    and others, as `splatpainter grade --help` lists them."""
    size: Any = parameter("5%", metavar="LENGTH|PERCENT", words=str)
    """Edge of a cell: world units, or a percentage of the asset's diameter."""
    style: Style = "cells"
    """cells: one colour in each. blur: colours run from cell to cell; they know no more than these."""
    color: str = parameter("", metavar="#RRGGBB")
    """One colour for all in place of the cells' means: then nothing of the old colours is left."""
    view: Path | None = parameter(None, metavar="CAM.json", file=True, holds="camera")
    """Camera along whose axes the cells lie, so that they look like pixels from there; default: the asset's axes."""
    margin: int = parameter(0, ge=0, le=100)  # each cell around costs a pass over 27 neighbours
    """Further cells around the region."""
    merge: bool = False
    """Also make one Gaussian of all in a cell: letters that the places and sizes of small Gaussians spell go with
    them."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        name = wording.option
        if not self.where:
            raise wording.error(self.kind, f"expected {name('where')}, the region that becomes unreadable, got none")
        check_terms(self.where)
        parse_width(self.size)
        if self.color and from_hex(self.color) is None:
            raise wording.error(self.kind, f"expected {name('color')} like #808080, got {ascii(self.color[:40])}")

    def ready(self, tools: Tools) -> ReadyOperation:
        from splatpainter.pictures.edit_files import camera_from

        region = Region.parse(self.where)
        camera = None if self.view is None else camera_from(self.view, tools.asset)
        return lambda asset, report: self._pixelated(asset, region, camera)

    def apply_selected(self, asset: Asset, weights: np.ndarray) -> Asset:
        """All of what is selected at all: half of an old look is a look."""
        region = Region.parse(self.where)
        # Within each group, so that the selection limits every `or` of the region.
        groups = tuple((*group, lambda _: weights) for group in region.groups)
        return self._pixelated(asset, Region(f"{region.text}, of a selection", groups), None)

    def _pixelated(self, asset: Asset, region: Region, camera: Camera | None) -> Asset:
        color = from_hex(self.color) if self.color else None
        how = {"size": self.size, "style": self.style, "margin": self.margin, "merge": self.merge}
        return pixelate(asset.splats, region, color=color, camera=camera, **how)

    def viewpoints(self) -> tuple[Path, ...]:
        return () if self.view is None else (self.view,)


def pixelate(
    splats: Splats,
    region: Region,
    *,
    size: float | str = "5%",
    style: Style = "cells",
    color: tuple[float, float, float] | None = None,
    camera: Camera | None = None,
    margin: int = 0,
    merge: bool = False,
) -> Asset:
    """The asset with a region of it pixelated or blurred, with its receipt, which says how many cells and colours there
    are and that SH is cleared; `verify` checks that against the file. size: edge of a cell, world units or "5%" of the
    asset's diameter. color: display 0..1, of all. camera: along whose axes the cells lie. margin: further cells around.

    Raises ValueError: a region that reaches nothing, cells so small that they cannot be counted, nothing that would
    change."""
    # The time is part of the receipt, as with every edit.
    start = time.perf_counter()
    splats = splats.numpy()
    edge = _edge(splats, size)
    # Whole cells, so that no border of the region shows through a cell that was cut.
    cells = _cells_of(splats, edge, camera)
    chosen, inner = _chosen(splats, region, cells, edge, margin)
    order, keys = np.flatnonzero(chosen), _keys(cells[chosen])
    # Rows sorted by cell: every step below works on cells by number.
    _, firsts, labels = np.unique(keys, return_index=True, return_inverse=True)
    colors = _cell_colors(splats, order, labels, len(firsts))
    # One colour for all leaves nothing of the means; a mean is still a hint of what was there.
    if color is not None:
        colors = np.broadcast_to(from_display(np.array([color]), splats.color_space), colors.shape)
    painted = _blurred(splats, order, labels, firsts, colors, edge) if style == "blur" else colors[labels]
    values = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    # SH above degree 0 is what is seen from aside, and would tell what the cells hide.
    values["sh"][order] = 0
    values["sh"][order, 0] = sh_from_color(painted.astype(np.float32))
    removed = np.zeros(0, np.int64)
    # Places and sizes can spell words too; the option makes one Gaussian of all in a cell.
    if merge:
        removed = _merge(values, splats, order, labels, firsts, edge)
    edited = replace(splats, **values)
    touched = changed_rows(splats, edited)
    if not len(touched):
        raise ValueError("pixelate: nothing to do, the region is of one colour in each cell already")
    # Everything outside is hashed before and after: that part of the claim is proved like any edit.
    before, after = untouched_hashes(splats, edited, touched)
    base_colors = len(np.unique(edited.sh[order, 0], axis=0))
    # What verify checks on the written file: rows, cells, colours, cleared SH.
    claim = Pixelation(order, len(firsts), base_colors, style, float(edge), inner, merge)
    receipt = Receipt(
        asset_sha256=splats.sha256,
        asset_rows=len(splats),
        output_sha256="",
        output_rows=len(edited),
        mode="pixelate",
        method=style,
        preset="",
        touched=touched,
        removed=np.intersect1d(removed, touched),
        appended_rows=0,
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        seconds={"pixelate": time.perf_counter() - start},
        note="; ".join(filter(None, _notes(region, claim, color is not None))),
        pixelation=claim,
    )
    return Asset(edited, receipt)


def _edge(splats: Splats, size: float | str) -> float:
    value, percent = parse_width(size)
    # A percentage is of the diameter, so that one setting suits assets of any scale.
    edge = value / 100 * 2 * bounding_sphere(splats)[1] if percent else value
    extent = float(np.ptp(splats.means[splats.drawable], axis=0).max()) if splats.drawable.any() else 0.0
    # Cells are numbered by 21 bits an axis; smaller ones would share numbers and so colours.
    if not extent <= edge * MAX_CELLS_ALONG / 4:
        raise ValueError(f"pixelate: expected cells of at least {4 * extent / MAX_CELLS_ALONG:g}, got {edge:g}")
    return edge


def _cells_of(splats: Splats, edge: float, camera: Camera | None) -> Ids:
    """[N, 3] int64: the cell of each Gaussian, of a grid through the world's origin; those that are nowhere (NaN) lie
    in one far off."""
    points = splats.world_means.astype(np.float64)
    # Along a camera's axes, so that cells look like pixels from there; computed alike on every machine.
    if camera is not None:
        points = portable.matmul(np.nan_to_num(points), camera.world_to_camera[:3, :3].T)
    with np.errstate(invalid="ignore", over="ignore"):
        cells = np.floor(points / edge)
    # Counted from the middle, so that assets far from the origin keep small numbers.
    middle = np.floor(np.median(cells[splats.drawable], axis=0)) if splats.drawable.any() else np.zeros(3)
    far = MAX_CELLS_ALONG - 1
    return np.nan_to_num(np.clip(cells - middle, -far, far), nan=far).astype(np.int64) + MAX_CELLS_ALONG


def _keys(cells: np.ndarray) -> Ids:
    """[M] int64, another for each cell."""
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _chosen(splats: Splats, region: Region, cells: np.ndarray, edge: float, margin: int) -> tuple[np.ndarray, int]:
    """([N] bool: Gaussians that change, how many of them are hidden ones that only lie near). All in the cells that the
    region reaches, also those that cannot be drawn; and what no view from outside shows, up to HIDDEN_CELLS from what
    changes."""
    reached = region.weights(splats) > 0
    # Cells and not Gaussians: what shares a cell with the region would show its colours in the mean.
    keys, region_keys = _keys(cells), distinct(_keys(cells[reached]))
    # One ring of neighbours for each cell of margin.
    for _ in range(margin):
        grown = [_keys(_unpacked(region_keys) + step) for step in NEIGHBOURS]
        region_keys = distinct(np.concatenate(grown))
    chosen = np.isin(keys, region_keys)
    # Hidden ones are looked for from all sides, and only near the region: a whole room's inside is hidden, too.
    points = splats.means[chosen & splats.drawable].astype(np.float64)
    reach = min(math.sqrt(float((np.ptp(points, axis=0) ** 2).sum())) / 2, HIDDEN_CELLS * edge)
    hidden = np.flatnonzero(~chosen & splats.drawable & ~_is_visible(splats))
    near, _ = nearest_within(points, splats.means[hidden].astype(np.float64), reach)
    behind = hidden[near >= 0]
    # They change with the region, since whoever opens the file can take away what covers them.
    chosen[behind] = True
    return chosen, len(behind)


def _is_visible(splats: Splats) -> Bools:
    """[N] bool: whether some view from all around shows more than MIN_VISIBLE of what a Gaussian covers."""
    center, radius = bounding_sphere(splats)
    out = np.zeros(len(splats), bool)
    size = MATCHING.view_px
    # Black and white pictures: only the weights of a view matter here, not its colours.
    black, everywhere = np.zeros((size, size, 3), np.float32), np.ones((size, size), np.float32)
    for camera in spherical_cameras(center, VIEW_DISTANCE_RADII * radius, MATCHING.views, size=size):
        # One view that shows it is enough, so views are joined and none is decisive.
        view = project(splats, camera.local)
        sums = view.backproject(black, everywhere)
        out[view.gaussian_ids[sums.weight > MIN_VISIBLE * sums.alpha]] = True
    return out


def _unpacked(keys: np.ndarray) -> np.ndarray:
    """[M, 3] cells of keys."""
    mask = (1 << 21) - 1
    return np.stack([keys >> 42, (keys >> 21) & mask, keys & mask], 1)


def _shares(splats: Splats, order: np.ndarray) -> np.ndarray:
    """[M] > 0: how much of a picture each Gaussian makes, up to a factor: its opacity times its area."""
    # The two larger sides: the area that a flat Gaussian shows.
    scales = np.sort(np.nan_to_num(splats.scales[order].astype(np.float64), posinf=0), axis=1)
    shares = splats.opacities[order] * scales[:, 1] * scales[:, 2]
    # Never 0, so that a cell of faint ones alone still has a mean.
    return np.where(splats.drawable[order], np.maximum(np.nan_to_num(shares), 0), 0) + 1e-300


def _cell_colors(splats: Splats, order: np.ndarray, labels: np.ndarray, count: int) -> Floats:
    """[count, 3] float64: the mean colour of each cell, by what its Gaussians make of a picture."""
    shares = _shares(splats, order)
    # Clipped to what a screen shows: one colour far outside would tint its whole cell.
    colors = np.clip(np.nan_to_num(base_color(splats.sh[order]).astype(np.float64)), 0, 1)
    return _means(colors, labels, shares, count)


def _means(values: np.ndarray, labels: np.ndarray, shares: np.ndarray, count: int) -> np.ndarray:
    """[count, C] weighted means of values [M, C]."""
    totals = np.bincount(labels, shares, count)
    sums = [np.bincount(labels, shares * column, count) for column in values.T]
    return np.stack(sums, 1) / totals[:, None]


def _blurred(
    splats: Splats, order: np.ndarray, labels: np.ndarray, firsts: np.ndarray, colors: np.ndarray, edge: float
) -> np.ndarray:
    """[M, 3] colours that run between the means of a Gaussian's cell and of those around it: a Gaussian of BLUR_CELLS
    about its place, over the middles of the cells' Gaussians."""
    points = np.nan_to_num(splats.means[order].astype(np.float64))
    # Measured from the middles of what lies in a cell, since Gaussians fill cells unevenly.
    middles = _means(points, labels, np.ones(len(order)), len(firsts))
    sums, weights = np.zeros((len(order), 3)), np.zeros(len(order))
    near = _neighbours_of(middles, edge)
    # Neighbour by neighbour over all rows at once: 27 passes in place of a loop over Gaussians.
    for column in near.T:
        there = column[labels]
        distance = ((points - middles[np.maximum(there, 0)]) ** 2).sum(1) / (BLUR_CELLS * edge) ** 2
        weight = np.where(there >= 0, portable.exp(-0.5 * np.minimum(distance, 200.0)), 0)
        sums += weight[:, None] * colors[np.maximum(there, 0)]
        weights += weight
    # Far from all middles the weights vanish; the cell's own colour is left there.
    return np.where(weights[:, None] > 1e-30, sums / np.maximum(weights, 1e-30)[:, None], colors[labels])


def _neighbours_of(middles: np.ndarray, edge: float) -> np.ndarray:
    """[C, 27] cells around each, -1 where there is none; of several in one cube the first."""
    cubes = np.floor((middles - middles.min(0)) / edge).astype(np.int64) + 1
    keys = _keys(cubes)
    # Sorted once, so that each of the 27 neighbours is a binary search.
    order = np.argsort(keys, kind="stable")
    out = np.full((len(keys), len(NEIGHBOURS)), -1, np.int64)
    for k, step in enumerate(NEIGHBOURS):
        sought = _keys(cubes + step)
        at = np.minimum(np.searchsorted(keys[order], sought), len(keys) - 1)
        exists = keys[order[at]] == sought
        out[exists, k] = order[at[exists]]
    return out


def _merge(
    values: dict[str, np.ndarray],
    splats: Splats,
    order: np.ndarray,
    labels: np.ndarray,
    firsts: np.ndarray,
    edge: float,
) -> np.ndarray:
    """Make one Gaussian of all in a cell, by their moments, in the row of the cell's first; the others' rows get its
    values and opacity 0. Returns these rows, ascending."""
    # Moments by what each Gaussian makes of a picture, so that the merged one looks like them from afar.
    shares, count = _shares(splats, order), len(firsts)
    points = np.nan_to_num(splats.means[order].astype(np.float64))
    means = _means(points, labels, shares, count)
    turns = quat_to_matrix(np.nan_to_num(splats.quats[order].astype(np.float64)))
    scales = np.nan_to_num(splats.scales[order].astype(np.float64), posinf=0)
    # Covariance of a mixture: that within each Gaussian and that of their places.
    apart = points - means[labels]
    axes = turns * scales[:, None, :]
    spread = (axes[:, :, None, :] * axes[:, None, :, :]).sum(-1) + apart[:, :, None] * apart[:, None, :]
    covariances = _means(spread.reshape(-1, 9), labels, shares, count).reshape(-1, 3, 3)
    variances, axes = principal_axes(covariances)
    deviations = np.sqrt(np.maximum(variances, 0))
    area = np.maximum(deviations[:, 1] * deviations[:, 2], 1e-300)
    # Its opacity covers the same area as they did, before gaps between cells are closed below.
    opacities = np.clip(np.bincount(labels, shares, count) / area, 0, MAX_MERGED_OPACITY)
    # At least so wide that no gap shows between neighbouring cells, and thick enough to be drawn.
    deviations[:, 1:] = np.maximum(deviations[:, 1:], MERGED_CELLS * edge)
    deviations[:, 0] = np.maximum(deviations[:, 0], MIN_THICKNESS_CELLS * edge)
    quats = matrix_to_quat(axes)
    for name, merged in (("means", means), ("scales", deviations), ("quats", quats), ("opacities", opacities)):
        values[name][order] = merged[labels].astype(np.float32)
    # All rows of a cell get one Gaussian's values, so that nothing of the old ones is left in the file.
    values["sh"][order] = values["sh"][order[firsts]][labels]
    # Rows are emptied and not removed: old Gaussians keep their indices (docs/ARCHITECTURE.md).
    emptied = np.ones(len(order), bool)
    emptied[firsts] = False
    values["opacities"][order[emptied]] = 0
    return order[emptied]


def _notes(region: Region, claim: Pixelation, one_color: bool) -> list[str]:
    """What a receipt says in words."""
    what = "one colour" if one_color else f"{claim.colors} colours"
    hidden = f", {claim.inner} of them hidden behind the region" if claim.inner else ""
    left = "" if claim.merged else "places, sizes and opacities of the Gaussians are as they were (merge changes them)"
    # Words of the user's end up in a file that others open; only what can be printed goes in.
    text = "".join(c if c.isprintable() else "?" for c in region.text[:1000])
    return [
        f"{claim.style} of {claim.size:.4g}: {len(claim.rows)} Gaussians in {claim.cells} cells have {what}{hidden}",
        "SH above degree 0 is cleared",
        left,
        f"where {text}",
    ]
