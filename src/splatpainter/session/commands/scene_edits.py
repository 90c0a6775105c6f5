"""Edits of a scene of several assets: a layer, or a stroke, on each asset that they reach, in one step of the history.

Pictures, masks and weights of commands are of the scene. A layer belongs to one asset and lives in its space, so a
stroke over two assets goes into a layer of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.io import files
from splatpainter.kernels.portable import matmul
from splatpainter.painter import Edit
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.document.document import Document, Layer, add_layer, add_stroke, change_layer
from splatpainter.session.document.layer_factory import new_layer
from splatpainter.session.document.layer_operation import LayerOperation
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID
from splatpainter.session.kinds.relief_layers import CopyAnchor, ReliefLayer
from splatpainter.session.replay.scene_replay import Scene, ScenePart
from splatpainter.session.replay.split_edits import split_edits
from splatpainter.session.selection.selection import Selection


def add_to_scene(
    core: SessionCore,
    operation: LayerOperation,
    edits: Sequence[Edit],
    name: str | None,
    index: int | None,
    attached: Sequence[bytes],
    asset: str | None,
    **mixing: Any,
) -> Layer:
    """`layers.add` where there are several assets: the layer of the asset that most of it is of. mixing: opacity and
    blend."""
    scene, document = core.scene(), core.document
    blobs = {files.sha256(data): data for data in attached}
    shares = split_edits(scene, edits, operation.needs_masks) if edits else [(part, []) for part in scene.parts]
    # With an asset named only that one takes part, whatever else the picture shows.
    shares = [share for share in shares if asset in (None, share[0].asset.id)]
    selected = getattr(operation, "selection", None)
    # A selection of the scene becomes one of each asset: layers live in the space of theirs.
    added: list[Layer] = []
    for part, pieces in shares:
        part_operation = operation
        if selected:
            data = _part_of_selection(blobs.get(selected) or core.transaction.blob(selected), scene, part)
            if data is None:
                continue
            blobs[files.sha256(data)] = data
            part_operation = operation.with_options({"selection": files.sha256(data)})
        layer, pictures = new_layer(part.state.splats, part_operation, pieces, name, **mixing)
        blobs |= pictures
        document, layer = add_layer(document, replace(layer, asset=part.asset.id), index)
        added.append(layer)
    if not added:
        raise ValueError("layer: nothing to do, it reaches no visible asset that was chosen")
    core.transaction.blobs = blobs
    core.commit(f"add {added[0].name}", document, strict=added[0].id)
    return added[0]


def paint_in_scene(
    core: SessionCore,
    layer: Layer,
    edits: Sequence[Edit],
    name: str,
    operation: LayerOperation,
) -> Layer:
    """A stroke of a scene: into `layer` on its asset, and into one of that name on every other asset that it
    reaches (an eraser: not there). layer: without an id, one is made where it is needed."""
    scene, document = core.scene(), core.document
    shares = split_edits(scene, edits)
    erases = operation.reads_below_layer
    if erases and layer.id:
        shares = [share for share in shares if share[0].asset.id == layer.asset]
        if not shares:
            raise ValueError(f"{layer.title}: its asset is not under the stroke; nothing is left to erase")
    # One step for all of them: undo takes the whole stroke back.
    targets, stroke_ids, blobs = [], [], {}
    for part, pieces in shares:
        document, target = _target(document, layer, part.asset.id, operation)
        below = part.state.splats
        stroke, pictures = new_layer(below, operation, pieces, name, cut_out=True)
        stroke, thumbnail = replace(stroke, thumbnail=None), stroke.thumbnail
        document, stroke = add_stroke(document, target, stroke)
        if not erases:  # that of an eraser is its mask
            document = change_layer(document, target, thumbnail=thumbnail)
        blobs |= pictures
        targets.append(target)
        stroke_ids.append(stroke.id)
    core.transaction.blobs = blobs
    core.commit(f"{name} in {layer.name}", document, strict=stroke_ids[0])
    for target in targets:
        core.fold(target)
    return core.layer(targets[0])


def relief_on_asset(core: SessionCore, relief: ReliefLayer) -> tuple[str, ReliefLayer]:
    """(the asset that a copy is on, the copy in its space). Raises ValueError where it is on two."""
    if not core.document.assets:
        return MAIN_ASSET_ID, relief
    scene = core.scene()
    splats = scene.state.splats
    # By the nearest visible Gaussian: an anchor is a point of the surface and names no asset.
    visible = np.flatnonzero(splats.drawable & (splats.opacities > 0))
    numbers = []
    for anchor in (relief.source, relief.target):
        near = visible[((splats.means[visible] - anchor.point) ** 2).sum(1).argmin()]
        numbers.append(int(scene.asset_numbers[near]))
    if numbers[0] != numbers[1]:
        raise ValueError("copy: expected the source and the target on one asset")
    asset, placement = scene.parts[numbers[0]].asset, scene.parts[numbers[0]].placement

    def inside(anchor: CopyAnchor) -> CopyAnchor:
        point = placement.point_before(anchor.point)
        return CopyAnchor(point, matmul(placement.matrix.T, anchor.axes))

    return asset.id, ReliefLayer(inside(relief.source), inside(relief.target), relief.radius / placement.scale)


def _target(document: Document, layer: Layer, asset: str, stroke: LayerOperation) -> tuple[Document, str]:
    """(document, id) of the layer that a stroke goes into on an asset: `layer` on its own; else the topmost paint layer
    of that name, made where there is none."""
    if layer.id and layer.asset == asset:
        return document, layer.id
    # A stroke that goes over to another asset again goes on in the layer that it made there before.
    for other in reversed(document.layers if layer.id else ()):
        if other.asset == asset and other.name == layer.name and other.holds_strokes:
            if other.visible and other.opacity > 0:
                return document, other.id
    holder = layer.operation.for_strokes() or stroke.for_strokes()
    assert holder is not None, "an eraser stays on its layer's asset"
    document, added = add_layer(document, Layer("", layer.name, holder, asset=asset))
    return document, added.id


def _part_of_selection(data: bytes, scene: Scene, part: ScenePart) -> bytes | None:
    """A selection of the scene as one of an asset; None where it selects nothing there."""
    selection = Selection.from_png(data, len(scene.original))
    weights = selection.on(scene.state.splats, scene.original)[part.scene_ids]
    if not weights.any():
        return None
    return Selection.of(weights, part.state.splats, part.original).to_png()
