"""JSON that nobody vouches for: text parsed within limits, values fetched by their expected kind, objects made into
dataclasses.

The meta.json of SOG, the JSON chunk of glTF, model configs and recipes are read through this; a value of another kind
is a ValueError in one line, never a TypeError or an AttributeError further on. Knows no files.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
import os
import types
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

MAX_JSON_BYTES = 16 << 20
"""Bytes of JSON text that are parsed. Parsed, small objects take 25 to 40 times their text in memory."""
MAX_JSON_DEPTH = 64
"""Lists and objects inside each other; glTF and SOG need fewer than 20."""
MAX_INTEGER = 2**53 - 1
"""The largest integer that every JSON reader holds exactly."""
_Dataclass = TypeVar("_Dataclass")


class FieldError(ValueError):
    """A value of a document that is not what its dataclass says."""

    def __init__(self, where: str, path: str, reason: str) -> None:
        super().__init__(f"{where}: {reason}")
        self.path = path
        """Dotted path of the value, or of what it belongs to: "refine.layers[2].dim"; "" for the document."""
        self.reason = reason


def load_object(
    data: bytes | memoryview | str, where: Path | str, what: str, max_bytes: int = MAX_JSON_BYTES
) -> dict[str, Any]:
    """The JSON object in `data`. what: its name for errors.

    Raises ValueError: longer than max_bytes, not UTF-8 JSON, nested deeper than MAX_JSON_DEPTH, not an object, or
    numbers beyond the range of a double.
    """
    document = load_document(data, where, what, max_bytes)
    if not isinstance(document, dict):
        raise ValueError(f"{where}: expected an object as {what}, found {type(document).__name__}")
    return document


def load_document(
    data: bytes | memoryview | str, where: Path | str, what: str, max_bytes: int = MAX_JSON_BYTES
) -> dict[str, Any] | list[Any]:
    """The JSON object or list in `data`. Raises ValueError: as `load_object`, and for a single value."""
    # The length before the parser, which would make memory of it.
    if len(data) > max_bytes:
        raise ValueError(f"{where}: {what} has {len(data)} bytes; expected at most {max_bytes}")
    try:
        document = json.loads(data if isinstance(data, str) else bytes(data), parse_constant=_no_constant)
    except UnicodeDecodeError:
        raise ValueError(f"{where}: {what} is not JSON (not UTF-8 text)") from None
    except ValueError as error:
        raise ValueError(f"{where}: {what} is not JSON ({' '.join(str(error).split())[:80]})") from None
    except RecursionError:
        raise _too_deep(where, what) from None
    if not isinstance(document, dict | list):
        raise ValueError(f"{where}: expected an object as {what}, found {type(document).__name__}")
    _check_values(document, where, what)
    return document


def object_at(item: dict[str, Any], key: str, where: Path | str) -> dict[str, Any]:
    """item[key] where it is an object, {} where there is none. Raises ValueError where it is something else."""
    value = item.get(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object as {key!r}, found {brief(value)}")
    return value


def objects_at(item: dict[str, Any], key: str, where: Path | str) -> list[dict[str, Any]]:
    """item[key] where it is a list of objects, [] where there is none. Raises ValueError otherwise."""
    # A missing list is an empty one; one of another kind is somebody's mistake.
    value = item.get(key, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError(f"{where}: expected a list of objects as {key!r}, found {brief(value)}")
    return value


def integer(value: Any, where: Path | str, what: str, least: int = 0) -> int:
    """`value` where it is an integer from `least` (0 or 1) to MAX_INTEGER. Raises ValueError otherwise."""
    if type(value) is not int or not least <= value <= MAX_INTEGER:
        kind = "a positive" if least else "a non-negative"
        raise ValueError(f"{where}: expected {kind} integer for {what}, found {brief(value)}")
    return value


def finite_numbers(value: Any, where: Path | str, what: str) -> np.ndarray:
    """[n] float64 of a list of finite numbers. Raises ValueError where it is anything else."""
    good = isinstance(value, list) and all(type(entry) in (int, float) for entry in value)
    try:
        array = np.array(value if good else [], np.float64)
    except OverflowError:  # an integer beyond 1.8e308
        good, array = False, np.zeros(0)
    if not good or not np.isfinite(array).all():
        # Of a list the entry that is no number: how many there are tells nobody what to mend.
        wrong = next((one for one in value if not _is_finite(one)), value) if isinstance(value, list) else value
        raise ValueError(f"{where}: expected finite numbers for {what}, found {brief(wrong)}")
    return array


def _is_finite(value: Any) -> bool:
    try:
        return type(value) in (int, float) and math.isfinite(value)
    except OverflowError:  # an integer beyond 1.8e308
        return False


def brief(value: Any) -> str:
    """A JSON value for an error: its kind where it is a list or object, else its first characters."""
    if isinstance(value, dict | list):
        kind = "an object" if isinstance(value, dict) else "a list"
        return f"{kind} of {len(value)}"
    if type(value) is int and abs(value) > MAX_INTEGER:  # str() refuses integers of thousands of digits
        return f"an integer of {value.bit_length()} bits"
    return ascii(value)[:40]


def build(
    kind: type[_Dataclass],
    values: Any,
    where: Path | str,
    *,
    what: str = "",
    base: _Dataclass | None = None,
    defaults: bool = False,
    older: Mapping[str, Any] | None = None,
    aliases: Mapping[str, str] | None = None,
) -> _Dataclass:
    """The dataclass `kind` from the object that `dataclasses.asdict` and JSON made of one.

    Fields may be numbers, text, truth values, Path, Literal, dataclasses, and tuples, dicts and `| None` of these.
    Numbers have to be finite, integers without a fraction, and a truth value is no number.

    where: names the file or option in errors; what: the object itself where it is none, say "a recipe".
    base: gives the values of missing keys, those of nested dataclasses, too; dataclasses in lists take their defaults.
        Without it every key has to be there, but for
    defaults: all that have a default take it, and for those of
    older: dotted path of a key that older files lack -> its JSON value there.
    aliases: dotted path of a key as older files spell it -> its present name ("refine.width" -> "dim"), or path and
        value of a Literal -> its present value ("refine.mixer=fast" -> "ttt"; the path as it is now).
    Raises FieldError (a ValueError) naming `where` and the path of what is unknown, missing, of the wrong kind or
    refused by `kind`.
    """
    builder = _Builder(str(where), what or "the document", older or {}, aliases or {}, defaults or base is not None)
    return builder.build(kind, values, "", base)


@cache
def field_types(kind: type) -> dict[str, Any]:
    """Field name -> type of a dataclass."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def plain(instance: Any) -> dict[str, Any]:
    """A dataclass as values of JSON: what `build` reads. Paths become text."""
    return json.loads(json.dumps(dataclasses.asdict(instance), default=os.fspath))


