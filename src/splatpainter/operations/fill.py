"""A part removed, or a hole, and what takes its place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

from splatpainter.operations.operation import AS_PYTHON, ReadyOperation, Report, Tools, Wording, parameter
from splatpainter.operations.painting_options import PictureSourceOptions
from splatpainter.operations.region import Region
from splatpainter.painter import Asset
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Fill(PictureSourceOptions):
    """Remove the part that WHERE selects and fill the gap, or fill a hole: surface, tone and texture continue."""

    kind: ClassVar[str] = "fill"

    where: tuple[str, ...] = parameter((), metavar="WHERE ...", holds="region")
    """Part to remove; what it leaves is filled."""
    remove: Literal["body", "selection"] = "body"
    """What goes of WHERE: body: the whole thing that it is of, its back too, without the ground it stands on; where it
    is a spot on something larger, as selection: it alone."""
    around: tuple[str, ...] = parameter((), metavar="WHERE ...", holds="region")
    """Instead: what surrounds an existing hole, such as a mask drawn around it."""
    source: str = parameter("", metavar="NAME", shared=True)
    """A picture source (`splatpainter source list`) that is sent a view of the filled hole, which is its mask; default:
    the texture of what surrounds it."""
    view: Path | None = parameter(None, metavar="CAM.json", file=True, holds="camera")
    """Camera of the view that is sent; default: one that faces the hole."""
    size: int | None = parameter(None, metavar="PX", shared=True)
    """Pixels of its longer side; default: what --view says."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        name = wording.option
        # Removing a part and filling a hole that is there are two tasks; with both it is open which is meant.
        if bool(self.where) == bool(self.around):
            given = "both" if self.where else "none"
            line = f"expected {name('where')} (what to remove) or {name('around')} (what surrounds a hole), got {given}"
            raise wording.error(self.kind, line)
        # Options of a source without one would be silently without effect.
        self.refuse_options_without_source(wording, ("prompt", "view", "size", "seed", "options"))

    def viewpoints(self) -> tuple[Path, ...]:
        return () if self.view is None else (self.view,)

    def ready(self, tools: Tools) -> ReadyOperation:
        from splatpainter.pictures.edit_files import camera_from
        from splatpainter.source_edits.fill import fill
        from splatpainter.source_edits.view_edit import SourceBrief

        # Files are read and the source is opened before any asset is: what is wrong with them is known at once.
        region = Region.parse(self.where or self.around)
        source = self.opened_source(tools) if self.source else None
        camera = None if self.view is None else camera_from(self.view, tools.asset)
        if camera is not None and self.size is not None:
            camera = camera.with_longest_side(self.size)

        def filled(asset: Asset, report: Report) -> Asset:
            splats = asset.splats
            # The region is weighed on the asset as it is now: operations before this one may have moved it.
            weights = region.weights(splats)
            with tools.progress() as progress:
                edited = fill(
                    splats,
                    weights if self.where else None,
                    around=weights if self.around else None,
                    body=self.remove == "body",
                    beside=region.beside(splats) if self.where else None,
                    source=source,
                    prompt=SourceBrief(self.prompt, seed=self.seed, strictness=self.strictness),
                    camera=camera.relative_to(splats.offset) if camera is not None else None,
                    progress=progress,
                    cancel=tools.cancel,
                )
            # Kept for the report: a service was paid for these, whatever becomes of the asset.
            report.answers += [answer for _, answer in getattr(source, "answers", ())]
            return replace(edited, original=None)  # its new Gaussians are surface, too

        return filled
