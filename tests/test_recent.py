"""The one LRU: what was used last stays, by number, by size, and in any case."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

import pytest

from splatpainter.system.recent import Recent


def held(recent: Recent) -> list:
    return list(recent.items)


def test_what_was_used_last_stays() -> None:
    recent: Recent[str] = Recent(2)
    made: list[str] = []

    def make(name: str) -> str:
        made.append(name)
        return name.upper()

    for name in ("a", "b", "a", "c", "a", "b"):
        assert recent.get(name, lambda name=name: make(name)) == name.upper()
    assert made == ["a", "b", "c", "b"] and held(recent) == ["a", "b"]
    assert recent.find("a") == "A" and held(recent) == ["b", "a"] and recent.find("c") is None
    recent.put("b", "new")
    assert held(recent) == ["a", "b"] and "b" in recent and [*recent.values()] == ["A", "new"]
    recent.forget(lambda item: item == "A")
    assert held(recent) == ["b"]


def test_sizes_count_and_none_is_an_item() -> None:
    recent: Recent[bytes] = Recent(5, len, least=2, most=3)
    for k, size in enumerate((1, 1, 1, 1)):
        recent.put(k, bytes(size))
    assert held(recent) == [1, 2, 3]  # no more than `most`
    recent.put(4, bytes(100))
    assert held(recent) == [3, 4]  # `least`, whatever their size
    empty: Recent[None] = Recent(1)
    assert empty.get("a", lambda: None) is None and "a" in empty
    assert empty.get("a", lambda: 1 / 0) is None  # type: ignore[arg-type, return-value]


@pytest.fixture
def quick_switches():
    """Threads take turns a thousand times as often, where they do not run at once anyway."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(before)


def at_once(*work: Callable[[], None]) -> None:
    """Runs all of these on threads that begin together; raises what one of them raised."""
    errors: list[BaseException] = []
    ready = threading.Barrier(len(work))

    def run(function: Callable[[], None]) -> None:
        ready.wait()
        try:
            function()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(function,)) for function in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for error in errors:
        raise error


@pytest.mark.usefixtures("quick_switches")
def test_what_is_held_is_found_by_all_threads_at_once() -> None:
    """Also while another one has just found it, which moves it to the end."""
    recent: Recent[str] = Recent(4)
    for key in "abcd":
        recent.put(key, key)

    def find() -> None:
        for k in range(20_000):
            assert recent.find("abcd"[k % 4]) == "abcd"[k % 4]

    at_once(find, find, find)


@pytest.mark.usefixtures("quick_switches")
def test_threads_that_put_at_once_leave_as_many_as_there_is_room_for() -> None:
    recent: Recent[int] = Recent(2, least=2)

    def put(first: int) -> None:
        for k in range(first, first + 10_000):
            assert recent.put(k % 7, k) == k
            assert len([*recent.values()]) in (1, 2)

    at_once(*(lambda n=n: put(n) for n in (0, 10_000, 20_000)))
    assert len(recent.items) == 2
