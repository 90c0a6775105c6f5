"""Global lift: one to four regraded or relit views change the whole asset, also what they do not show.

What the views show is lifted as in colors.py, over all views at once. The change of base colour is then regressed on
SH_2(normal) x (old colour, 1), the linear cousin of test-time training, and predicted for what no view shows. N
Gaussians, S of them seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.color import base_color, sh_from_color
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import each, run
from splatpainter.kernels.rows import by_blocks
from splatpainter.lift.colors import MAX_COLOR, MIN_SEEN_PX, SolidView, ViewInRounds, joint_change, total_weight
from splatpainter.lift.depth_normals import outward_normals, scattered
from splatpainter.lift.options import GLOBAL_DEFAULTS, GlobalOptions
from splatpainter.order_statistics import median
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm

Predict = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Another regression in place of this one: (change [N, 3] of base colour of Gaussians that are seen, weight [N] pixels
that show each) -> [N, 3] change of every Gaussian."""
MIN_CONFLICT_CHANGE = 0.15
"""Changes of one Gaussian that differ by more than this between views are a conflict: the later view decides."""
MAX_WEIGHT_PX = 50.0
"""A huge Gaussian must not outvote a thousand small ones."""


@dataclass(frozen=True)
class GlobalLift:
    """Result of a global lift."""

    splats: Splats
    confidence: Floats = field(repr=False)
    """[N] float32 0..1: how much of each Gaussian's new colour was seen (1) rather than predicted; predictions far from
    everything seen go to 0."""
    seen: Floats = field(repr=False)
    """[N] float32 0..1: the lift's share of each Gaussian's new colour; the rest is the regression's."""
    predicted: Floats = field(repr=False)
    """[N, 3] float32 base colours by the regression."""
    normals: Floats = field(repr=False)
    """[N, 3] float32 unit normals, outwards (`outward_normals`); zeros for Gaussians that cannot be drawn."""


