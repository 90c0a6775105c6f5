"""Views sent to a picture source, which edits them; what comes back is registered, corrected, cut and painted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import from_display
from splatpainter.operations.operation import AS_PYTHON, ReadyOperation, Report, ReportedView, Tools, Wording, parameter
from splatpainter.operations.painting_options import PaintingOptions, PictureSourceOptions
from splatpainter.painter import MAX_VIEWS, Asset, Mode, Painter
from splatpainter.rendering import MAX_SIDE_PX
from splatpainter.source_edits.coverage import ViewPlan, plan_views
from splatpainter.source_edits.edit import BACKGROUND, cover, edit_view
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief
from splatpainter.sources.picture_source import PictureSource
from splatpainter.splats import Splats
from splatpainter.system.plain_words import count
from splatpainter.system.quick_dataclass import dataclass

USUAL_PX, USUAL_ELEVATION_DEGREES, USUAL_VIEWS = 800, 15.0, 8
"""Side and height of a view that no camera says, and the most views of a plan."""


@dataclass(frozen=True)
class Generate(PictureSourceOptions, PaintingOptions):
    """Have a picture source edit a view, or one view after another until the surface is covered; each picture is
    registered, corrected and cut to what changed."""

    kind: ClassVar[str] = "generate"

    view: Path | None = parameter(None, metavar="CAM.json", file=True)
    """Camera of the view that is sent; default: --azimuth 0 --elevation 15, as the first picture of `render`."""
    azimuth: float | None = parameter(None, metavar="DEGREES")
    """Direction of the view that is sent, in place of its camera: degrees around the asset."""
    elevation: float | None = parameter(None, metavar="DEGREES", ge=-90, le=90)
    """Degrees of that direction above the horizon."""
    size: int | None = parameter(None, metavar="PX", shared=True, ge=16, le=MAX_SIDE_PX)
    """Pixels of the longer side of the views that are sent; default: 800, or what --view says."""
    views: Literal["", "auto"] = parameter("", metavar="auto")
    """auto: one view after another, each for surface that no earlier one showed, until the surface is covered."""
    max_views: int | None = parameter(None, metavar="N", ge=1, le=MAX_VIEWS)
    """Most views of --views auto; default: 8."""
    mask: Path | None = parameter(None, metavar="M.png", file=True)
    """Where the view may change: what is not black (or not transparent)."""
    references: tuple[Path, ...] = parameter((), metavar="PICTURE ...", option="reference", file=True)
    """Reference pictures for the source."""
    enlarge: int = parameter(1, ge=1, le=16)
    """Factor by which the source enlarges the view; the edit is made at that size."""
    report: Path | None = parameter(None, metavar="REPORT.png", option="source_report", output=True)
    """Write a sheet of pictures: sent, received, mask, used, difference."""
    mode: Mode = "local"
    """local: only what the source changed changes. global: a regraded or relit picture changes the whole asset."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        name = wording.option

        def refuse(line: str) -> None:
            raise wording.error(self.kind, line)

        if not self.source:
            refuse(f"expected {name('source')} NAME, the picture source that is asked")
        # A view is named by a file or by angles; with both, one of them would be ignored.
        if self.view is not None and (self.azimuth is not None or self.elevation is not None):
            refuse(f"expected {name('view')}, or {name('azimuth')} and {name('elevation')}, got both")
        # The plan makes a mask for each of its views, of what no earlier view showed.
        if self.mask is not None and self.views:
            refuse(f"expected no {name('mask')} with {name('views')} auto, which makes its own, got 1")
        if self.views and self.mode != "local":
            line = f"{name('views')} auto is for {name('mode')} local; one view is enough for {name('mode')} global"
            refuse(line)
        if self.max_views is not None and not self.views:
            refuse(f"{name('max_views')} is for {name('views')} auto")
        # Out of range is refused here, before a service is asked, and not by a renderer afterwards.
        super().check(wording)
        if self.mode == "spread":
            refuse("a source's picture is painted in mode local or global, not spread")

    def viewpoints(self) -> tuple[Path, ...]:
        return () if self.view is None else (self.view,)

    def ready(self, tools: Tools) -> ReadyOperation:
        task = self.task(tools)
        painter = self.painter(self.mode, tools)
        return lambda asset, report: task.painted(asset, painter, tools, report)

    def task(self, tools: Tools) -> SourceTask:
        """The source and what it is asked, with every file read."""
        from splatpainter.pictures.edit_files import camera_from
        from splatpainter.pictures.picture_reader import read_picture

        # Every file is read before the source is opened: a wrong path must cost no call.
        references = tuple(read_picture(path).colors for path in self.references)
        brief = SourceBrief(self.prompt, references, self.seed, self.enlarge, self.strictness)
        camera = None if self.view is None else camera_from(self.view, tools.asset)
        # The answer is laid over this view, so the size is settled before anything is rendered.
        if camera is not None and self.size is not None:
            camera = camera.with_longest_side(self.size)
        mask = None if self.mask is None else _mask(self.mask)
        return SourceTask(self.opened_source(tools), brief, camera, mask, self)


