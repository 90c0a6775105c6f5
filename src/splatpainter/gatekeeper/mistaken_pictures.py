"""Pictures that differ from their view nearly everywhere: which mistake made them so, found by trying mistakes out.

What another program, another encoding or a mirror would have made of the render is made of a small copy of it and
compared with a small copy of the picture. A mistake explains a picture where most of what it would have changed is as
it would be, and nearly nothing there is still as it was rendered: paint leaves the rest of a picture alone, a mistake
leaves nothing. Pure. H, W: pixels of the view; colours are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from splatpainter.color import LUMA
from splatpainter.gatekeeper.exact_mistakes import COLORS, OTHER_PRIMARIES, TURNS
from splatpainter.gatekeeper.fitted_mistakes import (
    FITS,
    MOVED_WORDS,
    fitted_mistakes,
    laid_softly,
    moved_a_little,
    moved_outline,
)
from splatpainter.gatekeeper.local_contrast import raised_contrast
from splatpainter.gatekeeper.small_copies import (
    COPIES,
    Explanation,
    Mistake,
    Size,
    SmallView,
    explained_by,
    mean_difference,
)
from splatpainter.gatekeeper.tone_curves import GRADED_BY_CURVES, curves_of, graded_by_curves, left_after
from splatpainter.kernels.portable import dot
from splatpainter.lift.masks import MASKS, box_mean, contrast, largest_channel, largest_difference
from splatpainter.order_statistics import median
from splatpainter.pictures.encodings import busiest, detailed, few_colors
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class MistakeThresholds:
    """Which pictures were saved or chosen by mistake. In display values, pixels of small copies. Measured where an
    entry says on what, else taste."""

    min_alike: float = 0.95
    """Share of what the picture and the view show that agrees from which nothing is looked for."""
    max_agreeing: float = 0.15
    """Share of what the picture and the view show from which a picture that nothing explains is taken for a painted
    one. Other views and assets have up to 0.08, a decal over 90 % 0.06 to 0.08."""
    max_agreeing_full: float = 0.03
    """As max_agreeing, where no background is bare."""
    max_agreeing_moved: float = 0.4
    """As max_agreeing, for pictures of another outline, which are looked at whether they were moved."""
    min_sure: float = 0.95
    """Share that agrees after a mistake from which no other is looked for."""
    min_intact: float = 0.005
    """Share of the asset's detail below which nothing of it is as it was rendered. Other views and assets, and looks,
    leave 0.000 of it on eighteen views of six captures; paint over 90 % of the asset 0.007 and more."""
    max_raised_intact: float = 0.4
    """Share of the asset's detail that may be as it was rendered where it is asked whether its local contrast was
    raised. A weak unsharp mask leaves up to 0.32 of it, on views of five assets."""
    intact_px: int = 3
    """Reach around a pixel within which it is asked how much is unchanged."""
    min_same: float = 0.9
    """Share of `intact_px` around a pixel that is unchanged where the pixel is intact."""
    max_intact_px: int = 1024
    """Side of the part of a picture in which intact pixels are looked for."""
    min_filter_px: int = 3
    """Reach over which a filter leaves the mean of colours as it was: pixels, at least."""
    filter_share: float = 1 / 24
    """The same reach in parts of the picture's longer side; the larger of both counts."""
    max_filtered_mean: float = 8 / 255
    """By how much it may change that mean."""
    min_filtered_px: int = 64
    """Pixels of detail by which a filter is told, at least."""
    min_filtered_share: float = 0.4
    """Share of the pixels of detail that is not painted over where a filter is told, at least."""
    max_smoothed: float = 0.85
    """Contrast in parts of the render's up to which a picture was smoothed. Recompressed ones have 0.93 to 1.2."""
    max_new_detail: float = 0.015
    """Share of the pixels of detail with more contrast than the render has anywhere near from which no filter smoothed
    a picture, but a better one was made. Close-ups of six meshes as 60,000 Gaussians: their true pictures 0.028 to
    0.047; blurs and medians up to 0.002, WebP of quality 1 to 10 up to 0.006."""
    new_contrast: float = 1.3
    """Contrast of such a pixel, in parts of the largest near it in the render."""
    new_reach_px: int = 2
    """How near that is looked for."""
    min_blocked: float = 0.6
    """How much of the new detail lies along a grid, beyond what would by chance, from which blocks made it: JPEG's, or
    large pixels."""
    block_px: tuple[int, ...] = (3, 4, 5, 6, 7, 8, 10, 12, 16)
    """Edges of blocks that are tried, pixels."""
    min_sharpened: float = 1.25
    """The same from which it was sharpened."""
    noise_px: int = 4
    """Reach over which the level of noise is measured."""
    min_noise: float = 1.2 / 255
    """Level from which noise lies over a pixel: rounding has up to half a level."""
    quiet_share: float = 0.1
    """Share of the pixels that are the quietest, and the loudest."""
    min_even_noise: float = 0.3
    """Level of the quietest tenth in parts of that of the loudest: noise lies over everything, detail does not."""
    max_median: float = 0.75
    """Contrast, in parts of the render's, up to which a filter may keep edges, and with them some detail, intact."""
    max_intact_edges: float = 0.06
    """Share of the detail that a picture of so little contrast keeps intact, at most, where it was smoothed."""
    max_posterised: int = 64
    """Colours of a picture from which it is not called posterised."""
    tone_px: int = 3
    """Reach over which noise averages out."""
    min_tone_contrast: float = 0.35
    """Standard deviation of a graded picture in parts of the render's: one flat colour is paint."""
    min_slight: float = 1 / 255
    """Median change of the asset from which it may have been graded slightly."""
    max_tone_error: float = 0.75 / 255
    """How near a graded picture is to one function of colour: display values of means over 3 x 3 pixels of small
    copies. Two views, a plain asset and a capture: 0.1 to 0.3 of 255 for four fifths of the pixels."""
    tone_error_share: float = 0.1
    """The same in parts of the median change; the larger of both counts."""
    min_graded: float = 0.7
    """Share of the asset that must be as near: the rest may be painted over."""
    min_graded_share: float = 0.3
    """Share of the asset that a grade must change visibly."""
    min_graded_background: float = 0.1
    """The same where it explains the background, too: much of an asset may be too dark to show it."""
    min_slight_change: float = 4 / 255
    """Change of a pixel from which it tells other primaries of pale colours."""
    min_slight_share: float = 0.05
    """Share of the asset that must tell so."""
    max_slight_error: float = 1.25 / 255
    """How near such a pixel is to what they make of it."""
    max_glaze_gain: float = 0.9
    """Contrast in parts of the render's up to which a colour may have been laid over all of the asset."""
    min_glaze_gain: float = 0.1
    """The same down to which the asset shows through a colour."""
    min_glazed: float = 0.9
    """Share of the asset that such a colour must explain."""
    max_off_mean: float = 0.02
    """How far such a colour may lie from the mean of the asset, up to which only the contrast was lowered."""
    middle_grey: float = 0.5
    """Display value about which many sliders of contrast turn; it is a colour to paint with, too."""
    min_spread: float = 0.06
    """Deviation of the asset's colours from which its mean is no colour that a brush would take."""
    min_registered_px: int = 16
    """Pixels of the shorter side of a small copy from which it is looked where it lies."""
    min_moved_score: float = 0.6
    """Score of a registration from which a picture was moved."""
    min_moved_explained: float = 0.25
    """Share of what differs that must be as a move makes it: on four assets, plain, fitted and captured, shifts of 3 to
    30 pixels and scales of 5 and 15 % 0.79 to 1.00, with a large dab over them 0.48 to 0.85; glows 0.00."""
    max_left_behind: float = 0.1
    """Share of what a move changes that may be as it was rendered: a part that was moved by hand leaves the rest."""
    max_left_by_curves: float = 0.7
    """What curves leave of a grade, in parts of what else takes it back leaves, up to which they take it back."""
    min_left: float = 1 / 255
    """What is left of a mistake that is met exactly: rounding, the larger the darker it was."""
    max_left_by_mistake: float = 3 / 255
    """What a known mistake leaves of most of the asset, at most, to be called so where curves leave less."""
    min_gain: float = 0.02
    """Share that must agree with curves beyond that with another mistake, from which they are likelier."""
    min_moved_px: float = 0.8
    """Pixels of a small copy from which it was moved."""


