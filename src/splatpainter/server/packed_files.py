"""Where the built page lies, and its files packed by gzip: wheels have NAME.gz in place of NAME (setup.py).

Knows no web server: exports read the page's scripts, too."""

from __future__ import annotations

import gzip
from pathlib import Path

STATIC = Path(__file__).with_name("static")
PACKED = ".gz"


def page_file(path: Path) -> bytes:
    """The bytes of a file of the page, STATIC / name. Raises FileNotFoundError where the page is not built."""
    packed = path.with_name(path.name + PACKED)
    return path.read_bytes() if path.exists() or not packed.exists() else gzip.decompress(packed.read_bytes())
