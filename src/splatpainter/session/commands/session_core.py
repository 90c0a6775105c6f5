"""What all parts of a session stand on: its project, its painter, the version that is shown, and the one way in which a
command becomes a step.

A command first computes, then makes durable, then publishes: nothing is ever shown that a crash could take back.
"""

from __future__ import annotations

import struct
import threading
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.io.files import printable
from splatpainter.painter import Edit, Painter
from splatpainter.session.document.document import Document, Layer
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, MAX_NAME, SceneAsset, find_asset
from splatpainter.session.project import asset_files
from splatpainter.session.project.asset_files import OriginalRule
from splatpainter.session.project.project_file import Project, Transaction
from splatpainter.session.project.scratch import ScratchFolder
from splatpainter.session.replay.delta import VersionLog
from splatpainter.session.replay.layer_blending import ADJUSTMENTS, AdjustmentFunction
from splatpainter.session.replay.layer_state import LayerState, Progress
from splatpainter.session.replay.scene_replay import Scene, SceneReplay
from splatpainter.session.replay.snapshot import Snapshot
from splatpainter.session.replay.split_edits import split_edits
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief

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


class SessionCore:
    """The state of an open project. Commands wait for each other; reading waits for nobody."""

    def __init__(
        self,
        project: Project,
        painter: Painter | None,
        adjustments: Mapping[str, AdjustmentFunction] | None,
        rule: OriginalRule,
        splats: Splats | None = None,
        scratch: ScratchFolder | None = None,
    ) -> None:
        """splats: the original, where it is at hand (a new project); scratch: the folder of a temporary project. The
        project is closed where this raises. Raises ValueError for what is damaged, gone or refused."""
        self.project, self.scratch, self.rule = project, scratch, rule
        self.lock = threading.RLock()
        """Held by a command from its first look at the document until it is published."""
        self.transaction = Transaction(project)
        self.painter = painter or Painter.load()
        self.progress: Progress | None = None
        self.versions = VersionLog()
        try:
            # Composed before anything is shown: a session that opens at all has a state that can be drawn.
            original = asset_files.restore(project, rule) if splats is None else splats
            table = {**ADJUSTMENTS, **(adjustments or {})}
            self.replay = SceneReplay(original, self.painter, self.transaction, table, self._load_added)
            steps, cursor = project.steps()
            document = project.document(steps[cursor].id)
            state = self.replay.compose(document)
            original = self.replay.original_of(document)
            self.snapshot = Snapshot(1, state, document, tuple(steps), cursor, original)
            # What was missing was computed just now; storing it spares the next opening the same work.
            if self.transaction.results:  # of a project that lost some
                project.move(steps[cursor].id, state.results, self.transaction)
                self.transaction.clear()
        except BaseException as error:
            # The lock must not outlive a failed opening, and a stranger's file may raise anything on the way.
            project.close()
            if scratch is not None:
                scratch.close()
            if splats is None and isinstance(error, DAMAGE_ERRORS) and str(project.path) not in str(error):
                reason = printable(" ".join(str(error).split()), 300)
                raise ValueError(f"{project.path}: damaged project file ({reason})") from error
            raise

    def _load_added(self, asset: SceneAsset) -> Splats:
        # From what is the project by then: under another name, or taken over, it is another object.
        return asset_files.restore_added(self.project, asset)

    # ---- what is shown

    @property
    def document(self) -> Document:
        return self.snapshot.document

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now."""
        return self.snapshot.splats

    @property
    def original(self) -> Splats:
        """The Gaussians as they were opened; of several assets all that are visible, as they stand."""
        return self.snapshot.original

    @property
    def assets(self) -> tuple[SceneAsset, ...]:
        """The assets of the scene; the first one is that which the session was opened with."""
        if self.document.assets:
            return self.document.assets
        name = files.printable(self.project.fact("name") or "asset", MAX_NAME)
        return (SceneAsset(MAIN_ASSET_ID, name or "asset"),)

    def asset(self, asset: str) -> SceneAsset:
        """The asset of this id. Raises ValueError for an unknown one."""
        return find_asset(self.assets, asset)

    def layer(self, layer: str) -> Layer:
        """A layer by its id. Raises ValueError for an unknown one."""
        document = self.snapshot.document
        return document.layers[document.index(layer)]

    def scene(self) -> Scene:
        """The present one; of a session with several assets."""
        return self.replay.scene(self.document)

    # ---- what commands bring, in the space of the asset that it is for

    def edits_of(self, layer: Layer, edits: Sequence[Edit]) -> list[Edit]:
        """Edits of the scene as edits of a layer's asset alone. Raises ValueError where they do not reach it."""
        if not self.document.assets:
            return [edit.relative_to(self.original.offset) for edit in edits]
        # A picture of a scene may show several assets; a layer takes only what reaches its own.
        for part, pieces in split_edits(self.scene(), edits, layer.operation.needs_masks):
            if part.asset.id == layer.asset:
                return pieces
        raise ValueError(f"{layer.title}: its asset is not under the picture")

    def camera_of(self, layer: Layer, camera: Camera) -> Camera:
        """A camera of the scene in the space of a layer's asset."""
        offset = self.replay.replay(self.document, layer.asset).original.offset
        return self.asset(layer.asset).placement.camera(camera.relative_to(self.original.offset), offset)

    def checked_weights(self, weights: np.ndarray) -> np.ndarray:
        """[N] float32 weights of `splats`. Raises ValueError for another shape, and where one is not finite."""
        weights = np.asarray(weights, np.float32)
        if weights.shape != (len(self.splats),) or not np.isfinite(weights).all():
            raise ValueError(f"selection: expected [{len(self.splats)}] finite weights, got {list(weights.shape)}")
        return weights

    # ---- how a command becomes a step

    @contextmanager
    def command(self) -> Iterator[None]:
        """One command at a time; what it prepared and did not commit is dropped."""
        with self.lock:
            if self.project.read_only:
                raise ValueError(f"{self.project.path}: {self.project.read_only}")
            self.project.check_file()  # before anything is computed for it
            try:
                yield
            finally:
                if self.transaction.results:  # computed, and not stored: the command failed
                    self.replay.forget(set(self.transaction.results))
                self.transaction.clear()

    def commit(self, label: str, document: Document, *, strict: Any = None, gesture: str | None = None) -> None:
        """Compute, make durable, publish: in this order, so that what was published is never lost."""
        state = self.replay.compose(document, self.progress, strict)
        removed = self.project.commit(label, document, state.results, self.transaction, gesture)
        self.transaction.clear()
        self.replay.forget(removed)
        self.publish(state, document)

    def step(self, by: int, strict: bool = False) -> bool:
        """Go some steps of the history back or forward; False where there is none. strict: that is an error."""
        with self.command():
            steps, cursor = self.project.steps()
            cursor += by
            if not 0 <= cursor < len(steps):
                if strict:
                    raise ValueError(f"history: expected an index of 0 to {len(steps) - 1}, got {brief(cursor)}")
                return False
            document = self.project.document(steps[cursor].id)
            state = self.replay.compose(document, self.progress)
            self.project.move(steps[cursor].id, state.results, self.transaction)
            computed = bool(self.transaction.results)
            self.transaction.clear()
            self.publish(state, document)
            # What was computed anew may take more room than it may; what was stored was folded when it came.
            for layer in document.layers if computed else ():
                self.fold(layer.id)
            return True

    def reload(self) -> bool:
        """Show what the project file holds now. False: it is what was shown."""
        steps, cursor = self.project.steps()
        document = self.project.document(steps[cursor].id)
        state = self.replay.compose(document, self.progress)
        changed = state.key != self.snapshot.state.key or document != self.document
        if self.transaction.results:  # of a project that lost some
            self.project.move(steps[cursor].id, state.results, self.transaction)
            self.transaction.clear()
        self.publish(state, document)
        return changed

    def publish(self, state: LayerState, document: Document) -> None:
        """Show a state that is on disk: from now on it is the snapshot."""
        before = self.snapshot
        version = before.version
        # A rename is a step and shows the same Gaussians, so viewers fetch nothing.
        if state.key != before.state.key:
            version += 1
            if before.splats.sh.shape[1] != state.splats.sh.shape[1]:  # of other assets: viewers get everything
                self.versions = VersionLog()
            else:
                self.versions.note(version, before.splats, state.splats)
        steps, cursor = self.project.steps()
        original = self.replay.original_of(document)
        self.snapshot = Snapshot(version, state, document, tuple(steps), cursor, original)

    def fold(self, layer: str) -> None:
        """Let the results of a layer's strokes take no more room than they may."""
        # Only after the step is on disk: folding loses nothing, and a crash before it costs room alone.
        replay, document = self.replay.of_layer(self.document, layer)
        folding = replay.fold(document, layer, self.transaction.project.result_bytes)
        self.transaction.clear()
        if folding is not None:
            project = self.transaction.project
            removed = project.fold(folding.keys, folding.key, folding.result, folding.next_key)
            self.replay.forget(removed)
