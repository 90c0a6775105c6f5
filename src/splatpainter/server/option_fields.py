"""Fields of messages that are options of operations: declared and explained once, in the dataclass of the operation,
and taken over here with their docstrings, defaults and ranges, so that the page's types say the same.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Sequence
from functools import cache
from typing import Any, Literal

from pydantic import Field, create_model

from splatpainter.operations.light import Delight, Relight
from splatpainter.operations.pixelate import Pixelate
from splatpainter.server.protocol import Message
from splatpainter.session.kinds.operation_layers import REGION_OPTIONS
from splatpainter.session.kinds.painted_layers import PaintedLayer
from splatpainter.system.jsonio import field_types


def options_message(name: str, operation: type, options: Sequence[str], doc: str) -> Any:
    """A message of some options of an operation (a dataclass). name, doc: of the message. Raises KeyError for an option
    that the operation does not have."""
    # Types and texts are read once for all fields: both cost a look into the source.
    declared = {entry.name: entry for entry in dataclasses.fields(operation)}
    docs, types = option_docs(operation), field_types(operation)
    fields: dict[str, Any] = {}
    for option in options:
        entry = declared[option]
        default = entry.default_factory() if callable(entry.default_factory) else entry.default
        # The ranges of the dataclass hold for the page too, so both refuse the same values.
        limits = {word: entry.metadata[word] for word in ("ge", "le", "gt", "lt") if word in entry.metadata}
        spelled = entry.metadata.get("words") or types[option]
        fields[option] = (spelled, Field(default=default, description=docs.get(option, ""), **limits))
    return create_model(name, __base__=Message, __doc__=doc, __module__=operation.__module__, **fields)


def layer_options(operation: type) -> list[str]:
    """The options of an operation that a layer of it can have: those that name no files and no region."""
    fields = dataclasses.fields(operation)
    files = {entry.name for entry in fields if entry.metadata.get("file") or entry.metadata.get("output")}
    return [entry.name for entry in fields if entry.name not in files and entry.name not in REGION_OPTIONS]


@cache
def option_docs(operation: type) -> dict[str, str]:
    """Option -> the text that stands under it in its dataclass, or in one that that one is made from."""
    docs: dict[str, str] = {}
    # From the base downwards, so that a class that explains an option anew has the last word.
    for kind in reversed(operation.__mro__):
        if not dataclasses.is_dataclass(kind):
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(body, ast.ClassDef)
        # Python keeps no docstrings of fields, so they are read from the source: the text after its declaration.
        for before, after in zip(body.body, body.body[1:], strict=False):
            if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name) and _is_text(after):
                docs[before.target.id] = inspect.cleandoc(after.value.value)  # type: ignore[attr-defined]
    return docs


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


PaintedOptions = options_message(
    "PaintedOptions", PaintedLayer, ("mode", "method", "within"), "How pictures are painted."
)


class PaintLimits(options_message("LimitOptions", PaintedLayer, ("angle_limit", "depth_edge_limit"), "")):
    """What one view may paint of surfaces that it cannot see well; null: as the painter has it."""

    def options(self) -> dict[str, Any]:
        """The limits as options of a layer."""
        return self.model_dump(exclude_none=True)


class LightOptions(options_message("LightFields", Relight, layer_options(Relight), "")):
    """A new light on the asset, as a layer."""

    kind: Literal["light"]


class DelightOptions(options_message("DelightFields", Delight, layer_options(Delight), "")):
    """The light that is in the asset's colours taken out, as a layer."""

    kind: Literal["delight"]


class PixelateOptions(options_message("PixelateFields", Pixelate, layer_options(Pixelate), "")):
    """What is selected made unreadable from all sides, as a layer."""

    kind: Literal["pixelate"]


OperationOptions = LightOptions | DelightOptions | PixelateOptions
"""Operations that can be layers."""
