"""A picture or a text laid on an asset's surface, unwrapped over it."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from splatpainter.color import from_hex
from splatpainter.operations.operation import AS_PYTHON, ReadyOperation, Report, ReportedView, Tools, Wording, parameter
from splatpainter.operations.painting_options import ViewLimits
from splatpainter.painter import Asset, Method, Painter
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class LayDecal(ViewLimits):
    """Lay a picture, or a text, on the surface under a pixel of a camera's picture; what is transparent of it leaves
    the asset as it is."""

    kind: ClassVar[str] = "decal"

    picture: Path | None = parameter(None, metavar="PICTURE", positional=True, file=True, holds="picture")
    """A picture to lay on the surface, unwrapped over it; what is transparent stays as it is."""
    text: str = parameter("", metavar="WORD")
    """A text to lay on the surface, in place of a picture."""
    font: Path | None = parameter(None, metavar="F.ttf", file=True)
    """Font of the text, TrueType or OpenType."""
    color: str = parameter("#202020", metavar="#RRGGBB")
    """Colour of the text."""
    at: tuple[float, float] | None = parameter(None, metavar="X,Y", words=str | None)
    """Pixel of the camera's picture (--camera CAM.json) under which the decal's centre lies on the surface."""
    camera: Path | None = parameter(None, metavar="CAM.json[:N]", file=True, holds="camera")
    """The camera: CAM.json, or a picture that `splatpainter render` made."""
    width: Any = parameter("", metavar="LENGTH|PERCENT", words=str)
    """Width of the decal along the surface: world units, or a percentage of the asset's diameter, like 12%."""
    angle: float = 0.0
    """Degrees by which the decal is turned, counter-clockwise as seen from outside; at 0 its up is the camera's, in the
    studio the object's."""
    wrap: float = parameter(180.0, gt=0, le=180)
    """Degrees by which the surface may turn away under the decal; 180: no limit."""
    method: Method = "auto"
    """lift (analytic), or fit (some seconds of optimisation after it); auto: lift."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # A pixel in words becomes two numbers already here, so that equal operations compare equal.
        with contextlib.suppress(ValueError):  # which `check` raises again
            object.__setattr__(self, "at", self._pixel())

    def check(self, wording: Wording = AS_PYTHON) -> None:
        # In this order: what is laid, who paints it, where it lies, how large it is. The first that is wrong is named.
        super().check(wording)
        name = wording.option
        if self.picture is not None and self.text:
            raise wording.error(self.kind, f"expected {name('picture')} or {name('text')}, got both")
        if self.picture is None and not self.text:
            raise wording.error(self.kind, f"expected {name('picture')} or {name('text')}, got none")
        if self.method == "ttt":
            raise wording.error(self.kind, "a decal is an edit of mode local by method lift or fit")
        if self.camera is None:
            line = f"a decal needs one {name('camera')} CAM.json, in whose picture {name('at')} is a pixel, got 0"
            raise wording.error(self.kind, line)
        if self.width in ("", None):
            line = f"a decal needs {name('width')}, in world units or like 12% of the asset's diameter"
            raise wording.error(self.kind, line)
        if not isinstance(self.width, str | int | float) or isinstance(self.width, bool):
            raise wording.error(self.kind, f"expected {name('width')} as a number or like 20%, got {self.width!r:.40}")
        # Imported this late: decals load much that other operations never need.
        from splatpainter.decals.decals import parse_width

        parse_width(self.width)
        if self.text and from_hex(self.color) is None:
            raise wording.error(self.kind, f"expected {name('color')} like #20406f, got {self.color!r}")
        self._pixel(wording)

    def viewpoints(self) -> tuple[Path, ...]:
        return () if self.camera is None else (self.camera,)

    def ready(self, tools: Tools) -> ReadyOperation:
        from splatpainter.decals.decals import Decal, text_picture  # which load what only decals need
        from splatpainter.pictures.edit_files import camera_from

        # `check` refused what is missing here; these lines only say so to the type checker.
        rgb = from_hex(self.color)
        assert self.camera is not None and rgb is not None
        # A text is drawn to a picture once, so both kinds are laid by the same code from here on.
        picture = text_picture(self.text, rgb, self.font) if self.picture is None else self.picture
        name = str(self.picture) if self.picture is not None else f"decal '{self.text[:40]}'"
        camera = camera_from(self.camera, tools.asset)
        decal = Decal(picture, self._pixel(), camera, str(self.width), self.angle, self.wrap, name)
        # Here auto is the lift: a decal is an edit of mode local by lift or fit alone (`check`).
        method: Method = "lift" if self.method == "auto" else self.method
        painter = tools.painter or self.limited(Painter.load(modes=["local"]).with_settings(aside=tools.aside))

        def lay(asset: Asset, report: Report) -> Asset:
            # An asset that an operation before this one made keeps the surface that it had when it was read.
            asset = painter.encode(asset.splats, method, ["local"]) if asset.receipt is None else asset
            laid = decal.laid(asset)
            edited = painter.apply(asset, laid.edits, "local", method)
            assert edited.receipt is not None
            note = "; ".join(filter(None, [laid.note, edited.receipt.note]))
            report.views += [ReportedView(edit.name) for edit in laid.edits]
            # The decal's own remarks stand in the receipt: how it lies is part of what was done.
            return replace(edited, receipt=replace(edited.receipt, note=note))

        return lay

    def _pixel(self, wording: Wording = AS_PYTHON) -> tuple[float, float]:
        """The pixel (x, y). Raises ValueError."""
        given: Any = "" if self.at is None else self.at
        try:
            x, y = (float(part) for part in (given.split(",") if isinstance(given, str) else given))
        except (TypeError, ValueError):
            line = f"expected {wording.option('at')} X,Y, a pixel of the camera's picture, got {given!r:.60}"
            raise wording.error(self.kind, line) from None
        return x, y
