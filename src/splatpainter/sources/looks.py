"""Looks: what a photographer does to a whole picture, as pure functions of colour. No pixel looks at another one.

Every function takes colours [..., 3], numpy or torch, float, and returns the like; nothing is changed in place and
nothing waits for a device. Colours are display sRGB 0..1 unless a name says linear; values a little outside 0..1 come
in from renders and are clipped where a formula needs it. A `Look` is a set of settings; `apply_look` is all of them in
the order in which raw developers apply them: light first (linear), then tone and colour (display).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpainter.splats import Array

LUMA = (0.2126, 0.7152, 0.0722)
"""Weights of Rec. 709: the luminance of linear colours, and near enough the luma of display colours."""
PIVOT = 0.461
"""Display value of 18 % grey: contrast turns around it."""
MIN_CURVE_STEP = 1e-6
"""Least distance of a tone curve's points along its input, 0..1: slopes of nearer ones overflow."""


@dataclass(frozen=True)
class Look:
    """Settings of a regrade; the defaults change nothing."""

    exposure: float = 0.0
    """Stops (EV), of linear light."""
    temperature: float = 0.0
    """-1 (blue) .. 1 (amber)."""
    tint: float = 0.0
    """-1 (green) .. 1 (magenta)."""
    contrast: float = 1.0
    """Slope in the mid-tones, > 0."""
    saturation: float = 1.0
    """0: grey; 1: as it is; 2: strong."""
    curve: tuple[tuple[float, float], ...] = ()
    """Points (in, out) 0..1 of a tone curve for all channels; empty: none."""
    channel_curves: tuple[tuple[tuple[float, float], ...], ...] = ()
    """Three such curves, red, green, blue; empty: none."""
    shadows: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Split toning: what is added to the darks, display units."""
    highlights: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Split toning: what is added to the lights, display units."""


def apply_look(colors: Array, look: Look) -> Array:
    """[..., 3] display colours 0..1 after a look, clipped to 0..1."""
    out = colors.clip(0, 1)
    if look.exposure or look.temperature or look.tint:
        light = white_balanced(exposed(to_linear(out), look.exposure), look.temperature, look.tint)
        out = to_display(light.clip(0, 1))
    out = contrasted(out, look.contrast) if look.contrast != 1 else out
    out = curved(out, look.curve) if look.curve else out
    if look.channel_curves:
        channels = [curved(out[..., k], points) for k, points in enumerate(look.channel_curves)]
        out = _stacked(channels)
    if any(look.shadows) or any(look.highlights):
        out = split_toned(out, look.shadows, look.highlights)
    out = saturated(out, look.saturation) if look.saturation != 1 else out
    return out.clip(0, 1)


def to_linear(display: Array) -> Array:
    """sRGB 0..1 -> linear light 0..1 (IEC 61966-2-1)."""
    low = display <= 0.04045
    return low * (display / 12.92) + ~low * ((display.clip(0.04045, None) + 0.055) / 1.055) ** 2.4


def to_display(linear: Array) -> Array:
    """Linear light 0..1 -> sRGB 0..1, the inverse of `to_linear`."""
    low = linear <= 0.0031308
    return low * (12.92 * linear) + ~low * (1.055 * linear.clip(0.0031308, None) ** (1 / 2.4) - 0.055)


def luminance(colors: Array) -> Array:
    """[..., 3] -> [...] Rec. 709 weighted sum."""
    return LUMA[0] * colors[..., 0] + LUMA[1] * colors[..., 1] + LUMA[2] * colors[..., 2]


def exposed(linear: Array, stops: float) -> Array:
    """Linear light times 2^stops."""
    return linear * 2.0**stops


def white_balanced(linear: Array, temperature: float, tint: float) -> Array:
    """Linear light under von Kries gains in RGB: temperature 1 is half a stop more red and less blue, tint 1 half a
    stop less green. The gains are scaled so that grey keeps its luminance."""
    gains = (2 ** (temperature / 2), 2 ** (-tint / 2), 2 ** (-temperature / 2))
    level = sum(weight * gain for weight, gain in zip(LUMA, gains, strict=True))
    return _stacked([linear[..., k] * (gain / level) for k, gain in enumerate(gains)])


def contrasted(display: Array, slope: float) -> Array:
    """A power curve on each side of PIVOT: slope there is `slope`, 0, PIVOT and 1 stay, nothing clips.
    Raises ValueError unless slope > 0."""
    if slope <= 0:
        raise ValueError(f"look: expected a contrast above 0, got {slope:g}")
    value = display.clip(0, 1)
    dark = PIVOT * (value.clip(None, PIVOT) / PIVOT) ** slope
    light = (1 - PIVOT) * (1 - ((1 - value.clip(PIVOT, None)) / (1 - PIVOT)) ** slope)
    return dark + light


