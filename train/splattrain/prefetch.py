"""Samples made ahead by other processes, in the very order and with the very values as without them.

The order is known for ever, so each worker is told numbers ahead of time; samples of one object go to one worker, which
then makes the object once. Used where a GPU would wait for the data. (torch's DataLoader gives whole batches to its
workers in turn: to stay with an object, it would hand over all samples of one at once, for every lane of a batch.)
"""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
import queue
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from splattrain.data.samples import Sample

ALIVE_CHECK_SECONDS = 5.0
"""Seconds between looks at whether a worker is still alive."""
VIEW_SETS = ("base", "edited", "novel_before", "novel_after")


class PrefetchedSamples:
    """Numbered samples from `count` processes."""

    def __init__(self, make: Callable[[], Any], count: int, samples_per_object: int) -> None:
        """make: the stream; called once in each worker, so it must be importable from there;
        samples_per_object: consecutive numbers that share an object."""
        context = multiprocessing.get_context("spawn")  # fork would copy torch's threads half
        self._samples_per_object, self._window = samples_per_object, (count + 1) * samples_per_object
        self._upcoming: Iterator[int] = iter(())
        self._pending: list[int] = []
        self._ready: dict[int, Any] = {}
        self._tasks = [context.Queue() for _ in range(count)]
        self._results = [context.Queue() for _ in range(count)]
        self._workers = [
            context.Process(target=_work, args=(make, tasks, results), daemon=True)
            for tasks, results in zip(self._tasks, self._results, strict=True)
        ]
        for worker in self._workers:
            worker.start()

    def expect(self, numbers: Iterable[int]) -> None:
        """The order in which samples will be asked for."""
        self._upcoming = iter(numbers)

    def __getitem__(self, number: int) -> Sample:
        """Raises ValueError where the stream does; RuntimeError when a worker has died."""
        self._fill()
        if number not in self._pending and number not in self._ready:  # not the order that was announced
            self._send(number)
        while number not in self._ready:
            self._receive(self._worker(number))
        result = self._ready.pop(number)
        self._fill()
        if isinstance(result, str):
            raise ValueError(result)
        return unpacked(result)

    def close(self) -> None:
        """End the workers."""
        for worker in self._workers:
            worker.terminate()
        for worker in self._workers:
            worker.join()

    def _fill(self) -> None:
        free = self._window - len(self._pending) - len(self._ready)
        for number in itertools.islice(self._upcoming, max(free, 0)):
            self._send(number)

    def _send(self, number: int) -> None:
        self._pending.append(number)
        self._tasks[self._worker(number)].put(number)

    def _worker(self, number: int) -> int:
        return number // self._samples_per_object % len(self._workers)

    def _receive(self, worker: int) -> None:
        try:
            number, result = self._results[worker].get(timeout=ALIVE_CHECK_SECONDS)
        except queue.Empty:
            if not self._workers[worker].is_alive():
                raise RuntimeError(f"data worker {worker} died; train with --workers 0 to see why") from None
            return
        self._pending.remove(number)
        self._ready[number] = result


def packed(sample: Sample) -> Sample:
    """The sample with numpy pictures: tensors would travel as file handles, of which a process has few."""
    return _with_colors(sample, lambda colors: torch.as_tensor(colors).cpu().numpy())


def unpacked(sample: Sample) -> Sample:
    """The inverse of `packed`."""
    return _with_colors(sample, lambda colors: torch.from_numpy(np.asarray(colors)))


def _with_colors(sample: Sample, change: Callable[[Any], Any]) -> Sample:
    views = {name: getattr(sample, name) for name in VIEW_SETS}
    return dataclasses.replace(
        sample, **{name: dataclasses.replace(v, colors=change(v.colors)) for name, v in views.items()}
    )


def _work(make: Callable[[], Any], tasks: Any, results: Any) -> None:
    torch.set_num_threads(1)
    stream = make()
    while True:
        number = tasks.get()
        try:
            result: Any = packed(stream[number])
        except ValueError as error:
            result = str(error)
        results.put((number, result))
