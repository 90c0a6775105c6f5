"""Options of a picture source: words KEY=VALUE and environment variables become a dataclass. Nothing is ignored: an
option that the source does not have is refused with the list of those that it has.

    @dataclass(frozen=True)
    class RustOptions:
        amount: float = option("Share of the rust.", 0.5, least=0, most=1)

    parse_options(RustOptions, "rust", {"amount": "0.8"})      # or SPLATPAINTER_RUST_AMOUNT=0.8
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.util
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from splatpainter.sources.picture_source import Capabilities, SourceError, describe
from splatpainter.system.quick_dataclass import dataclass

MAX_OPTION_CHARACTERS = 10_000
"""Most characters of one value."""
TRUTH_VALUES = {"yes": True, "true": True, "1": True, "on": True, "no": False, "false": False, "0": False, "off": False}
_T = TypeVar("_T")


@dataclass(frozen=True)
class OptionHelp:
    """One option, as people read it."""

    name: str
    meaning: str
    default: str
    """"" where it has to be given (`required`) or is empty."""
    environment: tuple[str, ...]
    """Variables that set it where it is not given, the first that is set."""
    required: bool


@dataclass(frozen=True)
class SourceDescription:
    """What `splatpainter source list` says of a source without opening it. A factory of another package may carry one
    as its attribute `description`."""

    name: str
    summary: str
    """One line."""
    options: type | None = None
    """Dataclass of its options."""
    capabilities: Capabilities | None = None
    """Capabilities with the options' defaults; None: they depend on the options."""
    takes: str = ""
    """What it takes in words, where `capabilities` is None."""
    keys: tuple[str, ...] = ()
    """Environment variables that may hold its key; the first that is set is used."""
    key_optional: bool = False
    """Whether it also works without a key."""
    modules: tuple[str, ...] = ()
    """Modules that must be installed."""
    extra: str = ""
    """The extra of splatpainter that brings them."""

    @property
    def accepts(self) -> str:
        """What it takes, in words."""
        return self.takes or (describe(self.capabilities) if self.capabilities is not None else "")

    @property
    def missing_modules(self) -> tuple[str, ...]:
        """Those of `modules` that are not installed; nothing is imported."""
        return tuple(name for name in self.modules if not is_installed(name))

    @property
    def key_variable(self) -> str:
        """The variable that holds the key here, or ""."""
        return next((name for name in self.keys if os.environ.get(name)), "")


def is_installed(module: str) -> bool:
    """Whether a module of that name is there; it is not imported to find out."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):  # half installed
        return False


def option(
    meaning: str,
    default: Any = MISSING,
    *,
    environment: tuple[str, ...] = (),
    least: float | None = None,
    most: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """A field of a dataclass of options: str, int, float, bool or Path, or one of them or None. environment: variables
    that set it besides SPLATPAINTER_SOURCE_OPTION. least, most: bounds of a number. choices: words that it may be."""
    metadata = {
        "meaning": meaning,
        "environment": environment,
        "least": least,
        "most": most,
        "choices": choices,
    }
    return dataclasses.field(default=default, metadata=metadata)


def option_words(words: Iterable[str]) -> dict[str, str]:
    """KEY=VALUE words as a dict. Raises ValueError: no "=", no key, a key that stands there twice."""
    options: dict[str, str] = {}
    for word in words:
        # Dashes or underscores: people type both, and fields have only the one.
        key, equals, value = word.partition("=")
        key = key.strip().replace("-", "_")
        if not equals or not key:
            raise ValueError(f"--source-option: expected KEY=VALUE, got {word[:80]!r}")
        # Twice is a mistake; the later one would win in silence.
        if key in options:
            raise ValueError(f"--source-option: {key} was given twice")
        options[key] = value
    return options


def parse_options(kind: type[_T], source: str, given: Mapping[str, str]) -> _T:
    """An instance of the dataclass `kind`: given options first, then environment variables, then defaults.

    Raises SourceError in one line: an unknown option (with those that exist), a missing one, a value of another type
    or out of its range."""
    # Unknown names first: a misspelt option is the likeliest reason for a missing one.
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for name in given:
        if name not in fields:
            near = difflib.get_close_matches(name, fields, 1)
            hint = f"; perhaps you meant {near[0]}" if near else ""
            listed = ", ".join(fields) or "no options"
            raise SourceError(f"source {source}: no option {name[:80]!r}{hint}; it has {listed}")
    hints = get_type_hints(kind)
    values: dict[str, Any] = {}
    # Given options, then the environment, then defaults: the nearest to the user wins.
    for name, field in fields.items():
        variables = environment_names(source, name, field.metadata.get("environment", ()))
        variable = next((variable for variable in variables if os.environ.get(variable)), None)
        if name in given:
            values[name] = _value(hints[name], str(given[name]), field.metadata, f"source {source}: option {name}")
        elif variable is not None:
            values[name] = _value(hints[name], os.environ[variable], field.metadata, f"source {source}: {variable}")
        elif field.default is MISSING:
            # The line says both ways to give it, since one of them suits scripts and the other people.
            meaning = field.metadata.get("meaning", "").rstrip(".")
            raise SourceError(
                f"source {source}: needs the option {name} ({meaning}): --source-option {name}=..., or {variables[0]}"
            )
    return kind(**values)


def environment_names(source: str, name: str, more: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Variables of an option, the program's own first."""
    return (re.sub(r"\W", "_", f"SPLATPAINTER_{source}_{name}").upper(), *more)


