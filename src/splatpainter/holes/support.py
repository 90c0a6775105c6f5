"""What a selected thing stands on: a plane that its outline crosses and that goes on all around its foot. Pure."""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.kernels import portable
from splatpainter.order_statistics import distinct
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class SupportThresholds:
    """When a plane is what something stands on. Measured by scripts/removal_survey.py."""

    candidates: int = 128
    """Pieces on the outline whose planes are tried, at most."""
    min_outline: int = 12
    """Pieces that the outline of a selection crosses, at least."""
    min_outline_share: float = 0.08
    """Share of these that lie on the plane, at least."""
    min_cosine_squared: float = 0.5
    """Mean squared cosine between a piece's normals and the plane's from which it is of it."""
    foot: float = 4.0
    """Height above the plane up to which a thing is its foot, in tolerances."""
    directions: int = 16
    """Directions around the foot."""
    min_direction_share: float = 0.6
    """Share of them in which the plane goes on, at least: the face of a box ends where its other faces begin."""
    min_standing_share: float = 0.1
    """Share of what is selected that is not of the plane, at least: a spot on a wall stands on nothing."""
    min_side_share: float = 0.6
    """Share of that on one side of the plane, at least."""
    power_rounds: int = 12
    """Rounds of the power iteration for a mean normal."""


SUPPORT = SupportThresholds()


@dataclass(frozen=True)
class Ground:
    """The plane on which a thing stands, among P pieces of surface."""

    pieces: Bools
    """[P] bool: those of it."""
    at_height: Bools
    """[P] bool: all at its height, whichever way they face."""
    normal: np.ndarray
    """[3] unit; zeros where there is none."""


def support_of(
    middles: np.ndarray,
    normals: np.ndarray,
    chosen: Bools,
    edges: tuple[np.ndarray, np.ndarray],
    tolerance: float,
) -> Ground:
    """The plane on which what is chosen ([P] bool) stands, without pieces where there is none. middles, normals: [P, 3]
    and [P, 6] as of _Pieces, of pieces of surface; edges: pairs of them that touch; tolerance: world units."""
    nothing = np.zeros(len(middles), bool)
    none = Ground(nothing, nothing, np.zeros(3))
    one, two = edges
    crossing = chosen[one] != chosen[two]
    outline = distinct(np.concatenate([one[crossing], two[crossing]]))
    if len(outline) < SUPPORT.min_outline:
        return none
    # The plane on which most of the outline lies.
    step = -(-len(outline) // SUPPORT.candidates)
    best, most = nothing, 0
    for piece in outline[::step].tolist():
        members = _members(middles, normals, middles[piece], _direction(normals[piece]), tolerance)
        count = int(members[outline].sum())
        if count > most:
            best, most = members, count
    if most < SUPPORT.min_outline_share * len(outline):
        return none
    normal = _direction(normals[best].mean(0))
    middle = middles[best] - middles[best][0]
    origin = middles[best][0] + float(np.median((middle * normal).sum(1))) * normal
    members = _members(middles, normals, origin, normal, tolerance)
    # Something stands on it, on one side, and it goes on all around the foot of that.
    heights = ((middles - origin) * normal).sum(1)
    standing = chosen & ~members
    if standing.sum() < SUPPORT.min_standing_share * chosen.sum() or not members.any():
        return none
    above = float((heights[standing] > 0).mean())
    if max(above, 1 - above) < SUPPORT.min_side_share:
        return none
    foot = standing & (np.abs(heights) < SUPPORT.foot * tolerance)
    if not foot.any():
        return none
    # The foot's middle is the origin of the plane.
    x, y = _flat(middles, normal)
    x, y = x - float(np.median(x[foot])), y - float(np.median(y[foot]))
    turns = portable.arctan2(y, x) / (2 * np.pi) * SUPPORT.directions
    direction = np.floor(turns).astype(np.int64) % SUPPORT.directions
    away = np.sqrt(x * x + y * y)
    farthest = np.zeros((2, SUPPORT.directions))
    for which, of in enumerate((foot, members)):
        np.maximum.at(farthest[which], direction[of], away[of])
    goes_on = farthest[1] > farthest[0] + tolerance
    if goes_on.mean() < SUPPORT.min_direction_share:
        return none
    return Ground(members, np.abs(heights) < tolerance, normal)


def below(middles: np.ndarray, body: Bools, normal: np.ndarray, edge: float) -> Bools:
    """[P] bool: pieces (middles [P, 3]) under or over a body ([P] bool), along a normal ([3]). edge: of the squares in
    which that is judged, world units."""
    if not normal.any() or not body.any():
        return np.zeros(len(middles), bool)
    x, y = (np.floor((axis - axis.min()) / edge).astype(np.int64) for axis in _flat(middles, normal))
    squares = x * (int(y.max()) + 1) + y
    return np.isin(squares, squares[body])


def _flat(middles: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([P], [P]) coordinates in a plane."""
    across = np.eye(3)[int(np.abs(normal).argmin())]
    first = np.cross(normal, across)
    first = first / np.sqrt((first * first).sum())
    second = np.cross(normal, first)
    return (middles * first).sum(1), (middles * second).sum(1)


def _members(
    middles: np.ndarray, normals: np.ndarray, origin: np.ndarray, normal: np.ndarray, tolerance: float
) -> Bools:
    """[P] bool: pieces near a plane that face as it does."""
    x, y, z = normal
    root = np.sqrt(2)
    outer = np.array([x * x, y * y, z * z, root * x * y, root * x * z, root * y * z])
    near = np.abs(((middles - origin) * normal).sum(1)) < tolerance
    return near & ((normals * outer).sum(1) > SUPPORT.min_cosine_squared)


def _direction(outer: np.ndarray) -> np.ndarray:
    """[3] unit: the direction that a mean of n n^T ([6]) has most of, by power iteration."""
    xx, yy, zz = outer[:3]
    xy, xz, yz = outer[3:] / np.sqrt(2)
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    vector = matrix[int(outer[:3].argmax())]
    for _ in range(SUPPORT.power_rounds):
        vector = (matrix * vector).sum(1)
        vector = vector / max(float(np.sqrt((vector * vector).sum())), 1e-30)
    return vector