@dataclasses.dataclass(frozen=True)
class _Builder:
    where: str
    what: str
    older: Mapping[str, Any]
    aliases: Mapping[str, str]
    defaults: bool
    """Whether missing keys take the dataclass's defaults where there is no base."""

    def build(self, kind: type, values: Any, path: str, base: Any = None) -> Any:
        if not isinstance(values, Mapping):
            raise self._wrong("an object", path, values)
        # Keys of the file first: unknown ones are refused, as a misspelt option would else be ignored in silence.
        types_of_fields, prefix = field_types(kind), f"{path}." if path else ""
        present: dict[str, Any] = {}
        for key, value in values.items():
            name = self.aliases.get(prefix + str(key), key)
            if name not in types_of_fields:
                reason = f"unknown key '{_line(prefix + str(key))}'; known there: {', '.join(types_of_fields)}"
                raise FieldError(self.where, prefix + str(key), reason)
            if name in present:
                raise FieldError(self.where, prefix + name, f"two values for '{prefix}{name}'")
            present[name] = value
        # Then keys that are not there: from the base, from what older files meant, or from the default.
        for field in dataclasses.fields(kind):
            if field.name in present or base is not None:
                continue
            if prefix + field.name in self.older:
                present[field.name] = self.older[prefix + field.name]
            elif not self.defaults or field.default is field.default_factory is dataclasses.MISSING:
                raise FieldError(self.where, path, f"missing key '{prefix}{field.name}'")
        fields = {
            name: self.value(types_of_fields[name], value, prefix + name, getattr(base, name, None))
            for name, value in present.items()
        }
        # The dataclass judges its own values; its complaint gets the place in the file.
        try:
            return kind(**fields) if base is None else dataclasses.replace(base, **fields)
        except ValueError as error:
            raise FieldError(self.where, path, f"{path + ': ' if path else ''}{error}") from None

    def value(self, hint: Any, value: Any, path: str, base: Any = None) -> Any:
        """`value` from JSON as what the annotation `hint` says. base: the value to start from, of a dataclass."""
        # One case for each kind of annotation that a document may hold.
        origin, arguments = get_origin(hint), get_args(hint)
        if hint is Any:
            return value
        # Containers go down into their parts, so that an error can name its whole path.
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            return self.build(hint, value, path, base)
        if origin is tuple:
            if not isinstance(value, list | tuple):
                raise self._wrong("a list", path, value)
            if len(arguments) == 2 and arguments[1] is ...:
                arguments = (arguments[0],) * len(value)
            elif len(arguments) != len(value):
                raise self._wrong(f"{len(arguments)} values", path, value)
            items = enumerate(zip(arguments, value, strict=True))
            return tuple(self.value(part, item, f"{path}[{i}]") for i, (part, item) in items)
        # A Literal may have been spelt otherwise by older files.
        if origin is Literal:
            if isinstance(value, str):
                value = self.aliases.get(f"{path}={value}", value)
            # 1 == True == 1.0, but only one of them is what the annotation says.
            if not any(value == choice and type(value) is type(choice) for choice in arguments):
                raise self._wrong(f"one of {', '.join(map(str, arguments))}", path, value)
            return value
        if origin is dict:
            if not isinstance(value, Mapping):
                raise self._wrong("an object", path, value)
            return {str(key): self.value(arguments[1], item, f"{path}.{key}") for key, item in value.items()}
        # Of unions only `| None` is read: of others a value would not say which it is.
        if origin in (Union, types.UnionType):
            (part,) = (argument for argument in arguments if argument is not type(None))
            return None if value is None else self.value(part, value, path, base)
        if hint is Path:
            if not isinstance(value, str | Path):
                raise self._wrong("a path", path, value)
            return Path(value)
        # bool is an int to Python, and a config that says layers: true is broken.
        if hint is int and isinstance(value, numbers.Integral) and not isinstance(value, bool):
            return int(value)
        if hint is float and isinstance(value, numbers.Real) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:  # an integer beyond 1.8e308
                number = math.inf
            if math.isfinite(number):
                return number
            raise self._wrong("a finite number", path, value)
        assert hint in (int, float, str, bool), f"{path}: fields of type {hint} are not read from JSON"
        if hint in (int, float) or not isinstance(value, hint):
            raise self._wrong(hint.__name__, path, value)
        return value

    def _wrong(self, expected: str, path: str, value: Any) -> FieldError:
        name = f"'{_line(path)}'" if path else self.what
        return FieldError(self.where, path, f"expected {expected} as {name}, got {brief(value)}")


def _line(text: str) -> str:
    """A key of a file for an error: in one line, and not longer than one."""
    return "".join(c if c.isprintable() else "?" for c in text[:100])


def _check_values(document: dict[str, Any] | list[Any], where: Path | str, what: str) -> None:
    # Level by level, in a loop of its own: recursion into a hostile document would end in a crash.
    level: list[Any] = [document]
    for _ in range(MAX_JSON_DEPTH):
        deeper: list[Any] = []
        for holder in level:
            values = holder.values() if type(holder) is dict else holder
            if math.inf in values or -math.inf in values:
                raise ValueError(f"{where}: {what} holds a number beyond 1.8e308")
            deeper += [child for child in values if type(child) is dict or type(child) is list]
        if not deeper:
            return
        level = deeper
    raise _too_deep(where, what)


def _too_deep(where: Path | str, what: str) -> ValueError:
    return ValueError(f"{where}: {what} is nested deeper than {MAX_JSON_DEPTH} lists and objects")


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a JSON number")
