"""Quality against time of methods that take steps: the asset as it was after 10, 30, 100, 300, ... of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from splatpainter.splats import Splats


def is_point(step: int) -> bool:
    """Whether a step is one of 10, 30, 100, 300, 1000, ..."""
    while step >= 100 and step % 10 == 0:
        step //= 10
    return step in (10, 30)


@dataclass
class Curve:
    """Collects points while a method runs: pass `watch` to fit.optimize. Taking a point is not counted as time."""

    wanted: bool
    """False: collects nothing."""
    start: float = field(default_factory=time.perf_counter)
    """Of the edit."""
    spent: float = 0.0
    """Seconds that taking points took."""
    points: list[tuple[float, int, Splats]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Since the start, without the points."""
        return time.perf_counter() - self.start - self.spent

    @property
    def watch(self) -> Callable[[int, Callable[[], Splats]], None] | None:
        """To be called after every step, counted from 1."""
        return self._see if self.wanted else None

    def _see(self, step: int, current: Callable[[], Splats]) -> None:
        if not is_point(step):
            return
        seconds, now = self.seconds, time.perf_counter()
        self.points.append((seconds, step, current()))
        self.spent += time.perf_counter() - now
