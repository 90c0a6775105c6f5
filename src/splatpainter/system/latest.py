"""The latest few of what somebody noted, for whoever asks whether what they need is among it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

_Item = TypeVar("_Item")


class Latest(Generic[_Item]):
    """Threads may share it: who looks meanwhile sees what was there before. A deque would end their loop with an error
    where another thread notes something, with a GIL at every line between its items and without one anywhere."""

    def __init__(self, most: int) -> None:
        """most: items that are held; at least 1."""
        self.most = most
        self.items: tuple[_Item, ...] = ()
        """The latest last."""

    def note(self, item: _Item) -> None:
        """Hold an item as the latest; the oldest goes where there are too many. Of two that are noted in the same
        moment one may be lost."""
        # One store and no lock: what ends with the oldest may note something itself, and a fork may come at any line.
        self.items = (*self.items, item)[-self.most :]

    def clear(self) -> None:
        self.items = ()

    def __iter__(self) -> Iterator[_Item]:
        """The items of this moment, the latest first."""
        return reversed(self.items)
