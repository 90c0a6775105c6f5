"""Where the studio reads and writes: the one folder given at start, its own projects, downloads, and uploads.

Names from clients are plain file names, looked up in these folders; what they resolve to must lie inside. Uploads are
known by their hash, in a folder of their own that goes with the studio: bounded, the oldest out first; what comes in is
written as it comes, stopped where it is too long, and judged (upload_sniffing.py) before anything decodes it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import secrets
import stat
import tempfile
import threading
import time
from collections import OrderedDict
from dataclasses import field
from pathlib import Path, PurePosixPath

from splatpainter import demo_asset
from splatpainter.io import files, format_of_name, read, write
from splatpainter.io.axes import flip
from splatpainter.server.uploads.upload_sniffing import UploadInfo, sniff
from splatpainter.session.project.disk_probe import NO_LOCKS, locks_refused
from splatpainter.session.project.project_summary import ProjectSummary, summarize
from splatpainter.session.project.scratch import ScratchFolder
from splatpainter.splats import Splats
from splatpainter.system.atomic import MAX_NAME_BYTES
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.user_folders import PROJECTS_VARIABLE, cache_folder, projects_folder

PROJECT = ".splatproj"
FRESH_NAME = re.compile(r"_\d{8}-\d{6}-[0-9a-f]{4}$")
"""What Projects.fresh adds to an asset's name: no two projects meet."""
MAX_ELSEWHERE = 64
"""Projects of other folders that are remembered while the studio runs."""
MAX_SUMMARIES = 512
"""Most summaries of project files, in memory."""
MAX_DOWNLOADS = 16
"""Exported files that are kept for their download."""
PROBE_BYTES = 1 << 20
"""Room that a folder of projects has to have when the studio starts."""
DEMO_FLIP = (-1, -1, 1)
"""The bundled asset is made with y up; the studio shows the axes of captures, y down."""


class Folder:
    """A folder whose files clients may name."""

    def __init__(self, root: Path) -> None:
        """Raises ValueError where it is no folder."""
        if not root.is_dir():
            raise ValueError(f"{root}: no such folder; make it first, or give another --folder")
        self.root = root.resolve()

    def file(self, name: str, *, new: bool = False) -> Path:
        """The file of that name. Raises ValueError: no plain name, hidden, outside (a link), missing."""
        # A plain name and nothing else: no folders, no hidden files, no drives or streams of Windows.
        if not name or name.startswith(".") or Path(name).name != name or re.search(r"[/\\:\x00-\x1f]", name):
            raise ValueError(f"{name!r}: expected a plain file name")
        if len(name.encode(errors="surrogatepass")) > MAX_NAME_BYTES:
            raise ValueError(f"{brief(name)}: expected a file name of at most {MAX_NAME_BYTES} bytes")
        # Resolved first: a link could lead anywhere.
        try:
            path = (self.root / name).resolve()
        except (OSError, RuntimeError):  # a circle of links
            raise ValueError(f"{name}: is a broken link") from None
        if path.parent != self.root:
            raise ValueError(f"{name}: lies outside the studio's folder")
        if not new and not path.is_file():
            raise ValueError(f"{name}: no such file in the studio's folder {self.root.name}")
        return path

    def within(self, name: str, *, new: bool = False) -> Path:
        """The file of a name in it, or in folders in it ("final/a.png", as of SavedPictures.name_of). Raises ValueError
        as `file`."""
        folder, _, last = name.rpartition("/")
        if not folder:
            return self.file(name, new=new)
        parts = PurePosixPath(folder).parts
        if any(part.startswith((".", "/")) or re.search(r"[\\:\x00-\x1f]", part) for part in parts):
            raise ValueError(f"{name!r}: expected the name of a file in the studio's folder")
        # A folder like this one: its files are judged alike, and no link leads out of it.
        inner = self.root.joinpath(*parts)
        if inner.resolve() != inner or not inner.is_dir():
            raise ValueError(f"{name}: lies outside the studio's folder")
        return Folder(inner).file(last, new=new)

    def names(self) -> list[str]:
        """Assets and projects in it, by name."""
        names = [entry.name for entry in os.scandir(self.root) if entry.is_file() and not entry.name.startswith(".")]
        names = [name for name in names if name.isprintable()]  # others are no text that could be sent
        return sorted(name for name in names if name.lower().endswith(PROJECT) or format_of_name(Path(name)))


