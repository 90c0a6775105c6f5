"""Stand-ins for what ComfyUI gives its nodes: SPLAT, and as much of comfy_api.latest as schemas need.

Written after ComfyUI's published behaviour (docs.comfy.org/custom-nodes/v3_migration; comfy_api/latest/_io.py and
_util/geometry_types.py): inputs and outputs are objects of types with an io_type, a schema has unique ids, widgets have
their own options and refuse others, NodeOutput holds the results in order.
"""

from __future__ import annotations

import types
from dataclasses import dataclass, field
from typing import Any

import torch


class SPLAT:
    """A batch of Gaussians, tensors [B, N, ...]."""

    def __init__(self, positions, scales, rotations, opacities, sh, counts=None) -> None:
        self.positions: torch.Tensor = positions
        self.scales: torch.Tensor = scales
        self.rotations: torch.Tensor = rotations
        self.opacities: torch.Tensor = opacities
        self.sh: torch.Tensor = sh
        self.counts: torch.Tensor | None = counts


def comfy_type(io_type: str, *options: str) -> type:
    """A type with Input and Output; options: keywords of its widget."""

    class Input:
        def __init__(self, id: str, *, optional: bool = False, tooltip: str | None = None, **values: Any) -> None:
            unknown = set(values) - set(options)
            if unknown:
                raise TypeError(f"{io_type}.Input got an unexpected keyword argument {sorted(unknown)[0]!r}")
            self.id, self.optional, self.tooltip, self.values, self.io_type = id, optional, tooltip, values, io_type

    class Output:
        def __init__(
            self, id: str | None = None, *, display_name: str | None = None, tooltip: str | None = None
        ) -> None:
            self.id, self.display_name, self.tooltip, self.io_type = id, display_name, tooltip, io_type

    return type(io_type, (), {"Input": Input, "Output": Output, "io_type": io_type})


@dataclass
class Schema:
    node_id: str
    display_name: str
    category: str
    inputs: list[Any] = field(default_factory=list)
    outputs: list[Any] = field(default_factory=list)
    description: str = ""
    is_output_node: bool = False


class ComfyNode:
    """As ComfyUI calls it: the schema is judged, then execute with the inputs by name."""

    @classmethod
    def define_schema(cls) -> Schema:
        raise NotImplementedError

    @classmethod
    def execute(cls, **inputs: Any) -> Any:
        raise NotImplementedError


class NodeOutput:
    def __init__(self, *results: Any, ui: dict[str, Any] | None = None) -> None:
        self.result, self.ui = results, ui


class ComfyExtension:
    async def get_node_list(self) -> list[type]:
        raise NotImplementedError


def comfy_api(named: tuple[str, ...] = ("Splat", "Load3DCamera")) -> dict[str, types.ModuleType]:
    """Modules for sys.modules. named: types that `io` has beyond those of all versions."""
    number = ("default", "min", "max", "step", "force_input")
    io = types.SimpleNamespace(
        ComfyNode=ComfyNode,
        NodeOutput=NodeOutput,
        Schema=Schema,
        Custom=comfy_type,
        Image=comfy_type("IMAGE"),
        Mask=comfy_type("MASK"),
        Int=comfy_type("INT", *number),
        Float=comfy_type("FLOAT", *number),
        Boolean=comfy_type("BOOLEAN", "default"),
        String=comfy_type("STRING", "default", "multiline", "force_input"),
        Combo=comfy_type("COMBO", "options", "default"),
    )
    kinds = {"Splat": "SPLAT", "Load3DCamera": "LOAD3D_CAMERA"}
    for name in named:
        setattr(io, name, comfy_type(kinds[name]))
    package, latest = types.ModuleType("comfy_api"), types.ModuleType("comfy_api.latest")
    package.__path__ = []  # type: ignore[attr-defined]
    package.__spec__ = latest.__spec__ = types.SimpleNamespace()  # type: ignore[assignment]
    latest.io, latest.ComfyExtension = io, ComfyExtension  # type: ignore[attr-defined]
    latest.Types = types.SimpleNamespace(**({"SPLAT": SPLAT} if "Splat" in named else {}))  # type: ignore[attr-defined]
    return {"comfy_api": package, "comfy_api.latest": latest}
