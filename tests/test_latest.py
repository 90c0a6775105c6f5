"""The latest few: as many as there is room for, the latest first, for loops of several threads."""

from __future__ import annotations

from splatpainter.system.latest import Latest
from tests.support.threads import at_once


def test_the_latest_come_first_and_the_oldest_go() -> None:
    latest = Latest[str](3)
    assert list(latest) == []
    for item in "abcd":
        latest.note(item)
    assert list(latest) == ["d", "c", "b"] and latest.items == ("b", "c", "d")
    latest.clear()
    assert list(latest) == []


def test_what_is_noted_during_a_loop_is_in_the_next_one() -> None:
    latest = Latest[int](4)
    latest.note(0)
    latest.note(1)
    seen = []
    for item in latest:
        seen.append(item)
        latest.note(10 + item)
    assert seen == [1, 0] and list(latest) == [10, 11, 1, 0]


def test_threads_note_and_look_at_once() -> None:
    """A deque's loop ends here with "mutated during iteration" where there is no GIL."""
    latest = Latest[tuple[int, int]](8)

    def work(thread: int) -> None:
        for k in range(5_000):
            latest.note((thread, k))
            assert 1 <= len(list(latest)) <= 8

    at_once(work, 4)
