"""Local contrast that was raised in all of a picture: unsharp masks, clarity, structure, the details of HDR programs.

Each adds to a picture what it has beyond some blurs of itself. How much of which blur fits best by least squares, and
what was added is taken back by solving for the picture of which it would have been made: from the halo around a stroke,
too. Pure. H, W: pixels of the view; colours are display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.gatekeeper.small_copies import COPIES, Explanation, Mistake, mean_difference, small_copy
from splatpainter.kernels.portable import gram, solved, transposed_product
from splatpainter.lift.masks import box_mean, largest_channel
from splatpainter.order_statistics import median
from splatpainter.pictures.encodings import busiest
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class LocalContrastThresholds:
    """When local contrast was raised. Display values, pixels of the view; source: taste, tried on views of five assets
    where an entry says so."""

    blurs: tuple[tuple[int, int], ...] = ((1, 1), (1, 3), (2, 3), (4, 3), (8, 3), (16, 3), (32, 3))
    """Reach of a box and how often it is applied: deviations of 0.8, 1.4, 2.4, 4.5, 8.5, 16 and 32 pixels."""
    wide_px: int = 4
    """Reach from which it is no sharpening, which may be meant, but contrast."""
    max_px: int = 768
    """Side of the part of a picture that is looked at."""
    max_samples: int = 40000
    """Pixels that are fitted, at most."""
    min_samples: int = 256
    reweightings: int = 6
    """Rounds of reweighting by which painted pixels, and halos around them, stop to count."""
    min_deviation: float = 0.004
    """Deviation of what is left below which it is rounding."""
    min_gain: float = 0.08
    """Sum of what is added, in parts of the detail beyond a blur: less is noise."""
    min_predicted: float = 7 / 255
    """Change that a pixel must show to count."""
    min_predicted_share: float = 0.03
    """Share of the asset that must change by it."""
    max_error: float = 5 / 255
    """How near the picture is to what was fitted."""
    min_explained: float = 0.6
    """Share of what it changes that must be as near; a dab, and its halo, are not."""
    max_contradicting: float = 0.03
    """Share of what it changes that may be as it was rendered. What was sharpened by hand leaves the rest."""
    rounds: int = 24
    """Rounds in which it is taken back; each halves what is left, where as much was added as was there."""


LOCAL = LocalContrastThresholds()
CONTRAST_WORDS = "of more local contrast all over (clarity, structure, HDR toning, a wide unsharp mask)"
SHARPER_WORDS = "sharpened all over (an unsharp mask)"


def raised_contrast(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray, agreeing: float) -> Explanation | None:
    """Local contrast as the explanation of a picture [H, W, 3]; None where it is none. render: [H, W, 3]; alpha:
    [H, W]; agreeing: share of what they show that agrees as it is."""
    part = busiest(alpha, LOCAL.max_px)
    seen, before, solid = picture[part], np.clip(render[part], 0, 1), alpha[part] > COPIES.min_cover
    gains = _fitted(seen, before, solid)
    if gains is None:
        return None
    made = _raised(before, gains)
    predicted = solid & (largest_channel(np.abs(made - before)) > LOCAL.min_predicted)
    if predicted.sum() < LOCAL.min_predicted_share * solid.sum():
        return None
    unchanged = largest_channel(np.abs(seen - before)) <= COPIES.max_unchanged
    near = largest_channel(np.abs(seen - made)) <= LOCAL.max_error
    if unchanged[predicted].mean() > LOCAL.max_contradicting or near[predicted].mean() < LOCAL.min_explained:
        return None
    wide = sum(gain for (reach, _), gain in zip(LOCAL.blurs, gains, strict=True) if reach >= LOCAL.wide_px)
    is_wide = wide > sum(gains) / 2
    words = CONTRAST_WORDS if is_wide else SHARPER_WORDS
    cause = "filter" if is_wide else "detail"
    mistake = Mistake(
        cause, words, lambda colors: _raised(colors, gains), lambda colors: _lowered(colors, gains, render)
    )
    agrees = mean_difference(small_copy(seen), small_copy(made)) <= COPIES.max_difference
    after = float(agrees[small_copy(solid.astype(np.float32)) > COPIES.min_cover].mean())
    return Explanation(cause, words, agreeing, after, mistake)


def _blurred(colors: np.ndarray, blur: tuple[int, int]) -> np.ndarray:
    reach, times = blur
    for _ in range(times):
        colors = box_mean(colors, reach)
    return colors


def _fitted(seen: np.ndarray, before: np.ndarray, solid: np.ndarray) -> tuple[float, ...] | None:
    """What was added of the detail beyond each of LOCAL.blurs; None where that is nothing."""
    samples = np.flatnonzero(solid & (seen.min(-1) > 0) & (seen.max(-1) < 1))  # what was cut says less
    samples = samples[:: max(len(samples) // LOCAL.max_samples, 1)]
    if len(samples) < LOCAL.min_samples:
        return None
    flat = before.reshape(-1, 3)[samples]
    beyond = np.stack([flat - _blurred(before, blur).reshape(-1, 3)[samples] for blur in LOCAL.blurs], -1)
    rows = np.ascontiguousarray(beyond.reshape(-1, len(LOCAL.blurs)), np.float64)
    gained = (seen.reshape(-1, 3)[samples] - flat).reshape(-1, 1).astype(np.float64)
    weight, gains = np.ones(len(samples)), np.zeros((len(LOCAL.blurs), 1))
    for _ in range(LOCAL.reweightings):
        each = np.repeat(weight, 3)
        normal = gram(rows, each)
        normal += 1e-5 * np.trace(normal) / len(normal) * np.eye(len(normal))
        gains = solved(normal, transposed_product(rows * each[:, None], gained))
        left = np.abs(gained - (rows * gains[:, 0]).sum(-1, keepdims=True)).reshape(-1, 3).max(-1)
        weight = 1 / (1 + (left / max(float(median(left)), LOCAL.min_deviation)) ** 2)
    likeliest = tuple(gains[:, 0].tolist())
    return likeliest if sum(likeliest) >= LOCAL.min_gain else None


def _added(colors: np.ndarray, gains: tuple[float, ...]) -> np.ndarray:
    """[H, W, 3] what colours have of their blurs, times the gains."""
    out = np.zeros(colors.shape, np.float32)
    for blur, gain in zip(LOCAL.blurs, gains, strict=True):
        out += np.float32(gain) * _blurred(colors, blur)
    return out


def _raised(colors: np.ndarray, gains: tuple[float, ...]) -> np.ndarray:
    colors = np.ascontiguousarray(colors, np.float32)
    return np.clip((1 + np.float32(sum(gains))) * colors - _added(colors, gains), 0, 1)


def _lowered(colors: np.ndarray, gains: tuple[float, ...], render: np.ndarray) -> np.ndarray:
    """[H, W, 3] the colours of which `_raised` makes these. What it cut at black and white may have been anything that
    is cut there: where the render [H, W, 3] is, it stays."""
    picture = np.ascontiguousarray(colors, np.float32)
    dark, light, total = picture <= 0, picture >= 1, 1 + np.float32(sum(gains))
    out = np.clip(render, 0, 1).astype(np.float32) if render.shape == picture.shape else picture
    for _ in range(LOCAL.rounds):
        added = _added(out, gains)
        raised = total * out - added
        target = np.where(dark, np.minimum(raised, 0), np.where(light, np.maximum(raised, 1), picture))
        out = (target + added) / total
    return np.clip(out, 0, 1)
