"""Light that reaches each Gaussian: from environments by SH transfer, from suns and lamps by shadow maps of the asset.

All irradiance is over pi: an open white surface under white light of radiance 1 has 1. What is in the way is not black:
it shows a neighbour in the mean light.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lighting import blocked_light, point_spacing, unoccluded_transfer, visibility
from splatpainter.lights.facing import Facing, facing
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.stand_ins import STAND_INS
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass

BLOCKER_RADIANCE = 0.3
"""Radiance of what blocks a direction over the mean radiance around: its albedo (a half) times its share of light. 42
path traced tuning meshes under true lights, dB: black ones -0.02 +- 0.01 (fitted) and -0.06 +- 0.02 (coarse); ones that
are lit from where they face, by bands (one bounce), -0.01 +- 0.01 and -0.02 to -0.05, so that they are not."""
MIN_BLOCKER_ALPHA = 0.25
"""Fainter Gaussians cast no shadow."""
NORMAL_LIFT = 2.2 * 1.25
"""Spacings by which points are lifted off their surface, as in native/lighting.h: 2.2 pixels of 1.25 spacings."""
NEAR_SHARE = 0.05
"""Of the blockers that may stand closer to a lamp than the distance for which its shadow map is fine enough."""
MAX_MAP_PX = 900
"""Of a lamp's shadow map, per side."""


