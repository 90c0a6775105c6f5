"""What each command does: functions of (call, command) that run on a worker thread and return the command's answer.

`@handles(Kind, writes=True)` puts them in HANDLERS. Those that write run one after the other, in the order in which
their commands came; the others look at snapshots and may run beside them. Wrong input is a ValueError of one line.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from splatpainter.server.core import Studio
from splatpainter.server.messages import Answer, Command
from splatpainter.server.paint import Stroke
from splatpainter.server.queue import Ticket

Run = Callable[["Call", Command], Answer]
Action = TypeVar("Action", bound=Callable[..., Answer])


@dataclass
class Desk:
    """What one client has in hand; its commands run one at a time."""

    name: str
    strokes: dict[str, Stroke] = field(default_factory=dict)
    """At most one, by its name."""


@dataclass
class Call:
    """One command on its way."""

    studio: Studio
    desk: Desk
    ticket: Ticket
    preview: bytes | None = None
    """A frame of rows to show to this client alone, with the answer."""
    preview_rows: np.ndarray | None = None
    """[C] the rows in it."""
    put_back: bool = False
    """Whether rows that this client previews shall show their true values again."""


@dataclass(frozen=True)
class Handler:
    """How a command is carried out."""

    run: Run
    writes: bool
    """Whether it may change the session."""
    aside: bool
    """Whether the client's next commands need not wait for it (long work that changes nothing)."""


HANDLERS: dict[type[Command], Handler] = {}


def handles(kind: type[Command], *, writes: bool = False, aside: bool = False) -> Callable[[Action], Action]:
    """Register the function for a command. aside: the client's next commands need not wait for it."""

    def register(run: Action) -> Action:
        HANDLERS[kind] = Handler(run, writes, aside)
        return run

    return register


def load() -> dict[type[Command], Handler]:
    """HANDLERS, complete."""
    for name in ("painting", "layers", "looks", "looking", "pictures", "files"):
        importlib.import_module(f"splatpainter.server.actions.{name}")
    return HANDLERS