@dataclass(frozen=True)
class SourceTask:
    """A source and what it is asked, with every file read."""

    source: PictureSource
    brief: SourceBrief
    camera: Camera | None
    """Camera of `view`; None: of azimuth and elevation, or chosen by the plan."""
    mask: np.ndarray | None
    """[h, w] 0..1 of any size, white where the picture may change."""
    options: Generate

    def view_camera(self, splats: Splats) -> Camera:
        """The view that is rendered and sent, of a single edit."""
        if self.camera is not None:
            return self.camera.relative_to(splats.offset)
        options = self.options
        # The same default view as `render` makes first, so that what is seen there is what is sent.
        return orbit_cameras(
            splats,
            1,
            size=options.size or USUAL_PX,
            azimuth=options.azimuth or 0.0,
            elevation=USUAL_ELEVATION_DEGREES if options.elevation is None else options.elevation,
            background=_background(splats),
        )[0]

    def plan(self, splats: Splats) -> ViewPlan:
        """The views of `views` auto, or the one view."""
        options = self.options
        # A camera that is given begins the plan: the view that the user cares for most is painted first.
        first = None if self.camera is None else self.camera.relative_to(splats.offset)
        if first is None and (options.azimuth is not None or options.elevation is not None):
            first = self.view_camera(splats)
        if options.views != "auto":
            return ViewPlan((self.view_camera(splats),), (0.0,))
        return plan_views(
            splats,
            size=options.size or USUAL_PX,
            max_views=options.max_views or USUAL_VIEWS,
            first=first,
            background=_background(splats),
        )

    def planned(self, splats: Splats) -> tuple[dict[str, Any], list[str]]:
        """(record, lines): which views would be sent, and how many calls that are; nothing is asked."""
        # Nothing is asked: this is what a dry run shows, with the price in calls.
        plan, auto = self.plan(splats), self.options.views
        paid = self.source.capabilities.paid
        calls = count(len(plan.cameras), "paid call" if paid else "call")
        lines = [f"{self.source.name}: {calls}{'' if paid else ', not paid'}; nothing was sent"]
        record: dict[str, Any] = {"source": self.source.name, "calls": len(plan.cameras), "paid": paid, "views": []}
        for number, (camera, gain) in enumerate(zip(plan.cameras, plan.gains, strict=True), 1):
            # In the file's own coordinates, as people read them in other programs.
            eye = [round(float(value), 3) for value in camera.relative_to((0.0, 0.0, 0.0)).position]
            view = {"width": camera.width, "height": camera.height, "eye": eye, "adds": round(gain, 4)}
            record["views"].append(view)
            adds = f", reaches {100 * gain:.1f} % of the surface for the first time" if auto else ""
            size = f"{camera.width} x {camera.height}"
            lines.append(f"view {number}: {size} from {eye[0]:g}, {eye[1]:g}, {eye[2]:g}{adds}")
        if auto:
            record["covered"] = round(plan.covered, 4)
            lines.append(f"together {100 * plan.covered:.1f} % of the surface that any direction shows")
        return record, lines

    def painted(self, asset: Asset, painter: Painter, tools: Tools, report: Report) -> Asset:
        """The edited asset. Raises SourceError and what `Painter.apply` raises."""
        options, method = self.options, self.options.method
        # An asset that an operation before this one made keeps the surface that it had when it was read.
        asset = painter.encode(asset.splats, method, [options.mode]) if asset.receipt is None else asset
        # A refused picture must leave its report: that is what it is looked at for.
        try:
            with tools.progress() as progress:
                how: dict[str, Any] = {"method": method, "progress": progress, "cancel": tools.cancel}
                if options.views == "auto":
                    sourced = cover(painter, asset, self.source, self.brief, self.plan(asset.splats), **how)
                else:
                    camera = self.view_camera(asset.splats)
                    mask = _fitted(self.mask, camera, tools.wording)
                    sourced = edit_view(painter, asset, self.source, self.brief, camera, mask, mode=options.mode, **how)
        except ValueError:  # a refused picture is what a report is looked at for
            self._write_report(())
            raise
        self._write_report(sourced.edits)
        # Notes that all views share are listed once, so that what is special about one of them is seen.
        notes = notes_of_views(sourced.edits)
        report.views += [ReportedView(edit.edit.name, lines) for edit, lines in zip(sourced.edits, notes, strict=True)]
        report.answers += [edit.answer for edit in sourced.edits]
        return sourced.asset

    def _write_report(self, edits: Sequence[AnsweredView]) -> None:
        """The page of all that came back, where one is wanted."""
        from splatpainter.contact_sheet import write_sheet
        from splatpainter.gatekeeper.gate_report import report_page

        # Also without any edit: then the sheet shows what came back and was refused.
        answers = getattr(self.source, "answers", ())
        if self.options.report is None or not answers:
            return
        views = []
        for sent, answer in answers:
            # An answer that was painted is shown as it was used, any other as it came.
            edit = next((edit for edit in edits if edit.answer is answer), None)
            views.append((sent, answer, None) if edit is None else (edit.request, answer, edit.admitted))
        title = f"{self.source.name}: {self.brief.prompt}".rstrip(": ")
        write_sheet(self.options.report, report_page(views, title))


