"""A node described once becomes a class of either of ComfyUI's schemas. Knows no node.

V1 (any ComfyUI): a class with INPUT_TYPES, RETURN_TYPES, FUNCTION and CATEGORY. V3 (docs.comfy.org/custom-nodes/
v3_migration): a subclass of io.ComfyNode with define_schema and execute, offered by a ComfyExtension.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

CATEGORY = "3d/splat/SplatPainter"
WIDGETS = ("STRING", "INT", "FLOAT", "BOOLEAN", "COMBO")
"""Types that have a widget; the others are links."""
V3_NAMES = {
    "STRING": "String",
    "INT": "Int",
    "FLOAT": "Float",
    "BOOLEAN": "Boolean",
    "COMBO": "Combo",
    "IMAGE": "Image",
    "MASK": "Mask",
    "SPLAT": "Splat",
    "LOAD3D_CAMERA": "Load3DCamera",
}
"""Names in `io`; what a version does not name (SPLAT came in 2026) and this pack's lists of views are custom types."""


@dataclass(frozen=True)
class Slot:
    """An input or an output."""

    id: str
    type: str
    optional: bool = False
    tooltip: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    """Of a widget: default, min, max, step, multiline; of a COMBO also `options`."""


@dataclass(frozen=True)
class Node:
    """One node: what it takes, what it gives, and the function between them."""

    id: str
    display_name: str
    description: str
    inputs: tuple[Slot, ...]
    outputs: tuple[Slot, ...]
    function: Callable[..., tuple]
    """Takes the inputs by their ids, gives a tuple in the order of the outputs."""
    is_output: bool = False
    """Whether it is run for what it does (writes a file)."""
    state: Callable[..., str] | None = None
    """Takes the inputs that are no links; what it gives changes when the node is to run again although they did not."""
    history_entry: Callable[[tuple], dict] | None = None
    """What the history of a run lists, of the outputs."""


def v1_class(node: Node) -> type:
    """The node as a class of the old schema."""

    def input_types(_: type) -> dict[str, dict[str, tuple]]:
        out: dict[str, dict[str, tuple]] = {"required": {}, "optional": {}}
        for slot in node.inputs:
            options = {key: value for key, value in slot.options.items() if key != "options"}
            options |= {"tooltip": slot.tooltip} if slot.tooltip else {}
            kind: Any = slot.options["options"] if slot.type == "COMBO" else slot.type
            out["optional" if slot.optional else "required"][slot.id] = (kind, options)
        return out

    def execute(_: object, **inputs: Any) -> Any:
        result = node.function(**inputs)
        return result if node.history_entry is None else {"ui": node.history_entry(result), "result": result}

    values = {
        "INPUT_TYPES": classmethod(input_types),
        "RETURN_TYPES": tuple(slot.type for slot in node.outputs),
        "RETURN_NAMES": tuple(slot.id for slot in node.outputs),
        "OUTPUT_TOOLTIPS": tuple(slot.tooltip for slot in node.outputs),
        "FUNCTION": "execute",
        "CATEGORY": CATEGORY,
        "DESCRIPTION": node.description,
        "OUTPUT_NODE": node.is_output,
        "execute": execute,
    }
    if node.state is not None:
        values["IS_CHANGED"] = classmethod(_state(node.state))
    return type(node.id, (), values)


def v3_class(node: Node) -> type:
    """The node as a class of the newer schema. Imports comfy_api."""
    io = importlib.import_module("comfy_api.latest").io

    def define_schema(_: type) -> Any:
        return io.Schema(
            node_id=node.id,
            display_name=node.display_name,
            category=CATEGORY,
            description=node.description,
            inputs=[_v3_input(io, slot) for slot in node.inputs],
            outputs=[
                _v3_type(io, slot.type).Output(display_name=slot.id, tooltip=slot.tooltip) for slot in node.outputs
            ],
            is_output_node=node.is_output,
        )

    def execute(_: type, **inputs: Any) -> Any:
        result = node.function(**inputs)
        entry = None if node.history_entry is None else node.history_entry(result)
        return io.NodeOutput(*result, ui=entry)

    methods = {"define_schema": classmethod(define_schema), "execute": classmethod(execute)}
    if node.state is not None:
        methods["fingerprint_inputs"] = classmethod(_state(node.state))
    return type(node.id, (io.ComfyNode,), methods)


def _state(function: Callable[..., str]) -> Callable[..., str]:
    return lambda _, **inputs: function(**inputs)


def v3_extension(nodes: Sequence[Node]) -> Any:
    """A ComfyExtension with these nodes. Imports comfy_api."""
    latest = importlib.import_module("comfy_api.latest")

    class SplatPainterExtension(latest.ComfyExtension):
        async def get_node_list(self) -> list[type]:
            return [v3_class(node) for node in nodes]

    return SplatPainterExtension()


def _v3_input(io: Any, slot: Slot) -> Any:
    options = {**slot.options, "optional": slot.optional}
    if slot.tooltip:
        options["tooltip"] = slot.tooltip
    return _v3_type(io, slot.type).Input(slot.id, **options)


def _v3_type(io: Any, name: str) -> Any:
    named = getattr(io, V3_NAMES.get(name, ""), None)
    return named if named is not None else io.Custom(name)


def has_v3() -> bool:
    """Whether this ComfyUI loads nodes of the newer schema."""
    try:
        return hasattr(importlib.import_module("comfy_api.latest"), "ComfyExtension")
    except ImportError:
        return False
