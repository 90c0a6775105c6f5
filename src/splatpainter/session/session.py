"""The session: an asset, its layers, and a project file that always holds both. Knows no HTTP and no screen.

    session = Session("vase.ply", project="vase.splatproj")
    stroke = session.add("paint", [Edit(picture, camera, mask)])
    session.set(stroke.id, opacity=0.5)
    session.undo()
    session.export("painted.ply")

The asset is a pure function of the original file and the ordered layers (compose.py). Every command is one step of the
history, is on disk when it returns, and can be undone, bit for bit, also after the project was closed. What a session
shows is one immutable Snapshot after the other, for any number of readers in other threads.
"""

from __future__ import annotations

import struct
import threading
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files, read
from splatpainter.io.files import printable
from splatpainter.jsonio import brief
from splatpainter.painter import Edit, Method, Mode, Painter
from splatpainter.session import asset_files, conflicts
from splatpainter.session.annotations import Annotations
from splatpainter.session.asset_commands import AssetCommands
from splatpainter.session.asset_files import ANY_FILE, OriginalRule
from splatpainter.session.database import SUFFIX
from splatpainter.session.delta import AssetDelta, VersionLog, without_source
from splatpainter.session.document import (
    Blend,
    Document,
    Kind,
    Layer,
    Policy,
    add_layer,
    change_layer,
    delete_layer,
    duplicate_layer,
    merge_layers,
    move_layer,
    resolve_conflict,
)
from splatpainter.session.export_commands import ExportCommands
from splatpainter.session.fingerprint import fingerprint
from splatpainter.session.geometry_commands import GeometryCommands
from splatpainter.session.layer_blending import ADJUSTMENTS, AdjustmentFunction
from splatpainter.session.layer_factory import limits_of, new_layer, spread_options_of
from splatpainter.session.layer_state import LayerState, Progress
from splatpainter.session.project_check import find_problems
from splatpainter.session.project_file import Project, Step, Transaction
from splatpainter.session.scene_asset import MAIN_ASSET_ID
from splatpainter.session.scene_replay import SceneReplay
from splatpainter.session.scratch import ScratchFolder
from splatpainter.session.snapshot import Snapshot
from splatpainter.splats import Frame, Splats

if TYPE_CHECKING:
    from splatpainter.surface.estimate import Surface

