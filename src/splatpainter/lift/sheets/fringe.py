"""The fringe of a sheet: painted pixels beside it that show a surface, but too little of it to be trusted.

At the outline of an object, and in cracks between its Gaussians, a pixel's own surface cannot be estimated; that of the
nearest covered pixel goes on there for a pixel or two.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import copied, filled, set_pixels
from splatpainter.lift.masks import dilated
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.surface.visible import PixelSurface, VisibleSurface
from splatpainter.system.quick_dataclass import dataclass

INT64 = np.dtype(np.int64)


@dataclass(frozen=True)
class FringeThresholds:
    """The strip of an outline that shows too little of a surface to be trusted. Source: taste."""

    width_px: int = 2
    """Pixels that a fringe is wide, at most."""
    min_alpha: float = 0.5
    """Alpha of a pixel below which it has no fringe."""
    max_bend_px: float = 2.0
    """Most by which the depth of a fringe may differ from that of the nearest covered pixel, pixels."""
    max_mix_error: float = 0.1
    """Distance of a fringe pixel's colour, 0..1, from the mixtures of paint and background up to which it is one."""


FRINGE = FringeThresholds()


@dataclass(frozen=True)
class FringedSurface:
    """A visible surface that goes on into a fringe."""

    visible: VisibleSurface
    source: Ids = field(repr=False)
    """[H, W] int64 flat index of the pixel whose surface each pixel of the fringe takes; -1: not in the fringe."""

    @staticmethod
    def of(
        visible: VisibleSurface, covered: np.ndarray, fringe: Bools, nearest: np.ndarray | None = None
    ) -> FringedSurface:
        """covered, fringe: [H, W] bool, apart; nearest: `nearest_pixels` of the former, if at hand."""
        source = filled(covered.shape, -1, INT64)
        source[fringe] = (nearest_pixels(covered) if nearest is None else nearest)[fringe]
        return FringedSurface(visible, source)

    @property
    def camera(self) -> Camera:
        return self.visible.camera

    def at(self, pixels: np.ndarray) -> PixelSurface:
        """As `VisibleSurface.at`, the fringe's pixels included."""
        camera = self.camera
        x, y = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).astype(np.int64).T
        return self._gone_on(self.visible.at(pixels), pixels, self.source[y, x])

    def at_centers(self, ids: Ids) -> PixelSurface:
        """As `VisibleSurface.at_centers`, the fringe's pixels included."""
        pixels = np.stack(np.divmod(ids, self.camera.width)[::-1], 1) + 0.5
        return self._gone_on(self.visible.at_centers(ids), pixels, self.source.ravel()[ids])

    def _gone_on(self, out: PixelSurface, pixels: np.ndarray, source: np.ndarray) -> PixelSurface:
        """What is at some places ([Q, 2]), those with a source ([Q], -1: none) as the surface there goes on."""
        camera, chosen = self.camera, np.flatnonzero(source >= 0)
        if not len(chosen):
            return out
        covered_pixels = np.stack(np.divmod(source[chosen], camera.width)[::-1], 1) + 0.5
        # The surface of the nearest covered pixel goes on as its plane.
        near = self.visible.at_centers(source[chosen])
        points = camera.to_camera(camera.unproject(near.depth, covered_pixels))
        rays = camera.to_camera(camera.unproject(np.ones(len(chosen)), pixels[chosen]))
        slope = (rays * near.normals).sum(1)
        # Where the plane is seen edge-on it would run off; the slope is bounded.
        depth = (points * near.normals).sum(1) / np.where(slope < -0.05, slope, -0.05)
        reach = FRINGE.max_bend_px * near.depth / camera.fx
        # A fringe is two pixels wide: it may bend by little, whatever the plane says.
        depth = np.clip(depth, near.depth - reach, near.depth + reach)
        full = [out.depth.copy(), out.normals.copy(), out.windows.copy(), out.residuals.copy()]
        for values, new in zip(full, (depth, near.normals, near.windows, near.residuals), strict=True):
            values[chosen] = new
        return PixelSurface(*full)


def fringe_of(painted: np.ndarray, covered: np.ndarray, trusted: Bools, alpha: np.ndarray) -> Bools:
    """[H, W] bool: painted pixels within FRINGE.width_px of covered ones that have no surface of their own. trusted:
    [H, W] bool pixels that have one; alpha: [H, W] of the asset."""
    return painted & ~trusted & ~covered & (alpha > FRINGE.min_alpha) & dilated(covered, FRINGE.width_px)


def fringe_paint(target: np.ndarray, fringe: FringedSurface, background: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] float32 the picture with paint alone in the fringe's pixels, [H, W] float32 0..1 how much of them it
    covers; 1 elsewhere). A pixel of the outline may be a mixture of the paint beside it and of the background."""
    colors, cover = copied(target), np.ones(target.shape[:2], np.float32)
    ys, xs = set_pixels(fringe.source >= 0)
    paint = target.reshape(-1, 3)[fringe.source[ys, xs]]
    way, seen = paint - background, target[ys, xs] - background
    # The share of paint in a pixel that is paint over background, by least squares along the line between both.
    share = np.clip((way * seen).sum(1) / np.maximum((way * way).sum(1), 1e-6), 0, 1)
    error = np.abs(seen - share[:, None] * way).max(1)
    mixed = error < FRINGE.max_mix_error
    colors[ys[mixed], xs[mixed]] = paint[mixed]
    cover[ys[mixed], xs[mixed]] = share[mixed]
    return colors, cover
