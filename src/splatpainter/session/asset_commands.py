"""Commands of a session that holds several assets: adding, moving, hiding and removing them, and what makes a layer of
each asset that an edit of the scene reaches.

    vase = session.add_asset("vase.ply")                       # beside what is there
    session.set_asset(vase.id, placement=Placement.of(move=(0, -0.4, 0)))
    session.export("scene.ply")                                # every asset in its own range of rows
    session.export("vase.ply", asset=vase.id)                  # one alone, against its own file

Pictures, masks and weights of commands are of the scene. A layer belongs to one asset and lives in its space: a stroke
over two assets goes into a layer of each, in one step of the history.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files, read
from splatpainter.io.formats.sog_container import META
from splatpainter.painter import Edit, Method
from splatpainter.scene.placement import Placement, shift_to_the_right
from splatpainter.scene.seam import match_seam, seam_weights
from splatpainter.session import asset_files
from splatpainter.session.document import SELECTION, Document, Kind, Layer, add_layer, add_stroke, change_layer
from splatpainter.session.fingerprint import fingerprint
from splatpainter.session.geometry_commands import SelectedPart
from splatpainter.session.layer_factory import new_layer
from splatpainter.session.relief import CopyAnchor, Relief
from splatpainter.session.scene_asset import MAIN_ASSET_ID, MAX_ASSETS, MAX_NAME, SceneAsset, changed_asset, find_asset
from splatpainter.session.scene_replay import Scene, ScenePart
from splatpainter.session.selection import Selection
from splatpainter.session.snapshot import Snapshot
from splatpainter.session.split_edits import split_edits
from splatpainter.session.stroke_commands import StrokeCommands
from splatpainter.splats import Frame, Splats

SETTABLE = ("name", "placement", "visible")


class AssetCommands(StrokeCommands):
    """Session's commands on assets; a part of Session."""

    @property
    def snapshot(self) -> Snapshot:
        """The present version."""
        raise NotImplementedError

    # ---- what there is

    @property
    def assets(self) -> tuple[SceneAsset, ...]:
        """The assets of the scene; the first one (id "") is that which the session was opened with."""
        return self._document.assets or (self._main_asset(),)

    def _main_asset(self) -> SceneAsset:
        name = files.printable(self._transaction.project.fact("name") or "asset", MAX_NAME)
        return SceneAsset(MAIN_ASSET_ID, name or "asset")

    def asset(self, asset: str) -> SceneAsset:
        """The asset of this id. Raises ValueError for an unknown one."""
        return find_asset(self.assets, asset)

    def asset_splats(self, asset: str) -> Splats:
        """The Gaussians of one asset with its layers, in its own space. Raises ValueError for an unknown one."""
        with self._commands:
            document = self._document
            return self._replay.replay(document, asset).compose(document.part(asset)).splats

    def asset_original(self, asset: str) -> Splats:
        """The Gaussians of one asset as they were read, in its own space. Raises ValueError for an unknown one."""
        return self._replay.replay(self._document, asset).original

    def _scene(self) -> Scene:
        """The present one; of a session with several assets."""
        return self._replay.scene(self._document)

    # ---- the list of assets

    def add_asset(
        self,
        asset: Splats | str | Path,
        *,
        name: str | None = None,
        placement: Placement | None = None,
        frame: Frame = "auto",
    ) -> SceneAsset:
        """Another asset in the scene: a splat file, or its Gaussians as read. The project keeps its bytes. placement:
        None: as it is, but to the right of what is there. Raises ValueError: it cannot be read, has no Gaussians that
        can be drawn, its colours are of another space; too many assets."""
        splats = asset if isinstance(asset, Splats) else read(asset, frame=frame)
        splats = splats.numpy()
        path = asset_files.file_of(splats)
        if path is None or splats.source is None:
            raise ValueError("asset: expected one that was read from a file which is still there")
        title = files.printable(name or path.name, MAX_NAME)
        if not splats.drawable.any():
            raise ValueError(f"asset {title}: none of its {len(splats)} Gaussians can be drawn")
        with self._command():
            document = self._document
            main = self._replay.main.original
            if any(splats.offset) or any(main.offset):
                where = title if any(splats.offset) else self.assets[0].name
                raise ValueError(
                    f"asset {title}: {where} has positions that float32 cannot hold, and stands alone; move it near 0 "
                    "(subtract its offset, as info shows it) to put it together with others"
                )
            if splats.color_space != main.color_space:
                spaces = f"{splats.color_space}, those of the session's {main.color_space}"
                raise ValueError(f"asset {title}: its colours are {spaces}; convert it first")
            if len(self.assets) >= MAX_ASSETS:
                raise ValueError(f"asset {title}: expected at most {MAX_ASSETS} assets")
            if placement is None:
                existing, new = (rows.means[rows.drawable] for rows in (self.splats, splats))
                placement = Placement(shift_to_the_right(existing, new))
            _check_reach(title, splats, placement)
            stored = META if path.is_dir() else path.name
            added = SceneAsset(
                str(document.next_id), title, placement, True, stored, splats.sha256, asset_files.stored_frame(splats)
            )
            self._transaction.files = ((added.folder + file, data) for file, data in asset_files.pieces(splats, path))
            self._replay.remember(added, asset_files.numbered(splats))
            document = replace(document, assets=(*self.assets, added), next_id=document.next_id + 1)
            self._commit(f"add asset {title}", document)
            return added

    def set_asset(self, asset: str, *, gesture: str | None = None, **values: Any) -> SceneAsset:
        """Change an asset's name, placement or visible. gesture: as of `set`. Raises ValueError: unknown, out of reach,
        the last visible one."""
        unknown = set(values) - set(SETTABLE)
        if unknown or not values:
            given = ", ".join(sorted(unknown)) or "nothing"
            raise ValueError(f"asset: expected one of {', '.join(SETTABLE)} to set, got {given}")
        with self._command():
            document, before = self._document, self.asset(asset)
            assets = changed_asset(self.assets, asset, **values)
            if not any(one.visible for one in assets):
                raise ValueError(f"asset {before.name}: is the only one that is visible")
            if "placement" in values:
                original = self._replay.replay(document, asset).original
                _check_reach(before.name, original, values["placement"])
            verb = {"placement": "move", "name": "rename", "visible": "show" if values.get("visible") else "hide"}
            label = f"{verb[next(iter(values))]} asset {before.name}"
            self._commit(label, _with_assets(document, assets), gesture=gesture)
            return self.asset(asset)

    def remove_asset(self, asset: str) -> None:
        """Take an asset out of the scene, with its layers. Raises ValueError for the first one, whose session it is."""
        with self._command():
            document, before = self._document, self.asset(asset)
            if asset == MAIN_ASSET_ID:
                raise ValueError(f"asset {before.name}: is the one that was opened; hide it instead")
            rest = tuple(one for one in self.assets if one.id != asset)
            if not any(one.visible for one in rest):
                raise ValueError(f"asset {before.name}: is the only one that is visible")
            layers = tuple(layer for layer in document.layers if layer.asset != asset)
            ids = replace(document, layers=layers).leaf_ids()
            policies = tuple(entry for entry in document.policies if entry[0] in ids and entry[1] in ids)
            document = replace(document, layers=layers, policies=policies)
            self._commit(f"remove asset {before.name}", _with_assets(document, rest))

    def match_seam(self, asset: str, *, to: str | None = None, falloff: float = 0.0) -> Layer:
        """An adjustment layer of an asset that brings its colours to those of another one (None: of all others that
        are visible) where they are near to each other (scene/seam.py). falloff: world units over which it fades out
        from the seam; 0: it holds everywhere. Raises ValueError: they are not near to each other."""
        with self._command():
            document, name = self._document, self.asset(asset).name
            parts = {part.asset.id: part for part in self._scene().parts} if document.assets else {}
            moving = parts.pop(asset, None)
            neighbours = [part for key, part in parts.items() if to in (None, key)]
            if moving is None or not neighbours:
                raise ValueError(f"asset {name}: expected it and another one visible to match their colours")
            placed = [part.asset.placement.apply(part.state.splats) for part in neighbours]
            fixed = placed[0]
            for more in placed[1:]:
                bands = min(fixed.sh.shape[1], more.sh.shape[1])  # base colours count
                fixed = replace(fixed, sh=fixed.sh[:, :bands], origin=None)
                fixed = fixed.append(replace(more, sh=more.sh[:, :bands], origin=None))
            scene_splats = moving.asset.placement.apply(moving.state.splats)
            match = match_seam(scene_splats, fixed, falloff)
            parameters = match.parameters(moving.state.splats.color_space)
            if falloff:
                weights = seam_weights(scene_splats, fixed, falloff)
                data = Selection.of(weights, moving.state.splats, moving.original).to_png()
                self._transaction.blobs = {files.sha256(data): data}
                parameters[SELECTION] = files.sha256(data)
            look = Layer("", "Match seam", "look", parameters=parameters, mode="global", method="lift", asset=asset)
            document, layer = add_layer(document, look)
            self._commit(f"match seam of {name}", document, strict=layer.id)
            return layer

    # ---- edits of a scene: a layer of each asset that they reach

    def _add_to_scene(
        self,
        kind: Kind,
        edits: Sequence[Edit],
        name: str | None,
        parameters: Mapping[str, Any],
        settings: Mapping[str, Any],
        index: int | None,
        attached: Sequence[bytes],
        asset: str | None,
    ) -> Layer:
        """`Session.add` where there are several assets: the layer of the asset that most of it is of."""
        scene, document = self._scene(), self._document
        blobs = {files.sha256(data): data for data in attached}
        masked = kind != "look" and settings["mode"] != "global"
        shares = split_edits(scene, edits, masked) if edits else [(part, []) for part in scene.parts]
        shares = [share for share in shares if asset in (None, share[0].asset.id)]
        selected = parameters.get(SELECTION)
        added: list[Layer] = []
        for part, pieces in shares:
            values = dict(parameters)
            if isinstance(selected, str):
                data = _part_of_selection(blobs.get(selected) or self._transaction.blob(selected), scene, part)
                if data is None:
                    continue
                values[SELECTION] = files.sha256(data)
                blobs[values[SELECTION]] = data
            layer, pictures = new_layer(part.state.splats, kind, pieces, name, values, settings)
            blobs |= pictures
            document, layer = add_layer(document, replace(layer, asset=part.asset.id), index)
            added.append(layer)
        if not added:
            raise ValueError("layer: nothing to do, it reaches no visible asset that was chosen")
        self._transaction.blobs = blobs
        self._commit(f"add {added[0].name}", document, strict=added[0].id)
        return added[0]

    def _paint_in_scene(
        self,
        layer: Layer,
        edits: Sequence[Edit],
        name: str,
        kind: Kind,
        method: Method,
        parameters: Mapping[str, Any] | None,
    ) -> Layer:
        """A stroke of a scene: into `layer` on its asset, and into one of that name on every other asset that it
        reaches (an eraser: not there). layer: without an id, one is made where it is needed."""
        scene, document = self._scene(), self._document
        method = self.painter.choose(method, "local")[0]
        settings = {"mode": "local", "method": method, "painter": fingerprint(self.painter, method)}
        shares = split_edits(scene, edits)
        if kind == "erase" and layer.id:
            shares = [share for share in shares if share[0].asset.id == layer.asset]
            if not shares:
                raise ValueError(f"{layer.title}: its asset is not under the stroke; nothing is left to erase")
        targets, stroke_ids, blobs = [], [], {}
        for part, pieces in shares:
            document, target = _target(document, layer, part.asset.id)
            below = part.state.splats
            stroke, pictures = new_layer(below, kind, pieces, name, dict(parameters or {}), settings, cut_out=True)
            stroke, thumbnail = replace(stroke, thumbnail=None), stroke.thumbnail
            document, stroke = add_stroke(document, target, stroke)
            if kind != "erase":  # that of an eraser is its mask
                document = change_layer(document, target, thumbnail=thumbnail)
            blobs |= pictures
            targets.append(target)
            stroke_ids.append(stroke.id)
        self._transaction.blobs = blobs
        self._commit(f"{name} in {layer.name}", document, strict=stroke_ids[0])
        for target in targets:
            self._fold(target)
        return self.layer(targets[0])

    def selected_parts(self, weights: np.ndarray) -> list[SelectedPart]:
        """Weights of the scene by asset, those of which anything is selected, the most first. Those of one asset: as
        they are."""
        if not self._document.assets:
            snapshot = self.snapshot
            return [SelectedPart(MAIN_ASSET_ID, weights, snapshot.splats, snapshot.original)]
        parts = [
            SelectedPart(part.asset.id, weights[part.scene_ids], part.state.splats, part.original)
            for part in self._scene().parts
        ]
        return sorted((part for part in parts if part.weights.any()), key=lambda part: -float(part.weights.sum()))

    def _edits_of(self, layer: Layer, edits: Sequence[Edit]) -> list[Edit]:
        """Edits of the scene as edits of a layer's asset alone. Raises ValueError where they do not reach it."""
        if not self._document.assets:
            return [edit.relative_to(self.snapshot.original.offset) for edit in edits]
        for part, pieces in split_edits(self._scene(), edits, layer.mode != "global"):
            if part.asset.id == layer.asset:
                return pieces
        raise ValueError(f"{layer.title}: its asset is not under the picture")

    def _camera_of(self, layer: Layer, camera: Camera) -> Camera:
        """A camera of the scene in the space of a layer's asset."""
        return self.asset(layer.asset).placement.camera(camera.relative_to(self.snapshot.original.offset))

    def _relief_of(self, relief: Relief) -> tuple[str, Relief]:
        """(the asset that a copy is on, the copy in its space). Raises ValueError where it is on two."""
        if not self._document.assets:
            return MAIN_ASSET_ID, relief
        scene = self._scene()
        splats = scene.state.splats
        visible = np.flatnonzero(splats.drawable & (splats.opacities > 0))
        numbers = []
        for anchor in (relief.source, relief.target):
            near = visible[((splats.means[visible] - anchor.point) ** 2).sum(1).argmin()]
            numbers.append(int(scene.asset_numbers[near]))
        if numbers[0] != numbers[1]:
            raise ValueError("copy: expected the source and the target on one asset")
        asset = scene.parts[numbers[0]].asset
        placement = asset.placement

        def inside(anchor: CopyAnchor) -> CopyAnchor:
            point = placement.matrix.T @ (anchor.point - np.array(placement.move)) / placement.scale
            return CopyAnchor(point, placement.matrix.T @ anchor.axes)

        return asset.id, Relief(inside(relief.source), inside(relief.target), relief.radius / placement.scale)


