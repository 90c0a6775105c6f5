"""Mistakes of which the amount is not known: colours mixed, shaded, laid over softly, moved by a little. The amount
that fits best is found first, then it is judged as every other mistake is.

Pure. H, W: pixels of the view; h, w: of its small copy; colours are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from splatpainter.color import LUMA
from splatpainter.gatekeeper.shades import shade_of
from splatpainter.gatekeeper.small_copies import (
    COPIES,
    Explanation,
    Mistake,
    SmallView,
    explained_by,
    mean_difference,
)
from splatpainter.kernels.portable import gram, matmul, solved, transposed_product
from splatpainter.lift.masks import box_mean, dilated, largest_channel
from splatpainter.order_statistics import median
from splatpainter.pictures.picture_reader import resample
from splatpainter.system.quick_dataclass import dataclass


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
    soft_px: int = 4
    """Reach over which a soft brush is the same, pixels of a small copy."""
    min_soft: float = 0.9
    """Share of what differs that a soft brush explains."""
    min_gain: float = 0.04
    """Mean share of the render that must show through it."""
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
SOFT_WORDS = "painted over softly everywhere, its background too, or shaded as a whole"
EVEN_WORDS = "darkened, lightened or tinted as a whole, or its transparency was lost"
MOVED_WORDS = "moved, scaled or turned by a little"
BENT_WORDS = "bent: distorted by a lens, in perspective, or stretched in one direction"
APART_WORDS = "of colours that lie beside each other (chromatic aberration, or a shifted channel)"


def fitted_mistakes(view: SmallView) -> Iterator[Explanation]:
    """Explanations by mistakes whose amount fits the picture best: channels mixed, shaded as a whole."""
    mixed = _mixed_channels(view)
    if mixed is not None:
        explanation = explained_by(*mixed, view)
        # What is fitted to a picture explains some of any picture.
        if explanation is not None and explanation.agreeing_after >= FITS.min_mixed:
            yield explanation
    shade = shade_of(view)
    if shade is not None:
        yield shade


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
    if agrees[differs].mean() < FITS.min_soft or float(gain[differs].mean()) < FITS.min_gain:
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
