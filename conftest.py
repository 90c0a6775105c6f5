"""Shared fixtures: the folder of real assets beside the checkout (tests that need it skip with a line when absent)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("SPLATPAINTER_SHARED", Path(__file__).resolve().parents[1] / "shared"))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The shared folder with data/ and perceptual/."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no real assets: {SHARED / 'data'} is absent (set SPLATPAINTER_SHARED)")
    return SHARED


@pytest.fixture(params=["float32", "bfloat16"])
def precision(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The test runs twice, with networks in float32 and in bf16: any machine can do both, some slowly."""
    monkeypatch.setenv("SPLATPAINTER_PRECISION", request.param)
    return request.param


@pytest.fixture
def float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks in float32, for tests of its rounding, whatever this machine or the environment prefers."""
    monkeypatch.setenv("SPLATPAINTER_PRECISION", "float32")


def pytest_make_parametrize_id(val: object) -> str | None:
    """File contents are called "bytes" in test names: gzip and zip write the time, and workers must agree on names."""
    return "bytes" if isinstance(val, bytes | bytearray) else None
