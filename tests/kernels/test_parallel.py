"""Shares of kernels on helping threads."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from splatpainter.kernels.parallel import (
    MIN_SHARED_NUMBERS,
    THREADS_VARIABLE,
    _Helper,
    ahead,
    alone,
    at_most,
    beside,
    each,
    run,
    run_sized,
    threads,
)


@pytest.fixture(autouse=True)
def four_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, "4")


def test_every_thread_takes_its_share_and_helpers_serve_again():
    shares, names = [], set()

    def work(first: list, thread: int, threads: int) -> None:
        first.append((thread, threads))
        names.add(threading.current_thread().name + str(threading.get_ident()))

    for _ in range(50):
        shares.clear()
        run(work, shares)
        assert sorted(shares) == [(k, 4) for k in range(4)]
    assert len(names) <= 10, "threads are made anew for each kernel"


@pytest.mark.parametrize("who", [0, 1, 3])
def test_what_a_share_raises_is_raised_once_all_have_ended(who: int):
    ended = []

    def work(thread: int, threads: int) -> None:
        if thread == who:
            raise MemoryError("no room")
        ended.append(thread)

    for _ in range(3):  # a helper whose share failed serves on
        ended.clear()
        with pytest.raises(MemoryError, match="no room"):
            run(work)
        assert sorted(ended) == [k for k in range(4) if k != who]


def test_what_is_small_is_done_by_the_caller_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "3")
    shares: list[tuple[str, int, int]] = []

    def kernel(word: str, thread: int, count: int) -> None:
        shares.append((word, thread, count))

    run_sized(MIN_SHARED_NUMBERS - 1, kernel, "small")
    assert shares == [("small", 0, 1)]
    run_sized(MIN_SHARED_NUMBERS, kernel, "large")
    assert sorted(shares[1:]) == [("large", k, 3) for k in range(3)]


def test_callers_beside_one_another_and_within_one_another_do_not_wait_for_ever():
    counts: list[int] = []

    def outer(thread: int, threads: int) -> None:
        run(lambda thread, threads: counts.append(thread))

    waiting = [beside(lambda: run(outer)) for _ in range(20)]
    run(outer)
    for wait in waiting:
        wait()
    assert len(counts) == 21 * 16
    assert each(lambda k: k * k, range(10)) == [k * k for k in range(10)]


@pytest.mark.parametrize("threads", ["1", "2"])
def test_items_are_made_one_ahead_and_never_two(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    made, done, begun = [], [], [threading.Event() for _ in range(6)]

    def items() -> Iterator[int]:
        for k in range(6):
            assert len(done) >= k - 1, "memory of an item in use would be written to"
            made.append(threading.get_ident())
            begun[k].set()
            yield k

    for k in ahead(items()):
        # The next one is made while this one is at work.
        assert threads == "1" or k == 5 or begun[k + 1].wait(20)
        done.append(k)
    assert done == list(range(6)) and len(made) == 6
    assert (threading.get_ident() in made) == (threads == "1")
    assert list(ahead([])) == []


@pytest.mark.parametrize(("count", "expected"), [(1, 1), (2, 1), (4, 3)])
def test_what_is_made_ahead_leaves_a_thread_to_who_uses_it(
    count: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, str(count))
    assert list(ahead(threads() for _ in range(3))) == [expected] * 3
    with at_most(2):
        assert list(ahead(threads() for _ in range(2))) == [min(expected, 1)] * 2 and threads() == min(count, 2)
        with alone():
            assert threads() == 1
    assert threads() == count


def test_items_that_are_made_at_once_come_no_earlier(monkeypatch: pytest.MonkeyPatch):
    """As where threads do not wait for a GIL."""
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    begin, made = _Helper.begin, []

    def begin_and_finish(helper: _Helper, share: Callable[[int, int], None], thread: int, count: int) -> None:
        begin(helper, share, thread, count)
        while helper._share is not None:
            time.sleep(0.001)

    monkeypatch.setattr(_Helper, "begin", begin_and_finish)
    for k in ahead(made.append(k) or k for k in range(6)):
        assert len(made) == min(k + 2, 6)


def test_what_making_an_item_raises_comes_in_its_turn_and_what_its_user_raises_ends_it():
    def items() -> Iterator[int]:
        yield 0
        yield 1
        raise OSError("no room")

    taken = []
    with pytest.raises(OSError, match="no room"):
        for item in ahead(items()):
            taken.append(item)
    assert taken == [0, 1]
    with pytest.raises(KeyError):
        for item in ahead(items()):
            raise KeyError(item)
    run(lambda thread, threads: None)  # helpers serve on


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")  # it is what is tried
def test_a_forked_child_has_helpers_of_its_own():
    if sys.platform == "win32":
        pytest.skip("no fork there")
    run(lambda thread, threads: None)
    child = os.fork()
    if not child:
        taken: list[int] = []
        run(lambda thread, threads: taken.append(thread))
        os._exit(0 if sorted(taken) == [0, 1, 2, 3] else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def policy_of_waiting(tmp_path: Path, **chosen: str) -> str:
    """OMP_WAIT_POLICY in a new process that has imported splatpainter."""
    program = "import splatpainter, os\nprint(os.environ.get('OMP_WAIT_POLICY', ''))"
    ours = {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME"}
    variables = {name: value for name, value in os.environ.items() if name not in ours} | chosen
    words = [sys.executable, "-c", program]
    return subprocess.run(words, env=variables, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.parametrize(
    ("chosen", "policy"),
    [
        ({}, "PASSIVE"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE"),
        ({"GOMP_SPINCOUNT": "100"}, ""),
        ({"KMP_BLOCKTIME": "1"}, ""),
    ],
)
def test_torch_leaves_the_cpus_to_the_kernels_while_it_waits_unless_the_user_chose(
    tmp_path: Path, chosen: dict[str, str], policy: str
):
    assert policy_of_waiting(tmp_path, **chosen) == policy