MISTAKES = MistakeThresholds()


GRADED_WORDS = (
    "graded, or glazed with one colour, as a whole, but for its background: its other sides stay as they are; --mode "
    "global carries the look all around"
)
GREYED_WORDS = (
    "of lower contrast, or glazed with middle grey, as a whole, but for its background: its other sides stay as they "
    "are; --mode global carries the look all around"
)
FLATTER_WORDS = "of lower contrast as a whole, but for its background"
PAINTED_OVER_WORDS = "painted over everywhere; if it is not, it is of another view or asset"
SMOOTHED_WORDS = "blurred, denoised or smoothed as a whole"
SHARPENED_WORDS = "sharpened, or detail or noise was added, all over: all of it is painted anew"


def explain(
    picture: np.ndarray,
    render: np.ndarray,
    alpha: np.ndarray,
    with_other_axes: Callable[[Size], Iterable[tuple[str, np.ndarray]]] | None = None,
) -> Explanation | None:
    """Why a picture [H, W, 3] differs from its view nearly everywhere; None where it does not, or where what differs
    may well be paint. render: [H, W, 3]; alpha: [H, W] of it; with_other_axes: gives views of that size of the asset
    read with other axes, and what to do about each; asked only where nothing else explains the picture."""
    # Small copies: compression averages out, and thirty mistakes can be tried in no time.
    view = SmallView.of(picture, render, alpha)
    if not view.compared.any():
        return None
    explanation = _explained(picture, render, alpha, view, with_other_axes)
    return None if explanation is None else _taken_back_by_curves(explanation, view)


