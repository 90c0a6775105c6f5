"""Bookmarks, assets, projects, exports, receipts."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from splatpainter.io import FORMATS, files, read
from splatpainter.server.commands.context import CommandContext, RawExpr, command, naming_errors, progress, python_line
from splatpainter.server.protocol import (
    Answer,
    Blob,
    BookmarkInfo,
    CameraInfo,
    Command,
    Exported,
    FileName,
    Message,
    Name,
    RecentInfo,
)
from splatpainter.server.studio import Studio, close_session
from splatpainter.server.uploads.storage import PROJECT, StoredBlob, demo
from splatpainter.session import Session
from splatpainter.session.project.disk_probe import locks_refused
from splatpainter.session.project.scratch import scratch_folder
from splatpainter.splats import Splats

READ_SHARE = 0.3
"""Of opening an asset, its file's reading."""
MIN_FREE_BYTES = 64 << 20
"""That a disk has to have beside the project's own size: room for some hours of strokes."""


FolderKey = Literal["studio", "projects", "home", "temporary"]
"""Folders that a project can go on in: the watched one, that of unnamed projects, the user's, the system's."""


class BookmarkMade(Answer):
    bookmark: BookmarkInfo


class BookmarkAdd(Command):
    NAME = "bookmark.add"
    ANSWER = BookmarkMade
    name: Name
    camera: CameraInfo


@command(BookmarkAdd, writes=True)
def add_bookmark(context: CommandContext, request: BookmarkAdd) -> BookmarkMade:
    camera = request.camera.to_camera()
    id = context.studio.session.bookmarks.add(request.name, camera)
    info = BookmarkInfo(id=id, name=request.name, camera=CameraInfo.of(camera))
    line = python_line("session.bookmarks.add", request.name)[:-1] + ", camera)"
    return BookmarkMade(bookmark=info, python=line)


class BookmarkDelete(Command):
    NAME = "bookmark.delete"
    bookmark: str


@command(BookmarkDelete, writes=True)
def delete_bookmark(context: CommandContext, request: BookmarkDelete) -> Answer:
    context.studio.session.bookmarks.delete(request.bookmark)
    return Answer(python=python_line("session.bookmarks.delete", request.bookmark))


class AssetOpen(Command):
    """A new session. Exactly one of: a blob that was sent, a file of the studio's folder, the demo asset."""

    NAME = "asset.open"
    blob: Blob | None = None
    file: FileName | None = None
    demo: bool = False


@command(AssetOpen, writes=True, bound=False)
def open_asset(context: CommandContext, request: AssetOpen) -> Answer:
    # One asset replaces another for all windows, so it has to be clear which.
    studio = context.studio
    if (request.blob is not None) + (request.file is not None) + request.demo != 1:
        raise ValueError("asset: expected one of blob, file or demo")
    report = context.ticket.report
    report(0, "reading")
    name, path = "demo", None
    if request.blob is not None:
        blob = studio.blobs.get(request.blob, "asset")
        name, path = blob.name or f"asset{blob.info.ending}", blob.path
    elif request.file is not None:
        name, path = request.file, folder_file(studio, request.file)

    # A large asset takes a while at each of these; whoever cancels meanwhile has what was open before, and no new file.
    def make() -> Session:
        splats = demo() if path is None else _read_watched(path, report)
        report(READ_SHARE, "keeping it in a project")
        session = Session(splats, studio.projects.fresh(name))
        try:
            report(0.6, "preparing the view")
        except BaseException:
            close_session(session, studio.projects)
            raise
        return session

    # The new session is made by the studio, which keeps the old one if the file cannot be read.
    with contextlib.nullcontext() if path is None else naming_errors(path, name):
        studio.open(make, name)
    return Answer(python=python_line("session = sp.Session", name))


def _read_watched(path: Path, report: Callable[[float, str], None]) -> Splats:
    """The asset of a file; how much of it is read is said up to READ_SHARE."""
    size, done, mutex = max(path.stat().st_size, 1) if path.is_file() else 1, 0, threading.Lock()

    def note(count: int) -> None:
        nonlocal done
        with mutex:  # several threads read one file
            done += count
            share = min(done / size, 1)
        report(READ_SHARE * share, "reading")

    with files.watched(note):
        return read(path)


