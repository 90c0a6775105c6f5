"""`splatpainter edit` with the options of decals and picture sources beside those of pictures, in place of operations:

    splatpainter edit a.ply --decal label.png --at 400,300 ...     as    edit a.ply decal label.png --at 400,300 ...
    splatpainter edit a.ply --source gemini --prompt ...           as    edit a.ply generate --source gemini ...

The options are those of the operations; here stands only what they are called otherwise and which go together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, get_type_hints

from splatpainter.commands.parts.edited_file import spoken
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.operations.decal import LayDecal
from splatpainter.operations.generate import Generate
from splatpainter.operations.operation import Operation, Wording
from splatpainter.operations.paint import Paint

DECAL_NAMES = {"picture": "decal", "text": "decal_text", "font": "decal_font", "color": "decal_color"}
"""Field of a decal -> what it is called beside the options of pictures."""
OF_SOURCES = (
    "prompt", "view", "azimuth", "elevation", "size", "views", "max_views", "references", "seed", "enlarge", "options",
    "report", "dry_run",
)  # fmt: skip
"""Options that nothing but a source has a use for."""
OF_DECALS = ("at", "width", "font", "color", "angle", "wrap")


def parse_shorthand(words: Sequence[str], program: str, *bases: type) -> tuple[Any, Operation, Wording]:
    """(the options of the file, the one operation, how errors name its options). bases: dataclasses of the former.
    Raises ValueError as `option_parsing.parse`, and where options do not go together."""
    # One parser for all three: in this spelling the options stand side by side.
    config = parse(_shorthand(bases), program, words)
    where = f"{program}: "
    # What is given says which operation is meant; pictures are what is left.
    kind: type[Operation] = Generate if config.source else LayDecal if _has_decal(config) else Paint
    names = {field: f"--{name.replace('_', '-')}" for field, name in DECAL_NAMES.items()}
    # Errors have to name the options as they are called here.
    wording = spoken(kind, where, names if kind is LayDecal else {"cameras": "--camera"})
    # What belongs to one of them alone is refused beside the others before any value is used.
    _refuse_strays(config, where)
    _refuse_company(config, where)
    values = {field.name: _value(config, kind, field.name) for field in dataclasses.fields(kind)}
    # Cameras and masks are lists among the options of pictures; the others take one at most.
    if kind is Generate:
        if len(config.masks) > 1:
            raise ValueError(f"{where}expected at most one --mask, got {len(config.masks)}")
        values["mask"] = config.masks[0] if config.masks else None
    if kind is LayDecal:
        if len(config.cameras) > 1:
            line = "a decal needs one --camera CAM.json, in whose picture --at is a pixel"
            raise ValueError(f"{where}{line}, got {len(config.cameras)}")
        values["camera"] = config.cameras[0] if config.cameras else None
    return config, kind(**values), wording


def _shorthand(bases: Sequence[type]) -> type:
    """A dataclass with the options of pictures, decals and sources side by side, each once."""
    fields: dict[str, tuple[str, Any, Any]] = {}
    for kind in (Paint, LayDecal, Generate):
        hints = get_type_hints(kind)
        for entry in dataclasses.fields(kind):
            name = DECAL_NAMES.get(entry.name, entry.name) if kind is LayDecal else entry.name
            # The first one to bring an option declares it, so none stands there twice.
            if name in fields or name in ("camera", "mask"):  # one of each is among those of pictures
                continue
            metadata = {**entry.metadata, "positional": entry.name == "pictures"}
            hint: Any = hints[entry.name]
            fields[name] = (name, hint, dataclasses.field(default=entry.default, metadata=metadata, kw_only=True))
    return dataclasses.make_dataclass("Shorthand", fields.values(), bases=tuple(bases), frozen=True)


def _value(config: Any, kind: type, name: str) -> Any:
    spelled = DECAL_NAMES.get(name, name) if kind is LayDecal else name
    return getattr(config, spelled, None)


def _has_decal(config: Any) -> bool:
    return config.decal is not None or bool(config.decal_text)


def _is_given(config: Any, kind: type, name: str) -> bool:
    default = {entry.name: entry.default for entry in dataclasses.fields(kind)}.get(name, False)
    return _value(config, kind, name) != default


def _refuse_strays(config: Any, where: str) -> None:
    """Raises ValueError for an option of sources without a source, of decals without a decal."""
    options = spoken(Generate, where)
    for name in OF_SOURCES if not config.source else ():
        # With mode spread a dry run is of pictures, and needs no source.
        if _is_given(config, Generate, name) and not (name == "dry_run" and config.mode == "spread"):
            line = f"{options.option(name)} is for pictures that a source makes; give --source NAME too"
            raise ValueError(f"{where}{line}")
    for name in OF_DECALS if not _has_decal(config) else ():
        if _is_given(config, LayDecal, name):
            spelled = DECAL_NAMES.get(name, name).replace("_", "-")
            line = f"--{spelled} is for decals; give --decal PICTURE or --decal-text WORD too"
            raise ValueError(f"{where}{line}")


def _refuse_company(config: Any, where: str) -> None:
    """Raises ValueError where pictures, a decal and a source, or what is for one of them, stand beside each other."""
    decal = _has_decal(config)
    # A source makes its own pictures, and a decal is one: together it would be open what is painted.
    if config.source and (decal or config.pictures or config.cameras):
        raise ValueError(
            f"{where}a source takes the place of pictures (VIEW.png), their --camera and decals; the view that is sent "
            "is --view CAM.json"
        )
    if decal and (config.pictures or config.masks):
        raise ValueError(f"{where}a decal takes the place of pictures (VIEW.png) and masks; give one or the other")
    if decal and (config.mode != "local" or config.method == "ttt"):
        raise ValueError(f"{where}a decal is an edit of mode local by method lift or fit")
    if (decal or config.source) and (config.correct or config.force):
        raise ValueError(f"{where}--correct and --force are for pictures (VIEW.png), no source or decal")
