"""Small copies of a picture and of its view, and whether a mistake explains the one by the other.

Compression averages out in a small copy, and thirty mistakes can be tried on one in no time. Pure. H, W: pixels of the
view; h, w: of its small copy; colours are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

from splatpainter.lift.masks import box_mean, dilated, largest_channel
from splatpainter.order_statistics import median
from splatpainter.pictures.picture_reader import resample
from splatpainter.system.quick_dataclass import dataclass

Cause = Literal[
    "turned", "colors", "tone", "shade", "look", "filter", "detail", "moved", "border", "strip", "axes", "other"
]
"""turned: mirrored or turned round; colors: other colours than sRGB; tone: graded as a whole, its background too or
not; shade: darkened or lightened from the middle outwards or from side to side; look: one colour laid over all of the
asset, or all of it painted over, which may well be meant; filter: blurred or smoothed all over; detail: sharpened all
over, or with detail added, which may well be meant; moved: shifted or scaled; border: one colour all along its rim,
over parts of the asset; strip: the same along one side, where it may be meant; axes: the asset's axes are read another
way; other: another asset, view or camera."""
Change: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""[H, W, 3] -> [H, W, 3] (turns may exchange H and W), colours 0..1."""
Size: TypeAlias = tuple[int, int]
"""(width, height)."""


@dataclass(frozen=True)
class CopyThresholds:
    """When two small copies agree, and when a mistake explains a picture. In display values, pixels of small copies.
    Measured where an entry says on what, else taste."""

    small_px: int = 160
    """Pixels of the longer side of the small copies: noise of compression averages out."""
    max_difference: float = 4.5 / 255
    """Mean difference over 3 x 3 pixels of small copies up to which they agree."""
    min_predicted: float = 7 / 255
    """Difference to the render from which a mistake says that a pixel changed."""
    max_unchanged: float = 2.5 / 255
    """Difference up to which a pixel is as it was rendered, and no mistake changed it."""
    min_predicted_share: float = 0.08
    """Share of what the picture and the view show that a mistake must change to be told at all."""
    min_explained: float = 0.5
    """Share of what a mistake changes that must be as it makes it: the rest may be painted over. On eighteen views of
    six captures: mistakes 0.77 to 1.00, recoloured by hand over 70 % 0.52 to 0.93; those have more than
    max_contradicting."""
    min_explained_tones: float = 0.2
    """The same of a mistake that changes every colour by one known curve (linear light), where what is as it makes it
    has many tones and nothing is as it was rendered: no paint follows a curve through them. The rest is painted
    over."""
    min_tones: float = 0.15
    """Range of the rendered values of what is as such a mistake makes it, between the middle four fifths: other curves,
    and glazes, cross it within 0.05."""
    max_contradicting_tones: float = 0.002
    """Share of what such a mistake changes that may be as it was rendered."""
    max_contradicting: float = 0.015
    """Share of what a mistake changes that may be as it was rendered. Mistakes have none of it; colours changed by hand
    over 85 % 0.03 and more."""
    min_reach: float = 0.5
    """Share of the asset that a mistake which spares something changes from which it is refused, and not only remarked:
    of a grey asset only the coloured parts become grey, as a brush makes them, too."""
    min_visible: float = 2.5 / 255
    """Change from which a pixel tells a mistake that is met exactly."""
    max_error: float = 1.5 / 255
    """How near the picture is to what such a mistake makes."""
    error_share: float = 0.1
    """The same in parts of the change; the larger of both counts."""
    min_near: float = 0.7
    """Share of what it changes that must be as near: the rest may be painted over."""
    max_same: float = 0.75 / 255
    """Difference up to which nothing happened to a pixel."""
    min_uniform: float = 0.7
    """Share of the bare background that a mistake must either change or leave alone: of what is painted there, soft
    brushes reach a part."""
    min_changed: float = 0.9
    """Share of the bare background that differs from which all of it was changed: a brush or a fill leaves a part."""
    max_stray: float = 0.02
    """Share of the bare background that differs up to which all paint lies on the asset: it may be all painted over."""
    min_bare_share: float = 0.03
    """Share of a picture that must be bare background to say that."""
    max_outline_unchanged: float = 0.5
    """Share of the pixels of the asset's outline that may be as they were rendered where it was moved. A shift to one
    side leaves the parts that run along it."""
    max_erased: float = 0.05
    """Share of the asset where a picture may show nothing but the background."""
    min_cover: float = 0.5
    """Alpha from which a pixel of a small copy shows the asset."""
    max_bare: float = 0.02
    """Alpha up to which it shows none of it."""
    rim_px: int = 2
    """Pixels of a small copy beside the asset that are not bare background."""


COPIES = CopyThresholds()