def options_help(description: SourceDescription) -> tuple[OptionHelp, ...]:
    """The options of a source."""
    if description.options is None:
        return ()
    # From the fields themselves, so that help and parser cannot differ.
    return tuple(
        OptionHelp(
            field.name,
            field.metadata.get("meaning", ""),
            "" if field.default is MISSING or field.default is None else _plain(field.default),
            environment_names(description.name, field.name, field.metadata.get("environment", ())),
            field.default is MISSING,
        )
        for field in dataclasses.fields(description.options)
    )


def _plain(value: Any) -> str:
    return ("yes" if value else "no") if isinstance(value, bool) else str(value)


def _value(hint: Any, text: str, metadata: Mapping[str, Any], where: str) -> Any:
    # Of an option that may be None only the other kind can be written down.
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind is not type(None)]
    kind = kinds[0]
    text = text.strip()
    # Before anything is parsed: text may come from a file or a page.
    if len(text) > MAX_OPTION_CHARACTERS or "\0" in text:
        raise SourceError(f"{where}: expected at most {MAX_OPTION_CHARACTERS:,} characters and none of them NUL")
    if kind is bool:
        if text.lower() not in TRUTH_VALUES:
            raise SourceError(f"{where}: expected yes or no, got {text[:80]!r}")
        return TRUTH_VALUES[text.lower()]
    if kind in (int, float):
        return _number(kind, text, metadata, where)
    # Choices are words and compared as such; bounds belong to numbers.
    choices = metadata.get("choices", ())
    if choices and text not in choices:
        raise SourceError(f"{where}: expected {' or '.join(choices)}, got {text[:80]!r}")
    if kind is Path:
        if not text:
            raise SourceError(f"{where}: expected a path, got nothing")
        return Path(text).expanduser()
    return text


def _number(kind: type, text: str, metadata: Mapping[str, Any], where: str) -> int | float:
    least, most = metadata.get("least"), metadata.get("most")
    try:
        number = kind(text)
        # NaN fails every comparison, so it is refused by being finite and not by the bounds.
        inside = math.isfinite(number) and (least is None or number >= least) and (most is None or number <= most)
    except (ValueError, OverflowError):
        number, inside = 0, False
    if not inside:
        # The line names only the bounds that there are.
        low = [f"at least {least}"] if least is not None else []
        high = [f"at most {most}"] if most is not None else []
        span = " and ".join(low + high)
        what = "a whole number" if kind is int else "a number"
        raise SourceError(f"{where}: expected {what}{f' of {span}' if span else ''}, got {text[:80]!r}")
    return number
