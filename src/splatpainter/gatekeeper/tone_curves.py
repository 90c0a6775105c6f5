"""Curves of tone that went over all of a picture, one for each channel: contrast, gamma, faded blacks, tone mapping,
looks of films, each with exposure and white balance.

A curve is piecewise linear and smooth; it is fitted beside the paint, and being one for each channel, it can be taken
back. Pure. h, w: pixels of a small copy; colours are display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.gatekeeper.fitted_mistakes import laid_softly
from splatpainter.gatekeeper.small_copies import (
    COPIES,
    Explanation,
    Mistake,
    SmallView,
    exact_reach,
    mean_difference,
)
from splatpainter.kernels import portable
from splatpainter.kernels.portable import gram, solved, transposed_product
from splatpainter.order_statistics import median
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class CurveThresholds:
    """How curves are fitted. Display values; source: taste, tried on views of eleven assets."""

    knots: int = 17
    """Points of a curve, evenly from black to white."""
    smoothness: float = 1e-3
    """Weight of the bends of a curve, in parts of that of all pixels: it goes straight on where no pixel tells."""
    max_samples: int = 6000
    min_samples: int = 256
    """Pixels that are fitted."""
    unclipped: tuple[float, float] = (0.01, 0.985)
    """Values of the picture beyond which it was clipped and says nothing."""
    reweightings: int = 12
    """Rounds of reweighting by which painted pixels stop to count."""
    min_deviation: float = 0.004
    """Deviation of what is left below which it is rounding."""
    min_rise: float = 1 / 255
    """By how much a curve rises from one point to the next, at least, so that it can be taken back."""
    min_range: float = 0.1
    """From black to white, at least: less has no tones left."""
    max_unchanged: float = 0.3
    """Share of the asset that is as it was rendered from which no curve is looked for that nothing else tells."""
    min_reach: float = 0.3
    """Share of the asset that such a curve must change and meet."""
    min_nearly: float = 0.8
    """Share of what picture and view show that must agree with a curve that the background has, too."""
    min_contrast: float = 0.35
    """Deviation of what it makes in parts of the render's: one flat colour is paint."""
    unpainted_share: float = 0.7
    """Share of the asset that tells how well curves explain it: the rest may be painted over."""


CURVES = CurveThresholds()
GRADED_BY_CURVES = "graded as a whole (by a curve: contrast, a gamma, tone mapping, a film look)"


@dataclass(frozen=True)
class ToneCurves:
    """One curve for each channel."""

    points: np.ndarray
    """[K] values before, 0 to 1."""
    values: np.ndarray
    """[3, K] values after, rising."""

    def made(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] colours after the curves."""
        return self._through(colors, [(self.points, values) for values in self.values])

    def undone(self, colors: np.ndarray) -> np.ndarray:
        """[..., 3] colours of which the curves make these."""
        return self._through(colors, [(values, self.points) for values in self.values])

    @staticmethod
    def _through(colors: np.ndarray, curves: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        channels = [portable.interp(colors[..., k], *curve) for k, curve in enumerate(curves)]
        return np.clip(np.stack(channels, -1), 0, 1).astype(np.float32)


def curves_of(view: SmallView) -> ToneCurves | None:
    """The curves that make a view most like its picture where the asset is; None where too little tells."""
    low, high = CURVES.unclipped
    pixels = np.flatnonzero(view.solid & ((view.picture > low) & (view.picture < high)).all(-1))
    pixels = pixels[:: max(len(pixels) // CURVES.max_samples, 1)]
    if len(pixels) < CURVES.min_samples:
        return None
    before, after = (image.reshape(-1, 3)[pixels].astype(np.float64) for image in (view.render, view.picture))
    points = np.linspace(0, 1, CURVES.knots)
    # Hat functions: how much of each point a value takes.
    hats = [np.maximum(1 - np.abs(before[:, [k]] - points) * (CURVES.knots - 1), 0) for k in range(3)]
    bend = np.diff(np.eye(CURVES.knots), 2, axis=0)
    stiffness = transposed_product(bend, bend) * CURVES.smoothness
    weight, values = np.ones(len(pixels)), np.zeros((3, CURVES.knots))
    for _ in range(CURVES.reweightings):
        left = np.zeros(len(pixels))
        for k, hat in enumerate(hats):
            normal = gram(hat, weight) + weight.sum() * stiffness + 1e-9 * np.eye(CURVES.knots)
            values[k] = solved(normal, transposed_product(hat, (weight * after[:, k])[:, None]))[:, 0]
            left = np.maximum(left, np.abs(after[:, k] - (hat * values[k]).sum(1)))
        weight = 1 / (1 + (left / max(float(median(left)), CURVES.min_deviation)) ** 2)
    steps = np.arange(CURVES.knots) * CURVES.min_rise
    rising = np.maximum.accumulate(values - steps, axis=1) + steps
    return ToneCurves(points, rising) if (rising[:, -1] - rising[:, 0]).min() >= CURVES.min_range else None


def graded_by_curves(view: SmallView) -> Explanation | None:
    """Curves as the explanation of a picture that they meet nearly everywhere to a level or so; None where they do not,
    or where only the asset has them and a colour that was laid over it may have done that."""
    solid = view.solid
    if not solid.any() or view.unchanged[solid].mean() > CURVES.max_unchanged:
        return None
    curves = curves_of(view)
    if curves is None:
        return None
    made = curves.made(view.render)
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    # A background that went through them, too, speaks for a picture that was compressed since.
    nearly = view.background_changed and agrees[view.compared].mean() >= CURVES.min_nearly
    if not nearly and exact_reach(made, view) < CURVES.min_reach:
        return None
    if made[solid].std(0).mean() < CURVES.min_contrast * view.render[solid].std(0).mean():
        return None
    if view.paint_is_on_asset:
        if laid_softly(view) is not None:
            return None
        made = np.where(view.bare[..., None], view.render, made)
    elif view.bare.any() and agrees[view.bare].mean() < COPIES.min_changed:
        return None  # a large brush reaches a part of the background
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    after = float(agrees[view.compared].mean())
    mistake = Mistake("tone", GRADED_BY_CURVES, curves.made, curves.undone)
    return Explanation("tone", mistake.words, view.agreeing, after, mistake)


def left_after(undone: np.ndarray, view: SmallView) -> float:
    """How far most of the asset still is from its render after something was taken back, [h, w, 3]."""
    return float(np.quantile(mean_difference(undone, view.render)[view.solid], CURVES.unpainted_share))
