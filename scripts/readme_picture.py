"""Remake docs/images/overview.jpg, the README's picture, from a fresh run of the demo. Run on an idle machine: its
caption tells the seconds."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from splatpainter.cli import main as splatpainter

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "overview.jpg"
LARGEST = 600_000
"""Bytes."""


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        code = splatpainter(["demo", "--out", folder])
        if code:
            return code
        with Image.open(Path(folder) / "overview.png") as picture:
            TARGET.parent.mkdir(parents=True, exist_ok=True)
            picture.convert("RGB").save(TARGET, quality=92, optimize=True, progressive=True, subsampling=0)
    size = TARGET.stat().st_size
    assert size <= LARGEST, size
    print(f"{TARGET}: {size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
