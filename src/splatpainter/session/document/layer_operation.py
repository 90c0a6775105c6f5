"""What a layer is and does, as one value: its options, and the function from the Gaussians below to a delta.

Every kind of layer is one frozen dataclass, in kinds/: its fields are the options, each declared and explained there
once; projects, layer files and messages read and write them by these fields; `result` is what it does. What composing
has to know of a kind it asks its value (`lays_paint`, `is_stored`, `mix`, ...): replay/ names no kind.

To add one: a module in kinds/ with a subclass, and its name in KINDS. Other distributions add theirs by entry points of
the group `splatpainter.layers`: kind = module:Class. Operations that read no files need none: operation_layers.py.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

import numpy as np

from splatpainter.io.files import printable
from splatpainter.session.document.layer_view import Blend, View, is_hash
from splatpainter.session.replay.delta import MAX_REASON, Delta
from splatpainter.session.replay.layer_blending import blend_delta
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.splats import Splats
from splatpainter.system import jsonio
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.painter import Asset, Edit, Method, Mode, Painter
    from splatpainter.spread.options import SpreadOptions

ENTRY_POINTS = "splatpainter.layers"
"""Group by which other distributions add kinds of layers."""
KINDS_PACKAGE = "splatpainter.session.kinds"
KINDS = {
    "paint": "painted_layers:PaintLayer",
    "picture": "painted_layers:PictureLayer",
    "clone": "painted_layers:CloneLayer",
    "look": "look_layers:LookLayer",
    "erase": "erase_layers:EraseLayer",
    "hide": "hide_layers:HideLayer",
    "fill": "fill_layers:FillLayer",
    "relief": "relief_layers:ReliefLayer",
    "merged": "merged_layers:MergedLayer",
    "light": "operation_layers:OperationLayer",
    "delight": "operation_layers:OperationLayer",
    "pixelate": "pixelate_layers:PixelateLayer",
}
"""Kind -> module of kinds/ (or a dotted name) and class, imported when it is asked for."""
Coverage = Literal["seen", "original", "as below"]
"""What of Gaussians that a layer changed is known: a view showed them, they are the original's again, or as they were
before."""


class LayerWork(Protocol):
    """What the operation of a layer has of the place where the layer is composed."""

    @property
    def title(self) -> str:
        """The layer's name in errors."""
        ...

    @property
    def views(self) -> tuple[View, ...]: ...

    @property
    def splats(self) -> Splats:
        """The Gaussians below; `origin`: the original's Gaussian that each comes from."""
        ...

    @property
    def original(self) -> Splats:
        """What an eraser goes back to: the asset as it was opened, or of a stroke what is below its layer."""
        ...

    @property
    def unlit(self) -> np.ndarray | None:
        """[N, 1, 3] SH of base colours of `splats` as they would be without light layers; None: there are none."""
        ...

    @property
    def fades(self) -> bool:
        """Whether the layer mixes with what is below it, by its opacity or blend."""
        ...

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture that the operation names. Raises ValueError: unknown or damaged."""
        ...

    def mask(self, view: View) -> np.ndarray:
        """[H, W] bool mask of a view; all of it where it has none."""
        ...

    def edit(self, view: View) -> Edit:
        """A view as it was given; what its picture was cut out of is that of `splats`."""
        ...

    def selected(self, selection: str) -> np.ndarray:
        """[N] float32 weights of a selection (the hash of its PNG) on `splats`."""
        ...

    def adjusted(self, name: str, settings: Mapping[str, Any]) -> Splats:
        """`splats` after an adjustment of colours that the session has by name."""
        ...

    def paint(
        self, mode: Mode, method: Method, options: Mapping[str, Any], spread: SpreadOptions | None
    ) -> tuple[Splats, Asset]:
        """(`splats` as the painter got them, what it made of them and of all views)."""
        ...

    def fingerprint(self, method: Method, mode: Mode) -> str:
        """What of the painter of now decides the results of a method in a mode."""
        ...

    @property
    def proves_changes(self) -> bool:
        """Whether the painter's receipts list every Gaussian that it changed."""
        ...


