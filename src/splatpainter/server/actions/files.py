"""Bookmarks, assets, projects, exports, receipts."""

from __future__ import annotations

import contextlib
import json
import shutil
from pathlib import Path
from typing import Any

from splatpainter.io import FORMATS, files, read
from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import called, camera_of, python_line
from splatpainter.server.blobs import Blob
from splatpainter.server.core import Studio
from splatpainter.server.demo import demo
from splatpainter.server.describe import camera_to_wire
from splatpainter.server.messages import Answer
from splatpainter.server.messages import files as say
from splatpainter.server.messages.base import Exported
from splatpainter.server.messages.state import Bookmark
from splatpainter.server.places import PROJECT
from splatpainter.session import Session
from splatpainter.session.scratch import scratch_folder
from splatpainter.splats import Splats


@handles(say.BookmarkAdd, writes=True)
def add_bookmark(call: Call, command: say.BookmarkAdd) -> say.BookmarkMade:
    camera = camera_of(command.camera)
    own = call.studio.session.add_bookmark(command.name, camera)
    mark = Bookmark(id=own, name=command.name, camera=camera_to_wire(camera))
    line = python_line("session.add_bookmark", command.name)[:-1] + ", camera)"
    return say.BookmarkMade(bookmark=mark, python=line)


@handles(say.BookmarkDelete, writes=True)
def delete_bookmark(call: Call, command: say.BookmarkDelete) -> Answer:
    call.studio.session.delete_bookmark(command.bookmark)
    return Answer(python=python_line("session.delete_bookmark", command.bookmark))


@handles(say.AssetOpen, writes=True)
def open_asset(call: Call, command: say.AssetOpen) -> Answer:
    studio = call.studio
    if (command.blob is not None) + (command.file is not None) + command.demo != 1:
        raise ValueError("asset: expected one of blob, file or demo")
    call.ticket.report(0, "reading")
    name, path = "demo", None
    if command.blob is not None:
        blob = studio.blobs.get(command.blob, "asset")
        name, path = blob.name or f"asset{blob.claim.ending}", blob.path
    elif command.file is not None:
        name, path = command.file, _folder_file(studio, command.file)
    with contextlib.nullcontext() if path is None else called(path, name):
        studio.open(lambda: start(studio, demo() if path is None else read(path), name), name)
    return Answer(python=python_line("session = sp.Session", name))


@handles(say.AssetUp, writes=True)
def turn_up(call: Call, command: say.AssetUp) -> Answer:
    call.studio.session.set_up(command.up)
    return Answer(python=python_line("session.set_up", command.up))


def start(studio: Studio, asset: Splats, name: str) -> Session:
    """A new session whose project is in the studio's own folder from the beginning."""
    return Session(asset, studio.projects.fresh(name))


@handles(say.ProjectOpen, writes=True)
def open_project(call: Call, command: say.ProjectOpen) -> Answer:
    studio = call.studio
    if sum(given is not None for given in (command.blob, command.file, command.recent)) != 1:
        raise ValueError("project: expected one of file, recent or blob")
    call.ticket.report(0, "opening")
    if command.blob is not None:
        blob = studio.blobs.get(command.blob, "project")
        name = Path(blob.name).stem or "project"
        studio.open(lambda: _received(studio, blob, name), name)
        return Answer(python=python_line("session = sp.Session.load", f"{name}{PROJECT}"))
    rule: dict[str, Any] = {"embedded": True}
    if command.recent is not None:
        path = studio.projects.find(command.recent)
        name = command.recent.rsplit("_", 1)[0]
    else:
        path = _folder_file(studio, command.file or "")
        name = path.stem
        assert studio.folder is not None
        rule = {"folder": studio.folder.root}
    if studio.session.path is None or path.resolve() != studio.session.path.resolve():
        studio.open(lambda: Session.load(path, **rule), name)
    return Answer(python=python_line("session = sp.Session.load", path.name))


