"""Which way Gaussians face, for light: their shortest axes on the side from which views all around see them, and what
share of that side each shows where both are seen (leaves, thin walls)."""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import bounding_sphere
from splatpainter.kernels import portable
from splatpainter.lift.depth_normals import scattered
from splatpainter.lights.sightings import SeenPixels, dense_places, look_around
from splatpainter.lights.stand_ins import StandIns
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, quat_to_matrix


@dataclass(frozen=True)
class FacingThresholds:
    """From where an asset's Gaussians are looked at, and what makes a surface face one way."""

    seen_px: float = 0.05
    """Pixels' worth of a Gaussian, over all views, from which its side is a matter of observation."""
    one_sided: float = 0.35
    """Mean cosine between the normal and the lines of sight from which only the one side counts."""
    one_sided_share: float = 0.75
    """Share of a side in what is seen of a Gaussian from which only that side counts. Without such a limit albedos of
    16 fitted tuning meshes are 0.1 dB better, and a low sun shines through walls of two layers."""
    oriented_share: float = 0.97
    """Of what is seen from one side, by pixels, that must show the positive end of its shortest axis: then the asset
    was made of oriented patches (from a mesh), and those that are hidden are believed too. Of fitted assets
    half does."""
    mostly_oriented_share: float = 0.75
    """The same, from which they decide at least for those that are not seen from one side, and for all where neighbours
    agree as well. Below, walls of two layers whose axes all point one way would let light through."""
    coherent_share: float = 0.93
    """Mean agreement of the ends of shortest axes among neighbours of one plane, from which the asset was made of
    oriented patches though much of it is seen from both sides: of meshes of single sheets 0.95 and more, of six
    captures 0.23 to 0.83."""
    min_neighbours: int = 8
    """Gaussians of a plane in a cell that such an agreement is asked of."""
    neighbourhood: float = 0.15
    """Edge of the cells in which Gaussians of a sheet seen from both sides agree, in radii of the asset."""
    max_cells: int = 1 << 18
    """Cells either way along an axis: what lies farther off shares the outermost ones."""
    axis_bins: int = 12
    """Directions of axes by which they are told apart in a cell."""
    max_sheet_gap: float = 0.35
    """Between the heights of what is seen from above and from below, in widths of Gaussians: more are two layers."""
    min_front: float = 0.9
    """Share of its front in what is seen of a Gaussian, from which it counts as facing one way."""
    min_side_share: float = 0.03
    """Of a sheet's pixels that show either side, at least, for it to be seen from both."""
    max_flatness: float = 0.7
    """Shortest axis over the middle one, up to which a Gaussian counts as flat."""


ORIENTATION = FacingThresholds()
MIN_FLAT_SHARE = 0.25
"""Of the drawable Gaussians that must be flat, for the asset to have a surface that light can be moved on."""


@dataclass(frozen=True)
class Facing:
    """Of N Gaussians."""

    normals: np.ndarray = field(repr=False)
    """[N, 3] float32 unit, towards the side that is seen more; zeros where it cannot be drawn."""
    front: np.ndarray = field(repr=False)
    """[N] float32 0.5..1: share of that side in what is seen of it."""
    seen: np.ndarray = field(repr=False)
    """[N] float32 pixels' worth of it, over all views."""
    flat_share: float
    """0..1 of the drawable Gaussians that are flat."""
    oriented: bool = False
    """Made of oriented patches, whose axes are believed as they are."""
    surface_pixels: SeenPixels | None = field(repr=False, default=None)
    """Of the surface, as views all around see it."""
    few: StandIns | None = field(repr=False, default=None)
    """What stood for the Gaussians where they were looked at; None: they themselves."""

    @property
    def trusted(self) -> np.ndarray:
        """[N] bool: seen, and facing one way."""
        return (self.seen > ORIENTATION.seen_px) & (self.front > ORIENTATION.min_front)


