"""Numbered work on other processes: a pool on this machine, or Ray on many. Knows no scenes and writes no files.

A worker that dies (killed, out of memory, crashed in native code) costs a retry of what it was doing; work whose worker
dies again and again comes back as `LostTask`, and the rest goes on. Exceptions of the work itself are raised here.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import sys
import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeAlias, TypeVar
from urllib.parse import urlsplit

from splatpainter.kernels.parallel import cpus
from splatpainter.system.quick_dataclass import dataclass

Result = TypeVar("Result")
RETRIES = 3
"""Retries of one piece of work, after its worker died."""
POLL_SECONDS = 0.1
"""Seconds between two looks at whether it was cancelled."""
CONNECT_SECONDS = 10.0
"""Seconds that a cluster has to take a connection."""
TASKS_PER_WORKER = 2
"""Pieces handed out per worker: one in work, one waiting, so that results do not pile up."""


@dataclass(frozen=True)
class LostTask:
    """Work that no worker survived."""

    reason: str


Results: TypeAlias = Generator[tuple[int, "Result | LostTask"]]
"""Closed by whoever stops before the end; what is in work then is ended."""


def run_here(work: Callable[[int], Result], numbers: Iterable[int]) -> Results[Result]:
    """(number, work(number)), one after another in this process."""
    for number in numbers:
        yield number, work(number)


def run_in_pool(
    work: Callable[[int], Result],
    numbers: Iterable[int],
    workers: int,
    retries: int = RETRIES,
    cancelled: Callable[[], bool] | None = None,
) -> Results[Result]:
    """(number, work(number)) as they finish, by `workers` processes of this machine. work: picklable. cancelled: asked
    again and again; once it says so, the workers are killed and nothing comes any more.

    When a worker dies, nobody knows which work it was doing: everything in progress is done again, each piece alone in
    a process of its own, so that only the guilty one is tried `retries` times."""
    remaining = list(numbers)[::-1]
    while remaining:
        running: dict[Future[Result], int] = {}
        pool = _pool(workers)
        try:
            while remaining or running:
                while remaining and len(running) < TASKS_PER_WORKER * workers:
                    running[pool.submit(work, remaining[-1])] = remaining[-1]
                    remaining.pop()
                done = _wait(running, cancelled)
                for future in done:
                    result = future.result()
                    yield running.pop(future), result
        except BrokenProcessPool:
            pass
        except _Cancelled:
            return
        finally:
            if running:  # cancelled, interrupted, or closed before the end: nobody waits for what they are doing
                _kill_workers(pool)
            pool.shutdown(wait=False, cancel_futures=True)
        for future, number in running.items():
            try:
                result = future.result() if _ended_well(future) else _alone(work, number, retries, cancelled)
            except _Cancelled:
                return
            yield number, result


class _Cancelled(Exception): ...


def _wait(running: Iterable[Future[Result]], cancelled: Callable[[], bool] | None) -> set[Future[Result]]:
    """Those that have ended, at least one. Raises _Cancelled."""
    while True:
        done, _ = wait(running, None if cancelled is None else POLL_SECONDS, return_when=FIRST_COMPLETED)
        if cancelled is not None and cancelled():
            raise _Cancelled
        if done:
            return done


def _kill_workers(pool: ProcessPoolExecutor) -> None:
    """What ProcessPoolExecutor.kill_workers of Python 3.14 does."""
    for process in list((pool._processes or {}).values()):
        process.kill()


def _ended_well(future: Future[Any]) -> bool:
    """Whether the work ended well before its pool broke."""
    return future.done() and not future.cancelled() and future.exception() is None


def _alone(
    work: Callable[[int], Result], number: int, retries: int, cancelled: Callable[[], bool] | None
) -> Result | LostTask:
    for _ in range(max(retries, 1)):
        with _pool(1) as pool:
            try:
                return _wait([pool.submit(work, number)], cancelled).pop().result()
            except BrokenProcessPool:
                continue
            except BaseException:
                _kill_workers(pool)
                raise
    return LostTask(f"its worker died {max(retries, 1) + 1} times (killed, or out of memory)")


def _pool(workers: int) -> ProcessPoolExecutor:
    share = max(1, cpus() // workers)
    # spawn: a forked child of a process with threads (torch, Mitsuba) can hang.
    limit = 61 if sys.platform == "win32" else workers  # what Windows can wait for at once
    return ProcessPoolExecutor(
        min(workers, limit), multiprocessing.get_context("spawn"), initializer=_begin_worker, initargs=(share,)
    )


def _begin_worker(threads: int) -> None:
    limit_threads(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A worker whose parent was killed would go on writing beside the next run, and then wait for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def limit_threads(count: int) -> None:
    """Let this process use `count` threads wherever numbers are crunched. Loads nothing: what is not imported yet reads
    the environment when it is."""
    for name in ("SPLATPAINTER_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = str(count)
    for module, setter in (("torch", "set_num_threads"), ("drjit", "set_thread_count")):
        if module in sys.modules:
            getattr(sys.modules[module], setter)(count)


def run_on_ray(
    work: Callable[[int], Result],
    numbers: Iterable[int],
    address: str | None = None,
    workers: int | None = None,
    retries: int = RETRIES,
    cpus_per_worker: int = 1,
) -> Results[Result]:
    """(number, work(number)) as they finish, as Ray tasks.

    address: of a cluster ("auto", "HOST:PORT", "ray://HOST:PORT"); None: a Ray of `workers` processes on this machine,
    ended afterwards. Ray itself starts work again when its worker dies, on another machine if need be. The package must
    be installed on the cluster and the work's files be reachable there. Raises ValueError when Ray is not installed or
    the cluster cannot be reached."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError as error:
        raise ValueError(f"--ray needs Ray ({error}); pip install 'splatpainter[cluster]'") from None
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "include_dashboard": False}
    if address is None:
        count = workers or cpus()
        options |= {"num_cpus": count * cpus_per_worker, "object_store_memory": 1 << 28}
    else:
        options = {"address": address, "log_to_driver": False, "logging_level": "ERROR"}
        _check_reachable(address)
    try:
        ray.init(**options)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        where = address or "a local Ray"
        raise ValueError(
            f"--ray: {where} cannot be reached or started ({' '.join(str(error).split())[:200]})"
        ) from None
    try:
        yield from _ray_results(ray, work, numbers, workers, retries, cpus_per_worker)
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raises ValueError: nobody answers at HOST:PORT or ray://HOST:PORT, of which Ray would complain for ten minutes;
    "auto" it looks up itself."""
    parts = urlsplit(address if "://" in address else f"ray://{address}")
    try:
        host, port = parts.hostname, parts.port
        if host and port:
            socket.create_connection((host, port), CONNECT_SECONDS).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(f"--ray: {address} cannot be reached ({' '.join(reason.split())[:200]})") from None


def _ray_results(
    ray: Any, work: Callable[[int], Result], numbers: Iterable[int], workers: int | None, retries: int, cpus: int
) -> Results[Result]:
    @ray.remote(num_cpus=cpus, max_retries=retries, retry_exceptions=False)
    def task(function: Callable[[int], Result], number: int) -> Result:
        limit_threads(cpus)
        return function(number)

    shared_work = ray.put(work)
    count = workers or max(1, int(ray.cluster_resources().get("CPU", 1)) // cpus)
    remaining, running = list(numbers)[::-1], {}
    while remaining or running:
        while remaining and len(running) < TASKS_PER_WORKER * count:
            number = remaining.pop()
            running[task.remote(shared_work, number)] = number
        for reference in ray.wait(list(running), num_returns=1)[0]:
            number = running.pop(reference)
            try:
                yield number, ray.get(reference)
            except ray.exceptions.RayTaskError as error:
                raise error.as_instanceof_cause() from None
            except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError) as error:
                yield number, LostTask(f"its worker died {retries + 1} times ({type(error).__name__})")
