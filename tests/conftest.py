"""Shared fixtures: the folder of real assets beside the checkout (tests that need it skip with a line when absent)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("SPLATPAINTER_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The shared folder with data/ and perceptual/."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no real assets: {SHARED / 'data'} is absent (set SPLATPAINTER_SHARED)")
    return SHARED


def pytest_make_parametrize_id(val: object) -> str | None:
    """File contents are called "bytes" in test names: gzip and zip write the time, and workers must agree on names."""
    return "bytes" if isinstance(val, bytes | bytearray) else None