def facing(splats: Splats) -> Facing:
    """Raises ValueError: nothing can be drawn."""
    drawable = splats.drawable
    if not drawable.any():
        raise ValueError("light: expected Gaussians that can be drawn, got none")
    # Gaussians that cannot be drawn would pull means and medians; they get zeros, and keep their places.
    if not drawable.all():
        part = facing(splats.take(drawable))
        few = part.few
        if few is not None:
            few = replace(few, of=scattered(few.of, drawable), share=scattered(few.share, drawable))
        normals, front, seen = (scattered(values, drawable) for values in (part.normals, part.front, part.seen))
        return Facing(normals, front, seen, part.flat_share, part.oriented, part.surface_pixels, few)
    # Round Gaussians have no normal to speak of, and who moves light asks for this share first.
    ordered = np.sort(splats.scales, 1)
    flat_share = float((ordered[:, 0] <= ORIENTATION.max_flatness * ordered[:, 1]).mean())
    axes = _shortest_axes(splats)
    few = dense_places(splats, axes)
    if few is None:
        return replace(_looked_at(splats, axes), flat_share=flat_share)
    part = _looked_at(few.splats, _shortest_axes(few.splats))
    # Oriented patches know their own normals; what was found by looking holds for all that one stands for.
    normals = axes if part.oriented else part.normals[few.of]
    seen = (part.seen[few.of] * few.share).astype(np.float32)
    return Facing(normals, part.front[few.of], seen, flat_share, part.oriented, part.surface_pixels, few)


def _shortest_axes(splats: Splats) -> np.ndarray:
    """[N, 3] float32 unit, towards their positive ends."""
    turns = quat_to_matrix(splats.quats)
    return turns[np.arange(len(splats)), :, splats.scales.argmin(1)].astype(np.float32)


def _looked_at(splats: Splats, axes: np.ndarray) -> Facing:
    """Of drawable Gaussians with these shortest axes [N, 3], by views all around; without their flat share."""
    count = len(splats)
    center, radius = bounding_sphere(splats)
    outwards = splats.means - center.astype(np.float32)
    # Which end of an axis is the outside is not in the file; which side can be seen from around is.
    sights = look_around(splats)
    towards, seen = sights.towards, sights.seen
    # What is seen from one side alone votes on whether the whole asset's axes have a meaning.
    cosines = (axes * towards).sum(1) / np.maximum(seen, 1e-9)
    one_sided = (seen > ORIENTATION.seen_px) & (np.abs(cosines) > ORIENTATION.one_sided)
    weight = seen[one_sided].astype(np.float64)
    agreeing = float(portable.total(weight[cosines[one_sided] > 0]) / portable.total(weight)) if len(weight) else 0.0
    sheets = agreeing >= ORIENTATION.mostly_oriented_share or not len(weight)
    sheets = sheets and _coherence(splats, axes, radius) >= ORIENTATION.coherent_share
    # Oriented patches are believed also where nothing sees them; else each side is what views found.
    oriented = agreeing >= ORIENTATION.oriented_share or sheets
    if oriented:
        normals, front = axes, np.ones(count, np.float32)
    else:
        cosines, sheet = _with_neighbours(splats, axes, towards, seen, cosines, radius)
        observed = (seen > ORIENTATION.seen_px) | sheet
        side = np.where(observed, cosines, (axes * outwards).sum(1))
        front = np.where(observed, 0.5 + 0.5 * np.minimum(np.abs(cosines) / ORIENTATION.one_sided, 1), 1).astype(
            np.float32
        )
        if agreeing >= ORIENTATION.mostly_oriented_share:  # or where observation does not decide
            side, front, sheet = np.where(one_sided, side, 1), np.ones(count, np.float32), np.ones(count, bool)
        normals = np.where(side[:, None] < 0, -axes, axes)
        # Axes of fitted Gaussians are noise, which light shows as specks: the surface that they show has the say.
        smooth, share, there = sights.surface_normals(normals)
        # Sides of sheets are a matter of all that lies around, which has been asked above.
        smooth = np.where((sheet & ((smooth * normals).sum(1) < 0))[:, None], -smooth, smooth)
        normals = np.where(there[:, None], smooth, normals)
        # Through the gaps of a wall some of its inner side is seen from outside: that is no side.
        share = 0.5 + 0.5 * np.minimum((share - 0.5) / (ORIENTATION.one_sided_share - 0.5), 1)
        front = np.where(there & ~sheet, share, front).astype(np.float32)
    return Facing(normals, front, seen, 1.0, oriented, sights.surface_pixels)


