"""How a picture's colours drifted from those of the render that it was made from, and their way back.

Image services and cameras of screens change exposure and white balance a little, everywhere. In linear light that is a
gain per channel, with an offset for haze, or a 3 x 4 matrix where channels were mixed. It is estimated on pixels that
should be as they were, by iteratively reweighted least squares (Holland and Welsch 1977) with Tukey's weights, so that
what was painted over does not count. Pure; colours are display sRGB 0..1, [P, 3] or [H, W, 3].
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.kernels.portable import gram, matmul, solved, transposed_product
from splatpainter.lift.masks import box_mean, largest_channel
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import principal_axes

DriftKind = Literal["none", "gain", "gain and offset", "matrix"]


@dataclass(frozen=True)
class DriftThresholds:
    """What a program did to all colours of a picture. In linear light unless said. Source: taste, tried on services'
    pictures, where an entry names none."""

    max_reweightings: int = 30
    """Most rounds of reweighting."""
    color_levels: int = 16
    """Steps of each channel by which colours are told apart when pixels are drawn for the fit."""
    max_of_a_color: int = 250
    """Pixels of each such colour that are fitted: a bare background must not outvote all."""
    min_samples: int = 64
    """Pixels that a fit needs."""
    unclipped_range: tuple[float, float] = (0.01, 0.985)
    """Display values beyond which a pixel was clipped and says nothing."""
    tukey: float = 4.685
    """Standard deviations beyond which a pixel does not count (Tukey's biweight, 95 % efficient on normal noise)."""
    min_spread: float = 0.002
    """Standard deviation, linear light, below which differences are rounding."""
    min_agreeing: float = 0.4
    """Share of the pixels that must agree after the correction, where any of them may have been painted over."""
    min_agreeing_masked: float = 0.15
    """The same where a mask says that none was to be painted over."""
    max_mixed: float = 0.3
    """Largest part of one channel that drifts into another."""
    max_agreeing_difference: float = 0.02
    """Largest difference, display values, of a pixel that agrees."""
    min_gain_range: float = 0.03
    """Standard deviation of linear light from which an offset can be told from a gain."""
    min_matrix_range: float = 0.004
    """Smallest principal deviation of the colours from which a matrix can be told."""
    min_improvement: float = 0.85
    """A richer model is taken only where it leaves at most this part of the simpler one's error."""
    min_drift: float = 0.75 / 255
    """Mean correction, display values, below which there is none."""
    min_tone: float = 0.03
    """Mean change of a channel, display values, from which a tone that changed everywhere was asked for: services drift
    by less."""
    min_toned: float = 0.93
    """Share of the pixels that one function of colour must explain for nothing but the tone to have changed."""
    max_tone_error: float = 0.04
    """Error of their 3 x 3 means, display values, up to which it explains them."""
    painted_px: int = 2
    """Reach of the squares in which what is left unexplained is counted, pixels: compression leaves lines at edges,
    paint areas."""
    painted_share: float = 0.9
    """Share of such a square that may be left unexplained."""


DRIFT = DriftThresholds()


@dataclass(frozen=True)
class ColorDrift:
    """The way back of drifted colours, in linear light."""

    kind: DriftKind
    matrix: np.ndarray
    """[3, 4]: corrected = matrix @ (red, green, blue, 1)."""
    agreeing: float = 1.0
    """Share of the pixels that were compared and agree after the correction."""

    @property
    def stops(self) -> float:
        """Exposure by which the picture was too bright (> 0) or too dark: of grey, by the mean channel."""
        return -math.log2(max(float(self.matrix[:, :3].sum(1).mean()), 1e-3))

    @property
    def strength(self) -> float:
        """The largest change of a channel of mid grey, in stops."""
        grey = 0.18
        after = np.maximum((self.matrix * np.array([grey, grey, grey, 1.0])).sum(1), 1e-3)
        return float(np.abs(np.log2(after / grey)).max())

    def corrected(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours as they should have come; the same array where nothing drifted."""
        if self.kind == "none":
            return colors
        light = srgb_to_linear(np.clip(colors, 0, 1).astype(np.float32))
        out = matmul(light, self.matrix[:, :3].T.astype(np.float32)) + self.matrix[:, 3].astype(np.float32)
        return linear_to_srgb(np.clip(out, 0, 1)).astype(np.float32)

    def record(self) -> dict:
        """The drift as receipts record it."""
        return {"kind": self.kind, "matrix": np.round(self.matrix, 5).tolist(), "agreeing": round(self.agreeing, 4)}


NO_DRIFT = ColorDrift("none", np.eye(3, 4))


def estimate_drift(picture: np.ndarray, render: np.ndarray, reference: np.ndarray, certain: bool) -> ColorDrift:
    """The drift of a picture [H, W, 3] that lies over its render [H, W, 3], on the pixels `reference` [H, W] bool.

    certain: whether nobody was to change these (a mask says so). A correction that makes too few of them agree, or that
    exchanges channels, is none: there the picture was changed on purpose."""
    low, high = DRIFT.unclipped_range
    # Clipped values say "at least so bright": they would pull any fit.
    usable = reference & ((picture > low) & (picture < high) & (render > low) & (render < high)).all(-1)
    if usable.sum() < DRIFT.min_samples:
        return NO_DRIFT
    # An even choice of colours: a large plain background must not decide alone.
    ids = _samples(np.flatnonzero(usable), render)
    display, expected = (image.reshape(-1, 3)[ids].astype(np.float64) for image in (picture, render))
    source, target = srgb_to_linear(display), srgb_to_linear(expected)
    drift, error = NO_DRIFT, math.inf
    # Simplest first; a richer model has to pay for its parameters with a clearly smaller error.
    for kind in _models(source):
        matrix = _fitted(source, target, kind)
        after = ColorDrift(kind, matrix).corrected(display)
        distance = largest_channel(np.abs(after - expected))
        # Capped, so that painted pixels weigh no more than any other disagreement; a quarter level keeps it above 0.
        rest = float(np.minimum(distance, 2 * DRIFT.max_agreeing_difference).mean()) + 0.25 / 255
        # A matrix that exchanges channels is an edit (a recolouring), not a drift.
        mixed = np.abs(matrix[:, :3] - np.diag(np.diag(matrix[:, :3]))).max()
        if rest < DRIFT.min_improvement * error and mixed < DRIFT.max_mixed:
            drift, error = ColorDrift(kind, matrix, float((distance < DRIFT.max_agreeing_difference).mean())), rest
    if drift.agreeing < (DRIFT.min_agreeing_masked if certain else DRIFT.min_agreeing):
        return NO_DRIFT
    # Below a level there is nothing to correct, and correcting would change every pixel.
    moved = np.abs(drift.corrected(display) - display).mean(0).max()
    return drift if moved > DRIFT.min_drift else NO_DRIFT


def tone_change(picture: np.ndarray, render: np.ndarray, reference: np.ndarray) -> float | None:
    """How much a picture [H, W, 3] that lies over its render changed tone as a whole: the largest mean change of a
    channel, display values, where `expected_tone` explains the pixels `reference` [H, W] bool; None where something
    else changed, too."""
    if expected_tone(picture, render, reference) is None:
        return None
    return float(np.abs(picture - render)[reference].mean(0).max())


def expected_tone(picture: np.ndarray, render: np.ndarray, reference: np.ndarray) -> np.ndarray | None:
    """[H, W, 3] as `likeliest_tone`, where it explains the pixels `reference`; None where something else changed,
    too."""
    expected = likeliest_tone(picture, render, reference)
    if expected is None:
        return None
    # Means over 3 x 3 pixels: compression averages out, a repainted patch does not.
    left = largest_channel(np.abs(box_mean((picture - expected) * reference[..., None], 1))) > DRIFT.max_tone_error
    left &= reference
    if (
        left.sum() > (1 - DRIFT.min_toned) * reference.sum()
        or (box_mean(left, DRIFT.painted_px) > DRIFT.painted_share).any()
    ):
        return None
    return expected


def likeliest_tone(picture: np.ndarray, render: np.ndarray, reference: np.ndarray) -> np.ndarray | None:
    """[H, W, 3] what one smooth function of colour makes of a render [H, W, 3]: the one that explains most of the
    pixels `reference` [H, W] bool of a picture [H, W, 3] over it, some of which may be painted over. None where too few
    say.

    The function is a cubic polynomial of the display colours (curves, exposure, balance, hue, saturation); what it
    clips may be clipped in the picture."""
    low, high = DRIFT.unclipped_range
    # Here the render may be clipped: the function is fitted from it, not back to it.
    usable = reference & ((picture > low) & (picture < high)).all(-1)
    if usable.sum() < DRIFT.min_samples:
        return None
    ids = _samples(np.flatnonzero(usable), render)
    source, target = _powers(render.reshape(-1, 3)[ids]), picture.reshape(-1, 3)[ids].astype(np.float64)
    share = np.ones(len(ids))
    coefficients = np.zeros((source.shape[1], 3))
    # The polynomial is linear in its coefficients, so fewer rounds settle it.
    for _ in range(DRIFT.max_reweightings // 3):
        normal = gram(source, share)
        normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
        coefficients = solved(normal, transposed_product(source * share[:, None], target))
        distance = np.linalg.norm(matmul(source, coefficients) - target, axis=1)
        spread = max(float(np.median(distance)), DRIFT.min_spread)
        share = np.maximum(1 - (distance / (DRIFT.tukey * spread)) ** 2, 0) ** 2
    return np.clip(matmul(_powers(render.reshape(-1, 3)), coefficients), 0, 1).reshape(render.shape)


def _powers(colors: np.ndarray) -> np.ndarray:
    """[P, 13] the terms of a cubic polynomial without mixed cubes; colors: [P, 3]."""
    r, g, b = colors.astype(np.float64).T
    cubes = (r * r * r, g * g * g, b * b * b)
    return np.stack([np.ones_like(r), r, g, b, r * r, g * g, b * b, r * g, r * b, g * b, *cubes], 1)


def _samples(ids: np.ndarray, render: np.ndarray) -> np.ndarray:
    """At most DRIFT.max_of_a_color of the pixels of each colour of the render, evenly over the picture."""
    steps = (render.reshape(-1, 3)[ids] * DRIFT.color_levels).astype(int)
    label = (steps[:, 0] * (DRIFT.color_levels + 1) + steps[:, 1]) * (DRIFT.color_levels + 1) + steps[:, 2]
    # Every n-th of each colour, in the order of the picture: no random numbers, so equal input gives equal answers.
    order = np.argsort(label, kind="stable")
    _, first, count = np.unique(label[order], return_index=True, return_counts=True)
    rank = np.arange(len(ids)) - np.repeat(first, count)
    stride = np.repeat(-(-count // DRIFT.max_of_a_color), count)
    return np.sort(ids[order[rank % stride == 0]])


def _models(source: np.ndarray) -> list[DriftKind]:
    """Those that these colours can tell apart, simplest first."""
    # An offset needs bright and dark pixels, a matrix colours that differ in all directions: else they are not
    # determined.
    out: list[DriftKind] = ["gain"]
    if source.std(0).min() > DRIFT.min_gain_range:
        out.append("gain and offset")
        if math.sqrt(max(_least_variance(source), 0)) > DRIFT.min_matrix_range:
            out.append("matrix")
    return out


def _least_variance(source: np.ndarray) -> float:
    """Of colours [P, 3] along the direction in which they differ least."""
    away = source - source.mean(0)
    return float(principal_axes(transposed_product(away, away)[None] / (len(source) - 1))[0][0, 0])


def _fitted(source: np.ndarray, target: np.ndarray, kind: DriftKind) -> np.ndarray:
    """[3, 4] by reweighted least squares, from the median ratio on."""
    matrix = np.zeros((3, 4))
    # A robust start: with a bad one the reweighting would lock onto what was painted over.
    np.fill_diagonal(matrix, np.median(target / source, axis=0))
    if kind != "gain":  # a weak start cannot leave what is painted over; the simpler model's answer is a better one
        matrix = _fitted(source, target, "gain")
    homogeneous = np.concatenate([source, np.ones((len(source), 1))], 1)
    for _ in range(DRIFT.max_reweightings):
        error = matmul(homogeneous, matrix.T) - target
        distance = np.linalg.norm(error, axis=1)
        # Scale from the median, so that half of the pixels may be painted over.
        spread = max(float(np.median(distance)), DRIFT.min_spread)
        share = np.maximum(1 - (distance / (DRIFT.tukey * spread)) ** 2, 0) ** 2
        previous, matrix = matrix, _least_squares(homogeneous, target, share, kind)
        if np.abs(matrix - previous).max() < 1e-5:
            break
    return matrix


def _least_squares(source: np.ndarray, target: np.ndarray, share: np.ndarray, kind: DriftKind) -> np.ndarray:
    """[3, 4] of one kind, pulled weakly to no change."""
    out = np.eye(3, 4)
    weighted = source * share[:, None]
    for channel in range(3):
        # Each channel by itself: which columns it may use is what tells the models apart.
        free = {"gain": [channel], "gain and offset": [channel, 3]}.get(kind, [0, 1, 2, 3])
        fixed = np.eye(4)[channel][free]
        normal = gram(source[:, free], share)
        ridge = 1e-5 * np.trace(normal) * np.eye(len(free))
        gain = transposed_product(weighted[:, free], target[:, [channel]]) + matmul(ridge, fixed[:, None])
        out[channel] = 0
        out[channel, free] = solved(normal + ridge, gain)[:, 0]
    return out
