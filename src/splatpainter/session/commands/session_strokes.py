"""session.strokes: painting into layers that are there, stroke after stroke, and erasing in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera, same_camera
from splatpainter.painter import Edit
from splatpainter.session.commands.scene_edits import paint_in_scene
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.commands.session_layers import SessionLayers
from splatpainter.session.document.document import (
    STROKE_KINDS,
    Document,
    Layer,
    add_layer,
    add_stroke,
    change_layer,
)
from splatpainter.session.document.layer_factory import decode_mask, new_layer
from splatpainter.session.document.layer_operation import LayerOperation, operation_of_layer
from splatpainter.session.kinds.erase_layers import EraseLayer
from splatpainter.session.replay.delta import without_source
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief

if TYPE_CHECKING:
    from splatpainter.lift.side_views import SideViewScore


class SessionStrokes:
    """Strokes of the layers. Each is one step of the history; only the stroke is computed."""

    def __init__(self, core: SessionCore, layers: SessionLayers) -> None:
        self._core, self._layers = core, layers

    def paint(
        self,
        layer: str,
        edits: Sequence[Edit],
        *,
        name: str = "Stroke",
        kind: str = "paint",
        **options: Any,
    ) -> Layer:
        """One more stroke in a paint layer, from any view; returns the layer. Only the stroke is computed, on what the
        strokes before it made (`painted_on` shows that). A layer of local views that `layers.add` made takes strokes
        too, and a merged one: on top of what it is made of, erasers excepted.

        kind: paint, clone, or erase, which takes this layer's paint away, and nothing below it; options: method,
        angle_limit, depth_edge_limit, as of `layers.add`; name: of the step. Raises ValueError as `layers.add`, and for
        a layer that takes no strokes or is hidden."""
        with self._core.command():
            operation = self._operation(kind, options)
            return self._painted(self._core.document, layer, None, edits, name, operation)

    def paint_new(
        self,
        layer_name: str | None,
        edits: Sequence[Edit],
        *,
        name: str = "Stroke",
        kind: str = "paint",
        **options: Any,
    ) -> Layer:
        """`layers.new` and `paint` in one step of the history; nothing where the stroke cannot be painted."""
        core = self._core
        with core.command():
            operation, empty = self._operation(kind, options), self._layers.empty(layer_name)
            if core.document.assets:
                return paint_in_scene(core, empty, edits, name, operation)
            document, layer = add_layer(core.document, empty)
            return self._painted(document, layer.id, core.splats, edits, name, operation)

    def painted_on(self, layer: str) -> Splats:
        """The Gaussians that the next stroke of a layer is painted on: what is below it, with its strokes in full."""
        with self._core.lock:
            return self._core.replay.painted_on(self._core.document, layer)

    def side_scores(self, layer: str) -> list[SideViewScore]:
        """How the latest stroke of a layer, or its edited pictures, look from the side (lift/side_views.py), one score
        per view; without the layer's opacity. Empty for layers that paint nothing or erase."""
        from splatpainter.lift.edit_views import edit_views
        from splatpainter.lift.side_views import side_view_score

        core = self._core
        with core.lock:
            target = core.layer(layer)
            replay, document = core.replay.of_layer(core.document, layer)
            latest = target.strokes[-1] if target.strokes else target
            if not latest.operation.is_local_paint or not target.visible:
                return []
            # The Gaussians before and after it: of the strokes before, or of what is below the layer.
            if target.strokes:
                earlier = change_layer(document, layer, strokes=target.strokes[:-1])
                before, after = replay.painted_on(earlier, layer), replay.painted_on(document, layer)
            else:
                full = change_layer(document, layer, opacity=1.0, blend="normal", mask=None)
                layers = full.layers[: full.index(layer) + 1]
                below = document.layers[: document.index(layer)]
                before, after = (replay.compose(replace(document, layers=some)).splats for some in (below, layers))
            # Under the lock up to here; the renders below need only what was taken, and commands may go on.
            edits = [replay.edit_of(view, latest) for view in latest.views if view.picture is not None]
        masks = [np.ones(edit.image.shape[:2], bool) if edit.mask is None else edit.mask for edit in edits]
        views = edit_views(
            without_source(before), [edit.camera for edit in edits], [edit.image for edit in edits], masks
        )
        return [side_view_score(without_source(before), without_source(after), view) for view in views]

    def erases_on(self, layer: str, cameras: Sequence[Camera]) -> bool:
        """Whether a layer is an eraser (back to the original) of just these views, so that `erase_more` can go on."""
        target = self._core.layer(layer)
        cameras = [self._core.camera_of(target, camera) for camera in cameras]
        views = [view.camera for view in target.views]
        return (
            isinstance(target.operation, EraseLayer)
            and len(views) == len(cameras)
            and all(any(same_camera(view, camera) for camera in cameras) for view in views)
        )

    def erase_more(self, layer: str, edits: Sequence[Edit], *, name: str = "Erase to original") -> Layer:
        """Back to the original where the masks of edits reach, too: those of an eraser layer that `layers.add` made
        grow. Raises ValueError as `layers.add`, for other layers, and for other views than the layer has: each would
        say that what it shows beside its mask stays."""
        core = self._core
        with core.command():
            if not self.erases_on(layer, [edit.camera for edit in edits]):
                raise ValueError(f"{core.layer(layer).title}: expected an eraser of the same views")
            # Masks grow and never shrink: what was erased stays so.
            target, grown = core.layer(layer), []
            for edit in core.edits_of(target, edits):
                (view,) = (one for one in target.views if same_camera(one.camera, edit.camera))
                earlier = decode_mask(core.transaction.blob(view.mask or ""), view.camera, target.title)
                grown.append(replace(edit, mask=earlier if edit.mask is None else earlier | edit.mask))
            fresh, blobs = new_layer(self._layers.below(layer), target.operation, grown, target.name)
            core.transaction.blobs = blobs
            document = change_layer(core.document, layer, views=fresh.views, thumbnail=fresh.thumbnail)
            core.commit(name, document, strict=layer)
            return core.layer(layer)

    def _operation(self, kind: str, options: Mapping[str, Any]) -> LayerOperation:
        """That of a stroke, painted by the painter of now. Raises ValueError for what cannot be a stroke."""
        if kind not in STROKE_KINDS:
            raise ValueError(f"stroke: expected a kind of {', '.join(STROKE_KINDS)}, got {brief(kind)}")
        return operation_of_layer({"kind": kind, **options}, "stroke").repainted(self._core.painter)

    def _painted(
        self,
        document: Document,
        layer: str,
        below: Splats | None,
        edits: Sequence[Edit],
        name: str,
        operation: LayerOperation,
    ) -> Layer:
        """Commit a document with one more stroke. below: what it is painted on, if at hand."""
        core = self._core
        target = document.layers[document.index(layer)]
        # Painting what nobody sees would look as if nothing happened.
        if not target.visible or target.opacity == 0:
            raise ValueError(f"{target.title}: is hidden; show it to paint into it")
        if document.assets:
            return paint_in_scene(core, target, edits, name, operation)
        below = self.painted_on(layer) if below is None else below
        stroke, blobs = new_layer(below, operation, edits, name, cut_out=True)
        # The layer shows its latest stroke; hundreds of small pictures beside it would only take room.
        stroke, thumbnail = replace(stroke, thumbnail=None), stroke.thumbnail
        document, stroke = add_stroke(document, layer, stroke)
        core.transaction.blobs = blobs
        if not operation.reads_below_layer:  # that of an eraser is its mask
            document = change_layer(document, layer, thumbnail=thumbnail)
        core.commit(f"{name} in {target.name}", document, strict=stroke.id)
        core.fold(layer)
        return core.layer(layer)