def _with_assets(document: Document, assets: tuple[SceneAsset, ...]) -> Document:
    """The document with these assets; none are listed where the first one is alone and unchanged."""
    alone = len(assets) == 1 and assets[0].placement.is_identity and assets[0].visible
    return replace(document, assets=() if alone else assets)


def _target(document: Document, layer: Layer, asset: str) -> tuple[Document, str]:
    """(document, id) of the layer that a stroke goes into on an asset: `layer` on its own; else the topmost paint layer
    of that name, made where there is none."""
    if layer.id and layer.asset == asset:
        return document, layer.id
    for other in reversed(document.layers if layer.id else ()):
        if other.asset == asset and other.name == layer.name and other.holds_strokes:
            if other.visible and other.opacity > 0:
                return document, other.id
    empty = Layer("", layer.name, "paint", method="lift", painter=layer.painter, asset=asset)
    document, added = add_layer(document, empty)
    return document, added.id


def _part_of_selection(data: bytes, scene: Scene, part: ScenePart) -> bytes | None:
    """A selection of the scene as one of an asset; None where it selects nothing there."""
    selection = Selection.from_png(data, len(scene.original))
    weights = selection.on(scene.state.splats, scene.original)[part.scene_ids]
    if not weights.any():
        return None
    return Selection.of(weights, part.state.splats, part.original).to_png()


def _check_reach(name: str, splats: Splats, placement: Placement) -> None:
    """Raises ValueError where a placement takes Gaussians out of what can be drawn."""
    if not placement.is_identity and placement.apply(splats).drawable.sum() < splats.drawable.sum():
        raise ValueError(f"asset {name}: its transform takes Gaussians out of what can be drawn; use smaller numbers")