@dataclass(frozen=True)
class LitSurface:
    """What light needs to know of an asset; once per asset."""

    points: np.ndarray = field(repr=False)
    """[N, 3] float32 centres, relative to the offset; the origin for those that cannot be drawn."""
    facing: Facing
    blockers: np.ndarray = field(repr=False)
    """[M, 3] float32 centres of those that cast shadows."""
    spacing: float
    """Typical distance of neighbours among them, world units."""
    transfer: np.ndarray = field(repr=False)
    """[N, 9] float64 SH transfer over pi of both sides by their shares, with what is in the way."""
    closed: np.ndarray = field(repr=False)
    """[N] float64 0..1 share of the cosine-weighted hemisphere that is blocked."""
    shadows: bool
    pixel_transfer: np.ndarray = field(repr=False)
    """[S, 9] float64 SH transfer over pi of what `facing.surface_pixels` show, with what is in the way."""
    pixel_closed: np.ndarray = field(repr=False)
    """[S] float64 0..1 share of their hemispheres that is blocked."""

    @staticmethod
    def of(splats: Splats, shadows: bool = True, sides: Facing | None = None) -> LitSurface:
        """sides: which way Gaussians face; None: found by looking. Raises ValueError: nothing can be drawn."""
        sides = facing(splats) if sides is None else sides
        drawable = splats.drawable
        points = np.where(drawable[:, None], splats.means, 0).astype(np.float32)
        # Where all are faint they still stand in each other's way: then all cast shadows.
        solid = drawable & (splats.opacities >= MIN_BLOCKER_ALPHA)
        blockers = np.ascontiguousarray(points[solid if solid.any() else drawable])
        spacing = point_spacing(blockers)
        pixels = sides.surface_pixels
        where = pixels.points if pixels else np.zeros((0, 3), np.float32)
        towards = pixels.normals if pixels else where
        # Gaussians, or the few that stand for them, and pixels of the surface look into the same maps.
        few = sides.few
        lookers = (points, sides.normals) if few is None else (few.splats.means, few.normals(sides.normals))
        visible = None
        if shadows and len(blockers) > 1:
            both = np.concatenate([lookers[0], where]), np.concatenate([lookers[1], towards])
            visible = visibility(*both, spacing, blockers=blockers)
        transfer, closed = np.empty((len(points), 9)), np.zeros(len(points))

        signs = np.repeat(np.array([1, -1, 1], np.float32), (1, 3, 5))  # of SH on the other side, by bands

        def fold(first: int) -> None:
            rows = slice(first, min(first + STAND_INS.piece, len(points)))
            front = sides.front[rows].astype(np.float64)[:, None]
            # Both sides, by the share of each that is seen: a leaf takes light from behind.
            above = unoccluded_transfer(sides.normals[rows].astype(np.float64)) / np.pi
            below = above * signs
            if visible is not None:
                of = rows if few is None else few.of[rows]
                above = above - visible.blocked_front[of] / np.pi
                below = below - visible.blocked_back[of] / np.pi
                closed[rows] = 1 - (front[:, 0] * visible.front[of] + (1 - front[:, 0]) * visible.back[of])
            transfer[rows] = front * above + (1 - front) * below

        each(fold, range(0, len(points), STAND_INS.piece))
        pixel_transfer = (unoccluded_transfer(towards.astype(np.float64)) / np.pi).astype(np.float64)
        pixel_closed = np.zeros(len(where))
        if visible is not None:
            pixel_transfer -= visible.blocked_front[len(lookers[0]) :] / np.pi
            pixel_closed = 1 - visible.front[len(lookers[0]) :].astype(np.float64)
        return LitSurface(points, sides, blockers, spacing, transfer, closed, shadows, pixel_transfer, pixel_closed)

    def from_sky(self, coefficients: np.ndarray) -> np.ndarray:
        """[N, 3] float64 >= 0 under an environment with SH coefficients [9, 3], in the asset's axes."""
        # What is blocked is not black: it shows a neighbour, in the mean light.
        mean = np.maximum(coefficients[0] * SH_C0, 0)
        received = portable.matmul(self.transfer, coefficients)
        return np.maximum(received + (BLOCKER_RADIANCE * self.closed)[:, None] * mean, 0)

    def from_directions(self, towards: np.ndarray) -> np.ndarray:
        """[N] float64 0..1 irradiance of distant lights of weight 1 / K in K unit directions [K, 3] to them."""
        normals, share = self.facing.normals.astype(np.float64), self.facing.front.astype(np.float64)
        # Both sides are counted open first: shadow maps say what of either is blocked.
        cosines = portable.matmul(normals, towards.T) / len(towards)
        front, back = np.maximum(cosines, 0).sum(1), np.maximum(-cosines, 0).sum(1)
        if self.shadows and len(self.blockers) > 1:
            weights = np.full(len(towards), 1 / len(towards))
            shade = blocked_light(self.blockers, self.points, self.facing.normals, towards, weights, self.spacing)[
                2
            ].astype(np.float64)
            front, back = front - shade[:, 0], back - shade[:, 1]
        return np.maximum(share * front + (1 - share) * back, 0)

    def from_lamp(self, lamp: Lamp, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
        """[N] float64 irradiance of a lamp of intensity 1. offset: of the asset."""
        total = np.zeros(len(self.points))
        positions = lamp.points() - np.array(offset)
        normals, share = self.facing.normals.astype(np.float64), self.facing.front.astype(np.float64)
        # One after the other: each point of an area has a shadow of its own, and together they make it soft.
        for position in positions:
            line = position - self.points.astype(np.float64)
            distance = np.maximum(np.linalg.norm(line, axis=1), 1e-12)
            towards = line / distance[:, None]
            cosine = (towards * normals).sum(1)
            received = share * np.maximum(cosine, 0) + (1 - share) * np.maximum(-cosine, 0)
            near = max(lamp.radius, self.spacing)  # nearer than this it is no point any more
            received = received * lamp.emission(-towards) / np.maximum(distance, near) ** 2
            if self.shadows:
                received = received * (1 - self._hidden_from(position, cosine))
            total += received / len(positions)
        return total

    def _hidden_from(self, position: np.ndarray, cosines: np.ndarray) -> np.ndarray:
        """[N] float64 0..1: how far each point is hidden from a place. One perspective shadow map, or six where the
        place lies in the asset's midst."""
        blockers = self.blockers.astype(np.float64) - position
        points = self.points.astype(np.float64) - position
        # Lifted on the side that faces the lamp, or a surface would shade itself.
        lift = np.where(cosines < 0, -1.0, 1.0)[:, None] * self.facing.normals.astype(np.float64)
        middle = (self.blockers.min(0) + self.blockers.max(0)).astype(np.float64) / 2 - position
        radius = portable.length(np.ptp(self.blockers, axis=0).astype(np.float64)) / 2
        hidden = np.zeros(len(points))
        # From far off one map holds the asset; from its midst no single frustum does.
        if portable.length(middle) > 1.2 * radius:
            axes = [middle / portable.length(middle)]
        else:
            axes = [sign * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
        for axis in axes:
            side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
            side = side / portable.length(side)
            frame = np.stack([side, np.cross(axis, side), axis], 1)
            seen, standing = portable.matmul(points, frame), portable.matmul(blockers, frame)
            # Six faces meet at 45 degrees; blockers a little beyond belong to both.
            limit = 1.0 if len(axes) > 1 else 4.0
            ahead = (standing[:, 2] > 1e-9) & (np.abs(standing[:, :2]).max(1) <= 1.1 * limit * standing[:, 2])
            inside = (seen[:, 2] > 1e-9) & (np.abs(seen[:, :2]).max(1) <= limit * seen[:, 2])
            if not ahead.any() or not inside.any():
                continue
            # The pixel follows the blockers, but a few right at the lamp must not make the map endless.
            standing, near = standing[ahead], float(np.quantile(standing[ahead, 2], NEAR_SHARE))
            width = float(np.ptp(standing[:, :2] / standing[:, 2:], axis=0).max())
            spacing = max(self.spacing / near, width / MAX_MAP_PX)
            lifted = NORMAL_LIFT * spacing * seen[inside, 2:]
            raised = seen[inside] + lifted * portable.matmul(lift[inside], frame)
            raised[:, 2] = np.maximum(raised[:, 2], 1e-9)
            towards = np.array([[0.0, 0.0, 1.0]])
            facing_place = np.broadcast_to(np.array([0, 0, 1], np.float32), (len(raised), 3))
            receivers = _warped(raised, near)
            receivers[:, 2] -= np.float32(NORMAL_LIFT * spacing)  # which the map adds, along the line of sight
            shade = blocked_light(_warped(standing, near), receivers, facing_place, towards, np.ones(1), spacing)[2]
            hidden[inside] = np.maximum(hidden[inside], np.clip(shade[:, 0], 0, 1))
        return hidden


def _warped(seen: np.ndarray, near: float) -> np.ndarray:
    """Camera coordinates [M, 3] with lines from the eye made parallel: slopes, and the logarithm of depth, towards the
    eye, so that a pixel is as deep as it is wide everywhere."""
    depth = portable.log(seen[:, 2:] / near)
    return np.concatenate([seen[:, :2] / seen[:, 2:], -depth], 1).astype(np.float32)


def sun_light(surface: LitSurface, sun: Sun, axes: np.ndarray) -> np.ndarray:
    """[N] float64 irradiance of a sun of intensity 1. axes: [3, 3] from the asset's axes to the lights' (y up)."""
    return surface.from_directions(portable.matmul(sun.directions(), axes))
