"""Small pictures to be edited, and a way to wait for their editing."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.sources.picture_source import PictureRequest

HEIGHT, WIDTH = 24, 32


def request(
    prompt: str = "",
    mask: bool = False,
    seed: int | None = None,
    references: int = 0,
    scale: int = 1,
    maps: bool = False,
) -> PictureRequest:
    """A gradient of 32 x 24 pixels; the mask is its right half."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    image = np.stack([x / WIDTH, y / HEIGHT, np.full_like(x, 0.25)], -1)
    half = (x >= WIDTH / 2).astype(np.float32) if mask else None
    camera = look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=WIDTH, height=HEIGHT)
    depth = np.where(x > 4, 2 + y / HEIGHT, 0).astype(np.float32)
    normal = np.where(x[..., None] > 4, np.array([0, 0, -1], np.float32), 0)
    return PictureRequest(
        image,
        np.ones((HEIGHT, WIDTH), np.float32),
        half,
        prompt,
        tuple(np.full((8, 8, 3), 0.1 * index, np.float32) for index in range(references)),
        seed,
        scale,
        camera,
        (lambda: depth) if maps else None,
        (lambda: normal) if maps else None,
    )


class Progressed:
    """Collects progress; sets `cancel` once `cancel_at` appears in the words."""

    def __init__(self, cancel_at: str | None = None) -> None:
        self.cancel = threading.Event()
        self.reports: list[tuple[float, str]] = []
        self._cancel_at = cancel_at

    def __call__(self, share: float, words: str) -> None:
        self.reports.append((share, words))
        if self._cancel_at is not None and self._cancel_at in words:
            self.cancel.set()


class HastyClock:
    """Stands in for the module `time` of a source: once `words` are reported, an hour has passed."""

    def __init__(self, words: str) -> None:
        self._words, self._ahead = words, 0.0
        self.time, self.sleep = time.time, time.sleep

    def monotonic(self) -> float:
        return time.monotonic() + self._ahead

    def progress(self) -> Progressed:
        """Progress that this clock listens to."""
        clock = self

        class Listening(Progressed):
            def __call__(self, share: float, words: str) -> None:
                super().__call__(share, words)
                if clock._words in words:
                    clock._ahead = 3600.0

        return Listening()


def script(folder: Path, body: str, name: str = "tool.py") -> Path:
    """A Python program in a file."""
    path = folder / name
    path.write_text(body, encoding="utf-8")
    return path