def saturated(display: Array, amount: float) -> Array:
    """Colours moved away from (or to) their own grey."""
    grey = luminance(display)[..., None]
    return grey + amount * (display - grey)


def split_toned(display: Array, shadows: tuple[float, float, float], highlights: tuple[float, float, float]) -> Array:
    """Colour added to darks and lights, each at most where its weight, (1 - luma)^2 or luma^2, is largest; pure black
    and white stay."""
    luma = luminance(display).clip(0, 1)
    room = 4 * luma * (1 - luma)
    dark, light = room * (1 - luma), room * luma
    return _stacked([display[..., k] + dark * shadows[k] + light * highlights[k] for k in range(3)])


def curved(values: Array, points: Sequence[tuple[float, float]]) -> Array:
    """A tone curve through (in, out) points: piecewise cubic Hermite with the slopes of Fritsch and Carlson (1980), so
    that it is monotone where the points are; constant outside. Values of any shape.
    Raises ValueError for fewer than two points or points not in order."""
    x, y = np.array(points, np.float64).reshape(-1, 2).T
    if len(x) < 2 or (np.diff(x) < MIN_CURVE_STEP).any():
        line = f"at least two points from left to right, {MIN_CURVE_STEP:g} apart"
        raise ValueError(f"look: expected a curve of {line}, got {list(points)}")
    slopes = _monotone_slopes(x, y)
    out = values * 0 + float(y[0])
    for k in range(len(x) - 1):  # each piece adds its own rise: outside its interval t is 0 or 1
        width, rise = float(x[k + 1] - x[k]), float(y[k + 1] - y[k])
        first, last = float(slopes[k]) * width, float(slopes[k + 1]) * width
        t = ((values - float(x[k])) / width).clip(0, 1)
        out = out + t * (first + t * (3 * rise - 2 * first - last + t * (first + last - 2 * rise)))
    return out


def random_look(rng: np.random.Generator) -> Look:
    """A look as people make them: one to four of the settings, some strong, most mild."""
    chosen = set(rng.choice(len(_SETTINGS), size=rng.integers(1, 5), replace=False).tolist())
    settings = {}
    for k, name in enumerate(_SETTINGS):
        if k in chosen:
            settings.update(_drawn(name, rng))
    return Look(**settings)


_SETTINGS = ("exposure", "white", "contrast", "saturation", "curve", "channels", "split")


def _drawn(name: str, rng: np.random.Generator) -> dict:
    if name == "exposure":
        return {"exposure": float(rng.uniform(-1.5, 1.2))}
    if name == "white":
        return {"temperature": float(rng.uniform(-1.2, 1.2)), "tint": float(rng.uniform(-0.6, 0.6))}
    if name == "contrast":
        return {"contrast": float(rng.uniform(0.6, 1.8))}
    if name == "saturation":
        return {"saturation": float(rng.choice([0.0, rng.uniform(0.2, 0.8), rng.uniform(1.2, 2.0)], p=[0.1, 0.4, 0.5]))}
    if name == "curve":
        return {"curve": _random_curve(rng, 0.12)}
    if name == "channels":
        return {"channel_curves": tuple(_random_curve(rng, 0.10) for _ in range(3))}
    hue = rng.uniform(0, 2 * np.pi)
    angles = hue + np.array([0, 2 * np.pi / 3, 4 * np.pi / 3])
    strength, balance = rng.uniform(0.08, 0.35), rng.uniform(0.3, 1)
    tone = strength * np.cos(angles)  # of mean 0: opposite hues in darks and lights
    return {"shadows": tuple((tone * balance).tolist()), "highlights": tuple((-tone).tolist())}


def _random_curve(rng: np.random.Generator, amount: float) -> tuple[tuple[float, float], ...]:
    y = np.array([0, 0.25, 0.5, 0.75, 1]) + rng.uniform(-amount, amount, 5) * [0.5, 1, 1, 1, 0.5]
    return tuple(zip((0.0, 0.25, 0.5, 0.75, 1.0), np.sort(y.clip(0, 1)).tolist(), strict=True))


def _monotone_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[K] slopes at the points: three-point means, limited to three times the smaller of the neighbouring secants."""
    secants = np.diff(y) / np.diff(x)
    slopes = np.concatenate([secants[:1], (secants[:-1] + secants[1:]) / 2, secants[-1:]])
    left, right = np.concatenate([secants[:1], secants]), np.concatenate([secants, secants[-1:]])
    limit = 3 * np.minimum(np.abs(left), np.abs(right))
    return np.where(left * right <= 0, 0, np.clip(slopes, -limit, limit))


def _stacked(channels: list[Array]) -> Array:
    if isinstance(channels[0], np.ndarray):
        return np.stack(channels, -1)
    import torch

    return torch.stack(channels, -1)
