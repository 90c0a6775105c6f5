"""What docs/compatibility.md promises from 0.1.0 on, held by files of that version as text."""

from __future__ import annotations

from splatpainter.session.project import database
from splatpainter.session.replay import delta


def test_what_is_stored_has_the_version_that_the_page_names() -> None:
    assert database.VERSION == delta.VERSION == 1