class AssetUp(Command):
    """Turn the asset on the screen; no Gaussian changes, and the project remembers it."""

    NAME = "asset.up"
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"]
    """World axis that is to point up."""


@command(AssetUp, writes=True)
def set_up_axis(context: CommandContext, request: AssetUp) -> Answer:
    context.studio.session.scene.set_up(request.up)
    return Answer(python=python_line("session.scene.set_up", request.up))


class AssetFront(Command):
    """The side that a view shows is the front from now on: the first view is from there. The project remembers it."""

    NAME = "asset.front"
    camera: CameraInfo


@command(AssetFront, writes=True)
def set_front(context: CommandContext, request: AssetFront) -> Answer:
    context.studio.session.scene.set_front(request.camera.to_camera())
    return Answer(python=python_line("session.scene.set_front", RawExpr("camera")))


class ProjectOpen(Command):
    """Exactly one of: a file of the studio's folder, an id of `project.recent`, a blob that was sent."""

    NAME = "project.open"
    file: FileName | None = None
    recent: str | None = None
    blob: Blob | None = None


@command(ProjectOpen, writes=True, bound=False)
def open_project(context: CommandContext, request: ProjectOpen) -> Answer:
    studio = context.studio
    # As with assets: exactly one place.
    if sum(source is not None for source in (request.blob, request.file, request.recent)) != 1:
        raise ValueError("project: expected one of file, recent or blob")
    context.ticket.report(0, "opening")
    # An upload has no place of its own yet; the others stay where they are.
    if request.blob is not None:
        blob = studio.blobs.get(request.blob, "project")
        name = Path(blob.name).stem or "project"
        studio.open(lambda: _open_upload(studio, blob, name), name)
        return Answer(python=python_line("session = sp.Session.load", f"{name}{PROJECT}"))
    # A project could name any file of this machine as its original; one of a stranger's must not.
    options: dict[str, Any] = {"embedded": True}
    if request.recent is not None:
        path = studio.projects.find(request.recent)
        name = studio.projects.name_of(path)
        if path == studio.named_project:
            options = {}
    else:
        path = folder_file(studio, request.file or "")
        name = path.stem
        assert studio.folder is not None
        options = {"folder": studio.folder.root}
    # One that is open already is not opened a second time.
    if studio.session.path is None or not files.is_same(path, studio.session.path):
        studio.open(lambda: Session.load(path, **options), name)
    return Answer(python=python_line("session = sp.Session.load", path.name))


class ProjectTakeOver(Command):
    """Go on in a project that is read only because it was open elsewhere, with the newest that was done in it there.
    Refused while somebody else has it open."""

    NAME = "project.take_over"
    despite_note: bool = False
    """Also where a note says that another computer has it open: its user knows that it is not."""


@command(ProjectTakeOver, writes=True)
def take_over(context: CommandContext, request: ProjectTakeOver) -> Answer:
    studio = context.studio
    with progress(context, "opening"):
        studio.session.files.take_over(despite_note=request.despite_note)
    if studio.session.note:
        studio.news = [studio.public(studio.session.note)]
    context.notice = f"{studio.name} can be edited now."
    options = {"despite_note": True} if request.despite_note else {}
    return Answer(python=python_line("session.files.take_over", **options))


def _open_upload(studio: Studio, blob: StoredBlob, name: str) -> Session:
    """A session on an uploaded project, which then lies in the studio's own folder. Only one that opens gets there."""
    title = blob.name or "the project"
    # Opened aside first: what cannot be read must not come to the user's projects.
    with scratch_folder("studio") as folder:
        copy = folder / f"upload{PROJECT}"
        try:
            shutil.copyfile(blob.path, copy)
        except OSError as error:
            raise ValueError(f"{title}: cannot be copied ({error.strerror or error})") from None
        with naming_errors(copy, title):
            session = Session.load(copy, embedded=True, readonly=False)
            try:
                session.files.save_as(studio.projects.fresh(name))
            except BaseException:
                session.close()
                raise
    return session


