"""What systems other than this one lack."""

from __future__ import annotations

import sys

import pytest

posix_only = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals, links or limits")
