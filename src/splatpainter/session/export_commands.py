"""What a session gives out: receipts, the asset or the scene as a file, and views."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import Alpha
from splatpainter.io import FORMATS, format_of_name
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.painter import Painter
from splatpainter.receipts import MAX_CARRIED, Receipt, Verification, can_carry
from splatpainter.rendering.profiles import Profile
from splatpainter.session import asset_files
from splatpainter.session.document import SOURCE, Document
from splatpainter.session.scene_asset import SceneAsset, find_asset
from splatpainter.session.scene_export import export_scene, scene_receipt
from splatpainter.session.scene_replay import SceneReplay
from splatpainter.session.snapshot import Snapshot
from splatpainter.splats import Splats
from splatpainter.view_files import Aov


class ExportCommands(ABC):
    """Session's exports; a part of Session."""

    painter: Painter
    _replay: SceneReplay
    _snapshot: Snapshot
    _commands: Any

    @property
    @abstractmethod
    def assets(self) -> tuple[SceneAsset, ...]: ...

    def receipt(self) -> Receipt:
        """Receipt of the session: the original against the asset as it is now."""
        return self._receipt(self._snapshot)

    def _receipt(self, snapshot: Snapshot, options: WriteOptions = AS_IT_IS) -> Receipt:
        note = ", ".join(layer.name for layer in snapshot.document.layers if layer.visible) or "none"
        used = {facts.get("precision", "") for _, facts in snapshot.state.facts}
        precision = next((word for word in ("bfloat16", "float32") if word in used), "")  # the roughest of the layers'
        words = (self.painter.preset, f"layers: {note}", precision)
        if snapshot.document.assets:
            receipt = scene_receipt(self._replay.scene(snapshot.document), *words)
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
    ) -> tuple[Receipt, Verification]:
        """Write the asset as it is now and its receipt (NAME.receipt.json), proved by reading it again; the name says
        the format. Of several assets all that are visible, each in its own range of rows, or one of them alone (asset:
        its id) in its own space, as an edit of its own file. remove_hidden: without the Gaussians of opacity 0, for
        good (not of a scene); the receipt says how many, and compares those that remain. options: what the file shall
        hold less or otherwise (not of a scene); the receipt names it, and compares with the original written so.
        Raises ValueError: the name, an existing file, nothing visible, an option that the format has not;
        RuntimeError: the file does not prove the receipt."""
        snapshot, target = self._exported(asset), Path(path)
        if snapshot.document.assets:
            if remove_hidden:
                raise ValueError("export: hidden Gaussians are removed of one asset at a time; name it")
            if options != AS_IT_IS:
                raise ValueError("export: options are for one asset at a time; name it")
            return export_scene(self._replay.scene(snapshot.document), self._receipt(snapshot), target, overwrite)
        asset_files.check_target(target, overwrite)
        options.check(FORMATS[format_of_name(target) or ""].write_options, str(target))
        write = asset_files.export_visible if remove_hidden else asset_files.export_asset
        return write(snapshot.original, snapshot.splats, self._receipt(snapshot, options), target, overwrite)

    def exported(self, *, remove_hidden: bool = False, asset: str | None = None) -> Splats:
        """The Gaussians that `export` would write."""
        splats = self._exported(asset).splats
        hidden = remove_hidden and not (splats.opacities > 0).all()
        return splats.take(np.flatnonzero(splats.opacities > 0)) if hidden else splats

    def _exported(self, asset: str | None) -> Snapshot:
        return self._snapshot if asset is None else self._alone(self._snapshot, asset)

    def _alone(self, snapshot: Snapshot, asset: str) -> Snapshot:
        """One asset of a snapshot, in its own space. Raises ValueError for an unknown one."""
        document = snapshot.document
        find_asset(document.assets or self.assets, asset)
        with self._commands:
            replay, part = self._replay.replay(document, asset), document.part(asset)
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
        snapshot, target = self._snapshot, Path(path)
        options = asset_files.view_options(target, bits, transparent, tuple(aovs), profile)
        contents = asset_files.view_files_of(snapshot.splats, snapshot.state.edited, camera, target.stem, options)
        return asset_files.write_files(target.parent, contents, overwrite)


def _sources_of(document: Document) -> dict[str, Any] | None:
    """What a receipt says of the picture sources of the visible layers, by the layers' names; None: there are none."""
    leaves = [leaf for layer in document.layers if layer.visible for leaf in layer.leaves() if leaf.visible]
    records = []
    for leaf in leaves:
        source = leaf.parameters.get(SOURCE)
        record = {"layer": leaf.name[:200], **source} if isinstance(source, dict) else {}
        if record and can_carry({"layers": [record]}):
            records.append(record)
    return {"layers": records[:MAX_CARRIED]} if records else None
