"""Commands of a session that hide Gaussians, copy them, or lay new ones where some are missing."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatpainter.holes.body import body_of
from splatpainter.io import files
from splatpainter.painter import Edit
from splatpainter.session.commands import Commands
from splatpainter.session.document import SELECTION, SOURCE, Layer, View, add_layer, change_layer
from splatpainter.session.fill_layers import FILL, SELECTED, FillWhere
from splatpainter.session.layer_factory import encode_mask, encode_picture, thumbnail
from splatpainter.session.layer_mask import LayerMask, MaskPart
from splatpainter.session.relief import Relief
from splatpainter.session.selection import Selection
from splatpainter.splats import Splats


@dataclass(frozen=True)
class SelectedPart:
    """What is selected of one asset."""

    asset: str
    """Its id."""
    weights: np.ndarray = field(repr=False)
    """[N] float32 of `splats`."""
    splats: Splats = field(repr=False)
    """The asset in its own space, with its layers; `original` without."""
    original: Splats = field(repr=False)


class GeometryCommands(Commands):
    """What Session has beside the layers as such; see there."""

    @property
    @abstractmethod
    def original(self) -> Splats: ...

    @property
    @abstractmethod
    def snapshot(self) -> Any: ...

    @abstractmethod
    def _weights(self, weights: np.ndarray) -> np.ndarray: ...

    @abstractmethod
    def selected_parts(self, weights: np.ndarray) -> list[SelectedPart]: ...

    @abstractmethod
    def _relief_of(self, relief: Relief) -> tuple[str, Relief]: ...

    def hide(self, weights: np.ndarray, name: str = "Hide", *, index: int | None = None) -> Layer:
        """A layer that hides what is selected: opacities are multiplied by 1 - weight, and 0 where that is all. The
        Gaussians stay; hiding the layer brings them back bit for bit. weights: [N] 0..1 of `splats`. Raises ValueError
        where nothing is selected."""
        weights = self._weights(weights)
        if not weights.any():
            raise ValueError("hide: nothing is selected")
        with self._command():
            document, added = self._document, []
            for hiding in self._hiding(weights, name):
                document, layer = add_layer(document, hiding, index)
                added.append(layer)
            self._commit(f"add {name}", document, strict=[layer.id for layer in added])
            return added[0]

    def copy(self, relief: Relief, name: str = "Copy", *, index: int | None = None) -> Layer:
        """A layer of Gaussians that are copied with their relief from one place of the surface to another (relief.py).
        Raises ValueError where there is nothing to copy, or too much."""
        with self._command():
            asset, relief = self._relief_of(relief)
            parameters = relief.parameters()
            clone = Layer("", name, "clone", mode="global", parameters=parameters, method="lift", asset=asset)
            document, layer = add_layer(self._document, clone, index)
            self._commit(f"add {layer.name}", document, strict=layer.id)
            return layer

    def fill(self, weights: np.ndarray, *, remove: bool = False, body: bool = False, name: str = "Fill") -> Layer:
        """A layer of new Gaussians that continue the surface over a hole, in colours of what surrounds it
        (holes/fill.py); nothing else changes. weights: [N] 0..1 of `splats`: Gaussians around the hole, as circling it
        selects them; or (remove) those that go first, by a layer below that hides them. Both layers are one step of
        the history; where the surface behind is closed the upper one is empty, and its note says so. body: what goes
        is the whole connected body that they are of, as far as there is one (holes/body.py). Of several assets a hole
        is in that which most of the weights are of; what is removed goes from all, and every one is filled. Raises
        ValueError where nothing is selected, and where there is no hole that can be filled."""
        weights = self._weights(weights)
        if not weights.any():
            raise ValueError("fill: nothing is selected; select what is to be removed, or circle a hole")
        where: FillWhere = "removed" if remove else "around"
        if remove and body:
            chosen = body_of(self.snapshot.splats.numpy(), weights >= SELECTED)
            weights = weights if chosen is None else chosen.astype(np.float32)
        with self._command():
            document, added = self._document, []
            for hiding in self._hiding(weights, f"{name}: removed")[: None if remove else 1]:
                if remove:
                    document, _ = add_layer(document, hiding)
                parameters = {FILL: where, SELECTION: hiding.parameters[SELECTION]}
                words = {"mode": "global", "parameters": parameters, "method": "lift", "asset": hiding.asset}
                document, layer = add_layer(document, Layer("", name, "fill", **words))
                added.append(layer)
            self._commit("remove and fill" if remove else f"add {name}", document, strict=added[0].id)
            return added[0]

    def filled_by(self, layer: str) -> np.ndarray:
        """[N] bool of `splats`: the Gaussians of a fill layer. Raises ValueError for another layer, and where it is
        hidden or changes nothing."""
        snapshot = self.snapshot
        out = np.zeros(len(snapshot.splats), bool)
        for entry in snapshot.state.edited:
            if entry.layer.id == layer and entry.layer.kind == "fill":
                out[slice(*entry.appended)] = True
        if not out.any():
            raise ValueError(f"{self.layer(layer).title}: expected a visible layer that fills a hole")
        return out

    def fill_from(
        self, layer: str, edits: Sequence[Edit], *, source: Mapping[str, Any] | None = None, name: str | None = None
    ) -> Layer:
        """Other colours of a fill layer: those of pictures with masks, such as a source makes of views that show it
        filled; none: of the surroundings again. source: what receipts say of who made them. Only the layer's own
        Gaussians take them. Raises ValueError for another layer, and a picture without a mask."""
        with self._command():
            before = self.layer(layer)
            if before.kind != "fill":
                raise ValueError(f"{before.title}: expected a layer that fills a hole")
            blobs: dict[str, bytes] = {}

            def put(data: bytes) -> str:
                blobs[files.sha256(data)] = data
                return files.sha256(data)

            views, small = [], None
            for edit in edits:
                if edit.mask is None:
                    raise ValueError(f"{edit.name}: expected a mask with a picture that colours a fill")
            for edit in self._edits_of(before, edits) if edits else ():
                picture = put(encode_picture(edit.image, self.splats.color_space))
                mask = np.ones(edit.image.shape[:2], bool) if edit.mask is None else edit.mask
                views.append(View(edit.camera, picture, put(encode_mask(mask))))
                small = small or put(thumbnail(edit.image, mask))
            parameters = {key: value for key, value in before.parameters.items() if key != SOURCE}
            if source is not None:
                parameters[SOURCE] = dict(source)
            self._transaction.blobs = blobs
            fields = {"views": tuple(views), "thumbnail": small, "parameters": parameters, "visible": True}
            document = change_layer(self._document, layer, name=name or before.name, **fields)
            self._commit(f"change {before.name}", document, strict=layer)
            return self.layer(layer)

    def mask_selection(self, layer: str, weights: np.ndarray) -> Layer:
        """A mask that shows a layer on what is selected, from every side, and nothing else of it. weights: [N] 0..1 of
        `splats`. Raises ValueError where nothing of the layer's asset is selected."""
        weights, target = self._weights(weights), self.layer(layer)
        with self._command():
            part = next((one for one in self.selected_parts(weights) if one.asset == target.asset), None)
            if part is None or not part.weights.any():
                raise ValueError(f"{target.title}: nothing of its asset is selected")
            data = Selection.of(part.weights, part.splats, part.original).to_png()
            self._transaction.blobs = {files.sha256(data): data}
            mask = LayerMask(parts=(MaskPart(selection=files.sha256(data)),))
            self._commit(f"mask (selection) of {target.name}", change_layer(self._document, layer, mask=mask))
            return self.layer(layer)

    def _hiding(self, weights: np.ndarray, name: str) -> list[Layer]:
        """Layers without ids, one for each asset, that with the most weight first; their selections are among the blobs
        of the transaction."""
        layers, blobs = [], {}
        for part in self.selected_parts(weights):
            data = Selection.of(part.weights, part.splats, part.original).to_png()
            blobs[files.sha256(data)] = data
            parameters = {SELECTION: files.sha256(data)}
            layers.append(Layer("", name, "hide", parameters=parameters, method="lift", asset=part.asset))
        self._transaction.blobs = blobs
        return layers
