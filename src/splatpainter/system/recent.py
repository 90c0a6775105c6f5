"""A small cache of what was used last: the one LRU of the package, beside functools.lru_cache for plain functions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

_Item = TypeVar("_Item")
_MISSING = object()


class Recent(Generic[_Item]):
    """The items used last, by key; the newest one stays whatever its size. Threads may share it: one that finds nothing
    while another one looks makes the item again."""

    def __init__(
        self,
        capacity: int,
        size: Callable[[_Item], int] = lambda item: 1,
        *,
        least: int = 1,
        most: int | None = None,
    ) -> None:
        """capacity: sum of sizes, by default a number of items; least, most: items that stay in any case, at all."""
        self.capacity, self.size, self.least, self.most = capacity, size, least, most
        self.items: dict[Any, _Item] = {}
        """The latest last."""
        # An item that is moved to the end is away for a moment: nobody may look then. Never held while one is made.
        self._lock = threading.Lock()

    def get(self, key: Any, make: Callable[[], _Item]) -> _Item:
        """The item of the key, made now if it is not there."""
        item = self.find(key, _MISSING)
        return self.put(key, make()) if item is _MISSING else item

    def find(self, key: Any, default: Any = None) -> Any:
        """The item of the key, which is then the latest; `default` where there is none."""
        with self._lock:
            item = self.items.pop(key, _MISSING)
            if item is _MISSING:
                return default
            self.items[key] = item  # type: ignore[assignment]
            return item

    def put(self, key: Any, item: _Item) -> _Item:
        """Hold an item as the latest, in place of the one that the key may have; those used least recently go."""
        gone = []  # what ends with them ends when the lock is free again
        with self._lock:
            gone.append(self.items.pop(key, None))
            self.items[key] = item
            while len(self.items) > self.least and self._is_full():
                gone.append(self.items.pop(next(iter(self.items))))
        return item

    def forget(self, gone: Callable[[_Item], bool]) -> None:
        """Drop items of which this is true."""
        with self._lock:
            dropped = [self.items.pop(key) for key, item in [*self.items.items()] if gone(item)]
        del dropped  # not before: what ends with them may look here

    def clear(self) -> None:
        with self._lock:
            dropped, self.items = self.items, {}
        del dropped

    def values(self) -> Iterator[_Item]:
        """The items, the latest last."""
        with self._lock:
            return iter([*self.items.values()])

    def __contains__(self, key: Any) -> bool:
        with self._lock:
            return key in self.items

    def _is_full(self) -> bool:
        if self.most is not None and len(self.items) > self.most:
            return True
        return sum(map(self.size, self.items.values())) > self.capacity
