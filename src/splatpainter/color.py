"""Colour of the package, each formula once: the sRGB curve, luminance, and the base colour of SH coefficients.

Functions of `FloatsOrTensor` take numpy (float32 or float64, kept) or torch. Pure.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Floats, FloatsOrTensor
from splatpainter.kernels import portable
from splatpainter.splats import SH_C0, ColorSpace

LUMA = (0.2126, 0.7152, 0.0722)
"""Weights of Rec. 709: the luminance of linear colours, and near enough the luma of display colours."""
TO_LMS = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
LMS_TO_LAB = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)


def srgb_to_linear(display: FloatsOrTensor) -> FloatsOrTensor:
    """Display sRGB >= 0 -> linear light (IEC 61966-2-1); the curve goes on beyond white."""
    if isinstance(display, np.ndarray | np.generic):
        return portable.srgb(display, to_linear=True)
    import torch

    high = ((display.clip(0.04045, None) + 0.055) / 1.055) ** 2.4
    return torch.where(display <= 0.04045, display / 12.92, high)


def linear_to_srgb(linear: FloatsOrTensor) -> FloatsOrTensor:
    """Linear light >= 0 -> display sRGB, the inverse of `srgb_to_linear`."""
    if isinstance(linear, np.ndarray | np.generic):
        return portable.srgb(linear, to_linear=False)
    import torch

    high = 1.055 * linear.clip(0.0031308, None) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, high)


def to_display(colors: Floats, space: ColorSpace) -> Floats:
    """Colours of an asset as a picture shows them, sRGB 0..1 (clipped to 0..1 where they are linear)."""
    return colors if space == "srgb" else linear_to_srgb(np.clip(np.nan_to_num(colors), 0, 1)).astype(colors.dtype)


def from_display(colors: Floats, space: ColorSpace) -> Floats:
    """The inverse of `to_display`, for sRGB 0..1."""
    return colors if space == "srgb" else srgb_to_linear(np.clip(colors, 0, 1)).astype(colors.dtype)


def to_light(colors: Floats, space: ColorSpace) -> Floats:
    """Colours of an asset as linear light, 1 = white; not clipped above."""
    return colors if space == "linear" else srgb_to_linear(np.maximum(colors, 0)).astype(colors.dtype)


def display_slope(light: np.ndarray, space: ColorSpace) -> np.ndarray:
    """Derivative of an asset's colours by linear light >= 0."""
    if space == "linear":
        return np.ones_like(light)
    dark = np.maximum(light, 0.0031308)
    return np.where(light <= 0.0031308, 12.92, 1.055 / 2.4 * portable.power(dark, 1 / 2.4) / dark)


def luminance(colors: FloatsOrTensor) -> FloatsOrTensor:
    """[..., 3] -> [...] Rec. 709 weighted sum."""
    return LUMA[0] * colors[..., 0] + LUMA[1] * colors[..., 1] + LUMA[2] * colors[..., 2]


def oklab(colors: Floats) -> Floats:
    """[N, 3] display colours 0..1 -> [N, 3] float64 lightness, a, b (Ottosson, "A perceptual color space for image
    processing", 2020)."""
    light = srgb_to_linear(colors.astype(np.float64))
    lms = portable.matmul(light, np.array(TO_LMS).T).clip(0, None)
    return portable.matmul(portable.power(lms, 1 / 3), np.array(LMS_TO_LAB).T)


def base_color(sh: FloatsOrTensor) -> FloatsOrTensor:
    """[..., K, 3] SH coefficients -> [..., 3] colour without its dependence on the view, not clipped."""
    return 0.5 + SH_C0 * sh[..., 0, :]


def sh_from_color(colors: FloatsOrTensor) -> FloatsOrTensor:
    """Base colours -> SH coefficients of band 0, the inverse of `base_color`."""
    return (colors - 0.5) / SH_C0


def from_hex(text: str) -> tuple[float, float, float] | None:
    """Red, green and blue 0..1 of "#2040a0" or "2040a0"; None of other text."""
    digits = text.removeprefix("#")
    if len(digits) != 6 or any(c not in "0123456789abcdefABCDEF" for c in digits):
        return None
    red, green, blue = (int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4))
    return red, green, blue
