"""What an export will take, and the asset as a page of its own. The exports of files are in files.py."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from splatpainter.io.files import writing
from splatpainter.io.size_estimate import estimated_bytes
from splatpainter.server.commands.context import CommandContext, RawExpr, command, python_line
from splatpainter.server.describe import endings, up_axis
from splatpainter.server.html_viewer import estimated_html_bytes, html_viewer
from splatpainter.server.protocol import Answer, CameraInfo, Command, Exported, FileName

HTML = ".html"


class ExportSizes(Answer):
    sizes: dict[str, int]
    """File name ending -> bytes, about: those of `formats`, and ".html"."""


class ExportEstimate(Command):
    """How large the files of an export would be, without writing them."""

    NAME = "export.sizes"
    ANSWER = ExportSizes


@command(ExportEstimate, background=True)
def estimate(context: CommandContext, request: ExportEstimate) -> ExportSizes:
    splats = context.studio.session.splats
    sizes: dict[str, Any] = {ending: estimated_bytes(splats, ending) for ending in endings()}
    return ExportSizes(sizes={**sizes, HTML: estimated_html_bytes(splats)})


class HtmlExport(Command):
    """The asset as it is now, in one HTML file that shows it without a server."""

    NAME = "export.html"
    ANSWER = Exported
    file: FileName
    camera: CameraInfo
    """The first view; its background is the page's."""
    turning: bool = False
    """It turns until it is touched."""


@command(HtmlExport, background=True)
def export_html(context: CommandContext, request: HtmlExport) -> Exported:
    studio = context.studio
    context.ticket.report(0, "packing the Gaussians")
    camera = replace(request.camera.to_camera(), asset_sha256=None)
    title = studio.state.asset.name
    data = html_viewer(studio.session.splats, camera, up_axis(studio.session), title, turning=request.turning)
    name = request.file if request.file.lower().endswith(HTML) else request.file + HTML
    path = studio.downloads.folder() / name
    with writing(path) as file:
        file.write(data)
    line = python_line("html_viewer", RawExpr("session.splats"), RawExpr("camera"), RawExpr("up"), title)
    return Exported(url=studio.downloads.add(path), file=name, bytes=len(data), python=line)
