"""Shades over all of a picture: vignettes, dark and light, and gradients from side to side.

Where the background went through a shade, too, rings around the middle tell how much light is left of each, whatever
its profile. Over a black background, or where the asset fills the picture, the asset alone must tell: there a smooth
shade of two or three numbers is fitted, and has to be met to a level or so, which nothing that a hand paints is. Pure.
H, W: pixels of the view; h, w: of its small copy; colours are display sRGB 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.gatekeeper.small_copies import (
    COPIES,
    Change,
    Explanation,
    Mistake,
    SmallView,
    explained_by,
    mean_difference,
)
from splatpainter.kernels import portable
from splatpainter.kernels.portable import gram, matmul, solved, transposed_product
from splatpainter.order_statistics import median
from splatpainter.system.quick_dataclass import dataclass

Field: TypeAlias = Callable[[tuple[int, ...]], np.ndarray]
"""(H, W, ...) -> [H, W], one number for each pixel of a picture of that size."""


@dataclass(frozen=True)
class ShadeThresholds:
    """What is taken for a shade over all of a picture. Display values and pixels of small copies; source: taste, tried
    on views of eleven assets."""

    reweightings: int = 6
    """Rounds of reweighting by which painted pixels stop to count."""
    min_deviation: float = 0.004
    """Deviation of what is left, display values, below which it is rounding."""
    min_samples: int = 64
    """Pixels that a plane, or a smooth shade, is fitted to, at least."""
    rings: int = 24
    """Rings around the middle of a picture whose shade is measured each."""
    min_lit: float = 0.04
    """Brightness from which a pixel says how much light is left of it."""
    min_left: float = 0.05
    """Light that is left at least where a shade is taken back: of less, rounding is all that would be seen."""
    min_ring_px: int = 8
    """Pixels of a ring that say so, at least."""
    max_middle_shade: float = 0.04
    """Loss in the middle of a picture, up to which a shade towards its corners leaves the middle alone."""
    max_covered_rings: int = 6
    """Rings in the middle that paint may cover whole."""
    max_middle_slope: float = 1.5
    """Loss per square of the distance from the middle beyond such rings, at most."""
    min_corner_shade: float = 0.1
    """Loss in the outermost ring, at least."""
    max_ring_rise: float = 0.02
    """By how much a ring may be lighter than the one inside of it."""
    min_background: float = 0.2
    """Share of the bare background that a shade must change: paint stays on the asset, a shade does not."""
    min_shade_explained: float = 0.8
    """Share of the background that a shade changes that is as it makes it."""
    min_shaded: float = 0.5
    """Share of what picture and view show that agrees after a shade: the rest may be painted over."""
    min_shaded_asset: float = 0.9
    """The same where the background is spared: a free profile fits some of any paint."""
    max_samples: int = 4000
    """Pixels that a smooth shade is fitted to, at most."""
    max_unshaded: float = 0.8
    """Share of the asset that is as it was rendered from which no smooth shade is looked for: a dab leaves more."""
    max_tint: float = 4 / 255
    """By how much a pixel may differ from its render made darker without another hue, for it to be fitted."""
    min_untinted: float = 0.3
    """Share of the asset that does not, at least."""
    min_smooth_shade: float = 0.03
    """Loss at the asset's rim, at least, beyond that nearest to the middle."""
    min_shown: float = 2.5 / 255
    """Change from which a pixel tells a smooth shade."""
    min_shown_share: float = 0.1
    """Share of the asset that must tell it."""
    max_error: float = 1.5 / 255
    """How near the picture is to what a smooth shade makes."""
    error_share: float = 0.1
    """The same in parts of the change; the larger of both counts."""
    min_near: float = 0.7
    """Share of what a smooth shade changes that must be as near: the rest may be painted over."""
    max_same: float = 0.75 / 255
    """Difference up to which nothing happened to a pixel."""


SHADES = ShadeThresholds()

VIGNETTE_WORDS = "darkened towards its corners (a vignette)"
LIGHT_VIGNETTE_WORDS = "lightened towards its corners (a vignette)"
GRADIENT_WORDS = "darkened or lightened from side to side (a gradient over all of it)"


def shade_of(view: SmallView) -> Explanation | None:
    """The shade that leaves least of a picture unexplained; None where none explains it."""
    explained: list[tuple[float, Explanation]] = []
    for (mistake, made), min_explained in _shadings(view):
        explanation = explained_by(mistake, made, view)
        # What is fitted to a picture explains some of any picture.
        if explanation is not None and explanation.agreeing_after >= min_explained:
            explained.append((_left_unexplained(made, view), explanation))
    explained += _smooth_shades(view)
    return min(explained, key=lambda pair: pair[0], default=(0.0, None))[1]


