"""Which directions each point of a surface can see: shadow maps from many directions, folded into SH transfer.

Precomputed radiance transfer (Sloan, Kautz, Snyder 2002) with distant light: irradiance E = sum_k t_k L_k where
t_k = integral of V(d) Y_k(d) max(n . d, 0). What is open has a closed form; only what is blocked is summed over
directions, so that convex objects carry no sampling error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

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
    points = np.ascontiguousarray(points[has_normal], np.float32)
    normals = np.ascontiguousarray(normals[has_normal], np.float32)
    visible = visibility(points, normals, _spacing(points))
    out[has_normal, :9] = (unoccluded_transfer(normals) - visible.blocked_front) / np.pi
    out[has_normal, 9] = visible.front
    return out


def _spacing(points: np.ndarray) -> float:
    """A little less than the distance of a point to its SPACING_NEIGHBOR-th neighbour: closed for the shadow maps."""
    picks = np.linspace(0, len(points) - 1, min(SPACING_SAMPLES, len(points))).astype(np.int64)
    samples, squares = points[picks].astype(np.float64), (points.astype(np.float64) ** 2).sum(1)
    near = min(SPACING_NEIGHBOR, len(points) - 1)
    apart = [np.partition(squares - 2 * points @ one + one @ one, near)[near] for one in samples]
    span = float(np.linalg.norm(np.ptp(points, axis=0)))
    return max(0.8 * float(np.sqrt(max(np.median(apart), 0.0))), 1e-6 * span, 1e-12)


def visibility(points: np.ndarray, normals: np.ndarray, spacing: float, directions: int = 48) -> Visibility:
    """What each point [N, 3] of a surface sees past all the others, which stand for the surface: typical distance
    `spacing`. normals [N, 3]: geometric, unit. One shadow map per direction; detail below 3 * spacing is not seen."""
    towards = fibonacci_sphere(directions).astype(np.float32)
    helper = np.where(np.abs(towards[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, towards)
    side = (side / np.linalg.norm(side, axis=1, keepdims=True)).astype(np.float32)
    other = np.cross(towards, side).astype(np.float32)
    span = float(np.linalg.norm(np.ptp(points, axis=0)))
    if not np.isfinite(span):
        raise ValueError("visibility: expected finite points whose squares are finite in float32, got others")
    pixel = np.float32(max(1.25 * spacing, span / 900))  # a map of at most 900 pixels a side
    center = ((points.min(0) + points.max(0)) / 2).astype(np.float32)
    size = int(np.ceil(span / pixel)) + 8
    folded = (sh_basis(towards.astype(np.float64), 2) * (4 * np.pi / directions)).astype(np.float32)
    lost_front = np.zeros((len(points), 9), np.float32)
    lost_back = np.zeros((len(points), 9), np.float32)
    shade = np.zeros((len(points), 2), np.float32)
    weights = np.full(directions, 4 * np.pi / directions, np.float32)
    moved = np.ascontiguousarray(points - center, np.float32)
    _march(moved, normals, towards, side, other, pixel, size, folded, weights, lost_front, lost_back, shade)
    open_share = np.clip(1 - shade / np.pi, 0, 1)
    return Visibility(open_share[:, 0], open_share[:, 1], lost_front, lost_back)


def warm() -> None:
    """Compile (or load) the kernel of this module."""
    points = np.eye(3, dtype=np.float32)
    prt_transfer(points, points)


@njit(nogil=True, cache=True, error_model="numpy")
def _inside(x, last):
    """int(x) within [0, last], 0 for NaN. Clamped as a float: casts of what an integer cannot hold are undefined."""
    x = x if x > 0 else np.float32(0)
    return int(x if x < last else np.float32(last))


@njit(nogil=True, cache=True, error_model="numpy")
def _march(points, normals, towards, side, other, pixel, size, folded, weights, lost_front, lost_back, shade):
    """Adds to lost_front, lost_back [N, 9] and shade [N, 2] (cosine-weighted) what is blocked."""
    depth = np.empty((size, size), np.float32)
    half = np.float32(size / 2)
    lift = np.float32(2.2) * pixel
    bias = np.float32(0.3) * pixel
    for k in range(len(towards)):
        d, a, b = towards[k], side[k], other[k]
        depth[:] = np.float32(-1e30)
        for i in range(len(points)):
            p = points[i]
            u = (p[0] * a[0] + p[1] * a[1] + p[2] * a[2]) / pixel + half - np.float32(0.5)
            v = (p[0] * b[0] + p[1] * b[1] + p[2] * b[2]) / pixel + half - np.float32(0.5)
            t = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
            x, y = _inside(u, size - 2), _inside(v, size - 2)
            for ix in range(x, x + 2):  # two by two pixels: no light through the gaps between points
                for iy in range(y, y + 2):
                    if t > depth[ix, iy]:
                        depth[ix, iy] = t
        for i in range(len(points)):
            p, n = points[i], normals[i]
            cosine = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
            sign = np.float32(1) if cosine >= 0 else np.float32(-1)
            off = sign * lift
            px, py, pz = p[0] + off * n[0], p[1] + off * n[1], p[2] + off * n[2]
            u = (px * a[0] + py * a[1] + pz * a[2]) / pixel + half - np.float32(0.5)
            v = (px * b[0] + py * b[1] + pz * b[2]) / pixel + half - np.float32(0.5)
            t = px * d[0] + py * d[1] + pz * d[2] + bias
            if not (-1 < u < size - 1 and -1 < v < size - 1):  # NaN too
                continue
            x, y = int(u), int(v)
            fu, fv = u - x, v - y
            hidden = np.float32(0)
            if depth[x, y] > t:
                hidden += (1 - fu) * (1 - fv)
            if depth[x + 1, y] > t:
                hidden += fu * (1 - fv)
            if depth[x, y + 1] > t:
                hidden += (1 - fu) * fv
            if depth[x + 1, y + 1] > t:
                hidden += fu * fv
            if hidden > 0:
                lost = hidden * abs(cosine)
                if cosine >= 0:
                    shade[i, 0] += lost * weights[k]
                    for c in range(9):
                        lost_front[i, c] += lost * folded[k, c]
                else:
                    shade[i, 1] += lost * weights[k]
                    for c in range(9):
                        lost_back[i, c] += lost * folded[k, c]