@dataclass(frozen=True)
class LayerOperation:
    """What every kind of layer has. Subclasses are frozen dataclasses, all of whose fields have defaults."""

    kind: ClassVar[str] = ""
    """Its name: for people, in files, and in Session.layers.add."""
    lays_paint: ClassVar[bool] = False
    """Whether it lays Gaussians in place of others: an opacity then starts from colours that are fitted to what its
    views saw before (replay/appearance.py)."""
    reshapes: ClassVar[bool] = False
    """Whether the surface that paint lies on is another one with it."""
    reads_below_layer: ClassVar[bool] = False
    """Whether it, as a stroke, reads what is below its layer, besides the strokes before it."""
    merges: ClassVar[bool] = False
    """Whether it does what the layers inside it do, and nothing else."""
    covers: ClassVar[Coverage] = "seen"

    def __post_init__(self) -> None:
        """Objects become copies, which nobody else changes. Raises ValueError for what JSON cannot hold, and for
        options that cannot be (`check`)."""
        # A caller who goes on changing the dictionary would change a layer of the history.
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, dict):
                object.__setattr__(self, entry.name, _json_copy(value, entry.name))
        self.check()

    def check(self) -> None:
        """Raises ValueError, one line, for options that cannot be or do not go together."""

    # ---- as JSON

    def record(self) -> dict[str, Any]:
        """JSON object: its kind, and the options that are not at their defaults; the inverse of
        `operation_of_layer`."""
        plain = jsonio.plain(self)
        return {"kind": self.kind, **{name: plain[name] for name in self.changes()}}

    def changes(self) -> dict[str, Any]:
        """The options that are not at their defaults, by name."""
        # Defaults are left out, so that a new option does not change the text, and so the key, of older layers.
        default = type(self)()
        values = {entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)}
        return {name: value for name, value in values.items() if value != getattr(default, name)}

    @property
    def options(self) -> Any:
        """The dataclass whose fields are its options: of a kind of layer the kind itself."""
        return self

    def option_names(self) -> tuple[str, ...]:
        """Names of its options."""
        return tuple(entry.name for entry in dataclasses.fields(self))

    def blobs(self) -> set[str]:
        """Hashes of the pictures that its options name."""
        values = (getattr(self, entry.name) for entry in dataclasses.fields(self) if entry.metadata.get("blob"))
        return {value for value in values if is_hash(value)}

    @classmethod
    def build(cls, kind: str, options: Mapping[str, Any], where: str) -> LayerOperation:
        """The value of a kind and some options, from JSON or from Python. Raises ValueError naming `where` and the
        option."""
        return jsonio.build(cls, options, where, what=f"the options of {kind}", defaults=True)

    def with_options(self, options: Mapping[str, Any], where: str = "layer") -> LayerOperation:
        """With other values of some options. Raises ValueError as `build`."""
        # Through the record, so that every option is judged as when a file is read.
        changes = {name: value for name, value in self.record().items() if name != "kind"}
        return self.build(self.kind, {**changes, **options}, where)

    # ---- what composing, painting and the document ask

    @property
    def holds_strokes(self) -> bool:
        """Whether a layer of it without views is one that strokes are painted into."""
        return False

    @property
    def is_stroke(self) -> bool:
        """Whether it can be one of the strokes of a layer."""
        return False

    @property
    def is_local_paint(self) -> bool:
        """Whether it paints a part of the surface from its views, and so can be in conflict with other such layers."""
        return False

    @property
    def reads_locally(self) -> bool:
        """Whether read_set.py says what it reads of the Gaussians below (on the analytic painter)."""
        return False

    @property
    def relights(self) -> bool:
        """Whether it changes the light on the asset, and nothing else (replay/light_below.py)."""
        return False

    @property
    def takes_views(self) -> bool:
        """Whether a layer of it can have views."""
        return False

    @property
    def needs_views(self) -> bool:
        """Whether a layer of it that is added has one at least."""
        return self.takes_views

    @property
    def takes_pictures(self) -> bool:
        """Whether its views are edited pictures; else masks alone count."""
        return False

    @property
    def certain_confidence(self) -> int:
        """Level of its confidence (0..255) above which a Gaussian counts as seen."""
        return 127

    @property
    def needs_masks(self) -> bool:
        """Whether a view without a mask gets that of what it changed; else all of the asset is meant."""
        return True

    def is_stored(self, views: tuple[View, ...]) -> bool:
        """Whether results are stored; else they are made anew as quickly."""
        return True

    def variant(self, fades: bool) -> str:
        """What of the layer's opacity and blend the result itself depends on, as part of its key."""
        return ""

    def for_strokes(self) -> LayerOperation | None:
        """The operation of the layer of strokes that a layer of this one becomes when it is painted into; None: nothing
        can be painted into it."""
        return None

    def repainted(self, painter: Painter, method: Method | None = None) -> LayerOperation:
        """As the painter of now makes it, by another method if one is given; operations that no painter makes stay as
        they are."""
        return self

    # ---- what it does

    def result(self, work: LayerWork) -> LayerResult:
        """What it makes of the Gaussians below; nothing is cached. Raises ValueError where it cannot be applied."""
        raise NotImplementedError

    def glance(self, work: LayerWork) -> np.ndarray | None:
        """[N, 1, 3] SH: base colours, nearly those that `result` gives to the Gaussians below, in a fraction of the
        time, while its options are dragged; None: there is no such way. Raises ValueError as `result`."""
        return None

    def mix(
        self,
        below: Splats,
        delta: Delta,
        opacity: float,
        blend: Blend,
        strength: np.ndarray | None,
        mask: np.ndarray | None,
    ) -> Delta:
        """What is left of its delta at an opacity and a blend; see layer_blending.blend_delta."""
        return blend_delta(below, delta, opacity, blend, strength, mask)


