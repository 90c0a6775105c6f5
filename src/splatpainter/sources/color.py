"""Display colours (what a PNG holds) and an asset's own colours, where those are linear. Pure."""

from __future__ import annotations

import numpy as np

from splatpainter.splats import ColorSpace


def to_display(colors: np.ndarray, space: ColorSpace) -> np.ndarray:
    """Colours of an asset as a picture shows them, sRGB 0..1 (IEC 61966-2-1; clipped to 0..1 where they are linear)."""
    if space == "srgb":
        return colors
    light = np.clip(np.nan_to_num(colors), 0, 1)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
    return coded.astype(colors.dtype)


def from_display(colors: np.ndarray, space: ColorSpace) -> np.ndarray:
    """The inverse of `to_display`, for sRGB 0..1."""
    if space == "srgb":
        return colors
    coded = np.clip(colors, 0, 1)
    light = np.where(coded <= 0.04045, coded / 12.92, ((np.maximum(coded, 0.04045) + 0.055) / 1.055) ** 2.4)
    return light.astype(colors.dtype)


def to_light(colors: np.ndarray, space: ColorSpace) -> np.ndarray:
    """Colours of an asset as linear light, 1 = white; not clipped above: the sRGB curve goes on beyond white."""
    if space == "linear":
        return colors
    coded = np.maximum(colors, 0)
    light = np.where(coded <= 0.04045, coded / 12.92, ((np.maximum(coded, 0.04045) + 0.055) / 1.055) ** 2.4)
    return light.astype(colors.dtype)
