"""Spread: an edited material changes beyond what the views show.

    result = spread(splats, views, options)          # every Gaussian of the painted material in its new colour
    edit = result.with_lift(lifted)                  # ... and the local lift of the same views on that

Painted Gaussians are positive examples and visible unpainted ones negative examples of a classifier that is solved for
the edit, on this asset alone. Where the paint ends in the middle of the material, the unpainted ones are only what else
there is (a density ratio), and then examples are what that answer says of what the views show, a few times over. The
answer is smoothed over the surface within like colours. The change of colour is fitted to the positives and applied to
what is reached. N Gaussians of the asset, M of them drawable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.color import base_color, to_display
from splatpainter.kernels import portable
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.features import no_features
from splatpainter.lift.global_edit import seen_change
from splatpainter.splats import Splats
from splatpainter.spread.classifier import Projections, density_ratio, two_class
from splatpainter.spread.color_change import ColorChange
from splatpainter.spread.descriptors import DESCRIPTOR_CHANNELS, Descriptors
from splatpainter.spread.examples import Examples
from splatpainter.spread.nearest_neighbours import smoothed
from splatpainter.spread.options import SPREAD_DEFAULTS, SpreadOptions
from splatpainter.spread.soft_edges import paint_alone
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class SpreadThresholds:
    """How a painted material is found elsewhere. Measured where an entry says on what, else taste."""

    max_examples: int = 8192
    """Most examples of each kind, evenly chosen, that the classifier learns from."""
    kernel_scale: float = 0.4
    """Width of the kernel: units of descriptors are multiplied by it."""
    ridge: float = 0.3
    """Ridge of the question what is painted material and what is not (classifier.py)."""
    ridge_partial: float = 1.0
    """Ridge where the paint ends in the middle of the material."""
    smoothing_rounds: int = 12
    """Rounds of smoothing over the surface."""
    hold: float = 0.4
    """How much a Gaussian holds on to its answer in each of these rounds."""
    hold_examples: float = 0.8
    """The same of an example."""
    self_rounds: int = 3
    """Rounds for paint that ends in the middle of the material, in which answers become examples of the next one. On 14
    training meshes, a stroke over 30 % of the material in view: IoU 0.64 without, 0.67 after one round, 0.71 after
    three."""
    self_negative: float = 0.5
    """Answer up to which what the views show is a negative example of the next round."""
    self_positive: float = 0.6
    """Answer from which it is a positive one."""
    color_similarity: float = 1.0
    """Units of colour by which neighbours may differ to take much from each other."""
    fade_confidence: float = 0.15
    """Confidence above the threshold over which the change fades in."""
    min_painted_px: float = 0.3
    """Pixels that must show a Gaussian under the paint for it to say how the colour changes."""
    sure_confidence: float = 0.5
    """Confidence that it must have for that."""
    max_confidence: float = 0.99
    """Highest confidence of what is not painted itself."""
    min_share: float = 1 / 64
    """Gaussians that would change by less keep their bits."""


SPREADING = SpreadThresholds()


@dataclass(frozen=True)
class SpreadConfidence:
    """Which Gaussians of an asset are of the painted material."""

    confidence: Floats = field(repr=False)
    """[N] float32 0..MAX_CONFIDENCE; 0 for Gaussians that cannot be drawn."""
    threshold: float
    is_partial: bool
    """Whether the paint ended in the middle of the material."""

    @property
    def shares(self) -> Floats:
        """[N] float32 0..1 how much of the change each Gaussian takes."""
        part = (self.confidence - self.threshold) / SPREADING.fade_confidence
        return np.where(part < SPREADING.min_share, 0, np.minimum(part, 1)).astype(np.float32)


def spread_confidence(
    splats: Splats, views: Sequence[EditView], options: SpreadOptions = SPREAD_DEFAULTS
) -> SpreadConfidence:
    """Which Gaussians are of the material that the views' masks paint. splats: numpy. Raises ValueError as
    `Examples.of`."""
    drawn = np.flatnonzero(splats.drawable)
    part = splats.take(drawn)
    examples, descriptors = Examples.of(part, views), Descriptors.of(part)
    confidence = np.zeros(len(splats), np.float32)
    confidence[drawn] = answered(descriptors, examples).clip(0, SPREADING.max_confidence)
    return SpreadConfidence(confidence, options.threshold, examples.is_partial)


def answered(descriptors: Descriptors, examples: Examples) -> Floats:
    """[M] float32 about 0..1, not clipped."""
    answer = _smooth(_classified(descriptors, examples), descriptors, examples)
    if not examples.is_partial:
        return answer
    # The paint ended in the middle: what the answer says of seen Gaussians becomes examples of a better question.
    visible = examples.positive | examples.negative
    for _ in range(SPREADING.self_rounds):
        positive = examples.positive | (visible & (answer > SPREADING.self_positive))
        negative = visible & ~positive & (answer < SPREADING.self_negative)
        if not negative.any():
            break
        again = replace(examples, positive=positive, negative=negative, is_partial=False)
        answer = _smooth(_classified(descriptors, again), descriptors, again)
    return answer


def _classified(descriptors: Descriptors, examples: Examples) -> Floats:
    """[M] float32 about 0..1, not clipped."""
    # A bounded number of examples of each kind: the solution costs the same for any asset.
    ids = np.union1d(_some(examples.positive), _some(examples.negative))
    points = SPREADING.kernel_scale * descriptors.values
    projections = Projections.of(DESCRIPTOR_CHANNELS)
    features, positive, weights = projections.features(points[ids]), examples.positive[ids], examples.weights[ids]
    if not examples.is_partial:
        return projections.predict(points, two_class(features, positive, weights, SPREADING.ridge))
    ratio = projections.predict(points, density_ratio(features, positive, weights, SPREADING.ridge_partial))
    # A density ratio has no scale of its own; painted ones define 1.
    typical = float(np.median(ratio[examples.positive]))
    return ratio / max(typical, 1e-6)


def _some(chosen: np.ndarray) -> np.ndarray:
    """Indices of at most SPREADING.max_examples of the chosen ([M] bool), evenly over their order."""
    ids = np.flatnonzero(chosen)
    if len(ids) <= SPREADING.max_examples:
        return ids
    return ids[np.linspace(0, len(ids) - 1, SPREADING.max_examples).astype(np.int64)]


def _smooth(answer: np.ndarray, descriptors: Descriptors, examples: Examples) -> Floats:
    """[M] float32: the answer, mixed with those of neighbours of like colour; examples stay near what they are."""
    near = descriptors.near
    links = np.zeros(near.shape, np.float32)
    for n in range(1, near.shape[1]):
        other = near[:, n]
        square = ((descriptors.colors[other] - descriptors.colors) ** 2).sum(1)
        # Neighbours of other colours pass nothing on: answers stay within the material.
        links[:, n] = portable.exp(-square / (2 * SPREADING.color_similarity**2)) * descriptors.weights[other]
    links /= np.maximum(links.sum(1, keepdims=True), 1e-12)
    counted = examples.positive | (examples.negative & (not examples.is_partial))
    target = np.where(examples.positive, 1, np.where(counted, 0, answer))
    hold = np.where(counted, SPREADING.hold_examples, SPREADING.hold)
    return smoothed(answer, target, hold, links, near, SPREADING.smoothing_rounds)


@dataclass(frozen=True)
class Spread:
    """A change of colour carried on over a material."""

    splats: Splats
    """The asset with it, of N Gaussians."""
    ids: Ids = field(repr=False)
    """[J] int64 ascending: those that it changes."""
    material: SpreadConfidence

    def with_lift(self, lifted: LiftedEdit) -> LiftedEdit:
        """The local lift of the same views, made on `splats`, as an edit of the asset before both."""
        # What the spread changed beyond the lift is part of the same edit, and of its receipt.
        new = np.setdiff1d(self.ids, lifted.ids)
        every = np.concatenate([lifted.ids, new])
        order = np.argsort(every, kind="stable")
        count, threshold = len(self.splats), self.material.threshold
        confidence = np.append(self.material.confidence, np.ones(len(lifted.splats) - count, np.float32))
        painted = lifted.ids[lifted.ids < count]
        confidence[painted[confidence[painted] >= threshold]] = 1
        edge = "ends in the middle of the material" if self.material.is_partial else "ends where the material does"
        return replace(
            lifted,
            ids=every[order],
            parents=np.concatenate([lifted.parents, new])[order],
            features=no_features(every),
            confidence=confidence,
            note=f"spread: {len(new)} Gaussians beyond the paint at threshold {threshold:g}; the paint {edge}",
        )


def spread(splats: Splats, views: Sequence[EditView], options: SpreadOptions = SPREAD_DEFAULTS) -> Spread:
    """The change of colour of the painted material, carried on over all of it: also under the paint and around it, so
    that what the local lift then makes of the paint has no rim of old colour. splats: numpy. Raises ValueError as
    `spread_confidence`."""
    material = spread_confidence(splats, views, options)
    shares = material.shares
    ids = np.flatnonzero(shares)
    if not len(ids):
        return Spread(splats, ids, material)
    sh = splats.sh.copy()
    sh[ids] = _color_change(splats, views, material.confidence).applied(splats, ids, shares[ids])
    return Spread(replace(splats, sh=sh), ids, material)


def _color_change(splats: Splats, views: Sequence[EditView], confidence: np.ndarray) -> ColorChange:
    """What the views make of the material's colours. Raises ValueError where they show no solid part of it."""
    drawn = np.flatnonzero(splats.drawable)
    part = splats.take(drawn)
    pictures = [paint_alone(view, splats.color_space) for view in views]
    change, weight = seen_change(part, [(view.camera, view.edited, view.mask) for view in pictures])
    # Sure examples first; any that the paint shows where there are none.
    for painted in ((weight > SPREADING.min_painted_px) & (confidence[drawn] > SPREADING.sure_confidence), weight > 0):
        if painted.any():
            old = base_color(part.sh[painted])
            old, new = (to_display(colors, splats.color_space) for colors in (old, old + change[painted]))
            return ColorChange.fit(old, new, weight[painted])
    raise ValueError("edit: spread: the views show no solid part of the asset (alpha above 0.9) under the paint")