def _left_unexplained(made: np.ndarray, view: SmallView) -> float:
    """How far most of the asset is from what a shade makes of it [h, w, 3]: the rest may be painted over."""
    return float(np.quantile(mean_difference(view.picture, made)[view.solid], SHADES.min_near))


def _shadings(view: SmallView) -> Iterator[tuple[tuple[Mistake, np.ndarray], float]]:
    """Shades that fit the picture best, and what each makes of the view [h, w, 3], and the share of the picture that
    they must explain: towards the corners, dark and light, and from side to side."""
    for dark in (True, False):
        # Towards white is what towards black is of the negative; lenses and some sliders shade light, not values.
        for linear in (False, True) if dark else (False,):
            before, after = (_toward_black(image, dark, linear) for image in (view.render, view.picture))
            brightness = before.mean(-1)
            lit = (brightness > SHADES.min_lit) & (view.solid if view.paint_is_on_asset else True)
            with np.errstate(divide="ignore", invalid="ignore"):
                left = np.where(lit, after.mean(-1) / brightness, 1)
            vignette = VIGNETTE_WORDS if dark else LIGHT_VIGNETTE_WORDS
            fields = [(vignette, _rings(left, lit, radius)) for radius in (_oval, _round)]
            for words, field in (*fields, (GRADIENT_WORDS, _slope(left, lit))):
                if field is None:
                    continue
                made = _from_black(before * field(view.alpha.shape)[..., None], dark, linear).astype(np.float32)
                if not _may_be_on_asset(made, view):
                    continue
                undone = _unshaded(field, dark, linear)
                if _is_on_background(made, view):
                    yield (Mistake("shade", words, lambda colors: colors, undone, "middle"), made), SHADES.min_shaded
                elif view.paint_is_on_asset and words == vignette:
                    if _telling(made, view).sum() >= SHADES.min_ring_px:  # black tells nothing
                        words = f"{words}, but for its background"
                    made = np.where(view.bare[..., None], view.render, made)
                    mistake = Mistake("shade", words, lambda colors: colors, undone, "background")
                    yield (mistake, made), SHADES.min_shaded_asset


def _telling(made: np.ndarray, view: SmallView) -> np.ndarray:
    """[h, w] bool: background that tells whether it went through a shade, too."""
    return view.bare & (mean_difference(made, view.render) > SHADES.min_shown)


def _may_be_on_asset(made: np.ndarray, view: SmallView) -> bool:
    """Whether the asset, too, is not as it was rendered where a shade reaches it: another ground around it is none."""
    shaded = view.solid & (mean_difference(made, view.render) > COPIES.min_predicted)
    return not shaded.any() or float(view.unchanged[shaded].mean()) <= COPIES.max_contradicting


def _toward_black(colors: np.ndarray, dark: bool, linear: bool) -> np.ndarray:
    """Colours [H, W, 3] in what a shade multiplies."""
    colors = np.clip(colors if dark else 1 - colors, 0, 1)
    return srgb_to_linear(colors) if linear else colors


def _from_black(colors: np.ndarray, dark: bool, linear: bool) -> np.ndarray:
    """The inverse of `_toward_black`."""
    colors = np.clip(colors, 0, 1)
    colors = linear_to_srgb(colors) if linear else colors
    return colors if dark else 1 - colors


def _unshaded(field: Field, dark: bool, linear: bool) -> Change:
    def undone(colors: np.ndarray) -> np.ndarray:
        light = np.maximum(field(colors.shape[:2]), SHADES.min_left)
        return _from_black(_toward_black(colors, dark, linear) / light[..., None], dark, linear)

    return undone


def _across(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] x and y of a picture's pixels, -1..1 from side to side."""
    height, width = shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    return 2 * x / width - 1, 2 * y / height - 1


def _oval(shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] 0 in the middle, 1 in the corners, along ellipses of the picture's shape."""
    return portable.hypot(*_across(shape)) / math.sqrt(2)


def _round(shape: tuple[int, ...]) -> np.ndarray:
    """The same along circles."""
    (x, y), (height, width) = _across(shape), shape[:2]
    return portable.hypot(x * width, y * height) / portable.hypot(width, height)