def notes_of_views(edits: Sequence[AnsweredView]) -> list[tuple[str, ...]]:
    """Notes of each view; what all of several have in common is listed once."""
    common = [note for note in edits[0].notes if len(edits) > 1 and all(note in edit.notes for edit in edits)]
    notes = [tuple(note for note in edit.notes if note not in common) for edit in edits]
    return [(*(f"{note} (all {len(edits)} views)" for note in common), *notes[0]), *notes[1:]]


def _background(splats: Splats) -> tuple[float, float, float]:
    red, green, blue = from_display(np.array(BACKGROUND), splats.color_space).tolist()
    return red, green, blue


def _mask(path: Path) -> np.ndarray:
    """[h, w] 0..1: white, or (of a picture with transparency) what is not transparent."""
    from splatpainter.pictures.picture_reader import EMPTY_MASK, read_picture

    picture = read_picture(path)
    # Either way of drawing a mask is common: black and white, or transparent where nothing may change.
    mask = picture.colors.mean(-1) if picture.alpha is None else picture.alpha
    if not (mask > 0).any():
        raise ValueError(f"{path}: {EMPTY_MASK}")
    return mask


def _fitted(mask: np.ndarray | None, camera: Camera, wording: Wording) -> np.ndarray | None:
    """The mask at the view's size. Raises ValueError for another shape."""
    if mask is None or mask.shape == (camera.height, camera.width):
        return mask
    from splatpainter.pictures.edit_files import MAX_ASPECT_ERROR
    from splatpainter.pictures.picture_reader import resample

    height, width = mask.shape
    # Another size is no mistake, another shape is one: the mask would lie elsewhere on the view.
    if abs(width * camera.height / (height * camera.width) - 1) > MAX_ASPECT_ERROR:
        size = f"{camera.width}x{camera.height}"
        line = f"expected {wording.option('mask')} of the view's shape ({size}), got {width}x{height}"
        raise wording.error("generate", line)
    return resample(mask, camera.width, camera.height)
