"""The asset as a file of any format or as a page of its own, and what that will take."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from pydantic import Field

from splatpainter.io import FORMATS
from splatpainter.io.files import writing
from splatpainter.io.size_estimate import estimated_bytes
from splatpainter.io.write_options import MAX_SH_DEGREE, WriteOptions
from splatpainter.output_paths import receipt_of
from splatpainter.server.commands.context import CommandContext, RawExpr, command, python_line
from splatpainter.server.describe import endings, up_axis
from splatpainter.server.html_viewer import HTML_OPTIONS, estimated_html_bytes, html_viewer
from splatpainter.server.protocol import Answer, CameraInfo, Command, Exported, FileName, Message
from splatpainter.splats import Axes

HTML = ".html"


class ExportOptions(Message):
    """What a file shall hold less or otherwise than the asset (io.WriteOptions); null: as the asset has it, or as its
    format is usually written. Which of them a format has: `choices` of ExportSizes."""

    sh_degree: int | None = Field(default=None, ge=0, le=MAX_SH_DEGREE)
    antialiased: bool | None = None
    spz_version: int | None = None
    sh_bits: int | None = None
    sh_palette: int | None = None

    def chosen(self) -> WriteOptions:
        return WriteOptions(**self.model_dump())


class ExportSizes(Answer):
    sizes: dict[str, int]
    """File name ending -> bytes, about: those of `formats`, and ".html"; without formats that cannot hold the asset."""
    choices: dict[str, list[str]]
    """File name ending -> the options that the format has."""


class ExportEstimate(Command):
    """How large the files of an export would be, without writing them."""

    NAME = "export.sizes"
    ANSWER = ExportSizes
    ending: str | None = None
    """One format alone, with these options; null: all, without any."""
    options: ExportOptions = ExportOptions()
    remove_hidden: bool = False
    asset: str | None = None
    """Asset to export, as in `export`; ".html" always shows all."""


@command(ExportEstimate, background=True)
def estimate(context: CommandContext, request: ExportEstimate) -> ExportSizes:
    # The file of an export may have fewer Gaussians than the screen, so its size is estimated from those.
    splats = context.studio.session.files.exported(remove_hidden=request.remove_hidden, asset=request.asset)
    options, sizes = request.options.chosen(), {}
    for ending in [*endings(), HTML] if request.ending is None else [request.ending]:
        # The page of its own shows everything together, whichever asset is asked for.
        if ending == HTML:
            sizes[ending] = estimated_html_bytes(options.applied(context.studio.session.splats))
            continue
        with contextlib.suppress(ValueError):  # an asset that this format cannot hold
            sizes[ending] = estimated_bytes(splats, ending, options)
    # All formats' options at once, so that the page need not ask for each.
    choices = {entry.suffixes[0]: list(entry.write_options) for entry in FORMATS.values() if entry.suffixes}
    return ExportSizes(sizes=sizes, choices={**choices, HTML: list(HTML_OPTIONS)})


class AssetExport(Command):
    """The asset as it is, as a file of the format that the name's ending says (`formats` of the state)."""

    NAME = "export"
    ANSWER = Exported
    file: FileName
    remove_hidden: bool = False
    """Without hidden Gaussians (of opacity 0), for good; the receipt says how many. Of one asset at a time."""
    asset: str | None = None
    """One of several assets alone, in its own space; None: all that are visible, each in its own range of rows."""
    options: ExportOptions = ExportOptions()
    """Options of the file; for one asset at a time."""
    axes: Axes = "auto"
    """Axes of the file's numbers, of one asset at a time: "rub" is y up, "rdf" y down; "auto": as its format usually
    has them, or as the asset's own file if that is of the same format."""


@command(AssetExport, background=True, bound=True)
def export_asset(context: CommandContext, request: AssetExport) -> Exported:
    studio = context.studio
    context.ticket.report(0, "writing and verifying")
    # A folder for each export: the receipt goes beside it, under a fixed name.
    path = studio.downloads.folder() / Path(request.file).name
    options = request.options.chosen()
    # Written, read again and proved, as the command line does it.
    _, proof = studio.session.files.export(
        path, remove_hidden=request.remove_hidden, asset=request.asset, options=options, axes=request.axes
    )
    receipt = receipt_of(path)
    # Addresses are secret keys and end with the studio; the folder's path is not told.
    return Exported(
        url=studio.downloads.add(path),
        file=path.name,
        bytes=path.stat().st_size,
        receipt_url=studio.downloads.add(receipt),
        lost=proof.lost,
        python=python_line(
            "session.files.export",
            path.name,
            remove_hidden=request.remove_hidden or None,
            asset=request.asset,
            axes=None if request.axes == "auto" else request.axes,
            options=RawExpr(python_line("sp.WriteOptions", **options.chosen)) if options.chosen else None,
        ),
    )


class HtmlExport(Command):
    """The asset as it is now, in one HTML file that shows it without a server."""

    NAME = "export.html"
    ANSWER = Exported
    file: FileName
    camera: CameraInfo
    """The first view; its background is the page's."""
    turning: bool = False
    """Whether the asset turns until the user touches it."""
    options: ExportOptions = ExportOptions()


@command(HtmlExport, background=True, bound=True)
def export_html(context: CommandContext, request: HtmlExport) -> Exported:
    studio = context.studio
    context.ticket.report(0, "packing the Gaussians")
    # The page shows an edited asset; the hash of the original would be wrong in it.
    camera = replace(request.camera.to_camera(), asset_sha256=None)
    title = studio.state.asset.name
    options = request.options.chosen()
    # Options that a page cannot follow are refused instead of ignored.
    options.check(HTML_OPTIONS, request.file)
    splats = options.applied(studio.session.splats)
    data = html_viewer(splats, camera, up_axis(studio.session), title, turning=request.turning)
    name = request.file if request.file.lower().endswith(HTML) else request.file + HTML
    path = studio.downloads.folder() / name
    with writing(path) as file:
        file.write(data)
    line = python_line("html_viewer", RawExpr("session.splats"), RawExpr("camera"), RawExpr("up"), title)
    return Exported(url=studio.downloads.add(path), file=name, bytes=len(data), python=line)
