"""Commands of a session that paint into layers that are there: strokes, and other pictures in place of a layer's."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.jsonio import brief
from splatpainter.painter import Asset, Edit, Method, Painter
from splatpainter.session.commands import Commands
from splatpainter.session.delta import without_source
from splatpainter.session.document import STROKE_KINDS, Document, Kind, Layer, add_layer, add_stroke, change_layer
from splatpainter.session.fingerprint import fingerprint
from splatpainter.session.layer_factory import decode_mask, decode_mask_part, encode_mask_part, new_layer
from splatpainter.session.layer_mask import MAX_PARTS, LayerMask, MaskPart, over
from splatpainter.session.scene_asset import MAIN_ASSET_ID, SceneAsset
from splatpainter.session.scene_replay import SceneReplay
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.decals.decals import Decal, LaidDecal
    from splatpainter.lift.side_views import SideViewScore
    from splatpainter.surface.estimate import Surface


class StrokeCommands(Commands):
    """What Session has beside the layers as such; see there."""

    painter: Painter
    _replay: SceneReplay
    _commands: Any
    """Lock of the commands."""

    @abstractmethod
    def asset(self, asset: str) -> SceneAsset: ...

    @abstractmethod
    def _paint_in_scene(
        self,
        layer: Layer,
        edits: Sequence[Edit],
        name: str,
        kind: Kind,
        method: Method,
        parameters: Mapping[str, Any] | None,
    ) -> Layer: ...

    @abstractmethod
    def _camera_of(self, layer: Layer, camera: Camera) -> Camera: ...

    def new_layer(self, name: str | None = None, *, index: int | None = None, asset: str = MAIN_ASSET_ID) -> Layer:
        """An empty layer that strokes can be painted into (on top, or at an index, 0 the lowest). asset: where there
        are several, the one that it belongs to."""
        with self._command():
            empty = replace(self._empty_layer(name), asset=self.asset(asset).id)
            document, layer = add_layer(self._document, empty, index)
            self._commit(f"new layer {layer.name}", document)
            return layer

    def _empty_layer(self, name: str | None) -> Layer:
        taken = {layer.name for layer in self._document.layers}
        numbered = (f"Paint {k}" if k > 1 else "Paint" for k in count(1))
        name = name or next(name for name in numbered if name not in taken)
        return Layer("", name, "paint", method="lift", painter=fingerprint(self.painter, "lift"))

    def paint(
        self,
        layer: str,
        edits: Sequence[Edit],
        *,
        name: str = "Stroke",
        kind: Kind = "paint",
        method: Method = "auto",
        parameters: Mapping[str, Any] | None = None,
    ) -> Layer:
        """One more stroke in a paint layer, from any view; returns the layer. Only the stroke is computed, on what the
        strokes before it made (`painted_on` shows that). It is one step of the history. A layer of local views that
        `add` made takes strokes too, and a merged one: on top of what it is made of, erasers excepted.

        kind: paint, clone, or erase, which takes this layer's paint away, and nothing below it; parameters:
        angle_limit, depth_edge_limit, as of `add`; name: of the step. Raises ValueError as `add`, and for a layer that
        takes no strokes or is hidden."""
        with self._command():
            document = self._document
            return self._painted(document, layer, None, edits, name, kind, method, parameters)

    def _painted(
        self,
        document: Document,
        layer: str,
        below: Splats | None,
        edits: Sequence[Edit],
        name: str,
        kind: Kind = "paint",
        method: Method = "auto",
        parameters: Mapping[str, Any] | None = None,
    ) -> Layer:
        """Commit a document with one more stroke. below: what it is painted on, if at hand."""
        if kind not in STROKE_KINDS:
            raise ValueError(f"stroke: expected a kind of {', '.join(STROKE_KINDS)}, got {brief(kind)}")
        target = document.layers[document.index(layer)]
        if not target.visible or target.opacity == 0:
            raise ValueError(f"{target.title}: is hidden; show it to paint into it")
        if document.assets:
            return self._paint_in_scene(target, edits, name, kind, method, parameters)
        method = self.painter.choose(method, "local")[0]
        settings = {"mode": "local", "method": method, "painter": fingerprint(self.painter, method)}
        below = self.painted_on(layer) if below is None else below
        stroke, blobs = new_layer(below, kind, edits, name, dict(parameters or {}), settings, cut_out=True)
        stroke, thumbnail = replace(stroke, thumbnail=None), stroke.thumbnail
        document, stroke = add_stroke(document, layer, stroke)
        self._transaction.blobs = blobs
        if kind != "erase":  # that of an eraser is its mask
            document = change_layer(document, layer, thumbnail=thumbnail)
        self._commit(f"{name} in {target.name}", document, strict=stroke.id)
        self._fold(layer)
        return self.layer(layer)

    def _fold(self, layer: str) -> None:
        """Let the results of a layer's strokes take no more room than they may."""
        replay, document = self._replay.of_layer(self._document, layer)
        folding = replay.fold(document, layer, self._transaction.project.result_bytes)
        self._transaction.clear()
        if folding is not None:
            project = self._transaction.project
            removed = project.fold(folding.keys, folding.key, folding.result, folding.next_key)
            self._replay.forget(removed)

    def first_stroke(self, layer_name: str | None, edits: Sequence[Edit], *, name: str = "Stroke", **how: Any) -> Layer:
        """`new_layer` and `paint` in one step of the history; nothing where the stroke cannot be painted."""
        with self._command():
            empty = self._empty_layer(layer_name)
            if self._document.assets:
                values = {"kind": "paint", "method": "auto", "parameters": None, **how}
                return self._paint_in_scene(empty, edits, name, **values)
            document, layer = add_layer(self._document, empty)
            return self._painted(document, layer.id, self.splats, edits, name, **how)

    def painted_on(self, layer: str) -> Splats:
        """The Gaussians that the next stroke of a layer is painted on: what is below it, with its strokes in full."""
        with self._commands:
            return self._replay.painted_on(self._document, layer)

    def below(self, layer: str) -> Splats:
        """The Gaussians below a layer."""
        with self._commands:
            return self._replay.compose(self._document.below(layer)).splats

    def aside(self, layer: str) -> list[SideViewScore]:
        """How the latest stroke of a layer, or its edited pictures, look from the side (lift/side_views.py), one score
        per view; without the layer's opacity. Empty for layers that paint nothing or erase."""
        from splatpainter.lift.edit_views import edit_views
        from splatpainter.lift.side_views import side_view_score

        with self._commands:
            target = self.layer(layer)
            replay, document = self._replay.of_layer(self._document, layer)
            latest = target.strokes[-1] if target.strokes else target
            if latest.kind not in ("paint", "picture", "clone") or latest.mode != "local" or not target.visible:
                return []
            if target.strokes:
                earlier = change_layer(document, layer, strokes=target.strokes[:-1])
                before, after = replay.painted_on(earlier, layer), replay.painted_on(document, layer)
            else:
                full = change_layer(document, layer, opacity=1.0, blend="normal", mask=None)
                layers = full.layers[: full.index(layer) + 1]
                below = document.layers[: document.index(layer)]
                before, after = (replay.compose(replace(document, layers=some)).splats for some in (below, layers))
            edits = [replay.edit_of(view, latest) for view in latest.views if view.picture is not None]
        masks = [np.ones(edit.image.shape[:2], bool) if edit.mask is None else edit.mask for edit in edits]
        views = edit_views(
            without_source(before), [edit.camera for edit in edits], [edit.image for edit in edits], masks
        )
        return [side_view_score(without_source(before), without_source(after), view) for view in views]

    def laid(self, decal: Decal, *, replaces: str | None = None) -> LaidDecal:
        """A decal on the asset as it is now, or on what is below a layer: its edits, for `add("paint", laid.edits)` or
        `replace_views(replaces, laid.edits)`. Raises ValueError as Decal.laid does."""
        asset, surface = self._decal_ground(replaces)
        return decal.laid(asset, surface)

    def decal_map(self, decal: Decal, camera: Camera, *, replaces: str | None = None) -> np.ndarray:
        """[H, W, 2] where `laid` would put it, as a view shows it: places of the decal, world units right and up of its
        middle, NaN beside it. Nothing changes. Raises ValueError as Decal.laid does."""
        asset, surface = self._decal_ground(replaces)
        return decal.placed(asset, surface).map_on(asset, surface, camera.within(asset.splats.offset))

    def _decal_ground(self, replaces: str | None) -> tuple[Asset, Surface]:
        splats = self.splats if replaces is None else self.below(replaces)
        surfaces = self._replay.surfaces(self._document)
        asset = Asset(
            replace(without_source(splats), origin=np.arange(len(splats))), original=without_source(surfaces.original)
        )
        return asset, surfaces.surface

    def replace_views(
        self,
        layer: str,
        edits: Sequence[Edit],
        *,
        name: str | None = None,
        parameters: Mapping[str, Any] | None = None,
        gesture: str | None = None,
        attached: Sequence[bytes] = (),
    ) -> Layer:
        """Other pictures in a layer that stays where it is, with its opacity and blend: other words of a text, another
        state of a picture. It is visible then. name, parameters: None: as they are; gesture: as of `set`; attached: as
        of `add`. Raises ValueError as `add`, and for a layer without pictures."""
        with self._command():
            before = self.layer(layer)
            if before.kind not in ("paint", "picture", "clone") or before.holds_strokes:
                raise ValueError(f"{before.title}: expected a layer of edited pictures")
            settings = {
                "mode": before.mode,
                "method": before.method,
                "painter": fingerprint(self.painter, before.method),
            }
            values = dict(before.parameters if parameters is None else parameters)
            edits = self._edits_of(before, edits)
            fresh, blobs = new_layer(self.below(layer), before.kind, edits, name or before.name, values, settings)
            self._transaction.blobs = blobs | {files.sha256(data): data for data in attached}
            fields = {"views": fresh.views, "thumbnail": fresh.thumbnail, "painter": fresh.painter, "visible": True}
            fields |= {"name": fresh.name, "parameters": fresh.parameters}
            document = change_layer(self._document, layer, **fields)
            self._commit(f"change {before.name}", document, strict=layer, gesture=gesture)
            return self.layer(layer)

    def erases_on(self, layer: str, cameras: Sequence[Camera]) -> bool:
        """Whether a layer is an eraser (back to the original) of just these views, so that `erase_more` can go on."""
        target = self.layer(layer)
        cameras = [self._camera_of(target, camera) for camera in cameras]
        views = [view.camera for view in target.views]
        return (
            target.kind == "erase"
            and len(views) == len(cameras)
            and all(any(_same(view, camera) for camera in cameras) for view in views)
        )

    def erase_more(self, layer: str, edits: Sequence[Edit], *, name: str = "Erase to original") -> Layer:
        """Back to the original where the masks of edits reach, too: those of an eraser layer that `add` made grow. It
        is one step of the history. Raises ValueError as `add`, for other layers, and for other views than the layer
        has: each would say that what it shows beside its mask stays."""
        with self._command():
            if not self.erases_on(layer, [edit.camera for edit in edits]):
                raise ValueError(f"{self.layer(layer).title}: expected an eraser of the same views")
            target, grown = self.layer(layer), []
            for edit in self._edits_of(target, edits):
                (view,) = (one for one in target.views if _same(one.camera, edit.camera))
                earlier = decode_mask(self._transaction.blob(view.mask or ""), view.camera, target.title)
                grown.append(replace(edit, mask=earlier if edit.mask is None else earlier | edit.mask))
            settings = {"mode": "local", "method": target.method, "painter": target.painter}
            fresh, blobs = new_layer(self.below(layer), "erase", grown, target.name, {}, settings)
            self._transaction.blobs = blobs
            document = change_layer(self._document, layer, views=fresh.views, thumbnail=fresh.thumbnail)
            self._commit(name, document, strict=layer)
            return self.layer(layer)

    def set_mask(self, layer: str, mask: LayerMask | None, *, what: str = "mask", gesture: str | None = None) -> Layer:
        """Another mask of a layer of any kind (layer_mask.py); None: all of it shows. what: of the step; gesture: as of
        `set`."""
        with self._command():
            document = change_layer(self._document, layer, mask=mask)
            self._commit(f"{what} of {self.layer(layer).name}", document, gesture=gesture)
            return self.layer(layer)

    def mask_area(self, layer: str, camera: Camera, shows: np.ndarray) -> Layer:
        """A mask that shows what is selected on one view ([H, W] 0..1), and nothing else."""
        with self._command():
            data = encode_mask_part(shows, np.ones_like(shows))
            self._transaction.blobs = {files.sha256(data): data}
            camera = self._camera_of(self.layer(layer), camera)
            mask = LayerMask(False, (MaskPart(camera, files.sha256(data)),))
            self._commit(f"mask (area) of {self.layer(layer).name}", change_layer(self._document, layer, mask=mask))
            return self.layer(layer)

    def paint_mask(
        self, layer: str, camera: Camera, shows: np.ndarray, share: np.ndarray, *, name: str = "paint"
    ) -> Layer:
        """Change a layer's mask on one view. shows: [H, W] 0 (nothing of the layer) to 1 (all); share: [H, W] 0..1, how
        far to go there. Raises ValueError: other shapes, nothing to change, too many parts."""
        shape = (camera.height, camera.width)
        if shows.shape != shape or share.shape != shape:
            raise ValueError(f"mask: expected pictures of shape {list(shape)}, got {list(shows.shape)}")
        if not share.any():
            raise ValueError("mask: nothing was painted")
        with self._command():
            mask, camera = self.layer(layer).mask or LayerMask(), self._camera_of(self.layer(layer), camera)
            parts, last = mask.parts, mask.parts[-1] if mask.parts else None
            if last is not None and last.camera is not None and last.picture is not None and _same(last.camera, camera):
                earlier = decode_mask_part(self._transaction.blob(last.picture), camera, "mask")
                shows, share = over(earlier[..., 0], earlier[..., 1], shows, share)
                parts = parts[:-1]
            if len(parts) >= MAX_PARTS:
                raise ValueError(f"mask: was painted from {MAX_PARTS} views; make another layer")
            data = encode_mask_part(shows, share)
            self._transaction.blobs = {files.sha256(data): data}
            part = MaskPart(camera, files.sha256(data))
            document = change_layer(self._document, layer, mask=replace(mask, parts=(*parts, part), enabled=True))
            self._commit(f"{name} in the mask of {self.layer(layer).name}", document)
            return self.layer(layer)


def _same(a: Camera, b: Camera) -> bool:
    return a == b and np.array_equal(a.world_to_camera, b.world_to_camera)
