"""A small cache of what was used last: the one LRU of the package, beside functools.lru_cache for plain functions."""

from __future__ import annotations

from collections import OrderedDict
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
        self.items: OrderedDict[Any, _Item] = OrderedDict()

    def get(self, key: Any, make: Callable[[], _Item]) -> _Item:
        """The item of the key, made now if it is not there."""
        item = self.find(key, _MISSING)
        return self.put(key, make()) if item is _MISSING else item

    def find(self, key: Any, default: Any = None) -> Any:
        """The item of the key, which is then the latest; `default` where there is none."""
        item = self.items.pop(key, _MISSING)
        if item is _MISSING:
            return default
        self.items[key] = item  # type: ignore[assignment]
        return item

    def put(self, key: Any, item: _Item) -> _Item:
        """Hold an item as the latest, in place of the one that the key may have; those used least recently go."""
        self.items.pop(key, None)
        self.items[key] = item
        while len(self.items) > self.least and self._is_full():
            self.items.popitem(last=False)
        return item

    def forget(self, gone: Callable[[_Item], bool]) -> None:
        """Drop items of which this is true."""
        for key in [key for key, item in [*self.items.items()] if gone(item)]:
            self.items.pop(key, None)

    def clear(self) -> None:
        self.items.clear()

    def values(self) -> Iterator[_Item]:
        """The items, the latest last."""
        return iter([*self.items.values()])

    def __contains__(self, key: Any) -> bool:
        return key in self.items

    def _is_full(self) -> bool:
        if self.most is not None and len(self.items) > self.most:
            return True
        return sum(map(self.size, self.values())) > self.capacity
