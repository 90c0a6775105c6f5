"""Nodes made of SplatPainter's operations: their inputs are the operations' options, each explained there once.

Left out are operations that get pictures which ComfyUI makes itself (paint, generate, refine: nodes.py has nodes for
that) and options of picture sources. An operation of another distribution becomes a node, too.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from splatpainter.image_files import write_png
from splatpainter.operations.operation import Operation, kinds, operation_class, option_texts
from splatpainter.operations.painting_options import PictureSourceOptions
from splatpainter.system.atomic import write_text
from splatpainter.system.ranges import bounds_of

from .lineage import asset_of, with_lineage
from .operations import input_file
from .schemas import Node, Slot
from .values import camera_of, picture_of

WITHOUT_NODES = ("paint", "generate", "refine")
OF_SOURCES = {field.name for field in dataclasses.fields(PictureSourceOptions)} | {"view"}
"""Options of operations that may ask a picture source."""
LINKS = {"picture": "IMAGE", "camera": "LOAD3D_CAMERA"}
"""What an option's file holds -> the link that stands for it."""
MAX_PX, FAR = 4096, 36000
"""Most pixels of a view; the range of a number that has none of its own."""


def operation_nodes() -> tuple[Node, ...]:
    """A node for each operation."""
    return tuple(_node(kind) for kind in kinds() if kind not in WITHOUT_NODES)


def _node(kind: str) -> Node:
    operation = operation_class(kind)
    fields, texts = _fields(operation), option_texts(operation)
    slots = [Slot("splat", "SPLAT", tooltip="One gaussian splat.")]
    slots += [_slot(operation, field, " ".join(texts.get(field.name, "").split())) for field in fields]
    if any(field.metadata.get("holds") == "camera" for field in fields):
        for side in ("width", "height"):
            options = {"default": 1024, "min": 64, "max": MAX_PX, "step": 8}
            slots.append(Slot(f"view_{side}", "INT", True, f"{side.capitalize()} of the camera's picture.", options))
    outputs = (Slot("splat", "SPLAT"), Slot("receipt", "STRING", tooltip="Which gaussians changed, as JSON."))
    name = kind.capitalize()
    about = " ".join((operation.__doc__ or "").split())
    return Node(f"SplatPainter{name}", f"{name} (SplatPainter)", about, tuple(slots), outputs, _function(operation))


def _fields(operation: type[Operation]) -> list[dataclasses.Field]:
    """The options that a node has."""
    hidden = OF_SOURCES if issubclass(operation, PictureSourceOptions) else set()
    fields = dataclasses.fields(operation)
    fields = [field for field in fields if field.name not in hidden and not field.metadata.get("output")]
    return sorted(fields, key=lambda field: bool(field.kw_only))


def _slot(operation: type[Operation], field: dataclasses.Field, text: str) -> Slot:
    """The input of an option: a link for pictures and cameras, else a widget. All may be left out."""
    says, hint = field.metadata, get_type_hints(operation)[field.name]
    if says.get("holds") in LINKS:
        return Slot(field.name, LINKS[says["holds"]], True, text)
    default = field.default
    if get_origin(hint) is Literal:
        return Slot(field.name, "COMBO", True, text, {"options": list(get_args(hint)), "default": default})
    if hint is bool:
        return Slot(field.name, "BOOLEAN", True, text, {"default": default})
    if hint in (int, float):
        kind, step = ("INT", 1) if hint is int else ("FLOAT", 0.01)
        bounds = bounds_of(field)
        # Widgets know no open ends: a value at one is refused by the operation, in its own words.
        low, high = bounds.get("ge", bounds.get("gt", -FAR)), bounds.get("le", bounds.get("lt", FAR))
        return Slot(field.name, kind, True, text, {"default": default, "min": low, "max": high, "step": step})
    return Slot(field.name, "STRING", True, text, {"default": "" if default in (None, ()) else str(default)})


def _function(operation: type[Operation]) -> Callable[..., tuple]:
    fields, hints = {field.name: field for field in _fields(operation)}, get_type_hints(operation)

    def run(splat: Any, view_width: int = 1024, view_height: int = 1024, **inputs: Any) -> tuple:
        """(SPLAT, STRING): the splat afterwards, and the receipt as JSON."""
        with tempfile.TemporaryDirectory() as folder:
            values = {}
            for name, given in inputs.items():
                if given is None or (isinstance(given, str) and not given.strip()):
                    continue
                values[name] = _value(fields[name], hints[name], given, Path(folder), (view_width, view_height))
            asset, lineage = asset_of(splat)
            edited = operation(**values).apply(asset)
        assert edited.receipt is not None
        line = None if lineage is None else lineage.edited(edited)
        return with_lineage(edited.splats, line, type(splat), splat.positions.device), edited.receipt.to_json()

    return run


def _value(field: dataclasses.Field, hint: Any, given: Any, folder: Path, size: tuple[int, int]) -> Any:
    """What an option gets of an input: files of what ComfyUI has in memory, words of a line of text."""
    if field.metadata.get("holds") == "picture":
        write_png(folder / f"{field.name}.png", picture_of(given, field.name))
        return folder / f"{field.name}.png"
    if field.metadata.get("holds") == "camera":
        write_text(folder / f"{field.name}.json", camera_of(given, *size).to_json())
        return folder / f"{field.name}.json"
    if field.metadata.get("file"):
        return input_file(given)
    if field.metadata.get("holds") == "region":
        return (given.strip(),)  # whose names may hold blanks
    if get_origin(hint) is tuple and field.metadata.get("words") is None:
        return tuple(given.split())
    if type(None) in get_args(hint) and {int, float} & {*get_args(hint)}:
        return float(given)
    return given
