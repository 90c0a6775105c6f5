"""Command-line words to a Config, by tyro where they are not plain (quick_options.py); its framed complaints become one
line. Knows no command."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import io
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, TypeAlias, get_args, get_origin, get_type_hints

from splatpainter.commands.parts.option_marks import BY_POSITION, Argument, Positional
from splatpainter.commands.parts.quick_options import quick_config
from splatpainter.operations.operation import option_texts
from splatpainter.splats import Axes

OLD_OPTIONS = {"--axes": "--out-frame", "--in-axes": "--frame"}
"""What options were called; scripts may still say it."""
AssetFile: TypeAlias = Annotated[Positional[Path], Argument(metavar="ASSET")]
OutFile: TypeAlias = Annotated[Path, Argument(metavar="OUT")]
CameraFiles: TypeAlias = Annotated[tuple[Path, ...], Argument(metavar="CAM.json[:N] ...", help_behavior_hint="")]
InAxesOption: TypeAlias = Annotated[Axes, Argument(metavar="auto|rub|rdf", aliases=(OLD_OPTIONS["--in-axes"],))]
"""Which way the numbers of a file point: rub is right-up-back (y up), rdf right-down-front (y down)."""
AxesOption: TypeAlias = Annotated[Axes, Argument(metavar="auto|rub|rdf", aliases=(OLD_OPTIONS["--axes"],))]
"""The same of a file that is written."""
NOT_A_NUMBER = (
    (r"invalid literal for int\(\) with base 10: (.*)$", "a whole number"),
    (r"could not convert string to float: (.*)$", "a number"),
    (r"no type matching \{None\}\|INT could be instantiated from \[(.*)\]", "a whole number"),
    (r"no type matching \{None\}\|FLOAT could be instantiated from \[(.*)\]", "a number"),
)
"""What Python and tyro say of a word that is no number (the word is the group), and what was expected."""
UNWRAPPED_COLUMNS = "4000"
"""Columns: tyro breaks no line where they are joined again."""


def parse(kind: type, program: str, words: Sequence[str]) -> Any:
    """An instance of the dataclass `kind` from command-line words.

    Raises ValueError with tyro's complaint in one line; --help prints the help and raises SystemExit(0)."""
    hints = get_type_hints(kind, include_extras=True)
    words = _out_by_place(hints, words)
    config = quick_config(kind, words, hints)
    if config is not None:
        return config
    _refuse_repeats_and_typos(kind, program, words)
    return parsed_by_tyro(kind, program, words)


def parsed_by_tyro(kind: type, program: str, words: Sequence[str]) -> Any:
    """As `parse`, whatever the words are."""
    import tyro  # a third of the time of a small command, and most lines are plain

    marks = (tyro.conf.FlagCreatePairsOff,)
    asks_for_help = "--help" in words or "-h" in words
    described = _described(kind, asks_for_help)
    if asks_for_help:
        return tyro.cli(described, prog=program, args=list(words), config=marks)
    box, unicode = io.StringIO(), io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    try:  # tyro looks at stdout's encoding for how it frames what it writes to stderr
        with (
            contextlib.redirect_stderr(box),
            contextlib.redirect_stdout(unicode),
            _environment("COLUMNS", UNWRAPPED_COLUMNS),
            _defaults_of_their_types(),
        ):
            return tyro.cli(described, prog=program, args=list(words), config=marks)
    except SystemExit as done:
        if done.code in (0, None):
            raise
        raise ValueError(f"{program}: {unboxed(box.getvalue(), program)}; see {program} --help") from None


def _out_by_place(hints: Mapping[str, Any], words: Sequence[str]) -> list[str]:
    """The words with `--out FILE` as the last place, where the output has a place: all other commands call it --out,
    and so do hands."""
    rest = list(words)
    has_place = BY_POSITION in getattr(hints.get("out"), "__metadata__", ())
    at = next((k for k, word in enumerate(rest) if word == "--out" or word.startswith("--out=")), None)
    if not has_place or at is None:
        return rest
    name, equals, value = rest.pop(at).partition("=")
    if not equals:
        value = rest.pop(at) if at < len(rest) else name
    return [*rest, value]


