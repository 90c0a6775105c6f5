"""An asset under a look: only colours change, only of the Gaussians of a region, with a receipt.

    edited = adjust(splats, GradeSettings(exposure=0.5, temperature=0.3))
    edited = adjust(splats, read_cube(Path("film.cube")), Region.parse(["hue=340..20"]), strength=0.7)

A look is a function of display colours. It acts on each Gaussian's base colour, and by its slope there on the SH bands
above (color_grading.py), so highlights are graded with the surface they lie on. Gaussians are compared bit by bit: what
the look and the region leave alone keeps every one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeAlias, runtime_checkable

import numpy as np

from splatpainter.color import from_hex
from splatpainter.grading.color_grading import ALL_HUES_DEGREES, ColorSliders, GradeSettings, apply_to_sh
from splatpainter.grading.color_match import ColorMap, ColorMatch, Recolor, display_colors, seen_weights
from splatpainter.grading.cube_lut import read_cube
from splatpainter.io import files
from splatpainter.operations.operation import AS_PYTHON, Operation, ReadyOperation, Report, Tools, Wording, parameter
from splatpainter.operations.region import Region, check_terms
from splatpainter.operations.session_files import session_files
from splatpainter.painter import Asset
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.splats import Splats, changed_rows
from splatpainter.system.jsonio import load_object
from splatpainter.system.quick_dataclass import dataclass

SLIDERS = (*(entry.name for entry in fields(ColorSliders)), "hue")
LOOKS = ("look", "lut", "match", "recolor")
"""What stands in place of sliders: a look of the studio, a LUT, a picture's colours, one new colour."""
MAX_NOTE = 2000
"""Characters of what a receipt says of a look and its region."""
MAX_LOOK_BYTES = 1 << 20
"""Most bytes of a LOOK.json."""
LAYER_SUFFIX = ".splatlayer"
"""Of an adjustment layer of the studio as a file."""


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


@dataclass(frozen=True)
class Grade(ColorSliders, Operation):
    """Grade the colours of an asset, or of a region of it: by sliders, a look of the studio, a LUT, the colours of a
    picture, or one new colour. Nothing but colours changes."""

    kind: ClassVar[str] = "grade"

    hue: float = parameter(0.0, ge=-360, le=360)
    """Degrees by which all hues turn, about the grey axis; 120: red to green."""
    look: Path | None = parameter(None, metavar="LOOK.json", file=True)
    """Instead of sliders: an adjustment layer, as the studio exports it (.splatlayer), or its settings as JSON: the
    sliders, curve, hues, strength."""
    lut: Path | None = parameter(None, metavar="FILE.cube", file=True)
    """Or: a table of display colours, 1D or 3D, as grading programs write it."""
    match: Path | None = parameter(None, metavar="PICTURE", file=True, holds="picture")
    """Or: the mean and spread of the colours of this picture (linear Monge-Kantorovitch map)."""
    recolor: str = parameter("", metavar="#RRGGBB")
    """Or: one new colour; light and shade stay as they are."""
    strength: float = parameter(1.0, gt=0, le=1)
    """Strength of the change, 0 .. 1."""
    where: tuple[str, ...] = parameter((), metavar="WHERE ...", holds="region")
    """Region that changes; default: everything."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        where = "grade: " if wording.where is None else wording.where
        # The look's file is not read here: jobs of a batch are checked before any of their files is there.
        one_look(vars(self), where, wording.dashes)
        if self.recolor:
            hex_color(self.recolor, where, wording.dashes)
        if self.where:
            check_terms(self.where)

    def ready(self, tools: Tools) -> ReadyOperation:
        look = self.colors()
        # Look and region are read once; the function that is returned may meet an asset much later.
        region = Region.parse(self.where) if self.where else None

        def graded(asset: Asset, report: Report) -> Asset:
            edited = adjust(asset.splats, look, region, strength=self.strength)
            # The first asset stays beside the new one: its surface is what operations after this one work on.
            return replace(edited, original=asset.original or asset.splats)

        return graded

    def colors(self) -> Look:
        """The look that is asked for; its file is read. Raises ValueError: one that cannot be read."""
        values = one_look(vars(self))
        # Hue is no slider of the settings: turning all of them is a band over all hues.
        turn = values.pop("hue", 0.0)
        if self.look is not None:
            return read_look(self.look)
        if self.lut is not None:
            return read_cube(self.lut)
        if self.match is not None:
            return ColorMatch(read_picture(self.match), self.match.name)
        if self.recolor:
            return Recolor(hex_color(self.recolor))
        bands = [{"hue": 0.0, "width": ALL_HUES_DEGREES, "shift": turn}] if turn else []
        return GradeSettings.from_dict({**values, "hues": bands})


def read_look(path: Path) -> Look:
    """Settings of an adjustment layer: a JSON file, or a layer of the studio. Raises ValueError naming it."""
    # A layer of the studio is read by the session's room, which stands above this one (session_files.py).
    if path.suffix.lower() == LAYER_SUFFIX:
        return session_files(str(path)).look(path)
    # One byte above the limit is enough to see that a file is too long.
    data = load_object(files.read_head(path, MAX_LOOK_BYTES + 1), path, "a look", MAX_LOOK_BYTES)
    try:
        return GradeSettings.from_dict(data)
    except ValueError as error:
        raise ValueError(f"{path}: {str(error).removeprefix('look: ')}") from None


def one_look(given: Mapping[str, Any], where: str = "", mark: str = "") -> dict[str, float]:
    """The sliders that are moved. given: values of SLIDERS and LOOKS by name. where: begins errors; mark: the names in
    them. Raises ValueError: no look at all, or several."""
    values = {name: float(given[name]) for name in SLIDERS if given[name]}
    # Sliders count as one look together, so that they cannot be mixed with a file without a word.
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
    # Weights, then the look fitted to them: a look that matches colours counts those alone that it will change.
    weights = None if region is None else region.weights(splats)
    function = fitted(splats, look, weights)
    # Only rows of the region are computed; all others keep their bytes.
    chosen = np.arange(len(splats)) if weights is None else np.flatnonzero(weights)
    graded = apply_to_sh(splats.sh[chosen], _weaker(function, strength), splats.color_space)
    # At weight 1 the result is taken as it is: a mix would round it.
    if weights is not None:
        share = weights[chosen][:, None, None]
        graded = np.where(share == 1, graded, splats.sh[chosen] + share * (graded - splats.sh[chosen]))
    sh = splats.sh.copy()
    sh[chosen] = graded
    edited = replace(splats, sh=sh.astype(np.float32))
    # Compared bit by bit, so that the receipt lists what did change and not what was aimed at.
    touched = changed_rows(splats, edited)
    # A file that is the old one under a new name would look like a success.
    if not len(touched):
        raise ValueError(f"grade: nothing to do, {describe(look)} changes no Gaussian")
    before, after = untouched_hashes(splats, edited, touched)
    # The receipt says in words what was asked for: from it the look can be made again.
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
    # Most looks are the same for every asset; only those that match colours have to see it first.
    if not isinstance(look, FittedLook):
        return look
    # Gaussians inside would pull the mean towards colours that nobody sees.
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
    # Only what was moved, in the order of the sliders on the page.
    for name in names:
        value = getattr(look, name)
        if value != getattr(default, name):
            parts.append(f"{name} {value:g}" if isinstance(value, int | float) else f"{name} of {len(value)}")
    return ", ".join(parts) or "neutral sliders"


def _weaker(function: ColorMap, strength: float) -> ColorMap:
    if strength == 1:
        return function
    return lambda colors: colors + np.float32(strength) * (function(colors) - colors)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text[:MAX_NOTE])
