"""Lenses that bend straight lines, and photographs taken through them as a pinhole camera would have taken them.

A lens says where a direction lands: slopes (x / z, y / z) of a direction in camera axes -> slopes of the pixel that
shows it, u = fx * x' + cx. Only this way is needed: each pixel of the pinhole picture looks up where it lies in the
photograph. The models are COLMAP's (src/colmap/sensor/models.h) and with them OpenCV's and nerfstudio's. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.portable import arctan2, cos, sin, tan
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class LensThresholds:
    """How photographs of wide lenses become pinhole pictures. Source: geometry and taste, as each entry says."""

    max_half_field_degrees: float = 60.0
    """Angle to the axis up to which a pinhole picture of a wide lens reaches: its edge has four times the pixels of the
    middle there, and 16 times at 76 degrees."""
    max_enlargement: float = 2.0
    """Times the photograph's sides, at most, of a pinhole picture that shows all of it."""
    slope_steps: int = 2048
    """Slopes at which a lens is looked at for where its formula turns back on itself."""
    window_steps: int = 40
    """Halvings until the edge of a window is found."""
    rows_at_a_time: int = 32
    """Rows of a picture that are sampled at a time."""
    edge_px: int = 3
    """Pixels around a picture that samples beside it may touch."""


LENSES = LensThresholds()


@dataclass(frozen=True)
class Lens:
    """Any model; subclasses say which."""

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        """[..., 2] slopes of the pixels that show directions of slopes [..., 2]."""
        raise NotImplementedError

    @cached_property
    def reach(self) -> float:
        """Largest slope up to which pixels move outwards with the direction, in every direction; polynomials that were
        fitted to a photograph turn back on themselves outside it, and would show it again there."""
        slopes = tan(np.linspace(0, math.radians(89.5), LENSES.slope_steps + 1))
        out = float(slopes[-1])
        # Eight directions: tangential and prism terms are not the same all around.
        for angle in np.arange(8) * (math.pi / 4):
            line = slopes[:, None] * np.array([cos(angle), sin(angle)])
            with np.errstate(all="ignore"):  # what overflows or has no root is beyond reach
                steps = np.diff(np.linalg.norm(self.distorted(line), axis=1))
            back = ~(steps > 0)
            if back.any():
                out = min(out, float(slopes[int(np.argmax(back))]))
        return out


