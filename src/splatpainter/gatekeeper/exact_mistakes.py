"""Mistakes that are known to the last digit, with what takes each back: turned pictures, numbers of other colour
spaces, gammas and ranges, exchanged channels, negatives, grey. Pure. Colours are display sRGB 0..1, [..., 3]."""

from __future__ import annotations

import numpy as np

from splatpainter.color import LUMA, linear_to_srgb, srgb_to_linear
from splatpainter.gatekeeper.small_copies import Change, Mistake
from splatpainter.kernels.portable import matmul, power

SRGB_TO_P3 = np.array([[0.8224621, 0.1775380, 0], [0.0331941, 0.9668058, 0], [0.0170827, 0.0723974, 0.9105199]])
"""Linear sRGB to linear Display P3 (both D65)."""
P3_TO_SRGB = np.array(
    [[1.22493995, -0.2249401, 0], [-0.04205682, 1.04205693, 0], [-0.01963766, -0.07863598, 1.09827363]]
)
"""Its inverse."""
SRGB_TO_ADOBE = np.array([[0.7151256, 0.2848744, 0], [0, 1, 0], [0, 0.0411619, 0.9588381]])
"""Linear sRGB to linear Adobe RGB (1998) (both D65)."""
ADOBE_TO_SRGB = np.array([[1.39835576, -0.39835576, 0], [0, 1, 0], [0, -0.04292894, 1.04292894]])
"""Its inverse."""
SRGB_TO_PROPHOTO = np.array(
    [[0.5293178, 0.3300928, 0.1405894], [0.0983744, 0.8734610, 0.0281647], [0.0168832, 0.1176725, 0.8654443]]
)
"""Linear sRGB (D65) to linear ProPhoto RGB (D50, adapted by Bradford's matrix)."""
PROPHOTO_TO_SRGB = np.array(
    [[2.0341926, -0.7274198, -0.3067655], [-0.2288108, 1.2317292, -0.0029216], [-0.0085649, -0.1532726, 1.1618390]]
)
"""Its inverse."""
PROPHOTO_GAMMA = 1.8
LUMA_601 = (0.299, 0.587, 0.114)
"""Weights of Rec. 601, by which many programs make grey."""
ADOBE_GAMMA = 563 / 256
VIDEO_BLACK, VIDEO_RANGE = 16 / 255, 219 / 255
"""Limited range of video: levels 16 to 235."""


def _primaries(matrix: np.ndarray, encode: Change, decode: Change) -> Change:
    return lambda colors: encode(np.clip(matmul(decode(colors), matrix.T), 0, 1))


def _linear(colors: np.ndarray) -> np.ndarray:
    return srgb_to_linear(np.clip(colors, 0, 1))


def _encoded(light: np.ndarray) -> np.ndarray:
    return linear_to_srgb(np.clip(light, 0, 1))


def _power(exponent: float) -> Change:
    return lambda colors: power(np.clip(colors, 0, 1), exponent)


def _grey(weights: tuple[float, float, float], linear: bool = False) -> Change:
    def made(colors: np.ndarray) -> np.ndarray:
        values = matmul(_linear(colors) if linear else colors, np.asarray(weights, colors.dtype)[:, None])[..., 0]
        return np.repeat((_encoded(values) if linear else values)[..., None], 3, -1)

    return made


def _darker(levels: np.ndarray) -> np.ndarray:
    return np.clip((levels - VIDEO_BLACK) / VIDEO_RANGE, 0, 1)


def _video(levels: np.ndarray) -> np.ndarray:
    return VIDEO_BLACK + VIDEO_RANGE * levels


_to_p3 = _primaries(SRGB_TO_P3, _encoded, _linear)
_from_p3 = _primaries(P3_TO_SRGB, _encoded, _linear)
_to_adobe = _primaries(SRGB_TO_ADOBE, _power(1 / ADOBE_GAMMA), _linear)
_from_adobe = _primaries(ADOBE_TO_SRGB, _encoded, _power(ADOBE_GAMMA))
_to_prophoto = _primaries(SRGB_TO_PROPHOTO, _power(1 / PROPHOTO_GAMMA), _linear)
_from_prophoto = _primaries(PROPHOTO_TO_SRGB, _encoded, _power(PROPHOTO_GAMMA))
TURNS = (
    Mistake("turned", "mirrored from left to right", lambda p: p[:, ::-1], lambda p: p[:, ::-1]),
    Mistake("turned", "mirrored from top to bottom", lambda p: p[::-1], lambda p: p[::-1]),
    Mistake("turned", "turned upside down", lambda p: p[::-1, ::-1], lambda p: p[::-1, ::-1]),
    Mistake("turned", "turned by 90 degrees clockwise", lambda p: np.rot90(p, -1), lambda p: np.rot90(p, 1)),
    Mistake("turned", "turned by 90 degrees counter-clockwise", lambda p: np.rot90(p, 1), lambda p: np.rot90(p, -1)),
)
OTHER_PRIMARIES = (
    Mistake("colors", "made of Display P3 numbers without their profile", _to_p3, _from_p3, "grey"),
    Mistake("colors", "converted from Display P3 although it was sRGB", _from_p3, _to_p3, "grey"),
    Mistake("colors", "made of Adobe RGB numbers without their profile", _to_adobe, _from_adobe, "grey"),
    Mistake("colors", "converted from Adobe RGB although it was sRGB", _from_adobe, _to_adobe, "grey"),
)
"""Colour spaces of nearly sRGB's gamma, which change pale colours little."""
COLORS = (
    Mistake("colors", "linear light without a profile that says so", _linear, _encoded),
    Mistake("colors", "sRGB numbers in a file of linear light", _encoded, _linear),
    Mistake("colors", "of another gamma, 1.8 for 2.2", _power(1.8 / 2.2), _power(2.2 / 1.8)),
    Mistake("colors", "of another gamma, 2.2 for 1.8", _power(2.2 / 1.8), _power(1.8 / 2.2)),
    Mistake("colors", "in limited video levels (16 to 235)", _video, _darker),
    Mistake("colors", "stretched as if it were video levels (16 to 235)", _darker, _video),
    *OTHER_PRIMARIES,
    Mistake("colors", "made of ProPhoto RGB numbers without their profile", _to_prophoto, _from_prophoto),
    Mistake("colors", "with red and blue exchanged", lambda p: p[..., ::-1], lambda p: p[..., ::-1], "grey"),
    Mistake("colors", "inverted (a negative)", lambda p: 1 - p, lambda p: 1 - p),
    Mistake("colors", "grey", _grey(LUMA), spares="grey"),
    Mistake("colors", "grey", _grey(LUMA_601), spares="grey"),
    Mistake("colors", "grey", _grey(LUMA, linear=True), spares="grey"),
    Mistake("colors", "grey", _grey((1 / 3, 1 / 3, 1 / 3)), spares="grey"),
    Mistake("colors", "grey", lambda p: np.repeat((p.max(-1) + p.min(-1))[..., None] / 2, 3, -1), spares="grey"),
)
