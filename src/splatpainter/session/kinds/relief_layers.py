"""Copies of Gaussians with their relief: what lies in a disc of one surface is laid on another place of the asset.

A pure function of the Gaussians below it: those of the source disc are copied (turned with the surface, view dependence
too) and those of the target disc fade under them; both by the same soft edge. Hidden, it brings everything back bit for
bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from splatpainter.io.axes import move
from splatpainter.kernels import portable
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork
from splatpainter.session.replay.delta import Delta, between
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

MAX_COPIED = 500_000
"""Gaussians of one copy."""
EDGE_SHARE = 0.25
"""Share of the radius over which the copy and what is under it fade."""
DEPTH_SHARE = 0.6
"""Share of the radius how deep below the surface Gaussians are copied and fade: what lies behind a thin wall stays."""
HEIGHT_SHARE = 1.0
"""Share of the radius how high above it, with an edge as soft as that of the disc."""


@dataclass(frozen=True)
class CopyAnchor:
    """A point of the surface and its axes."""

    point: np.ndarray
    """[3] world."""
    axes: np.ndarray
    """[3, 3] rotation whose columns are two tangents and the outward normal."""

    @staticmethod
    def of(point: np.ndarray, normal: np.ndarray, along: np.ndarray) -> CopyAnchor:
        """along: [3] the first tangent, as far as it is one."""
        up = np.asarray(normal, float) / portable.length(np.asarray(normal, float))
        # Where the first tangent stands on the surface any other does: the copy still needs axes.
        side = along - portable.dot(along, up) * up
        if portable.length(side) < 1e-6 * portable.length(along):
            side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        side = side / portable.length(side)
        return CopyAnchor(np.asarray(point, float), np.stack([side, np.cross(up, side), up], 1))

    def local(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] along the tangents and above the surface."""
        return portable.matmul(points.astype(np.float64) - self.point, self.axes)

    def record(self) -> dict[str, Any]:
        return {"point": self.point.tolist(), "axes": self.axes.tolist()}

    @staticmethod
    def parse(data: Any) -> CopyAnchor:
        """Parse a point and axes. Raises ValueError."""
        try:
            point, axes = np.array(data["point"], np.float64), np.array(data["axes"], np.float64)
        except (TypeError, ValueError, KeyError, OverflowError):
            raise ValueError(f"copy: expected a point and axes, got {brief(data)}") from None
        # No mirror image and no stretch: the copy's quaternions could not follow.
        turned = point.shape == (3,) and axes.shape == (3, 3) and np.isfinite(point).all() and np.isfinite(axes).all()
        if not turned or np.abs(portable.matmul(axes, axes.T) - np.eye(3)).max() > 1e-6 or _is_mirrored(axes):
            raise ValueError("copy: expected a finite point [3] and a rotation [3, 3] as axes")
        return CopyAnchor(point, axes)


def _is_mirrored(axes: np.ndarray) -> bool:
    return portable.dot(np.cross(axes[:, 0], axes[:, 1]), axes[:, 2]) < 0


ORIGIN = CopyAnchor(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class ReliefLayer(LayerOperation):
    """One copy. Raises ValueError where the radius is none."""

    kind: ClassVar[str] = "relief"
    lays_paint: ClassVar[bool] = True

    source: CopyAnchor = ORIGIN
    target: CopyAnchor = ORIGIN
    radius: float = 1.0
    """Radius of both discs, world units."""

    def check(self) -> None:
        if not 0 < self.radius < 1e18:
            raise ValueError(f"copy: expected a radius above 0, got {self.radius}")

    def record(self) -> dict[str, Any]:
        return {"kind": self.kind, **self.changes()}

    def changes(self) -> dict[str, Any]:
        return {"source": self.source.record(), "target": self.target.record(), "radius": self.radius}

    @classmethod
    def build(cls, kind: str, options: Mapping[str, Any], where: str) -> LayerOperation:
        if set(options) != {"source", "target", "radius"} or type(options["radius"]) not in (int, float):
            raise ValueError(f"{where}: copy: expected source, target and radius, got {brief(dict(options))}")
        try:
            source, target = (CopyAnchor.parse(options[name]) for name in ("source", "target"))
            return cls(source, target, float(options["radius"]))
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{where}: {error}") from None

    def result(self, work: LayerWork) -> LayerResult:
        return LayerResult(self.delta(work.splats))

    def weights(self, anchor: CopyAnchor, splats: Splats) -> np.ndarray:
        """[N] float64 how much of each Gaussian is in the disc, 0..1."""
        # Far away, as positions that are not finite must not reach the distances.
        local = anchor.local(np.where(splats.drawable[:, None], splats.means, 1e30))
        with np.errstate(over="ignore"):
            distance = portable.hypot(local[:, 0], local[:, 1]) / self.radius
        height = local[:, 2] / self.radius
        # What lies behind a thin wall stays: the copy is of the surface that was pointed at.
        soft = np.clip((1 - distance) / EDGE_SHARE, 0, 1)
        below_top = np.clip((HEIGHT_SHARE - height) / EDGE_SHARE, 0, 1)
        return np.where(height > -DEPTH_SHARE, soft * below_top, 0.0)

    def delta(self, splats: Splats) -> Delta:
        """What it does to `splats` (numpy). Raises ValueError: nothing to copy there, too much."""
        weights = self.weights(self.source, splats)
        parent_ids = np.flatnonzero((weights > 0) & (splats.opacities > 0))
        if not len(parent_ids):
            raise ValueError("copy: there is nothing within the brush at the source; choose another, or a larger brush")
        if len(parent_ids) > MAX_COPIED:
            many = f"{MAX_COPIED:,} Gaussians, got {len(parent_ids):,}"
            raise ValueError(f"copy: expected at most {many}; use a smaller brush")
        # The copy appears by the same edge by which what lies there fades, so that together they cover once.
        copies = self.copied(splats.take(parent_ids), weights[parent_ids])
        rest = 1 - self.weights(self.target, splats)
        faded = (splats.opacities * rest).astype(np.float32)
        under = replace(splats, opacities=np.where(rest < 1, faded, splats.opacities), origin=None)
        return between(splats, under.append(replace(copies, source=None, origin=None)), parent_ids)

    def copied(self, splats: Splats, weights: np.ndarray) -> Splats:
        """[M] Gaussians at the target, their opacities times weights [M]."""
        turn = portable.matmul(self.target.axes, self.source.axes.T)
        moved = move(splats, turn, shift=self.target.point - portable.matmul(self.source.point, turn.T))
        return replace(moved, opacities=(splats.opacities * weights).astype(np.float32))
