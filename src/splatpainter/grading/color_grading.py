"""Color grading: what a photographer does to a whole picture, on colours and on the SH of Gaussians. Pure.

`ColorGrade` is a set of photographic settings and `apply_grade` all of them in the order in which raw developers apply
them: light first (linear), then tone and colour (display). These functions take colours [..., 3], numpy or torch,
float, and return the like; nothing waits for a device. Colours are display sRGB 0..1 unless a name says linear; values
a little outside 0..1 come in from renders and are clipped where a formula needs it.

`GradeSettings` are the settings of an adjustment layer, and `grade_sh` applies them to Gaussians: a base colour goes
through a ColorGrade and through hue bands; the SH bands >= 1 through the same function's Jacobian there (first order),
so that highlights are graded with the surface they lie on. Zeros change nothing, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from splatpainter.array_types import FloatsOrTensor
from splatpainter.color import LUMA, linear_to_srgb, luminance, srgb_to_linear
from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import each, run
from splatpainter.splats import SH_C0, ColorSpace
from splatpainter.system import jsonio
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import out_of_range, ranged
from splatpainter.transforms import stacked

PIVOT = 0.461
"""Display value of 18 % grey: contrast turns around it."""
MIN_CURVE_STEP = 1e-6
"""Smallest distance of a tone curve's points along its input, 0..1: slopes of nearer ones overflow."""
GRADE = "grade"
"""The name of `grade_sh` in the parameters of an adjustment layer ({"look": "grade", ...})."""
ALL_HUES_DEGREES = 1e6
"""To either side: a band of hues that fades out nowhere."""
JACOBIAN_STEP = 1 / 64
"""Step of the finite differences, display units."""
MAX_JACOBIAN_ENTRY = 4.0
"""Where a curve is a cliff, a highlight must not become a spike."""
GAUSSIANS_PER_PIECE = 8192
"""Graded at a time: they fit the processor's cache, and threads share the pieces."""


@dataclass(frozen=True)
class ColorGrade:
    """Photographic settings; the defaults change nothing."""

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


def apply_grade(colors: FloatsOrTensor, grade: ColorGrade) -> FloatsOrTensor:
    """[..., 3] display colours 0..1 after all settings of a grade, clipped to 0..1."""
    # In a raw developer's order: light, tone, curves, toning, saturation.
    return _mix_channels(_grade_channels(colors, grade), grade)


def _grade_channels(colors: FloatsOrTensor, grade: ColorGrade) -> FloatsOrTensor:
    """What a grade does to each channel by itself: all that comes before the toning."""
    out: Any = colors.clip(0, 1)
    if grade.exposure or grade.temperature or grade.tint:
        light = white_balance(expose(srgb_to_linear(out), grade.exposure), grade.temperature, grade.tint)
        out = linear_to_srgb(light.clip(0, 1))
    out = adjust_contrast(out, grade.contrast) if grade.contrast != 1 else out
    out = tone_curve(out, grade.curve) if grade.curve else out
    if grade.channel_curves:
        channels = [tone_curve(out[..., k], points) for k, points in enumerate(grade.channel_curves)]
        out = stacked(channels, out)
    return out


def _mix_channels(out: FloatsOrTensor, grade: ColorGrade) -> FloatsOrTensor:
    """The rest, of what `_grade_channels` gave."""
    if any(grade.shadows) or any(grade.highlights):
        out = split_tone(out, grade.shadows, grade.highlights)
    out = saturate(out, grade.saturation) if grade.saturation != 1 else out
    return out.clip(0, 1)


def expose(linear: FloatsOrTensor, stops: float) -> FloatsOrTensor:
    """Linear light times 2^stops."""
    return linear * 2.0**stops


def white_balance(linear: FloatsOrTensor, temperature: float, tint: float) -> FloatsOrTensor:
    """Linear light under von Kries gains in RGB: temperature 1 is half a stop more red and less blue, tint 1 half a
    stop less green. The gains are scaled so that grey keeps its luminance."""
    # Gains on linear light, scaled so that a grey keeps its luminance.
    gains = (2 ** (temperature / 2), 2 ** (-tint / 2), 2 ** (-temperature / 2))
    level = sum(weight * gain for weight, gain in zip(LUMA, gains, strict=True))
    return stacked([linear[..., k] * (gain / level) for k, gain in enumerate(gains)], linear)