@dataclass(frozen=True)
class Mistake:
    """Something that changes all of a picture."""

    cause: Cause
    words: str
    """What it says of the picture: "the picture is ..."."""
    made: Change
    """What it makes of a render."""
    undone: Change | None = None
    """What takes it back in a picture; None: it cannot be."""
    spares: Literal["nothing", "grey", "middle", "background"] = "nothing"
    """What it leaves as it was. Much of an asset may be grey, or in the middle of the picture."""


@dataclass(frozen=True)
class Explanation:
    """Why a picture differs from its view nearly everywhere."""

    cause: Cause
    words: str
    agreeing: float
    """Share of what the picture and the view show that agrees as it is, 0..1."""
    agreeing_after: float
    """Share that agrees with what the mistake makes of the view, 0..1; 0 where none explains the picture."""
    mistake: Mistake | None = None
    reach: float = 1.0
    """Share of the asset that the mistake changed, 0..1."""

    @property
    def may_be_meant(self) -> bool:
        """Whether it is only remarked: all of the asset was painted on purpose, or much of it is left as it was."""
        spares = "nothing" if self.mistake is None else self.mistake.spares
        partial = spares != "nothing" and (spares == "background" or self.reach < COPIES.min_reach)
        return self.cause in ("look", "detail", "strip") or partial

    @property
    def is_grade(self) -> bool:
        """Whether it changed colours all over, as a look of the whole asset does."""
        return self.cause in ("colors", "tone", "shade")


@dataclass(frozen=True)
class SmallView:
    """Small copies [h, w] of a picture and its view."""

    picture: np.ndarray
    render: np.ndarray
    alpha: np.ndarray
    compared: np.ndarray
    """[h, w] bool: where the view shows the asset, or the picture something else than the view's background."""
    unchanged: np.ndarray
    """[h, w] bool: as it was rendered."""
    agreeing: float
    """Share of `compared` that agrees."""

    @staticmethod
    def of(picture: np.ndarray, render: np.ndarray, alpha: np.ndarray) -> SmallView:
        seen, before, cover = (small_copy(values) for values in (picture, render, alpha))
        differences = mean_difference(seen, before)
        agrees = differences <= COPIES.max_difference
        compared = (cover > COPIES.min_cover) | ~agrees
        agreeing = float(agrees[compared].mean()) if compared.any() else 1.0
        return SmallView(seen, before, cover, compared, differences <= COPIES.max_unchanged, agreeing)

    @property
    def solid(self) -> np.ndarray:
        """[h, w] bool: where the view shows the asset."""
        return self.alpha > COPIES.min_cover

    @property
    def bare(self) -> np.ndarray:
        """[h, w] bool: background, not beside the asset."""
        return ~dilated(self.alpha > COPIES.max_bare, COPIES.rim_px)

    @property
    def stray(self) -> float:
        """Share of the bare background that differs, 0..1; 1 where there is too little of it to say."""
        bare = self.bare
        if bare.mean() < COPIES.min_bare_share:
            return 1.0
        return float((mean_difference(self.picture, self.render) > COPIES.max_difference)[bare].mean())

    @property
    def paint_is_on_asset(self) -> bool:
        """Whether the background is as it was rendered, where there is enough of it to say."""
        return self.stray <= COPIES.max_stray

    @property
    def background_change(self) -> float:
        """By how much most of the bare background changed, display values; 0 where there is none."""
        change = (self.picture - self.render)[self.bare]
        return float(np.abs(median(change)).max()) if len(change) else 0.0

    @property
    def background_changed(self) -> bool:
        """Whether the same happened to nearly all of the bare background: paint covers a part of it."""
        has_background = self.bare.mean() >= COPIES.min_bare_share
        return bool(has_background and self.stray >= COPIES.min_changed and self.background_is_uniform)

    @property
    def background_is_uniform(self) -> bool:
        """Whether the same happened to most of the bare background."""
        change = (self.picture - self.render)[self.bare]
        if not len(change):
            return True
        near = largest_channel(np.abs(change - median(change))) <= COPIES.max_unchanged
        return bool(near.mean() >= COPIES.min_uniform)

    @property
    def outline_is_elsewhere(self) -> bool:
        """Whether most of the asset's outline is not as it was rendered, where it can be seen against the
        background."""
        if self.bare.mean() < COPIES.min_bare_share:
            return False
        outline = dilated(self.solid, 1) & dilated(~self.solid, 1)
        return bool(outline.any() and self.unchanged[outline].mean() < COPIES.max_outline_unchanged)

    @property
    def has_other_outline(self) -> bool:
        """Whether the picture shows its background where the asset is, or something else beside it: paint does
        neither."""
        bare = self.bare
        if bare.mean() < COPIES.min_bare_share:
            return False
        # The render's bare pixels say what the background is, whatever colour it has.
        background = median(self.render[bare])
        solid = self.solid
        empty, before = (
            largest_channel(np.abs(image - background)) <= COPIES.max_unchanged for image in (self.picture, self.render)
        )
        erased = (empty & ~before & solid).sum() > COPIES.max_erased * max(int(solid.sum()), 1)
        return bool(erased or not self.paint_is_on_asset)