DAMAGE_ERRORS = (
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


class Session(AssetCommands, ExportCommands, Annotations, GeometryCommands):
    """An open project. Commands wait for each other; reading waits for nobody."""

    def __init__(
        self,
        asset: Splats | str | Path,
        project: str | Path | None = None,
        *,
        painter: Painter | None = None,
        adjustments: Mapping[str, AdjustmentFunction] | None = None,
        embed: bool = True,
        overwrite: bool = False,
        frame: Frame = "auto",
    ) -> None:
        """asset: a splat file, its Gaussians as read, those of any origin, or a project file (then as `load`).

        project: the project file to make; None: a temporary one, which `save_as` moves to a name and `close` deletes.
        painter: default Painter.load(). adjustments: functions of adjustment layers by name, besides
        layer_blending.ADJUSTMENTS. embed: the project holds the original's bytes; False: only its path and
        hash. frame: of a splat file, as in io.read. Raises ValueError for what cannot be read, an asset of
        which nothing can be drawn, and a project that exists (unless overwrite)."""
        if not isinstance(asset, Splats) and Path(asset).suffix.lower() == SUFFIX:
            if project is not None:
                raise ValueError(f"{asset}: is a project already; open it alone, then save_as")
            self._start(Project.open(Path(asset)), painter, adjustments)
            return
        splats = asset if isinstance(asset, Splats) else read(asset, frame=frame)
        splats = asset_files.numbered(splats.numpy())
        if not splats.drawable.any():
            reasons = "NaN, zero scale or zero quaternion"
            raise ValueError(f"asset: none of the {len(splats)} Gaussians can be drawn ({reasons})")
        source = asset_files.file_of(splats)
        if source is None:
            splats = asset_files.numbered(without_source(splats))
            if not embed:
                raise ValueError("session: embed=False needs an asset that was read from a file")
        scratch = None
        if project is None:
            scratch = ScratchFolder("session")
            project = scratch.path / f"unsaved{SUFFIX}"
        try:
            facts = asset_files.describe(splats, source, embed)
            pieces = asset_files.pieces(splats, source) if embed else ()
            created = Project.create(_project_path(project), facts, pieces, overwrite)
        except BaseException:
            if scratch is not None:
                scratch.close()
            raise
        self._start(created, painter, adjustments, splats=splats, scratch=scratch)

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
        session = cls.__new__(cls)
        at, within = (None if path is None else Path(path) for path in (original, folder))
        session._start(
            Project.open(Path(project), readonly), painter, adjustments, rule=OriginalRule(at, embedded, within)
        )
        return session

    def _start(self, project: Project, painter, adjustments, *, splats=None, scratch=None, rule=ANY_FILE) -> None:
        self._project, self._scratch, self._rule = project, scratch, rule
        self._commands = threading.RLock()
        self._versions = VersionLog()
        self._transaction = Transaction(project)
        self.painter = painter or Painter.load()
        self.progress: Progress | None = None
        """Called before each layer that has to be computed; what it raises cancels the command."""
        try:
            original = asset_files.restore(project, rule) if splats is None else splats
            table = {**ADJUSTMENTS, **(adjustments or {})}
            load = partial(asset_files.restore_added, project)
            self._replay = SceneReplay(original, self.painter, self._transaction, table, load)
            steps, cursor = project.steps()
            document = project.document(steps[cursor].id)
            state = self._replay.compose(document)
            original = self._replay.original_of(document)
            self._snapshot = Snapshot(1, state, document, tuple(steps), cursor, original)
            if self._transaction.results:  # of a project that lost some
                project.move(steps[cursor].id, state.results, self._transaction)
                self._transaction.clear()
        except BaseException as error:
            project.close()
            if scratch is not None:
                scratch.close()
            if splats is None and isinstance(error, DAMAGE_ERRORS) and str(project.path) not in str(error):
                reason = printable(" ".join(str(error).split()), 300)
                raise ValueError(f"{project.path}: damaged project file ({reason})") from error
            raise

    # ---- what there is: changes nothing

    @property
    def snapshot(self) -> Snapshot:
        """The present version: what belongs together stays together while other threads write."""
        return self._snapshot

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now; those of the original keep their ids."""
        return self._snapshot.splats

    @property
    def original(self) -> Splats:
        """The Gaussians as they were opened; of several assets all that are visible, as they stand."""
        return self._snapshot.original

    @property
    def opened(self) -> Splats:
        """The asset that the session was opened with, alone."""
        return self._replay.main.original

    @property
    def _document(self) -> Document:
        return self._snapshot.document

    @property
    def version(self) -> int:
        return self._snapshot.version

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers, lowest first."""
        return self._snapshot.document.layers

    @property
    def path(self) -> Path | None:
        """The project file; None while it is temporary."""
        return None if self._scratch is not None else self._project.path

    @property
    def read_only(self) -> str:
        """Why nothing can be changed; "" where it can."""
        return self._project.read_only

    @property
    def history(self) -> tuple[Step, ...]:
        """Oldest first; the first one is the asset as it was opened."""
        return self._snapshot.history

    @property
    def cursor(self) -> int:
        """Index in the history of the step in effect."""
        return self._snapshot.cursor

    @property
    def note(self) -> str:
        """What was found beside the project file when it was opened (a log of another state of it); after `close` also
        where its layers are, if another program had replaced or deleted it. "": nothing."""
        return self._project.note

    @property
    def has_its_file(self) -> bool:
        """Whether the project file is still the one that was opened: not deleted, moved, replaced or overwritten."""
        try:
            self._project.check_file()
        except ValueError:
            return False
        return True

    def layer(self, layer: str) -> Layer:
        """A layer by its id. Raises ValueError for an unknown one."""
        document = self._snapshot.document
        return document.layers[document.index(layer)]

    def facts(self, layer: str) -> dict[str, Any]:
        """What is known of a layer's last computation: rows_touched, rows_appended, seconds, method, note, views with
        psnr_before, psnr_after, psnr_outside; "problem" where it cannot be applied. Empty for a hidden layer."""
        return dict(self._snapshot.state.facts).get(layer, {})

    def blob(self, sha256: str) -> bytes:
        """PNG bytes of a picture, mask or thumbnail that a layer names. Raises ValueError: unknown."""
        return self._project.blob(sha256)

    def conflicts(self) -> list[conflicts.Conflict]:
        """Gaussians that several layers changed from different views, and who wins."""
        snapshot = self._snapshot
        return conflicts.find_conflicts(snapshot.state.edited, snapshot.document)

    def confidence(self, layer: str) -> np.ndarray:
        """[N] float32 0..1 per Gaussian of `splats`: how sure a layer of mode spread is that it is of the painted
        material (1: painted). Raises ValueError for another layer, and for one that is hidden."""
        snapshot = self._snapshot
        for entry in snapshot.state.edited:
            if entry.layer.id == layer and entry.layer.mode == "spread" and entry.confidence is not None:
                out = np.zeros(len(snapshot.splats), np.float32)
                out[: len(entry.confidence)] = entry.confidence / np.float32(255)
                return out
        raise ValueError(f"{self.layer(layer).title}: expected a visible layer of mode spread")

    def painted(self, name: str) -> np.ndarray:
        """[N] float32 per Gaussian of `splats`: 1 where the visible layers of this name paint. Raises ValueError where
        none does."""
        snapshot = self._snapshot
        layers = [layer for layer in snapshot.document.layers if name in (layer.name, layer.id)]
        ids = {layer.id for layer in layers} | {leaf.id for layer in layers for leaf in layer.leaves()}
        out = np.zeros(len(snapshot.splats), np.float32)
        for entry in snapshot.state.edited:
            if entry.layer.id in ids:
                out[entry.changed] = 1
                out[slice(*entry.appended)] = 1
        if not out.any():
            raise ValueError(f"layer: expected the name of a visible layer that paints, got {brief(name)}")
        return out

    def coverage(self) -> np.ndarray:
        """[N] uint8 per Gaussian: conflicts.ORIGINAL, SEEN or PREDICTED."""
        snapshot = self._snapshot
        return conflicts.coverage(snapshot.state.edited, len(snapshot.splats))

    @property
    def surface(self) -> Surface:
        """Surface of the original, on which edits are laid."""
        return self._replay.surfaces(self._document).surface

    def delta(self, since: int | None = None) -> AssetDelta:
        """What changed since a version that was seen before (None: everything)."""
        while True:
            snapshot = self._snapshot
            delta = self._versions.since(since, snapshot.version, snapshot.splats)
            if self._snapshot is snapshot:
                return delta

    def prepare(self, camera: Camera | None = None) -> None:
        """Make now what the next local edit would make first (samples of the surface; where this camera, or any, needs
        them the voxels of the asset), in another thread than commands, while the edit is still being drawn. Changes
        nothing."""
        camera = None if camera is None else camera.relative_to(self.original.offset)
        self._replay.prepare(self._document, self._snapshot.state, camera)

    def left_out(self, camera: Camera, **limits: float) -> np.ndarray:
        """[H, W] bool: pixels of a view that a local edit would not paint (by more than half), to about a block of
        1/128 of its longer side. limits: angle_limit, depth_edge_limit, as a layer's parameters."""
        camera = camera.relative_to(self.original.offset)
        return self._replay.surfaces(self._document).left_out(self._snapshot.state, camera, limits)

    def surface_blocks(self, camera: Camera) -> tuple[np.ndarray, int]:
        """([rows, columns, 4] float32 z-depth and unit normal towards the camera (camera space) of the surface in the
        middle of each block of a view, depth 0 where it is not trusted or there is none; pixels along a block). Of the
        original, less what is hidden: paint lies on that surface, whatever it is made of."""
        from splatpainter.lift.sheets.view_limits import blocks_px

        camera = camera.relative_to(self.original.offset)
        document, state = self._snapshot.document, self._replay.base_state
        hiding = tuple(layer for layer in document.layers if layer.kind in ("hide", "fill") and layer.visible)
        if hiding or document.assets:
            with self._commands:
                state = self._replay.compose(replace(document, layers=hiding))
        coarse = self._replay.surfaces(document).coarse_surface(state, camera)
        rows, columns = coarse.index.shape
        middles = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) + 0.5
        at = coarse.at(middles.astype(np.float64))
        table = np.concatenate([at.depth[:, None], at.normals], 1).astype(np.float32)
        return table.reshape(rows, columns, 4), blocks_px(camera)

    def verify(self, *, repaint: bool = False) -> list[str]:
        """Check everything; what is wrong, one line each. The file's structure and hashes, the original, and that
        replaying the layers gives the asset bit for bit; repaint: with every layer computed anew."""
        with self._commands:
            rule = replace(self._rule, at=None)  # what is checked is what the project itself leads to
            document, splats = self._snapshot.document, self._snapshot.splats
            return find_problems(self._project, document, splats, self._replay, repaint, rule)

    def refresh(self) -> bool:
        """In a read-only session: show what the writer has done since. False: nothing."""
        with self._commands:
            steps, cursor = self._project.steps()
            document = self._project.document(steps[cursor].id)
            state = self._replay.compose(document)
            changed = state.key != self._snapshot.state.key or document != self._snapshot.document
            self._publish(state, document)
            return changed

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
        index: int | None = None,
        attached: Sequence[bytes] = (),
        asset: str | None = None,
    ) -> Layer:
        """A new layer (on top, or at an index, 0 the lowest) and its result.

        kind paint, picture, clone: edits with pictures, mode local unless said; look (an adjustment layer): pictures
        that grade everything (mode global), or parameters {"look": name, ...} with edits whose masks limit it; erase:
        edits of which only cameras and masks count. Pictures are kept with 8 bits. A local edit without a mask gets the
        one of what differs from the asset now. parameters {"angle_limit": degrees, "depth_edge_limit": pixels} of local
        edits: what one view may paint, where that is not to be as the painter's LocalOptions say; {"spread_threshold":
        confidence 0..1} of edits of mode spread: how far their material reaches (lower: further). attached: PNG bytes
        that the parameter "placed" names as its image, kept with the layer. asset: of several, the one that it is for;
        None: a layer for each that it reaches (that with the most pixels is returned). Raises ValueError as
        Painter.apply does, with nothing changed."""
        with self._command():
            if kind == "look" and "look" in (parameters or {}):
                method = "lift"  # no painter is asked, whose weights would be read for its name
            method = self.painter.choose(method, mode or ("global" if kind == "look" else "local"))[0]
            settings = {"mode": mode, "method": method, "opacity": opacity, "blend": blend}
            settings["painter"] = fingerprint(self.painter, method)
            if self._document.assets:
                return self._add_to_scene(kind, edits, name, dict(parameters or {}), settings, index, attached, asset)
            layer, blobs = new_layer(self.splats, kind, edits, name, dict(parameters or {}), settings)
            self._transaction.blobs = blobs | {files.sha256(data): data for data in attached}
            document, layer = add_layer(self._snapshot.document, layer, index)
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
            limits_of(values.get("parameters") or {}, "layer")
            spread_options_of(values.get("parameters") or {}, "layer")
            if "method" in values:
                values["method"] = self.painter.choose(values["method"], self.layer(layer).mode)[0]
                values["painter"] = fingerprint(self.painter, values["method"])
                again = {"method": values["method"], "painter": values["painter"]}
                values["strokes"] = tuple(replace(stroke, **again) for stroke in self.layer(layer).strokes)
            document = change_layer(self._snapshot.document, layer, **values)
            verb = {"visible": "show" if values.get("visible") else "hide", "name": "rename"}
            first = next(iter(values))
            label = f"{verb.get(first, 'set ' + first)} {self.layer(layer).name}"
            self._commit(label, document, gesture=gesture)
            return self.layer(layer)

    def blend_preview(
        self, layer: str, *, opacity: float | None = None, blend: Blend | None = None, visible: bool | None = None
    ) -> tuple[np.ndarray, Splats] | None:
        """([C] int64 ascending ids, C Gaussians): what `set` will show of a layer, where nothing has to be painted anew
        for it, to be seen until all is done; None where that is as quick, or where it cannot be said. Ids beyond
        `splats` are of Gaussians that follow them. Changes nothing."""
        with self._commands:
            document = self._snapshot.document
            values = {"opacity": opacity, "blend": blend, "visible": visible}
            fields = {name: value for name, value in values.items() if value is not None}
            return self._replay.blend_preview(change_layer(document, layer, **fields), layer, document)

    def move(self, layer: str, index: int) -> None:
        """Move a layer: 0 is the lowest index."""
        with self._command():
            self._commit(f"move {self.layer(layer).name}", move_layer(self._snapshot.document, layer, index))

    def duplicate(self, layer: str) -> Layer:
        """Add a copy of a layer right above it."""
        with self._command():
            document, copy = duplicate_layer(self._snapshot.document, layer)
            self._commit(f"duplicate {self.layer(layer).name}", document)
            return copy

    def delete(self, layer: str) -> None:
        """Remove a layer from the document."""
        with self._command():
            self._commit(f"delete {self.layer(layer).name}", delete_layer(self._snapshot.document, layer))

    def merge(self, layers: Sequence[str], name: str | None = None) -> Layer:
        """Neighbouring layers become one, which shows the same, bit for bit."""
        with self._command():
            document, one = merge_layers(self._snapshot.document, layers, name)
            self._commit(f"merge {len(one.layers)} layers", document)
            return one

    def resolve_conflict(self, lower: str, upper: str, policy: Policy) -> None:
        """Who wins where two layers changed the same Gaussians: "latest" (the upper one), "first" (the lower), "blend"
        (half of each)."""
        with self._command():
            document = resolve_conflict(self._snapshot.document, lower, upper, policy)
            self._commit(f"conflict: {policy}", document)

    def export_layer(self, layer: str, path: str | Path, *, overwrite: bool = False) -> None:
        """One layer with its pictures as a .splatlayer file."""
        asset_files.write_layer(Path(path), self.layer(layer), self.blob, overwrite)

    def import_layer(self, path: str | Path, *, asset: str = MAIN_ASSET_ID) -> Layer:
        """Add the layer of a .splatlayer file on top. Raises ValueError: not such a file, or it cannot be applied."""
        with self._command():
            layer, self._transaction.blobs = asset_files.read_layer(Path(path))
            document, layer = add_layer(self._snapshot.document, replace(layer, asset=self.asset(asset).id))
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
        """Jump to any step of the history. Raises ValueError for one that is not there."""
        with self._command():
            self._jump(cursor - self.cursor, strict=True)

    def _jump(self, by: int, strict: bool = False) -> bool:
        with self._command():
            steps, cursor = self._project.steps()
            cursor += by
            if not 0 <= cursor < len(steps):
                if strict:
                    raise ValueError(f"history: expected an index of 0 to {len(steps) - 1}, got {brief(cursor)}")
                return False
            document = self._project.document(steps[cursor].id)
            state = self._replay.compose(document, self.progress)
            self._project.move(steps[cursor].id, state.results, self._transaction)
            computed = bool(self._transaction.results)
            self._transaction.clear()
            self._publish(state, document)
            for layer in document.layers if computed else ():
                self._fold(layer.id)
            return True

    # ---- files

    def save_as(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Go on in a project file of another name (from a temporary one: move there). The old file stays as it is."""
        with self._commands:
            target = _project_path(path)
            if target == self._project.path:
                self._project.check_file()
                return  # all of it is there already
            self._project.copy(target, overwrite)
            old, scratch = self._project, self._scratch
            self._project, self._scratch = Project.open(target, readonly=False), None
            self._transaction.project = self._project
            old.close(is_copied=True)
            if scratch is not None:
                scratch.close()

    def save_copy(self, path: str | Path, *, overwrite: bool = False) -> None:
        """A copy of the project in another file; the session stays where it is."""
        self._project.copy(_project_path(path), overwrite)

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

    def _commit(self, label: str, document: Document, *, strict: Any = None, gesture: str | None = None) -> None:
        """Compute, make durable, publish: in this order, so that what was published is never lost."""
        state = self._replay.compose(document, self.progress, strict)
        removed = self._project.commit(label, document, state.results, self._transaction, gesture)
        self._transaction.clear()
        self._replay.forget(removed)
        self._publish(state, document)

    def _publish(self, state: LayerState, document: Document) -> None:
        before = self._snapshot
        version = before.version
        if state.key != before.state.key:
            version += 1
            if before.splats.sh.shape[1] != state.splats.sh.shape[1]:  # of other assets: viewers get everything
                self._versions = VersionLog()
            else:
                self._versions.note(version, before.splats, state.splats)
        steps, cursor = self._project.steps()
        original = self._replay.original_of(document)
        self._snapshot = Snapshot(version, state, document, tuple(steps), cursor, original)

    @contextmanager
    def _command(self) -> Iterator[None]:
        """One command at a time; what it prepared and did not commit is dropped."""
        with self._commands:
            if self.read_only:
                raise ValueError(f"{self._project.path}: {self.read_only}")
            self._project.check_file()  # before anything is computed for it
            try:
                yield
            finally:
                if self._transaction.results:  # computed, and not stored: the command failed
                    self._replay.forget(set(self._transaction.results))
                self._transaction.clear()


def _project_path(path: str | Path) -> Path:
    if Path(path).suffix.lower() != SUFFIX:
        raise ValueError(f"{path}: expected a project file name ending in {SUFFIX}")
    return Path(path).absolute()


# Names up to version 0.1, which still work.


def _renamed(cls: type, old: str, new: str) -> None:
    def get(self: Any) -> Any:
        warnings.warn(f"{cls.__name__}.{old} is now called {new}", DeprecationWarning, stacklevel=2)
        return getattr(self, new)

    setattr(cls, old, property(get))


_renamed(Session, "shown", "snapshot")
_renamed(Session, "settle", "resolve_conflict")
_renamed(Snapshot, "level", "state")
_renamed(conflicts.Conflict, "rows", "gaussian_ids")
_renamed(AssetDelta, "rows", "gaussian_ids")
_renamed(AssetDelta, "kept", "retained")
