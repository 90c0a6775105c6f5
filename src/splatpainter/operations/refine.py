"""Views enlarged by a model or another source, and their detail put onto the asset."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from splatpainter.operations.operation import AS_PYTHON, ReadyOperation, Report, ReportedView, Tools, Wording, parameter
from splatpainter.operations.painting_options import PictureSourceOptions
from splatpainter.painter import MAX_VIEWS, Asset, Painter
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Refine(PictureSourceOptions):
    """Make an asset sharper in close-ups: views are enlarged by a super-resolution model, or another picture source,
    and lifted together."""

    kind: ClassVar[str] = "refine"

    views: tuple[Path, ...] = parameter((), metavar="CAM.json ...", option="view", file=True)
    """1 to 16 cameras of the views (CAM.json, or pictures that `render` made)."""
    upscale: Path | None = parameter(None, metavar="MODEL.safetensors", file=True)
    """Super-resolution model that enlarges the views."""
    scale: Literal[1, 2, 4] | None = parameter(None, metavar="1|2|4")
    """Factor by which each view is enlarged; default: 2, or 1 for sources that do not enlarge."""
    source: str = parameter("upscale", metavar="NAME", shared=True)
    """Picture source that enlarges the views (`splatpainter source list`)."""
    size: int | None = parameter(None, metavar="PX", shared=True)
    """Pixels of the longer side at which views are rendered and sent; default: the cameras'."""
    method: Literal["lift", "fit"] = "lift"
    """lift: analytic, seconds; fit: some seconds of optimisation after it, nearer to the pictures."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        name = wording.option
        # A file for each view: without any there is nothing to enlarge, and networks and memory bound the number.
        if not 1 <= len(self.views) <= MAX_VIEWS:
            given = len(self.views) or "none"
            line = f"expected 1 to {MAX_VIEWS} cameras ({name('views')} CAM.json ...), got {given}"
            raise wording.error(self.kind, line)
        # The model belongs to the source that loads models; another one would ignore it.
        if self.upscale is not None and self.source != "upscale":
            raise wording.error(self.kind, f"{name('upscale')} is the model of source upscale, not of {self.source}")

    def calls(self) -> int:
        return len(self.views)

    def viewpoints(self) -> tuple[Path, ...]:
        return self.views[:1]

    def ready(self, tools: Tools) -> ReadyOperation:
        from splatpainter.pictures.edit_files import camera_from
        from splatpainter.source_edits.edit import refine_views, usual_scale
        from splatpainter.source_edits.view_edit import SourceBrief

        # The model's path goes in as an option, so that `upscale` is a source like any other.
        source = self.opened_source(tools, **({} if self.upscale is None else {"model": str(self.upscale)}))
        cameras = [camera_from(path, tools.asset) for path in self.views]
        if self.size is not None:
            cameras = [camera.with_longest_side(self.size) for camera in cameras]
        # Without weights: this operation has the methods lift and fit alone.
        painter = tools.painter or Painter.load("lift").with_settings(aside=tools.aside)

        def refined(asset: Asset, report: Report) -> Asset:
            # Unless a factor is asked for: some sources only sharpen and cannot enlarge.
            scale = self.scale or usual_scale(source)
            brief = SourceBrief(self.prompt, seed=self.seed, scale=scale, strictness=self.strictness)
            asset = painter.encode(asset.splats, self.method, ["local"]) if asset.receipt is None else asset
            # All views in one edit, so that detail in which they disagree is settled between them.
            with tools.progress() as progress:
                result = refine_views(
                    painter,
                    asset,
                    source,
                    brief,
                    [camera.relative_to(asset.splats.offset) for camera in cameras],
                    method=self.method,
                    progress=progress,
                    cancel=tools.cancel,
                )
            for path, edit in zip(self.views, result.edits, strict=True):
                size = f"{edit.edit.camera.width} x {edit.edit.camera.height}"
                against = f"the picture of {edit.answer.model or source.name}, {size}"
                # There is no picture of the user's to compare with: the score is against what the source drew.
                report.views.append(ReportedView(str(path), edit.notes, against))
            report.answers += [edit.answer for edit in result.edits]
            return result.asset

        return refined