def _rings(left: np.ndarray, lit: np.ndarray, radius: Field) -> Field | None:
    """The light that is left, by its distance from the middle; None where that is no shade towards the corners. left,
    lit: [h, w]; radius: 0..1 of each pixel."""
    ring = np.minimum((radius(left.shape) * SHADES.rings).astype(int), SHADES.rings - 1)
    centers, values = [], []
    for number in range(SHADES.rings):
        inside = lit & (ring == number)
        if inside.sum() >= SHADES.min_ring_px:
            centers.append((number + 0.5) / SHADES.rings)
            values.append(float(median(left[inside])))
    if len(values) < SHADES.rings // 2:
        return None
    # Most dabs are in the middle, where they cover rings whole: there the light rises as the square of the distance.
    for covered in range(SHADES.max_covered_rings + 1):
        inner = centers[covered]
        middle = SHADES.max_middle_shade + (SHADES.max_middle_slope * inner * inner if covered else 0)
        rest = np.asarray(values[covered:])
        if np.diff(rest).max() <= SHADES.max_ring_rise and -SHADES.max_middle_shade <= 1 - rest[0] <= middle:
            break
    else:
        return None
    if covered:  # the next one may be covered in part
        covered, rest, inner = covered + 1, rest[1:], centers[covered + 1]
    within = np.asarray(centers[:covered])
    profile = np.concatenate([1 - (1 - rest[0]) * (within / inner) ** 2, rest])
    if profile[0] - profile[-1] < SHADES.min_corner_shade:
        return None
    return lambda shape: portable.interp(radius(shape), centers, profile)


def _slope(left: np.ndarray, lit: np.ndarray) -> Field | None:
    """The light that is left, as a plane over the picture; None where it is level. left, lit: [h, w]."""
    x, y = _across(left.shape)
    terms = np.stack([np.ones_like(x), x, y], -1)
    samples, values, weight = terms[lit], left[lit], np.ones(int(lit.sum()))
    if len(values) < SHADES.min_samples:
        return None
    plane = np.zeros((3, 1))
    for _ in range(SHADES.reweightings):
        normal = gram(samples, weight) + 1e-6 * np.eye(3)
        plane = solved(normal, transposed_product(samples, (weight * values)[:, None]))
        error = np.abs(values - matmul(samples, plane)[:, 0])
        weight = 1 / (1 + (error / max(float(median(error)), SHADES.min_deviation)) ** 2)
    if np.abs(plane[1:]).sum() < SHADES.min_corner_shade / 2:
        return None
    constant, across, down = plane[:, 0].tolist()

    def field(shape: tuple[int, ...]) -> np.ndarray:
        x, y = _across(shape)
        return constant + across * x + down * y

    return field


def _is_on_background(made: np.ndarray, view: SmallView) -> bool:
    bare = view.bare
    if bare.mean() < COPIES.min_bare_share:
        return False
    shaded = bare & (mean_difference(made, view.render) > COPIES.min_predicted)
    if shaded.sum() < SHADES.min_background * bare.sum():
        return False
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    return bool(agrees[shaded].mean() >= SHADES.min_shade_explained)


# ---- told by the asset alone


def _smooth_shades(view: SmallView) -> Iterator[tuple[float, Explanation]]:
    """Explanations by smooth shades, each with what it leaves unexplained: towards the corners by three powers of the
    distance from the middle, from side to side by a plane."""
    for dark in (True, False):
        for linear in (False, True) if dark else (False,):
            before, after = (_toward_black(image, dark, linear) for image in (view.render, view.picture))
            lit = (before.mean(-1) > SHADES.min_lit) & view.solid
            if lit.sum() < SHADES.min_samples or view.unchanged[lit].mean() > SHADES.max_unshaded:
                continue
            vignette = VIGNETTE_WORDS if dark else LIGHT_VIGNETTE_WORDS
            fits = [(vignette, _corner_field(before, after, lit, linear, radius)) for radius in (_oval, _round)]
            for words, field in (*fits, (GRADIENT_WORDS, _plane_field(before, after, lit, linear))):
                if field is not None and (one := _judged_shade(view, words, field, dark, linear)) is not None:
                    yield one


def _corner_field(before: np.ndarray, after: np.ndarray, lit: np.ndarray, linear: bool, radius: Field) -> Field | None:
    """The light that is left towards the corners, of colours [h, w, 3] where lit [h, w]; None where that is no
    shade."""
    away = radius(lit.shape) ** 2
    powers = np.stack([-away, -(away**2), -(away**3)], -1)
    # What is left is 1 less the sum, so the sum is fitted to what is lost.
    weights = _fitted(before, after, lit, linear, powers, after - before)
    if weights is None:
        return None

    def field(shape: tuple[int, ...]) -> np.ndarray:
        square = np.minimum(radius(shape) ** 2, farthest)
        return np.clip(1 - ((weights[2] * square + weights[1]) * square + weights[0]) * square, 0, 1)

    # Beyond the asset nothing was fitted: there it stays as it is at its rim.
    farthest = float(away[lit].max())
    profile = np.sort(away[lit])
    left = 1 - ((weights[2] * profile + weights[1]) * profile + weights[0]) * profile
    rises = float((left - np.minimum.accumulate(left)).max())
    is_shade = left[0] - left[-1] >= SHADES.min_smooth_shade and rises <= SHADES.max_ring_rise
    return field if is_shade and abs(1 - left[0]) <= 1 - left[-1] else None


