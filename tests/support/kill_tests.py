"""Work for other processes that kills its own, for the tests of data/cluster.py; imported by the workers."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Work:
    """number -> its square; leaves a file per attempt."""

    folder: str
    dies_once: int = -1
    """The worker that does this number first is killed in the middle."""
    dies_always: int = -1
    fails: int = -1
    """This number raises ValueError."""
    hangs: int = -1
    """This number never ends."""

    def __call__(self, number: int) -> int:
        first = not list(Path(self.folder).glob(f"{number}.*"))
        (Path(self.folder) / f"{number}.{time.time_ns()}.{os.getpid()}").touch()
        if number == self.dies_always or (number == self.dies_once and first):
            os.kill(os.getpid(), 9)  # SIGKILL; on Windows TerminateProcess
        if number == self.hangs:
            time.sleep(600)
        if number == self.fails:
            raise ValueError(f"{number}: is unlucky")
        return number * number


class Killed:
    """`function` after `work`, which may kill the process. It is pickled apart: a worker that is killed before it loads
    nothing for it."""

    def __init__(self, work: Work, function: Callable[[int], Any]) -> None:
        self.work, self.function = work, pickle.dumps(function)

    def __call__(self, number: int) -> Any:
        self.work(number)
        return pickle.loads(self.function)(number)


def attempts(folder: Path, number: int) -> int:
    return len(list(folder.glob(f"{number}.*")))
