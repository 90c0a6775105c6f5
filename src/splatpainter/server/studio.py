"""The studio without HTTP: one open session, what was uploaded, the folders, and the state that clients get.

`open`, `refresh` and everything that changes the session run on the queue's one writer thread; `state`,
`session.snapshot` and blobs may be read from anywhere.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.kernels.parallel import alone
from splatpainter.pictures.view_search import NamedView
from splatpainter.server import describe
from splatpainter.server.batches.batch_runs import Batches
from splatpainter.server.current_selection import CurrentSelection
from splatpainter.server.held_layers import HeldLayers, show_left_behind
from splatpainter.server.protocol import (
    AssetInfo,
    Problem,
    ProjectInfo,
    RecentInfo,
    SceneAssetInfo,
    SelectionInfo,
    State,
    first_fault,
)
from splatpainter.server.public_text import public_text
from splatpainter.server.strokes.stroke import Stroke
from splatpainter.server.uploads.storage import (
    Blobs,
    Downloads,
    Folder,
    Projects,
    RecentProject,
    UploadLimits,
    project_id,
)
from splatpainter.session import Session
from splatpainter.session.document.layer_factory import thumbnail
from splatpainter.session.project.scratch import ScratchFolder, sweep_folder, sweep_scratch
from splatpainter.splats import Splats
from splatpainter.system.latest import Latest
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent
from splatpainter.system.user_folders import projects_folder

MAX_EARLIER = 3
"""Projects over the same original that are offered."""
MAX_SOURCED_PICTURES = 64
"""The latest ones of sources, whose makers are remembered until they are painted with."""
MAX_EXPORTED_VIEWS = 64
"""The latest ones, which a returning picture is compared with."""


@dataclass(frozen=True)
class StudioOptions:
    """How a studio runs."""

    folder: Path | None = None
    """The one folder whose files clients may open and write, and which is watched for saved pictures."""
    projects: Path | None = None
    """Where new projects are saved; None: the user's data folder."""
    limits: UploadLimits = field(default_factory=UploadLimits)
    note: str = ""
    """A line about `projects`, which is shown to who opens the page."""


