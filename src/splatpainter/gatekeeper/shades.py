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
    exact_reach,
    explained_by,
    mean_difference,
)
from splatpainter.kernels import portable
from splatpainter.kernels.portable import gram, matmul, solved, transposed_product
from splatpainter.lift.masks import largest_channel
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
    max_photograph_tint: float = 20 / 255
    """The same of a photograph, which differs from its render otherwise, too."""
    max_left_by_corners: float = 0.7
    """What a photograph without its vignette still differs by, in parts of what it differed by, at most."""
    min_untinted: float = 0.3
    """Share of the asset that does not, at least."""
    min_smooth_shade: float = 0.03
    """Loss at the asset's rim, at least, beyond that nearest to the middle."""
    min_visible_share: float = 0.1
    """Share of the asset that must tell it."""


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


def darker_corners(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> Change | None:
    """What takes the vignette of a photograph [H, W, 3] back, in linear light, its exposure left as it is; None where
    it has none. render: [H, W, 3] what it shows, alpha: [H, W] of that; the picture may be otherwise exposed, sharper,
    and painted on."""
    from splatpainter.gatekeeper.color_drift import estimate_drift  # of photographs alone

    # Channels of other gains would be other shades; the mean exposure of a vignette is a gain, too.
    drift = estimate_drift(picture, render, alpha > COPIES.min_cover, certain=False)
    view = SmallView.of(drift.corrected(picture), render, alpha)
    before, after = (_toward_black(image, True, True) for image in (view.render, view.picture))
    lit = (before.mean(-1) > SHADES.min_lit) & view.solid
    best, most = None, SHADES.max_left_by_corners
    for radius in (_oval, _round):
        field = _corner_field(before, after, lit, True, radius, SHADES.max_photograph_tint)
        if field is None:
            continue
        left = field(lit.shape)[lit]
        brightest = float(left.max())
        share = float(
            np.median(largest_channel(np.abs(before * field(lit.shape)[..., None] - after))[lit])
            / max(float(np.median(largest_channel(np.abs(before - after))[lit])), 1e-6)
        )
        if 1 - float(left.min()) / brightest >= SHADES.min_corner_shade and share < most:
            best, most = _unshaded(_scaled(field, 1 / brightest), True, True), share
    return best


def _scaled(field: Field, factor: float) -> Field:
    return lambda shape: field(shape) * factor


def _left_unexplained(made: np.ndarray, view: SmallView) -> float:
    """How far most of the asset is from what a shade makes of it [h, w, 3]: the rest may be painted over."""
    return float(np.quantile(mean_difference(view.picture, made)[view.solid], COPIES.min_near))


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
                shaded, undone = _shaded(field, dark, linear), _unshaded(field, dark, linear)
                if _is_on_background(made, view):
                    yield (Mistake("shade", words, shaded, undone, "middle"), made), SHADES.min_shaded
                elif view.paint_is_on_asset and words == vignette:
                    if _telling(made, view).sum() >= SHADES.min_ring_px:  # black tells nothing
                        words = f"{words}, but for its background"
                    made = np.where(view.bare[..., None], view.render, made)
                    mistake = Mistake("shade", words, shaded, undone, "background")
                    yield (mistake, made), SHADES.min_shaded_asset


def _telling(made: np.ndarray, view: SmallView) -> np.ndarray:
    """[h, w] bool: background that tells whether it went through a shade, too."""
    return view.bare & (mean_difference(made, view.render) > COPIES.min_visible)


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


def _shaded(field: Field, dark: bool, linear: bool) -> Change:
    def made(colors: np.ndarray) -> np.ndarray:
        lit = _toward_black(colors, dark, linear) * field(colors.shape[:2])[..., None]
        return _from_black(lit, dark, linear).astype(np.float32)

    return made


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
            bright = before.mean(-1) > SHADES.min_lit
            on_asset = bright & view.solid
            if on_asset.sum() < SHADES.min_samples or view.unchanged[on_asset].mean() > SHADES.max_unshaded:
                continue
            # A background that changed, too, tells as well, and further out.
            lit = on_asset if view.paint_is_on_asset else bright
            vignette = VIGNETTE_WORDS if dark else LIGHT_VIGNETTE_WORDS
            fits = [(vignette, _corner_field(before, after, lit, linear, radius)) for radius in (_oval, _round)]
            for words, field in (*fits, (GRADIENT_WORDS, _plane_field(before, after, lit, linear))):
                if field is not None and (one := _judged_shade(view, words, field, dark, linear)) is not None:
                    yield one


def _corner_field(
    before: np.ndarray,
    after: np.ndarray,
    lit: np.ndarray,
    linear: bool,
    radius: Field,
    max_tint: float = SHADES.max_tint,
) -> Field | None:
    """The light that is left towards the corners, of colours [h, w, 3] where lit [h, w]; None where that is no
    shade. max_tint: display values by which a pixel may have another hue."""
    away = radius(lit.shape) ** 2
    # What is left in the middle is 1, but for an exposure; a fit without it comes first, as it has less to explain.
    powers = np.stack([away, away**2, away**3], -1)
    for terms in (powers, np.concatenate([np.ones_like(powers[..., :1]), powers], -1)):
        middle = terms.shape[-1] == powers.shape[-1]
        weights = _fitted(before, after, lit, linear, terms, after - before if middle else after, max_tint)
        if weights is None:
            return None
        polynomial = (1.0, *weights.tolist()) if middle else tuple(weights.tolist())
        field = _polynomial_field(polynomial, radius, np.sort(away[lit]), middle)
        if field is not None and (not middle or _is_near(before * field(lit.shape)[..., None], after, lit)):
            return field
    return None


def _is_near(made: np.ndarray, after: np.ndarray, lit: np.ndarray) -> bool:
    """Whether most of what is lit, [h, w] bool, is as a field makes it."""
    return bool((largest_channel(np.abs(made - after))[lit] <= SHADES.max_tint).mean() >= COPIES.min_near)


def _polynomial_field(
    weights: tuple[float, ...], radius: Field, squares: np.ndarray, full_middle: bool
) -> Field | None:
    """The light that is left by a polynomial of the square of the distance from the middle; None where that is no
    shade towards the corners. squares: [P] those of the asset's pixels, ascending; full_middle: whether nothing is lost
    in the middle."""

    def left_at(square: np.ndarray) -> np.ndarray:
        left = np.full(square.shape, weights[-1])
        for weight in weights[-2::-1]:
            left = left * square + weight
        return left

    profile = left_at(squares)
    loss = (profile[0] - profile[-1]) / max(float(profile[0]), 1e-3)
    rises = float((profile - np.minimum.accumulate(profile)).max())
    if loss < SHADES.min_smooth_shade or rises > SHADES.max_ring_rise:
        return None
    if full_middle and abs(1 - profile[0]) > 1 - profile[-1]:
        return None
    # Beyond the asset nothing was fitted: there it stays as it is at its rim.
    nearest, farthest = float(squares[0]), float(squares[-1])
    return lambda shape: np.maximum(left_at(np.clip(radius(shape) ** 2, nearest, farthest)), 0)


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
    before: np.ndarray,
    after: np.ndarray,
    lit: np.ndarray,
    linear: bool,
    terms: np.ndarray,
    target_values: np.ndarray,
    max_tint: float = SHADES.max_tint,
) -> np.ndarray | None:
    """[F] weights of terms [h, w, F] whose sum times the colours before [h, w, 3] is nearest to what is target_values
    [h, w, 3], where lit [h, w] bool; None where too little was shaded and not tinted."""
    pixels = np.flatnonzero(lit)
    pixels = pixels[:: max(len(pixels) // SHADES.max_samples, 1)]
    one, other, goal = (values.reshape(-1, 3)[pixels].astype(np.float64) for values in (before, after, target_values))
    # Errors count as they are seen: a step of light is a larger one of display values where it is dark.
    seen = np.ones(other.shape) if not linear else 1 / (2 * np.sqrt(np.maximum(other, 0.01)))
    left = other.sum(1, keepdims=True) / one.sum(1, keepdims=True)
    untinted = (np.abs(other - left * one) * seen).max(1) <= max_tint
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
    reach = exact_reach(made, view)
    if reach < SHADES.min_visible_share:
        return None
    near = mean_difference(view.picture, made) <= np.maximum(COPIES.max_error, COPIES.error_share * change)
    spares = "middle"
    telling = _telling(made, view)
    if telling.sum() >= SHADES.min_ring_px and near[telling].mean() < COPIES.min_near:
        # It goes on beside the asset, or stops there as one of a cut-out picture does.
        if not view.paint_is_on_asset or words == GRADIENT_WORDS:
            return None
        made = np.where(view.bare[..., None], view.render, made)
        words, spares = f"{words}, but for its background", "background"
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    mistake = Mistake("shade", words, _shaded(field, dark, linear), _unshaded(field, dark, linear), spares)
    after = float(agrees[view.compared].mean())
    return _left_unexplained(made, view), Explanation("shade", words, view.agreeing, after, mistake, reach)
