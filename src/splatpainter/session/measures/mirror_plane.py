"""The plane in which an asset is most nearly its own mirror image, and views as that mirror shows them. Pure.

The asset is thinned to points that lie evenly. Planes through their middle, in many directions, are scored by how near
each mirrored point comes to a point; the best are refined by matching mirrored points to their nearest ones, for which
the best plane is a smallest eigenvector. The same asset has the same plane.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.portable import cos, dot, length, matmul, sin, symmetric_axes
from splatpainter.order_statistics import groups, row_keys
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MAX_POINTS = 700
"""Points that the asset is thinned to, about."""
TRIED_DIRECTIONS = 48
"""Planes that are tried first, beside those of the axes and of the principal axes."""
REFINED_PLANES = 4
"""How many of the best of these are refined."""
REFINEMENT_STEPS = 8
"""Steps of that refinement."""
MAX_PARTNER_SPACINGS = 2.5
"""Distance in spacings of the points from which a mirrored point counts as having no partner."""
UPRIGHT_BONUS = 0.06
"""Bonus on the score (0..1): planes that contain the up axis win where others are hardly better."""
MIN_OPACITY = 0.3
"""Fainter Gaussians are not the asset's shape."""


@dataclass(frozen=True)
class MirrorPlane:
    """Points x with normal x = offset."""

    normal: tuple[float, float, float]
    """Unit, world axes."""
    offset: float
    """World units."""
    agreement: float = 1.0
    """Agreement of the asset with its mirror image: 1 where every mirrored point meets one, 0 where none does."""

    def mirrored(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] points on the other side."""
        normal = np.asarray(self.normal)
        return points - 2 * (matmul(points, normal) - self.offset)[..., None] * normal


def parsed_plane(normal: tuple[float, float, float] | list[float], offset: float) -> MirrorPlane:
    """Raises ValueError: no direction, not finite."""
    vector = np.asarray(normal, float)
    valid = vector.shape == (3,) and 1e-9 < float(np.abs(vector).max()) < 1e9
    if not (valid and np.isfinite(offset)):
        raise ValueError("mirror: expected a normal of three numbers, not all 0, and a finite offset")
    x, y, z = (float(value) for value in vector / length(vector))
    return MirrorPlane((x, y, z), float(offset) / length(vector))


def mirrored_camera(camera: Camera, plane: MirrorPlane) -> Camera:
    """The camera on the other side of the plane: of an asset that is its own mirror image it shows the same picture,
    left and right exchanged."""
    normal = np.asarray(plane.normal)
    reflection = np.eye(3) - 2 * np.outer(normal, normal)
    rotation = matmul(camera.world_to_camera[:3, :3], reflection) * np.array([[-1.0], [1.0], [1.0]])
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = -matmul(rotation, plane.mirrored(camera.position))
    return replace(camera, cx=camera.width - camera.cx, world_to_camera=world_to_camera)


def find_mirror_plane(splats: Splats, up: tuple[float, float, float]) -> MirrorPlane:
    """The best plane. up: axis that upright planes contain. Raises ValueError where there are too few Gaussians."""
    points, spacing = _thinned(splats)
    middle = points.mean(0)
    # Axes and principal axes are tried as well: an asset that is symmetric often stands along one of them.
    principal = symmetric_axes(matmul((points - middle).T, points - middle))[1].T
    directions = np.concatenate([np.eye(3), principal, _hemisphere(TRIED_DIRECTIONS)])
    upward = np.asarray(up, float)

    def cost(normal: np.ndarray, offset: float) -> float:
        mirrored = points - 2 * (matmul(points, normal) - offset)[:, None] * normal
        return float(np.minimum(_nearest(mirrored, points)[1] / (MAX_PARTNER_SPACINGS * spacing), 1).mean())

    def ranked(normal: np.ndarray, offset: float) -> float:
        return cost(normal, offset) + UPRIGHT_BONUS * abs(dot(normal, upward))

    first = sorted(((ranked(n, dot(n, middle)), k) for k, n in enumerate(directions)))
    best: tuple[float, np.ndarray, float] | None = None
    # Several are refined, as the best of the coarse ones need not lead to the best.
    for _, k in first[:REFINED_PLANES]:
        normal, offset = directions[k], dot(directions[k], middle)
        score = ranked(normal, offset)
        for _ in range(REFINEMENT_STEPS):
            finer = _refined(points, normal, offset, MAX_PARTNER_SPACINGS * spacing)
            finer_score = np.inf if finer is None else ranked(*finer)
            if finer is None or finer_score >= score:
                break
            (normal, offset), score = finer, finer_score
        if best is None or score < best[0]:
            best = score, normal, offset
    assert best is not None
    _, normal, offset = best
    # One of both normals of a plane, always the same: a plane that is found again is equal.
    if normal[np.abs(normal).argmax()] < 0:
        normal, offset = -normal, -offset
    x, y, z = (float(value) for value in normal)
    return MirrorPlane((x, y, z), float(offset), max(0.0, 1 - cost(normal, offset)))


def _thinned(splats: Splats) -> tuple[np.ndarray, float]:
    """([P, 3] float64 middles of the cells that opaque Gaussians lie in, the cells' size)."""
    solid = splats.drawable & (splats.opacities >= MIN_OPACITY)
    means = splats.means[solid].astype(np.float64)
    if len(means) < 8:
        raise ValueError("mirror: expected an asset of 8 opaque Gaussians or more")
    # Strays would set the size of the cells, and leave the asset in few of them.
    low, high = np.quantile(means, 0.005, 0), np.quantile(means, 0.995, 0)
    means = means[((means >= low) & (means <= high)).all(1)]
    size = max(float((high - low).max()), 1e-12) / 64
    while True:
        cells = np.floor((means - low) / size).astype(np.int64)
        _, group, count = groups(row_keys(cells))
        if len(count) <= MAX_POINTS:
            sums = [np.bincount(group, means[:, axis]) for axis in range(3)]
            return np.stack(sums, 1) / count[:, None], size
        size *= 1.15


def _hemisphere(count: int) -> np.ndarray:
    """[count, 3] unit directions, even over half a sphere: a Fibonacci spiral."""
    k = np.arange(count)
    height = (k + 0.5) / count
    angle = k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * cos(angle), ring * sin(angle), height], 1)


def _nearest(queries: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([Q] int64 nearest point, [Q] its distance)."""
    squares = (queries**2).sum(1)[:, None] + (points**2).sum(1)[None] - 2 * matmul(queries, points.T)
    index = squares.argmin(1)
    return index, np.linalg.norm(queries - points[index], axis=1)


def _refined(points: np.ndarray, normal: np.ndarray, offset: float, reach: float) -> tuple[np.ndarray, float] | None:
    """The plane that brings points nearest to the partners that they have now; None: too few have one."""
    mirrored = points - 2 * (matmul(points, normal) - offset)[:, None] * normal
    index, distance = _nearest(mirrored, points)
    # Points without a partner (a handle on one side) would pull the plane towards them.
    paired = distance < reach
    if paired.sum() < 8:
        return None
    ours, theirs = points[paired], points[index[paired]]
    first, second = ours - ours.mean(0), theirs - theirs.mean(0)
    products = matmul(first.T, second)
    finer = symmetric_axes(products + products.T)[1][:, 0]
    return finer, dot(finer, ours.mean(0) + theirs.mean(0)) / 2
