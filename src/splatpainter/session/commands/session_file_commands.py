"""session.files: what a session gives out (receipts, the asset or the scene as a file, views, single layers), and the
project file that it lives in.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import Alpha
from splatpainter.io import FORMATS, format_of_name
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.receipts import MAX_CARRIED, Receipt, Verification, can_carry
from splatpainter.rendering.profiles import Profile
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.document.document import Document, Layer, add_layer
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, find_asset
from splatpainter.session.project import asset_files
from splatpainter.session.project.asset_files import ORIGINAL_FACTS
from splatpainter.session.project.database import SUFFIX
from splatpainter.session.project.holder import other_holder
from splatpainter.session.project.lock import ProjectLock
from splatpainter.session.project.project_file import Project
from splatpainter.session.project.project_summary import PICTURE_FACT
from splatpainter.session.project.scene_export import export_scene, scene_receipt
from splatpainter.session.replay.snapshot import Snapshot
from splatpainter.splats import Axes, Splats
from splatpainter.view_files import Aov


class SessionFileCommands:
    """Files of a session. Only `import_layer` is a step of the history."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core
        self._project_id: str | None = None

    # ---- the asset

    def receipt(self, *, asset: str | None = None) -> Receipt:
        """Receipt of the session: the original against the asset as it is now. asset: of several, that of this id
        alone."""
        return self._receipt(self._exported(asset))

    def _receipt(self, snapshot: Snapshot, options: WriteOptions = AS_IT_IS) -> Receipt:
        note = ", ".join(layer.name for layer in snapshot.document.layers if layer.visible) or "none"
        # One word for all: a receipt must not promise more than the roughest layer keeps.
        used = {facts.get("precision", "") for _, facts in snapshot.state.facts}
        precision = next((word for word in ("bfloat16", "float32") if word in used), "")  # the roughest of the layers'
        words = (self._core.painter.preset, f"layers: {note}", precision)
        if snapshot.document.assets:
            receipt = scene_receipt(self._core.replay.scene(snapshot.document), *words)
        else:
            receipt = asset_files.receipt_between(snapshot.original, snapshot.splats, *words, options)
        return replace(receipt, source=_sources_of(snapshot.document))

    def export(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        remove_hidden: bool = False,
        asset: str | None = None,
        options: WriteOptions = AS_IT_IS,
        axes: Axes = "auto",
    ) -> tuple[Receipt, Verification]:
        """Write the asset as it is now and its receipt (NAME.receipt.json), proved by reading it again; the name says
        the format. Of several assets all that are visible, each in its own range of rows, or one of them alone (asset:
        its id) in its own space, as an edit of its own file. remove_hidden: without the Gaussians of opacity 0, for
        good (not of a scene); the receipt says how many, and compares those that remain. options: what the file shall
        hold less or otherwise (not of a scene); the receipt names it, and compares with the original written so. axes:
        of the file's numbers (not of a scene), "rub" is y up, "rdf" y down; "auto": as the format usually has them.
        Raises ValueError: the name, an existing file, nothing visible, an option that the format has not;
        RuntimeError: the file does not prove the receipt."""
        # One snapshot for file and receipt: commands may go on meanwhile.
        snapshot, target = self._exported(asset), Path(path)
        if snapshot.document.assets:
            if remove_hidden:
                raise ValueError("export: hidden Gaussians are removed of one asset at a time; name it")
            if options != AS_IT_IS or axes != "auto":
                raise ValueError("export: options are for one asset at a time; name it")
            return export_scene(self._core.replay.scene(snapshot.document), self._receipt(snapshot), target, overwrite)
        asset_files.check_target(target, overwrite)
        # Judged before anything is computed: an option that the format has not is a quick error.
        options.check(FORMATS[format_of_name(target) or ""].write_options, str(target))
        write = asset_files.export_visible if remove_hidden else asset_files.export_asset
        return write(snapshot.original, snapshot.splats, self._receipt(snapshot, options), target, overwrite, axes)

    def exported(self, *, remove_hidden: bool = False, asset: str | None = None) -> Splats:
        """The Gaussians that `export` would write."""
        splats = self._exported(asset).splats
        hidden = remove_hidden and not (splats.opacities > 0).all()
        return splats.take(np.flatnonzero(splats.opacities > 0)) if hidden else splats

    def _exported(self, asset: str | None) -> Snapshot:
        return self._core.snapshot if asset is None else self._alone(self._core.snapshot, asset)

    def _alone(self, snapshot: Snapshot, asset: str) -> Snapshot:
        """One asset of a snapshot, in its own space. Raises ValueError for an unknown one."""
        document = snapshot.document
        find_asset(document.assets or self._core.assets, asset)
        with self._core.lock:
            replay, part = self._core.replay.replay(document, asset), document.part(asset)
            return replace(snapshot, state=replay.compose(part), document=part, original=replay.original)

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
        """Render the asset into NAME.png or NAME.exr, its AOVs (NAME.depth.png, ...; "coverage" is the
        session's) and the sidecar NAME.json; returns their paths. bits, transparent, aovs, profile: as
        view_files.PictureOptions. Raises ValueError: these, the name, an existing file, a missing library."""
        snapshot, target = self._core.snapshot, Path(path)
        options = asset_files.view_options(target, bits, transparent, tuple(aovs), profile)
        contents = asset_files.view_files_of(snapshot.splats, snapshot.state.edited, camera, target.stem, options)
        return asset_files.write_files(target.parent, contents, overwrite)

    # ---- single layers

    def export_layer(self, layer: str, path: str | Path, *, overwrite: bool = False) -> None:
        """One layer with its pictures as a .splatlayer file."""
        asset_files.write_layer(Path(path), self._core.layer(layer), self.blob, overwrite)

    def import_layer(self, path: str | Path, *, asset: str = MAIN_ASSET_ID) -> Layer:
        """Add the layer of a .splatlayer file on top. Raises ValueError: not such a file, or it cannot be applied."""
        core = self._core
        with core.command():
            layer, core.transaction.blobs = asset_files.read_layer(Path(path))
            document, layer = add_layer(core.document, replace(layer, asset=core.asset(asset).id))
            core.commit(f"import {layer.name}", document, strict=layer.id)
            return layer

    # ---- the project file

    def save_as(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Go on in a project file of another name (from a temporary one: move there). The old file stays as it is."""
        core = self._core
        with core.lock:
            target = project_path(path)
            if target == core.project.path:
                core.project.check_file()
                return  # all of it is there already
            # Copied, opened and only then let go of: whatever fails before, the session stays where it is.
            core.project.copy(target, overwrite)
            old, scratch = core.project, core.scratch
            core.project, core.scratch = Project.open(target, readonly=False), None
            core.transaction.project = core.project
            old.close(is_copied=True)
            if scratch is not None:
                scratch.close()

    def save_copy(self, path: str | Path, *, overwrite: bool = False) -> None:
        """A copy of the project in another file; the session stays where it is."""
        self._core.project.copy(project_path(path), overwrite)

    def take_over(self, despite_note: bool = False) -> None:
        """Go on in a project that can only be looked at because it was open elsewhere, once nobody has it open: what is
        shown is then the newest that was done in it, and it can be changed. Does nothing where it can be changed
        already. despite_note: also where a note says that another computer has it open (`noted_computer`), as its user
        knows better; one that does have it open acknowledges nothing more. Raises ValueError, and nothing changes: it
        is open elsewhere still or again, is gone, cannot be written, or is of another original now."""
        core = self._core
        with core.lock:
            old = core.project
            if not old.read_only:
                return
            # Opened, shown and only then let go of: whatever fails before, the session goes on showing what it did.
            fresh = Project.open(old.path, readonly=False, despite_note=despite_note)
            try:
                if any(old.fact(name) != fresh.fact(name) for name in ORIGINAL_FACTS):
                    raise ValueError(f"{old.path}: another project has this name now; open it anew")
                core.project = core.transaction.project = fresh
                core.reload()
            except BaseException:
                core.project = core.transaction.project = old
                core.transaction.clear()
                fresh.close()
                raise
            old.close()

    def settling_later(self) -> AbstractContextManager[None]:
        """What commands do meanwhile is on the disk when they return, but in the log beside the project file until
        `settle`, or until the session next looks at the file: for a server that has an answer to give in between."""
        return self._core.project.settling_later()

    def settle(self) -> None:
        """Bring what is in the log into the one file."""
        self._core.project.settle()

    @property
    def can_be_taken_over(self) -> bool:
        """Whether the project can only be looked at because it was open elsewhere, and nobody has it open any more.
        Cheap enough to be asked every few seconds. Raises OSError: its folder cannot be reached."""
        return self._was_let_go_of and not other_holder(self._core.project.path)

    @property
    def noted_computer(self) -> str:
        """Name of the computer that, as a note says, has a project open that can only be looked at here, or did not
        close it, while nobody here has it open; "": none. Whether it is open there its user knows."""
        return other_holder(self._core.project.path) if self._was_let_go_of else ""

    @property
    def _was_let_go_of(self) -> bool:
        project = self._core.project
        return project.was_held and project.path.is_file() and ProjectLock.is_free(project.path)

    @property
    def project_id(self) -> str:
        """What the project has of its own, by chance, since it was made, wherever it is moved; "" of older ones."""
        if self._project_id is None:  # read once: the file may be another program's by now
            self._project_id = self._core.project.fact("id") or ""
        return self._project_id

    @property
    def is_in_place(self) -> bool:
        """Whether the project file is still the one that was opened: not deleted, moved, replaced or overwritten."""
        try:
            self._core.project.check_file()
        except ValueError:
            return False
        return True

    def blob(self, sha256: str) -> bytes:
        """PNG bytes of a picture, mask or thumbnail that a layer names. Raises ValueError: unknown."""
        return self._core.project.blob(sha256)

    def set_picture(self, png: bytes) -> None:
        """A small PNG of the asset as it is now, for lists of projects (project_summary.py). Not part of the
        history."""
        self._core.project.set_fact(PICTURE_FACT, base64.b64encode(png).decode())

    @property
    def has_picture(self) -> bool:
        """Whether `set_picture` was called, in this session or before."""
        return self._core.project.fact(PICTURE_FACT) is not None


def project_path(path: str | Path) -> Path:
    """The absolute path of a project file. Raises ValueError for a name of another ending."""
    if Path(path).suffix.lower() != SUFFIX:
        raise ValueError(f"{path}: expected a project file name ending in {SUFFIX}")
    return Path(path).absolute()


def _sources_of(document: Document) -> dict[str, Any] | None:
    """What a receipt says of the picture sources of the visible layers, by the layers' names; None: there are none."""
    leaves = [leaf for layer in document.layers if layer.visible for leaf in layer.leaves() if leaf.visible]
    records = []
    for leaf in leaves:
        source = getattr(leaf.operation, "source", None)
        record = {"layer": leaf.name[:200], **source} if isinstance(source, dict) else {}
        if record and can_carry({"layers": [record]}):
            records.append(record)
    return {"layers": records[:MAX_CARRIED]} if records else None