def _explained(
    picture: np.ndarray,
    render: np.ndarray,
    alpha: np.ndarray,
    view: SmallView,
    with_other_axes: Callable[[Size], Iterable[tuple[str, np.ndarray]]] | None,
) -> Explanation | None:
    """As `explain`, of a view's small copies."""
    intact = intact_share(picture, render, alpha)
    raised = raised_contrast(picture, render, alpha, view.agreeing) if intact < MISTAKES.max_raised_intact else None
    if view.agreeing <= MISTAKES.min_alike:
        # Every mistake is made of the render and compared; the best explanation wins ...
        judged = [*(_judged(mistake, view) for mistake in (*TURNS, *COLORS)), *fitted_mistakes(view)]
        best = max(filter(None, (*judged, raised)), key=lambda one: one.agreeing_after, default=None)
        if best is not None and (best is raised or best.cause == "turned" or best.agreeing_after > MISTAKES.min_sure):
            return best
        # ... against one smooth function of colour, which many mistakes of encoding resemble.
        nothing_left = view.agreeing <= MISTAKES.max_agreeing or intact < MISTAKES.min_intact
        graded = _graded(view) if nothing_left else None
        likeliest = max(filter(None, (graded, best)), key=lambda one: one.agreeing_after, default=None)
        # Of a pale asset other primaries change little, which a curve follows as well; its paint they change much.
        likeliest = _other_primaries(view, likeliest) or likeliest
        # Fixed curves explain a part of any exposure: one that fits beside the paint and explains more is likelier.
        painted = _graded_under_paint(view, nothing_left) if graded is None else None
        if painted is not None and (likeliest is None or _explains_more(painted, likeliest)):
            likeliest = painted
        # A shade, or a known gamma, that explains a part may be a curve that explains all.
        if likeliest is None or likeliest.cause in ("shade", "colors"):
            curved = graded_by_curves(view)
            explained = 0.0 if likeliest is None else likeliest.agreeing_after + MISTAKES.min_gain
            if curved is not None and curved.agreeing_after > explained and not _is_glazed(view, curved):
                likeliest = curved
        if likeliest is not None:
            return likeliest
    if raised is not None:
        return raised
    # By a pixel or a degree small copies hardly move: that is looked for at full size, where little is intact.
    moved = moved_a_little(picture, render, alpha, view.agreeing) if _may_be_moved(view, intact) else None
    if moved is None and view.outline_is_elsewhere and min(view.alpha.shape) >= MISTAKES.min_registered_px:
        moved = moved_outline(picture, render, alpha, view.agreeing)
    if moved is not None or view.agreeing > MISTAKES.min_alike:
        return moved
    # Much of it agrees: it was painted on, unless its outline says that it was moved.
    if view.agreeing > MISTAKES.max_agreeing and not (
        view.agreeing < MISTAKES.max_agreeing_moved and view.has_other_outline
    ):
        return None
    # Registration is dear, so it comes after what is cheap; other axes need new renders and come last.
    moved = _moved(view)
    if moved is not None or view.agreeing > MISTAKES.max_agreeing:
        return moved
    if intact >= MISTAKES.min_intact:
        return None
    softly = laid_softly(view)
    return softly or _of_other_axes(view, with_other_axes) or _posterised(picture, view) or _something_else(view)