class ProjectSaveAs(Command):
    """Move the project to a file in the studio's folder; from then on it lives there."""

    NAME = "project.save_as"
    file: FileName
    overwrite: bool = False


@command(ProjectSaveAs, writes=True)
def save_as(context: CommandContext, request: ProjectSaveAs) -> Answer:
    studio = context.studio
    if studio.folder is None:
        raise ValueError("project: the studio was started without a folder; export it as a download instead")
    # The ending is added where it was left out: without it the project would not be found again.
    name = request.file if request.file.lower().endswith(PROJECT) else request.file + PROJECT
    path = studio.folder.file(name, new=True)
    before, is_there = studio.session.path, studio.session.files.is_in_place
    studio.session.files.save_as(path, overwrite=request.overwrite)
    # Only one that lived in the studio's own folder moves; any other place is the user's.
    if before is not None and before.parent == studio.projects.root and is_there:
        files.remove(before)  # it moved
    studio.name = path.stem
    studio.note_place(before)
    return Answer(python=python_line("session.files.save_as", name))


class ProjectMoved(Answer):
    folder: str
    """For people."""
    file: str


class FolderInfo(Message):
    """A folder of this machine that has room for the project."""

    key: FolderKey
    name: str
    """For people."""
    free: int
    """Bytes free on its disk."""


class RoomyFolders(Answer):
    folders: list[FolderInfo]
    """The most durable first; that in which the project is, and those that are full, are left out."""


class ProjectFolders(Command):
    """Where the project could go on if its disk is full."""

    NAME = "project.folders"
    ANSWER = RoomyFolders


@command(ProjectFolders)
def list_folders(context: CommandContext, request: ProjectFolders) -> RoomyFolders:
    roomy = _roomy_folders(context.studio)
    return RoomyFolders(folders=[FolderInfo(key=key, name=name, free=free) for key, (name, _, free) in roomy.items()])


class ProjectMove(Command):
    """Go on in another folder, under the same name. A project of the studio's own folder moves; others stay as they
    are."""

    NAME = "project.move"
    ANSWER = ProjectMoved
    folder: FolderKey


@command(ProjectMove, writes=True)
def move_project(context: CommandContext, request: ProjectMove) -> ProjectMoved:
    studio = context.studio
    # The list was made a while ago; the disk may have filled since.
    roomy = _roomy_folders(studio)
    if request.folder not in roomy:
        raise ValueError("project: that folder has no room for it any more; choose another one")
    name, folder, _ = roomy[request.folder]
    before, is_there = studio.session.path, studio.session.files.is_in_place
    file = before.name if before is not None else studio.projects.fresh(studio.name).name
    studio.session.files.save_as(folder / file)
    studio.note_place(before)
    # The old file goes only when the new one is written.
    if before is not None and before.parent == studio.projects.root and is_there:
        with contextlib.suppress(OSError):  # the disk that refuses to be written
            files.remove(before)
    return ProjectMoved(folder=name, file=file, python=python_line("session.files.save_as", file))


def _roomy_folders(studio: Studio) -> dict[FolderKey, tuple[str, Path, int]]:
    """Key -> (name for people, folder, free bytes) of where the project would fit, the most durable first."""
    path = studio.session.path
    size = 0 if path is None or not path.exists() else path.stat().st_size  # another program may have deleted it
    named: dict[FolderKey, tuple[str, Path]] = {
        "projects": ("the studio's own folder", studio.projects.root),
        "home": ("the home folder", Path.home()),
        "temporary": ("the temporary folder, which the system empties", Path(tempfile.gettempdir())),
    }
    if studio.folder is not None:
        named = {"studio": (f"the folder {studio.folder.root.name}", studio.folder.root), **named}
    out: dict[FolderKey, tuple[str, Path, int]] = {}
    # Room, rights and locks: a project needs all three to be saved.
    for key, (name, folder) in named.items():
        with contextlib.suppress(OSError):
            free = shutil.disk_usage(folder).free
            is_here = path is not None and files.is_same(folder, path.parent)
            roomy = not is_here and free > size + MIN_FREE_BYTES and os.access(folder, os.W_OK)
            if roomy and not locks_refused(folder):
                out[key] = (name, folder, free)
    return out


