"""JSON from files that nobody vouches for: parsed within limits, and values fetched by their expected shape.

The meta.json of SOG and the JSON chunk of glTF are read through this; a value of another kind is a ValueError in one
line, never a TypeError or an AttributeError further on.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

MAX_JSON_BYTES = 16 << 20
"""Bytes of JSON text that are parsed. Parsed, small objects take 25 to 40 times their text in memory."""
MAX_JSON_DEPTH = 64
"""Lists and objects inside each other; glTF and SOG need fewer than 20."""
MAX_INTEGER = 2**53 - 1
"""The largest integer that every JSON reader holds exactly."""


def load_object(data: bytes | memoryview, where: Path | str, what: str) -> dict[str, Any]:
    """The JSON object in `data`. what: its name for errors.

    Raises ValueError: longer than MAX_JSON_BYTES, not UTF-8 JSON, nested deeper than MAX_JSON_DEPTH, not an object, or
    numbers beyond the range of a double.
    """
    if len(data) > MAX_JSON_BYTES:
        raise ValueError(f"{where}: {what} has {len(data)} bytes; expected at most {MAX_JSON_BYTES}")
    try:
        document = json.loads(bytes(data), parse_constant=_no_constant)
    except UnicodeDecodeError:
        raise ValueError(f"{where}: {what} is not JSON (not UTF-8 text)") from None
    except ValueError as error:
        raise ValueError(f"{where}: {what} is not JSON ({' '.join(str(error).split())[:80]})") from None
    except RecursionError:
        raise _too_deep(where, what) from None
    if not isinstance(document, dict):
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


def numbers(value: Any, where: Path | str, what: str) -> np.ndarray:
    """[n] float64 of a list of finite numbers. Raises ValueError where it is anything else."""
    good = isinstance(value, list) and all(type(entry) in (int, float) for entry in value)
    try:
        array = np.array(value if good else [], np.float64)
    except OverflowError:  # an integer beyond 1.8e308
        good, array = False, np.zeros(0)
    if not good or not np.isfinite(array).all():
        raise ValueError(f"{where}: expected finite numbers for {what}, found {brief(value)}")
    return array


def brief(value: Any) -> str:
    """A JSON value for an error: its kind where it is a list or object, else its first characters."""
    if isinstance(value, dict | list):
        kind = "an object" if isinstance(value, dict) else "a list"
        return f"{kind} of {len(value)}"
    if type(value) is int and abs(value) > MAX_INTEGER:  # str() refuses integers of thousands of digits
        return f"an integer of {value.bit_length()} bits"
    return ascii(value)[:40]


def _check_values(document: dict[str, Any], where: Path | str, what: str) -> None:
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