def _taken_back_by_curves(explanation: Explanation, view: SmallView) -> Explanation:
    """The same, taken back by curves that were fitted to the picture where these leave less than what it has: tone
    mapping resembles a gamma, and no gain takes back contrast."""
    mistake = explanation.mistake
    if explanation.cause not in ("colors", "tone") or (mistake is not None and mistake.spares != "nothing"):
        return explanation
    curves = curves_of(view)
    if curves is None:
        return explanation
    after = left_after(curves.undone(view.picture), view)
    before = np.inf
    if mistake is not None and mistake.undone is not None:
        before = left_after(np.asarray(mistake.undone(view.picture), np.float32), view)
    if after > COPIES.max_difference or after > MISTAKES.max_left_by_curves * max(before - MISTAKES.min_left, 0):
        return explanation
    cause, words = explanation.cause, explanation.words
    # A known gamma that is so far off is none.
    if cause == "colors" and before > MISTAKES.max_left_by_mistake:
        cause, words = "tone", GRADED_BY_CURVES
    return replace(explanation, cause=cause, words=words, mistake=Mistake(cause, words, curves.made, curves.undone))


def _may_be_moved(view: SmallView, intact: float) -> bool:
    return intact < FITS.max_intact and min(view.alpha.shape) >= MISTAKES.min_registered_px