def lift_global(
    splats: Splats,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    options: GlobalOptions = GLOBAL_DEFAULTS,
    normals: np.ndarray | None = None,
    predict: Predict | None = None,
) -> GlobalLift:
    """Regrade all Gaussians by (camera, target [H, W, 3], mask [H, W] bool) views; pixels that the asset covers by less
    than 0.9 do not count. Gaussians that cannot be drawn keep their bits.

    normals: [N, 3] of `outward_normals`, where they are at hand; predict: what becomes of Gaussians that no view shows,
    in place of the ridge regression, which then only turns SH bands >= 1. Raises ValueError when the views show no
    solid part of the asset."""
    drawable = splats.drawable
    normals = outward_normals(splats) if normals is None else normals
    if not drawable.all():  # a NaN would spread through the regression
        # The caller's regression knows all N Gaussians; the recursion works on the drawable ones and translates.
        def predict_drawable(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
            assert predict is not None
            return predict(scattered(change, drawable), scattered(weight, drawable))[drawable]

        part = lift_global(splats.take(drawable), views, options, normals[drawable], predict and predict_drawable)
        sh = splats.sh.copy()
        sh[drawable] = part.splats.sh
        values = (part.confidence, part.seen, part.predicted, part.normals)
        return GlobalLift(replace(splats, sh=sh), *(scattered(value, drawable) for value in values))
    old = np.empty((len(splats), 3), splats.sh.dtype)
    by_blocks(lambda block: np.copyto(old[block], base_color(splats.sh[block])), len(old))
    # First what the views show: colours towards all of them at once, as a local lift does.
    solid = _solid_views(splats, views)
    weight = total_weight(solid)
    drawn = [ViewInRounds.of(view.projected) for view in solid]
    change = joint_change(solid, options.rounds, drawn=drawn)
    visible = np.flatnonzero(weight > MIN_SEEN_PX)
    if not len(visible):
        raise ValueError(
            "edit: the views show no solid part of the asset (alpha above 0.9); check the cameras and masks"
        )
    # Then what no view shows: the same change as a function of old colour and normal.
    features = regression_features(np.clip(old, 0, 1), normals)
    seen_changes, seen_weights = change.take(visible, 0), weight.take(visible)
    solution, inverse = ridge(features.take(visible, 0), seen_changes, seen_weights, options)
    # [N, 3] change of base colour
    predicted = portable.matmul(features, solution) if predict is None else predict(change, weight)
    if options.far_side:
        # Light that came to the front went from the back; see GlobalOptions.far_side for when this is believed.
        back = _far_side(splats, solid, visible, seen_changes, seen_weights, weight, options)
        guess, predicted = predicted, np.empty_like(predicted)
        by_blocks(lambda block: np.subtract(guess[block], back(block), out=predicted[block]), len(predicted))
    # What was seen replaces the prediction by degrees: a pixel's worth of sight is not yet certain.
    share = (weight / (weight + options.half_seen))[:, None]
    # Colours outside the drawn range stay as far outside as they were, no farther.
    sh, regressed_colors = np.empty_like(splats.sh), np.empty(old.shape, np.float32)

    def regrade(block: slice) -> None:
        before, after = old[block], old[block] + predicted[block]
        sh[block], regressed_colors[block] = splats.sh[block], after
        sh[block, 0] = sh_from_color(np.clip(after, np.minimum(before, 0), np.maximum(before, MAX_COLOR)))

    by_blocks(regrade, len(old))
    if sh.shape[1] > 1:
        # View dependence is turned by the derivative of the same map: a red light makes highlights red, too.
        run(kernels.turn_bands, features, _linear(solution), sh)
    result = replace(splats, sh=sh)
    if options.last_rounds:
        # Last rounds start from the prediction, so that they only mend what the edited views still show wrong.
        # In each view it is where it was, in other colours.
        drawn = [one.recolored(result) for one in drawn]
        last = joint_change(solid, options.last_rounds, drawn=drawn, hold=options.hold)
        result.sh[:, 0] += last / SH_C0  # its own copy
    # How far a Gaussian's features are from all that was seen (leverage of the regression): far ones are guesses.
    leverage = np.empty(len(features), np.float32)
    run(kernels.measure_leverage, features, readonly(inverse, np.float32), leverage)
    typical = np.maximum(portable.total(leverage.take(visible) * seen_weights) / portable.total(seen_weights), 1e-12)
    certain = share[:, 0] + (1 - share[:, 0]) * 0.5 / (1 + leverage / (4 * typical))
    confidence, seen = (value.astype(np.float32) for value in (certain, share[:, 0]))
    return GlobalLift(result, confidence, seen, regressed_colors, normals.astype(np.float32, copy=False))


def seen_change(
    splats: Splats,
    views: Sequence[tuple[Camera, np.ndarray, np.ndarray]],
    options: GlobalOptions = GLOBAL_DEFAULTS,
) -> tuple[np.ndarray, np.ndarray]:
    """What a global lift learns from: ([N, 3] float32 change of base colour of the Gaussians that the views show, zeros
    for others, [N] float32 pixels that show each). splats: all drawable; views: as in `lift_global`."""
    solid = _solid_views(splats, views)
    return joint_change(solid, options.rounds), total_weight(solid)


def regressed(
    splats: Splats,
    normals: np.ndarray,
    change: np.ndarray,
    weight: np.ndarray,
    options: GlobalOptions = GLOBAL_DEFAULTS,
) -> np.ndarray:
    """[N, 3] change of base colour of all Gaussians, by the lift's ridge regression on those that are seen (at least
    one). splats: all drawable; normals: [N, 3]; change, weight: of `seen_change`."""
    features = regression_features(np.clip(base_color(splats.sh), 0, 1), normals)
    seen = weight > MIN_SEEN_PX
    return portable.matmul(features, ridge(features[seen], change[seen], weight[seen], options)[0])


def _far_side(
    splats: Splats,
    views: Sequence[SolidView],
    visible: Ids,
    change: np.ndarray,
    seen_weights: np.ndarray,
    weight: np.ndarray,
    options: GlobalOptions,
) -> Callable[[slice], np.ndarray]:
    """What is to be taken from the predicted change of a block of M Gaussians ([M, 3] float32; see
    `GlobalOptions.far_side`). splats: all drawable; visible: [S] those that are seen; change, seen_weights: [S, 3] and
    [S] of these, weight: [N], as of `seen_change`."""
    low, high = options.unexplained
    unexplained = unexplained_by_color(0.5 + SH_C0 * splats.sh[visible, 0], change, seen_weights, options)
    share = options.far_side * one_sided(splats, [view.camera for view in views])
    # A change that is a function of colour is a look, and goes all around: nothing is taken back.
    share *= float(np.clip((unexplained - low) / (high - low), 0, 1))
    capped = np.minimum(seen_weights, MAX_WEIGHT_PX)
    mean = (change * capped[:, None]).sum(0) / portable.total(capped)

    def back(block: slice) -> np.ndarray:
        hidden = options.half_hidden_px / (weight[block] + options.half_hidden_px)
        return (share * hidden[:, None] * mean).astype(np.float32)

    return back


def one_sided(splats: Splats, cameras: Sequence[Camera]) -> float:
    """0..1: 1 where all views come from one side of the asset, 0 where they surround it. splats: all drawable."""
    # The mean of unit directions is long where all views come from one side, and 0 where they surround the asset.
    center = np.stack(each(lambda axis: median(np.ascontiguousarray(splats.means[:, axis])), range(3)))
    away = np.stack([camera.position for camera in cameras]) - center
    lines = away / np.maximum(row_norm(away)[:, None], 1e-12)
    return float((lines.mean(0) ** 2).sum())


def unexplained_by_color(
    colors: np.ndarray, change: np.ndarray, weight: np.ndarray, options: GlobalOptions = GLOBAL_DEFAULTS
) -> float:
    """0..1: the share of a change that is no quadratic function of the colour. It is small for looks; light that comes
    from a side, and assets that fit their pictures badly, have more. colors, change: [S, 3]; weight: [S] pixels that
    show each."""
    return _unexplained(_color_terms(colors), change, weight, options)


def light_share(
    colors: np.ndarray,
    normals: np.ndarray,
    change: np.ndarray,
    weight: np.ndarray,
    options: GlobalOptions = GLOBAL_DEFAULTS,
) -> float:
    """0..1: the share of what colour leaves unexplained of a change that normals explain. Light has much, looks have
    little, however badly the asset fits its pictures. colors, normals, change: [S, 3]; weight: [S] pixels that show
    each."""
    terms = _color_terms(colors)
    # All harmonics of the normal but the constant one, which the colours' terms have.
    turned = regression_features(np.zeros_like(colors), normals)[:, 7::4]
    left = _unexplained(np.concatenate([terms, turned], 1), change, weight, options)
    return 1 - left / max(_unexplained(terms, change, weight, options), 1e-12)


def _color_terms(colors: np.ndarray) -> np.ndarray:
    """[S, 10] float64: all quadratic monomials of the colours [S, 3], enough for curves and crosstalk of common
    looks."""
    out = np.empty((len(colors), 10))

    def fill(block: slice) -> None:
        r, g, b = np.clip(colors[block], 0, 1).astype(np.float64).T
        for column, term in enumerate((1, r, g, b, r * r, g * g, b * b, r * g, g * b, b * r)):
            out[block, column] = term

    by_blocks(fill, len(out))
    return out


def _unexplained(terms: np.ndarray, change: np.ndarray, weight: np.ndarray, options: GlobalOptions) -> float:
    """0..1: the share of a change [S, 3] that is no linear function of terms [S, T]."""
    capped = np.minimum(weight, MAX_WEIGHT_PX).astype(np.float64)[:, None]
    gram = portable.gram(terms, capped[:, 0]) + options.ridge * portable.total(capped) * np.eye(terms.shape[1])
    solution = portable.solved(gram, portable.transposed_product(terms * capped, change))
    rest = change - portable.matmul(terms, solution)
    left, all_of_it = np.empty(rest.shape), np.empty(rest.shape)

    def square(block: slice) -> None:
        left[block] = capped[block] * rest[block] ** 2
        all_of_it[block] = capped[block] * change[block].astype(np.float64) ** 2

    by_blocks(square, len(rest))
    return float(portable.total(left) / max(portable.total(all_of_it), 1e-12))


def _solid_views(splats: Splats, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> list[SolidView]:
    """Where views conflict about a Gaussian, only the latest that sees it counts: in the others its weight is 0."""
    if len(views) == 1:  # which has nobody to disagree with
        return [SolidView.of(splats, *views[0])]
    solid: list[SolidView] = []
    decided = np.zeros(len(splats), bool)
    last = np.zeros((len(splats), 3), np.float32)  # the change that the latest view wants of each
    # Latest first, so that what a later view decided stands when an earlier one is looked at.
    for camera, target, mask in reversed(views):
        view = SolidView.of(splats, camera, target, mask)
        ids = view.projected.gaussian_ids
        weight = view.weight[ids]
        gain, _ = view.projected.sirt_step(target, view.use, np.maximum(view.projected.unclamped_colors, 0))
        change = gain / np.maximum(weight, 1e-6)[:, None]
        # Conflicts are judged by the change each view wants by itself, before any round mixes them.
        weight[decided[ids] & (np.abs(change - last[ids]).max(1) > MIN_CONFLICT_CHANGE)] = 0
        fresh = (weight > 1) & ~decided[ids]
        last[ids[fresh]], decided[ids[fresh]] = change[fresh], True
        view.weight[ids] = weight
        solid.append(view)
    return solid[::-1]


def regression_features(colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N, 36] float32: nine real spherical harmonics of the normal, each times (r, g, b, 1); the constant one's four
    first."""
    features = np.empty((len(colors), 36), np.float32)
    run(kernels.fill_regression_features, readonly(colors, np.float32), readonly(normals, np.float32), features)
    return features


def ridge(
    features: np.ndarray, change: np.ndarray, weight: np.ndarray, options: GlobalOptions
) -> tuple[np.ndarray, np.ndarray]:
    """(solution [36, 3], inverse normal matrix [36, 36]) in float64. features: [S, 36]; change: [S, 3]; weight: [S]
    pixels that show each."""
    capped = np.minimum(weight, MAX_WEIGHT_PX).astype(np.float64)
    # The four constant terms are held less: exposure and tint are common, direction is rarely sure.
    penalty = np.full(36, options.ridge_normals)
    penalty[:4] = options.ridge
    inverse = portable.solved(portable.gram(features, capped) + np.diag(penalty * portable.total(capped)), np.eye(36))
    return portable.matmul(inverse, portable.transposed_product(features, change * capped[:, None])), inverse


def _linear(solution: np.ndarray) -> Floats:
    """[9, 9] float32: what each harmonic of the normal adds to d new colour / d old colour, by out and in. The kernel
    that turns SH bands by it keeps the diagonal within 0..2, so that an extrapolation never inverts a highlight."""
    linear = solution.reshape(9, 4, 3)[:, :3]  # [9, in, out]
    return np.ascontiguousarray(linear.transpose(0, 2, 1).reshape(9, 9), np.float32)
