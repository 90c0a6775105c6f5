"""The one LRU: what was used last stays, by number, by size, and in any case."""

from __future__ import annotations

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
