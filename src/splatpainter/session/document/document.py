"""Layers, the document that orders them, and what can be done to it: frozen values, JSON, and pure functions from
document to document for the session to commit and to undo. Knows no Gaussians, no pictures and no file.

Pictures and masks are named by the SHA-256 of their PNG bytes; who has the bytes is the project's business.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Literal, get_args

from splatpainter.cameras import Camera
from splatpainter.io.files import printable
from splatpainter.painter import MAX_VIEWS
from splatpainter.session.document.layer_mask import LayerMask
from splatpainter.session.document.layer_operation import LayerOperation, operation_of_layer
from splatpainter.session.document.layer_view import Blend, View, checked_hash
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, SceneAsset
from splatpainter.session.replay.delta import MAX_REASON
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

Policy = Literal["latest", "first", "blend"]
MAX_NESTING = 16
"""Most levels of merged layers inside merged layers."""
MAX_STROKES = 10_000
"""Most strokes of one layer."""
STROKE_KINDS = ("paint", "clone", "erase")
"""Kinds of strokes, for errors."""
MAX_LISTED_IDS = 20
"""Most layer ids that an error lists."""


@dataclass(frozen=True)
class Layer:
    """One step of the asset, from the Gaussians below it to those above."""

    id: str
    """Unique within the project, never used again."""
    name: str
    operation: LayerOperation
    """What it is and does, with all of its options (layer_operation.py)."""
    views: tuple[View, ...] = ()
    """Its edited pictures and masks."""
    opacity: float = 1.0
    """0..1, see layer_blending.py."""
    blend: Blend = "normal"
    visible: bool = True
    layers: tuple[Layer, ...] = ()
    """Layers that a merged one is made of, lowest first."""
    thumbnail: str | None = None
    """Hash of a small PNG of what was edited."""
    strokes: tuple[Layer, ...] = ()
    """What was painted into a paint layer without views, oldest first. Each stroke is a layer of its own views, painted
    on those before it; its opacity, blend and visibility do not count."""
    mask: LayerMask | None = None
    """How much of it shows where; None: all."""
    asset: str = MAIN_ASSET_ID
    """Id of the asset that it belongs to, and in whose space its views are (scene_asset.py)."""

    def __post_init__(self) -> None:
        if self.blend not in get_args(Blend):
            listed = ", ".join(get_args(Blend))
            raise ValueError(f"{self.title}: expected blend of {listed}, got {brief(self.blend)}")
        if not 0 <= self.opacity <= 1:
            raise ValueError(f"{self.title}: expected an opacity of 0 to 1, got {self.opacity}")
        try:
            f"{self.id} {self.name}".encode()
        except UnicodeEncodeError as error:  # halves of surrogate pairs are no text
            reason = printable(str(error), MAX_REASON)
            raise ValueError(f"{self.title}: expected a name that UTF-8 can hold ({reason})") from None
        # Checked where commands and files both come through: no command makes a layer that cannot be opened.
        if self.operation.merges != bool(self.layers):
            raise ValueError(f"{self.title}: a merged layer, and no other, holds layers")
        if self.strokes and not self.holds_strokes:
            raise ValueError(f"{self.title}: expected strokes in a paint layer without views of its own only")

    @property
    def kind(self) -> str:
        """That of its operation, for people."""
        return self.operation.kind

    @property
    def holds_strokes(self) -> bool:
        """Whether strokes can be painted into it as it is."""
        return not self.views and self.operation.holds_strokes

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of the layer's views and strokes, each once."""
        views = (view for layer in (self, *self.strokes) for view in layer.views)
        return tuple({_camera_key(view.camera): view.camera for view in views}.values())

    @property
    def title(self) -> str:
        """The layer's name in errors, cut."""
        return f"layer {printable(self.name, 80)!r}"

    def record(self, strokes: bool = True) -> dict[str, Any]:
        """JSON object of all fields. strokes False: of these only their number."""
        # A mask, an asset or strokes that are not there are left out: most layers have none.
        names = ("id", "name", "opacity", "blend", "visible", "thumbnail")
        record = {**{name: getattr(self, name) for name in names}, **self._content()}
        if self.mask is not None:
            record["mask"] = self.mask.record()
        if self.asset != MAIN_ASSET_ID:
            record["asset"] = self.asset
        if self.strokes:
            record["strokes"] = [stroke.record() for stroke in self.strokes] if strokes else len(self.strokes)
        return record

    @cached_property
    def text(self) -> str:
        """The record as JSON, without strokes."""
        return json.dumps(self.record(strokes=False), sort_keys=True)

    @cached_property
    def key(self) -> str:
        """Hash of what decides its result on given Gaussians below (not: name, opacity, blend, mask, visibility). Of a
        layer that holds strokes the strokes' keys count instead."""
        return digest(json.dumps(self._content(), sort_keys=True))

    def _content(self) -> dict[str, Any]:
        views = [view.record() for view in self.views]
        return {"operation": self.operation.record(), "views": views, "layers": [one.record() for one in self.layers]}

    @staticmethod
    def parse(data: dict[str, Any], where: str = "layer", depth: int = 0) -> Layer:
        """The inverse of `record`. Raises ValueError naming `where`."""
        try:
            # Sizes are judged before the parts are read: the record may be a stranger's.
            if depth > MAX_NESTING:
                raise ValueError("merged layers are nested too deeply")
            if len(data["views"]) > MAX_VIEWS:
                raise ValueError(f"expected at most {MAX_VIEWS} views, got {len(data['views'])}")
            return Layer(
                str(data["id"]),
                str(data["name"]),
                operation_of_layer(data["operation"], where),
                tuple(View.parse(view, where) for view in data["views"]),
                float(data["opacity"]),
                data["blend"],
                bool(data["visible"]),
                tuple(Layer.parse(layer, where, depth + 1) for layer in data["layers"]),
                checked_hash(data["thumbnail"], where),
                _parsed_strokes(data.get("strokes", []), where, depth),
                LayerMask.parse(data.get("mask"), where),
                str(data.get("asset", MAIN_ASSET_ID)),
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            reason = f"has no {error}" if isinstance(error, KeyError) else str(error).removeprefix(f"{where}: ")
            raise ValueError(f"{where}: {printable(reason, MAX_REASON)}") from None

    def blobs(self) -> set[str]:
        """Hashes of all pictures, masks and thumbnails, those of strokes and merged layers too."""
        return self.direct_blobs().union(*(layer.blobs() for layer in (*self.layers, *self.strokes)))

    def direct_blobs(self) -> set[str]:
        """`blobs` without those of strokes and merged layers."""
        names = [self.thumbnail, *(name for view in self.views for name in (view.picture, view.mask))]
        pictures = self.mask.pictures() if self.mask is not None else set()
        return {name for name in names if name} | self.operation.blobs() | pictures

    def leaves(self) -> Iterator[Layer]:
        """Itself, or the layers that a merged one is made of, lowest first."""
        if not self.layers:
            yield self
        for layer in self.layers:
            yield from layer.leaves()


@dataclass(frozen=True)
class Document:
    """The layers that make the asset from the original, with their settings."""

    layers: tuple[Layer, ...] = ()
    """Lowest first."""
    policies: tuple[tuple[str, str, Policy], ...] = ()
    """(lower layer, upper layer, who wins) where both changed the same Gaussians; pairs not listed: the latest."""
    next_id: int = 1
    assets: tuple[SceneAsset, ...] = ()
    """All assets where there are several, that of the original first; empty: that one alone, as it is."""

    def part(self, asset: str) -> Document:
        """The document of one asset alone, in its own space."""
        if not self.assets:
            return self
        return replace(self, layers=tuple(layer for layer in self.layers if layer.asset == asset), assets=())

    def below(self, layer: str) -> Document:
        """Without a layer, and without those of its asset that lie above it."""
        # Other assets stay whole: they have no order with this layer, and may stand beside it in view.
        at = self.index(layer)
        asset = self.layers[at].asset
        layers = (entry for k, entry in enumerate(self.layers) if k < at or entry.asset != asset)
        return replace(self, layers=tuple(layers))

    def index(self, layer: str) -> int:
        """Index of a layer by its id, 0 the lowest. Raises ValueError for an unknown one."""
        ids = [entry.id for entry in self.layers]
        if layer not in ids:
            raise ValueError(f"layer: expected one of {_listed(ids)}, got {brief(layer)}")
        return ids.index(layer)

    def leaf_ids(self) -> set[str]:
        return {leaf.id for layer in self.layers for leaf in layer.leaves()}


def add_layer(document: Document, layer: Layer, index: int | None = None) -> tuple[Document, Layer]:
    """The document with a new layer at `index` (0 the lowest; None: on top). The layer and those inside it get new
    ids."""
    new, next_id = _numbered(layer, document.next_id)
    layers = list(document.layers)
    layers.insert(len(layers) if index is None else _checked_index(index, len(layers) + 1), new)
    return replace(document, layers=tuple(layers), next_id=next_id), new


def change_layer(document: Document, layer: str, **fields: Any) -> Document:
    """The document with other values of a layer's fields (Layer's names)."""
    at = document.index(layer)
    layers = list(document.layers)
    layers[at] = replace(layers[at], **fields)
    return replace(document, layers=tuple(layers))


def move_layer(document: Document, layer: str, index: int) -> Document:
    """The document with a layer at another index, 0 the lowest."""
    layers = list(document.layers)
    layers.insert(_checked_index(index, len(layers)), layers.pop(document.index(layer)))
    return replace(document, layers=tuple(layers))


def add_stroke(document: Document, layer: str, stroke: Layer) -> tuple[Document, Layer]:
    """The document with one more stroke in a layer: (the document, the stroke with its id). A paint layer of local
    views becomes one that holds strokes, with what it was as the first; a merged layer gets it as the uppermost of
    what it is made of. Raises ValueError where the layer takes none."""
    at = document.index(layer)
    target = document.layers[at]
    if target.layers:
        return _add_stroke_on_top(document, at, stroke)
    # The settings stay with the layer and the first stroke gets none: they would else count twice.
    if target.views and (holder := _for_strokes(target)) is not None:
        plain: dict[str, Any] = {"opacity": 1.0, "blend": "normal", "visible": True, "thumbnail": None, "mask": None}
        first = replace(target, id=str(document.next_id), **plain)
        target = replace(target, operation=holder, views=(), strokes=(first,))
        document = replace(document, next_id=document.next_id + 1)
    if not target.holds_strokes:
        raise ValueError(f"{target.title}: takes no strokes; choose a paint layer, or make a new one")
    if len(target.strokes) >= MAX_STROKES:
        raise ValueError(f"{target.title}: holds {MAX_STROKES} strokes already; make a new layer")
    stroke = replace(stroke, id=str(document.next_id))
    target = replace(target, strokes=(*target.strokes, stroke))
    layers = (*document.layers[:at], target, *document.layers[at + 1 :])
    return replace(document, layers=layers, next_id=document.next_id + 1), stroke


def _for_strokes(layer: Layer) -> LayerOperation | None:
    """See LayerOperation.for_strokes. Raises ValueError naming the layer."""
    try:
        return layer.operation.for_strokes()
    except ValueError as error:
        raise ValueError(f"{layer.title}: {error}") from None


def takes_strokes(layer: Layer) -> bool:
    """Whether `add_stroke` takes a layer."""
    try:
        return bool(layer.layers) or layer.holds_strokes or (bool(layer.views) and _for_strokes(layer) is not None)
    except ValueError:
        return False


def _add_stroke_on_top(document: Document, at: int, stroke: Layer) -> tuple[Document, Layer]:
    """The document with a stroke in the uppermost layer inside a merged one, or in a new one on top of them where that
    holds no strokes, or mixes them with what is below."""
    merged = document.layers[at]
    operation = stroke.operation.for_strokes()
    if operation is None:
        raise ValueError(f"{merged.title}: is merged, and nothing can be erased in it; hide parts of it by its mask")
    *rest, top = merged.layers
    # A stroke under an opacity or mask would not look as it was painted; a new layer on top has neither.
    plain = top.visible and top.opacity == 1 and top.blend == "normal" and top.mask is None
    if not (plain and top.holds_strokes and len(top.strokes) < MAX_STROKES):
        rest = [*merged.layers]
        top = Layer(str(document.next_id), stroke.name, operation, asset=merged.asset)
        document = replace(document, next_id=document.next_id + 1)
    stroke = replace(stroke, id=str(document.next_id))
    top = replace(top, strokes=(*top.strokes, stroke))
    target = replace(merged, layers=(*rest, top))
    layers = (*document.layers[:at], target, *document.layers[at + 1 :])
    return replace(document, layers=layers, next_id=document.next_id + 1), stroke


def delete_layer(document: Document, layer: str) -> Document:
    """The document without a layer."""
    layers = list(document.layers)
    layers.pop(document.index(layer))
    # A policy of a layer that is gone would stay for good and say nothing: ids are never used again.
    remaining = replace(document, layers=tuple(layers))
    ids = remaining.leaf_ids()
    return replace(remaining, policies=tuple(p for p in document.policies if p[0] in ids and p[1] in ids))


def duplicate_layer(document: Document, layer: str) -> tuple[Document, Layer]:
    """The document with a copy of a layer right above it."""
    index = document.index(layer)
    source = document.layers[index]
    return add_layer(document, replace(source, name=f"{source.name} copy"), index + 1)


def merge_layers(document: Document, layers: Sequence[str], name: str | None = None) -> tuple[Document, Layer]:
    """The document with neighbouring layers as one, which shows what they did. They stay inside it, with their ids,
    opacities and pictures, so it is still replayed when something below changes. Raises ValueError: fewer than two,
    gaps between."""
    # Only neighbours: a layer in between would change its place, and what is shown with it.
    indices = sorted({document.index(layer) for layer in layers})
    if len(indices) < 2 or indices != list(range(indices[0], indices[-1] + 1)):
        raise ValueError("merge: expected two or more layers that lie next to each other; move them together first")
    inner = document.layers[indices[0] : indices[-1] + 1]
    # Layers of two assets live in two spaces.
    asset = inner[0].asset
    if any(layer.asset != asset for layer in inner):
        raise ValueError("merge: expected layers of one asset")
    names = {"name": name or inner[-1].name, "thumbnail": inner[-1].thumbnail}
    merged_operation = operation_of_layer({"kind": "merged"}, "merge")
    one = Layer(str(document.next_id), operation=merged_operation, layers=inner, asset=asset, **names)
    merged = (*document.layers[: indices[0]], one, *document.layers[indices[-1] + 1 :])
    return replace(document, layers=merged, next_id=document.next_id + 1), one


def resolve_conflict(document: Document, lower: str, upper: str, policy: Policy) -> Document:
    """The document with another winner where two layers changed the same Gaussians ("latest" is what happens
    anyway)."""
    if policy not in get_args(Policy):
        raise ValueError(f"conflict: expected latest, first or blend, got {brief(policy)}")
    ids = document.leaf_ids()
    if lower not in ids or upper not in ids or lower == upper:
        given = f"{brief(lower)}, {brief(upper)}"
        raise ValueError(f"conflict: expected two of the layers {_listed(sorted(ids))}, got {given}")
    # "latest" is what happens without an entry, so that choosing it leaves none behind.
    rest = [entry for entry in document.policies if entry[:2] != (lower, upper)]
    new = [] if policy == "latest" else [(lower, upper, policy)]
    return replace(document, policies=tuple(rest + new))


def _listed(ids: Sequence[str]) -> str:
    """Ids of layers for an error."""
    more = ", ..." if len(ids) > MAX_LISTED_IDS else ""
    return printable(", ".join(ids[:MAX_LISTED_IDS]), MAX_REASON) + more if ids else "none"


def _numbered(layer: Layer, start: int) -> tuple[Layer, int]:
    """(the layer with ids from `start` on, the id after the last of them)."""
    inner, next_id = [], start + 1
    for child in (*layer.layers, *layer.strokes):
        numbered, next_id = _numbered(child, next_id)
        inner.append(numbered)
    count = len(layer.layers)
    return replace(layer, id=str(start), layers=tuple(inner[:count]), strokes=tuple(inner[count:])), next_id


def _parsed_strokes(records: Any, where: str, depth: int) -> tuple[Layer, ...]:
    """Raises ValueError for anything but strokes."""
    if not isinstance(records, list) or len(records) > MAX_STROKES:
        raise ValueError(f"expected a list of at most {MAX_STROKES} strokes")
    strokes = tuple(Layer.parse(record, where, depth + 1) for record in records)
    for stroke in strokes:
        check_stroke(stroke)
    return strokes


def check_stroke(stroke: Layer) -> None:
    """Raises ValueError where a layer is no stroke."""
    if not stroke.operation.is_stroke or not stroke.views:
        raise ValueError(f"{stroke.title}: expected a stroke: kind {', '.join(STROKE_KINDS)}, mode local, with a view")


def _camera_key(camera: Camera) -> tuple[Any, ...]:
    matrix = camera.world_to_camera.tobytes()
    return matrix, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


def _checked_index(index: int, count: int) -> int:
    if not 0 <= index < count:
        raise ValueError(f"layer: expected an index of 0 to {count - 1}, got {brief(index)}")
    return index


def digest(text: str) -> str:
    """Hex SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()
