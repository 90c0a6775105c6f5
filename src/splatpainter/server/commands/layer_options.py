"""The options of a layer as a page can offer them without knowing its kind: made from the fields of its operation, so
that kinds of other packages, too, have a panel."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, cast, get_args, get_origin

from splatpainter.server.commands.context import CommandContext, command
from splatpainter.server.message import Message, layer_options, option_docs
from splatpainter.server.protocol import Answer, Command
from splatpainter.system.jsonio import field_types
from splatpainter.system.ranges import bounds_of

OptionKind = Literal["number", "whole", "flag", "choice", "text"]
KINDS_OF_TYPES: dict[Any, OptionKind] = {float: "number", int: "whole", bool: "flag", str: "text"}
"""Types that a page has a control for; other options (pictures, lists, what may be None) are set elsewhere."""


class OptionInfo(Message):
    """One option."""

    name: str
    """As `layer.set` takes it in its parameters."""
    label: str
    """The name, for people."""
    help: str
    """What it means."""
    kind: OptionKind
    value: float | bool | str
    default: float | bool | str
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
    types, texts, names = field_types(type(options)), option_docs(type(options)), layer_options(type(options))
    out = []
    for entry in dataclasses.fields(options):
        spelled = entry.metadata.get("words") or types[entry.name]
        kind: OptionKind | None = "choice" if get_origin(spelled) is Literal else KINDS_OF_TYPES.get(spelled)
        value = getattr(options, entry.name)
        # What has no control, or was given in another form than the control's, is left as it is.
        has_control = isinstance(value, bool) if kind == "flag" else isinstance(value, str | int | float)
        if kind is None or not has_control or entry.name not in names:
            continue
        bounds, default = bounds_of(entry), entry.default
        out.append(
            OptionInfo(
                name=entry.name,
                label=entry.name.replace("_", " ").capitalize(),
                help=" ".join(texts.get(entry.name, "").split()),
                kind=kind,
                value=str(value) if kind in ("text", "choice") else value,
                default=str(default) if kind in ("text", "choice") else cast(Any, default),
                choices=[str(choice) for choice in get_args(spelled)] if kind == "choice" else [],
                low=bounds.get("ge", bounds.get("gt")),
                high=bounds.get("le", bounds.get("lt")),
            )
        )
    return out
