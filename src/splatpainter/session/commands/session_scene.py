"""session.scene: the assets of a session, where they stand, and which way they are looked at.

    vase = session.scene.add("vase.ply")                             # beside what is there
    session.scene.set(vase.id, placement=Placement.of(move=(0, -0.4, 0)))
    session.files.export("scene.ply")                                # every asset in its own range of rows
    session.files.export("vase.ply", asset=vase.id)                  # one alone, against its own file

Pictures, masks and weights of commands are of the scene; a layer belongs to one asset (scene_edits.py).
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import UPS, Camera
from splatpainter.io import files, read
from splatpainter.io.formats.sog_container import META
from splatpainter.io.positions import Offset
from splatpainter.scene.placement import Placement, check_near, shift_to_the_right
from splatpainter.scene.seam import match_seam, seam_weights
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.document.document import Document, Layer, add_layer
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, MAX_ASSETS, MAX_NAME, SceneAsset, changed_asset
from splatpainter.session.kinds.look_layers import look_of
from splatpainter.session.measures.orientation import Orientation, azimuth_of, measure, parsed_direction
from splatpainter.session.project import asset_files
from splatpainter.session.selection.selection import Selection
from splatpainter.splats import Axes, Splats
from splatpainter.system.old_names import formerly

SETTABLE = ("name", "placement", "visible")
"""What `set` can change of an asset."""


class SessionScene:
    """The assets. Adding, changing and removing them are steps of the history; which way is up is none."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core
        self._measured: tuple[tuple[str | None, str | None], Orientation] | None = None
        """(what the project says of up and front, what follows): measuring draws the asset from all sides."""

    # ---- what there is

    @property
    def assets(self) -> tuple[SceneAsset, ...]:
        """The assets of the scene; the first one (id "") is that which the session was opened with."""
        return self._core.assets

    def asset(self, asset: str) -> SceneAsset:
        """The asset of this id. Raises ValueError for an unknown one."""
        return self._core.asset(asset)

    def splats_of(self, asset: str) -> Splats:
        """The Gaussians of one asset with its layers, in its own space. Raises ValueError for an unknown one."""
        core = self._core
        with core.lock:
            document = core.document
            return core.replay.replay(document, asset).compose(document.part(asset)).splats

    def original_of(self, asset: str) -> Splats:
        """The Gaussians of one asset as they were read, in its own space. Raises ValueError for an unknown one."""
        return self._core.replay.replay(self._core.document, asset).original

    # ---- which way it is looked at: no step of the history, and no Gaussian changes

    @property
    def up(self) -> str:
        """Which way of the asset is up on the screen: a key of cameras.UPS; measured where nobody has said it."""
        return self._orientation().up

    @property
    def front(self) -> float:
        """From which side the asset is seen first: degrees around `up`, the `start` of cameras.orbit; measured where
        nobody has said it."""
        return self._orientation().front

    @property
    def is_oriented(self) -> bool:
        """Whether somebody has said which way is up, or where the front is."""
        return bool(self._core.project.fact("up") or self._core.project.fact("front"))

    def set_up(self, up: str) -> None:
        """Which way of the asset is up on the screen: a key of cameras.UPS. Raises ValueError for another one."""
        if up not in UPS:
            raise ValueError(f"up: expected one of {', '.join(UPS)}, got {str(up)[:20]!r}")
        self._core.project.set_fact("up", up)

    def set_front(self, camera: Camera) -> None:
        """The side that a view shows is the front, from which the asset is seen first."""
        self._core.project.set_fact("front", json.dumps(np.round(camera.forward, 6).tolist()))

    def _orientation(self) -> Orientation:
        up, front = self._core.project.fact("up"), self._core.project.fact("front")
        key = (up, front)
        if self._measured is None or self._measured[0] != key:
            chosen = measure(self._core.original, up if up in UPS else None)
            if front:
                chosen = replace(chosen, front=azimuth_of(parsed_direction(front), chosen.up))
            self._measured = (key, chosen)
        return self._measured[1]

    # ---- the list of assets

    @formerly(axes="frame")
    def add(
        self,
        asset: Splats | str | Path,
        *,
        name: str | None = None,
        placement: Placement | None = None,
        axes: Axes = "auto",
    ) -> SceneAsset:
        """Another asset in the scene: a splat file, or its Gaussians as read. The project keeps its bytes. placement:
        None: as it is, but to the right of what is there. Raises ValueError: it cannot be read, has no Gaussians that
        can be drawn, its colours are of another space; too many assets."""
        splats = asset if isinstance(asset, Splats) else read(asset, axes=axes)
        splats = splats.numpy()
        # The project keeps the file's bytes, so that exports of this asset can be proved against them.
        path = asset_files.file_of(splats)
        if path is None or splats.source is None:
            raise ValueError("asset: expected one that was read from a file which is still there")
        title = files.printable(name or path.name, MAX_NAME)
        if not splats.drawable.any():
            raise ValueError(f"asset {title}: none of its {len(splats)} Gaussians can be drawn")
        core = self._core
        with core.command():
            document = core.document
            main = core.replay.main.original
            if splats.color_space != main.color_space:
                spaces = f"{splats.color_space}, those of the session's {main.color_space}"
                raise ValueError(f"asset {title}: its colours are {spaces}; convert it first")
            if len(core.assets) >= MAX_ASSETS:
                raise ValueError(f"asset {title}: expected at most {MAX_ASSETS} assets")
            # Beside what is there, so that it is seen at once and hides nothing.
            if placement is None:
                existing, new = (rows.world_means[rows.drawable] for rows in (core.splats, splats))
                placement = Placement(shift_to_the_right(existing, new))
            _check_reach(title, splats, placement, main.offset)
            # Bytes and original go along with the step: until it is committed the project knows neither.
            stored = META if path.is_dir() or path.name.lower() == META else path.name
            added = SceneAsset(
                str(document.next_id),
                title,
                placement,
                True,
                stored,
                splats.sha256,
                asset_files.stored_axes(splats),
                splats.offset,
            )
            core.transaction.files = ((added.folder + file, data) for file, data in asset_files.pieces(splats, path))
            core.replay.remember(added, asset_files.numbered(splats))
            document = replace(document, assets=(*core.assets, added), next_id=document.next_id + 1)
            core.commit(f"add asset {title}", document)
            return added

    def set(self, asset: str, *, gesture: str | None = None, **values: Any) -> SceneAsset:
        """Change an asset's name, placement or visible. gesture: as of `layers.set`. Raises ValueError: unknown, out of
        reach, the last visible one."""
        unknown = set(values) - set(SETTABLE)
        if unknown or not values:
            given = ", ".join(sorted(unknown)) or "nothing"
            raise ValueError(f"asset: expected one of {', '.join(SETTABLE)} to set, got {given}")
        core = self._core
        with core.command():
            document, before = core.document, core.asset(asset)
            assets = changed_asset(core.assets, asset, **values)
            if not any(one.visible for one in assets):
                raise ValueError(f"asset {before.name}: is the only one that is visible")
            if "placement" in values:
                original = core.replay.replay(document, asset).original
                _check_reach(before.name, original, values["placement"], core.replay.main.original.offset)
            verb = {"placement": "move", "name": "rename", "visible": "show" if values.get("visible") else "hide"}
            label = f"{verb[next(iter(values))]} asset {before.name}"
            core.commit(label, _with_assets(document, assets), gesture=gesture)
            return core.asset(asset)

    def remove(self, asset: str) -> None:
        """Take an asset out of the scene, with its layers. Raises ValueError for the first one, whose session it is."""
        core = self._core
        with core.command():
            document, before = core.document, core.asset(asset)
            if asset == MAIN_ASSET_ID:
                raise ValueError(f"asset {before.name}: is the one that was opened; hide it instead")
            rest = tuple(one for one in core.assets if one.id != asset)
            if not any(one.visible for one in rest):
                raise ValueError(f"asset {before.name}: is the only one that is visible")
            layers = tuple(layer for layer in document.layers if layer.asset != asset)
            # Policies of layers that go would name ids that are never given again.
            ids = replace(document, layers=layers).leaf_ids()
            policies = tuple(entry for entry in document.policies if entry[0] in ids and entry[1] in ids)
            document = replace(document, layers=layers, policies=policies)
            core.commit(f"remove asset {before.name}", _with_assets(document, rest))

    def match_seam(self, asset: str, *, to: str | None = None, falloff: float = 0.0) -> Layer:
        """An adjustment layer of an asset that brings its colours to those of another one (None: of all others that
        are visible) where they are near to each other (scene/seam.py). falloff: world units over which it fades out
        from the seam; 0: it holds everywhere. Raises ValueError: they are not near to each other."""
        core = self._core
        with core.command():
            document, name = core.document, core.asset(asset).name
            parts = {part.asset.id: part for part in core.scene().parts} if document.assets else {}
            moving = parts.pop(asset, None)
            neighbours = [part for key, part in parts.items() if to in (None, key)]
            if moving is None or not neighbours:
                raise ValueError(f"asset {name}: expected it and another one visible to match their colours")
            placed = [part.placed(part.state.splats) for part in neighbours]
            # Only as many bands as all have: neighbours of other files may hold fewer.
            fixed = placed[0]
            for more in placed[1:]:
                bands = min(fixed.sh.shape[1], more.sh.shape[1])  # base colours count
                fixed = replace(fixed, sh=fixed.sh[:, :bands], origin=None)
                fixed = fixed.append(replace(more, sh=more.sh[:, :bands], origin=None))
            scene_splats = moving.placed(moving.state.splats)
            match = match_seam(scene_splats, fixed, falloff)
            selection = None
            if falloff:
                weights = seam_weights(scene_splats, fixed, falloff)
                data = Selection.of(weights, moving.state.splats, moving.original).to_png()
                core.transaction.blobs = {files.sha256(data): data}
                selection = files.sha256(data)
            look = look_of(match.parameters(moving.state.splats.color_space), selection)
            document, layer = add_layer(document, Layer("", "Match seam", look, asset=asset))
            core.commit(f"match seam of {name}", document, strict=layer.id)
            return layer


def _with_assets(document: Document, assets: tuple[SceneAsset, ...]) -> Document:
    """The document with these assets; none are listed where the first one is alone and unchanged."""
    # One asset as it is needs no list: it is composed, and stored, as before there was a second one.
    alone = len(assets) == 1 and assets[0].placement.is_identity and assets[0].visible
    return replace(document, assets=() if alone else assets)


def _check_reach(name: str, splats: Splats, placement: Placement, scene: Offset) -> None:
    """Raises ValueError where a placement takes Gaussians out of what can be drawn, or so far from where the scene is
    that its positions would be rounded."""
    inside = placement.apply(splats, scene)
    check_near(f"asset {name}", inside)
    if inside is not splats and inside.drawable.sum() < splats.drawable.sum():
        raise ValueError(f"asset {name}: its transform takes Gaussians out of what can be drawn; use smaller numbers")
