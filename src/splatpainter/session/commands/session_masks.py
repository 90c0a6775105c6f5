"""session.masks: how much of a layer shows where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera, same_camera
from splatpainter.io import files
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.commands.session_selections import SessionSelections
from splatpainter.session.document.document import Layer, change_layer
from splatpainter.session.document.layer_factory import decode_mask_part, encode_mask_part
from splatpainter.session.document.layer_mask import MAX_PARTS, LayerMask, MaskPart, over
from splatpainter.session.selection.selection import Selection


class SessionMasks:
    """Masks of layers of any kind (layer_mask.py). Each command is one step of the history."""

    def __init__(self, core: SessionCore, selections: SessionSelections) -> None:
        self._core, self._selections = core, selections

    def set(self, layer: str, mask: LayerMask | None, *, what: str = "mask", gesture: str | None = None) -> Layer:
        """Another mask of a layer; None: all of it shows. what: of the step; gesture: as of `layers.set`."""
        core = self._core
        with core.command():
            document = change_layer(core.document, layer, mask=mask)
            core.commit(f"{what} of {core.layer(layer).name}", document, gesture=gesture)
            return core.layer(layer)

    def set_area(self, layer: str, camera: Camera, shows: np.ndarray) -> Layer:
        """A mask that shows what is selected on one view ([H, W] 0..1), and nothing else."""
        core = self._core
        with core.command():
            data = encode_mask_part(shows, np.ones_like(shows))
            core.transaction.blobs = {files.sha256(data): data}
            camera = core.camera_of(core.layer(layer), camera)
            mask = LayerMask(False, (MaskPart(camera, files.sha256(data)),))
            core.commit(f"mask (area) of {core.layer(layer).name}", change_layer(core.document, layer, mask=mask))
            return core.layer(layer)

    def set_selection(self, layer: str, weights: np.ndarray) -> Layer:
        """A mask that shows a layer on what is selected, from every side, and nothing else of it. weights: [N] 0..1 of
        `Session.splats`. Raises ValueError where nothing of the layer's asset is selected."""
        core = self._core
        weights, target = core.checked_weights(weights), core.layer(layer)
        with core.command():
            # A layer lives on one asset, so only what is selected of that one can be its mask.
            part = next((one for one in self._selections.by_asset(weights) if one.asset == target.asset), None)
            if part is None or not part.weights.any():
                raise ValueError(f"{target.title}: nothing of its asset is selected")
            data = Selection.of(part.weights, part.splats, part.original).to_png()
            core.transaction.blobs = {files.sha256(data): data}
            mask = LayerMask(parts=(MaskPart(selection=files.sha256(data)),))
            core.commit(f"mask (selection) of {target.name}", change_layer(core.document, layer, mask=mask))
            return core.layer(layer)

    def paint(self, layer: str, camera: Camera, shows: np.ndarray, share: np.ndarray, *, name: str = "paint") -> Layer:
        """Change a layer's mask on one view. shows: [H, W] 0 (nothing of the layer) to 1 (all); share: [H, W] 0..1, how
        far to go there. Raises ValueError: other shapes, nothing to change, too many parts."""
        shape = (camera.height, camera.width)
        if shows.shape != shape or share.shape != shape:
            raise ValueError(f"mask: expected pictures of shape {list(shape)}, got {list(shows.shape)}")
        if not share.any():
            raise ValueError("mask: nothing was painted")
        core = self._core
        with core.command():
            mask, camera = core.layer(layer).mask or LayerMask(), core.camera_of(core.layer(layer), camera)
            parts, last = mask.parts, mask.parts[-1] if mask.parts else None
            # Dabs on one view stay one part: hundreds of parts would be evaluated one after the other.
            if last is not None and last.camera is not None and last.picture is not None:
                if same_camera(last.camera, camera):
                    earlier = decode_mask_part(core.transaction.blob(last.picture), camera, "mask")
                    shows, share = over(earlier[..., 0], earlier[..., 1], shows, share)
                    parts = parts[:-1]
            if len(parts) >= MAX_PARTS:
                raise ValueError(f"mask: was painted from {MAX_PARTS} views; make another layer")
            data = encode_mask_part(shows, share)
            core.transaction.blobs = {files.sha256(data): data}
            part = MaskPart(camera, files.sha256(data))
            document = change_layer(core.document, layer, mask=replace(mask, parts=(*parts, part), enabled=True))
            core.commit(f"{name} in the mask of {core.layer(layer).name}", document)
            return core.layer(layer)
