"""A stroke while it is drawn: what was painted so far on one view, and quick previews of it on the rows.

The view is projected once per stroke; a dab costs a few colour rounds of the lift over the tiles around it. Previews
change colours of rows that are there; when the pen goes up, the chosen method does the real edit from `picture()`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import BRIGHTEST, recolor
from splatpainter.lift.local_edit import FAINTEST, INSIDE_SMALL, VISIBLE
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.sources.color import from_display, to_display
from splatpainter.splats import Splats

ROUNDS = 3
"""Colour rounds per dab; the next dab beside it continues them."""
MARGIN = 24
"""Pixels around a dab that hold the rows which straddle its edge."""
SEEN = 1 / 512
"""Changes of a row's colour below this are not sent."""


@dataclass(frozen=True)
class Preview:
    """Rows to show in other colours."""

    rows: np.ndarray
    """[C] int64 ascending."""
    splats: Splats
    """[C] rows."""


@dataclass
class _Canvas:
    """What the stroke knows of one version of the asset."""

    version: int
    frame: ProjectedView
    base: np.ndarray
    """[H, W, 3] the render without the stroke."""
    erased: np.ndarray
    """[H, W, 3] the original's render (of an erasing stroke; else the base)."""
    target: np.ndarray
    """[H, W, 3] the base with the stroke on it."""
    whole: np.ndarray
    """[M] weight of each row in the view."""
    colors: np.ndarray
    """[M, 3] as previewed."""
    sent: np.ndarray
    """[M, 3] as last sent."""
    movable: np.ndarray = field(repr=False)
    """[M] bool."""


class Stroke:
    """One stroke of one client; used by one thread at a time."""

    def __init__(self, camera: Camera, erase: bool = False) -> None:
        self.camera, self.erase = camera, erase
        self.rgba = np.zeros((camera.height, camera.width, 4), np.uint8)
        self._canvas: _Canvas | None = None

    def prepare(self, splats: Splats, original: Splats, version: int) -> None:
        """Project the asset (numpy) as it now is, unless that was done for this version."""
        if self._canvas is not None and self._canvas.version == version:
            return
        frame = project(splats, self.camera)
        base = frame.rasterize()[0]
        erased = project(original, self.camera).rasterize()[0] if self.erase else base
        everywhere = np.ones(base.shape[:2], np.float32)
        whole = frame.backproject(np.zeros_like(base), everywhere).weight
        colors = np.maximum(frame.unclamped_colors, 0)
        movable = np.zeros(len(frame), bool)
        self._canvas = _Canvas(version, frame, base, erased, base.copy(), whole, colors.copy(), colors.copy(), movable)

    def patch(self, x: int, y: int, width: int, height: int, rgba: bytes) -> tuple[int, int, int, int]:
        """Put pixels (straight alpha, 8 bits) in their rectangle; returns it as left, top, right, bottom. Raises
        ValueError where it is not inside the view, or the bytes are not that many."""
        if x + width > self.camera.width or y + height > self.camera.height:
            size = f"{self.camera.width}x{self.camera.height}"
            raise ValueError(f"dab: expected a rectangle inside the view of {size}, got {width}x{height} at {x}, {y}")
        if len(rgba) != width * height * 4:
            raise ValueError(f"dab: expected {width * height * 4} bytes of RGBA, got {len(rgba)}")
        self.rgba[y : y + height, x : x + width] = np.frombuffer(rgba, np.uint8).reshape(height, width, 4)
        return x, y, x + width, y + height

    def preview(self, splats: Splats, original: Splats, version: int, box: tuple[int, int, int, int]) -> Preview:
        """Rows whose colours changed since the last preview, after new pixels in `box`. A changed asset (another
        version) is projected again, and the whole stroke shown on it."""
        if self._canvas is None or self._canvas.version != version:
            self.prepare(splats, original, version)
            box = (0, 0, self.camera.width, self.camera.height)
        canvas = self._canvas
        assert canvas is not None
        frame = canvas.frame
        inside = _slices(box)
        alpha = self.rgba[inside][..., 3:].astype(np.float32) / 255
        wanted = canvas.erased[inside]
        if not self.erase:
            wanted = from_display(self.rgba[inside][..., :3].astype(np.float32) / 255, splats.color_space)
        canvas.target[inside] = (1 - alpha) * canvas.base[inside] + alpha * wanted
        entries = self._lift(canvas, splats, _grown(box, self.camera))
        news = entries[np.abs(canvas.colors[entries] - canvas.sent[entries]).max(1) > SEEN]
        canvas.sent[news] = canvas.colors[news]
        news = news[np.argsort(frame.gaussian_ids[news])]
        rows = frame.gaussian_ids[news]
        some = splats.take(rows)
        sh = recolor(some.sh, frame.unclamped_colors[news], canvas.colors[news])
        return Preview(rows, replace(some, sh=sh, source=None, origin=None))

    def _lift(self, canvas: _Canvas, splats: Splats, box: tuple[int, int, int, int]) -> np.ndarray:
        """Some colour rounds within a window of the view. Returns [E] the frame's entries that it shows."""
        frame, window = canvas.frame, _slices(box)
        left, top, right, bottom = box
        centers, extents = frame.means2d, frame.extents
        near = (np.abs(2 * centers - (left + right, top + bottom)) < 2 * extents + (right - left, bottom - top)).all(1)
        chosen = np.flatnonzero(near)
        camera = self.camera.cropped(left, top, right - left, bottom - top)
        small = project(splats.take(frame.gaussian_ids[chosen]), camera)
        entries = chosen[small.gaussian_ids]
        target = np.ascontiguousarray(canvas.target[window])
        painted = (self.rgba[window][..., 3] > 0).astype(np.float32)
        everywhere = np.ones_like(painted)
        sums = small.backproject(target, painted)
        reached = (sums.peak > FAINTEST) & (sums.weight > VISIBLE * sums.alpha)
        canvas.movable[entries] |= reached & (sums.weight > INSIDE_SMALL * canvas.whole[entries])
        movable = canvas.movable[entries]
        towards = sirt_steps(small, target, everywhere, movable)
        step, own = 1 / np.maximum(towards.weight, 1e-6)[:, None], entries[movable]
        colors, ceiling = canvas.colors[own], np.maximum(frame.unclamped_colors[own], BRIGHTEST)
        for _ in range(ROUNDS):
            colors = np.clip(colors + step * towards.residual(colors), 0, ceiling).astype(np.float32)
        canvas.colors[own] = colors
        return entries

    @property
    def mask(self) -> np.ndarray:
        """[H, W] bool: painted pixels."""
        return self.rgba[..., 3] > 0

    def picture(self, splats: Splats, original: Splats, version: int) -> np.ndarray:
        """[H, W, 3] display colours 0..1: the stroke over the asset's own render."""
        self.prepare(splats, original, version)
        assert self._canvas is not None
        render = to_display(self._canvas.base, splats.color_space)
        alpha = self.rgba[..., 3:].astype(np.float32) / 255
        return np.clip(render * (1 - alpha) + self.rgba[..., :3].astype(np.float32) / 255 * alpha, 0, 1)


def _slices(box: tuple[int, int, int, int]) -> tuple[slice, slice]:
    left, top, right, bottom = box
    return slice(top, bottom), slice(left, right)


def _grown(box: tuple[int, int, int, int], camera: Camera) -> tuple[int, int, int, int]:
    left, top, right, bottom = box
    return (
        max(left - MARGIN, 0),
        max(top - MARGIN, 0),
        min(right + MARGIN, camera.width),
        min(bottom + MARGIN, camera.height),
    )
