"""What a viewer that knows an older version of the asset has to be told: only rows that changed or came."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from splatpainter.receipts import changed_rows
from splatpainter.session.deltas import bare
from splatpainter.splats import Splats

REMEMBERED = 256
"""Versions back from which a sparse answer is possible, at most; older ones get everything."""
MOST_ROWS = 1 << 24
"""Rows that all of them may name together: global edits of a large asset are forgotten sooner."""
GEOMETRY = ("means", "quats", "scales")


@dataclass(frozen=True)
class AssetDelta:
    """The way from one version of the shown asset to the present one: keep the first `kept` rows (those beyond are
    gone), overwrite `rows` with `values`, add `appended` at the end."""

    since: int | None
    """The version that it starts from; None: everything is sent, `kept` is 0."""
    version: int
    kept: int
    rows: np.ndarray = field(repr=False)
    """[T] int64 ascending, all below `kept`."""
    values: Splats = field(repr=False)
    """T rows."""
    appended: Splats = field(repr=False)
    """A rows, which become rows kept, kept + 1, ..."""
    recolored: bool = False
    """Whether means, scales and rotations of all rows are as they were."""


class Changes:
    """The rows that each of the latest versions changed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._steps: deque[tuple[int, int, np.ndarray, bool]] = deque(maxlen=REMEMBERED)

    def note(self, version: int, before: Splats, after: Splats) -> None:
        """`after` is what `version` shows, `before` what the one before it showed."""
        rows = changed_rows(before, after).astype(np.int32)
        recolored = all(getattr(before, name) is getattr(after, name) for name in GEOMETRY)
        step = (version, min(len(before), len(after)), rows, recolored)
        with self._lock:
            self._steps.append(step)
            while len(self._steps) > 1 and sum(len(step[2]) for step in self._steps) > MOST_ROWS:
                self._steps.popleft()

    def since(self, version: int | None, now: int, splats: Splats) -> AssetDelta:
        """From a version (None or unknown: from nothing) to the present one, `now`, which shows `splats`."""
        with self._lock:
            steps = [] if version is None else [step for step in self._steps if version < step[0] <= now]
        if version is None or version > now or len(steps) != now - version:
            version, kept, rows = None, 0, np.zeros(0, np.int64)
        else:
            kept = min([len(splats), *(step[1] for step in steps)])
            rows = np.unique(np.concatenate([np.zeros(0, np.int64), *(step[2] for step in steps)])).astype(np.int64)
            rows = rows[rows < kept]
        tail = np.arange(kept, len(splats))
        recolored = version is not None and all(step[3] for step in steps)
        return AssetDelta(version, now, kept, rows, bare(splats.take(rows)), bare(splats.take(tail)), recolored)