def adjust_contrast(display: FloatsOrTensor, slope: float) -> FloatsOrTensor:
    """A power curve on each side of PIVOT: slope there is `slope`, 0, PIVOT and 1 stay, nothing clips.
    Raises ValueError unless slope > 0."""
    if slope <= 0:
        raise ValueError(f"look: expected a contrast above 0, got {slope:g}")
    if isinstance(display, np.ndarray) and display.dtype == np.float32:
        levels = np.require(display, np.float32, ["C", "A"])
        out = np.empty_like(levels)
        run(kernels.bend_levels, levels.reshape(-1), slope, PIVOT, out.reshape(-1))
        return out
    value = display.clip(0, 1)
    power, where = (portable.power, np.where) if isinstance(value, np.ndarray | np.generic) else _torch_functions()
    # Two power curves that meet at middle grey with one slope: nothing clips at either end.
    dark = value < PIVOT
    bent = power(where(dark, value / PIVOT, (1 - value) / (1 - PIVOT)), slope)
    return where(dark, PIVOT * bent, 1 - (1 - PIVOT) * bent)


def _torch_functions() -> tuple[Callable[..., Any], Callable[..., Any]]:
    import torch

    return torch.pow, torch.where


def saturate(display: FloatsOrTensor, amount: float) -> FloatsOrTensor:
    """Colours moved away from (or to) their own grey."""
    grey = luminance(display)[..., None]
    return grey + amount * (display - grey)


def split_tone(
    display: FloatsOrTensor, shadows: tuple[float, float, float], highlights: tuple[float, float, float]
) -> FloatsOrTensor:
    """Colour added to darks and lights, each at most where its weight, (1 - luma)^2 or luma^2, is largest; pure black
    and white stay."""
    luma = luminance(display).clip(0, 1)
    # Weights vanish at black and white, which have to stay neutral.
    middle = 4 * luma * (1 - luma)
    dark, light = middle * (1 - luma), middle * luma
    return stacked([display[..., k] + dark * shadows[k] + light * highlights[k] for k in range(3)], display)


def tone_curve(values: FloatsOrTensor, points: Sequence[tuple[float, float]]) -> FloatsOrTensor:
    """A tone curve through (in, out) points: piecewise cubic Hermite with the slopes of Fritsch and Carlson (1980), so
    that it is monotone where the points are; constant outside. Values of any shape.
    Raises ValueError for fewer than two points or points not in order."""
    x, y = np.array(points, np.float64).reshape(-1, 2).T
    if len(x) < 2 or (np.diff(x) < MIN_CURVE_STEP).any():
        line = f"at least two points from left to right, {MIN_CURVE_STEP:g} apart"
        raise ValueError(f"look: expected a curve of {line}, got {list(points)}")
    # Plain splines overshoot, and a tone curve that turns back swaps tones.
    slopes = _monotone_slopes(x, y)
    out = values * 0 + float(y[0])
    for k in range(len(x) - 1):  # each piece adds its own rise: outside its interval t is 0 or 1
        width, rise = float(x[k + 1] - x[k]), float(y[k + 1] - y[k])
        first, last = float(slopes[k]) * width, float(slopes[k + 1]) * width
        t = ((values - float(x[k])) / width).clip(0, 1)
        out = out + t * (first + t * (3 * rise - 2 * first - last + t * (first + last - 2 * rise)))
    return out


@dataclass(frozen=True)
class HueBand:
    """A change of one range of hues; greys have no hue and stay."""

    hue: float = ranged(ge=0, lt=360)
    """Middle of the range, degrees (0 red, 120 green, 240 blue)."""
    width: float = ranged(60.0, gt=0, le=ALL_HUES_DEGREES)
    """Degrees to either side over which the change fades out (a raised cosine); 1,000,000: all hues alike."""
    shift: float = ranged(0.0, ge=-360, le=360)
    """Degrees, about the grey axis."""
    saturation: float = ranged(0.0, ge=-1, le=1)
    """-1 grey .. 1 twice as colourful."""
    lightness: float = ranged(0.0, ge=-1, le=1)
    """-1 half .. 1 twice as bright."""

    def __post_init__(self) -> None:
        if (line := out_of_range(self)) is not None:
            raise ValueError(line)


@dataclass(frozen=True)
class ColorSliders:
    """The sliders of a look: what `splatpainter grade`, a JOBS.yaml, an adjustment layer and the page have alike. Zeros
    change nothing."""

    exposure: float = ranged(0.0, ge=-10, le=10)
    """Exposure in stops, of linear light."""
    temperature: float = ranged(0.0, ge=-1, le=1)
    """-1 cold .. 1 warm."""
    tint: float = ranged(0.0, ge=-1, le=1)
    """-1 green .. 1 magenta."""
    contrast: float = ranged(0.0, ge=-1, le=1)
    """-1 .. 1: slope 2^c in the mid-tones."""
    saturation: float = ranged(0.0, ge=-1, le=1)
    """-1 grey .. 1 twice as colourful."""


