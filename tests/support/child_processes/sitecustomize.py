"""What every Python process that a test starts does first (conftest.py puts this folder on PYTHONPATH).

The garbage collector looks at new objects seldom, and not at all at the end: walks through what torch consists of are
0.7 of the 1.7 CPU seconds of a process that only imports it, and tests start a hundred of those.
"""

import atexit
import gc

gc.set_threshold(1_000_000, 20, 20)
atexit.register(gc.freeze)  # registered first, so it comes last