def _received(studio: Studio, blob: Blob, name: str) -> Session:
    """A session on an uploaded project, which then lies in the studio's own folder. Only one that opens gets there."""
    title = blob.name or "the project"
    with scratch_folder("studio") as folder:
        copy = folder / f"upload{PROJECT}"
        try:
            shutil.copyfile(blob.path, copy)
        except OSError as error:
            raise ValueError(f"{title}: cannot be copied ({error.strerror or error})") from None
        with called(copy, title):
            session = Session.load(copy, embedded=True, readonly=False)
            try:
                session.save_as(studio.projects.fresh(name))
            except BaseException:
                session.close()
                raise
    return session


@handles(say.ProjectSaveAs, writes=True)
def save_as(call: Call, command: say.ProjectSaveAs) -> Answer:
    studio = call.studio
    if studio.folder is None:
        raise ValueError("project: the studio was started without a folder; export it as a download instead")
    name = command.file if command.file.lower().endswith(PROJECT) else command.file + PROJECT
    path = studio.folder.file(name, new=True)
    before = studio.session.path
    studio.session.save_as(path, overwrite=command.overwrite)
    if before is not None and before.parent == studio.projects.root:
        files.remove(before)  # it moved
    studio.name = path.stem
    return Answer(python=python_line("session.save_as", name))


@handles(say.ProjectDownload)
def download_project(call: Call, command: say.ProjectDownload) -> Exported:
    studio = call.studio
    path = studio.downloads.folder() / f"{Path(studio.state.project.name).stem or 'project'}{PROJECT}"
    studio.session.save_copy(path)
    url = studio.downloads.add(path)
    return Exported(
        url=url, file=path.name, bytes=path.stat().st_size, python=python_line("session.save_copy", path.name)
    )


@handles(say.ProjectRecent)
def recent(call: Call, command: say.ProjectRecent) -> say.RecentProjects:
    studio = call.studio
    kept = [say.Recent(id=own.id, name=own.name, changed=own.changed) for own in studio.projects.kept()]
    return say.RecentProjects(recent=kept, files=[] if studio.folder is None else studio.folder.names())


@handles(say.Export, aside=True)
def export(call: Call, command: say.Export) -> Exported:
    studio = call.studio
    call.ticket.report(0, "writing and verifying")
    path = studio.downloads.folder() / Path(command.file).name
    studio.session.export(path)
    receipt = path.with_name(path.name + ".receipt.json")
    return Exported(
        url=studio.downloads.add(path),
        file=path.name,
        bytes=path.stat().st_size,
        receipt_url=studio.downloads.add(receipt),
        python=python_line("session.export", path.name),
    )


@handles(say.Receipt, aside=True)
def receipt(call: Call, command: say.Receipt) -> say.ReceiptMade:
    own = call.studio.session.receipt()
    added = f", {own.appended_rows:,} appended" if own.appended_rows else ""
    text = f"{own.untouched_rows:,} of {own.asset_rows:,} rows byte-identical{added}"
    return say.ReceiptMade(receipt=json.loads(own.to_json()), text=text, python="session.receipt()")


@handles(say.Verify, aside=True)
def verify(call: Call, command: say.Verify) -> say.Verified:
    session = call.studio.session
    source = session.original.source
    entry = None if source is None else FORMATS.get(source.format)
    ending = ".ply" if entry is None or entry.write is None or not entry.suffixes else entry.suffixes[0]
    call.ticket.report(0, "writing and reading again")
    with scratch_folder("verify") as folder:
        _, found = session.export(folder / f"asset{ending}")
    call.ticket.report(0.5, "replaying the layers")
    problems = [*found.problems, *session.verify()]
    return say.Verified(
        proved=not problems,
        rows=found.rows,
        same=found.same,
        changed=found.changed,
        appended=found.appended,
        problems=problems,
        exact=found.exact,
        python="session.verify()",
    )


def _folder_file(studio: Studio, name: str) -> Path:
    if studio.folder is None:
        raise ValueError(f"{name}: the studio was started without a folder; drop the file into the page instead")
    return studio.folder.file(name)