@dataclass(frozen=True)
class GradeSettings(ColorSliders):
    """The settings of an adjustment layer; the defaults change nothing. Raises ValueError: out of a range."""

    curve: tuple[tuple[float, float], ...] = ranged((), ge=0, le=1, max_length=16)
    """Points (in, out) of display values, left to right; (0, 0) and (1, 1) are added where no point says otherwise."""
    hues: tuple[HueBand, ...] = ranged((), max_length=12)
    """Ranges of hues that change, one after the other."""
    strength: float = ranged(1.0, ge=0, le=1)
    """0..1: how much of the change is taken."""
    space: ColorSpace = "srgb"
    """Space of the asset's colours: "srgb" (display) or "linear"; the sliders act on display colours either way."""

    def __post_init__(self) -> None:
        if (line := out_of_range(self)) is not None:
            raise ValueError(line)

    def to_dict(self) -> dict[str, Any]:
        """Parameters of a layer."""
        return {"look": GRADE, **asdict(self)}

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> GradeSettings:
        """The inverse of `to_dict`. Raises ValueError: unknown fields, no finite numbers, a curve not in order."""
        values = {key: value for key, value in data.items() if key != "look"}
        sliders = jsonio.build(GradeSettings, values, "look", base=GradeSettings())
        curve = sliders.curve
        if any(b[0] - a[0] < MIN_CURVE_STEP for a, b in zip(curve, curve[1:], strict=False)):
            line = f"points from left to right, {MIN_CURVE_STEP:g} apart"
            raise ValueError(f"look: expected a curve of {line}, got {list(curve)}")
        return sliders

    @property
    def neutral(self) -> bool:
        """Whether it changes nothing."""
        sliders = (self.exposure, self.temperature, self.tint, self.contrast, self.saturation)
        bands = any(band.shift or band.saturation or band.lightness for band in self.hues)
        return self.strength == 0 or not (any(sliders) or bands or self._full_curve())

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours 0..1 -> the like."""
        return self.mix_channels(self.grade_channels(colors), colors)

    def grade_channels(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours 0..1 after what happens to each channel by itself, the dear part."""
        return _grade_channels(colors, self._grade())

    def mix_channels(self, toned: np.ndarray, colors: np.ndarray) -> np.ndarray:
        """[..., 3] the rest of the function, of what `grade_channels` made of colours."""
        out = _mix_channels(toned, self._grade())
        for band in self.hues:
            out = shift_hues(out, band)
        return out if self.strength == 1 else colors + np.float32(self.strength) * (out - colors)

    def _grade(self) -> ColorGrade:
        return ColorGrade(
            exposure=self.exposure,
            temperature=self.temperature,
            tint=self.tint,
            contrast=2.0**self.contrast,
            saturation=1 + self.saturation,
            curve=self._full_curve(),
        )

    def _full_curve(self) -> tuple[tuple[float, float], ...]:
        if all(x == y for x, y in self.curve):
            return ()
        first = () if self.curve[0][0] <= 0 else ((0.0, 0.0),)
        last = () if self.curve[-1][0] >= 1 else ((1.0, 1.0),)
        return (*first, *self.curve, *last)


def grade_sh(sh: np.ndarray, settings: Mapping[str, Any]) -> np.ndarray:
    """[N, K, 3] float32 SH after the sliders (GradeSettings's fields); Gaussians that do not change keep their bits.
    Raises ValueError as GradeSettings.from_dict."""
    sliders = GradeSettings.from_dict(settings)
    if sliders.neutral:
        return sh

    return apply_to_sh(sh, sliders, sliders.space)


def apply_to_sh(sh: np.ndarray, function: Callable[[np.ndarray], np.ndarray], space: ColorSpace = "srgb") -> np.ndarray:
    """[N, K, 3] float32 SH after a function of display colours [M, 3] 0..1; Gaussians that do not change keep their
    bits. The bands >= 1 go through the function's Jacobian at the base colour. space: of the SH."""

    sh = np.require(sh, np.float32, ["C", "A"])
    out = np.empty_like(sh)

    def grade_piece(start: int) -> None:
        piece = slice(start, start + GAUSSIANS_PER_PIECE)
        _grade_piece(sh[piece], function, space, out[piece])

    # In pieces that fit the cache, shared among threads.
    each(grade_piece, range(0, len(sh), GAUSSIANS_PER_PIECE))
    return out