@functools.cache
def _described(kind: type, with_texts: bool) -> type:
    """The class as tyro is to see it: what `operations.operation.parameter` says of a field becomes an annotation.
    with_texts: docstrings of options, too, lose their line breaks, which tyro keeps beside its own; reading them takes
    time that only people who ask for help have, and so does the text of the class, which tyro would parse each time."""
    from tyro.conf import arg

    hints = get_type_hints(kind, include_extras=True)
    texts = option_texts(kind) if with_texts else {}
    annotations: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        hint, says = field.metadata.get("words") or hints[field.name], field.metadata
        values: dict[str, Any] = {}
        if "\n" in texts.get(field.name, "") or (says and field.name in texts):
            values["help"] = " ".join(texts[field.name].split())
        if says.get("metavar"):
            values["metavar"] = says["metavar"]
            if field.default in (None, "", ()):
                values["help_behavior_hint"] = ""
        if says.get("option"):
            values["name"] = says["option"].replace("_", "-")
        marked = _marked_for_tyro(Positional[hint] if says.get("positional") else hint)
        if values or marked is not hint:
            annotations[field.name] = Annotated[marked, arg(**values)] if values else marked
    if with_texts and not annotations:
        return kind
    # What classes share (their keyword-only fields) comes after what is peculiar to each.
    order = {field.name: field for field in sorted(dataclasses.fields(kind), key=lambda field: bool(field.kw_only))}
    members = {"__annotations__": annotations, "__module__": kind.__module__, "__dataclass_fields__": order}
    members["__doc__"] = kind.__doc__ if with_texts else None
    return type(kind.__name__, (kind,), members)


def _marked_for_tyro(hint: Any) -> Any:
    """A type with tyro's marks in place of ours."""
    from tyro import conf

    if get_origin(hint) is not Annotated:
        return hint
    hint, *marks = get_args(hint)
    for mark in marks:
        if mark is BY_POSITION:
            hint = conf.Positional[hint]
        elif isinstance(mark, Argument):
            hint = Annotated[
                hint, conf.arg(**{name: value for name, value in mark._asdict().items() if value not in (None, ())})
            ]
        else:
            hint = Annotated[hint, mark]
    return hint


def unboxed(text: str, program: str) -> str:
    """What tyro's framed error says, in one line: the words above the first rule, without the options' help.

    The frame is public behaviour and parse hooks are not (tyro 1.0 keeps them in a private module), so text it is."""
    body = [line.strip().removeprefix("│ ").removesuffix("│").rstrip() for line in text.splitlines()][1:]
    rules = [at for at, line in enumerate(body) if line.strip("─╰╯ ") == ""] + [len(body)]
    words = [line.strip() for line in body[: rules[0]] if not line.startswith(8 * " ")]  # deeper: help of an option
    line = " ".join(words).replace(f"Missing from {program}:", "missing").replace("Error parsing ", "")
    for pattern, what in NOT_A_NUMBER:
        line = re.sub(pattern, rf"expected {what}, got \1", line)
    return line.rstrip(". ") or "options that cannot be understood"


def _refuse_repeats_and_typos(kind: type, program: str, words: Sequence[str]) -> None:
    """tyro lets the last of two equal options win without a word, and blames positional words for a mistyped option."""
    options = [word.split("=", 1)[0].replace("_", "-") for word in words if word.startswith("--") and len(word) > 2]
    names = [option_name(field) for field in dataclasses.fields(kind)]
    valid_options = {f"{dashes}{name}" for name in ["help", *names] for dashes in ("--", "--no-")}
    present = {old: option for option, old in OLD_OPTIONS.items() if option in valid_options}
    valid_options |= set(present)
    options = [present.get(option, option) for option in options]
    for option in options:
        if option not in valid_options and "." not in option:
            near = difflib.get_close_matches(option, sorted(valid_options), 1)
            hint = f"; perhaps you meant {near[0]}" if near else ""
            raise ValueError(f"{program}: unknown option {option}{hint}; see {program} --help")
        if options.count(option) > 1:
            raise ValueError(f"{program}: {option} was given twice; give it once, with all its values behind it")


def option_name(field: dataclasses.Field) -> str:
    """The option of a field, without its dashes."""
    return (field.metadata.get("option") or field.name).replace("_", "-")


@contextlib.contextmanager
def _defaults_of_their_types() -> Iterator[None]:
    """tyro asks typeguard whether the defaults of options are of the options' types, which the type checker has said
    and a test asks again: importing it (with unittest.mock and asyncio) takes a sixth of the time of a refusal."""
    if "typeguard" in sys.modules:
        yield
        return
    answers = ModuleType("typeguard")
    answers.check_type = lambda value, kind: value  # pyright: ignore[reportAttributeAccessIssue]
    answers.TypeCheckError = TypeError  # pyright: ignore[reportAttributeAccessIssue]
    sys.modules["typeguard"] = answers
    try:
        yield
    finally:
        del sys.modules["typeguard"]


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name) if before is None else os.environ.update({name: before})
