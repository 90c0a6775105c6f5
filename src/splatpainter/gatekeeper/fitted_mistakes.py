"""Mistakes of which the amount is not known: colours mixed, shaded towards the corners or from side to side, moved by a
little. The amount that fits best is found first, then it is judged as every other mistake is.

Pure. H, W: pixels of the view; h, w: of its small copy; colours are display sRGB 0..1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np

from splatpainter.color import LUMA, linear_to_srgb, srgb_to_linear
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
from splatpainter.lift.masks import box_mean, dilated, largest_channel
from splatpainter.order_statistics import median
from splatpainter.pictures.picture_reader import resample
from splatpainter.system.quick_dataclass import dataclass

Field: TypeAlias = Callable[[tuple[int, ...]], np.ndarray]
"""(H, W, ...) -> [H, W], one number for each pixel of a picture of that size."""


@dataclass(frozen=True)
class FitThresholds:
    """What is taken for a mistake of an amount that was found. Measured on fourteen views of seven assets where an
    entry says so, else taste."""

    reweightings: int = 6
    """Rounds of reweighting by which painted pixels stop to count."""
    min_deviation: float = 0.004
    """Deviation of what is left, display values, below which it is rounding."""
    min_chroma: float = 0.03
    """Distance from grey, display values, from which a pixel has a colour."""
    min_colored: int = 64
    """Pixels that have a colour, at least."""
    min_mixed: float = 0.8
    """Share of what picture and view show that agrees after a mixture of channels, grey parts, too."""
    min_saturation: tuple[float, float] = (0.95, 1.05)
    """Gains of saturation that are none."""
    max_hue_turn: float = 0.08
    """Largest entry of a mixture of channels that is left beside a gain of saturation."""
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
    soft_px: int = 4
    """Reach over which a soft brush is the same, pixels of a small copy."""
    min_soft: float = 0.9
    """Share of what differs that a soft brush explains."""
    min_texture: float = 1e-4
    """Variance of the colours around a pixel, from which it says how much of them is left."""
    min_gain_range: float = 0.08
    """Range of what is left, between the middle four fifths of such pixels, below which it is the same everywhere."""
    max_intact: float = 0.65
    """Share of the detail that may be as it was rendered where a picture is looked at whether it was moved. A shift by
    a pixel leaves up to 0.41 of it, on a smooth asset, a keystone of 2 % up to 0.63; a dab or a decal leaves more."""
    min_moved_share: float = 0.008
    """Share of the asset's pixels that a small move must change to be told. A keystone of 2 % changes 0.3 to 4 % of
    it."""
    min_moved_explained: float = 0.8
    """Share of what a small move changes that is as it makes it: 0.87 to 1.00 where it is one, up to 0.10 where a
    filter shifted edges."""
    mean_reach: float = 1 / 24
    """Reach over which a move leaves means as they are, in parts of the longer side."""
    max_mean: float = 10 / 255
    """By how much it may change such a mean."""
    min_still: float = 0.6
    """Share of the asset whose means have to be so."""
    min_outline_moved: float = 0.75
    """Share of what a move of the outline changes that is as it makes it. Shifts of 1 to 6 pixels of a ball 0.82 to
    0.92, crops and pads 0.98 to 1.00."""
    min_outline_explained: float = 0.97
    """Share of what differs beside the outline that is as the move makes it: 0.98 to 1.00 of moves, up to 0.93 of paint
    along the outline (the background's colour drawn all around)."""
    outline_px: int = 4
    """How far beside it that is looked at."""
    max_moved_px: int = 1024
    """Longer side of the copies on which it is looked for."""


FITS = FitThresholds()

MIXED_WORDS = "with its hues turned, or its channels mixed or exchanged"
VIGNETTE_WORDS = "darkened towards its corners (a vignette)"
LIGHT_VIGNETTE_WORDS = "lightened towards its corners (a vignette)"
GRADIENT_WORDS = "darkened or lightened from side to side (a gradient over all of it)"
SOFT_WORDS = "painted over softly everywhere, its background too, or shaded as a whole"
EVEN_WORDS = "darkened, lightened or tinted as a whole, or its transparency was lost"
MOVED_WORDS = "moved, scaled or turned by a little"
BENT_WORDS = "bent: distorted by a lens, in perspective, or stretched in one direction"
APART_WORDS = "of colours that lie beside each other (chromatic aberration, or a shifted channel)"


def fitted_mistakes(view: SmallView) -> Iterator[Explanation]:
    """Explanations by mistakes whose amount fits the picture best: channels mixed, shaded as a whole."""
    mixed = _mixed_channels(view)
    for made, min_explained in (*(() if mixed is None else ((mixed, FITS.min_mixed),)), *_shadings(view)):
        explanation = explained_by(*made, view)
        # What is fitted to a picture explains some of any picture.
        if explanation is not None and explanation.agreeing_after >= min_explained:
            yield explanation


def _mixed_channels(view: SmallView) -> tuple[Mistake, np.ndarray] | None:
    """The mixture of channels that leaves grey as it is and fits the picture best, and what it makes of the view
    [h, w, 3]: more or less saturation, hues turned, channels exchanged. None where nothing has a colour."""
    before, after = (image[view.solid].astype(np.float64) for image in (view.render, view.picture))
    # Over 3 x 3 pixels compression averages out; grey says nothing, as it stays.
    chroma = before - before.mean(1, keepdims=True)
    colored = np.abs(chroma).max(1) > FITS.min_chroma
    if colored.sum() < FITS.min_colored:
        return None
    # Of what each channel gains only the two differences to green can tell: their sum is zero on grey.
    away = before[colored][:, (0, 2)] - before[colored][:, 1:2]
    gained = after[colored] - before[colored]
    weight = np.ones(len(away))
    mixture = np.zeros((2, 3))
    for _ in range(FITS.reweightings):
        normal = gram(away, weight)
        normal += 1e-6 * np.trace(normal) * np.eye(2)
        mixture = solved(normal, transposed_product(away * weight[:, None], gained))
        left = np.abs(gained - matmul(away, mixture)).max(1)
        weight = 1 / (1 + (left / max(float(median(left)), FITS.min_deviation)) ** 2)
    # Rows of the full matrix sum to one: (r - g) and (b - g) times the mixture.
    full = np.eye(3) + np.stack([mixture[0], -mixture[0] - mixture[1], mixture[1]])
    made = np.clip(matmul(view.render, full), 0, 1).astype(np.float32)
    inverse = _unmixed(full)
    undone = None if inverse is None else lambda colors: np.clip(matmul(colors, inverse), 0, 1)
    return Mistake(
        "colors", _mixture_words(full), lambda colors: np.clip(matmul(colors, full), 0, 1), undone, "grey"
    ), made


def _unmixed(full: np.ndarray) -> np.ndarray | None:
    """[3, 3] the inverse of a mixture of channels; None where too little of a colour is left."""
    # Rows of the adjugate are cross products of columns.
    adjugate = np.cross(full[:, (1, 2, 0)], full[:, (2, 0, 1)], axis=0).T
    determinant = float((adjugate[0] * full[:, 0]).sum())
    return adjugate / determinant if abs(determinant) > 0.05 else None


def _mixture_words(full: np.ndarray) -> str:
    grey = np.tile(np.asarray(LUMA)[:, None], (1, 3))
    away = np.eye(3) - grey
    gain = float((away * (full - grey)).sum() / (away**2).sum())
    low, high = FITS.min_saturation
    if np.abs(full - grey - gain * away).max() < FITS.max_hue_turn + 0.2 * abs(gain - 1) and gain > 0:
        if gain < low:
            return f"of less saturation (by about {100 * (1 - gain):.0f} %)"
        if gain > high:
            return f"of more saturation (by about {100 * (gain - 1):.0f} %)"
    return MIXED_WORDS


def _shadings(view: SmallView) -> Iterator[tuple[tuple[Mistake, np.ndarray], float]]:
    """Shades that fit the picture best, and what each makes of the view [h, w, 3], and the share of the picture that
    they must explain: towards the corners, dark and light, and from side to side."""
    for dark in (True, False):
        # Towards white is what towards black is of the negative; lenses and some sliders shade light, not values.
        for linear in (False, True) if dark else (False,):
            before, after = (_toward_black(image, dark, linear) for image in (view.render, view.picture))
            brightness = before.mean(-1)
            lit = (brightness > FITS.min_lit) & (view.solid if view.paint_is_on_asset else True)
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
                    yield (Mistake("shade", words, lambda colors: colors, undone, "middle"), made), FITS.min_shaded
                elif view.paint_is_on_asset and words == vignette:
                    made = np.where(view.bare[..., None], view.render, made)
                    words = f"{words}, but for its background"
                    mistake = Mistake("shade", words, lambda colors: colors, undone, "background")
                    yield (mistake, made), FITS.min_shaded_asset


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
        light = np.maximum(field(colors.shape[:2]), FITS.min_left)
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
    ring = np.minimum((radius(left.shape) * FITS.rings).astype(int), FITS.rings - 1)
    centers, values = [], []
    for number in range(FITS.rings):
        inside = lit & (ring == number)
        if inside.sum() >= FITS.min_ring_px:
            centers.append((number + 0.5) / FITS.rings)
            values.append(float(median(left[inside])))
    if len(values) < FITS.rings // 2:
        return None
    # Most dabs are in the middle, where they cover rings whole: there the light rises as the square of the distance.
    for covered in range(FITS.max_covered_rings + 1):
        inner = centers[covered]
        middle = FITS.max_middle_shade + (FITS.max_middle_slope * inner * inner if covered else 0)
        rest = np.asarray(values[covered:])
        if np.diff(rest).max() <= FITS.max_ring_rise and -FITS.max_middle_shade <= 1 - rest[0] <= middle:
            break
    else:
        return None
    if covered:  # the next one may be covered in part
        covered, rest, inner = covered + 1, rest[1:], centers[covered + 1]
    within = np.asarray(centers[:covered])
    profile = np.concatenate([1 - (1 - rest[0]) * (within / inner) ** 2, rest])
    if profile[0] - profile[-1] < FITS.min_corner_shade:
        return None
    return lambda shape: portable.interp(radius(shape), centers, profile)


def _slope(left: np.ndarray, lit: np.ndarray) -> Field | None:
    """The light that is left, as a plane over the picture; None where it is level. left, lit: [h, w]."""
    x, y = _across(left.shape)
    terms = np.stack([np.ones_like(x), x, y], -1)
    samples, values, weight = terms[lit], left[lit], np.ones(int(lit.sum()))
    if len(values) < FITS.min_colored:
        return None
    plane = np.zeros((3, 1))
    for _ in range(FITS.reweightings):
        normal = gram(samples, weight) + 1e-6 * np.eye(3)
        plane = solved(normal, transposed_product(samples, (weight * values)[:, None]))
        error = np.abs(values - matmul(samples, plane)[:, 0])
        weight = 1 / (1 + (error / max(float(median(error)), FITS.min_deviation)) ** 2)
    if np.abs(plane[1:]).sum() < FITS.min_corner_shade / 2:
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
    if shaded.sum() < FITS.min_background * bare.sum():
        return False
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    return bool(agrees[shaded].mean() >= FITS.min_shade_explained)


def laid_softly(view: SmallView) -> Explanation | None:
    """Whether one colour, laid over it more here and less there, makes the view the picture everywhere: a very large
    soft brush, which may be meant; or as much of it everywhere, which is none."""
    before, after = view.render.astype(np.float64), view.picture.astype(np.float64)
    # Around each pixel: after = gain * before + colour, by least squares over its surroundings.
    mean_before, mean_after = (box_mean(image, FITS.soft_px) for image in (before, after))
    away = (box_mean(before**2, FITS.soft_px) - mean_before**2).sum(-1)
    together = (box_mean(before * after, FITS.soft_px) - mean_before * mean_after).sum(-1)
    gain = np.clip(together / np.maximum(away, 1e-6), 0, 1)[..., None]
    made = (gain * before + mean_after - gain * mean_before).astype(np.float32)
    differs = view.compared & (mean_difference(view.picture, view.render) > COPIES.max_difference)
    if not differs.any():
        return None
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    if agrees[differs].mean() < FITS.min_soft or float(gain[differs].mean()) < FITS.min_lit:
        return None
    # The same everywhere is no brush: a layer that was multiplied by its transparency, or one of a flat colour.
    textured = gain[differs & (away > FITS.min_texture)]
    even = len(textured) > FITS.min_colored and float(np.ptp(np.quantile(textured, (0.1, 0.9)))) < FITS.min_gain_range
    after = float(agrees[view.compared].mean())
    return (
        Explanation("tone", EVEN_WORDS, view.agreeing, after)
        if even
        else Explanation("look", SOFT_WORDS, view.agreeing, after)
    )


def moved_a_little(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray, agreeing: float) -> Explanation | None:
    """A picture [H, W, 3] that lies beside its render [H, W, 3] by some pixels, degrees or per cent: what that changes
    is nowhere as it was rendered, and nearly everywhere as it makes it. alpha: [H, W]."""
    picture, render, alpha = _not_too_large(picture, render, alpha)
    height, width = alpha.shape
    # A small move leaves the means of colours where they are; paint over much of it does not. It is cheap.
    solid = alpha > COPIES.min_cover
    reach = max(round(max(height, width) * FITS.mean_reach), 1)
    mean = largest_channel(np.abs(box_mean(picture - np.clip(render, 0, 1), reach)))
    if not solid.any() or (mean <= FITS.max_mean)[solid].mean() < FITS.min_still:
        return None
    unchanged = mean_difference(picture, render) <= COPIES.max_unchanged
    unpainted = mean <= FITS.max_mean
    for words, mistake, made, inside in _displacements(picture, render):
        asset = inside & solid & unpainted  # a dab on a bend is as neither makes it
        moved = asset & (mean_difference(made, render) > COPIES.min_predicted)
        if moved.sum() <= FITS.min_moved_share * asset.sum() or unchanged[moved].mean() > COPIES.max_contradicting:
            continue
        agrees = mean_difference(picture, made) <= COPIES.max_difference
        if agrees[moved].mean() >= FITS.min_moved_explained:
            return Explanation("moved", words, agreeing, float(agrees[asset].mean()), mistake)
    return None


def moved_outline(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray, agreeing: float) -> Explanation | None:
    """A picture [H, W, 3] of a plain asset that was cropped, padded or shifted: all that it shows is the outline, and
    that lies elsewhere than in the render [H, W, 3], on all sides as one motion has it. alpha: [H, W]."""
    from splatpainter.gatekeeper.registration import inverse_map, small_motion, warped

    picture, render, alpha = _not_too_large(picture, render, alpha)
    motion = small_motion(picture, render)
    if motion is None:
        return None
    height, width = alpha.shape
    made, inside = warped(render, inverse_map(motion)[:2], (width, height))
    predicted = inside & (mean_difference(made, render) > COPIES.min_predicted)
    if predicted.sum() <= FITS.min_moved_share * (alpha > COPIES.min_cover).sum():
        return None
    # Paint on the outline leaves the rest of it where it was, or differs beside it from what the motion makes.
    agrees = mean_difference(picture, made) <= COPIES.max_difference
    differs = inside & dilated(predicted, FITS.outline_px)
    differs &= mean_difference(picture, render) > COPIES.max_difference
    if agrees[predicted].mean() < FITS.min_outline_moved or not differs.any():
        return None
    if agrees[differs].mean() < FITS.min_outline_explained:
        return None
    return Explanation("moved", MOVED_WORDS, agreeing, float(agrees[inside].mean()))


def _not_too_large(*images: np.ndarray) -> Iterator[np.ndarray]:
    """Larger pictures are looked at smaller: a pixel of a large one is half of one there, which is seen as well."""
    height, width = images[0].shape[:2]
    shrink = max(max(height, width) / FITS.max_moved_px, 1.0)
    width, height = max(round(width / shrink), 1), max(round(height / shrink), 1)
    return (resample(np.clip(one, 0, 1), width, height) if shrink > 1 else one for one in images)


def _displacements(
    picture: np.ndarray, render: np.ndarray
) -> Iterator[tuple[str, Mistake | None, np.ndarray, np.ndarray]]:
    """How a picture [H, W, 3] may lie beside its render [H, W, 3], cheapest first: words, the mistake where it can be
    taken back, what that makes of the render [H, W, 3], and [H, W] bool where that is known."""
    from splatpainter.gatekeeper.bent_pictures import bend_of  # few pictures come so far
    from splatpainter.gatekeeper.registration import inverse_map, small_motion, warped

    height, width = render.shape[:2]
    motion = small_motion(picture, render)
    if motion is not None:
        inverse = inverse_map(motion)[:2]
        yield MOVED_WORDS, None, *warped(render, inverse, (width, height))
    bend = bend_of(picture, render)
    if bend is not None:
        made, inside = bend.made(render)
        yield BENT_WORDS, Mistake("moved", BENT_WORDS, lambda colors: bend.made(colors)[0], bend.undone), made, inside
    # A lens bends each colour by another amount; a shifted channel is the simplest case of it.
    bends = [bend_of(*(np.repeat(image[..., [channel]], 3, -1) for image in (picture, render))) for channel in range(3)]
    if any(bends):

        def parts_of(colors: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
            planes = [colors[..., [channel]] for channel in range(3)]
            everywhere = np.ones((height, width), bool)
            return [
                (plane, everywhere) if one is None else one.made(plane)
                for one, plane in zip(bends, planes, strict=True)
            ]

        def made_of(colors: np.ndarray) -> np.ndarray:
            return np.concatenate([plane for plane, _ in parts_of(colors)], -1)

        def undone(colors: np.ndarray) -> np.ndarray:
            planes = [colors[..., [channel]] for channel in range(3)]
            return np.concatenate(
                [plane if one is None else one.undone(plane) for one, plane in zip(bends, planes, strict=True)], -1
            )

        parts = parts_of(render)
        yield (
            APART_WORDS,
            Mistake("moved", APART_WORDS, made_of, undone),
            np.concatenate([plane for plane, _ in parts], -1),
            np.all([inside for _, inside in parts], axis=0),
        )
