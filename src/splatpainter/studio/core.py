"""The studio without HTTP: one open session, what was uploaded, the folders, and the state that clients are told.

`open`, `refresh` and everything that changes the session run on the queue's one writer thread; `state`, `session.shown`
and blobs may be read from anywhere.
"""

from __future__ import annotations

import contextlib
import secrets
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.session import Session
from splatpainter.splats import Splats
from splatpainter.studio import describe
from splatpainter.studio.blobs import Blobs, Limits
from splatpainter.studio.messages.state import ProjectInfo, State
from splatpainter.studio.places import Downloads, Folder, Projects
from splatpainter.user_folders import projects_folder

EXPORTS = 64
"""Exported views that a returning picture is compared with."""


@dataclass(frozen=True)
class Options:
    """How a studio runs."""

    folder: Path | None = None
    """The one folder whose files clients may open and write, and which is watched for saved pictures."""
    projects: Path | None = None
    """Where projects live that have no place of their own; None: the user's data folder."""
    limits: Limits = field(default_factory=Limits)


@dataclass(frozen=True)
class ExportedView:
    """A view that was given out to be edited elsewhere."""

    name: str
    camera: Camera
    small: np.ndarray = field(repr=False)
    """[S, S, 3] float32 what it looked like, shrunk."""


class Studio:
    """One session at a time; another asset or project replaces it for all clients."""

    def __init__(self, session: Session, name: str = "asset", options: Options = Options()) -> None:
        """The session is the studio's from now on: closing the studio closes it."""
        self.options = options
        self.folder = None if options.folder is None else Folder(options.folder)
        self.projects = Projects(options.projects or projects_folder())
        self.blobs = Blobs(options.limits)
        self._scratch = tempfile.TemporaryDirectory(
            prefix="splatpainter-studio-", ignore_cleanup_errors=True
        )  # Windows keeps files that are being sent
        self.downloads = Downloads(Path(self._scratch.name))
        self.exports: deque[ExportedView] = deque(maxlen=EXPORTS)
        self.written: dict[str, str] = {}
        """Pictures that the studio itself wrote into the folder: name -> sha256, to be told from saved ones."""
        self._adopt(session, name)

    @property
    def original(self) -> Splats:
        return self.session.original

    def open(self, make: Callable[[], Session], name: str) -> None:
        """Close the session and go on with another. Where `make` raises, everything stays as it was."""
        fresh = make()
        old = self.session
        self._adopt(fresh, name)
        self.exports.clear()
        _leave(old, self.projects)

    def _adopt(self, session: Session, name: str) -> None:
        self.session, self.session_id, self.name = session, secrets.token_hex(8), name
        self._asset = describe.asset_info(session, name)
        self._lists = describe.Lists()
        self._counted = 0
        self.refresh()

    def refresh(self) -> None:
        """Describe the session anew; cheap where the rows are the same."""
        session, shown = self.session, self.session.shown
        if self._counted != shown.version:
            self._asset = describe.counted(self._asset, session.original, shown.splats)
            self._counted = shown.version
        self.state = State(
            session=self.session_id,
            version=shown.version,
            asset=self._asset,
            layers=[describe.layer_info(session, layer) for layer in session.layers],
            history=self._lists.history(session),
            cursor=session.cursor,
            conflicts=describe.conflict_infos(session),
            bookmarks=self._lists.bookmarks(session),
            project=self._project(),
            methods=describe.methods(session),
            folder=None if self.folder is None else self.folder.root.name,
            clients=0,
            formats=describe.endings(),
        )

    def _project(self) -> ProjectInfo:
        path = self.session.path
        inside = path is not None and self.folder is not None and path.resolve().parent == self.folder.root
        name = self.name if path is None or not inside else path.stem
        file = path.name if path is not None and inside else None
        return ProjectInfo(name=name, file=file, read_only=bool(self.session.read_only))

    def picture_bytes(self, sha256: str) -> tuple[bytes, str]:
        """(bytes, content type) of a picture that was sent or made, or that a layer holds. Raises ValueError."""
        with contextlib.suppress(ValueError):
            blob = self.blobs.get(sha256)
            return blob.path.read_bytes(), blob.claim.media
        with contextlib.suppress(ValueError):
            return self.session.blob(sha256), "image/png"
        raise ValueError(f"blob {sha256[:12]}...: not here (any more)")

    def close(self) -> None:
        """Leave nothing but the project file."""
        _leave(self.session, self.projects)
        self.blobs.close()
        self._scratch.cleanup()


def _leave(session: Session, projects: Projects) -> None:
    """Close a session; a project of the studio's own folder in which nothing was done is not kept."""
    path = session.path
    unused = path is not None and path.parent == projects.root and not session.read_only
    unused = unused and len(session.history) == 1 and not session.bookmarks()
    session.close()
    if unused and path is not None:
        files.remove(path)
