"""In which order several workers find tests, so that none of them waits for another's last."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest


def in_runs(items: Sequence[pytest.Item], workers: int) -> list[pytest.Item]:
    """xdist's workers start with equal runs of the tests, and take from the ends of each other's runs when theirs is
    over. Half of the runs start with the tests in a browser: these take longest and wait most, and the other half of
    the workers keeps the cores busy meanwhile. All runs end with short tests."""
    runs: list[list[pytest.Item]] = [[] for _ in range(workers)]
    in_browser: dict[Path, list[pytest.Item]] = {}
    rest: list[pytest.Item] = []
    for item in items:
        drives = "browser" in getattr(item, "fixturenames", ())
        (in_browser.setdefault(item.path, []) if drives else rest).append(item)
    for tests in in_browser.values():  # one after the other: a browser that starts is 2 s of CPU time
        min(runs[: max(workers // 2, 1)], key=_weight).extend(tests)
    rest.sort(key=lambda test: test.get_closest_marker("slow") is None)
    out: list[pytest.Item] = []
    for left, run in zip(range(workers, 0, -1), reversed(runs), strict=True):
        count = max((len(rest) + sum(map(len, runs[:left]))) // left - len(run), 0)
        out += run + rest[:count]
        del rest[:count]
    return out + rest


def _weight(tests: list[pytest.Item]) -> int:
    """About how long tests in a browser take."""
    return sum(4 if test.get_closest_marker("slow") else 1 for test in tests)