def visible_after(undone: Change, shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] bool: where a picture [H, W, 3] shows something after a move of it was taken back. What lies beyond its
    rim repeats that, which a dark rim on white tells."""
    framed = np.zeros(shape, np.float32)
    framed[1:-1, 1:-1] = 1
    return np.asarray(undone(framed)).min(-1) > 0.99


def small_copy(values: np.ndarray) -> np.ndarray:
    """[h, w(, C)] of [H, W(, C)], cut to 0..1."""
    height, width = values.shape[:2]
    shrink = max(max(height, width) / COPIES.small_px, 1.0)
    size = max(round(width / shrink), 1), max(round(height / shrink), 1)
    clipped = values
    # Most values lie in 0..1 already, and a copy of a large picture costs more than to ask; NaN fails both comparisons.
    if values.dtype != np.float32 or not (values.min(initial=0) >= 0 and values.max(initial=0) <= 1):
        clipped = np.clip(values, 0, 1).astype(np.float32)
        clipped[np.isnan(clipped)] = 0
    return clipped if size == (width, height) else resample(clipped, *size)


def mean_difference(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[H, W] how far two pictures [H, W, 3] are apart over 3 x 3 pixels, in the channel that differs most."""
    means = box_mean(one - other, 1)
    return largest_channel(np.abs(means, out=means))


def explained_by(mistake: Mistake, made: np.ndarray, view: SmallView) -> Explanation | None:
    """The mistake as an explanation of the picture; None where it is none. made: [h, w, 3] what it makes of the
    view."""
    # Only pixels that the mistake would have changed can tell whether it was made.
    predicted = view.compared & (mean_difference(made, view.render) > COPIES.min_predicted)
    if predicted.sum() < COPIES.min_predicted_share * view.compared.sum():
        return None
    # A mistake changes everything: pixels that are as they were rendered speak against it. The likeliest answer, as
    # most pictures were painted on, so it is asked first.
    contradicting = float(view.unchanged[predicted].mean())
    if contradicting > COPIES.max_contradicting:
        return None
    agrees = mean_difference(view.picture, made) <= COPIES.max_difference
    explained = float(agrees[predicted].mean())
    through_tones = explained >= COPIES.min_explained_tones and contradicting <= COPIES.max_contradicting_tones
    if explained < COPIES.min_explained and not (through_tones and _is_one_curve(mistake, view, predicted & agrees)):
        return None
    # What changes colours changes all of the background or nothing of it; a large brush reaches a part.
    bare = view.bare & (mean_difference(made, view.render) > COPIES.min_predicted)
    solid = view.solid
    reach = float(predicted[solid].mean()) if solid.any() else 1.0
    if mistake.cause in ("colors", "shade") and bare.any():
        changed = float(agrees[bare].mean())
        if max(changed, float(view.unchanged[bare].mean())) < COPIES.min_uniform:
            return None
        # All of the picture went through it, however grey the asset is.
        if mistake.cause == "colors" and changed >= COPIES.min_uniform and view.background_changed:
            reach = 1.0
    if mistake.spares != "nothing":
        reach = max(reach, exact_reach(made, view))
    return Explanation(mistake.cause, mistake.words, view.agreeing, float(agrees[view.compared].mean()), mistake, reach)


def exact_reach(made: np.ndarray, view: SmallView) -> float:
    """Share of the asset that a mistake changed, 0..1, by however little, where nearly all of that is just as it makes
    it: [h, w, 3], to a level or so. A hand that recolours the coloured parts leaves the nearly grey ones; 0 there."""
    change = mean_difference(made, view.render)
    near = mean_difference(view.picture, made) <= np.maximum(COPIES.max_error, COPIES.error_share * change)
    visible = view.solid & (change > COPIES.min_visible)
    if not visible.any() or near[visible].mean() < COPIES.min_near:
        return 0.0
    same = mean_difference(view.picture, view.render) <= COPIES.max_same
    return float(visible.sum() / view.solid.sum()) if same[visible].mean() <= COPIES.max_contradicting else 0.0


def _is_one_curve(mistake: Mistake, view: SmallView, explained: np.ndarray) -> bool:
    """Whether a mistake puts all values through one known curve, and what it explains, [h, w] bool, has many of
    them."""
    rendered = view.render[explained & view.solid].mean(-1)
    if mistake.cause != "colors" or mistake.spares != "nothing" or not len(rendered):
        return False
    low, high = np.quantile(rendered, (0.1, 0.9))
    return bool(high - low >= COPIES.min_tones)
