"""Ranges of numbers, stated where a dataclass declares them: everything that takes its values from people (command
lines, JSON, messages of a page, nodes of other programs) holds to these, and none states them again."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import MISSING, field
from typing import Any

BOUNDS = ("ge", "gt", "le", "lt")
"""Keys of a field's metadata: least value, or what it is above; largest value, or what it is below."""


def ranged(default: Any = MISSING, **bounds: float) -> Any:
    """A field of a dataclass with bounds (BOUNDS), also of every number in a tuple; max_length: how many parts a
    message may hold of it."""
    return field(default=default, metadata=bounds)


def same_range(kind: type, name: str, default: Any) -> Any:
    """A field with the bounds that a field of another dataclass states, and a default of its own."""
    (entry,) = (entry for entry in dataclasses.fields(kind) if entry.name == name)
    return field(default=default, metadata=bounds_of(entry))


def bounds_of(entry: dataclasses.Field) -> dict[str, Any]:
    """The bounds that a field states."""
    return {word: entry.metadata[word] for word in BOUNDS if entry.metadata.get(word) is not None}


def out_of_range(instance: Any, name: Callable[[str], str] = str) -> str | None:
    """What is wrong with the first field of a dataclass that is beyond its bounds, "expected exposure from -10 to 10,
    got 12"; None where all keep to them. name: field -> what it is called there."""
    for entry in dataclasses.fields(instance):
        bounds = bounds_of(entry)
        for value in _numbers(getattr(instance, entry.name)) if bounds else ():
            if not _keeps(value, bounds):
                return f"expected {name(entry.name)} {in_words(bounds)}, got {value}"
    return None


def in_words(bounds: dict[str, float]) -> str:
    """The bounds as a part of a sentence: "from 0 to 1", "above 0, up to 180"."""
    low = (
        f"from {_plain(bounds['ge'])}" if "ge" in bounds else f"above {_plain(bounds['gt'])}" if "gt" in bounds else ""
    )
    if "le" in bounds:
        return (
            f"{low} to {_plain(bounds['le'])}" if "ge" in bounds else f"{low}, up to {_plain(bounds['le'])}".strip(", ")
        )
    high = f"below {_plain(bounds['lt'])}" if "lt" in bounds else ""
    return ", ".join(filter(None, [low, high])) + (" on" if "ge" in bounds and not high else "")


def _plain(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


def _keeps(value: float, bounds: dict[str, float]) -> bool:
    # Written so that NaN, which no comparison is true of, keeps to no bounds.
    return (
        value >= bounds.get("ge", -math.inf)
        and value <= bounds.get("le", math.inf)
        and ("gt" not in bounds or value > bounds["gt"])
        and ("lt" not in bounds or value < bounds["lt"])
    )


def _numbers(value: Any) -> Iterator[float]:
    """The numbers in a value; None, words and other objects have none."""
    if isinstance(value, tuple | list):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, int | float):
        yield value
