"""A small cache of what was used last."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, Generic, TypeVar

_Item = TypeVar("_Item")


class Recent(Generic[_Item]):
    """The items used last, by key; the newest one stays whatever its size."""

    def __init__(self, capacity: int, size: Callable[[_Item], int] = lambda item: 1) -> None:
        """capacity: sum of sizes, by default a number of items."""
        self.capacity, self.size, self.items = capacity, size, OrderedDict[Any, _Item]()

    def get(self, key: Any, make: Callable[[], _Item]) -> _Item:
        """The item of the key, made now if it is not there."""
        if key not in self.items:
            self.items[key] = make()
            while len(self.items) > 1 and sum(map(self.size, self.items.values())) > self.capacity:
                self.items.popitem(last=False)
        self.items.move_to_end(key)
        return self.items[key]
