"""The base of everything that travels, and messages whose fields are options of operations: declared and explained
once, in the dataclass of the operation, and taken over with their docstrings, defaults and ranges, so that the page's
types say the same.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, create_model

from splatpainter.session.kinds.operation_layers import REGION_OPTIONS
from splatpainter.system.jsonio import field_types
from splatpainter.system.ranges import bounds_of

FILES = ("file", "output", "blob")
"""What metadata says of options that name files, or the hash of a picture."""


class Message(BaseModel):
    """Base of everything that travels: unknown fields are errors, NaN and infinity are too."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        json_schema_serialization_defaults_required=True,
    )


def options_message(
    name: str, operation: type, options: Sequence[str], doc: str = "", parts: Mapping[type, type[Message]] | None = None
) -> Any:
    """A message of some options of an operation (a dataclass). name, doc: of the message. parts: dataclass -> the
    message that stands for it in lists. Raises KeyError for an option that the operation does not have."""
    # Types and texts are read once for all fields: both cost a look into the source.
    declared = {entry.name: entry for entry in dataclasses.fields(operation)}
    docs, types = option_docs(operation), field_types(operation)
    fields: dict[str, Any] = {}
    for option in options:
        entry = declared[option]
        # The ranges of the dataclass hold for the page too, so both refuse the same values.
        bounds = bounds_of(entry)
        limits: dict[str, Any] = {}
        spelled = entry.metadata.get("words") or (str | None if entry.metadata.get("file") else types[option])
        if get_origin(spelled) is tuple:
            spelled = _in_lists(spelled, bounds, parts or {})
        else:
            limits |= bounds
        if entry.metadata.get("max_length") is not None:
            limits["max_length"] = entry.metadata["max_length"]
        if entry.default is not dataclasses.MISSING or entry.default_factory is not dataclasses.MISSING:
            limits["default"] = entry.default_factory() if callable(entry.default_factory) else entry.default
        fields[option] = (spelled, Field(description=docs.get(option, ""), **limits))
    return create_model(name, __base__=Message, __doc__=doc, __module__=operation.__module__, **fields)


def _in_lists(hint: Any, bounds: Mapping[str, Any], parts: Mapping[type, type[Message]]) -> Any:
    """A type with bounds on its numbers, and messages in place of dataclasses."""
    if get_origin(hint) is tuple:
        inner = [part if part is ... else _in_lists(part, bounds, parts) for part in get_args(hint)]
        return tuple[tuple(inner)]  # type: ignore[misc]
    if hint in (int, float) and bounds:
        return Annotated[hint, Field(**bounds)]
    return parts.get(hint, hint)


def layer_options(operation: type) -> list[str]:
    """The options of an operation that a layer of it can have: those that name no pictures or region, and no files but
    such as a project holds."""
    fields = dataclasses.fields(operation)
    files = {entry.name for entry in fields if any(entry.metadata.get(role) for role in FILES)}
    files -= {*getattr(operation, "holds", ())}
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
