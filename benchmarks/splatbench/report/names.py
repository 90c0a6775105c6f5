"""What methods are called in a report, in which order they stand, and which mark is theirs everywhere in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol


class Named(Protocol):
    """What a report needs of a method (methods.Method has it)."""

    @property
    def label(self) -> str: ...
    @property
    def oracle(self) -> bool: ...


class Layout(Protocol):
    """What a report needs of a protocol (protocols.Table has it)."""

    @property
    def title(self) -> str: ...
    @property
    def columns(self) -> tuple: ...
    @property
    def split_by(self) -> str: ...


@dataclass(frozen=True)
class Names:
    """The methods of one report."""

    order: tuple[str, ...]
    """Names of methods that occur in it, in the order of the tables."""
    labels: dict[str, str]
    unmarked: frozenset[str]
    """Upper bounds, and the row in which nothing is done: never marked as a table's best."""

    @staticmethod
    def of(methods: Mapping[str, Named], found: Iterable[str]) -> Names:
        """methods: all that are known, in order. found: names that occur; unknown ones come last, by name, and are
        called by their name."""
        found = set(found)
        order = (*(name for name in methods if name in found), *sorted(found - set(methods)))
        labels = {name: methods[name].label if name in methods else name for name in order}
        oracles = {name for name in order if name in methods and methods[name].oracle}
        return Names(order, labels, frozenset(oracles | {"nothing"}))

    def style(self, name: str) -> int:
        """Number of its colour and shape."""
        return self.order.index(name)
