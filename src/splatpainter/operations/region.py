"""Which Gaussians a look changes, said in words: `--where hue=340..20 y=..0.5 or sphere=0,0,0,1`.

Terms that stand beside each other all have to hold, `or` between them begins another group, and `not:` before a term
turns it round. Ranges A..B have an end or both; numbers are world units as `splatpainter info` prints them.

    hue=A..B           of the base colour, degrees: 0 red, 120 green, 240 blue; 340..20 goes through 0; greys have none
    saturation=A..B    0 grey .. 1; of HSV
    lightness=A..B     0..1, luma
    color=#RRGGBB~D    colours within D (default 0.1) of this one in OKLab
    x=A..B y= z=       centres
    box=X,Y,Z,X,Y,Z    centres between two corners
    sphere=X,Y,Z,R     centres within R of a point
    opacity=A..B       peak alpha
    size=A..B          standard deviation along the longest axis
    mask=M.png@CAM.json  those that show mostly inside a mask drawn on a view, as a selection in the studio; without
                       @CAM.json the picture carries its camera
    selection=NAME@P.splatproj  what the studio keeps under that name in a project of the same asset
    layer=NAME@P.splatproj  what a visible layer of such a project paints

Terms of colour fade out beyond their ends (FADE), so that shades do not tear; the others are sharp.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import field
from pathlib import Path

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.cameras import Camera
from splatpainter.color import from_hex, luminance, oklab
from splatpainter.grading.color_match import display_colors
from splatpainter.image_files import find_camera
from splatpainter.kernels import portable
from splatpainter.operations.session_files import Weigh, session_files
from splatpainter.pictures.edit_files import camera_from
from splatpainter.pictures.picture_reader import EMPTY_MASK, read_mask, resample
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MAX_TERMS = 64
TERM_BREAK = re.compile(r"\s+(?=or\s|(?:not:)?\w+=)|(?<=\bor)\s+")
"""What stands between the terms of one text; names of selections may hold blanks."""
FADE = {"hue": 15.0, "saturation": 0.05, "lightness": 0.05}
"""How far each fades beyond the ends of a range, in its unit."""
DEFAULT_DISTANCE = 0.1
"""Distance in OKLab; black and white are 1 apart."""
COLOR_FADE = 0.5
"""Share of a colour's distance over which it fades, beyond it."""
MIN_CHROMA = 0.05
"""Display units between the largest and the smallest channel: what has less is nearly grey, and has a hue by chance."""
OF_FILES = ("mask", "selection", "layer")
"""Terms that name files."""
TermReader = Callable[[str, str], Weigh]


@dataclass(frozen=True)
class MaskOnView:
    """A term: what shows mostly inside a mask that was drawn on a view."""

    camera: Camera
    """In the world."""
    mask: np.ndarray
    """[H, W] bool, of the camera's size."""

    def __call__(self, splats: Splats) -> Floats:
        from splatpainter.lift.masked_gaussians import reached_gaussians

        # By what shows inside the mask, as the studio selects, and not by where centres lie.
        return reached_gaussians(splats, [(self.camera.relative_to(splats.offset), self.mask)]).astype(np.float32)


@dataclass(frozen=True)
class Region:
    """Some Gaussians, by what they are: an `or` of groups of terms that all have to hold."""

    text: str
    """The words that it was read from."""
    groups: tuple[tuple[Weigh, ...], ...] = field(repr=False, default=())

    @staticmethod
    def parse(words: Sequence[str]) -> Region:
        """Raises ValueError naming the term: unknown, numbers that are none, a mask that cannot be read."""
        # Bounded: each term is a pass over all Gaussians.
        terms = _terms(words)
        if not terms or len(terms) > MAX_TERMS:
            raise ValueError(f"--where: expected 1 to {MAX_TERMS} terms, got {len(terms)}")
        groups: list[list[Weigh]] = [[]]
        for term in terms:
            if term == "or":
                groups.append([])
            else:
                groups[-1].append(_term(term))
        if not all(groups):
            raise ValueError("--where: expected a term on both sides of or")
        return Region(" ".join(terms), tuple(map(tuple, groups)))

    def weights(self, splats: Splats) -> Floats:
        """[N] float32 0..1: how much of each Gaussian belongs to the region; 0 for what cannot be drawn. Raises
        ValueError: it reaches none."""
        out = np.zeros(len(splats), np.float32)
        # Fuzzy logic: `or` is the largest weight, `and` the smallest, `not` the rest.
        for group in self.groups:
            out = np.maximum(out, np.minimum.reduce([term(splats) for term in group]))
        # What cannot be drawn cannot be meant; and a region of nothing is a mistake in its words.
        out[~splats.drawable] = 0
        if not out.any():
            raise ValueError(f"--where {self.text}: reaches none of {len(splats)} Gaussians; widen it")
        return out

    def beside(self, splats: Splats) -> Bools | None:
        """[N] bool: Gaussians that are drawn beside the mask of which the region is all there is; None: it is other
        than one mask."""
        from splatpainter.rendering.pixel_shares import beside_mask

        terms = [term for group in self.groups for term in group]
        if len(terms) != 1 or not isinstance(terms[0], MaskOnView):
            return None
        return beside_mask(splats, terms[0].camera.relative_to(splats.offset), terms[0].mask.astype(np.float32))