def _coherence(splats: Splats, axes: np.ndarray, radius: float) -> float:
    """0..1: how far shortest axes of neighbours in one plane have their positive ends on one side."""
    # Smaller cells than for sheets: neighbours should lie on one plane even where the surface bends.
    groups, aligned = _planes(splats, axes, ORIENTATION.neighbourhood / 2 * radius)
    sign = np.where((aligned * axes).sum(1) < 0, -1.0, 1.0)
    count = np.bincount(groups)
    enough = count >= ORIENTATION.min_neighbours
    return float(np.abs(np.bincount(groups, sign))[enough].sum() / max(count[enough].sum(), 1))


def _planes(splats: Splats, axes: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """([N] int64 which Gaussians lie in one cell and along one plane, [N, 3] their axes on one side of it)."""
    fan = fibonacci_sphere(2 * ORIENTATION.axis_bins)[: ORIENTATION.axis_bins]  # half of the sphere: axes have no sign
    along = portable.matmul(axes.astype(np.float64), fan.T)
    bins = np.abs(along).argmax(1)
    aligned = np.where(along[np.arange(len(axes)), bins] < 0, -1.0, 1.0)[:, None] * axes
    # Cells off the origin: planes through it are common.
    cells = np.floor(splats.means.astype(np.float64) / max(edge, 1e-12) + 0.37)
    half = ORIENTATION.max_cells
    cells = cells.clip(-half, half - 1).astype(np.int64) + half
    # As one number: rows of numbers sort ten times as slowly.
    keys = ((cells[:, 0] * 2 * half + cells[:, 1]) * 2 * half + cells[:, 2]) * ORIENTATION.axis_bins + bins
    return np.unique(keys, return_inverse=True)[1].reshape(-1), aligned


def _with_neighbours(
    splats: Splats,
    axes: np.ndarray,
    towards: np.ndarray,
    seen: np.ndarray,
    cosines: np.ndarray,
    radius: float,
) -> tuple[np.ndarray, np.ndarray]:
    """([N] mean cosines between axes and lines of sight, [N] bool Gaussians of sheets).

    Of a sheet that is seen from both sides they are those of the sheet around, which all Gaussians of it share: each
    for itself would be speckled by chance. A wall of two layers is no such sheet: what is seen from one side of it lies
    apart from what is seen from the other."""
    positions = splats.means.astype(np.float64)
    weight = np.maximum(seen.astype(np.float64), 1e-9)
    groups, aligned = _planes(splats, axes, ORIENTATION.neighbourhood * radius)

    def mean(values: np.ndarray, by: np.ndarray) -> np.ndarray:
        total = np.maximum(np.bincount(groups, by), 1e-12)
        return np.stack([np.bincount(groups, by * column) / total for column in values.T], 1)[groups]

    # Heights from above and from below tell a leaf from a wall: both faces of a leaf are the same Gaussians.
    axis = mean(aligned, weight)
    height = ((positions - mean(positions, weight)) * axis).sum(1)[:, None]
    # Of each Gaussian by itself: a sheet's are seen from above by some views and from below by others.
    sight = (aligned * towards).sum(1) / weight
    above, below = weight * (sight > 0), weight * (sight < 0)
    gap = np.abs(mean(height, above) - mean(height, below))[:, 0]
    width = mean(np.sort(splats.scales, 1)[:, 1:2].astype(np.float64), weight)[:, 0]
    share = mean((sight > 0)[:, None].astype(np.float64), weight)[:, 0]
    # Both conditions: nearly nothing seen from one side makes that side's mean height a matter of chance.
    sheet = (gap < ORIENTATION.max_sheet_gap * width) & (np.minimum(share, 1 - share) > ORIENTATION.min_side_share)
    common = (aligned * mean(towards / weight[:, None], weight)).sum(1)
    sign = (aligned * axes).sum(1)
    return np.where(sheet, sign * common, cosines), sheet
