"""A session is small: what can be done with it stands in its parts, each a topic."""

from __future__ import annotations

from splatpainter.session import Session
from tests.support.session_scenes import flat

MAX_PUBLIC_NAMES = 30
"""Of a session itself, its parts included."""
MAX_PART_NAMES = 30
"""Of each part."""


def public(value: object) -> list[str]:
    return [name for name in dir(value) if not name.startswith("_")]


def test_a_session_and_its_parts_can_be_taken_in_at_a_glance() -> None:
    with flat() as session:
        assert len(public(session)) <= MAX_PUBLIC_NAMES
        for part in Session.__annotations__:
            assert len(public(getattr(session, part))) <= MAX_PART_NAMES, part
            assert type(getattr(session, part)).__doc__, part