def check_terms(words: Sequence[str]) -> None:
    """Raises ValueError as `Region.parse`, where that needs no file; terms that hold {asset} or {variant} pass."""
    for term in _terms(words):
        # Placeholders of batches ({asset}, {variant}) get their values later, and files are not read here.
        if term != "or" and "{" not in term:
            name, value, _ = _split(term)
            if name not in OF_FILES:
                _TERMS[name](name, value)


def files_of_terms(words: Sequence[str]) -> tuple[Path, ...]:
    """The files that terms name. Terms that are none are left to `check_terms`."""
    out: list[Path] = []
    for term in _terms(words):
        name, _, value = term.removeprefix("not:").partition("=")
        if name == "mask":
            out += [Path(part) for part in value.split("@") if part]
        elif name in OF_FILES and "@" in value:
            out.append(Path(value.rpartition("@")[2]))
    return tuple(out)


def _terms(words: Sequence[str]) -> list[str]:
    return [term for word in words for term in TERM_BREAK.split(word.strip())] if len(words) == 1 else list(words)


def _split(text: str) -> tuple[str, str, bool]:
    """(name, value, whether it is turned round)."""
    # The name is looked at before the value, so that a misspelt one is answered with those that exist.
    inverted = text.startswith("not:")
    name, equals, value = text.removeprefix("not:").partition("=")
    if name not in _TERMS or not equals or not value:
        raise ValueError(f"--where: expected NAME=VALUE with one of {', '.join(_TERMS)}, got {ascii(text[:60])}")
    return name, value, inverted


def _term(text: str) -> Weigh:
    name, value, inverted = _split(text)
    weigh = _TERMS[name](name, value)
    return (lambda splats: 1 - weigh(splats)) if inverted else weigh


def _range(name: str, text: str) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    # One end may be open, but a range without any says nothing.
    if not dots or not (low or high):
        raise wrong_term(name, "A..B, ..B or A..", text)
    start = _number(name, low) if low else -math.inf
    end = _number(name, high) if high else math.inf
    # Only hues go round: 340..20 is a range through red.
    if start > end and name != "hue":
        raise wrong_term(name, "a range from its lower to its higher end", text)
    return start, end


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        # NaN and infinity are numbers to Python and would quietly select nothing or all.
        value = math.nan
    if not math.isfinite(value):
        raise wrong_term(name, "a number", text)
    return value


def _vector(name: str, text: str, count: int) -> np.ndarray:
    parts = text.split(",")
    if len(parts) != count:
        raise wrong_term(name, f"{count} numbers with commas between", text)
    return np.array([_number(name, part) for part in parts])


def wrong_term(name: str, expected: str, text: str) -> ValueError:
    """What a term says of a value that it cannot read."""
    return ValueError(f"--where {name}: expected {expected}, got {ascii(text[:60])}")


def _faded(beyond: np.ndarray, fade: float) -> np.ndarray:
    """1 where a value lies inside its range (beyond <= 0), 0 from `fade` beyond it on, a raised cosine between."""
    return (0.5 + 0.5 * portable.cos(np.pi * np.clip(beyond / fade, 0, 1))).astype(np.float32)


def _hue(name: str, text: str) -> Weigh:
    start, end = _range(name, text)
    if math.isinf(start) or math.isinf(end):
        raise wrong_term(name, "A..B, two angles", text)
    # An angle from start to end the positive way, so that ranges through 0 need no special case.
    width = (end - start) % 360 if end - start < 360 else 360.0
    middle = start + width / 2

    def weigh(splats: Splats) -> np.ndarray:
        colors = display_colors(splats)
        high, low = colors.max(1), colors.min(1)
        chroma = high - low
        # The shorter way round the circle. What is nearly grey has a hue by chance, and counts less.
        distance = np.abs((hues(colors) - middle + 180) % 360 - 180)
        return _faded(distance - width / 2, FADE[name]) * np.minimum(chroma / np.float32(MIN_CHROMA), 1)

    return weigh


