"""The sliders of a global look on rows: `grade(sh, settings) -> sh`, the look "grade" of a session.

A row's base colour goes through looks.py and through hue bands; its SH bands >= 1 through the same function's Jacobian
there (first order), so that highlights are regraded with the surface they lie on. Zeros change nothing, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from splatpainter import jsonio
from splatpainter.kernels.parallel import each
from splatpainter.sources.looks import MIN_CURVE_STEP, Look, apply_look, luminance, to_display, to_linear
from splatpainter.splats import SH_C0, ColorSpace

NAME = "grade"
"""What a layer's parameters call it ({"look": "grade", ...})."""
STEP = 1 / 64
"""Of the finite differences that make the Jacobian."""
STEEPEST = 4.0
"""Bound of its entries: where a curve is a cliff, a highlight must not become a spike."""
PIECE = 8192
"""Rows graded at a time: they fit the processor's cache, and threads share the pieces."""


@dataclass(frozen=True)
class HueBand:
    """A change of one range of hues; greys have no hue and stay."""

    hue: float
    """Middle of the range, degrees (0 red, 120 green, 240 blue)."""
    width: float = 60.0
    """Degrees to either side over which the change fades out (a raised cosine)."""
    shift: float = 0.0
    """Degrees, about the grey axis."""
    saturation: float = 0.0
    """-1 grey .. 1 twice as colourful."""
    lightness: float = 0.0
    """-1 half .. 1 twice as bright."""


@dataclass(frozen=True)
class Grade:
    """Settings; the defaults change nothing."""

    exposure: float = 0.0
    """Stops, of linear light."""
    temperature: float = 0.0
    """-1 cold .. 1 warm."""
    tint: float = 0.0
    """-1 green .. 1 magenta."""
    contrast: float = 0.0
    """-1..1: slope 2^c in the mid-tones."""
    saturation: float = 0.0
    """-1 grey .. 1 twice as colourful."""
    curve: tuple[tuple[float, float], ...] = ()
    """Points (in, out) of display values, left to right; (0, 0) and (1, 1) are added where no point says otherwise."""
    hues: tuple[HueBand, ...] = ()
    strength: float = 1.0
    """0..1: how much of the change is taken."""
    space: ColorSpace = "srgb"
    """What the rows' colours mean: "srgb" (display) or "linear"; the sliders act on display colours either way."""

    def to_dict(self) -> dict[str, Any]:
        """Parameters of a layer."""
        return {"look": NAME, **asdict(self)}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Grade:
        """The inverse of `to_dict`. Raises ValueError: unknown fields, no finite numbers, a curve not in order."""
        values = {key: value for key, value in data.items() if key != "look"}
        settings = jsonio.build(Grade, values, "look", base=Grade())
        curve = settings.curve
        if any(b[0] - a[0] < MIN_CURVE_STEP for a, b in zip(curve, curve[1:], strict=False)):
            line = f"points from left to right, {MIN_CURVE_STEP:g} apart"
            raise ValueError(f"look: expected a curve of {line}, got {list(curve)}")
        return settings

    @property
    def neutral(self) -> bool:
        """Whether it changes nothing."""
        sliders = (self.exposure, self.temperature, self.tint, self.contrast, self.saturation)
        bands = any(band.shift or band.saturation or band.lightness for band in self.hues)
        return self.strength == 0 or not (any(sliders) or bands or self._whole_curve())

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours 0..1 -> the like."""
        look = Look(
            exposure=self.exposure,
            temperature=self.temperature,
            tint=self.tint,
            contrast=2.0**self.contrast,
            saturation=1 + self.saturation,
            curve=self._whole_curve(),
        )
        out = apply_look(colors, look)
        for band in self.hues:
            out = banded(out, band)
        return out if self.strength == 1 else colors + np.float32(self.strength) * (out - colors)

    def _whole_curve(self) -> tuple[tuple[float, float], ...]:
        if all(x == y for x, y in self.curve):
            return ()
        first = () if self.curve[0][0] <= 0 else ((0.0, 0.0),)
        last = () if self.curve[-1][0] >= 1 else ((1.0, 1.0),)
        return (*first, *self.curve, *last)


def grade(sh: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """SH [N, K, 3] of rows after the sliders (Grade's fields), float32; rows that do not change keep their bits.
    Raises ValueError as Grade.from_dict."""
    chosen = Grade.from_dict(settings)
    if chosen.neutral:
        return sh

    def turned(colors: np.ndarray) -> np.ndarray:
        return to_linear(chosen(to_display(colors))) if chosen.space == "linear" else chosen(colors)

    pieces = [sh[start : start + PIECE] for start in range(0, len(sh), PIECE)]
    return np.concatenate(each(lambda piece: _graded(piece, turned), pieces)) if pieces else sh


def _graded(sh: np.ndarray, turned: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    base = np.clip(np.nan_to_num(0.5 + SH_C0 * sh[:, 0]), 0, 1).astype(np.float32)
    new = turned(base)
    step = (new - base) / np.float32(SH_C0)
    out = sh.astype(np.float32)
    out[:, 0] = np.where(step != 0, sh[:, 0] + step, sh[:, 0])
    if sh.shape[1] > 1:
        slopes = []
        for channel in range(3):
            side = np.where(base[:, channel] > 0.5, -STEP, STEP).astype(np.float32)  # stay inside 0..1
            moved = base.copy()
            moved[:, channel] += side
            slopes.append((turned(moved) - new) / side[:, None])
        matrix = np.clip(np.stack(slopes, 1), -STEEPEST, STEEPEST)  # [N, in, out]
        turns = np.abs(matrix - np.eye(3, dtype=np.float32)).max((1, 2)) > 1e-5
        if turns.all():
            out[:, 1:] = sh[:, 1:] @ matrix
        else:
            out[turns, 1:] = sh[turns, 1:] @ matrix[turns]
    return out


def banded(colors: np.ndarray, band: HueBand) -> np.ndarray:
    """[..., 3] display colours with one range of hues changed; hue as the hexagon of HSV has it."""
    red, green, blue = (colors[..., k] for k in range(3))
    high, low = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    chroma = high - low
    safe = np.where(chroma > 1e-6, chroma, 1)
    sextant = np.where(
        high == red,
        (green - blue) / safe % 6,
        np.where(high == green, (blue - red) / safe + 2, (red - green) / safe + 4),
    )
    away = np.abs((60 * sextant - band.hue + 180) % 360 - 180)
    weight = np.where(away < band.width, 0.5 + 0.5 * np.cos(np.pi * away / band.width), 0)
    weight = weight * np.minimum(chroma / 0.05, 1)  # what is nearly grey has a hue by chance
    out = colors @ _turn(band.shift) if band.shift else colors
    grey = luminance(out)[..., None]
    out = (grey + (1 + band.saturation) * (out - grey)) * 2.0**band.lightness
    return (colors + weight[..., None] * (out - colors)).clip(0, 1).astype(colors.dtype)


def _turn(degrees: float) -> np.ndarray:
    """[3, 3], to be multiplied from the right: rotation about (1, 1, 1) by Rodrigues' formula; red turns to green."""
    angle = np.radians(degrees)
    cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn.T.astype(np.float32)
