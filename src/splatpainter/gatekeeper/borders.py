"""Borders around pictures: a scanner's white, a canvas that was made larger, a screenshot's frame, black bars of films.

A border covers whole rows and columns along the rim with one colour that the view has not there, on two sides at least.
A hand paints along one side, or leaves something of the view beside its stroke; a ground that a program laid behind the
whole asset (pictures/lost_transparency.py) goes on within. Strips along one side, or in the background's colour:
gatekeeper/strips.py. Pure. H, W: pixels of the view; colours are display sRGB 0..1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splatpainter.gatekeeper.fitted_mistakes import FITS
from splatpainter.gatekeeper.mistaken_pictures import intact_share
from splatpainter.gatekeeper.small_copies import COPIES, Cause, Explanation, mean_difference
from splatpainter.gatekeeper.strips import SideStrip, strip_of
from splatpainter.lift.masks import dilated, largest_channel
from splatpainter.order_statistics import median
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class PictureBorderThresholds:
    """What is taken for a border. Display values, pixels of the view; source: taste."""

    max_noise: float = 8 / 255
    """Difference from a side's colour that a scanner or compression leaves."""
    max_apart: float = 12 / 255
    """By how much sides of one border differ."""
    min_line: float = 0.95
    """Share of a row or column that must have the colour: a stroke may run over it."""
    min_other: float = 0.5
    """Share of a border that must be unlike its render: a background of the same colour is none."""
    max_side: float = 0.4
    """Width of a side, parts of the picture's: more is a fill. A square within 16:9 has 0.22."""
    max_within: float = 0.2
    """Share of the bare background within that may have the border's colour: else it is a ground behind the asset."""
    max_nested: int = 3
    """Borders within each other: a white one, a line, and one more."""
    rim_px: int = 2
    """Pixels beside a border that resampling blends with it."""
    max_bare: float = 1 / 512
    """Alpha up to which a pixel shows background alone."""


BORDERS = PictureBorderThresholds()
BORDER_WORDS = "framed by a border of one colour (of a scan, a larger canvas, a screenshot, a film)"
STRIP_WORDS = (
    "covered by a strip of one colour all along a side (of a caption, a film, a scan, a larger canvas); --correct "
    "leaves that out"
)
BORDER_NOTE = "its border of one colour is no paint"


@dataclass(frozen=True)
class FramedPicture:
    """A picture within its border. H, W: pixels of the view."""

    colors: np.ndarray
    """[H, W, 3], as it was rendered where the border lies."""
    window: tuple[slice, slice]
    """Rows and columns within the border and what may blend with it."""
    explanation: Explanation | None
    """Why it differs; cause "border" where that covers a part of the asset and nothing else is wrong, "strip" where a
    hand may have painted it."""
    is_certain: bool = True
    """Whether the border is none that a hand painted."""


