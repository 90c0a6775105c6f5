"""The base of everything that travels, and messages whose fields are options of operations: declared and explained
once, in the dataclass of the operation, and taken over with their docstrings, defaults and ranges, so that the page's
types say the same.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, ClassVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, create_model
from pydantic_core import CoreSchema

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
        json_schema_serialization_defaults_required=True,
    )
    OPERATION: ClassVar[type | None] = None
    """Whose options the fields are, if they are any's."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """With the texts under the fields. pydantic would read them as each class is made, which is two fifths of the
        time that a studio takes to be imported; here they are read where a schema is asked for."""
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in field_docs(cls).items():
            if text and name in properties:
                properties[name].setdefault("description", text)
        return schema


def options_message(
    name: str, operation: type, options: Sequence[str], doc: str = "", parts: Mapping[type, type[Message]] | None = None
) -> Any:
    """A message of some options of an operation (a dataclass). name, doc: of the message. parts: dataclass -> the
    message that stands for it in lists. Raises KeyError for an option that the operation does not have."""
    declared, types = {entry.name: entry for entry in dataclasses.fields(operation)}, field_types(operation)
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
        fields[option] = (spelled, Field(**limits))
    made = create_model(name, __base__=Message, __doc__=doc, __module__=operation.__module__, **fields)
    made.OPERATION = operation
    return made


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
def field_docs(kind: type) -> dict[str, str]:
    """Field of a dataclass or message -> the text that stands under it there, or in one that that one is made from."""
    docs: dict[str, str] = {}
    # From the base downwards, so that a class that explains a field anew has the last word.
    for base in reversed(kind.__mro__):
        operation = base.__dict__.get("OPERATION")
        if operation is not None:
            docs |= {name: text for name, text in field_docs(operation).items() if name in base.model_fields}
        elif dataclasses.is_dataclass(base) or issubclass(base, Message):
            there = _docs_of_module(base.__module__).get(base.__qualname__, {})
            # A message that declares a field anew means another thing, an operation only another default.
            docs |= there if issubclass(base, Message) else {name: text for name, text in there.items() if text}
    return docs


@cache
def _docs_of_module(module: str) -> dict[str, dict[str, str]]:
    """Qualified name of each class of a module -> field -> the text after its declaration, or "": Python keeps no
    docstrings of fields, so they are read from the source."""
    docs: dict[str, dict[str, str]] = {}

    def read(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                docs[prefix + child.name] = {
                    entry.target.id: _text(after)
                    for entry, after in zip(child.body, [*child.body[1:], None], strict=True)
                    if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name)
                }
                read(child, f"{prefix}{child.name}.")
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                read(child, f"{prefix}{child.name}.<locals>.")

    read(ast.parse(inspect.getsource(sys.modules[module])), "")
    return docs


def _text(node: ast.stmt | None) -> str:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return inspect.cleandoc(node.value.value)
    return ""