@dataclass(frozen=True)
class RecentProject:
    """A project in the studio's own folder."""

    id: str
    name: str
    path: Path
    changed: float
    """When it was last edited, seconds since 1970."""
    summary: ProjectSummary | None
    """None where it cannot be read without being opened for writing (a damaged one, or of version 1)."""


class Summaries:
    """Summaries of project files, read anew when a file has changed. May be used from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cache: OrderedDict[Path, tuple[object, ProjectSummary | None]] = OrderedDict()

    def get(self, path: Path) -> ProjectSummary | None:
        # The log beside the file too: edits may be in it alone for a while.
        key = tuple(_stamp(path.with_name(path.name + ending)) for ending in ("", "-wal"))
        with self._lock:
            entry = self._cache.get(path)
        if entry is None or entry[0] != key:
            # Outside of the lock: reading a file must not hold up other threads.
            entry = key, summarize(path)
        with self._lock:
            self._cache[path] = entry
            self._cache.move_to_end(path)
            while len(self._cache) > MAX_SUMMARIES:
                self._cache.popitem(last=False)
        return entry[1]


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


def project_id(path: Path, by_chance: str) -> str:
    """Name by which clients know a project: its file's, with what it has by chance where that name is not unique by
    itself. by_chance: ProjectSummary.id."""
    return path.stem if not by_chance or FRESH_NAME.search(path.stem) else f"{path.stem}~{by_chance}"


class Projects:
    """Projects that nobody has saved elsewhere yet: everything is always saved, wherever it is."""

    def __init__(self, root: Path) -> None:
        """Raises ValueError where it cannot be made."""
        # Made at once, so that a studio that cannot save says so when it starts.
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"{root}: cannot be made ({error.strerror or error})") from None
        self.root = root
        self.summaries = Summaries()
        self._elsewhere: dict[Path, None] = {}
        """Projects of other folders that were open, the latest last."""

    def note(self, path: Path) -> None:
        """A project is open: one can go back to it, wherever it is."""
        if path.parent == self.root:
            return
        self._elsewhere.pop(path, None)
        self._elsewhere[path] = None
        while len(self._elsewhere) > MAX_ELSEWHERE:
            del self._elsewhere[next(iter(self._elsewhere))]

    def fresh(self, name: str) -> Path:
        """A file name for a new project about something called `name`."""
        # Words of the asset's name, for people; time and chance, so that no two projects meet.
        stem = re.sub(r"[^\w-]+", "-", Path(name).name.split(".")[0]).strip("-")[:40] or "asset"
        stamp = time.strftime("%Y%m%d-%H%M%S")
        return self.root / f"{stem}_{stamp}-{secrets.token_hex(2)}{PROJECT}"

    def forget(self, path: Path) -> None:
        """A project lies elsewhere from now on."""
        self._elsewhere.pop(path, None)

    def recent(self, present: Path | None = None) -> list[RecentProject]:
        """Latest edit first. Of copies the latest; projects in which nothing was done are left out, but for the
        present one."""
        out = []
        for path in self._paths():
            # Every opened asset has a project at once; those that nobody worked in are not worth a line.
            summary = self.summaries.get(path)
            if summary is not None and summary.is_untouched and path != present:
                continue
            changed = path.stat().st_mtime if summary is None else summary.edited
            out.append(RecentProject(self._id(path), self.name_of(path), path, changed, summary))
        out.sort(key=lambda project: -project.changed)
        # Copies hold the same work; the latest stands for all.
        contents: set[str] = set()
        latest = []
        for project in out:
            content = project.id if project.summary is None else project.summary.content
            if content not in contents:
                latest.append(project)
            contents.add(content)
        return latest

    def of_original(self, sha256: str, *, without: Path | None = None) -> list[RecentProject]:
        """Those with layers over one original, latest edit first. without: the one that is open."""
        return [
            project
            for project in self.recent()
            if project.path != without
            and project.summary is not None
            and project.summary.original_sha256 == sha256
            and project.summary.layers
        ]

    def name_of(self, path: Path) -> str:
        """What a project is called: of one of this folder, without what `fresh` adds."""
        return path.stem.rsplit("_", 1)[0] if path.parent == self.root else path.stem

    def find(self, id: str) -> Path:
        """Raises ValueError for an unknown one."""
        for path in self._paths():
            if self._id(path) == id:
                return path
        raise ValueError(f"project {brief(id)}: no longer among the recent ones")

    def _id(self, path: Path) -> str:
        if FRESH_NAME.search(path.stem):  # known without a look into the file
            return path.stem
        summary = self.summaries.get(path)
        return project_id(path, "" if summary is None else summary.id)

    def _paths(self) -> list[Path]:
        paths = [*self._elsewhere, *self.root.glob(f"*{PROJECT}")]
        return [path for path in paths if not path.name.startswith(".") and path.is_file()]


def usable_projects(named: Path | None = None) -> tuple[Path, str]:
    """(folder of new projects, a line on why it is not the user's data folder; "" where it is). named: that one and no
    other. Raises ValueError where none can be used: it cannot be made or written, its disk is full, or its file system
    refuses file locks."""
    # Looked at before the first edit: a folder that cannot hold projects would lose it.
    root = named or projects_folder()
    why = _why_unusable(root)
    if not why:
        return root, ""
    what_helps = f"set {PROJECTS_VARIABLE} to a folder on a local disk"
    # A folder that was named is taken or refused; only the usual one has a substitute.
    if named is None and not os.environ.get(PROJECTS_VARIABLE):
        other = _temporary_projects()
        if other is not None and not _why_unusable(other):
            what_helps = f"{what_helps}, or save them under a name"
            return other, f"{root}: {why}; new projects are in {other}, which the system may empty: {what_helps}"
    raise ValueError(f"{root}: projects cannot be saved here ({why}); {what_helps}")


def _why_unusable(root: Path) -> str:
    """Why projects cannot be saved in a folder, which is made where it is missing; "" where they can."""
    # Tried by writing: what a system says of room and rights is not always so.
    probe = root / f".room.{secrets.token_hex(4)}.part"  # a name that the sweep knows
    try:
        root.mkdir(parents=True, exist_ok=True)
        with open(probe, "wb") as file:
            file.write(bytes(PROBE_BYTES))
    except OSError as error:
        return error.strerror or str(error)
    finally:
        files.remove(probe)
    return NO_LOCKS if locks_refused(root) else ""


def _temporary_projects() -> Path | None:
    """A folder of this user alone among the system's temporary ones, the same each time; None where there is none."""
    # Others of this machine can write to the temporary folder, so it must be this user's and closed to the rest.
    user = getattr(os, "getuid", lambda: "")()  # Windows: its temporary folder is the user's own
    path = Path(tempfile.gettempdir()) / f"splatpainter-projects{user}"
    with contextlib.suppress(OSError):
        path.mkdir(mode=0o700, exist_ok=True)
        status = path.lstat()
        foreign = user != "" and (status.st_uid != user or stat.S_IMODE(status.st_mode) & 0o077)
        return path if stat.S_ISDIR(status.st_mode) and not foreign else Path(tempfile.mkdtemp(prefix=path.name))
    return None


@dataclass
class Downloads:
    """Files made for a download, by a secret key. May be used from several threads."""

    root: Path
    _files: dict[str, Path] = field(default_factory=dict)
    """The latest last."""
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def folder(self) -> Path:
        """A new folder for one export."""
        folder = self.root / secrets.token_hex(8)
        folder.mkdir(parents=True)
        return folder

    def add(self, path: Path) -> str:
        """The address to download it from; the oldest goes where there are too many."""
        key = secrets.token_urlsafe(16)
        # Exports are large, and most are fetched once and at once.
        with self._lock:
            self._files[key] = path
            gone = [self._files.pop(oldest) for oldest in [*self._files][:-MAX_DOWNLOADS]]
        for oldest in gone:
            files.remove(oldest)  # Windows: not while it is sent
        return f"/api/files/{key}/{path.name}"

    def find(self, key: str, name: str) -> Path:
        """Raises ValueError for an unknown one."""
        path = self._files.get(key)
        if path is None or path.name != name or not path.is_file():
            raise ValueError("download: no longer available; export it again")
        return path


class TooLarge(ValueError):
    """More bytes than a limit allows."""


@dataclass(frozen=True)
class UploadLimits:
    """Limits of what one studio takes in."""

    upload: int = 2 << 30
    """Bytes of one upload."""
    picture: int = 256 << 20
    """Bytes of one picture."""
    total: int = 4 << 30
    """Bytes kept; beyond that the oldest go. No more than that may be on their way in either."""
    gaussians: int = 20_000_000
    """Most Gaussians that an uploaded asset may claim."""


@dataclass(frozen=True)
class StoredBlob:
    """One upload, or one thing that the studio made."""

    sha256: str
    path: Path
    name: str
    """What its owner called it, for messages only; it never becomes a path."""
    size: int
    info: UploadInfo


class Blobs:
    """A store; may be used from several threads."""

    def __init__(self, limits: UploadLimits = UploadLimits()) -> None:
        self.limits = limits
        self._scratch = ScratchFolder("blobs")
        self.folder = self._scratch.path
        self._lock = threading.Lock()
        self._blobs: OrderedDict[str, StoredBlob] = OrderedDict()
        self._incoming = 0
        """Bytes of uploads that have not ended."""

    def receive(self, name: str = "") -> Incoming:
        """A thing to be written piece by piece. Raises ValueError where nothing can be written."""
        return Incoming(self, name)

    def put(self, data: bytes, name: str = "") -> StoredBlob:
        """Store bytes. Raises ValueError as Incoming."""
        with self.receive(name) as incoming:
            incoming.write(data)
            return incoming.finish()

    def get(self, sha256: str, kind: str | None = None) -> StoredBlob:
        """What was put; a sky is a picture, too. Raises ValueError where it is not (or no longer) here, or of another
        kind."""
        with self._lock:
            # Taken again is used again: the oldest to go is the one that nobody asks for.
            blob = self._blobs.get(sha256)
            if blob is not None:
                self._blobs.move_to_end(sha256)
        if blob is None:
            raise ValueError(f"blob {sha256[:12]}...: no longer available; send it again to /api/blobs")
        if kind is not None and blob.info.kind != kind and not (kind == "picture" and blob.info.kind == "sky"):
            raise ValueError(f"{blob.name or 'blob'}: expected {_article(kind)}, got {_article(blob.info.kind)}")
        return blob

    def name_of(self, sha256: str) -> str:
        """What its owner called it; "" for none, or one that is not here."""
        with self._lock:
            blob = self._blobs.get(sha256)
        return "" if blob is None else blob.name

    @property
    def size(self) -> int:
        """Bytes kept."""
        with self._lock:
            return sum(blob.size for blob in self._blobs.values())

    def close(self) -> None:
        """Remove everything."""
        with self._lock:
            self._blobs.clear()
        self._scratch.close()

    def _partial(self) -> Path:
        return self.folder / f"{secrets.token_hex(8)}.part"

    def _count_incoming(self, count: int, name: str) -> None:
        """Count bytes on their way in (negative: they have ended). Raises TooLarge where there are too many."""
        # Together, too: many uploads at a time would pass a limit for each.
        with self._lock:
            if count > 0 and self._incoming + count > self.limits.total:
                raise TooLarge(f"{name}: expected at most {self.limits.total >> 20} MiB of uploads at a time")
            self._incoming += count

    def _add(self, partial: Path, sha256: str, name: str, size: int) -> StoredBlob:
        # Judged from its header and on the disk: nothing is decoded before that.
        try:
            info = sniff(partial, name, self.limits.gaussians)
        except ValueError as error:
            raise ValueError(str(error).replace(str(partial), name or "the upload")) from None
        if info.kind == "picture" and size > self.limits.picture:
            raise TooLarge(f"{name or 'picture'}: expected at most {self.limits.picture >> 20} MiB, got {size >> 20}")
        # The name on the disk is the hash and an ending of ours; what its owner calls it stays a word.
        blob = StoredBlob(sha256, self.folder / (sha256 + info.ending), name, size, info)
        # In one step with the list, so that no other thread removes it in between.
        with self._lock:
            if not blob.path.exists():  # the same bytes; and Windows replaces no file that is being read
                files.replace(partial, blob.path)
            self._blobs[sha256] = blob
            self._blobs.move_to_end(sha256)
            total = sum(blob.size for blob in self._blobs.values())
            # The newest stays, even where it is larger than all that may be kept.
            while total > self.limits.total and len(self._blobs) > 1:
                _, oldest = self._blobs.popitem(last=False)
                total -= oldest.size
                files.remove(oldest.path)
        return blob


def _article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


class Incoming:
    """Bytes on their way in; leaving the block without `finish` drops them."""

    def __init__(self, store: Blobs, name: str) -> None:
        # The name is only shown, so it is cut and made text.
        self._store, self._name = store, name[:200].encode("utf-8", "replace").decode()
        self._partial = store._partial()
        self._digest, self._size = hashlib.sha256(), 0
        try:
            self._file = open(self._partial, "wb")
        except OSError as error:
            raise self._unwritable(error) from None

    def __enter__(self) -> Incoming:
        return self

    # Whatever ended the block, nothing of it stays: neither the file nor its share of the limit.
    def __exit__(self, *_: object) -> None:
        try:
            self._file.close()
        except OSError:
            pass  # a full disk: what was written is dropped
        files.remove(self._partial)
        self._store._count_incoming(-self._size, self._name)
        self._size = 0

    def write(self, piece: bytes) -> None:
        """Raises TooLarge where it gets too long, ValueError where the disk is full."""
        limit = self._store.limits.upload
        # Before it is written: a header may have stated another length.
        if self._size + len(piece) > limit:
            raise TooLarge(f"{self._name or 'upload'}: expected at most {limit >> 20} MiB; use a file in the folder")
        self._store._count_incoming(len(piece), self._name or "uploads")
        self._size += len(piece)
        # Hashed while it passes, so that the file need not be read again.
        self._digest.update(piece)
        try:
            self._file.write(piece)
        except OSError as error:
            raise self._unwritable(error) from None

    def finish(self) -> StoredBlob:
        """Judge and store. Raises ValueError: empty, or nothing that the studio can use."""
        if not self._size:
            raise ValueError(f"{self._name or 'upload'}: is empty")
        try:
            # Closed first: a full disk may only show then.
            self._file.close()
            return self._store._add(self._partial, self._digest.hexdigest(), self._name, self._size)
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> ValueError:
        return ValueError(f"{self._name or 'upload'}: cannot be kept ({error.strerror or 'disk error'})")


def demo(cache: Path | None = None) -> Splats:
    """The bundled still life, kept as a PLY in `cache` (None: the user's cache folder) under the hash of the file that
    it was unpacked from."""
    # By the hash of the bundled file: another version unpacks its own.
    path = (cache or cache_folder()) / f"demo-{_demo_hash()}.ply"
    with contextlib.suppress(ValueError):  # not there yet, or damaged: it is unpacked anew
        return read(path)
    asset = flip(demo_asset.demo_asset(), DEMO_FLIP)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, asset, overwrite=True)
        return read(path)
    except (OSError, ValueError):
        return asset  # nowhere to keep it


def _demo_hash() -> str:
    return hashlib.sha256(demo_asset.FILE.read_bytes()).hexdigest()[:16]
