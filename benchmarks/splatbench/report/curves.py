"""Quality on the way of methods that take steps (Record.curve), over cases. Knows no drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from splatbench.records import Record


@dataclass(frozen=True)
class Point:
    """What a method had after so many steps."""

    steps: float
    seconds: float
    """Median over cases."""
    mean: float
    """Of the figure, over cases."""


def points(records: Sequence[Record], method: str, key: str) -> list[Point]:
    """Of the figure `key`, at the step counts that all the method's cases with a curve have, in their order; steps at
    which a case lacks the figure are left out."""
    told = [{p["steps"]: p for p in r.curve} for r in records if r.method == method and r.whole and r.curve]
    if not told:
        return []
    found = []
    for steps in sorted(s for s in set.intersection(*(set(curve) for curve in told)) if s is not None):
        those = [curve[steps] for curve in told]
        seconds = [p["seconds"] for p in those if p["seconds"] is not None]
        values = [v for p in those if (v := p.get(key)) is not None and math.isfinite(v)]
        if len(values) == len(those) and seconds:
            found.append(Point(steps, median(seconds), float(np.mean(values))))
    return found


def best(found: Sequence[Point], better: str) -> Point | None:
    """The point with the best figure, the earliest of equals; None where there is none, or nothing is better."""
    if not found or not better:
        return None
    sign = 1.0 if better == "higher" else -1.0
    return max(found, key=lambda point: (sign * point.mean, -point.steps))
