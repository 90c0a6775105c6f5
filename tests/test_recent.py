"""The one LRU: what was used last stays, by number, by size, and in any case."""

from __future__ import annotations

from splatpainter.system.recent import Recent
from tests.support.threads import at_once


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


def test_what_is_held_is_found_by_all_threads_at_once() -> None:
    """Also while another one has just found it, which moves it to the end."""
    recent: Recent[str] = Recent(4)
    for key in "abcd":
        recent.put(key, key)

    def find(thread: int) -> None:
        for k in range(20_000):
            assert recent.find("abcd"[k % 4]) == "abcd"[k % 4]

    at_once(find, 3)


def test_threads_that_put_at_once_leave_as_many_as_there_is_room_for() -> None:
    recent: Recent[int] = Recent(2, least=2)

    def put(thread: int) -> None:
        for k in range(10_000 * thread, 10_000 * (thread + 1)):
            assert recent.put(k % 7, k) == k
            assert len([*recent.values()]) in (1, 2)

    at_once(put, 3)
    assert len(recent.items) == 2
