"""The border of a hole: which Gaussians surround what was removed, or lie where a hole was circled; and from which side
it is looked at. Pure.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.kernels import portable
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import principal_axes, quat_to_matrix
from splatpainter.voxels.neighbours import components, nearest_within


@dataclass(frozen=True)
class BorderThresholds:
    """Which Gaussians border what was removed. Source: taste, tried on bodies removed from captures."""

    min_opacity: float = 0.05
    """Least opacity of a Gaussian that borders a hole."""
    min_gaussians: int = 12
    """Gaussians of a border."""
    cell_widths: float = 1 / 0.6
    """Distance between neighbours in widths sqrt(s0 s1) of Gaussians that cover a surface."""
    reach_cells: float = 2.5
    """Distance to what was removed up to which Gaussians border it, in cells."""
    max_growths: int = 4
    """Times that this distance doubles where there are too few of them."""
    link_cells: float = 3.0
    """Edge of the cubes in which the Gaussians of one border hang together, in cells."""
    max_borders: int = 8
    """Parts of a border that are looked at, the largest first: an object may touch several things."""
    min_border_share: float = 0.08
    """Gaussians of a part beside those of the largest one: smaller parts are crumbs."""
    min_aligned: float = 0.6
    """Share of the normals' second moment along one axis, from which that axis is the normal of a border; below, it is
    that along which the border extends least: around a stump normals point everywhere."""
    min_flatness: float = 0.2
    """Mean of 1 - shortest / middle axis, from which Gaussians have normals."""


BORDER = BorderThresholds()


@dataclass(frozen=True)
class Border:
    """One connected border."""

    gaussian_ids: Ids = field(repr=False)
    """[B] int64 ascending."""
    center: Floats
    """[3] float64 world."""
    radius: float
    """Within which it lies, world units."""
    normal: Floats
    """[3] float64 unit; either side may be the outer one."""
    across: Floats
    """[3] float64 unit, along the border's longest extent across the normal."""
    cell: float
    """Distance between neighbours, world units."""
    aligned: bool
    """Whether the normals of its Gaussians agree with `normal`."""


def borders_of(splats: Splats, remaining: np.ndarray, candidates: np.ndarray) -> list[Border]:
    """The connected parts, the largest first, of candidates ([N] bool) among what remains ([N] bool)."""
    ids = np.flatnonzero(candidates & remaining & splats.drawable & (splats.opacities >= BORDER.min_opacity))
    if len(ids) < BORDER.min_gaussians:
        return []
    cell = cell_of(splats, ids)
    # An object may have stood on several things: each connected part is a border by itself.
    labels = components(splats.means[ids], BORDER.link_cells * cell)
    counts = np.bincount(labels)
    order = np.argsort(-counts, kind="stable")[: BORDER.max_borders]
    least = max(BORDER.min_gaussians, BORDER.min_border_share * counts.max())
    parts = [ids[labels == label] for label in order if counts[label] >= least]
    return [_border(splats, part) for part in parts]


def bordering_gaussians(splats: Splats, remaining: np.ndarray, removed: np.ndarray) -> Bools:
    """[N] bool: what remains near to what was removed ([N] bool)."""
    out = np.zeros(len(splats), bool)
    gone, rest = np.flatnonzero(removed), np.flatnonzero(remaining & (splats.opacities >= BORDER.min_opacity))
    if not len(gone) or not len(rest):
        return out
    # Grow until there are neighbours: an object may have stood a little above its ground.
    radius = BORDER.reach_cells * cell_of(splats, gone)
    for _ in range(BORDER.max_growths):
        _, distance = nearest_within(splats.means[gone], splats.means[rest], radius)
        near = rest[np.isfinite(distance)]
        if len(near) >= BORDER.min_gaussians:
            # Neighbours may be coarser than what was removed, or finer.
            least = BORDER.reach_cells * min(cell_of(splats, near), 4 * radius / BORDER.reach_cells)
            if least > radius:
                _, distance = nearest_within(splats.means[gone], splats.means[rest], least)
                near = rest[np.isfinite(distance)]
            out[near] = True
            break
        radius *= 2
    return out


def cell_of(splats: Splats, ids: np.ndarray) -> float:
    """Distance between neighbours among some Gaussians, world units, by their median width."""
    scales = np.sort(splats.scales[ids].astype(np.float64), 1)
    return max(float(np.median(np.sqrt(scales[:, 1] * scales[:, 2]))) * BORDER.cell_widths, 1e-9)


def _border(splats: Splats, ids: np.ndarray) -> Border:
    means, scales = splats.means[ids].astype(np.float64), splats.scales[ids]
    axes = quat_to_matrix(splats.quats[ids].astype(np.float64))
    thin = axes[np.arange(len(ids)), :, scales.argmin(1)]
    # The middle of the box: the mean would lean to where the border is denser.
    center = (means.min(0) + means.max(0)) / 2
    offsets = means - means.mean(0)
    one = np.ones(len(ids))
    extents, directions = (of[0] for of in principal_axes(portable.gram(offsets, one)[None]))
    # Two candidates for the normal: what the Gaussians' own normals agree on, and the border's shortest extent.
    shares, normals = (of[0] for of in principal_axes(portable.gram(thin, one)[None] / len(ids)))
    ordered = np.sort(scales, 1)
    if float((1 - ordered[:, 0] / ordered[:, 1]).mean()) < BORDER.min_flatness:  # round ones have no normal
        aligned, normal = True, directions[:, 0]
    else:
        aligned = bool(shares[2] >= BORDER.min_aligned)
        normal = normals[:, 2] if aligned else directions[:, 0]
    across = directions[:, int(extents.argmax())]
    across = across - portable.dot(across, normal) * normal
    # A border without extent across the normal: any direction will do.
    if portable.length(across) < 1e-3:
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= portable.length(across)
    radius = float(np.linalg.norm(means - center, axis=1).max())
    return Border(ids, center, radius, normal, across, cell_of(splats, ids), aligned)