def operation_of_layer(record: Any, where: str) -> LayerOperation:
    """The operation that `LayerOperation.record` describes. Raises ValueError naming `where`: no such kind, no such
    option, or a value that it cannot have."""
    if not isinstance(record, Mapping) or not isinstance(record.get("kind"), str):
        raise ValueError(f"{where}: expected the operation of a layer with its kind, got {brief(record)}")
    options = {name: value for name, value in record.items() if name != "kind"}
    return layer_class(record["kind"], where).build(record["kind"], options, where)


def layer_kinds() -> list[str]:
    """All kinds of layers, those of other distributions last."""
    return [*KINDS, *sorted({point.name for point in _entry_points()} - {*KINDS})]


def layer_class(kind: str, where: str) -> type[LayerOperation]:
    """The class of a kind. Raises ValueError naming `where`: there is none of that name."""
    if kind in KINDS:
        module, _, name = KINDS[kind].partition(":")
        return getattr(importlib.import_module(module if "." in module else f"{KINDS_PACKAGE}.{module}"), name)
    points = [point for point in _entry_points() if point.name == kind]
    if len(points) != 1:
        raise ValueError(f"{where}: expected a kind of {', '.join(layer_kinds())}, got {brief(kind)}")
    return points[0].load()


def _entry_points() -> list[importlib.metadata.EntryPoint]:
    return list(importlib.metadata.entry_points(group=ENTRY_POINTS))


def _json_copy(value: dict[str, Any], name: str) -> dict[str, Any]:
    """A copy of an object. Raises ValueError where JSON cannot hold it."""
    try:
        text = json.dumps(value, allow_nan=False, ensure_ascii=False)
        text.encode()  # halves of surrogate pairs are no text
        return json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        reason = printable(str(error), MAX_REASON)
        raise ValueError(f"expected {name} that JSON can hold ({reason})") from None