def _plane_field(before: np.ndarray, after: np.ndarray, lit: np.ndarray, linear: bool) -> Field | None:
    """The light that is left as a plane over the picture, as `_corner_field`."""
    across, down = _across(lit.shape)
    weights = _fitted(before, after, lit, linear, np.stack([np.ones_like(across), across, down], -1), after)
    if weights is None:
        return None
    constant, rightwards, downwards = weights.tolist()
    if abs(rightwards) + abs(downwards) < SHADES.min_corner_shade / 2:
        return None

    def field(shape: tuple[int, ...]) -> np.ndarray:
        x, y = _across(shape)
        return np.maximum(constant + rightwards * x + downwards * y, 0)

    return field


def _fitted(
    before: np.ndarray, after: np.ndarray, lit: np.ndarray, linear: bool, terms: np.ndarray, wanted: np.ndarray
) -> np.ndarray | None:
    """[F] weights of terms [h, w, F] whose sum times the colours before [h, w, 3] is nearest to what is wanted
    [h, w, 3], where lit [h, w] bool; None where too little was shaded and not tinted."""
    pixels = np.flatnonzero(lit)
    pixels = pixels[:: max(len(pixels) // SHADES.max_samples, 1)]
    one, other, goal = (values.reshape(-1, 3)[pixels].astype(np.float64) for values in (before, after, wanted))
    # Errors count as they are seen: a step of light is a larger one of display values where it is dark.
    seen = np.ones(other.shape) if not linear else 1 / (2 * np.sqrt(np.maximum(other, 0.01)))
    left = other.sum(1, keepdims=True) / one.sum(1, keepdims=True)
    untinted = (np.abs(other - left * one) * seen).max(1) <= SHADES.max_tint
    if untinted.mean() < SHADES.min_untinted or untinted.sum() < SHADES.min_samples:
        return None
    count = terms.shape[-1]
    samples = (one * seen)[..., None] * terms.reshape(-1, count)[pixels][:, None]
    samples, target = np.ascontiguousarray(samples.reshape(-1, count)), (goal * seen).reshape(-1, 1)
    weight, weights = untinted.astype(np.float64), np.zeros((count, 1))
    for _ in range(SHADES.reweightings):
        each = np.repeat(weight, 3)
        normal = gram(samples, each)
        normal += 1e-7 * np.trace(normal) * np.eye(count)
        weights = solved(normal, transposed_product(samples, each[:, None] * target))
        error = np.abs(target - (samples * weights[:, 0]).sum(-1, keepdims=True)).reshape(-1, 3).max(1)
        middle = max(float(median(error[untinted])), SHADES.min_deviation)
        weight = untinted / (1 + (error / middle) ** 2)
    return weights[:, 0]


def _judged_shade(
    view: SmallView, words: str, field: Field, dark: bool, linear: bool
) -> tuple[float, Explanation] | None:
    """A smooth shade as the explanation of a picture, and what it leaves unexplained; None where it is none."""
    before = _toward_black(view.render, dark, linear)
    made = _from_black(before * field(view.alpha.shape)[..., None], dark, linear).astype(np.float32)
    change = mean_difference(made, view.render)
    near = mean_difference(view.picture, made) <= np.maximum(SHADES.max_error, SHADES.error_share * change)
    shown = view.solid & (change > SHADES.min_shown)
    if shown.sum() < SHADES.min_shown_share * view.solid.sum() or near[shown].mean() < SHADES.min_near:
        return None
    # What a hand left out is as it was rendered.
    same = mean_difference(view.picture, view.render) <= SHADES.max_same
    if same[shown].mean() > COPIES.max_contradicting:
        return None
    spares = "middle"
    telling = _telling(made, view)
    if telling.sum() >= SHADES.min_ring_px and near[telling].mean() < SHADES.min_near:
        # It goes on beside the asset, or stops there as one of a cut-out picture does.
        if not view.paint_is_on_asset or words == GRADIENT_WORDS:
            return None
        made = np.where(view.bare[..., None], view.render, made)
        words, spares = f"{words}, but for its background", "background"
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    reach = float((change > COPIES.min_predicted)[view.solid].mean())
    mistake = Mistake("shade", words, lambda colors: colors, _unshaded(field, dark, linear), spares)
    after = float(agrees[view.compared].mean())
    return _left_unexplained(made, view), Explanation("shade", words, view.agreeing, after, mistake, reach)