@dataclass(frozen=True)
class PolynomialLens(Lens):
    """Brown and Conrady's model with its offspring: OpenCV's rational one, Kannala and Brandt's fisheye (the polynomial
    is of the angle to the axis), thin prisms (Weng et al. 1992)."""

    radial: tuple[float, ...] = ()
    """k1, k2, ...: factors of the 2nd, 4th, ... power."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2."""
    divisor: tuple[float, ...] = ()
    """k4, k5, k6 of OpenCV: a polynomial like `radial` that it is divided by."""
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Shifts along x by the 2nd and 4th power, along y likewise."""
    fisheye: bool = False
    """Whether slopes become angles first (the equidistant projection)."""
    radial_first: bool = False
    """Whether the other terms see what the polynomial made (Project Aria's lenses)."""

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        # Fisheye models are polynomials of the angle, others of its tangent.
        points = _angles(slopes) if self.fisheye else slopes
        square = (points**2).sum(-1)
        factor = _polynomial(self.radial, square) / _polynomial(self.divisor, square)
        moved = points * factor[..., None]
        if self.radial_first:
            points, square = moved, (moved**2).sum(-1)
        x, y = points[..., 0], points[..., 1]
        p1, p2 = self.tangential
        s1, s2, s3, s4 = self.prism
        right = 2 * p1 * x * y + p2 * (square + 2 * x * x) + s1 * square + s2 * square**2
        down = 2 * p2 * x * y + p1 * (square + 2 * y * y) + s3 * square + s4 * square**2
        return moved + np.stack([right, down], -1)


@dataclass(frozen=True)
class FieldOfViewLens(Lens):
    """Devernay and Faugeras 2001: one number."""

    omega: float
    """Radians, above 0."""

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        radius = np.linalg.norm(slopes, axis=-1, keepdims=True)
        angle = arctan2(radius * 2 * tan(self.omega / 2), 1.0) / self.omega
        return slopes * _ratio(angle, radius, 2 * tan(self.omega / 2) / self.omega)


@dataclass(frozen=True)
class DivisionLens(Lens):
    """Fitzgibbon 2001: the pinhole's slope is the pixel's over 1 + k times its square."""

    k: float

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        square = (slopes**2).sum(-1, keepdims=True)
        return slopes * 2 / (1 + np.sqrt(1 - 4 * self.k * square))


@dataclass(frozen=True)
class UnifiedLens(Lens):
    """The enhanced unified camera model (Khomutenko et al. 2016)."""

    alpha: float
    beta: float

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        distance = np.sqrt(self.beta * (slopes**2).sum(-1, keepdims=True) + 1)
        return slopes / (self.alpha * distance + 1 - self.alpha)


def _angles(slopes: np.ndarray) -> np.ndarray:
    radius = np.linalg.norm(slopes, axis=-1, keepdims=True)
    return slopes * _ratio(arctan2(radius, 1.0), radius, 1.0)


def _ratio(above: np.ndarray, below: np.ndarray, limit: float) -> np.ndarray:
    """above / below; limit where both are 0."""
    return np.divide(above, below, out=np.full_like(below, limit), where=below > 1e-12)


def _polynomial(factors: Sequence[float], square: np.ndarray) -> np.ndarray:
    out = np.zeros_like(square)
    for factor in reversed(factors):
        out = (out + factor) * square
    return 1 + out


# ---- pinhole pictures of a photograph


def pinhole_window(camera: Camera, lens: Lens, *, all_of_it: bool) -> Camera:
    """The pinhole camera of a photograph's place and focal lengths, with more or fewer pixels around its principal
    point. camera: that of the photograph, as if its lens bent nothing.

    all_of_it: the least that shows the whole photograph (its corners may be empty), else the most of which every pixel
    is in the photograph; within LENSES.max_half_field_degrees and LENSES.max_enlargement. Raises ValueError: nothing
    can be seen."""
    # Bisection over the window's size: whether its border is seen is monotone in it.
    low, high = 0.0, _largest_window(camera)
    for _ in range(LENSES.window_steps):
        middle = (low + high) / 2
        seen = _seen(camera, lens, _border(camera, middle))
        inner = seen.any() if all_of_it else seen.all()
        low, high = (middle, high) if inner else (low, middle)
    factor = high if all_of_it else low
    # Whole pixels, inwards, so that the window's border is within what was found.
    left, top = (math.ceil(center * (1 - factor) - 1e-6) for center in (camera.cx, camera.cy))
    right = math.floor(camera.cx + (camera.width - camera.cx) * factor + 1e-6)
    bottom = math.floor(camera.cy + (camera.height - camera.cy) * factor + 1e-6)
    if right - left < 1 or bottom - top < 1:
        raise ValueError("camera: its lens leaves nothing of the photograph; check its distortion parameters")
    return camera.cropped(left, top, right - left, bottom - top)


def _largest_window(camera: Camera) -> float:
    corners = [(side - center) / focal for side, center, focal in _sides(camera)]
    widest = max(abs(slope) for slope in corners)
    return min(tan(math.radians(LENSES.max_half_field_degrees)) / max(widest, 1e-9), LENSES.max_enlargement)


def _sides(camera: Camera) -> list[tuple[float, float, float]]:
    across, along = (camera.cx, camera.fx), (camera.cy, camera.fy)
    return [(0.0, *across), (float(camera.width), *across), (0.0, *along), (float(camera.height), *along)]


def _border(camera: Camera, factor: float) -> np.ndarray:
    """[P, 2] slopes along the border of a window `factor` times the camera's, about the principal point."""
    left, right, top, bottom = (factor * (side - center) / focal for side, center, focal in _sides(camera))
    x, y = np.linspace(left, right, 65), np.linspace(top, bottom, 65)
    lines = [(x, np.full_like(x, top)), (x, np.full_like(x, bottom)), (np.full_like(y, left), y)]
    return np.concatenate([np.stack(line, 1) for line in (*lines, (np.full_like(y, right), y))])


def _seen(camera: Camera, lens: Lens, slopes: np.ndarray) -> np.ndarray:
    """[...] bool: which directions of slopes [..., 2] the photograph shows."""
    return _within(camera, lens, slopes, _pixels(camera, lens, slopes))


def _within(camera: Camera, lens: Lens, slopes: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x, y = pixels[..., 0], pixels[..., 1]
    rounding = 1e-6
    inside = (x >= -rounding) & (x <= camera.width + rounding) & (y >= -rounding) & (y <= camera.height + rounding)
    return inside & (np.linalg.norm(slopes, axis=-1) <= lens.reach)


def _pixels(camera: Camera, lens: Lens, slopes: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):  # beyond the lens's reach anything may come
        bent = lens.distorted(np.asarray(slopes, np.float64))
    return bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def straightened(values: np.ndarray, camera: Camera, lens: Lens, window: Camera) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, C] float32 what a photograph [h, w, C] shows at each pixel of the pinhole camera `window`, [H, W] bool
    where it shows anything). camera: of the photograph, of its size. Bicubic (Catmull and Rom); edges are repeated."""
    assert values.shape[:2] == (camera.height, camera.width)
    # A repeated rim, so that the cubic kernel needs no branches at the border.
    padded = np.pad(values.astype(np.float32), [(LENSES.edge_px, LENSES.edge_px)] * 2 + [(0, 0)], mode="edge")
    out = np.empty((window.height, window.width, values.shape[2]), np.float32)
    inside = np.empty((window.height, window.width), bool)
    # A few rows at a time: slopes of a whole photograph would take gigabytes.
    for top in range(0, window.height, LENSES.rows_at_a_time):
        rows = slice(top, min(top + LENSES.rows_at_a_time, window.height))
        y, x = np.mgrid[rows, : window.width] + 0.5
        slopes = window.slopes(np.stack([x, y], -1))
        pixels = _pixels(camera, lens, slopes)
        inside[rows] = _within(camera, lens, slopes, pixels)
        out[rows] = _sampled(padded, np.nan_to_num(pixels))
    return out, inside


def _sampled(padded: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[R, W, C] float32 of a picture [h, w, C] at pixels [R, W, 2], whose centres lie at .5. padded: the picture with
    LENSES.edge_px repeated around it."""
    height, width, channels = padded.shape
    x, y = (
        np.clip(pixels[..., axis] - 0.5, -1, side - 2 * LENSES.edge_px).astype(np.float32)
        for axis, side in ((0, width), (1, height))
    )
    left, top = np.floor(x), np.floor(y)
    across, along = _weights(x - left), _weights(y - top)
    first = (top.astype(np.int64) + LENSES.edge_px - 1) * width + left.astype(np.int64) + LENSES.edge_px - 1
    flat = padded.reshape(-1, channels)
    out = np.zeros((*first.shape, channels), np.float32)
    # Catmull and Rom over 4 x 4 pixels; gathers of whole pixels are what takes time.
    for j in range(4):
        for i in range(4):
            out += (across[i] * along[j])[..., None] * flat.take(first + (j * width + i), axis=0)
    return out


def _weights(t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Catmull and Rom's weights of the four pixels around a place t of 0..1 between the middle two."""
    return (
        ((-0.5 * t + 1) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1,
        ((-1.5 * t + 2) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


def lens_or_none(lens: PolynomialLens) -> PolynomialLens | None:
    """The lens, or None where all of its numbers are 0 and it bends nothing."""
    numbers = (*lens.radial, *lens.tangential, *lens.divisor, *lens.prism)
    return lens if lens.fisheye or any(numbers) else None
