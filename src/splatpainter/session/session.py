"""The session: an asset, its layers, and a project file that always holds both. Knows no HTTP and no screen.

    session = Session("vase.ply", project="vase.splatproj")
    stroke = session.add("paint", [Edit(picture, camera, mask)])
    session.set(stroke.id, opacity=0.5)
    session.undo()
    session.export("painted.ply")

The shown asset is a pure function of the original file and the ordered layers (replay.py). Every command is one step of
the history, is on disk when it returns, and can be undone, bit for bit, also after the project was closed.
"""

from __future__ import annotations

import struct
import threading
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatpainter.cameras import UPS, Camera
from splatpainter.io import read
from splatpainter.io.files import printable
from splatpainter.painter import Edit, Method, Mode, Painter
from splatpainter.session import commands, export, original, schema
from splatpainter.session.adapter import fingerprint
from splatpainter.session.changes import Changes
from splatpainter.session.deltas import bare
from splatpainter.session.layer_factory import new_layer
from splatpainter.session.layers import Blend, Document, Kind, Layer, Policy
from splatpainter.session.looks import LOOKS, LookFunction
from splatpainter.session.original import ANY_FILE, OriginalRule
from splatpainter.session.pending import Pending
from splatpainter.session.project import Project
from splatpainter.session.reader import Reader, Shown
from splatpainter.session.replay import Progress, Replay
from splatpainter.session.scratch import ScratchFolder
from splatpainter.splats import Frame, Splats

ODD = (
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    RuntimeError,
    AssertionError,
    EOFError,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)
"""What reading values that are not what they should be raises."""
SETTABLE = ("name", "visible", "opacity", "blend", "parameters", "method")


