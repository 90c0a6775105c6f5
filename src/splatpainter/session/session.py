"""The session: an asset, its layers, and a project file that always holds both. Knows no HTTP and no screen.

    session = Session("vase.ply", project="vase.splatproj")
    stroke = session.layers.add("paint", [Edit(picture, camera, mask)])
    session.layers.set(stroke.id, opacity=0.5)
    session.undo()
    session.files.export("painted.ply")

The asset is a pure function of the original file and the ordered layers (compose.py). Every command is one step of the
history, is on disk when it returns, and can be undone, bit for bit, also after the project was closed. What a session
shows is one immutable Snapshot after the other, for any number of readers in other threads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.io import read
from splatpainter.painter import Painter
from splatpainter.session.commands.session_bookmarks import SessionBookmarks
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.commands.session_file_commands import SessionFileCommands, project_path
from splatpainter.session.commands.session_history import SessionHistory
from splatpainter.session.commands.session_layers import SessionLayers
from splatpainter.session.commands.session_masks import SessionMasks
from splatpainter.session.commands.session_scene import SessionScene
from splatpainter.session.commands.session_selections import SessionSelections
from splatpainter.session.commands.session_strokes import SessionStrokes
from splatpainter.session.commands.session_surface import SessionSurface
from splatpainter.session.former_names import under_former_name
from splatpainter.session.project import asset_files
from splatpainter.session.project.asset_files import ANY_FILE, OriginalRule
from splatpainter.session.project.database import SUFFIX
from splatpainter.session.project.project_check import find_problems
from splatpainter.session.project.project_file import Project
from splatpainter.session.project.scratch import ScratchFolder
from splatpainter.session.replay.delta import AssetDelta, without_source
from splatpainter.session.replay.layer_blending import AdjustmentFunction
from splatpainter.session.replay.layer_state import Progress
from splatpainter.session.replay.snapshot import Snapshot
from splatpainter.splats import Axes, Splats
from splatpainter.system.old_names import formerly


class Session:
    """An open project. Commands wait for each other; reading waits for nobody. What can be done stands in its parts."""

    layers: SessionLayers
    """The layers, lowest first: to add, change, order, merge."""
    strokes: SessionStrokes
    """Painting into a layer, stroke after stroke."""
    masks: SessionMasks
    """How much of a layer shows where."""
    selections: SessionSelections
    """Selections that the project keeps by name."""
    scene: SessionScene
    """The assets, where they stand, which way is up."""
    surface: SessionSurface
    """The surface that edits are laid on, as views show it."""
    history: SessionHistory
    """The steps, of which one is in effect."""
    bookmarks: SessionBookmarks
    """Views to come back to."""
    files: SessionFileCommands
    """Exports, receipts, layer files, the project under another name."""

    @formerly(axes="frame")
    def __init__(
        self,
        asset: Splats | str | Path,
        project: str | Path | None = None,
        *,
        painter: Painter | None = None,
        adjustments: Mapping[str, AdjustmentFunction] | None = None,
        embed: bool = True,
        overwrite: bool = False,
        axes: Axes = "auto",
    ) -> None:
        """asset: a splat file, its Gaussians as read, those of any origin, or a project file (then as `load`).

        project: the project file to make; None: a temporary one, which `save_as` moves to a name and `close` deletes.
        painter: default Painter.load(). adjustments: functions of adjustment layers by name, besides
        layer_blending.ADJUSTMENTS. embed: the project holds the original's bytes; False: only its path and
        hash. axes: of a splat file, as in io.read. Raises ValueError for what cannot be read, an asset of
        which nothing can be drawn, and a project that exists (unless overwrite)."""
        if not isinstance(asset, Splats) and Path(asset).suffix.lower() == SUFFIX:
            if project is not None:
                raise ValueError(f"{asset}: is a project already; open it alone, then save_as")
            self._set_parts(SessionCore(Project.open(Path(asset)), painter, adjustments, ANY_FILE))
            return
        splats = asset if isinstance(asset, Splats) else read(asset, axes=axes)
        splats = asset_files.numbered(splats.numpy())
        if not splats.drawable.any():
            reasons = "NaN, zero scale or zero quaternion"
            raise ValueError(f"asset: none of the {len(splats)} Gaussians can be drawn ({reasons})")
        # Without a file that still holds these Gaussians, the project keeps the Gaussians themselves.
        source = asset_files.file_of(splats)
        if source is None:
            splats = asset_files.numbered(without_source(splats))
            if not embed:
                raise ValueError("session: embed=False needs an asset that was read from a file")
        # A temporary project is one like any other: commands are on disk there too.
        scratch = None
        if project is None:
            scratch = ScratchFolder("session")
            project = scratch.path / f"unsaved{SUFFIX}"
        try:
            facts = asset_files.describe(splats, source, embed)
            pieces = asset_files.pieces(splats, source) if embed else ()
            created = Project.create(project_path(project), facts, pieces, overwrite)
        except BaseException:
            if scratch is not None:
                scratch.close()
            raise
        self._set_parts(SessionCore(created, painter, adjustments, ANY_FILE, splats, scratch))

    @classmethod
    def load(
        cls,
        project: str | Path,
        *,
        painter: Painter | None = None,
        adjustments: Mapping[str, AdjustmentFunction] | None = None,
        readonly: bool | None = None,
        original: str | Path | None = None,
        embedded: bool = False,
        folder: str | Path | None = None,
    ) -> Session:
        """Open a project file where it was left, history and all. If it is open elsewhere, or cannot be written (a
        folder without rights, a full disk), the session can only be looked at (`read_only` says why; readonly=False
        makes that an error).

        Of a project that names its original instead of holding the bytes: original says where that file is now;
        embedded refuses it; folder refuses it unless the file lies in there. For projects of strangers: else they
        could name any file of this machine. Raises ValueError: missing, damaged or newer, an original that is gone,
        refused or another."""
        at, within = (None if path is None else Path(path) for path in (original, folder))
        rule = OriginalRule(at, embedded, within)
        session = cls.__new__(cls)
        session._set_parts(SessionCore(Project.open(Path(project), readonly), painter, adjustments, rule))
        return session

    def _set_parts(self, core: SessionCore) -> None:
        self._core = core
        self.selections = SessionSelections(core)
        self.layers = SessionLayers(core, self.selections)
        self.strokes = SessionStrokes(core, self.layers)
        self.masks = SessionMasks(core, self.selections)
        self.scene = SessionScene(core)
        self.surface = SessionSurface(core)
        self.history = SessionHistory(core)
        self.bookmarks = SessionBookmarks(core)
        self.files = SessionFileCommands(core)

    # Hidden from type checkers, to which a mistyped name would be one of these.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            return under_former_name(self, name)

    # ---- what there is: changes nothing

    @property
    def snapshot(self) -> Snapshot:
        """The present version: what belongs together stays together while other threads write."""
        return self._core.snapshot

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now; those of the original keep their ids."""
        return self._core.splats

    @property
    def original(self) -> Splats:
        """The Gaussians as they were opened; of several assets all that are visible, as they stand."""
        return self._core.original

    @property
    def opened(self) -> Splats:
        """The asset that the session was opened with, alone."""
        return self._core.replay.main.original

    @property
    def version(self) -> int:
        """Goes up with every change of the Gaussians."""
        return self._core.snapshot.version

    @property
    def painter(self) -> Painter:
        """What computes new layers."""
        return self._core.painter

    @property
    def progress(self) -> Progress | None:
        """Called before each layer that has to be computed; what it raises cancels the command."""
        return self._core.progress

    @progress.setter
    def progress(self, report: Progress | None) -> None:
        self._core.progress = report

    @property
    def path(self) -> Path | None:
        """The project file; None while it is temporary."""
        return None if self._core.scratch is not None else self._core.project.path

    @property
    def read_only(self) -> str:
        """Why nothing can be changed; "" where it can."""
        return self._core.project.read_only

    @property
    def note(self) -> str:
        """What was found beside the project file when it was opened (a log of another state of it); after `close` also
        where its layers are, if another program had replaced or deleted it. "": nothing."""
        return self._core.project.note

    def delta(self, since: int | None = None) -> AssetDelta:
        """What changed since a version that was seen before (None: everything)."""
        while True:
            snapshot = self._core.snapshot
            delta = self._core.versions.since(since, snapshot.version, snapshot.splats)
            if self._core.snapshot is snapshot:
                return delta

    def verify(self, *, repaint: bool = False) -> list[str]:
        """Check everything; what is wrong, one line each. The file's structure and hashes, the original, and that
        replaying the layers gives the asset bit for bit; repaint: with every layer computed anew."""
        core = self._core
        with core.lock:
            rule = replace(core.rule, at=None)  # what is checked is what the project itself leads to
            return find_problems(core.project, core.document, core.splats, core.replay, repaint, rule)

    # ---- through the history

    def undo(self) -> bool:
        """One step back; False at the beginning."""
        return self._core.step(-1)

    def redo(self) -> bool:
        """One step forward again; False at the end."""
        return self._core.step(1)

    def refresh(self) -> bool:
        """In a read-only session: show what the writer has done since. False: nothing."""
        with self._core.lock:
            return self._core.reload()

    def close(self) -> None:
        """Leave one file behind (none where it was temporary). Nothing needs to be saved first."""
        core = self._core
        with core.lock:
            core.project.close()
            if core.scratch is not None:
                core.scratch.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