def framed_picture(
    picture: np.ndarray,
    render: np.ndarray,
    cover: np.ndarray,
    explanation: Explanation | None,
    why: Callable[[np.ndarray], Explanation | None],
) -> FramedPicture | None:
    """What a border frames; None where a picture [H, W, 3] has none, or where it came with a move, as that of a larger
    canvas shown smaller, and is a part of it. render: [H, W, 3]; cover: [H, W] alpha of the asset; explanation: why the
    picture differs as it is; why: says that of one [H, W, 3] within a border."""
    around = border_or_strip(picture, render, cover)
    if around is None:
        return None
    border, is_certain = around.outside, around.is_certain
    covered = with_rim(border)
    framed = np.where(covered[..., None], render, picture)
    is_moved = explanation is not None and explanation.cause == "moved"
    if is_moved and intact_share(framed, render, cover) < FITS.max_intact:
        return None
    within = why(framed)
    if within is not None and within.cause in ("moved", "axes", "other"):
        return None
    solid = cover > COPIES.min_cover
    differs = solid & (mean_difference(picture, render) > COPIES.max_difference)
    if (differs & border).any() and (within is None or within.may_be_meant):
        cause: Cause = "border" if is_certain else "strip"
        words = BORDER_WORDS if is_certain else STRIP_WORDS
        within = Explanation(cause, words, 1 - float(differs[solid].mean()), 1.0)
    rows, columns = (np.flatnonzero(~covered.all(axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return FramedPicture(framed, window, within, is_certain)


def border_or_strip(picture: np.ndarray, render: np.ndarray, cover: np.ndarray) -> SideStrip | None:
    """What frames a picture [H, W, 3], or lies along one side of it; None where nothing does. As border_of."""
    border = border_of(picture, render, cover)
    return strip_of(picture, render, cover) if border is None else SideStrip(border, is_certain=True)


def border_of(picture: np.ndarray, render: np.ndarray, cover: np.ndarray) -> np.ndarray | None:
    """[H, W] bool: pixels of a border around a picture [H, W, 3]; None where it has none. render: [H, W, 3]; cover:
    [H, W] alpha of the asset. Up to `rim_px` beside it may blend with it."""
    height, width = cover.shape
    top, bottom, left, right = 0, height, 0, width
    for _ in range(BORDERS.max_nested):
        window = np.s_[top:bottom, left:right]
        widths = _widths(picture[window], render[window], cover[window])
        if widths is None:
            break
        top, bottom, left, right = top + widths[0], bottom - widths[1], left + widths[2], right - widths[3]
    if min(bottom - top, right - left) <= 2 * BORDERS.rim_px:  # nothing is left within
        return None
    if (top, bottom, left, right) == (0, height, 0, width):
        return None
    outside = np.ones(cover.shape, bool)
    outside[top:bottom, left:right] = False
    return outside


def with_rim(border: np.ndarray) -> np.ndarray:
    """[H, W] bool: a border and what may blend with it."""
    return dilated(border, BORDERS.rim_px)


def _widths(picture: np.ndarray, render: np.ndarray, cover: np.ndarray) -> tuple[int, int, int, int] | None:
    """Widths of the outermost border above, below, left and right; None where there is none."""
    lines, rendered = _sides(picture), _sides(render)
    # The outermost rows and columns alone say of most pictures that they have none.
    colors = [_color_of(side[:1], before[:1]) for side, before in zip(lines, rendered, strict=True)]
    candidates = [color for color in colors if color is not None]
    if len(candidates) < 2:
        return None
    # Sides of one colour belong together: of those, the most.
    alike = [[_apart(one, other) <= BORDERS.max_apart for other in candidates] for one in candidates]
    color = candidates[int(np.argmax([sum(row) for row in alike]))]
    widths = [
        0 if side_color is None or _apart(side_color, color) > BORDERS.max_apart else _width(side, side_color)
        for side, side_color in zip(lines, colors, strict=True)
    ]
    if sum(width > 0 for width in widths) < 2:
        return None
    if any(width > BORDERS.max_side * len(side) for width, side in zip(widths, lines, strict=True)):
        return None
    above, below, left, right = widths
    height, width = cover.shape
    outside = np.ones(cover.shape, bool)
    outside[above : height - below, left : width - right] = False
    other = largest_channel(np.abs(render - color)) > BORDERS.max_noise
    bare = ~outside & (cover <= BORDERS.max_bare)
    same = largest_channel(np.abs(picture - color)) <= BORDERS.max_noise
    if other[outside].mean() < BORDERS.min_other or (bare.any() and same[bare].mean() > BORDERS.max_within):
        return None
    return above, below, left, right


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).max())


def _sides(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """An image [H, W, 3] from above, below, left and right: lines from the rim inwards."""
    across = image.swapaxes(0, 1)
    return image, image[::-1], across, across[::-1]


def _color_of(line: np.ndarray, before: np.ndarray) -> np.ndarray | None:
    """[3] the one colour of a line [1, P, 3]; None where it has others, or has that in its render, too."""
    if not line.size:
        return None
    color = np.asarray(median(line[0]))
    return color if _has_color(line, color)[0] and not _has_color(before, color)[0] else None


def _has_color(rows: np.ndarray, color: np.ndarray) -> np.ndarray:
    """[R] bool: rows [R, P, 3] of that colour."""
    return (largest_channel(np.abs(rows - color)) <= BORDERS.max_noise).mean(1) >= BORDERS.min_line


def _width(side: np.ndarray, color: np.ndarray) -> int:
    """How many rows of [R, P, 3] have the colour, from the first on."""
    rows = _has_color(side, color)
    return len(rows) if rows.all() else int(np.argmin(rows))