class Session(Reader):
    """An open project. Commands wait for each other; reading what is shown (reader.py) waits for nobody."""

    def __init__(
        self,
        asset: Splats | str | Path,
        project: str | Path | None = None,
        *,
        painter: Painter | None = None,
        looks: Mapping[str, LookFunction] | None = None,
        embed: bool = True,
        overwrite: bool = False,
        frame: Frame = "auto",
    ) -> None:
        """asset: a splat file, its rows as read, rows of any origin, or a project file (then as `load`).

        project: the project file to make; None: a temporary one, which `save_as` moves to a name and `close` deletes.
        painter: default the analytic lift. looks: functions of look layers by name, besides looks.LOOKS. embed: the
        project holds the original's bytes; False: only its path and hash. frame: of a splat file, as in
        io.read. Raises ValueError for what cannot be read,
        an asset without a row that can be drawn, and a project that exists (unless overwrite)."""
        if not isinstance(asset, Splats) and Path(asset).suffix.lower() == schema.SUFFIX:
            if project is not None:
                raise ValueError(f"{asset}: is a project already; open it alone, then save_as")
            self._start(Project.open(Path(asset)), painter, looks)
            return
        splats = asset if isinstance(asset, Splats) else read(asset, frame=frame)
        splats = original.numbered(splats.numpy())
        if not splats.drawable.any():
            raise ValueError(f"asset: none of the {len(splats)} rows can be drawn (NaN, zero scale or zero quaternion)")
        source = original.file_of(splats)
        if source is None:
            splats = original.numbered(bare(splats))
            if not embed:
                raise ValueError("session: embed=False needs an asset that was read from a file")
        scratch = None
        if project is None:
            scratch = ScratchFolder("session")
            project = scratch.path / f"unsaved{schema.SUFFIX}"
        try:
            place = _project_name(project)
            facts = original.describe(splats, source, embed)
            made = Project.create(place, facts, original.pieces(splats, source) if embed else (), overwrite)
        except BaseException:
            if scratch is not None:
                scratch.close()
            raise
        self._start(made, painter, looks, splats=splats, scratch=scratch)

    @classmethod
    def load(
        cls,
        project: str | Path,
        *,
        painter: Painter | None = None,
        looks: Mapping[str, LookFunction] | None = None,
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
        session = cls.__new__(cls)
        at, within = (None if path is None else Path(path) for path in (original, folder))
        session._start(Project.open(Path(project), readonly), painter, looks, rule=OriginalRule(at, embedded, within))
        return session

    def _start(self, project: Project, painter, looks, *, splats=None, scratch=None, rule=ANY_FILE) -> None:
        self._project, self._scratch, self._rule = project, scratch, rule
        self._commands = threading.RLock()
        self._changes = Changes()
        self._pending = Pending(project)
        self.painter = painter or Painter.load()
        self.progress: Progress | None = None
        """Called before each layer that has to be computed; what it raises cancels the command."""
        try:
            self.original = original.restore(project, rule) if splats is None else splats
            self._replay = Replay(self.original, self.painter, self._pending, {**LOOKS, **(looks or {})})
            steps, at = project.steps()
            document = project.document(steps[at].id)
            level = self._replay.compose(document)
            self._shown = Shown(1, level, document, tuple(steps), at)
            if self._pending.more.results:  # of a project that lost some
                project.move(steps[at].id, level.results, self._pending.more)
                self._pending.drop()
        except BaseException as error:
            project.close()
            if scratch is not None:
                scratch.close()
            if splats is None and isinstance(error, ODD) and str(project.path) not in str(error):
                reason = printable(" ".join(str(error).split()), 300)
                raise ValueError(f"{project.path}: damaged project file ({reason})") from error
            raise

    # ---- layers

    def add(
        self,
        kind: Kind,
        edits: Sequence[Edit] = (),
        *,
        name: str | None = None,
        mode: Mode | None = None,
        method: Method = "auto",
        parameters: Mapping[str, Any] | None = None,
        opacity: float = 1.0,
        blend: Blend = "normal",
        place: int | None = None,
    ) -> Layer:
        """A new layer (on top, or at a place) and its result.

        kind paint, picture, clone: edits with pictures, mode local unless said; look: pictures that regrade everything
        (mode global), or parameters {"look": name, ...} with edits whose masks limit it; erase: edits of which only
        cameras and masks count. Pictures are kept with 8 bits. A local edit without a mask gets the one of what
        differs from the asset now. Raises ValueError as Painter.apply does, with nothing changed."""
        with self._command():
            method = self.painter.choose(method, mode or ("global" if kind == "look" else "local"))[0]
            settings = {"mode": mode, "method": method, "opacity": opacity, "blend": blend}
            settings["painter"] = fingerprint(self.painter, method)
            layer, self._pending.more.blobs = new_layer(
                self.splats, kind, edits, name, dict(parameters or {}), settings
            )
            document, layer = commands.added(self._shown.document, layer, place)
            self._commit(f"add {layer.name}", document, strict=layer.id)
            return layer

    def set(self, layer: str, *, gesture: str | None = None, **values: Any) -> Layer:
        """Change a layer's name, visible, opacity, blend, parameters or method (it is then painted anew, by the painter
        of now). gesture: steps of one gesture (a slider that is dragged) in a row are one step of the history."""
        unknown = set(values) - set(SETTABLE)
        if unknown or not values:
            raise ValueError(
                f"layer: expected one of {', '.join(SETTABLE)} to set, got {', '.join(unknown) or 'nothing'}"
            )
        with self._command():
            if "method" in values:
                values["method"] = self.painter.choose(values["method"], self.layer(layer).mode)[0]
                values["painter"] = fingerprint(self.painter, values["method"])
            document = commands.changed(self._shown.document, layer, **values)
            verb = {"visible": "show" if values.get("visible") else "hide", "name": "rename"}
            first = next(iter(values))
            label = f"{verb.get(first, 'set ' + first)} {self.layer(layer).name}"
            self._commit(label, document, gesture=gesture)
            return self.layer(layer)

    def move(self, layer: str, place: int) -> None:
        """Reorder: 0 is the lowest place."""
        with self._command():
            self._commit(f"move {self.layer(layer).name}", commands.moved(self._shown.document, layer, place))

    def duplicate(self, layer: str) -> Layer:
        """A copy right above."""
        with self._command():
            document, copy = commands.duplicated(self._shown.document, layer)
            self._commit(f"duplicate {self.layer(layer).name}", document)
            return copy

    def delete(self, layer: str) -> None:
        with self._command():
            self._commit(f"delete {self.layer(layer).name}", commands.deleted(self._shown.document, layer))

    def merge(self, layers: Sequence[str], name: str | None = None) -> Layer:
        """Neighbouring layers become one, which shows the same, bit for bit."""
        with self._command():
            document, one = commands.merged(self._shown.document, layers, name)
            self._commit(f"merge {len(one.layers)} layers", document)
            return one

    def settle(self, lower: str, upper: str, policy: Policy) -> None:
        """Who wins where two layers wrote the same rows: "latest" (the upper one), "first" (the lower), "blend"."""
        with self._command():
            self._commit(f"conflict: {policy}", commands.settled(self._shown.document, lower, upper, policy))

    def export_layer(self, layer: str, path: str | Path, *, overwrite: bool = False) -> None:
        """One layer with its pictures as a .splatlayer file."""
        export.write_layer(Path(path), self.layer(layer), self.blob, overwrite)

    def import_layer(self, path: str | Path) -> Layer:
        """Add the layer of a .splatlayer file on top. Raises ValueError: not such a file, or it cannot be applied."""
        with self._command():
            layer, blobs = export.read_layer(Path(path))
            self._pending.more.blobs = blobs
            document, layer = commands.added(self._shown.document, layer)
            self._commit(f"import {layer.name}", document, strict=layer.id)
            return layer

    # ---- history

    def undo(self) -> bool:
        """One step back; False at the beginning."""
        return self._jump(-1)

    def redo(self) -> bool:
        """One step forward again; False at the end."""
        return self._jump(1)

    def jump(self, cursor: int) -> None:
        """To any place of the history. Raises ValueError for one that is not there."""
        with self._command():
            self._jump(cursor - self.cursor, strict=True)

    def _jump(self, by: int, strict: bool = False) -> bool:
        with self._command():
            steps, at = self._project.steps()
            if not 0 <= at + by < len(steps):
                if strict:
                    raise ValueError(f"history: expected a place of 0 to {len(steps) - 1}, got {at + by}")
                return False
            document = self._project.document(steps[at + by].id)
            level = self._replay.compose(document, self.progress)
            self._project.move(steps[at + by].id, level.results, self._pending.more)
            self._publish(level, document)
            return True

    # ---- bookmarks

    def add_bookmark(self, name: str, camera: Camera) -> str:
        """Returns its id."""
        return self._project.add_bookmark(name, camera)

    def delete_bookmark(self, bookmark: str) -> None:
        self._project.delete_bookmark(bookmark)

    def set_up(self, up: str) -> None:
        """Which way of the asset is up on the screen: a key of cameras.UPS. Kept in the project, not part of the
        history; no row changes. Raises ValueError for another one."""
        if up not in UPS:
            raise ValueError(f"up: expected one of {', '.join(UPS)}, got {str(up)[:20]!r}")
        self._project.set_fact("up", up)

    # ---- files

    def save_as(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Go on in a project file of another name (from a temporary one: move there). The old file stays as it is."""
        with self._commands:
            place = _project_name(path)
            if place == self._project.path:
                return  # all of it is there already
            self._project.copy(place, overwrite)
            old, scratch = self._project, self._scratch
            self._project, self._scratch = Project.open(place, readonly=False), None
            self._pending.project = self._project
            old.close()
            if scratch is not None:
                scratch.close()

    def save_copy(self, path: str | Path, *, overwrite: bool = False) -> None:
        """A copy of the project in another file; the session stays where it is."""
        self._project.copy(_project_name(path), overwrite)

    def close(self) -> None:
        """Leave one file behind (none where it was temporary). Nothing needs to be saved first."""
        with self._commands:
            self._project.close()
            if self._scratch is not None:
                self._scratch.close()

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ---- inside

    def _commit(self, label: str, document: Document, *, strict: str | None = None, gesture: str | None = None) -> None:
        """Compute, make durable, show: in this order, so that what was shown is never lost."""
        level = self._replay.compose(document, self.progress, strict)
        gone = self._project.commit(label, document, level.results, self._pending.more, gesture)
        self._replay.forget(gone)
        self._publish(level, document)

    @contextmanager
    def _command(self) -> Iterator[None]:
        """One command at a time; what it prepared and did not commit is dropped."""
        with self._commands:
            if self.read_only:
                raise ValueError(f"{self._project.path}: {self.read_only}")
            try:
                yield
            finally:
                self._pending.drop()


def _project_name(path: str | Path) -> Path:
    place = Path(path).absolute()
    if place.suffix.lower() != schema.SUFFIX:
        raise ValueError(f"{path}: expected a project file name ending in {schema.SUFFIX}")
    return place
