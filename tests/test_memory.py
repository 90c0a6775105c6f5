"""Memory that a process gives back."""

from __future__ import annotations

import subprocess
import sys

import pytest

CHILD = """
import sys
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
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="what glibc does")
def test_large_arrays_go_back_to_the_system():
    given_back = {
        mode: int(subprocess.run([sys.executable, "-c", CHILD, mode], capture_output=True, check=True).stdout)
        for mode in ("returned", "kept")
    }
    assert given_back["returned"] > 80 > given_back["kept"]
