"""Memory that a process gives back."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHILD = """
import sys
from resource import RUSAGE_SELF, getrusage
import numpy as np
from splatpainter.system.memory import return_large_arrays

if sys.argv[1] == "returned":
    return_large_arrays()

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 >> 20

for _ in range(3):
    np.ones(3 << 20)  # 24 MiB: glibc keeps smaller ones from now on
arrays = [np.ones(1 << 20) for _ in range(12)]
before = resident()
last = arrays.pop()
del arrays
print(before - resident())
faults = getrusage(RUSAGE_SELF).ru_minflt
for _ in range(100):
    np.ones(1 << 18)  # 2 MiB, of 512 pages
print(getrusage(RUSAGE_SELF).ru_minflt - faults)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what glibc does")
def test_large_arrays_go_back_to_the_system():
    lines = [
        subprocess.run([sys.executable, "-c", CHILD, mode], capture_output=True, check=True).stdout.split()
        for mode in ("returned", "kept")
    ]
    limited, unlimited = ([int(number) for number in numbers] for numbers in lines)
    assert limited[0] > 80 > unlimited[0]
    # The pages of smaller ones are there for the next.
    assert limited[1] < 10 * 512


HOLES = """
import sys
import numpy as np
from splatpainter.system.memory import return_idle_memory, return_large_arrays

if sys.argv[1] == "returned":
    return_large_arrays()

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 >> 20

np.ones(3 << 20)  # 24 MiB: glibc keeps smaller ones from now on
arrays = [np.ones(1 << 16) for _ in range(160)]  # of 0.5 MiB each, one after the other in the heap
del arrays[:-1]
before = resident()
return_idle_memory()
print(before - resident())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what glibc does")
def test_free_pieces_amid_the_heap_go_back_where_large_arrays_do():
    sizes = [
        int(subprocess.run([sys.executable, "-c", HOLES, mode], capture_output=True, check=True).stdout)
        for mode in ("returned", "kept")
    ]
    assert sizes[0] > 40 and sizes[1] == 0


EDITS_IN_TURN = """
import sys
from resource import RUSAGE_SELF, getrusage
import numpy as np
from splatpainter.system.memory import keep_freed_arrays, return_large_arrays

if sys.argv[1] == "returned":
    return_large_arrays()
if sys.argv[1] != "fresh":
    keep_freed_arrays()
for turn in range(12):
    if turn == 2:
        faults = getrusage(RUSAGE_SELF).ru_minflt
    arrays = [np.ones(1 << 16) for _ in range(24)]  # 12 MiB in all, of 3,072 pages
    del arrays
print(getrusage(RUSAGE_SELF).ru_minflt - faults)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what glibc does")
def test_what_an_edit_frees_is_there_for_the_next():
    fresh, learnt, limited = (
        int(subprocess.run([sys.executable, "-c", EDITS_IN_TURN, mode], capture_output=True, check=True).stdout)
        for mode in ("fresh", "kept", "returned")
    )
    assert learnt < 1000 < 10 * 1500 < fresh
    assert limited > 10 * 1500, "processes of one edit go on giving back"


THREADS_IN_TURN = """
import sys
import threading
from resource import RUSAGE_SELF, getrusage
import numpy as np
from splatpainter.system.memory import keep_freed_arrays, share_one_heap

if sys.argv[1] == "shared":
    share_one_heap()
keep_freed_arrays()
hold, freed = threading.Event(), threading.Semaphore(0)

def work():
    arrays = [np.ones(1 << 16) for _ in range(40)]  # 20 MiB in all, of 5,120 pages
    del arrays
    freed.release()
    hold.wait()  # threads that are gone leave their heap to the next one

for turn in range(6):
    if turn == 1:
        faults = getrusage(RUSAGE_SELF).ru_minflt
    threading.Thread(target=work).start()
    freed.acquire()
print(getrusage(RUSAGE_SELF).ru_minflt - faults)
hold.set()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what glibc does")
def test_what_one_thread_frees_serves_the_others():
    shared, apart = (
        int(subprocess.run([sys.executable, "-c", THREADS_IN_TURN, mode], capture_output=True, check=True).stdout)
        for mode in ("shared", "apart")
    )
    assert shared < 5000 < 4 * 5000 < apart
