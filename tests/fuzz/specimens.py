"""Faults on purpose: each target has one input (seed 3) at which something goes wrong; the supervisor must notice."""

from __future__ import annotations

import os
import random
import time
import warnings
from functools import partial
from pathlib import Path

from .target import Target, Verdict

BAD_SEED = 3


class SpecimenTarget(Target):
    """Well but for one input."""

    memory_limit = 100 << 20
    seconds_limit = 0.25

    def __init__(self, folder: Path, kind: str) -> None:
        super().__init__(folder)
        self.name = self.kind = kind
        self._bad = random.Random(f"{kind}/{BAD_SEED}").random()

    def make(self, rng: random.Random) -> dict[str, bytes]:
        return {"chance": str(rng.random()).encode()}

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        if float(files["chance"]) == self._bad:
            self._fail()
        return Verdict(opened=1)

    def _fail(self) -> None:
        if self.kind == "raises":
            raise IndexError("string index out of range")
        if self.kind == "warns":
            warnings.warn("overflow encountered in exp", RuntimeWarning, stacklevel=1)
        if self.kind == "dies":
            os.abort()
        if self.kind == "hangs":
            time.sleep(600)
        if self.kind == "swells":
            assert bytearray(2 * self.memory_limit)
        if self.kind == "late":
            start = time.process_time()
            while time.process_time() - start < 2 * self.seconds_limit:
                pass


TARGETS = {kind: partial(SpecimenTarget, kind=kind) for kind in ("raises", "warns", "dies", "hangs", "swells", "late")}
