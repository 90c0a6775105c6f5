"""One browser for all browser tests that a process runs one after the other."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest

from tests.support.studio_pages import browsing

FOLDER = Path(__file__).parent
OPENED = contextlib.ExitStack()
"""Closes the browser."""
BROWSERS: list[Any] = []
"""The browser that is open, if any."""


@pytest.fixture
def browser() -> Any:
    """The one that is open, else a new one."""
    if not BROWSERS:
        BROWSERS.append(OPENED.enter_context(browsing()))
    return BROWSERS[0]


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """The browser ends with the last test in a row that uses it: while it is there, so is Playwright's loop, which lets
    no other one run in this process."""
    fixtures = getattr(nextitem, "fixturenames", ())
    if nextitem is None or FOLDER not in nextitem.path.parents or "browser" not in fixtures:
        BROWSERS.clear()
        OPENED.close()
