"""Where text goes in a plot, so that labels overlap neither each other nor, where it can be helped, what is drawn.

Boxes are (left, top, right, bottom) in pixels, y downwards. Knows no SVG.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence

Box = tuple[float, float, float, float]
Point = tuple[float, float]

_WIDTHS = {0.28: "ijl|'.,:;!I", 0.36: 'ftr()[]/\\- "*', 0.86: "mM%@&", 0.96: "W", 0.76: "wCDGHNOQRU"}
_WIDTH = {letter: width for width, letters in _WIDTHS.items() for letter in letters}
"""Em; about those of Helvetica and of what systems have in its place."""
SAFETY = 1.08
STRUCK, LATER = 40.0, 3.0
"""What a label pays for each line through it, and for every anchor that it does not take, in pixels of distance."""
ROOM = 1.5
"""Pixels that lines keep away from labels."""


def text_width(text: str, size: float) -> float:
    """Pixels that text of `size` pixels takes in a sans serif, a little too much rather than too little."""
    return SAFETY * size * sum(_em(letter) for letter in text)


def shortened(text: str, size: float, most: float) -> str:
    """The text, or its beginning and an ellipsis, within `most` pixels."""
    if text_width(text, size) <= most:
        return text
    while text and text_width(text + "…", size) > most:
        text = text[:-1]
    return text.rstrip() + "…"


def wrapped(text: str, size: float, most: float, lines: int = 2) -> list[str]:
    """The text in at most so many lines of `most` pixels; what does not fit is cut off the last."""
    out, words = [""], text.split()
    for k, word in enumerate(words):
        longer = f"{out[-1]} {word}".strip()
        if text_width(longer, size) > most and out[-1]:
            if len(out) == lines:
                out[-1] = " ".join([out[-1], *words[k:]])
                break
            longer = word
            out.append("")
        out[-1] = longer
    return [shortened(line, size, most) for line in out]


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Places within low..high, at least `gap` apart and in the order of `wanted`, whose squared distances to the wanted
    ones are least: bounded isotonic regression by pooling adjacent violators (Ayer et al. 1955).

    Raises ValueError where they do not fit.
    """
    count = len(wanted)
    if (count - 1) * gap > high - low + 1e-9:
        raise ValueError(f"labels: {count} of {gap:g} pixels do not fit into {high - low:g}")
    order = sorted(range(count), key=lambda k: wanted[k])
    pools: list[tuple[float, int]] = []  # (sum, count) of wanted - rank * gap
    for rank, k in enumerate(order):
        total, size = wanted[k] - rank * gap, 1
        while pools and pools[-1][0] / pools[-1][1] >= total / size:
            total, size = total + pools[-1][0], size + pools[-1][1]
            pools.pop()
        pools.append((total, size))
    level = [total / size for total, size in pools for _ in range(size)]
    places = [0.0] * count
    for rank, k in enumerate(order):
        places[k] = min(max(level[rank], low), high - (count - 1) * gap) + rank * gap
    return places


def place(
    anchors: Sequence[Sequence[Point]],
    sizes: Sequence[Point],
    frame: Box,
    marks: Sequence[Box] = (),
    lines: Sequence[tuple[Point, Point]] = (),
    clear: float = 7.0,
) -> list[Box | None]:
    """A box for each label of sizes (width, height) near one of its anchors, the first by preference, inside the frame
    and clear of all other labels; those that fit nowhere get None. Marks and lines are avoided where there is another
    place not much farther.

    Greedy, in the given order: each takes the cheapest of rings of places around its anchors. clear: pixels between
    anchor and the nearest place.
    """
    taken: list[Box] = []
    found: list[Box | None] = []
    lines = list(lines)
    for spots, (width, height) in zip(anchors, sizes, strict=True):
        best, price, start = None, math.inf, spots[0]
        for rank, (x, y) in enumerate(spots):
            others = [mark for mark in marks if not (mark[0] <= x <= mark[2] and mark[1] <= y <= mark[3])]
            for ring in range(14):
                least = rank * LATER + ring * 9.0
                if least >= price:  # farther ones only cost more
                    break
                for box in _around(x, y, width, height, clear + ring * 9.0, frame):
                    if not _inside(box, frame) or any(overlap(box, other, 1.0) for other in taken):
                        continue
                    cost = least + 60.0 * sum(overlap(box, mark, 1.0) for mark in marks)
                    cost += STRUCK * sum(_crosses(_grown(box), *line) for line in lines)
                    if ring:  # far enough for a leader, which is to cross little
                        leader = (x, y), nearest((x, y), box)
                        cost += 14.0 * sum(_crosses(b, *leader) for b in (*others, *taken))
                    if cost < price - 1e-9:
                        best, price, start = box, cost, (x, y)
        found.append(best)
        if best is not None:
            taken.append(best)
            lines.append((start, nearest(start, best)))
    return found


def nearest(point: Point, box: Box) -> Point:
    """The point of a box that is nearest to a point."""
    return min(max(point[0], box[0]), box[2]), min(max(point[1], box[1]), box[3])


def overlap(a: Box, b: Box, room: float = 0.0) -> bool:
    """Whether boxes share an area, or are nearer than `room` pixels."""
    return a[0] < b[2] + room and b[0] < a[2] + room and a[1] < b[3] + room and b[1] < a[3] + room


def _around(x: float, y: float, width: float, height: float, reach: float, frame: Box) -> list[Box]:
    """Right, left, between, and above and below (there moved sideways into the frame), at `reach` pixels."""
    slant, half = reach * 0.75, height / 2
    middle = min(max(x - width / 2, frame[0]), frame[2] - width)
    corners = [
        (x + reach, y - half),
        (x - reach - width, y - half),
        (x + slant, y - slant - half),
        (x + slant, y + slant - half),
        (x - slant - width, y - slant - half),
        (x - slant - width, y + slant - half),
        (middle, y - reach - height + 1),
        (middle, y + reach - 1),
    ]
    return [(left, top, left + width, top + height) for left, top in corners]


def _grown(box: Box) -> Box:
    return box[0] - ROOM, box[1] - ROOM, box[2] + ROOM, box[3] + ROOM


def _inside(box: Box, frame: Box) -> bool:
    return box[0] >= frame[0] and box[1] >= frame[1] and box[2] <= frame[2] and box[3] <= frame[3]


def _crosses(box: Box, a: Point, b: Point) -> bool:
    """Whether the segment a..b touches the box (Liang and Barsky 1984)."""
    first, last = 0.0, 1.0
    for axis in (0, 1):
        step = b[axis] - a[axis]
        low, high = box[axis] - a[axis], box[axis + 2] - a[axis]
        if abs(step) < 1e-12:
            if low > 0 or high < 0:
                return False
            continue
        near, far = sorted((low / step, high / step))
        first, last = max(first, near), min(last, far)
    return first <= last


def _em(letter: str) -> float:
    if unicodedata.east_asian_width(letter) in "WF":
        return 1.0
    if letter in _WIDTH:
        return _WIDTH[letter]
    return 0.68 if letter.isupper() else 0.56