def intact_share(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> float:
    """Share of the asset's detail, 0..1, that is in a picture [H, W, 3] exactly where its render [H, W, 3] has it:
    nothing but paint leaves any. alpha: [H, W] of the render. 1 where there is no detail."""
    part = busiest(alpha, MISTAKES.max_intact_px)
    seen, before = picture[part], np.clip(render[part], 0, 1)
    detail = detailed(before, alpha[part] > COPIES.min_cover)
    return float(_intact(seen, before)[detail].mean()) if detail.any() else 1.0


def filtered(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> Explanation | None:
    """A filter that went over all of a picture [H, W, 3] and left its colours where they are, but none of its detail as
    the render [H, W, 3] (as it was stored) has it: blurring, a median, denoising, pixels, sharpening, noise. None where
    there is no such; what paint covers does not count. alpha: [H, W] of the render."""
    part = busiest(alpha, MISTAKES.max_intact_px)
    seen, before, solid = picture[part], np.clip(render[part], 0, 1), alpha[part] > COPIES.min_cover
    detail = detailed(before, solid)
    if detail.sum() < MISTAKES.min_filtered_px:
        return None
    # A filter leaves means as they were: where they moved, somebody painted, and that does not count.
    reach = max(MISTAKES.min_filter_px, round(max(alpha.shape) * MISTAKES.filter_share))
    weight = box_mean(solid.astype(np.float32), reach)
    changed = seen - before
    changed.reshape(-1, 3)[np.flatnonzero(~solid)] = 0
    mean = box_mean(changed, reach)
    del changed  # of large pictures every array is fresh pages
    mean /= np.maximum(weight, 1e-3)[..., None]
    same_mean = largest_channel(np.abs(mean, out=mean)) <= MISTAKES.max_filtered_mean
    del mean, weight
    unpainted = detail & same_mean
    if unpainted.sum() < MISTAKES.min_filtered_share * detail.sum():
        return None
    # Strong smoothing may keep edges; weak smoothing that leaves a part intact is an edit of the rest.
    intact = float(_intact(seen, before)[unpainted].mean())
    if intact < max(MISTAKES.min_intact, MISTAKES.max_intact_edges):
        after, rendered = contrast(seen), contrast(before)
        ratio = float(np.median(after[unpainted]) / max(float(np.median(rendered[unpainted])), 1e-6))
        smoothed = ratio < MISTAKES.max_smoothed and intact < (
            MISTAKES.min_intact if ratio > MISTAKES.max_median else MISTAKES.max_intact_edges
        )
        # A better picture of a coarse asset has less contrast, too, where that was noise; but edges that no filter
        # makes.
        if smoothed and not _has_new_detail(after, rendered, unpainted):
            return Explanation("filter", SMOOTHED_WORDS, intact, 0.0)
        if ratio > MISTAKES.min_sharpened and intact < MISTAKES.min_intact:
            return Explanation("detail", SHARPENED_WORDS, intact, 0.0)
    if _is_noisy(seen, before, same_mean):
        return Explanation("detail", SHARPENED_WORDS, intact, 0.0)
    return None


def _is_noisy(picture: np.ndarray, render: np.ndarray, unpainted: np.ndarray) -> bool:
    """Whether noise lies over a picture [H, W, 3] where it was not painted, [H, W] bool: asset and background alike."""
    level = _noise_level(picture - render)[unpainted]
    # Counted first: what the picture has beyond its render is quiet enough in most of them, and the least of both
    # levels, and an order of them, need not be found for that.
    if np.count_nonzero(level <= MISTAKES.min_noise) > MISTAKES.quiet_share * len(level) + 1:
        return False
    # Noise of the render that a clean picture lacks is none of the picture's.
    level = np.minimum(level, _noise_level(picture)[unpainted])
    quiet, loud = np.quantile(level, (MISTAKES.quiet_share, 1 - MISTAKES.quiet_share)) if len(level) else (0.0, 0.0)
    return bool(quiet > max(MISTAKES.min_noise, MISTAKES.min_even_noise * loud))


def _noise_level(values: np.ndarray) -> np.ndarray:
    """[H, W] mean level of noise around each pixel of [H, W, 3]."""
    noise = box_mean(values, 1)
    np.subtract(values, noise, out=noise)
    return box_mean(largest_channel(np.abs(noise, out=noise)), MISTAKES.noise_px)


def _has_new_detail(after: np.ndarray, before: np.ndarray, pixels: np.ndarray) -> bool:
    """Whether a picture has detail that its render has not, and that is not the edges of blocks. after, before: [H, W]
    contrast; pixels: [H, W] bool that count."""
    around = before
    for axis in (0, 1):
        reach = range(-MISTAKES.new_reach_px, MISTAKES.new_reach_px + 1)
        around = np.max([np.roll(around, step, axis) for step in reach], axis=0)
    new = pixels & (after > MISTAKES.new_contrast * around + COPIES.max_unchanged)
    if new.sum() <= MISTAKES.max_new_detail * pixels.sum():
        return False
    rows, columns = np.nonzero(new)
    for block in MISTAKES.block_px:
        # Both pixels beside an edge between blocks have its contrast.
        on_grid = ((rows % block) % (block - 1) == 0) | ((columns % block) % (block - 1) == 0)
        chance = 1 - (1 - 2 / block) ** 2
        if on_grid.mean() - chance > MISTAKES.min_blocked * (1 - chance):
            return False
    return True


def _intact(picture: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels with whose surroundings nothing happened."""
    same = box_mean(largest_difference(picture, render), 1) <= COPIES.max_unchanged
    return box_mean(same.astype(np.float32), MISTAKES.intact_px) > MISTAKES.min_same


def _explains_more(graded: Explanation, other: Explanation) -> bool:
    """Whether a grade that was fitted, and not only told, leaves less unexplained than another mistake."""
    is_fitted = graded.mistake is not None and graded.mistake.undone is not None
    return is_fitted and graded.agreeing_after > other.agreeing_after and other.cause in ("colors", "shade")


def _other_primaries(view: SmallView, other: Explanation | None) -> Explanation | None:
    """Numbers of other primaries that explain a picture of pale colours at least as well as another explanation does;
    None where they do not."""
    if other is not None and other.cause != "tone":
        return None
    solid = view.solid
    out = None
    for mistake in OTHER_PRIMARIES:
        made = np.ascontiguousarray(mistake.made(view.render), np.float32)
        predicted = solid & (mean_difference(made, view.render) > MISTAKES.min_slight_change)
        if predicted.sum() < max(MISTAKES.min_slight_share * solid.sum(), MISTAKES.min_filtered_px):
            continue
        if view.unchanged[predicted].mean() > COPIES.max_contradicting:
            continue
        error = mean_difference(view.picture, made)
        if (error[predicted] <= MISTAKES.max_slight_error).mean() < MISTAKES.min_graded:
            continue
        after = float((error <= COPIES.max_difference)[view.compared].mean())
        if after > max((one.agreeing_after for one in (out, other) if one is not None), default=0) - 0.01:
            reach = 1.0 if other is not None else float(predicted.sum() / solid.sum())
            out = Explanation(mistake.cause, mistake.words, view.agreeing, after, mistake, reach)
    return out


def _judged(mistake: Mistake, view: SmallView) -> Explanation | None:
    """The mistake as an explanation; None where it is none."""
    made = np.ascontiguousarray(mistake.made(view.render), np.float32)
    return None if made.shape != view.picture.shape else explained_by(mistake, made, view)


def _graded(view: SmallView) -> Explanation | None:
    """One smooth function of colour changed all of the asset; of the picture, where its background changed, too."""
    solid = view.solid
    if not solid.any():
        return None
    changed = largest_channel(np.abs(box_mean(view.picture - view.render, MISTAKES.tone_px)))[solid]
    contrast_ratio = view.picture[solid].std(0).mean() / max(float(view.render[solid].std(0).mean()), 1e-6)
    if view.paint_is_on_asset and (glaze := _glaze_color(view, solid)) is not None:
        if _is_mean_color(glaze, view.render[solid]):
            return Explanation("tone", FLATTER_WORDS, view.agreeing, 1.0)
        is_grey = np.abs(glaze - MISTAKES.middle_grey).max() <= MISTAKES.max_off_mean
        return Explanation("look", GREYED_WORDS if is_grey else GRADED_WORDS, view.agreeing, 1.0)
    # Noise, or one flat colour over the asset: paint, though a (constant) function explains it.
    if median(changed) < COPIES.max_difference or contrast_ratio < MISTAKES.min_tone_contrast:
        return None
    from splatpainter.gatekeeper.color_drift import expected_tone  # few pictures come so far

    # A grade changes all of the background or nothing of it; a large brush reaches a part.
    if not view.paint_is_on_asset and (view.stray < COPIES.min_uniform or not view.background_is_uniform):
        return None
    expected = expected_tone(view.picture, view.render, solid)
    if expected is None:
        return None
    # What the function would have changed and is as it was rendered was left out by a hand.
    predicted = solid & (mean_difference(expected, view.render) > COPIES.min_predicted)
    if predicted.any() and view.unchanged[predicted].mean() > COPIES.max_contradicting:
        return None
    return _tone_of(view)


def _graded_under_paint(view: SmallView, nothing_left: bool) -> Explanation | None:
    """One smooth function of colour changed all of the asset, by however little, and some of it was painted over: the
    rest is as near to the function as rounding leaves it, which paint alone is not. nothing_left: whether hardly
    anything is as it was rendered, which dark parts of a graded asset may be."""
    solid = view.solid
    changed = largest_channel(np.abs(box_mean(view.picture - view.render, MISTAKES.tone_px)))[solid]
    middle = float(median(changed)) if len(changed) else 0.0
    slight = MISTAKES.min_slight <= middle < COPIES.max_difference
    # A grade changes all of the background or nothing of it.
    on_asset = view.paint_is_on_asset
    if not (nothing_left or slight or view.background_changed) or not (on_asset or view.background_changed):
        return None
    from splatpainter.gatekeeper.color_drift import likeliest_tone  # few pictures come so far

    expected = likeliest_tone(view.picture, view.render, solid)
    if expected is None:
        return None
    # Up to there nothing would count as painted.
    predicted = solid & (
        mean_difference(expected, view.render) > (MASKS.max_rounding if slight else COPIES.min_predicted)
    )
    error = min(max(MISTAKES.max_tone_error, MISTAKES.tone_error_share * middle), COPIES.max_difference)
    near = mean_difference(view.picture, expected) <= error
    least = MISTAKES.min_graded_background if _background_too(view) else MISTAKES.min_graded_share
    if near[solid].mean() < MISTAKES.min_graded or predicted.sum() < least * solid.sum():
        return None
    # What was left out by a hand is as it was rendered; one colour over all of the asset may be meant.
    same = mean_difference(view.picture, view.render) <= MISTAKES.max_tone_error
    made = replace(view, picture=expected.astype(np.float32))
    contrast_left = expected[solid].std(0).mean() / max(float(view.render[solid].std(0).mean()), 1e-6)
    is_paint = same[predicted].mean() > COPIES.max_contradicting or contrast_left < MISTAKES.min_tone_contrast
    if is_paint or (on_asset and _glaze_color(made, solid) is not None):
        return None
    # A shade from side to side is nearly a function of colour, too, where colours change from side to side.
    if on_asset and not slight and laid_softly(view) is not None:
        return None
    return _tone_of(view)


def _background_too(view: SmallView) -> bool:
    """Whether the gain or mixture of channels that fits the asset takes the background back, too, which changed."""
    if not view.background_changed:
        return False
    from splatpainter.gatekeeper.color_drift import estimate_drift

    before, after = (median(image[view.bare]) for image in (view.render, view.picture))
    drift = estimate_drift(view.picture, view.render, view.solid, certain=True)
    return drift.kind != "none" and bool(np.abs(drift.corrected(after) - before).max() <= COPIES.max_difference)


def _tone_of(view: SmallView) -> Explanation:
    """What is said of a picture that was graded, and what takes it back."""
    from splatpainter.gatekeeper.color_drift import estimate_drift

    # The background did not change: a colour laid over all of the asset is paint; any other curve is a grade.
    if view.paint_is_on_asset and view.background_change < MISTAKES.max_tone_error:
        return Explanation("tone", "graded as a whole, but for its background", view.agreeing, 1.0)
    # Gain and offset can be taken back; a free curve cannot.
    drift = estimate_drift(view.picture, view.render, view.solid, certain=True)
    words, undone, after = "graded as a whole", None, COPIES.min_explained
    if drift.kind in ("gain", "gain and offset"):
        words = f"graded as a whole (exposure or white balance by {drift.strength:.1f} stops)"
    if drift.kind != "none":
        undone = drift.corrected
        after = float(
            (mean_difference(undone(view.picture), view.render) <= COPIES.max_difference)[view.compared].mean()
        )
    return Explanation("tone", words, view.agreeing, after, Mistake("tone", words, lambda colors: colors, undone))


def _glaze_color(view: SmallView, solid: np.ndarray) -> np.ndarray | None:
    """[3] the one colour that may have been laid over all solid pixels ([h, w] bool), through which they still show:
    then all channels lose the same share of their contrast. Lower contrast is a glaze of grey. None: none was."""
    before, after = (image[solid].astype(np.float64) for image in (view.render, view.picture))
    away = before - before.mean(0)
    gains = (away * (after - after.mean(0))).sum(0) / np.maximum((away**2).sum(0), 1e-9)
    gain = float(((away**2).sum(0) * gains).sum() / max((away**2).sum(), 1e-9))
    color = (after.mean(0) - gain * before.mean(0)) / max(1 - gain, 1e-3)
    left = np.abs(gain * before + (1 - gain) * color - after).max(1)
    possible = MISTAKES.min_glaze_gain <= gain < MISTAKES.max_glaze_gain and color.min() > -0.1 and color.max() < 1.1
    return color if possible and (left <= COPIES.max_difference).mean() > MISTAKES.min_glazed else None


def _is_glazed(view: SmallView, curved: Explanation) -> bool:
    """Whether what curves explain may be one colour that was laid over the asset alone."""
    if curved.mistake is None or not view.paint_is_on_asset:
        return False
    made = np.asarray(curved.mistake.made(view.render), np.float32)
    return _glaze_color(replace(view, picture=made), view.solid) is not None


def _is_mean_color(color: np.ndarray, before: np.ndarray) -> bool:
    """Whether a glaze's colour [3] is the mean of what lies under it ([P, 3] colours), or the grey of that: sliders of
    contrast turn about it, and nobody picks just this colour to paint with, where there are many."""
    mean, spread = before.mean(0), float(before.std(0).mean())
    grey = np.full(3, dot(mean, np.asarray(LUMA)))
    off = min(float(np.abs(color - middle).max()) for middle in (mean, grey))
    return spread >= MISTAKES.min_spread and off <= MISTAKES.max_off_mean


def _moved(view: SmallView) -> Explanation | None:
    if min(view.alpha.shape) < MISTAKES.min_registered_px:
        return None
    # Judged at the small size: a shift below a small pixel is not what makes everything differ.
    from splatpainter.gatekeeper.registration import inverse_map, register, warped  # few pictures come so far

    laid = register(view.picture, view.render)
    reach = max(view.alpha.shape) / 2
    moved = max(abs(laid.right), abs(laid.down), reach * abs(laid.scale - 1))
    if laid.score < MISTAKES.min_moved_score or (laid.framing == "full" and moved < MISTAKES.min_moved_px):
        return None
    if laid.framing != "full":
        return Explanation("moved", f"{laid.framing} within its frame", view.agreeing, laid.score)
    # Parts that are still where they were rendered were left out by a hand.
    made, inside = warped(view.render, inverse_map(laid.matrix)[:2], view.alpha.shape[::-1])
    predicted = inside & view.solid & (mean_difference(made, view.render) > COPIES.min_predicted)
    if predicted.any() and view.unchanged[predicted].mean() > MISTAKES.max_left_behind:
        return None
    # A glow along a plain asset's outline lies as a move would have it, but has no colours of the render.
    differs = inside & (mean_difference(view.picture, view.render) > COPIES.max_difference)
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    if agrees[differs].mean() < MISTAKES.min_moved_explained:
        return None
    return Explanation("moved", MOVED_WORDS, view.agreeing, laid.score)


def _of_other_axes(
    view: SmallView, with_other_axes: Callable[[Size], Iterable[tuple[str, np.ndarray]]] | None
) -> Explanation | None:
    if with_other_axes is None:
        return None
    height, width = view.alpha.shape
    for words, other in with_other_axes((width, height)):
        explanation = explained_by(Mistake("axes", words, lambda colors: colors), other.astype(np.float32), view)
        if explanation is not None:
            return explanation
    return None


def _posterised(picture: np.ndarray, view: SmallView) -> Explanation | None:
    colors = few_colors(picture)
    solid = view.solid
    if colors is None or len(colors) > MISTAKES.max_posterised or not solid.any():
        return None
    if view.picture[solid].std(0).mean() < MISTAKES.min_tone_contrast * view.render[solid].std(0).mean():
        return None
    return Explanation("filter", f"posterised: it has {len(colors)} colours", view.agreeing, 0.0)


def _something_else(view: SmallView) -> Explanation | None:
    # Same outline, nothing agrees: painted over everywhere, if anything.
    if view.bare.mean() >= COPIES.min_bare_share and not view.has_other_outline:
        return Explanation("look", PAINTED_OVER_WORDS, view.agreeing, 0.0)
    if view.bare.mean() < COPIES.min_bare_share and view.agreeing > MISTAKES.max_agreeing_full:
        return None
    words = "of another asset, another view or another camera"
    return Explanation("other", words, view.agreeing, 0.0)