class ProjectDownload(Command):
    """A copy of the project, whole, to download."""

    NAME = "project.download"
    ANSWER = Exported


@command(ProjectDownload, bound=True)
def download_project(context: CommandContext, request: ProjectDownload) -> Exported:
    studio = context.studio
    # A name of plain words, for it becomes a file on the user's disk.
    path = studio.downloads.folder() / f"{Path(studio.state.project.name).stem or 'project'}{PROJECT}"
    studio.session.files.save_copy(path)
    url = studio.downloads.add(path)
    return Exported(
        url=url, file=path.name, bytes=path.stat().st_size, python=python_line("session.files.save_copy", path.name)
    )


class RecentProjects(Answer):
    recent: list[RecentInfo]
    """Latest edit first."""
    files: list[str]
    """Assets and projects in the studio's folder."""


class ProjectRecent(Command):
    NAME = "project.recent"
    ANSWER = RecentProjects


@command(ProjectRecent, writes=True, bound=False)
def recent_projects(context: CommandContext, request: ProjectRecent) -> RecentProjects:
    studio = context.studio
    # Lists show the present project too, so it gets its picture now.
    studio.draw_picture(listed=True)
    recent = [studio.recent_info(project) for project in studio.projects.recent(studio.session.path)]
    return RecentProjects(recent=recent, files=[] if studio.folder is None else studio.folder.names())


class ReceiptMade(Answer):
    receipt: dict[str, Any]
    """Receipt of the whole session: original against now."""
    text: str
    """One line for people."""


class ReceiptShow(Command):
    NAME = "receipt"
    ANSWER = ReceiptMade


@command(ReceiptShow, background=True)
def show_receipt(context: CommandContext, request: ReceiptShow) -> ReceiptMade:
    receipt = context.studio.session.files.receipt()
    # The proof in one line; the receipt itself is for programs.
    appended = f", {receipt.appended_rows:,} appended" if receipt.appended_rows else ""
    text = f"{receipt.untouched_rows:,} of {receipt.asset_rows:,} Gaussians byte-identical{appended}"
    return ReceiptMade(receipt=json.loads(receipt.to_json()), text=text, python="session.files.receipt()")


class Verified(Answer):
    proved: bool
    gaussians: int
    same: int
    changed: int
    appended: int
    problems: list[str]
    exact: str
    """How they were compared."""


class AssetVerify(Command):
    """Write the asset, read it again, and compare every Gaussian with the original."""

    NAME = "verify"
    ANSWER = Verified


@command(AssetVerify, background=True, bound=True)
def verify_asset(context: CommandContext, request: AssetVerify) -> Verified:
    session = context.studio.session
    source = session.opened.source
    # In the asset's own format where that can be written, so that bytes can be compared with bytes.
    entry = None if source is None else FORMATS.get(source.format)
    ending = ".ply" if entry is None or entry.write is None or not entry.suffixes else entry.suffixes[0]
    context.ticket.report(0, "writing and reading again")
    # Written and read again: the proof is of a file and not of what is in memory.
    with scratch_folder("verify") as folder:
        _, proof = session.files.export(folder / f"asset{ending}")
    # Replayed as well: stored results must be what the layers say.
    context.ticket.report(0.5, "replaying the layers")
    problems = [*proof.problems, *session.verify()]
    return Verified(
        proved=not problems,
        gaussians=proof.rows,
        same=proof.same,
        changed=proof.changed,
        appended=proof.appended,
        problems=problems,
        exact=proof.exact,
        python="session.verify()",
    )


def folder_file(studio: Studio, name: str) -> Path:
    if studio.folder is None:
        raise ValueError(f"{name}: the studio was started without a folder; drop the file into the page instead")
    return studio.folder.file(name)
