"""Decals of `splatpainter edit`: its options become a `Decal`, a laid decal becomes the edited asset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatpainter.color import from_hex
from splatpainter.painter import Asset, Method, Painter
from splatpainter.pictures.edit_files import camera_from
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.decals.decals import Decal

COMMAND = "splatpainter edit"


@dataclass(frozen=True)
class DecalView:
    """One of the views that a decal was painted from, as the report names it."""

    path: str
    notes: tuple[str, ...] = ()


def decal_from_options(
    picture: Path | None,
    text: str,
    font: Path | None,
    color: str,
    at: str,
    cameras: Sequence[Path],
    width: str,
    angle: float,
    wrap: float,
    asset: Path | None = None,
) -> Decal | None:
    """The decal, or None where neither a picture nor a text is given. asset: what the camera is for.
    Raises ValueError, one line naming the option."""
    if picture is None and not text:
        for option, given in (("--at", at), ("--width", width), ("--decal-font", font)):
            if given:
                raise ValueError(f"{COMMAND}: {option} is for decals; give --decal PICTURE or --decal-text WORD too")
        return None
    if picture is not None and text:
        raise ValueError(f"{COMMAND}: expected --decal or --decal-text, got both")
    if len(cameras) != 1:
        raise ValueError(
            f"{COMMAND}: a decal needs one --camera CAM.json, in whose picture --at is a pixel, got {len(cameras)}"
        )
    if not width:
        raise ValueError(f"{COMMAND}: a decal needs --width, in world units or like 12% of the asset's diameter")
    from splatpainter.decals.decals import Decal, parse_width, text_picture  # which load what only decals need

    parse_width(width)
    source = text_picture(text, _color(color), font) if picture is None else picture
    name = str(picture) if picture is not None else f"decal '{text[:40]}'"
    return Decal(source, _pixel(at), camera_from(cameras[0], asset), width, angle, wrap, name)


def paint_decal(splats: Splats, decal: Decal, method: Method, painter: Painter) -> tuple[Asset, list[DecalView]]:
    """(the asset with the decal on it, one entry per view of its receipt)."""
    method = "lift" if method == "auto" else method
    asset = painter.encode(splats, method, ["local"])
    laid = decal.laid(asset)
    edited = painter.apply(asset, laid.edits, "local", method)
    assert edited.receipt is not None
    note = "; ".join(filter(None, [laid.note, edited.receipt.note]))
    return replace(edited, receipt=replace(edited.receipt, note=note)), [DecalView(e.name) for e in laid.edits]


def _pixel(text: str) -> tuple[float, float]:
    parts = text.split(",")
    try:
        x, y = (float(part) for part in parts)
    except ValueError:
        raise ValueError(f"{COMMAND}: expected --at X,Y, a pixel of the camera's picture, got {text!r}") from None
    return x, y


def _color(text: str) -> tuple[float, float, float]:
    color = from_hex(text)
    if color is None:
        raise ValueError(f"{COMMAND}: expected --decal-color like #20406f, got {text!r}")
    return color