def hues(colors: np.ndarray) -> np.ndarray:
    """[N] degrees 0..360 of display colours [N, 3] as the hexagon of HSV has them; 0 of greys."""
    red, green, blue = colors.T.astype(np.float64)
    high, low = colors.max(1), colors.min(1)
    # Greys have no chroma to divide by; their sextant is 0 in any case.
    chroma = np.where(high > low, high - low, 1)
    sextant = np.select(
        [high == red, high == green],
        [(green - blue) / chroma % 6, (blue - red) / chroma + 2],
        (red - green) / chroma + 4,
    )
    return 60 * sextant


def _color_range(name: str, text: str) -> Weigh:
    low, high = _range(name, text)

    def weigh(splats: Splats) -> np.ndarray:
        colors = display_colors(splats)
        if name == "lightness":
            value = luminance(colors)
        else:
            value = 1 - colors.min(1) / np.maximum(colors.max(1), 1e-6)
        return _faded(np.maximum(low - value, value - high), FADE[name])

    return weigh


def _color(name: str, text: str) -> Weigh:
    code, tilde, distance_text = text.partition("~")
    color = from_hex(code)
    if color is None:
        raise wrong_term(name, "#RRGGBB or #RRGGBB~DISTANCE", text)
    # Around one colour, in a space where equal distances look about equal.
    limit = _number(name, distance_text) if tilde else DEFAULT_DISTANCE
    if limit <= 0:
        raise wrong_term(name, "a distance above 0", text)
    target = oklab(np.array([color]))

    def weigh(splats: Splats) -> np.ndarray:
        distance = np.linalg.norm(oklab(display_colors(splats)) - target, axis=1)
        return _faded(distance - limit, COLOR_FADE * limit)

    return weigh


def _attribute(name: str, text: str) -> Weigh:
    low, high = _range(name, text)

    def weigh(splats: Splats) -> np.ndarray:
        if name == "opacity":
            value = splats.opacities
        else:
            # World coordinates, as `splatpainter info` prints them, whatever offset the file keeps apart.
            value = splats.scales.max(1) if name == "size" else splats.world_means[:, "xyz".index(name)]
        return ((value >= low) & (value <= high)).astype(np.float32)

    return weigh


def _box(name: str, text: str) -> Weigh:
    corners = _vector(name, text, 6).reshape(2, 3)
    low, high = corners.min(0), corners.max(0)
    return lambda splats: ((splats.world_means >= low) & (splats.world_means <= high)).all(1).astype(np.float32)


def _sphere(name: str, text: str) -> Weigh:
    *center, radius = _vector(name, text, 4)
    if radius <= 0:
        raise wrong_term(name, "a radius above 0", text)
    return lambda splats: (((splats.world_means - np.array(center)) ** 2).sum(1) <= radius**2).astype(np.float32)


def _mask(name: str, text: str) -> MaskOnView:
    # Without @CAM.json the picture itself has to carry its camera.
    picture, at, camera_name = text.rpartition("@")
    if not at:
        picture, camera_name = text, ""
    camera = camera_from(Path(camera_name)) if camera_name else find_camera(Path(picture))
    mask = read_mask(Path(picture))
    # A mask of another shape was drawn on another view; of another size it only has to be resampled.
    if abs(mask.shape[1] * camera.height - mask.shape[0] * camera.width) > max(mask.shape):
        size = f"{mask.shape[1]}x{mask.shape[0]}"
        raise ValueError(
            f"{picture}: expected a mask of its camera's shape ({camera.width}x{camera.height}), got {size}"
        )
    if not mask.any():
        raise ValueError(f"{picture}: {EMPTY_MASK}")
    if mask.shape != (camera.height, camera.width):
        mask = resample(mask.astype(np.float32), camera.width, camera.height) > 0.5

    return MaskOnView(camera, mask)


def _of_project(name: str, text: str) -> Weigh:
    """A selection that a project keeps, or what one of its layers paints, on an asset made from its original."""
    return session_files(f"--where {name}").region(name, text)


_TERMS: dict[str, TermReader] = {
    "hue": _hue,
    "saturation": _color_range,
    "lightness": _color_range,
    "color": _color,
    "x": _attribute,
    "y": _attribute,
    "z": _attribute,
    "box": _box,
    "sphere": _sphere,
    "opacity": _attribute,
    "size": _attribute,
    "mask": _mask,
    "selection": _of_project,
    "layer": _of_project,
}
"""Name of a term -> what reads it from (name, value)."""
