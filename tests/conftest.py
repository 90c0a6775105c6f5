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
