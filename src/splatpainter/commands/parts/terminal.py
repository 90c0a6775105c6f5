"""What reaches the terminal: one-line errors and warnings, progress bars, JSON. Knows no splats."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from splatpainter.system.plain_words import count as count
from splatpainter.system.plain_words import decibels as decibels
from splatpainter.system.plain_words import reason as reason
from splatpainter.system.plain_words import seconds as seconds
from splatpainter.system.plain_words import size as size

PROGRAM = "splatpainter"
BAR_DELAY_SECONDS = 1.0
"""Seconds before a progress bar appears."""
_Item = TypeVar("_Item")


def complain(text: str) -> None:
    """One line on stderr: `splatpainter: text`."""
    line = " ".join(str(text).split())
    print(
        line if line.startswith((f"{PROGRAM}: ", f"{PROGRAM} ")) else f"{PROGRAM}: {line}", file=sys.stderr, flush=True
    )


def warn(text: str) -> None:
    """One line on stderr about something that did not stop the command."""
    complain(f"warning: {text}")


def progress(items: Iterable[_Item], total: int, what: str) -> Iterator[_Item]:
    """`items`, with a bar on stderr once it has taken a second; only where a person is looking."""
    if not watched():
        yield from items
        return
    from tqdm import tqdm

    yield from tqdm(items, total=total, desc=what, delay=BAR_DELAY_SECONDS, leave=False, file=sys.stderr)


class Stages:
    """A bar over named stages, from a second on: `enter("lift")` before each; at the end `close()`."""

    def __init__(self, total: int) -> None:
        self._bar, self._timer, self._entered, self._start = None, None, 0, time.monotonic()
        if watched():
            from tqdm import tqdm

            form = "{desc:<10} {bar} {n_fmt}/{total_fmt} [{elapsed}]"
            self._bar = tqdm(total=total, delay=BAR_DELAY_SECONDS, leave=False, file=sys.stderr, bar_format=form)
            self._timer = threading.Timer(
                BAR_DELAY_SECONDS, self._bar.refresh
            )  # the second may end within a long stage
            self._timer.daemon = True
            self._timer.start()

    def enter(self, name: str) -> None:
        if self._bar is not None:
            self._bar.set_description_str(name, refresh=False)
            self._bar.n = self._entered
            if time.monotonic() - self._start > BAR_DELAY_SECONDS:
                self._bar.refresh()
        self._entered += 1

    def close(self) -> None:
        if self._bar is not None and self._timer is not None:
            self._timer.cancel()
            self._bar.close()


@contextlib.contextmanager
def stages(total: int) -> Iterator[Stages]:
    """Stages that are closed at the end, also by an error."""
    bar = Stages(total)
    try:
        yield bar
    finally:
        bar.close()


class SourceBar:
    """Progress of a source on stderr, where a person is looking."""

    def __init__(self) -> None:
        self._bar = None

    def __enter__(self) -> SourceBar:
        if watched():
            from tqdm import tqdm

            form = "{desc:<40} {bar} [{elapsed}]"
            self._bar = tqdm(total=1.0, leave=False, file=sys.stderr, bar_format=form)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, share: float, words: str) -> None:
        if self._bar is not None:
            self._bar.n = min(max(share, 0.0), 1.0)
            self._bar.set_description_str(words[:40])


def watched() -> bool:
    """Whether a person is looking at stderr."""
    return sys.stderr is not None and sys.stderr.isatty()


def to_json(record: Any) -> str:
    """Indented JSON. Infinities and NaN, which JSON does not know, become null."""
    return json.dumps(_plain(record), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (Path, os.PathLike)):
        return os.fspath(value)
    if hasattr(value, "tolist"):  # numpy numbers and arrays
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
