"""Which directions each point of a surface can see: shadow maps from many directions, folded into SH transfer.

Precomputed radiance transfer (Sloan, Kautz, Snyder 2002) with distant light: irradiance E = sum_k t_k L_k where
t_k = integral of V(d) Y_k(d) max(n . d, 0). What is open has a closed form; only what is blocked is summed over
directions, so that convex objects carry no sampling error.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, sh_basis

COSINE_BANDS = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
"""[9] what the clamped cosine does to each SH coefficient (Ramamoorthi and Hanrahan 2001)."""


@dataclass(frozen=True)
class Visibility:
    """What N points see above (front) and below (back) their surface."""

    front: np.ndarray
    """[N] float32 0..1: open share of the cosine-weighted hemisphere around the normal."""
    back: np.ndarray
    """[N] the same around the opposite of the normal."""
    blocked_front: np.ndarray
    """[N, 9] float32: the part of the transfer that is lost to what is in the way."""
    blocked_back: np.ndarray
    """[N, 9]."""


def unoccluded_transfer(normals: np.ndarray) -> np.ndarray:
    """[N, 9] float32 transfer of points that see their whole hemisphere."""
    return (sh_basis(normals, 2) * COSINE_BANDS).astype(np.float32)


SPACING_SAMPLES = 256
"""Points of which the distance to their neighbours is measured."""
SPACING_NEIGHBOR = 5
"""The neighbour whose distance counts."""


def prt_transfer(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N, 10] float32 of Gaussians that stand for a surface: transfer over pi, so that an open one under uniform light
    has 1 / C0 in the first column and 0 in the others, and the open share 0..1 of its hemisphere. points: [N, 3]
    centres; normals: [N, 3] unit, outwards; those with a zero normal (not drawable) count for nothing and get zeros."""
    has_normal = np.abs(normals).max(1, initial=0) > 0
    out = np.zeros((len(points), 10), np.float32)
    if not has_normal.any():
        return out
    # Gaussians that are not drawn neither see nor hide anything.
    points = np.ascontiguousarray(points[has_normal], np.float32)
    normals = np.ascontiguousarray(normals[has_normal], np.float32)
    visible = visibility(points, normals, point_spacing(points))
    out[has_normal, :9] = (unoccluded_transfer(normals) - visible.blocked_front) / np.pi
    out[has_normal, 9] = visible.front
    return out


def point_spacing(points: np.ndarray) -> float:
    """A little less than the distance of a point to its SPACING_NEIGHBOR-th neighbour: closed for the shadow maps."""
    # A sample, as the median of a few hundred is as good as that of all.
    picks = np.linspace(0, len(points) - 1, min(SPACING_SAMPLES, len(points))).astype(np.int64)
    squares = np.empty(len(picks))
    near = min(SPACING_NEIGHBOR, len(points) - 1)
    run(kernels.measure_neighbour_squares, np.ascontiguousarray(points, np.float32), picks, near, squares)
    span = portable.length(np.ptp(points, axis=0))
    return max(0.8 * float(np.sqrt(np.median(squares))), 1e-6 * span, 1e-12)


def visibility(
    points: np.ndarray,
    normals: np.ndarray,
    spacing: float,
    directions: int = 48,
    blockers: np.ndarray | None = None,
) -> Visibility:
    """What each point [N, 3] of a surface sees past all the others, which stand for the surface: typical distance
    `spacing`. normals [N, 3]: geometric, unit. blockers: [M, 3] points that stand for it instead. One shadow map per
    direction; detail below 3 * spacing is not seen."""
    towards = fibonacci_sphere(directions)
    weights = np.full(directions, 4 * np.pi / directions)
    blockers = points if blockers is None else blockers
    lost_front, lost_back, shade = blocked_light(blockers, points, normals, towards, weights, spacing)
    open_share = np.clip(1 - shade / np.pi, 0, 1)
    return Visibility(open_share[:, 0], open_share[:, 1], lost_front, lost_back)


def blocked_light(
    blockers: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    towards: np.ndarray,
    weights: np.ndarray,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What points [N, 3] lose of distant light to blockers [M, 3], which stand for a surface of typical distance
    `spacing`: (lost_front, lost_back [N, 9] float32 SH transfer around their normals [N, 3] and the opposites, shade
    [N, 2] the same as sums of weight times cosine). towards: [K, 3] float64 unit directions to the light; weights: [K]
    float64 their solid angles, or their irradiances. One shadow map per direction."""
    count = len(towards)
    towards = towards.astype(np.float32)
    # What a blocked direction takes from each coefficient: kernels then only add.
    folded = (sh_basis(towards.astype(np.float64), 2) * weights[:, None]).astype(np.float32)
    # Two axes across each direction, for the pixels of its map.
    helper = np.where(np.abs(towards[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, towards)
    side = (side / np.linalg.norm(side, axis=1, keepdims=True)).astype(np.float32)
    other = np.cross(towards, side).astype(np.float32)
    span = portable.length(np.ptp(blockers, axis=0))
    if not np.isfinite(span):
        raise ValueError("visibility: expected finite points whose squares are finite in float32, got others")
    # As coarse as the points are apart, or light would fall through between them.
    pixel = np.float32(max(1.25 * spacing, span / 900))  # a map of at most 900 pixels a side
    center = ((blockers.min(0) + blockers.max(0)) / 2).astype(np.float32)
    size = int(np.ceil(span / pixel)) + 8
    lost_front = np.zeros((len(points), 9), np.float32)
    lost_back = np.zeros((len(points), 9), np.float32)
    shade = np.zeros((len(points), 2), np.float32)
    standing = np.ascontiguousarray(blockers - center, np.float32)
    moved = standing if points is blockers else np.ascontiguousarray(points - center, np.float32)
    normals = np.ascontiguousarray(normals, np.float32)
    sums = (folded, np.ascontiguousarray(weights, np.float32), lost_front, lost_back, shade)
    frames = (*(np.ascontiguousarray(axis, np.float32) for axis in (towards, side, other)), float(pixel))
    # A map for each thread, 3 MB at most: more would fall out of the CPU's caches before they are looked into.
    depth = np.empty((min(threads(), count), size, size), np.float32)
    for first in range(0, count, len(depth)):
        run(kernels.draw_shadow_maps, standing, *frames, first, depth)
        run(kernels.fold_shadows, moved, normals, *frames, first, depth, *sums)
    return lost_front, lost_back, shade
