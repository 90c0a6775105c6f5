"""Pages over all their connections: what they have in hand, and what came of their latest commands.

A page names itself in `hello` and numbers its commands. When it comes back after a lost connection it sends again what
was not answered; a command with a number that came before is not executed again, its outcome is sent again. Knows no
sockets.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from typing import Protocol

import numpy as np

from splatpainter.server.protocol import Answer, Message
from splatpainter.server.strokes.mirrored_stroke import MirroredStroke
from splatpainter.server.strokes.stroke import Stroke
from splatpainter.server.work_queue import Ticket

MAX_OUTCOMES = 128
"""Latest commands of a page whose outcome can be sent again: more than may wait (client.MAX_QUEUED_COMMANDS)."""
RECONNECT_SECONDS = 120.0
"""Seconds for which a page that lost its connection is remembered."""
MAX_ABSENT_PAGES = 32
"""Pages without a connection that are remembered at a time; the oldest are forgotten first."""


class Connection(Protocol):
    """One of a page's connections to the studio."""

    page: PageState
    greeted: bool
    """Whether it said `hello`."""

    def send(self, message: Message) -> None: ...
    def mark_dirty(self) -> None: ...
    def show_preview(self, frame: bytes | None, gaussian_ids: np.ndarray | None, session: str) -> None: ...
    def end_previews(self) -> None: ...
    def closed(self) -> None: ...


class PageState:
    """One page. Its commands run one at a time."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.strokes: dict[str, Stroke] = {}
        """The page's stroke by its name, at most one."""
        self.mirrored: dict[str, MirroredStroke] = {}
        """The other half of a stroke under symmetry, by the stroke's name."""
        self.previewed_ids = np.zeros(0, np.int64)
        """Gaussians that its screen shows in other colours than the asset has."""
        self.previewed_shapes = False
        """Whether previews moved Gaussians, or added some, since all were as the asset has them."""
        self.dragged_layers: set[str] = set()
        """Layers that `layer.preview` shows otherwise than they are."""
        self.clear_preview = False
        """Whether they shall show the asset's again, which has not been sent yet."""
        self.client: Connection | None = None
        """The page's connection, the latest if there are several: the older ones are dead, whatever they look like."""
        self.attachments = 0
        """How often a connection was attached."""
        self.tickets: dict[int, Ticket] = {}
        """Tickets of the page's commands that wait or are running."""
        self._outcomes: OrderedDict[int, asyncio.Future[Answer]] = OrderedDict()

    async def once(self, number: int, work: Callable[[], Awaitable[Answer]]) -> Answer:
        """What `work` returns, or raises; for a number that came before, the outcome of that time."""
        # Shielded: the connection that asks again may break as well, and the outcome must outlive it.
        earlier = self._outcomes.get(number)
        if earlier is not None:
            return await asyncio.shield(earlier)
        outcome = self._outcomes[number] = asyncio.get_running_loop().create_future()
        # More than can wait at a time, so what may still be asked for again is always there.
        while len(self._outcomes) > MAX_OUTCOMES:
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


class PageStates:
    """Pages with a connection, and those that may come back."""

    def __init__(self) -> None:
        self._pages: OrderedDict[str, PageState] = OrderedDict()

    def __len__(self) -> int:
        return len(self._pages)

    def attach(self, client: Connection, name: str | None) -> bool:
        """A connection says whose it is; returns whether the page has been here before. name: the page's; None: it has
        none, and will not come back."""
        returning = name is not None and name in self._pages
        # Moved to the end: the order is what decides which page is forgotten first.
        if name is not None:
            client.page = self._pages.pop(name) if returning else PageState(name)
            self._pages[name] = client.page  # the latest last
        before, client.page.client = client.page.client, client
        client.page.attachments += 1
        # A page has one connection; an older one is dead even where its end has not been noticed.
        if before is not None and before is not client:
            before.closed()
        return returning

    def detach(self, client: Connection) -> None:
        """Forget a connection that was closed."""
        page = client.page
        # A late end of an old connection must not take the new one away.
        if page.client is not client:
            return
        page.client = None
        # Names are free to make up, so those who never come back are bounded in number and in time.
        absent = [page for page in self._pages.values() if page.client is None]
        for oldest in absent[: max(len(absent) - MAX_ABSENT_PAGES, 0)]:
            self._forget(oldest, oldest.attachments)
        asyncio.get_running_loop().call_later(RECONNECT_SECONDS, self._forget, page, page.attachments)

    def _forget(self, page: PageState, attachments: int) -> None:
        """Unless it has been back meanwhile."""
        # Called by a timer: the page may have come back and left again, which begins another wait.
        if page.client is None and page.attachments == attachments and self._pages.get(page.name) is page:
            del self._pages[page.name]
            for ticket in page.tickets.values():
                if ticket.ends_with_page:
                    ticket.cancel()
