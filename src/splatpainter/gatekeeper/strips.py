"""Strips along a picture's sides that the usual border (gatekeeper/borders.py) is not made of: in the background's
colour, or along one side alone (a caption, a bar of tasks, a film's lower bar, the edge of a scan).

Either is like paint, so more is asked of it: full lines, a straight edge beyond which the asset is as it was rendered,
and a colour that is no pigment. What a hand could have done all the same is only remarked, and painted. Pure. H, W:
pixels of the view; colours are display sRGB 0..1.
"""

from __future__ import annotations

import numpy as np

from splatpainter.gatekeeper.small_copies import COPIES
from splatpainter.lift.masks import largest_channel
from splatpainter.order_statistics import median
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class StripThresholds:
    """What is taken for a strip. Display values, pixels of the view; source: taste."""

    max_noise: float = 8 / 255
    """Difference from its colour, and beyond it from the render, that a scanner or compression leaves."""
    min_line: float = 0.95
    """Share of a row or column that must have the colour."""
    min_written_line: float = 0.4
    """The same between the first and the last one, where words or icons may stand."""
    max_chroma: float = 14 / 255
    """Range of the channels of a colour up to which it is no pigment: paper, black, a program's grey."""
    max_black: float = 16 / 255
    """Distance from black, or white, up to which a strip is a film's or a scan's."""
    max_side: float = 0.4
    """Width of a strip, parts of the picture's: more is a fill."""
    rim_px: int = 2
    """Pixels beside a strip that resampling blends with it."""
    beyond_px: int = 8
    """Reach beyond the rim within which the picture must be as it was rendered."""
    min_intact: float = 0.6
    """Share of the pixels there that is: a stroke may end, or begin, beside a strip."""
    min_hidden_px: int = 24
    """Pixels of the asset that a strip in the background's colour must hide, and that must show beyond it."""
    min_hidden: float = 0.95
    """Share of the asset's pixels within it that it must hide."""
    min_cut: float = 0.6
    """Share of the asset right beyond it that must go on within it."""
    max_uneven_px: int = 3
    """By how much the sides of a frame in the background's colour differ in width."""
    min_bare: float = 0.02
    """Share of a strip that lies on bare background from which nobody painted it: it changes nothing there."""
    max_within: float = 0.2
    """Share of the bare background within that may have the strip's colour: else it is a ground behind the asset."""


STRIPS = StripThresholds()


@dataclass(frozen=True)
class SideStrip:
    """One or more sides of one colour. H, W: pixels of the view."""

    outside: np.ndarray
    """[H, W] bool: its pixels."""
    is_certain: bool
    """Whether no hand painted it; else it may be meant."""


@dataclass(frozen=True)
class _SideView:
    """A picture and its render from one side inwards, [L, P, 3] and [L, P]."""

    picture: np.ndarray
    render: np.ndarray
    cover: np.ndarray


def strip_of(picture: np.ndarray, render: np.ndarray, cover: np.ndarray) -> SideStrip | None:
    """What lies along the sides of a picture [H, W, 3] that no border of two sides explains; None where nothing does.
    render: [H, W, 3]; cover: [H, W] alpha of the asset."""
    bare = cover <= COPIES.max_bare
    sides = _sides(picture, render, cover)
    if bare.any():
        background = np.asarray(median(render[bare]))
        widths = [_hiding_width(side, background) for side in sides]
        if any(widths):
            # One side alone, or two unlike, is what selections erase, too.
            hiding = [width for width in widths if width]
            is_even = len(hiding) > 1 and max(hiding) - min(hiding) <= STRIPS.max_uneven_px
            return SideStrip(_outside(widths, cover.shape), is_even)
    return _single(sides, picture, render, bare)


def _single(sides: list[_SideView], picture: np.ndarray, render: np.ndarray, bare: np.ndarray) -> SideStrip | None:
    """The strip along one side that has a colour which the render has not there."""
    colors = [_line_color(side) for side in sides]
    # Two sides are a border, or two bands that somebody laid.
    if sum(color is not None for color in colors) != 1:
        return None
    index = next(k for k, color in enumerate(colors) if color is not None)
    side, color = sides[index], colors[index]
    assert color is not None
    if color.max() - color.min() > STRIPS.max_chroma:
        return None
    width = _written_width(side, color)
    if not width or _intact_beyond(side, width).mean() < STRIPS.min_intact:
        return None
    outside = _outside([width if k == index else 0 for k in range(4)], bare.shape)
    within = bare & ~outside
    if within.any() and _has(picture[within], color).mean() > STRIPS.max_within:
        return None
    # A hand has a reason to paint: not black, not paper, nor words on grey, nor where nothing of the asset is.
    idle = bare & outside & ~_has(render, color)
    is_idle = idle.sum() >= STRIPS.min_bare * outside.sum()
    is_extreme = color.max() <= STRIPS.max_black or color.min() >= 1 - STRIPS.max_black
    intact = (largest_channel(np.abs(picture - render)) <= STRIPS.max_noise)[~outside].mean() >= STRIPS.min_intact
    return SideStrip(outside, bool(intact and (is_idle or is_extreme or _has_words(side, width, color))))


