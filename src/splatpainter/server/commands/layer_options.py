"""The options of a layer as a page can offer them without knowing its kind: made from the fields of its operation, so
that kinds of other packages, too, have a panel."""

from __future__ import annotations

import dataclasses
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin

from splatpainter.server.commands.context import CommandContext, command
from splatpainter.server.message import Message, field_docs, layer_options
from splatpainter.server.protocol import Answer, Command
from splatpainter.system.jsonio import field_types
from splatpainter.system.ranges import bounds_of

OptionKind = Literal["number", "whole", "flag", "choice", "text", "lines"]
KINDS_OF_TYPES: dict[Any, OptionKind] = {
    float: "number",
    int: "whole",
    bool: "flag",
    str: "text",
    tuple[str, ...]: "lines",
}
"""Types that a page has a control for, also where they may be None; other options (pictures) are set elsewhere."""

FORMS: dict[OptionKind, Any] = {
    "number": int | float,
    "whole": int | float,
    "flag": bool,
    "choice": str | int | float,
    "text": str | int | float,
    "lines": tuple | list,
}
"""What a value has to be for its control to show it."""


class OptionInfo(Message):
    """One option."""

    name: str
    """As `layer.set` takes it in its parameters."""
    label: str
    """The name, for people."""
    help: str
    """What it means."""
    kind: OptionKind
    value: float | bool | str | list[str] | None
    default: float | bool | str | list[str] | None
    optional: bool
    """Whether it may be None."""
    choices: list[str]
    """Of a choice."""
    low: float | None
    """Least value of a number; None: no end."""
    high: float | None


class LayerOptionsListed(Answer):
    options: list[OptionInfo]


class LayerOptions(Command):
    """The options of a layer that can be changed by `layer.set`, whatever its kind."""

    NAME = "layer.options"
    ANSWER = LayerOptionsListed
    layer: str


@command(LayerOptions)
def list_layer_options(context: CommandContext, request: LayerOptions) -> LayerOptionsListed:
    options = context.studio.session.layers.by_id(request.layer).operation.options
    return LayerOptionsListed(options=option_infos(options))


def option_infos(options: Any) -> list[OptionInfo]:
    """The options of a dataclass that a page has a control for."""
    types, texts, names = field_types(type(options)), field_docs(type(options)), layer_options(type(options))
    out = []
    for entry in dataclasses.fields(options):
        spelled, optional = _without_none(entry.metadata.get("words") or types[entry.name])
        kind: OptionKind | None = "choice" if get_origin(spelled) is Literal else KINDS_OF_TYPES.get(spelled)
        value = getattr(options, entry.name)
        # What has no control, or was given in another form than the control's, is left as it is.
        if (
            kind is None
            or entry.name not in names
            or not (isinstance(value, FORMS[kind]) or optional and value is None)
        ):
            continue
        bounds, default = bounds_of(entry), entry.default
        out.append(
            OptionInfo(
                name=entry.name,
                label=entry.name.replace("_", " ").capitalize(),
                help=" ".join(texts.get(entry.name, "").split()),
                kind=kind,
                value=_plain(value, kind),
                default=_plain(default, kind),
                optional=optional,
                choices=[str(choice) for choice in get_args(spelled)] if kind == "choice" else [],
                low=bounds.get("ge", bounds.get("gt")),
                high=bounds.get("le", bounds.get("lt")),
            )
        )
    return out


def _without_none(spelled: Any) -> tuple[Any, bool]:
    """(the type, whether it may be None) of `float | None`."""
    parts = [part for part in get_args(spelled) if part is not NoneType]
    if isinstance(spelled, UnionType) and len(parts) == 1 and NoneType in get_args(spelled):
        return parts[0], True
    return spelled, False


def _plain(value: Any, kind: OptionKind) -> Any:
    """As JSON has it. Numbers as text keep their digits."""
    if value is None:
        return None
    return str(value) if kind in ("text", "choice") else list(value) if kind == "lines" else value
