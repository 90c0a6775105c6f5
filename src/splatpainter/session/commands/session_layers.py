"""session.layers: the layers of a session, lowest first, and what can be done to them.

    stroke = session.layers.add("paint", [Edit(picture, camera, mask)])
    session.layers.set(stroke.id, opacity=0.5)
    [layer.name for layer in session.layers]

Each command is one step of the history, and on disk when it returns. Painting into a layer: session.strokes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, overload

import numpy as np

from splatpainter.holes.body import body_or_selection
from splatpainter.io import files
from splatpainter.operations.light import Relight
from splatpainter.operations.operation import Operation
from splatpainter.painter import Edit
from splatpainter.scene.placement import Placement
from splatpainter.session.commands.scene_edits import add_to_scene, relief_on_asset
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.commands.session_selections import SessionSelections
from splatpainter.session.document.document import (
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
from splatpainter.session.document.layer_factory import (
    encode_mask,
    encode_picture,
    new_layer,
    thumbnail,
)
from splatpainter.session.document.layer_operation import LayerOperation, layer_kinds, operation_of_layer
from splatpainter.session.document.layer_view import Blend, View
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID
from splatpainter.session.kinds.fill_layers import SELECTED, FillLayer, FillWhere
from splatpainter.session.kinds.hide_layers import HideLayer
from splatpainter.session.kinds.operation_layers import OperationLayer
from splatpainter.session.kinds.painted_layers import PaintedLayer, PaintLayer
from splatpainter.session.kinds.relief_layers import ReliefLayer
from splatpainter.session.replay import conflicts
from splatpainter.session.replay.snapshot import Snapshot
from splatpainter.session.selection.selection import Selection
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief

SETTABLE = ("name", "visible", "opacity", "blend")
"""What `set` can change of any layer."""


class SessionLayers(Sequence[Layer]):
    """The layers as they are now, lowest first. To hold on to those of one moment: Session.snapshot."""

    def __init__(self, core: SessionCore, selections: SessionSelections) -> None:
        self._core, self._selections = core, selections

    # ---- what there is: changes nothing

    def __len__(self) -> int:
        return len(self._core.document.layers)

    def __iter__(self) -> Iterator[Layer]:
        return iter(self._core.document.layers)

    @overload
    def __getitem__(self, index: int) -> Layer: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Layer, ...]: ...
    def __getitem__(self, index: int | slice) -> Layer | tuple[Layer, ...]:
        return self._core.document.layers[index]

    def by_id(self, layer: str) -> Layer:
        """A layer by its id. Raises ValueError for an unknown one."""
        return self._core.layer(layer)

    def facts(self, layer: str) -> dict[str, Any]:
        """What is known of a layer's last computation: rows_touched, rows_appended, seconds, method, note, views with
        psnr_before, psnr_after, psnr_outside; "problem" where it cannot be applied. Empty for a hidden layer."""
        return dict(self._core.snapshot.state.facts).get(layer, {})

    def below(self, layer: str) -> Splats:
        """The Gaussians below a layer."""
        with self._core.lock:
            return self._core.replay.compose(self._core.document.below(layer)).splats

    def painted(self, name: str) -> np.ndarray:
        """[N] float32 per Gaussian of the session: 1 where the visible layers of this name paint. Raises ValueError
        where none does."""
        snapshot = self._core.snapshot
        # A merged layer paints through those inside it, which are what the state lists.
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

    def filled_by(self, layer: str) -> np.ndarray:
        """[N] bool per Gaussian of the session: those of a fill layer. Raises ValueError for another layer, and where
        it is hidden or changes nothing."""
        snapshot = self._core.snapshot
        out = np.zeros(len(snapshot.splats), bool)
        for entry in snapshot.state.edited:
            if entry.layer.id == layer and isinstance(entry.layer.operation, FillLayer):
                out[slice(*entry.appended)] = True
        if not out.any():
            raise ValueError(f"{self.by_id(layer).title}: expected a visible layer that fills a hole")
        return out

    def confidence(self, layer: str) -> np.ndarray:
        """[N] float32 0..1 per Gaussian of the session: how sure a layer of mode spread is that it is of the painted
        material (1: painted). Raises ValueError for another layer, and for one that is hidden."""
        snapshot = self._core.snapshot
        for entry in snapshot.state.edited:
            operation = entry.layer.operation
            spreads = isinstance(operation, PaintedLayer) and operation.spreads
            if entry.layer.id == layer and spreads and entry.confidence is not None:
                out = np.zeros(len(snapshot.splats), np.float32)
                out[: len(entry.confidence)] = entry.confidence / np.float32(255)
                return out
        raise ValueError(f"{self.by_id(layer).title}: expected a visible layer of mode spread")

    def coverage(self) -> np.ndarray:
        """[N] uint8 per Gaussian of the session: conflicts.ORIGINAL, SEEN or PREDICTED."""
        snapshot = self._core.snapshot
        return conflicts.coverage(snapshot.state.edited, len(snapshot.splats))

    def conflicts(self) -> list[conflicts.Conflict]:
        """Gaussians that several layers changed from different views, and who wins."""
        snapshot = self._core.snapshot
        return conflicts.find_conflicts(snapshot.state.edited, snapshot.document)

    def blend_preview(
        self, layer: str, *, opacity: float | None = None, blend: Blend | None = None, visible: bool | None = None
    ) -> tuple[np.ndarray, Splats] | None:
        """([C] int64 ascending ids, C Gaussians): what `set` will show of a layer, where nothing has to be painted anew
        for it, to be seen until all is done; None where that is as quick, or where it cannot be said. Ids beyond
        `Session.splats` are of Gaussians that follow them."""
        core = self._core
        with core.lock:
            # Under the lock, as it composes: a command must not publish in between.
            document = core.document
            values = {"opacity": opacity, "blend": blend, "visible": visible}
            fields = {name: value for name, value in values.items() if value is not None}
            return core.replay.blend_preview(change_layer(document, layer, **fields), layer, document)

    def under_turned_lights(self, degrees: float, center: np.ndarray, snapshot: Snapshot | None = None) -> Splats:
        """The Gaussians with the lights of all visible layers of light turned about the vertical through a centre ([3]
        world coordinates), counter-clockwise seen from above; nothing is stored. snapshot: None: as it is now. Raises
        ValueError: there is no such layer."""
        core = self._core
        with core.lock:
            document, count = (snapshot or core.snapshot).document, 0
            for layer in document.layers:
                operation = layer.operation
                if not isinstance(operation, OperationLayer) or not isinstance(operation.operation, Relight):
                    continue
                placed = core.asset(layer.asset).placement if document.assets else Placement()
                lit = operation.operation.turned(degrees, placed.point_before(center))
                document = change_layer(document, layer.id, operation=replace(operation, operation=lit))
                count += layer.visible
            if not count:
                raise ValueError("light: no layer of light is visible; add a light first, for it to turn")
            try:
                return core.replay.compose(document).splats
            finally:
                # What was computed for one picture of a film is no result of a step.
                core.replay.forget(set(core.transaction.results))
                core.transaction.clear()

    def color_preview(
        self, layer: str, *, opacity: float | None = None, **options: Any
    ) -> tuple[np.ndarray, Splats] | None:
        """([C] int64 ascending ids, C Gaussians of base colours alone): nearly what `set` will show of a layer, in a
        fraction of the time and with nothing stored, while options are dragged; None: its kind has no such way, or
        layers above hide it. Raises ValueError as `set`."""
        core = self._core
        with core.lock:
            document = core.document
            fields: dict[str, Any] = {"operation": core.layer(layer).operation.with_options(options)}
            fields |= {} if opacity is None else {"opacity": opacity}
            return core.replay.color_preview(change_layer(document, layer, **fields), layer, document)

    # ---- new layers

    def add(
        self,
        what: str | LayerOperation | Operation,
        edits: Sequence[Edit] = (),
        *,
        name: str | None = None,
        opacity: float = 1.0,
        blend: Blend = "normal",
        index: int | None = None,
        attached: Sequence[bytes] = (),
        asset: str | None = None,
        **options: Any,
    ) -> Layer:
        """A new layer (on top, or at an index, 0 the lowest) and its result.

        what: a kind of layer (layer_operation.KINDS) with its options, or the value of both, or an operation
        (sp.Relight(...)), of whose files the project holds what it needs. paint, picture, clone: edits with pictures;
        look (an adjustment layer): pictures that grade everything, or look=NAME and settings, with edits whose masks
        limit it; erase: edits of which only cameras and masks count; light, delight: no edits. Pictures are kept with 8
        bits. A local edit without a mask gets the one of what differs from the asset now. options: the fields of the
        kind's dataclass (kinds/): mode, method, angle_limit, spread_threshold, ... attached: PNG bytes that options
        name by their hash (a selection, the image of a sticker), kept with the layer. asset: of several, the one that
        it is for; None: a layer for each that it reaches (that with the most pixels is returned). Raises ValueError as
        Painter.apply does, with nothing changed."""
        core = self._core
        with core.command():
            # The painter of now is written into the layer, so that another one later does not change it.
            if isinstance(what, Operation):
                what, held = held_by_project(what)
                attached = [*attached, *held]
            operation = operation_from(what, options).repainted(core.painter)
            mixing: dict[str, Any] = {"opacity": opacity, "blend": blend}
            if core.document.assets:
                return add_to_scene(core, operation, edits, name, index, attached, asset, **mixing)
            layer, blobs = new_layer(core.splats, operation, edits, name, **mixing)
            core.transaction.blobs = blobs | {files.sha256(data): data for data in attached}
            document, layer = add_layer(core.document, layer, index)
            core.commit(f"add {layer.name}", document, strict=layer.id)
            return layer

    def new(self, name: str | None = None, *, index: int | None = None, asset: str = MAIN_ASSET_ID) -> Layer:
        """An empty layer that strokes can be painted into (on top, or at an index, 0 the lowest). asset: where there
        are several, the one that it belongs to."""
        core = self._core
        with core.command():
            empty = replace(self.empty(name), asset=core.asset(asset).id)
            document, layer = add_layer(core.document, empty, index)
            core.commit(f"new layer {layer.name}", document)
            return layer

    def empty(self, name: str | None) -> Layer:
        """A paint layer without an id, which is in no document yet. name: None: the next free one."""
        taken = {layer.name for layer in self}
        numbered = (f"Paint {k}" if k > 1 else "Paint" for k in count(1))
        name = name or next(name for name in numbered if name not in taken)
        return Layer("", name, PaintLayer().repainted(self._core.painter, "lift"))

    def hide_selected(self, weights: np.ndarray, name: str = "Hide", *, index: int | None = None) -> Layer:
        """A layer that hides what is selected: opacities are multiplied by 1 - weight, and 0 where that is all. The
        Gaussians stay; hiding the layer brings them back bit for bit. weights: [N] 0..1 of `Session.splats`. Raises
        ValueError where nothing is selected."""
        core = self._core
        weights = core.checked_weights(weights)
        if not weights.any():
            raise ValueError("hide: nothing is selected")
        with core.command():
            document, added = core.document, []
            # One layer per asset, all in one step: undo takes back what one gesture did.
            for asset, hidden in self._hidden(weights):
                document, layer = add_layer(document, Layer("", name, hidden, asset=asset), index)
                added.append(layer)
            core.commit(f"add {name}", document, strict=[layer.id for layer in added])
            return added[0]

    def copy_relief(self, relief: ReliefLayer, name: str = "Copy", *, index: int | None = None) -> Layer:
        """A layer of Gaussians that are copied with their relief from one place of the surface to another
        (relief_layers.py). Raises ValueError where there is nothing to copy, or too much."""
        core = self._core
        with core.command():
            asset, relief = relief_on_asset(core, relief)
            document, layer = add_layer(core.document, Layer("", name, relief, asset=asset), index)
            core.commit(f"add {layer.name}", document, strict=layer.id)
            return layer

    def body(self, weights: np.ndarray, beside: np.ndarray | None = None) -> tuple[np.ndarray, str]:
        """([N] 0..1 weights of the whole connected body that a selection is of, ""), or, where that is a part of
        something larger, the weights themselves and a line that says so. weights: [N] 0..1 of `Session.splats`; beside:
        [N] bool, where an outline on a view chose them: Gaussians drawn beside it (pixel_shares.beside_mask), so that a
        neighbour that touches what is outlined stays."""
        weights = self._core.checked_weights(weights)
        selected = weights >= SELECTED
        chosen, words = body_or_selection(self._core.splats.numpy(), selected, beside)
        return (weights, words) if chosen is selected else (chosen.astype(np.float32), "")

    def fill(
        self,
        weights: np.ndarray,
        *,
        remove: bool = False,
        body: bool = False,
        beside: np.ndarray | None = None,
        name: str = "Fill",
    ) -> Layer:
        """A layer of new Gaussians that continue the surface over a hole, in colours of what surrounds it
        (holes/fill.py); nothing else changes. weights: [N] 0..1 of `Session.splats`: Gaussians around the hole, as
        circling it selects them; or (remove) those that go first, by a layer below that hides them. Both layers are one
        step of the history; where the surface behind is closed the upper one is empty, and its note says so. body: what
        goes is the whole connected body that they are of, as far as there is one (holes/body.py); beside: as for
        `body`. Of several assets a
        hole is in that which most of the weights are of; what is removed goes from all, and every one is filled. Raises
        ValueError where nothing is selected, and where there is no hole that can be filled."""
        core = self._core
        weights = core.checked_weights(weights)
        if not weights.any():
            raise ValueError("fill: nothing is selected; select what is to be removed, or circle a hole")
        # The layer keeps which it was: a removed body and a circled hole are found in different ways on replay.
        where: FillWhere = "removed" if remove else "around"
        if remove and body:
            weights, _ = self.body(weights, beside)
        with core.command():
            document, added = core.document, []
            # What is removed goes from every asset that it is selected on; a circled hole is in one.
            for asset, hidden in self._hidden(weights)[: None if remove else 1]:
                if remove:
                    document, _ = add_layer(document, Layer("", f"{name}: removed", hidden, asset=asset))
                filling = FillLayer(fill=where, selection=hidden.selection)
                document, layer = add_layer(document, Layer("", name, filling, asset=asset))
                added.append(layer)
            core.commit("remove and fill" if remove else f"add {name}", document, strict=added[0].id)
            return added[0]

    # ---- layers changed

    def set(self, layer: str, *, gesture: str | None = None, attached: Sequence[bytes] = (), **values: Any) -> Layer:
        """Change a layer's name, visible, opacity or blend, or options of its kind (kinds/), such as angle_limit of
        paint or settings of a look; method: it is then painted anew, by the painter of now. gesture: steps of one
        gesture (a slider that is dragged) in a row are one step of the history. attached: as of `add`."""
        core = self._core
        with core.command():
            target = core.layer(layer)
            core.transaction.blobs = {files.sha256(data): data for data in attached}
            # All names are judged before anything is changed, so that a wrong one leaves the layer as it is.
            fields = {name: value for name, value in values.items() if name in SETTABLE}
            options = {name: value for name, value in values.items() if name not in SETTABLE}
            settable = (*SETTABLE, *target.operation.option_names())
            unknown = [name for name in values if name not in settable]
            if unknown or not values:
                given = ", ".join(unknown) or "nothing"
                raise ValueError(f"layer: expected one of {', '.join(settable)} to set, got {given}")
            if options:
                # Another method means another painter of the layer and of every stroke in it.
                operation = target.operation.with_options(options)
                if "method" in options:
                    method = options["method"]
                    operation = operation.repainted(core.painter, method)
                    fields["strokes"] = tuple(
                        replace(one, operation=one.operation.repainted(core.painter, method)) for one in target.strokes
                    )
                fields["operation"] = operation
            document = change_layer(core.document, layer, **fields)
            verb = {"visible": "show" if values.get("visible") else "hide", "name": "rename"}
            first = next(iter(values))
            words = verb.get(first, f"set the {first.replace('_', ' ')} of")  # as "mask of", "in the mask of"
            label = f"{words} {core.layer(layer).name}"
            core.commit(label, document, gesture=gesture)
            return core.layer(layer)

    def move(self, layer: str, index: int) -> None:
        """Move a layer: 0 is the lowest index."""
        core = self._core
        with core.command():
            core.commit(f"move {core.layer(layer).name}", move_layer(core.document, layer, index))

    def duplicate(self, layer: str) -> Layer:
        """Add a copy of a layer right above it."""
        core = self._core
        with core.command():
            document, copy = duplicate_layer(core.document, layer)
            core.commit(f"duplicate {core.layer(layer).name}", document)
            return copy

    def delete(self, layer: str) -> None:
        """Remove a layer from the document."""
        core = self._core
        with core.command():
            core.commit(f"delete {core.layer(layer).name}", delete_layer(core.document, layer))

    def merge(self, layers: Sequence[str], name: str | None = None) -> Layer:
        """Neighbouring layers become one, which shows the same, bit for bit."""
        core = self._core
        with core.command():
            document, one = merge_layers(core.document, layers, name)
            core.commit(f"merge {len(one.layers)} layers", document)
            return one

    def resolve_conflict(self, lower: str, upper: str, policy: Policy) -> None:
        """Who wins where two layers changed the same Gaussians: "latest" (the upper one), "first" (the lower), "blend"
        (half of each)."""
        core = self._core
        with core.command():
            core.commit(f"conflict: {policy}", resolve_conflict(core.document, lower, upper, policy))

    def replace_views(
        self,
        layer: str,
        edits: Sequence[Edit],
        *,
        name: str | None = None,
        gesture: str | None = None,
        attached: Sequence[bytes] = (),
        **options: Any,
    ) -> Layer:
        """Other pictures in a layer that stays where it is, with its opacity and blend: other words of a text, another
        state of a picture. It is visible then. name: None: as it is; gesture: as of `set`; attached: as of `add`;
        options: those of its kind that change. Raises ValueError as `add`, and for a layer without pictures."""
        core = self._core
        with core.command():
            before = core.layer(layer)
            if not before.operation.lays_paint or not before.operation.takes_pictures or before.holds_strokes:
                raise ValueError(f"{before.title}: expected a layer of edited pictures")
            operation = before.operation.with_options(options).repainted(core.painter)
            edits = core.edits_of(before, edits)
            # Judged against what is below, where the layer's pictures will be laid, not against what is shown.
            fresh, blobs = new_layer(self.below(layer), operation, edits, name or before.name)
            core.transaction.blobs = blobs | {files.sha256(data): data for data in attached}
            fields = {"views": fresh.views, "thumbnail": fresh.thumbnail, "operation": operation, "visible": True}
            fields["name"] = fresh.name
            document = change_layer(core.document, layer, **fields)
            core.commit(f"change {before.name}", document, strict=layer, gesture=gesture)
            return core.layer(layer)

    def fill_from(
        self, layer: str, edits: Sequence[Edit], *, source: Mapping[str, Any] | None = None, name: str | None = None
    ) -> Layer:
        """Other colours of a fill layer: those of pictures with masks, such as a source makes of views that show it
        filled; none: of the surroundings again. source: what receipts say of who made them. Only the layer's own
        Gaussians take them. Raises ValueError for another layer, and a picture without a mask."""
        core = self._core
        with core.command():
            before = core.layer(layer)
            if not isinstance(before.operation, FillLayer):
                raise ValueError(f"{before.title}: expected a layer that fills a hole")
            blobs: dict[str, bytes] = {}

            def put(data: bytes) -> str:
                blobs[files.sha256(data)] = data
                return files.sha256(data)

            # Masks are asked for before the first picture is encoded: an edit without one fails with nothing stored.
            views, small = [], None
            for edit in edits:
                if edit.mask is None:
                    raise ValueError(f"{edit.name}: expected a mask with a picture that colours a fill")
            for edit in core.edits_of(before, edits) if edits else ():
                picture = put(encode_picture(edit.image, core.splats.color_space))
                mask = np.ones(edit.image.shape[:2], bool) if edit.mask is None else edit.mask
                views.append(View(edit.camera, picture, put(encode_mask(mask))))
                small = small or put(thumbnail(edit.image, mask))
            operation = replace(before.operation, source=None if source is None else dict(source))
            core.transaction.blobs = blobs
            fields = {"views": tuple(views), "thumbnail": small, "operation": operation, "visible": True}
            document = change_layer(core.document, layer, name=name or before.name, **fields)
            core.commit(f"change {before.name}", document, strict=layer)
            return core.layer(layer)

    def _hidden(self, weights: np.ndarray) -> list[tuple[str, HideLayer]]:
        """(asset, what hides the selected part of it), that with the most weight first; selections are among the blobs
        of the transaction."""
        hidden, blobs = [], {}
        for part in self._selections.by_asset(weights):
            # Stored under its hash with the step: a layer must not depend on what is selected later.
            data = Selection.of(part.weights, part.splats, part.original).to_png()
            blobs[files.sha256(data)] = data
            hidden.append((part.asset, HideLayer(selection=files.sha256(data))))
        self._core.transaction.blobs = blobs
        return hidden


def held_by_project(operation: Operation) -> tuple[OperationLayer, list[bytes]]:
    """(an operation as a layer, PNG bytes that it names by their hash): of its files what a project holds of them."""
    packed, held = operation.packed()
    return OperationLayer(packed, held={name: files.sha256(data) for name, data in held.items()}), [*held.values()]


def operation_from(what: str | LayerOperation | Operation, options: Mapping[str, Any]) -> LayerOperation:
    """What a layer is to be: a kind with options, or the value of both. Raises ValueError for what is none."""
    if isinstance(what, str):
        return operation_of_layer({"kind": what, **options}, "layer")
    operation = OperationLayer(what) if isinstance(what, Operation) else what
    if not isinstance(operation, LayerOperation):
        raise ValueError(f"layer: expected a kind of {', '.join(layer_kinds())}, or its value, got {brief(what)}")
    return operation.with_options(options) if options else operation