def _hiding_width(side: _SideView, background: np.ndarray) -> int:
    """How many lines from this side on have the background's colour where the render shows the asset; 0: none."""
    length = len(side.picture)
    of_asset = (side.cover > COPIES.min_cover).any(1)
    if not of_asset.any():
        return 0
    # Most pictures show their asset where it begins, which one line tells.
    first = min(int(np.argmax(of_asset)) + STRIPS.rim_px, length - 1)
    if not _is_line(side.picture[first], background):
        return 0
    width = _first_other(_has(side.picture, background).mean(1) >= STRIPS.min_line)
    if not 0 < width <= STRIPS.max_side * length or width + STRIPS.rim_px >= length:
        return 0
    asset = (side.cover[:width] > COPIES.min_cover) & ~_has(side.render[:width], background)
    hidden = _has(side.picture[:width], background)[asset]
    if len(hidden) < STRIPS.min_hidden_px or hidden.mean() < STRIPS.min_hidden:
        return 0
    # Cut straight through the asset: what stands right beyond begins within. A part that was erased up to where another
    # begins, as a handle is, ends there by itself.
    edge, first_beyond = (side.cover[line] > COPIES.min_cover for line in (width - 1, width + STRIPS.rim_px))
    if not first_beyond.any() or edge[first_beyond].mean() < STRIPS.min_cut:
        return 0
    beyond = side.cover[_beyond(width)] > COPIES.min_cover
    is_intact = beyond.sum() >= STRIPS.min_hidden_px and _intact_beyond(side, width)[beyond].mean() >= STRIPS.min_intact
    return width if is_intact else 0


def _intact_beyond(side: _SideView, width: int) -> np.ndarray:
    """[beyond_px, P] bool: what is as it was rendered right beyond a strip of that width."""
    beyond = _beyond(width)
    return largest_channel(np.abs(side.picture[beyond] - side.render[beyond])) <= STRIPS.max_noise


def _beyond(width: int) -> slice:
    return slice(width + STRIPS.rim_px, width + STRIPS.rim_px + STRIPS.beyond_px)


def _written_width(side: _SideView, color: np.ndarray) -> int:
    """How many lines a strip of a colour has, words and icons on it included; 0: none, or most of the picture."""
    share = _has(side.picture, color).mean(1)
    reach = _first_other(share >= STRIPS.min_written_line)
    ends = np.flatnonzero(share[:reach] >= STRIPS.min_line)
    width = int(ends[-1]) + 1 if len(ends) else 0
    # Lines that keep the colour but are not full are the soft rim of it, or a hand's uneven edge.
    uneven = reach - width > STRIPS.rim_px
    return 0 if uneven or width > STRIPS.max_side * len(share) or width + STRIPS.rim_px >= len(share) else width


def _has_words(side: _SideView, width: int, color: np.ndarray) -> bool:
    """Whether something stands on a strip of a colour: lines that are not full, between lines that are."""
    return bool((_has(side.picture[:width], color).mean(1) < STRIPS.min_line).any())


def _line_color(side: _SideView) -> np.ndarray | None:
    """[3] the one colour of the outermost line; None where it has others, or has that in its render, too."""
    color = np.asarray(median(side.picture[0]))
    return color if _is_line(side.picture[0], color) and not _is_line(side.render[0], color) else None


def _sides(picture: np.ndarray, render: np.ndarray, cover: np.ndarray) -> list[_SideView]:
    """From above, below, left and right."""
    across = [values.swapaxes(0, 1) for values in (picture, render, cover)]
    return [
        _SideView(picture, render, cover),
        _SideView(picture[::-1], render[::-1], cover[::-1]),
        _SideView(*across),
        _SideView(*(values[::-1] for values in across)),
    ]


def _outside(widths: list[int], shape: tuple[int, ...]) -> np.ndarray:
    """[H, W] bool: so many lines above, below, left and right."""
    above, below, left, right = widths
    height, width = shape
    outside = np.ones((height, width), bool)
    outside[above : height - below, left : width - right] = False
    return outside


def _has(colors: np.ndarray, color: np.ndarray) -> np.ndarray:
    """[...] bool: which of [..., 3] have a colour."""
    return largest_channel(np.abs(colors - color)) <= STRIPS.max_noise


def _is_line(line: np.ndarray, color: np.ndarray) -> bool:
    return bool(_has(line, color).mean() >= STRIPS.min_line)


def _first_other(lines: np.ndarray) -> int:
    """How many of [L] bool are true, from the first on."""
    return len(lines) if lines.all() else int(np.argmin(lines))
