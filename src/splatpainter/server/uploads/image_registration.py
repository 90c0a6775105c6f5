"""Pictures that come back from elsewhere: what was changed in them.

Which view they show is for pictures/view_search.py, whether they were moved or cropped for gatekeeper/registration.py.
Pure. H, W: pixels of the camera; colours are display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import CAMERA_KEYWORD, encode_png, to_uint8
from splatpainter.lift.masks import edited_mask

FAINT_DIFFERENCE = 1.5 / 255
"""Differences outside the mask up to here are rounding and compression."""
FAINT_WARNING_SHARE = 0.02
"""Share of the pixels outside the mask that may differ more before it is worth a warning."""
REGRADED_SHARE = 0.6
"""Where more than this share of the asset changed, somebody regraded it."""


def png_bytes(image: np.ndarray, camera: Camera | None = None) -> bytes:
    """PNG of [H, W, 3 or 4] or [H, W] values (float 0..1, uint8 or bool), with its camera inside. Fast, not small."""
    pixels = image.astype(np.uint8) * 255 if image.dtype == bool else to_uint8(image)
    return encode_png(pixels, None if camera is None else {CAMERA_KEYWORD: camera.to_json()}, level=1)


def changed_mask(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray, threshold: float | None) -> np.ndarray:
    """[H, W] bool: pixels that were edited; alpha: [H, W] of the render; threshold: the difference (0..1) from which
    one counts, None: as in `edited_mask`."""
    # A threshold that is given holds for every pixel; without one the picture's own noise decides.
    if threshold is None:
        return edited_mask(picture, render, alpha)
    return np.abs(np.clip(picture, 0, 1) - np.clip(render, 0, 1)).max(-1) > threshold


def faint_changes(picture: np.ndarray, render: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels outside the mask that differ although they count as not edited; a generator's or a
    compressor's doing. Averaged over 5 x 5 pixels, so that grain does not count."""
    # Signed, so that grain cancels in the mean and a drift does not.
    signed = np.where(mask[..., None], 0, np.clip(picture, 0, 1) - np.clip(render, 0, 1))
    padded = np.pad(signed, ((2, 2), (2, 2), (0, 0)), mode="edge")
    height, width = mask.shape
    mean = sum(padded[y : y + height, x : x + width] for y in range(5) for x in range(5)) / 25
    return (np.abs(mean).max(-1) > FAINT_DIFFERENCE) & ~mask


def overlay(mask: np.ndarray) -> np.ndarray:
    """[H, W, 4] uint8: red where the mask is, else transparent."""
    out = np.zeros((*mask.shape, 4), np.uint8)
    out[mask] = (255, 60, 60, 150)
    return out
