"""An asset under a look: only colours change, only of the Gaussians of a region, with a receipt. Pure.

    edited = adjust(splats, GradeSettings(exposure=0.5, temperature=0.3))
    edited = adjust(splats, read_cube(Path("film.cube")), Region.parse(["hue=340..20"]), strength=0.7)

A look is a function of display colours. It acts on each Gaussian's base colour, and by its slope there on the SH bands
above (color_grading.py), so highlights are graded with the surface they lie on. Gaussians are compared bit by bit: what
the look and the region leave alone keeps every one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from splatpainter.color import from_hex
from splatpainter.grading.color_grading import GradeSettings, apply_to_sh
from splatpainter.grading.color_match import ColorMap, display_colors, seen_weights
from splatpainter.operations.region import Region
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.splats import Splats, changed_rows

SLIDERS = {"exposure": 10.0, "temperature": 1.0, "tint": 1.0, "contrast": 1.0, "saturation": 1.0, "hue": 360.0}
"""Slider -> the largest value to either side."""
LOOKS = ("look", "lut", "match", "recolor")
"""What stands in place of sliders: a look of the studio, a LUT, a picture's colours, one new colour."""
MAX_NOTE = 2000
"""Characters of what a receipt says of a look and its region."""


@runtime_checkable
class FittedLook(Protocol):
    """A look that depends on the colours that it changes."""

    def fit(self, colors: np.ndarray, weights: np.ndarray) -> ColorMap: ...

    def describe(self) -> str: ...


class FixedLook(Protocol):
    """A look that is the same for every asset."""

    def __call__(self, colors: np.ndarray) -> np.ndarray: ...

    def describe(self) -> str: ...


Look: TypeAlias = GradeSettings | FixedLook | FittedLook


def one_look(given: Mapping[str, Any], where: str = "", mark: str = "") -> dict[str, float]:
    """The sliders that are moved. given: values of SLIDERS and LOOKS by name. where: begins errors; mark: the names in
    them. Raises ValueError: a slider beyond its end, no look at all, or several."""
    for name, limit in SLIDERS.items():
        if not -limit <= given[name] <= limit:
            raise ValueError(f"{where}expected {mark}{name} from {-limit:g} to {limit:g}, got {given[name]}")
    values = {name: float(given[name]) for name in SLIDERS if given[name]}
    looks = [f"{mark}{name}" for name in LOOKS if given[name]] + (["sliders"] if values else [])
    if len(looks) != 1:
        choices = ", ".join(f"{mark}{name}" for name in (*SLIDERS, *LOOKS))
        raise ValueError(f"{where}expected sliders or one look ({choices}), got {' and '.join(looks) or 'none'}")
    return values


def hex_color(text: str, where: str = "", mark: str = "") -> tuple[float, float, float]:
    """0..1 of a --recolor. Raises ValueError, which begins with `where`."""
    color = from_hex(text)
    if color is None:
        raise ValueError(f"{where}expected {mark}recolor like #2040a0, got {ascii(text[:40])}")
    return color


def adjust(splats: Splats, look: Look, region: Region | None = None, *, strength: float = 1.0) -> Asset:
    """The asset under a look. region: what it changes (None: everything); strength: 0..1 of the change.

    Raises ValueError: a strength out of range, nothing that would change, a region that reaches nothing."""
    if not 0 < strength <= 1:
        raise ValueError(f"grade: expected a strength above 0, up to 1, got {strength:g}")
    splats = splats.numpy()
    weights = None if region is None else region.weights(splats)
    function = fitted(splats, look, weights)
    chosen = np.arange(len(splats)) if weights is None else np.flatnonzero(weights)
    try:
        graded = apply_to_sh(splats.sh[chosen], _weaker(function, strength), splats.color_space)
    except OverflowError as error:  # of Python's own floats
        raise ValueError(f"grade: expected smaller settings ({error})") from None
    if weights is not None:
        share = weights[chosen][:, None, None]
        graded = np.where(share == 1, graded, splats.sh[chosen] + share * (graded - splats.sh[chosen]))
    sh = splats.sh.copy()
    sh[chosen] = graded
    edited = replace(splats, sh=sh.astype(np.float32))
    touched = changed_rows(splats, edited)
    if not len(touched):
        raise ValueError(f"grade: nothing to do, {describe(look)} changes no Gaussian")
    before, after = untouched_hashes(splats, edited, touched)
    what = [describe(look), f"strength {strength:g}" if strength != 1 else "", f"where {region.text}" if region else ""]
    receipt = Receipt(
        asset_sha256=splats.sha256,
        asset_rows=len(splats),
        output_sha256="",
        output_rows=len(edited),
        mode="grade",
        method="colors",
        preset="",
        touched=touched,
        appended_rows=0,
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        note=_one_line("; ".join(filter(None, what))),
    )
    return Asset(edited, receipt, original=splats)


grade = adjust
"""The older name; the command is still called so."""


def fitted(splats: Splats, look: Look, weights: np.ndarray | None) -> ColorMap:
    """The look as a function of display colours. weights: [N] of the region, None: all."""
    if not isinstance(look, FittedLook):
        return look
    seen = seen_weights(splats)
    counted = seen if weights is None else seen * weights
    if not counted.sum() > 0:  # nothing of it is seen from outside
        counted = splats.drawable.astype(np.float64) if weights is None else weights.astype(np.float64)
    return look.fit(display_colors(splats), counted)


def describe(look: Look) -> str:
    """One line for receipts."""
    if not isinstance(look, GradeSettings):
        return look.describe()
    default = GradeSettings()
    names = ("exposure", "temperature", "tint", "contrast", "saturation", "curve", "hues", "strength")
    parts = []
    for name in names:
        value = getattr(look, name)
        if value != getattr(default, name):
            parts.append(f"{name} {value:g}" if isinstance(value, float) else f"{name} of {len(value)}")
    return ", ".join(parts) or "neutral sliders"


def _weaker(function: ColorMap, strength: float) -> ColorMap:
    if strength == 1:
        return function
    return lambda colors: colors + np.float32(strength) * (function(colors) - colors)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text[:MAX_NOTE])
