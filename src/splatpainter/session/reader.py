"""What a session shows: one immutable version after the other, for any number of readers in other threads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, Camera
from splatpainter.image_files import Alpha
from splatpainter.painter import Painter
from splatpainter.receipts import Receipt, Verification
from splatpainter.rendering.profiles import Profile
from splatpainter.session import conflicts, export
from splatpainter.session.changes import AssetDelta, Changes
from splatpainter.session.layers import Document, Layer
from splatpainter.session.original import OriginalRule
from splatpainter.session.project import Bookmark, Project, Step
from splatpainter.session.replay import Level, Replay
from splatpainter.splats import Splats
from splatpainter.view_files import Aov


@dataclass(frozen=True)
class Shown:
    """One immutable version of the asset, for readers in other threads."""

    version: int
    """Goes up with every change of rows."""
    level: Level
    document: Document
    history: tuple[Step, ...]
    """Oldest first; the first one is the asset as it was opened."""
    cursor: int
    """Place in the history of the step in effect."""

    @property
    def splats(self) -> Splats:
        return self.level.splats


class Reader:
    """The side of a session that changes nothing. `Session` makes its fields."""

    original: Splats
    """As it was opened; `origin` is filled in."""
    painter: Painter
    _project: Project
    _replay: Replay
    _changes: Changes
    _shown: Shown
    _commands: Any
    """The lock of commands (a threading.RLock)."""
    _scratch: Any
    """The folder of a temporary project (a scratch.ScratchFolder), or None."""
    _rule: OriginalRule
    """What may be opened as the original."""

    @property
    def shown(self) -> Shown:
        """The present version, whole: what belongs together stays together while others write."""
        return self._shown

    @property
    def splats(self) -> Splats:
        """The rows as they are shown now; those of the original keep their places."""
        return self._shown.splats

    @property
    def version(self) -> int:
        return self._shown.version

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Lowest first."""
        return self._shown.document.layers

    @property
    def path(self) -> Path | None:
        """The project file; None while it is temporary."""
        return None if self._scratch is not None else self._project.path

    @property
    def up(self) -> str:
        """Which way of the asset is up on the screen: a key of cameras.UPS."""
        up = self._project.fact("up") or AUTO_UP
        return up if up in UPS else AUTO_UP

    @property
    def read_only(self) -> str:
        """Why nothing can be changed; "" where it can."""
        return self._project.read_only

    @property
    def history(self) -> tuple[Step, ...]:
        """Oldest first; the first one is the asset as it was opened."""
        return self._shown.history

    @property
    def cursor(self) -> int:
        """Place in the history of the step in effect."""
        return self._shown.cursor

    def layer(self, layer: str) -> Layer:
        """A layer by its id. Raises ValueError for an unknown one."""
        document = self._shown.document
        return document.layers[document.index(layer)]

    def facts(self, layer: str) -> dict[str, Any]:
        """What is known of a layer's last computation: rows_touched, rows_appended, seconds, method, note, views with
        psnr_before, psnr_after, psnr_outside; "problem" where it cannot be applied. Empty for a hidden layer."""
        return dict(self._shown.level.facts).get(layer, {})

    def blob(self, sha256: str) -> bytes:
        """PNG bytes of a picture, mask or thumbnail that a layer names. Raises ValueError: unknown."""
        return self._project.blob(sha256)

    def conflicts(self) -> list[conflicts.Conflict]:
        """Rows that several layers wrote from different views, and who wins."""
        shown = self._shown
        return conflicts.conflicts(shown.level.touches, shown.document)

    def coverage(self) -> np.ndarray:
        """[N] uint8 per shown row: conflicts.ORIGINAL, SEEN or PREDICTED."""
        shown = self._shown
        return conflicts.coverage(shown.level.touches, len(shown.splats))

    def delta(self, since: int | None = None) -> AssetDelta:
        """What changed since a version that was seen before (None: everything)."""
        while True:
            shown = self._shown
            found = self._changes.since(since, shown.version, shown.splats)
            if self._shown is shown:
                return found

    def prepare(self) -> None:
        """Make now what the next local edit of the shown rows would make first (their voxels), in another thread than
        commands, while the edit is still being drawn. Changes nothing."""
        self._replay.prepare(self._shown.level)

    def bookmarks(self) -> list[Bookmark]:
        """Views to come back to. Not part of the history."""
        return self._project.bookmarks()

    def receipt(self) -> Receipt:
        """Of the whole session: original against now."""
        return self._receipt(self._shown)

    def _receipt(self, shown: Shown) -> Receipt:
        names = ", ".join(layer.name for layer in shown.document.layers if layer.visible) or "none"
        used = {facts.get("precision", "") for _, facts in shown.level.facts}
        precision = next((word for word in ("bfloat16", "float32") if word in used), "")  # the roughest of the layers'
        return export.receipt_between(self.original, shown.splats, self.painter.preset, f"layers: {names}", precision)

    def export(self, path: str | Path, *, overwrite: bool = False) -> tuple[Receipt, Verification]:
        """Write the shown asset and its receipt (NAME.receipt.json), proved by reading it again; the name says the
        format. Raises ValueError: the name, an existing file; RuntimeError: the file does not prove the receipt."""
        shown = self._shown
        return export.export_asset(self.original, shown.splats, self._receipt(shown), Path(path), overwrite)

    def export_view(
        self,
        path: str | Path,
        camera: Camera,
        *,
        bits: int | None = None,
        transparent: Alpha | None = None,
        aovs: Sequence[Aov] = (),
        profile: Profile = "inria",
        overwrite: bool = False,
    ) -> list[Path]:
        """Render the shown asset into NAME.png or NAME.exr, its AOVs (NAME.depth.png, ...; "coverage" is the
        session's) and the sidecar NAME.json; returns their paths. bits, transparent, aovs, profile: as
        view_files.PictureOptions. Raises ValueError: these, the name, an existing file, a missing library."""
        shown = self._shown
        splats, target = shown.splats, Path(path)
        options = export.view_options(target, bits, transparent, tuple(aovs), profile)
        made = export.view_files_of(splats, shown.level.touches, camera, target.stem, options)
        return export.write_files(target.parent, made, overwrite)

    def verify(self, *, repaint: bool = False) -> list[str]:
        """Check everything; what is wrong, one line each. The file's structure and hashes, the original, and that
        replaying the layers gives the shown rows bit for bit; repaint: with every layer computed anew."""
        from splatpainter.session.check import problems

        with self._commands:
            rule = replace(self._rule, at=None)  # what is checked is what the project itself leads to
            return problems(self._project, self._shown, self._replay, repaint, rule)

    def refresh(self) -> bool:
        """For a session that can only be looked at: show what the writer has done since. False: nothing."""
        with self._commands:
            steps, at = self._project.steps()
            document = self._project.document(steps[at].id)
            level = self._replay.compose(document)
            changed = level.key != self._shown.level.key or document != self._shown.document
            self._publish(level, document)
            return changed

    def _publish(self, level: Level, document: Document) -> None:
        before = self._shown
        version = before.version
        if level.key != before.level.key:
            version += 1
            self._changes.note(version, before.splats, level.splats)
        steps, at = self._project.steps()
        self._shown = Shown(version, level, document, tuple(steps), at)