@np.errstate(over="ignore", invalid="ignore")  # of functions; in each thread
def _grade_piece(
    sh: np.ndarray, function: Callable[[np.ndarray], np.ndarray], space: ColorSpace, out: np.ndarray
) -> None:
    # The base colours and, for the Jacobian's one-sided differences, these with every channel moved.
    ends = np.empty((2, len(sh), 3), np.float32)
    run(kernels.take_base_colors, sh, SH_C0, JACOBIAN_STEP, ends)
    # What happens to each channel by itself is computed for these two, the rest for the four that come of them.
    bands = sh.shape[1] > 1
    display = ends if bands else ends[:1]
    display = linear_to_srgb(display) if space == "linear" else display
    colors = _moved_in_turn(display) if bands else display
    if isinstance(function, GradeSettings):
        toned = function.grade_channels(display)
        graded = function.mix_channels(_moved_in_turn(toned) if bands else toned, colors)
    else:
        graded = function(colors.reshape(-1, 3)).reshape(colors.shape)
    graded = srgb_to_linear(graded) if space == "linear" else graded
    graded = np.require(graded, np.float32, ["C", "A"])
    run(kernels.grade_bands, sh, ends[0], graded, SH_C0, JACOBIAN_STEP, MAX_JACOBIAN_ENTRY, out)


def _moved_in_turn(ends: np.ndarray) -> np.ndarray:
    """[4, N, 3]: the first of two colours, and it with one channel after the other of the second."""
    out = np.repeat(ends[:1], 4, 0)
    for channel in range(3):
        out[1 + channel, :, channel] = ends[1, :, channel]
    return out


def shift_hues(colors: np.ndarray, band: HueBand) -> np.ndarray:
    """[..., 3] display colours with one range of hues changed; hue as the hexagon of HSV has it."""
    red, green, blue = (colors[..., k] for k in range(3))
    high, low = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    chroma = high - low
    safe = np.where(chroma > 1e-6, chroma, 1)
    # Hue by the hexagon of HSV, in sixths of a turn.
    sextant = np.where(
        high == red,
        (green - blue) / safe % 6,
        np.where(high == green, (blue - red) / safe + 2, (red - green) / safe + 4),
    )
    distance = np.abs((60 * sextant - band.hue + 180) % 360 - 180)
    # A raised cosine: bands fade into each other without an edge.
    weight = np.where(distance < band.width, 0.5 + 0.5 * portable.cos(np.pi * distance / band.width), 0)
    weight = weight * np.minimum(chroma / 0.05, 1)  # what is nearly grey has a hue by chance
    out = portable.matmul(colors, _hue_rotation(band.shift)) if band.shift else colors
    grey = luminance(out)[..., None]
    out = (grey + (1 + band.saturation) * (out - grey)) * 2.0**band.lightness
    return (colors + weight[..., None] * (out - colors)).clip(0, 1).astype(colors.dtype)


def _hue_rotation(degrees: float) -> np.ndarray:
    """[3, 3], to be multiplied from the right: rotation about (1, 1, 1) by Rodrigues' formula; red turns to green."""
    angle = np.radians(degrees)
    cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)
    twice = portable.matmul(cross, cross)
    rotation = np.eye(3) + portable.sin(angle) * cross + (1 - portable.cos(angle)) * twice
    return rotation.T.astype(np.float32)


def random_grade(rng: np.random.Generator) -> ColorGrade:
    """A grade as people make them: one to four of the settings, some strong, most mild."""
    chosen = set(rng.choice(len(_SETTINGS), size=rng.integers(1, 5), replace=False).tolist())
    settings = {}
    for k, name in enumerate(_SETTINGS):
        if k in chosen:
            settings.update(_random_setting(name, rng))
    return ColorGrade(**settings)


_SETTINGS = ("exposure", "white", "contrast", "saturation", "curve", "channels", "split")


def _random_setting(name: str, rng: np.random.Generator) -> dict:
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
    tone = strength * portable.cos(angles)  # of mean 0: opposite hues in darks and lights
    return {"shadows": tuple((tone * balance).tolist()), "highlights": tuple((-tone).tolist())}


def _random_curve(rng: np.random.Generator, amount: float) -> tuple[tuple[float, float], ...]:
    y = np.array([0, 0.25, 0.5, 0.75, 1]) + rng.uniform(-amount, amount, 5) * [0.5, 1, 1, 1, 0.5]
    return tuple(zip((0.0, 0.25, 0.5, 0.75, 1.0), np.sort(y.clip(0, 1)).tolist(), strict=True))


def _monotone_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[K] slopes at the points: three-point means, limited to three times the smaller of the neighbouring secants."""
    secants = np.diff(y) / np.diff(x)
    slopes = np.concatenate([secants[:1], (secants[:-1] + secants[1:]) / 2, secants[-1:]])
    # Fritsch and Carlson: where neighbouring secants differ in sign the slope is 0, else at most three times the
    # smaller.
    left, right = np.concatenate([secants[:1], secants]), np.concatenate([secants, secants[-1:]])
    limit = 3 * np.minimum(np.abs(left), np.abs(right))
    return np.where(left * right <= 0, 0, np.clip(slopes, -limit, limit))