class Studio:
    """One session at a time; another asset or project replaces it for all clients."""

    def __init__(self, session: Session, name: str = "asset", options: StudioOptions = StudioOptions()) -> None:
        """The session is the studio's from now on: closing the studio closes it. What a studio that was killed left
        behind is removed."""
        self.options = options
        self.named_project = session.path
        """That the studio was started with: its user may name any file as its original."""
        self.folder = None if options.folder is None else Folder(options.folder)
        self.projects = Projects(options.projects or projects_folder())
        # Before anything of this studio's is made: what a killed one left behind is no longer anybody's.
        sweep_scratch()
        folders = {self.projects.root, self.folder and self.folder.root, session.path and session.path.parent}
        for folder in folders - {None}:
            sweep_folder(folder)
        self.blobs = Blobs(options.limits)
        self.scratch = ScratchFolder("studio")
        self.downloads = Downloads(self.scratch.path)
        self.batches = Batches(self.scratch.path)
        self._scene: tuple[Any, list[SceneAssetInfo]] | None = None
        self._preparing: threading.Thread | None = None
        self._is_closed = False
        self._looked: tuple[Session | None, bool, str] = (None, False, "")
        """Of which session it was seen whether its project could be taken over, and whose note says that it cannot."""
        # A project that has a picture of this version needs no other.
        self._drawn: int | None = None
        """Version of the session of which its project has a picture; None: it has none."""
        self.exports = Latest[NamedView](MAX_EXPORTED_VIEWS)
        # The latest ones only: a picture may be kept for a long time and never be painted with.
        self._sourced = Recent[dict[str, Any]](MAX_SOURCED_PICTURES)
        """Pictures that a source made: sha256 -> what receipts say of it."""
        self.news: list[str] = []
        """What was found of a project that was closed, opened or taken over, for people."""
        self.held_layers = HeldLayers()
        self.last_note = ""
        """What was found when the last project was closed: another program had replaced or deleted its file."""
        self.written: dict[str, str] = {}
        """Pictures that the studio itself wrote into the folder: name -> sha256, to be told from saved ones."""
        # The folders exist by now, so a session that cannot be described has to leave none of them behind.
        try:
            self._adopt(session, name)
        except BaseException:
            self.blobs.close()
            self.scratch.close()
            raise

    @property
    def original(self) -> Splats:
        return self.session.original

    def open(self, make: Callable[[], Session], name: str) -> None:
        """Close the session and go on with another. Where `make` raises, or what it made cannot be described to
        clients, everything stays as it was."""
        # Made while the old session is still whole: a file that cannot be read must change nothing.
        fresh = make()
        old = self.session
        # Drawn before the old session goes, for lists of recent projects.
        self.held_layers.show(old)
        self.draw_picture()
        try:
            self._adopt(fresh, name)
        except BaseException:
            fresh.close()
            raise
        self.exports.clear()
        before = old.note
        # Closing may find something out about the old project; only what is new is said to people.
        close_session(old, self.projects)
        self.news = [self.public(note) for note in (old.note if old.note != before else "", fresh.note) if note]

    def note_place(self, former: Path | None = None) -> None:
        """Remember where the project is: one can go back to it from another one. former: where it was until now."""
        path = self.session.path
        # Those of the studio's folder are known by their files.
        if path is not None and (self.folder is None or path.resolve().parent != self.folder.root):
            self.projects.note(path)
        if former is not None and former != path:
            self.projects.forget(former)

    def take_news(self) -> list[str]:
        """The `news`, which are none afterwards."""
        news, self.news = self.news, []
        return news

    def prepare_edit(self, camera: Camera, stroke: Stroke | None = None) -> None:
        """Make what the next local edit, in this view, needs in a thread of its own, unless one is at it; `close` waits
        for it. stroke: whose edit it will be, where it is one's; of several assets its edit is made of other arrays."""
        # One at a time: preparing only saves time, and an edit does without it as well.
        if self._preparing is not None and self._preparing.is_alive():
            return
        surface, alone_there = self.session.surface, len(self.session.scene.assets) == 1

        def work() -> None:
            surface.prepare(camera)
            if stroke is not None and alone_there:
                stroke.copy_ahead()

        self._preparing = threading.Thread(target=work, name="studio-prepare", daemon=True)
        self._preparing.start()

    def look_under(self, stroke: Stroke) -> None:
        """Estimate the surface under a stroke in a thread of its own while the stroke is drawn, unless one is at it;
        `close` waits for it. Not of several assets: each has its surface, which the edit asks when the stroke was cut
        to it."""
        # Most patches bring too little that is new, a text comes as one: no thread is begun for nothing.
        if not stroke.has_grown or len(self.session.scene.assets) > 1:
            return
        if self._preparing is not None and self._preparing.is_alive():
            return
        surface = self.session.surface.estimate

        def work() -> None:
            # On one CPU: the other one is for the next preview.
            with alone():
                while stroke.look(surface):
                    pass

        self._preparing = threading.Thread(target=work, name="studio-prepare", daemon=True)
        self._preparing.start()

    def _adopt(self, session: Session, name: str) -> None:
        show_left_behind(session)
        # All is made aside and put in place at the end, so that readers on other threads never see half of it.
        session_id, lists, snapshot = secrets.token_hex(8), describe.Lists(), session.snapshot
        selection = CurrentSelection(session)
        selection.note()
        # Only while nothing was done in it: then earlier work on the same original may be what is looked for.
        self._earlier = [] if len(snapshot.history) > 1 else self._earlier_of(session)
        # Values of a damaged project show here, where its old session is still the studio's.
        with _one_line_errors(name):
            asset = describe.counted(describe.asset_info(session, name), session.original, snapshot.splats)
            state = self._state_of(session, session_id, name, asset, lists, selection)
        self.session, self.session_id, self.name = session, session_id, name
        self.note_place()
        self._drawn = snapshot.version if session.files.has_picture else None
        self.selection = selection
        self._asset, self._lists, self._counted = asset, lists, snapshot.version
        self._front = session.scene.front
        self._original = snapshot.original
        self.state = state

    def refresh(self) -> None:
        """Describe the session anew; cheap where the Gaussians are the same."""
        session, snapshot = self.session, self.session.snapshot
        self.selection.note()
        # What says the first view has changed, so all of the asset's description is made anew.
        if self._asset.up != list(describe.up_axis(session)) or self._front != session.scene.front:
            self._asset, self._counted = describe.asset_info(session, self._asset.name), 0
            self._front = session.scene.front
        if len(snapshot.history) > 1:
            self._earlier = []
        if self._original is not snapshot.original:  # assets came, went, or moved
            # A selection is of Gaussians by number; with other assets the numbers mean others.
            if len(self._original) != len(snapshot.original):
                self.selection.choose(None)
            self._asset, self._counted = describe.asset_info(session, self._asset.name), 0
            self._original = snapshot.original
        # Counting compares every Gaussian, so it is done once for each version.
        if self._counted != snapshot.version:
            self._asset = describe.counted(self._asset, session.original, snapshot.splats)
            self._counted = snapshot.version
        with _one_line_errors(self.name):
            self.state = self._state_of(session, self.session_id, self.name, self._asset, self._lists, self.selection)

    def note_lock(self) -> None:
        """Look whether a project that is read only could be taken over by now, and say so in `state`."""
        files = self.session.files
        self._looked = (self.session, files.can_be_taken_over, files.noted_computer)
        self.refresh()

    def _scene_assets(self, session: Session, name: str) -> list[SceneAssetInfo]:
        """Described anew where something about them changed."""
        # Whatever the description is made of, and nothing else: strokes leave it as it is.
        key = (id(session), session.scene.assets, tuple(layer.asset for layer in session.layers), name)
        if self._scene is None or self._scene[0] != key:
            self._scene = (key, describe.scene_assets(session, name))
        return self._scene[1]

    def _state_of(
        self,
        session: Session,
        session_id: str,
        name: str,
        asset: AssetInfo,
        lists: describe.Lists,
        selection: CurrentSelection,
    ) -> State:
        return State(
            session=session_id,
            version=session.snapshot.version,
            asset=asset,
            assets=self._scene_assets(session, name),
            layers=[describe.layer_info(session, layer) for layer in session.layers],
            history=lists.history(session),
            cursor=session.history.cursor,
            latest_edit=describe.latest_edit(session),
            conflicts=describe.conflict_infos(session),
            bookmarks=lists.bookmarks(session),
            earlier=self._earlier,
            project=self._project(session, name),
            selection=SelectionInfo(
                revision=selection.revision,
                gaussians=selection.gaussians,
                names=session.selections.names(),
                undo=selection.steps[0],
                redo=selection.steps[1],
            ),
            methods=describe.methods(session),
            folder=None if self.folder is None else self.folder.root.name,
            clients=0,
            formats=describe.endings(),
        )

    def _project(self, session: Session, name: str) -> ProjectInfo:
        path = session.path
        # Clients know files of the studio's folder alone; another place is none of theirs.
        inside = path is not None and self.folder is not None and path.resolve().parent == self.folder.root
        name = name if path is None or not inside else path.stem
        file = path.name if path is not None and inside else None
        reason = session.read_only
        id = "" if path is None else project_id(path, session.files.project_id)
        looked, is_free, noted = self._looked
        is_free, noted = (is_free, noted) if reason and session is looked else (False, "")
        reason = self.public(reason)
        return ProjectInfo(
            id=id,
            name=name,
            file=file,
            read_only=bool(reason),
            read_only_reason=reason,
            is_free=is_free,
            noted_computer=self.public(noted),
        )

    def _earlier_of(self, session: Session) -> list[RecentInfo]:
        projects = self.projects.of_original(session.opened.sha256, without=session.path)
        return [self.recent_info(project) for project in projects[:MAX_EARLIER]]

    def recent_info(self, project: RecentProject) -> RecentInfo:
        """A project as clients see it; its picture is a blob."""
        summary, picture = project.summary, None
        # A list of projects must not fail for the picture of one of them.
        if summary is not None and summary.picture is not None:
            with contextlib.suppress(ValueError):  # damaged, or nothing can be kept
                picture = self.blobs.put(summary.picture, f"{project.id}.png").sha256
        return RecentInfo(
            id=project.id,
            name=project.name,
            changed=project.changed,
            layers=None if summary is None else summary.layers,
            picture=picture,
            is_open=getattr(self, "session", None) is not None and self.session.path == project.path,
        )

    def notes(self) -> list[str]:
        """Lines that who opens the page, or a project, has to know of where they are saved."""
        return [self.public(line) for line in (self.options.note, self.session.note) if line]

    def draw_picture(self, listed: bool = False) -> None:
        """Leave a small picture of the asset in its project, for lists. listed: also where nothing was done in it yet;
        such a project goes when it is left."""
        session = self.session
        # Nothing to show of one in which nothing was done, unless it is listed while it is open.
        if session.read_only or session.version == self._drawn or (len(session.history) < 2 and not listed):
            return
        # Noted before it is drawn: if the disk is full it would be tried again at every turn.
        self._drawn = session.version
        camera = describe.small_view(self._asset)
        with contextlib.suppress(ValueError):  # a full disk
            session.files.set_picture(thumbnail(describe.drawn(session.splats, camera), None, few_colors=True))

    def public(self, text: str) -> str:
        """A message without the folders that clients have no business with; names of files in them stay."""
        # Every folder of this machine that a message could name; what lies in them keeps its name.
        folders = [self.projects.root, self.blobs.folder, self.scratch.path]
        folders += [] if self.folder is None else [self.folder.root]
        session = getattr(self, "session", None)
        if session is not None and session.path is not None:
            folders.append(session.path.parent)
        if session is not None and session.opened.source is not None:
            folders.append(Path(session.opened.source.path).absolute().parent)
        return public_text(text, folders, self.blobs.name_of)

    def public_problem(self, problem: Problem) -> Problem:
        """The same problem with `public` texts."""
        return problem.model_copy(update={"message": self.public(problem.message), "hint": self.public(problem.hint)})

    def note_source(self, picture: str, record: dict[str, Any] | None) -> None:
        """A picture of a source, by its hash; record: what receipts say of it, None: nothing."""
        if record is not None:
            self._sourced.put(picture, record)

    def source_of(self, pictures: Sequence[str]) -> dict[str, Any] | None:
        """What receipts say of the sources of some pictures, all in one; None: no source made them."""
        records = [record for picture in pictures if (record := self._sourced.find(picture)) is not None]
        # All views of a layer may come from one source; its record then lists them together.
        if not records:
            return None
        return {**records[0], "views": [view for record in records for view in record["views"]]}

    def picture_bytes(self, sha256: str) -> tuple[bytes, str]:
        """(bytes, content type) of a picture that was sent or made, or that a layer holds. Raises ValueError."""
        # Uploads may be gone by now, and a layer keeps its pictures in the project.
        with contextlib.suppress(ValueError):
            blob = self.blobs.get(sha256)
            return blob.path.read_bytes(), blob.info.media
        with contextlib.suppress(ValueError):
            return self.session.files.blob(sha256), "image/png"
        raise ValueError(f"blob {sha256[:12]}...: no longer available")

    def close(self) -> None:
        """Leave nothing but the project file: no thread and no program either. Closing twice does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        # Programs and threads first, for they may still use the files that go next.
        self.batches.close()
        if self._preparing is not None:
            self._preparing.join()
        self.held_layers.show(self.session)
        self.draw_picture()
        before = self.session.note
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # said by who closes it
            close_session(self.session, self.projects)
        if self.session.note != before:
            self.last_note = self.session.note
        self.blobs.close()
        self.scratch.close()


def close_session(session: Session, projects: Projects) -> None:
    """Close a session; a project of the studio's own folder in which nothing was done is removed."""
    path = session.path
    # All of these hold only for a project that nobody has touched; anything else is somebody's work.
    unused = path is not None and path.parent == projects.root and not session.read_only
    unused = unused and len(session.history) == 1 and not session.bookmarks and not session.scene.is_oriented
    unused = unused and session.files.is_in_place
    session.close()
    if unused and path is not None:
        files.remove(path)


@contextlib.contextmanager
def _one_line_errors(name: str) -> Iterator[None]:
    """Values of a project that no message can hold are an error of one line."""
    try:
        yield
    except ValidationError as error:
        raise ValueError(f"{name}: damaged project ({first_fault(error, 'state')})") from None
