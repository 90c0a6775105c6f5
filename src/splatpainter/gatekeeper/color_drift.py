"""How a picture's colours drifted from those of the render that it was made from, and their way back.

Image services and cameras of screens change exposure and white balance a little, everywhere. In linear light that is a
gain per channel, with an offset for haze, or a 3 x 4 matrix where channels were mixed. It is estimated on pixels that
should be as they were, by iteratively reweighted least squares (Holland and Welsch 1977) with Tukey's weights, so that
what was painted over does not count. Pure; colours are display sRGB 0..1, [P, 3] or [H, W, 3].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.lift.masks import box_mean, largest_channel

DriftKind = Literal["none", "gain", "gain and offset", "matrix"]
MAX_REWEIGHTINGS = 30
"""Most rounds of reweighting."""
COLOR_LEVELS, MAX_OF_A_COLOR = 16, 250
"""Steps of each channel, and pixels that are fitted of each colour in them: a bare background must not outvote all."""
MIN_SAMPLES = 64
"""... at least."""
UNCLIPPED_RANGE = (0.01, 0.985)
"""Display values beyond which a pixel was clipped and says nothing."""
TUKEY = 4.685
"""Standard deviations beyond which a pixel does not count."""
MIN_SPREAD = 0.002
"""Standard deviation, linear light, below which differences are rounding."""
MIN_AGREEING = 0.4
"""Share of the pixels that must agree after the correction, where any of them may have been painted over."""
MIN_AGREEING_MASKED = 0.15
"""... and where a mask says that none was to be."""
MAX_MIXED = 0.3
"""Largest part of one channel that drifts into another."""
MAX_AGREEING_DIFFERENCE = 0.02
"""Largest difference, display values, of a pixel that agrees."""
MIN_GAIN_RANGE = 0.03
"""Standard deviation of linear light from which an offset can be told from a gain."""
MIN_MATRIX_RANGE = 0.004
"""Smallest principal deviation of the colours from which a matrix can be told."""
MIN_IMPROVEMENT = 0.85
"""A richer model is taken only where it leaves at most this part of the simpler one's error."""
MIN_DRIFT = 0.75 / 255
"""Mean correction, display values, below which there is none."""
MIN_TONE = 0.03
"""Mean change of a channel, display values, from which a tone that changed everywhere was asked for: services drift by
less."""
MIN_TONED, MAX_TONE_ERROR = 0.93, 0.04
"""Share of the pixels that one function of colour must explain, to this error of their 3 x 3 means, for nothing but the
tone to have changed; ..."""
PAINTED_PX, PAINTED_SHARE = 2, 0.9
"""... and in no square of this reach may so large a share be left: compression leaves lines at edges, paint areas."""


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
        after = np.maximum(self.matrix @ np.array([grey, grey, grey, 1.0]), 1e-3)
        return float(np.abs(np.log2(after / grey)).max())

    def corrected(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] display colours as they should have come; the same array where nothing drifted."""
        if self.kind == "none":
            return colors
        light = srgb_to_linear(np.clip(colors, 0, 1).astype(np.float32))
        out = light @ self.matrix[:, :3].T.astype(np.float32) + self.matrix[:, 3].astype(np.float32)
        return linear_to_srgb(np.clip(out, 0, 1)).astype(np.float32)

    def record(self) -> dict:
        """The drift as receipts record it."""
        return {"kind": self.kind, "matrix": np.round(self.matrix, 5).tolist(), "agreeing": round(self.agreeing, 4)}


NO_DRIFT = ColorDrift("none", np.eye(3, 4))


def estimate_drift(picture: np.ndarray, render: np.ndarray, reference: np.ndarray, certain: bool) -> ColorDrift:
    """The drift of a picture [H, W, 3] that lies over its render [H, W, 3], on the pixels `reference` [H, W] bool.

    certain: whether nobody was to change these (a mask says so). A correction that makes too few of them agree, or that
    exchanges channels, is none: there the picture was changed on purpose."""
    low, high = UNCLIPPED_RANGE
    usable = reference & ((picture > low) & (picture < high) & (render > low) & (render < high)).all(-1)
    if usable.sum() < MIN_SAMPLES:
        return NO_DRIFT
    ids = _samples(np.flatnonzero(usable), render)
    display, expected = (image.reshape(-1, 3)[ids].astype(np.float64) for image in (picture, render))
    source, target = srgb_to_linear(display), srgb_to_linear(expected)
    drift, error = NO_DRIFT, math.inf
    for kind in _models(source):
        matrix = _fitted(source, target, kind)
        after = ColorDrift(kind, matrix).corrected(display)
        distance = largest_channel(np.abs(after - expected))
        rest = float(np.minimum(distance, 2 * MAX_AGREEING_DIFFERENCE).mean()) + 0.25 / 255
        mixed = np.abs(matrix[:, :3] - np.diag(np.diag(matrix[:, :3]))).max()
        if rest < MIN_IMPROVEMENT * error and mixed < MAX_MIXED:
            drift, error = ColorDrift(kind, matrix, float((distance < MAX_AGREEING_DIFFERENCE).mean())), rest
    if drift.agreeing < (MIN_AGREEING_MASKED if certain else MIN_AGREEING):
        return NO_DRIFT
    moved = np.abs(drift.corrected(display) - display).mean(0).max()
    return drift if moved > MIN_DRIFT else NO_DRIFT


def tone_change(picture: np.ndarray, render: np.ndarray, reference: np.ndarray) -> float | None:
    """How much a picture [H, W, 3] that lies over its render changed tone as a whole: the largest mean change of a
    channel, display values, where one smooth function of colour explains the pixels `reference` [H, W] bool; None where
    something else changed, too.

    The function is a cubic polynomial of the display colours (curves, exposure, balance, hue, saturation); what it
    clips may be clipped in the picture."""
    low, high = UNCLIPPED_RANGE
    usable = reference & ((picture > low) & (picture < high)).all(-1)
    if usable.sum() < MIN_SAMPLES:
        return None
    ids = _samples(np.flatnonzero(usable), render)
    source, target = _powers(render.reshape(-1, 3)[ids]), picture.reshape(-1, 3)[ids].astype(np.float64)
    share = np.ones(len(ids))
    coefficients = np.zeros((source.shape[1], 3))
    for _ in range(MAX_REWEIGHTINGS // 3):
        weighted = source * share[:, None]
        normal = weighted.T @ source
        normal += 1e-6 * np.trace(normal) / len(normal) * np.eye(len(normal))
        coefficients = np.linalg.solve(normal, weighted.T @ target)
        distance = np.linalg.norm(source @ coefficients - target, axis=1)
        spread = max(float(np.median(distance)), MIN_SPREAD)
        share = np.maximum(1 - (distance / (TUKEY * spread)) ** 2, 0) ** 2
    expected = np.clip(_powers(render.reshape(-1, 3)) @ coefficients, 0, 1).reshape(render.shape)
    left = largest_channel(np.abs(box_mean((picture - expected) * reference[..., None], 1))) > MAX_TONE_ERROR
    left &= reference
    if left.sum() > (1 - MIN_TONED) * reference.sum() or (box_mean(left, PAINTED_PX) > PAINTED_SHARE).any():
        return None
    return float(np.abs(picture - render)[reference].mean(0).max())


def _powers(colors: np.ndarray) -> np.ndarray:
    """[P, 13] the terms of a cubic polynomial without mixed cubes; colors: [P, 3]."""
    r, g, b = colors.astype(np.float64).T
    return np.stack([np.ones_like(r), r, g, b, r * r, g * g, b * b, r * g, r * b, g * b, r**3, g**3, b**3], 1)


def _samples(ids: np.ndarray, render: np.ndarray) -> np.ndarray:
    """At most MAX_OF_A_COLOR of the pixels of each colour of the render, evenly over the picture."""
    steps = (render.reshape(-1, 3)[ids] * COLOR_LEVELS).astype(int)
    label = (steps[:, 0] * (COLOR_LEVELS + 1) + steps[:, 1]) * (COLOR_LEVELS + 1) + steps[:, 2]
    order = np.argsort(label, kind="stable")
    _, first, count = np.unique(label[order], return_index=True, return_counts=True)
    rank = np.arange(len(ids)) - np.repeat(first, count)
    stride = np.repeat(-(-count // MAX_OF_A_COLOR), count)
    return np.sort(ids[order[rank % stride == 0]])


def _models(source: np.ndarray) -> list[DriftKind]:
    """Those that these colours can tell apart, simplest first."""
    out: list[DriftKind] = ["gain"]
    if source.std(0).min() > MIN_GAIN_RANGE:
        out.append("gain and offset")
        if math.sqrt(max(float(np.linalg.eigvalsh(np.cov(source.T))[0]), 0)) > MIN_MATRIX_RANGE:
            out.append("matrix")
    return out


def _fitted(source: np.ndarray, target: np.ndarray, kind: DriftKind) -> np.ndarray:
    """[3, 4] by reweighted least squares, from the median ratio on."""
    matrix = np.zeros((3, 4))
    np.fill_diagonal(matrix, np.median(target / source, axis=0))
    if kind != "gain":  # a weak start cannot leave what is painted over; the simpler model's answer is a better one
        matrix = _fitted(source, target, "gain")
    homogeneous = np.concatenate([source, np.ones((len(source), 1))], 1)
    for _ in range(MAX_REWEIGHTINGS):
        error = homogeneous @ matrix.T - target
        distance = np.linalg.norm(error, axis=1)
        spread = max(float(np.median(distance)), MIN_SPREAD)
        share = np.maximum(1 - (distance / (TUKEY * spread)) ** 2, 0) ** 2
        previous, matrix = matrix, _least_squares(homogeneous, target, share, kind)
        if np.abs(matrix - previous).max() < 1e-5:
            break
    return matrix


def _least_squares(source: np.ndarray, target: np.ndarray, share: np.ndarray, kind: DriftKind) -> np.ndarray:
    """[3, 4] of one kind, pulled weakly to no change."""
    out = np.eye(3, 4)
    weighted = source * share[:, None]
    for channel in range(3):
        free = {"gain": [channel], "gain and offset": [channel, 3]}.get(kind, [0, 1, 2, 3])
        fixed = np.eye(4)[channel][free]
        normal = weighted[:, free].T @ source[:, free]
        ridge = 1e-5 * np.trace(normal) * np.eye(len(free))
        gain = weighted[:, free].T @ target[:, channel] + ridge @ fixed
        out[channel] = 0
        out[channel, free] = np.linalg.solve(normal + ridge, gain)
    return out
