"""Pages over all their connections: what they have in hand, and what came of their latest commands.

A page names itself in `hello` and numbers its commands. When it comes back after a lost connection it sends again what
was not answered; a command with a number that was taken before is not carried out again, its outcome is told again.
Knows no sockets.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.server.actions import Desk
from splatpainter.server.messages import Answer
from splatpainter.server.queue import Ticket

if TYPE_CHECKING:
    from splatpainter.server.hub import Client

REMEMBERED = 128
"""Latest commands of a page whose outcome can be told again: more than may wait (socket.AHEAD)."""
GRACE = 120.0
"""Seconds for which a page that went is waited for."""
MOST = 32
"""Pages that are waited for at a time; the oldest are forgotten first."""


class Visitor:
    """One page."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.desk = Desk(name)
        self.previewed = np.zeros(0, np.int64)
        """Rows that its screen shows in other colours than the asset has."""
        self.put_back = False
        """Whether they shall show the asset's again, and have not been told yet."""
        self.client: Client | None = None
        """Its connection, the latest if there are several: the older ones are dead, whatever they look like."""
        self.visits = 0
        self.tickets: dict[int, Ticket] = {}
        """Of its commands that wait or are in work."""
        self._outcomes: OrderedDict[int, asyncio.Future[Answer]] = OrderedDict()

    async def once(self, number: int, work: Callable[[], Awaitable[Answer]]) -> Answer:
        """What `work` returns, or raises; for a number that came before, the outcome of that time."""
        kept = self._outcomes.get(number)
        if kept is not None:
            return await asyncio.shield(kept)
        outcome = self._outcomes[number] = asyncio.get_running_loop().create_future()
        while len(self._outcomes) > REMEMBERED:
            self._outcomes.popitem(last=False)
        try:
            answer = await work()
        except Exception as error:
            outcome.set_exception(error)
            outcome.exception()  # it is raised here; nobody else may ask for it
            raise
        except BaseException:  # the server is being closed
            outcome.cancel()
            raise
        outcome.set_result(answer)
        return answer


class Visitors:
    """Those that are here, and those that may come back."""

    def __init__(self) -> None:
        self._known: OrderedDict[str, Visitor] = OrderedDict()

    def __len__(self) -> int:
        return len(self._known)

    def enter(self, client: Client, page: str | None) -> bool:
        """A connection says whose it is; returns whether the page is known. page: its name; None: it has none, and
        will not come back."""
        known = page is not None and page in self._known
        if page is not None:
            client.visitor = self._known.pop(page) if known else Visitor(page)
            self._known[page] = client.visitor  # the latest last
        before, client.visitor.client = client.visitor.client, client
        client.visitor.visits += 1
        if before is not None and before is not client:
            before.gone()
        return known

    def leave(self, client: Client) -> None:
        """A connection has gone."""
        visitor = client.visitor
        if visitor.client is not client:
            return
        visitor.client = None
        away = [own for own in self._known.values() if own.client is None]
        for own in away[: max(len(away) - MOST, 0)]:
            self._forget(own, own.visits)
        asyncio.get_running_loop().call_later(GRACE, self._forget, visitor, visitor.visits)

    def _forget(self, visitor: Visitor, visits: int) -> None:
        """Unless it has been back meanwhile."""
        if visitor.client is None and visitor.visits == visits and self._known.get(visitor.name) is visitor:
            del self._known[visitor.name]
