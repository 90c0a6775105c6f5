"""Layers and the document that orders them: frozen values, and JSON. Knows no rows, no pictures and no file.

Pictures and masks are named by the SHA-256 of their PNG bytes; who has the bytes is the project's business.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from splatpainter.cameras import Camera
from splatpainter.painter import MAX_VIEWS, Method, Mode

Kind = Literal["paint", "picture", "look", "clone", "erase", "merged"]
Blend = Literal["normal", "color", "luminosity", "darken", "lighten"]
Policy = Literal["latest", "first", "blend"]
DEEPEST = 16
"""Merged layers inside merged layers."""
MAX_VIEW_PIXELS = 64_000_000
"""Pixels of one view."""


@dataclass(frozen=True)
class View:
    """One edited picture of a layer."""

    camera: Camera
    picture: str | None = None
    """Hash of the edited view, a PNG of the camera's size; None where only the mask counts (erase, masked looks)."""
    mask: str | None = None
    """Hash of the mask, a PNG (white: edited); None: all that the asset covers (mode global)."""

    def record(self) -> dict[str, Any]:
        camera = json.loads(self.camera.to_json())
        return {"camera": camera, "picture": self.picture, "mask": self.mask}

    @staticmethod
    def parse(data: dict[str, Any], where: str) -> View:
        camera = Camera.from_json(json.dumps(data["camera"]), where)
        if camera.width * camera.height > MAX_VIEW_PIXELS:
            raise ValueError(f"{where}: expected a view of at most {MAX_VIEW_PIXELS // 10**6} megapixels")
        return View(camera, _hash(data["picture"], where), _hash(data["mask"], where))


@dataclass(frozen=True)
class Layer:
    """One step of the asset, from the rows below it to the rows above."""

    id: str
    """Unique within the project, never used again."""
    name: str
    kind: Kind
    views: tuple[View, ...] = ()
    parameters: dict[str, Any] = field(default_factory=dict)
    """JSON; of a look its name and settings (looks.py). Free for the caller's own notes otherwise."""
    mode: Mode = "local"
    method: Method = "auto"
    opacity: float = 1.0
    """0..1, see blend.py."""
    blend: Blend = "normal"
    visible: bool = True
    layers: tuple[Layer, ...] = ()
    """Of kind "merged": the layers that it is made of, lowest first."""
    thumbnail: str | None = None
    """Hash of a small PNG of what was edited."""
    painter: str = ""
    """What of the painter decides its result (adapter.fingerprint), as it was when the layer was made."""

    def __post_init__(self) -> None:
        for name, value, known in (
            ("kind", self.kind, Kind),
            ("blend", self.blend, Blend),
            ("mode", self.mode, Mode),
            ("method", self.method, Method),
        ):
            if value not in get_args(known):
                raise ValueError(f"layer {self.name!r}: expected {name} of {', '.join(get_args(known))}, got {value!r}")
        if not 0 <= self.opacity <= 1:
            raise ValueError(f"layer {self.name!r}: expected an opacity of 0 to 1, got {self.opacity}")
        try:  # a copy, which nobody else changes
            text = json.dumps(self.parameters, allow_nan=False, ensure_ascii=False)
            f"{self.id} {self.name} {self.painter} {text}".encode()  # halves of surrogate pairs are no text
            own = json.loads(text)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"layer {self.name!r}: expected parameters that JSON can hold ({error})") from None
        object.__setattr__(self, "parameters", own)
        if (self.kind == "merged") != bool(self.layers):
            raise ValueError(f"layer {self.name!r}: a merged layer, and no other, holds layers")

    def record(self) -> dict[str, Any]:
        """JSON object of all fields."""
        own = {k: getattr(self, k) for k in ("id", "name", "opacity", "blend", "visible", "thumbnail")}
        return {**own, **self._content()}

    @property
    def key(self) -> str:
        """Hash of what decides which rows it wants on given rows below (not: name, opacity, blend, visibility)."""
        return digest(json.dumps(self._content(), sort_keys=True))

    def _content(self) -> dict[str, Any]:
        views = [view.record() for view in self.views]
        own = {name: getattr(self, name) for name in ("kind", "mode", "method", "painter", "parameters")}
        return {**own, "views": views, "layers": [layer.record() for layer in self.layers]}

    @staticmethod
    def parse(data: dict[str, Any], where: str = "layer", depth: int = 0) -> Layer:
        """The inverse of `record`. Raises ValueError naming `where`."""
        try:
            if depth > DEEPEST:
                raise ValueError("merged layers are nested too deeply")
            if len(data["views"]) > MAX_VIEWS:
                raise ValueError(f"expected at most {MAX_VIEWS} views, got {len(data['views'])}")
            if not isinstance(data["parameters"], dict):
                raise ValueError(f"expected parameters as a JSON object, got {data['parameters']!r:.40}")
            return Layer(
                str(data["id"]),
                str(data["name"]),
                data["kind"],
                tuple(View.parse(view, where) for view in data["views"]),
                data["parameters"],
                data["mode"],
                data["method"],
                float(data["opacity"]),
                data["blend"],
                bool(data["visible"]),
                tuple(Layer.parse(layer, where, depth + 1) for layer in data["layers"]),
                _hash(data["thumbnail"], where),
                str(data["painter"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            said = f"has no {error}" if isinstance(error, KeyError) else str(error).removeprefix(f"{where}: ")
            raise ValueError(f"{where}: {said}") from None

    def blobs(self) -> set[str]:
        """Hashes of all pictures, masks and thumbnails, those of merged layers too."""
        names = [self.thumbnail, *(name for view in self.views for name in (view.picture, view.mask))]
        return {name for name in names if name}.union(*(layer.blobs() for layer in self.layers))

    def leaves(self) -> Iterator[Layer]:
        """Itself, or the layers that a merged one is made of, lowest first."""
        if not self.layers:
            yield self
        for layer in self.layers:
            yield from layer.leaves()


@dataclass(frozen=True)
class Document:
    """What the asset is made of, next to the original."""

    layers: tuple[Layer, ...] = ()
    """Lowest first."""
    policies: tuple[tuple[str, str, Policy], ...] = ()
    """(lower layer, upper layer, who wins) where both wrote the same rows; pairs not listed: the latest."""
    next_id: int = 1

    def index(self, layer: str) -> int:
        """Place of a layer, 0 the lowest. Raises ValueError for an unknown one."""
        for k, own in enumerate(self.layers):
            if own.id == layer:
                return k
        known = ", ".join(own.id for own in self.layers) or "none"
        raise ValueError(f"layer: expected one of {known}, got {layer!r}")

    def leaf_ids(self) -> set[str]:
        return {leaf.id for layer in self.layers for leaf in layer.leaves()}


def digest(text: str) -> str:
    """Hex SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


def _hash(value: Any, where: str) -> str | None:
    if value is None:
        return None
    if not (isinstance(value, str) and len(value) == 64 and set(value) <= set("0123456789abcdef")):
        raise ValueError(f"{where}: expected the SHA-256 of a picture, got {value!r:.80}")
    return value
