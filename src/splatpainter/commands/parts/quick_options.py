"""Command-line words that leave no doubt, made into a Config without tyro, whose import and reading of types take a
third of the time of a small command. Whatever is not plain (help, mistakes, negative numbers, --name=value) is left to
tyro, which says what is wrong with it; what is read here is what tyro would have read.
"""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from splatpainter.commands.parts.option_marks import BY_POSITION, Argument

INTEGER = re.compile(r"[0-9]{1,18}")
DECIMAL = re.compile(r"[0-9]{1,18}(\.[0-9]{1,18})?")
MANY = -1
"""As many values as there are."""


class Doubtful(Exception):
    """Not plain: tyro has to read the line."""


class Option(NamedTuple):
    """How the words of a field are read."""

    field: str
    read: Callable[[str], Any]
    values: int
    """How many words it takes: 0 of a flag, or MANY."""


def quick_config(kind: type, words: Sequence[str], hints: dict[str, Any]) -> Any | None:
    """An instance of the dataclass `kind`, or None where tyro has to read the words. hints: its types with their
    marks."""
    try:
        named, positional = _options_of(kind, hints)
        given = _given(named, positional, words)
    except Doubtful:
        return None
    if any(_is_required(field) and field.name not in given for field in dataclasses.fields(kind)):
        return None
    try:
        return kind(**given)
    except ValueError:  # of the class itself, which tyro words
        return None


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _options_of(kind: type, hints: dict[str, Any]) -> tuple[dict[str, Option], list[Option]]:
    """(options by their names with dashes, those that are given by their position)."""
    named: dict[str, Option] = {}
    positional: list[Option] = []
    # As tyro sees them: keyword-only fields, which classes share, come last.
    for field in sorted(dataclasses.fields(kind), key=lambda field: bool(field.kw_only)):
        says = field.metadata
        hint, names, is_positional = says.get("words") or hints[field.name], [], says.get("positional", False)
        while get_origin(hint) is Annotated:
            hint, *marks = get_args(hint)
            for mark in marks:
                if isinstance(mark, Argument):
                    names += mark.aliases
                elif mark is BY_POSITION:
                    is_positional = True
                else:
                    raise Doubtful
        name = f"--{(says.get('option') or field.name).replace('_', '-')}"
        if hint is bool:
            # The only flag of a pair that changes something; the other one is refused.
            if field.default not in (True, False) or is_positional:
                raise Doubtful
            name = f"--no-{name[2:]}" if field.default else name
            option = Option(field.name, lambda _, value=not field.default: value, 0)
        else:
            option = Option(field.name, *_reader(hint))
        if is_positional:
            positional.append(option)
        else:
            named |= dict.fromkeys([name, *names], option)
    # Of one before the last that takes more than a word nobody could say where it ends.
    if any(option.values != 1 for option in positional[:-1]):
        raise Doubtful
    return named, positional


def _reader(hint: Any) -> tuple[Callable[[str], Any], int]:
    """(what makes a value of a word, how many words a field of this type takes)."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        read, values = _reader(arguments[0])
        if values == 1:
            return read, MANY
    if origin in (Union, types.UnionType) and len(arguments) == 2 and arguments[1] is type(None):
        read, values = _reader(arguments[0])
        if values == 1:
            return lambda word: read(_unless(word == "None", word)), 1
    if origin is Literal and all(type(choice) in (int, str) for choice in arguments):
        choices = {str(choice): choice for choice in arguments}
        return lambda word: choices[_unless(word not in choices, word)], 1
    if hint is Path or hint is str:
        return hint, 1
    if hint is int:
        return lambda word: int(_unless(INTEGER.fullmatch(word) is None, word)), 1
    if hint is float:
        return lambda word: float(_unless(DECIMAL.fullmatch(word) is None, word)), 1
    raise Doubtful


def _unless(is_doubtful: bool, word: str) -> str:
    if is_doubtful:
        raise Doubtful
    return word


def _given(named: dict[str, Option], positional: list[Option], words: Sequence[str]) -> dict[str, Any]:
    """Field -> value of those that the words give."""
    given: dict[str, Any] = {}
    free = list(positional)
    at = 0
    while at < len(words):
        # An option and the words behind it up to the next one; or words that have a position.
        word = words[at]
        if word.startswith("-"):
            option = named.get(word)
            at += 1
            if option is None or option.field in given:
                raise Doubtful
        elif free:
            option = free.pop(0)
        else:
            raise Doubtful
        most = len(words) if option.values == MANY else min(at + option.values, len(words))
        end = next((k for k in range(at, most) if words[k].startswith("-")), most)
        values = [option.read(_unless(not word, word)) for word in words[at:end]]
        if option.values == 0:
            given[option.field] = option.read("")
        elif option.values == MANY and values:
            given[option.field] = tuple(values)
        elif option.values == len(values) == 1:
            given[option.field] = values[0]
        else:
            raise Doubtful
        at = end
    return given
