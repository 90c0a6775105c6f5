"""Pictures that come back from elsewhere: whose camera they are, whether they were moved, what changed in them. Pure.

H, W: pixels of the camera. Colours are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from splatpainter.cameras import CHUNK, Camera, to_uint8
from splatpainter.image_files import encode_png
from splatpainter.lift.masks import change_mask
from splatpainter.sources.files import ASPECT
from splatpainter.sources.pictures import resample

SMALL = 48
"""Pixels of the thumbnails that pictures are recognised by."""
ALIKE = 0.08
"""Mean difference of thumbnails up to which a picture is taken for an edit of an exported view."""
FARTHEST = 0.04
"""Part of the picture's size by which it may have been moved."""
FAINT = 1.5 / 255
"""Differences outside the mask up to here are rounding and compression."""
SPREAD = 0.02
"""Share of the pixels outside the mask that may differ more before it is worth a warning."""
WHOLE = 0.6
"""Where more than this share of the asset changed, somebody regraded it."""


def same_shape(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether a picture of `size` (width, height) is one of `wanted`, resized."""
    return abs((size[0] / size[1]) / (wanted[0] / wanted[1]) - 1) <= ASPECT or (
        abs(size[0] - size[1] * wanted[0] / wanted[1]) <= 1
    )


def png_bytes(image: np.ndarray, camera: Camera | None = None) -> bytes:
    """PNG of [H, W, 3 or 4] or [H, W] values (float 0..1, uint8 or bool), with its camera inside. Fast, not small."""
    pixels = image.astype(np.uint8) * 255 if image.dtype == bool else to_uint8(image)
    return encode_png(pixels, None if camera is None else {CHUNK: camera.to_json()}, level=1)


def small(image: np.ndarray) -> np.ndarray:
    """[SMALL, SMALL, 3] a picture shrunk, to be recognised by."""
    return resample(np.clip(image, 0, 1), SMALL, SMALL)


def most_alike(picture: np.ndarray, candidates: Iterable[np.ndarray]) -> int | None:
    """Which thumbnail the picture [h, w, 3] was made from, or None where none is like it. The half of the pixels that
    agrees best decides: the other half may have been painted over."""
    own = small(picture)
    scores = [float(np.sort(np.abs(own - other).mean(-1), axis=None)[: SMALL**2 // 2].mean()) for other in candidates]
    if not scores or min(scores) > ALIKE / 2:
        return None
    return int(np.argmin(scores))


def shift_of(picture: np.ndarray, render: np.ndarray) -> tuple[int, int]:
    """(right, down) whole pixels that the picture [H, W, 3] was moved by against the render, (0, 0) where that does not
    make them agree much better. By phase correlation of their gradients (Kuglin and Hines 1975)."""
    height, width = render.shape[:2]
    spectra = [np.fft.rfft2(_edges(image)) for image in (picture, render)]
    cross = spectra[0] * np.conj(spectra[1])
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), (height, width))
    down, right = np.unravel_index(int(peak.argmax()), peak.shape)
    down, right = (int(v - size if v > size // 2 else v) for v, size in ((down, height), (right, width)))
    if (right, down) == (0, 0) or abs(right) > FARTHEST * width or abs(down) > FARTHEST * height:
        return 0, 0
    still, moved = _disagreement(picture, render), _disagreement(moved_back(picture, render, right, down), render)
    return (right, down) if moved < 0.5 * still else (0, 0)


def moved_back(picture: np.ndarray, render: np.ndarray, right: int, down: int) -> np.ndarray:
    """The picture moved back by (right, down) pixels; what it does not show then is as in the render."""
    height, width = render.shape[:2]
    out = render.copy()
    x0, x1, y0, y1 = max(-right, 0), min(width - right, width), max(-down, 0), min(height - down, height)
    out[y0:y1, x0:x1] = picture[y0 + down : y1 + down, x0 + right : x1 + right]
    return out


def changed(picture: np.ndarray, render: np.ndarray, threshold: float | None) -> np.ndarray:
    """[H, W] bool: pixels that were edited; threshold: the difference (0..1) from which one counts, None: found."""
    if threshold is None:
        return change_mask(picture, render)
    return np.abs(np.clip(picture, 0, 1) - np.clip(render, 0, 1)).max(-1) > threshold


def faint_changes(picture: np.ndarray, render: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels outside the mask that differ although they count as not edited; a generator's or a
    compressor's doing. Averaged over 5 x 5 pixels, so that grain does not count."""
    signed = np.where(mask[..., None], 0, np.clip(picture, 0, 1) - np.clip(render, 0, 1))
    padded = np.pad(signed, ((2, 2), (2, 2), (0, 0)), mode="edge")
    height, width = mask.shape
    mean = sum(padded[y : y + height, x : x + width] for y in range(5) for x in range(5)) / 25
    return (np.abs(mean).max(-1) > FAINT) & ~mask


def overlay(mask: np.ndarray) -> np.ndarray:
    """[H, W, 4] uint8: red where the mask is, else transparent."""
    out = np.zeros((*mask.shape, 4), np.uint8)
    out[mask] = (255, 60, 60, 150)
    return out


def _edges(image: np.ndarray) -> np.ndarray:
    grey = np.clip(image, 0, 1).mean(-1)
    return np.hypot(np.diff(grey, axis=1, prepend=grey[:, :1]), np.diff(grey, axis=0, prepend=grey[:1]))


def _disagreement(picture: np.ndarray, render: np.ndarray) -> float:
    """Mean difference, of the half of the textured pixels that agrees best."""
    difference = np.abs(np.clip(picture, 0, 1) - np.clip(render, 0, 1)).mean(-1)
    edges = _edges(render)
    values = np.sort(difference[edges >= np.quantile(edges, 0.8)])
    return float(values[: len(values) // 2 + 1].mean()) + 1e-4
