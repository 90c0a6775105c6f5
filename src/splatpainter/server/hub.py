"""Commands in, answers and rows out, for every client of a studio. Knows no HTTP: a client is something that can send.

What a client is sent is always in this order: rows that bring it to the present version, the state, then what was
waiting for it (answers, previews). So an answer never comes before the rows that it speaks of.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from pydantic import ValidationError

from splatpainter.server import describe, frames
from splatpainter.server.actions import Call, Desk, Handler, load
from splatpainter.server.core import Studio
from splatpainter.server.messages import COMMANDS, Answer, Command, Model, Problem, Progress
from splatpainter.server.messages.connection import Greeting, ToastEvent
from splatpainter.server.messages.state import State
from splatpainter.server.problems import Refused, first_fault, problem_of
from splatpainter.server.queue import Ticket, WorkQueue
from splatpainter.server.visitors import Visitor, Visitors
from splatpainter.session import Session

PACE = 0.1
"""Seconds between progress messages of one command."""
WAITING = 64
"""Messages that may wait for a client that reads slowly, before its next command has to wait too, ..."""
WAITING_BYTES = 64 << 20
"""... and bytes of them."""
MAX_WAITING = 1024
"""Messages that may wait for a client; one that reads none of more is closed."""


class Socket(Protocol):
    """What a client is sent through; may wait where the client is slow."""

    async def send_text(self, data: str) -> None: ...
    async def send_bytes(self, data: bytes) -> None: ...


class Client:
    """One connection, and what it has been sent so far."""

    def __init__(self, hub: Hub, socket: Socket) -> None:
        self.hub, self.socket = hub, socket
        self.name = secrets.token_hex(4)
        self.visitor = Visitor("")
        """Whose connection it is; `hello` says so."""
        self.session, self.version = "", -1
        """Which rows it has; -1: none yet."""
        self.greeted = self._gone = False
        self._told: State | None = None
        """The state that it was told last; None: no greeting has gone out yet."""
        self._state_due = False
        self._waiting: list[str | _Preview | Greeting] = []
        self._waiting_bytes = 0
        self.overrun = asyncio.Event()
        """Set where it reads so little that it has to go."""
        self._wake, self._room = asyncio.Event(), asyncio.Event()
        self._room.set()

    def say(self, message: Model) -> None:
        """Send a message after everything that it may speak of. A greeting goes out with the state of that moment."""
        self._add(message if isinstance(message, Greeting) else message.model_dump_json())

    def notice(self) -> None:
        """Something changed: send what this client lacks."""
        self._state_due = True
        self._wake.set()

    def after(self, call: Call) -> None:
        """Take over what a command leaves for the screen of its page, which may have another connection by now."""
        self.visitor.put_back |= call.put_back
        shown = self.visitor.client or self
        if call.preview is not None and call.preview_rows is not None:
            shown._add(_Preview(call.preview, call.preview_rows, self.hub.studio.session_id))
        shown._wake.set()

    def _add(self, item: str | _Preview | Greeting) -> None:
        if self._gone:
            return
        self._waiting.append(item)
        self._waiting_bytes += item.size if isinstance(item, _Preview) else len(item) if isinstance(item, str) else 0
        if len(self._waiting) >= WAITING or self._waiting_bytes >= WAITING_BYTES:
            self._room.clear()
        if len(self._waiting) > MAX_WAITING:
            self._waiting.clear()
            self.overrun.set()
        self._wake.set()

    def gone(self) -> None:
        """Nobody reads any more: nothing is kept for it, nothing waits for it."""
        self._gone = True
        self._room.set()

    async def room(self) -> None:
        """Wait until not too much waits to be sent: whoever does not read gets no more work done."""
        await self._room.wait()

    async def send_all(self) -> None:
        """Send until cancelled or the connection breaks."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            items, self._waiting = self._waiting, []
            self._waiting_bytes = 0
            self._room.set()
            if self.greeted:
                await self._send_rows([item for item in items if isinstance(item, _Preview)])
                if self._state_due and self._told is not None:
                    self._state_due = False
                    self._told, text = self.hub.news(self._told)
                    await self.socket.send_text(text)
            for item in items:
                if isinstance(item, str):
                    await self.socket.send_text(item)
                elif isinstance(item, Greeting):
                    self._told, self._state_due = self.hub.studio.state, False
                    state = self.hub.state()
                    await self.socket.send_text(item.model_copy(update={"state": state}).model_dump_json())
                elif item.session == self.session and item.version == self.version:
                    old = self.visitor.previewed
                    self.visitor.previewed = np.union1d(old, item.rows) if len(old) else item.rows
                    await self.socket.send_bytes(item.frame)

    async def _send_rows(self, coming: list[_Preview]) -> None:
        """Rows that changed since this client's version, and the true values of rows whose preview is over."""
        studio = self.hub.studio
        put_back, self.visitor.put_back = self.visitor.put_back, False
        shown, session_id = studio.session.shown, studio.session_id
        if self.session == session_id and self.version == shown.version and not put_back:
            return
        old, self.visitor.previewed = self.visitor.previewed, np.zeros(0, np.int64)
        stale = old if put_back else np.zeros(0, np.int64)
        if put_back and coming:  # rows that are about to be previewed anew need not flicker
            stale = np.setdiff1d(stale, coming[-1].rows, assume_unique=True)
        known = self.version if self.session == session_id and self.version >= 0 else None
        version, packed = await self.hub.frames(known, stale)
        if not put_back:
            self.visitor.previewed = old
        for frame in packed:
            await self.socket.send_bytes(frame)
        self.session, self.version = session_id, version


class _Preview:
    """A frame that shows what is not (yet) so."""

    def __init__(self, frame: bytes, rows: np.ndarray, session: str) -> None:
        self.frame, self.rows, self.session = frame, rows, session
        self.size = len(frame) + rows.nbytes
        self.version = frames.HEADER.unpack_from(frame)[4]


def _frames(session: Session, known: int | None, stale: np.ndarray) -> tuple[int, list[bytes]]:
    """(version, frames that bring a client from version `known` (None: nothing) there, and `stale` rows back)."""
    while True:
        shown = session.shown
        if known is None:
            return shown.version, [frames.snapshot(shown.splats, shown.version)]
        found = session.delta(known)
        if found.version == shown.version:  # else a writer was faster: look again
            break
    if found.since is None:
        return shown.version, [frames.snapshot(shown.splats, shown.version)]
    total, out = len(shown.splats), []
    rows = np.concatenate([found.rows, np.arange(found.kept, total)])
    if known != shown.version:
        out.append(frames.delta(shown.splats, rows, known, shown.version, found.recolored))
    stale = np.setdiff1d(stale[stale < total], rows)
    if len(stale):
        out.append(frames.preview(shown.splats.take(stale), stale, total, shown.version))
    return shown.version, out


class Hub:
    """All clients of a studio, and the queue that orders their work."""

    def __init__(self, studio: Studio, queue: WorkQueue | None = None) -> None:
        self.studio, self.queue = studio, queue or WorkQueue()
        self.clients: set[Client] = set()
        self.visitors = Visitors()
        self.handlers: dict[type[Command], Handler] = load()
        self.leaving: set[asyncio.Task[None]] = set()
        """Work of clients that have gone, to its end."""
        self._texts: tuple[State, dict[tuple[int, int], tuple[State, str]]] | None = None
        self._delta: tuple[Session, int, int, asyncio.Future[tuple[int, list[bytes]]]] | None = None

    def state(self) -> State:
        """The state as clients get it."""
        return self.studio.state.model_copy(update={"clients": len(self.clients)})

    def news(self, told: State) -> tuple[State, str]:
        """(the state now, the event for a client that was told another one); made once for all clients that were."""
        now, clients = self.studio.state, len(self.clients)
        if self._texts is None or self._texts[0] is not now:
            self._texts = (now, {})
        known = self._texts[1]
        if (id(told), clients) not in known:  # it is kept with what it is known by, or another could have its id
            known[id(told), clients] = told, describe.changes(told, now, clients).model_dump_json()
        return now, known[id(told), clients][1]

    async def frames(self, known: int | None, stale: np.ndarray) -> tuple[int, list[bytes]]:
        """See _frames; the last delta is kept, for mostly all clients want the same one."""
        session, now = self.studio.session, self.studio.session.version
        if len(stale) or known is None:
            return await asyncio.to_thread(_frames, session, known, stale)
        kept = self._delta
        if kept is None or kept[0] is not session or kept[1] != known or kept[2] != now:
            task = asyncio.ensure_future(asyncio.to_thread(_frames, session, known, stale))
            kept = self._delta = (session, known, now, task)
        return await asyncio.shield(kept[3])

    def announce(self) -> None:
        """Tell every client that something changed."""
        for client in self.clients:
            client.notice()

    def publish(self, message: Model) -> None:
        """Say something to every client."""
        for client in self.clients:
            if client.greeted:
                client.say(message)

    async def carry_out(self, command: Command, desk: Desk, ticket: Ticket, client: Client | None) -> Answer:
        """Run a command and return its answer. Raises Refused where it failed; nothing has changed then."""
        handler = self.handlers[type(command)]
        call = Call(self.studio, desk, ticket)
        spent, opened = [0.0], [False]

        def job(own: Ticket) -> Answer:
            start, before = time.perf_counter(), self.studio.session_id
            try:
                answer = handler.run(call, command)
                opened[0] = self.studio.session_id != before
                if handler.writes:
                    self.studio.refresh()
                return answer.model_copy(update={"version": self.studio.session.version})
            finally:
                spent[0] = time.perf_counter() - start

        lane = self.queue.write if handler.writes else self.queue.aside if handler.aside else self.queue.read
        try:
            answer = await lane(job, ticket)
        except Exception as error:
            raise Refused(self.studio.problem(problem_of(error))) from error
        if client is not None:
            client.after(call)
        if handler.writes:
            self.announce()
        if handler.writes and opened[0]:
            note = ToastEvent(level="info", message=f"Another window opened {self.studio.name}.")
            for other in self.clients - {client}:
                if other.greeted:
                    other.say(note)
        return answer.model_copy(update={"seconds": round(spent[0], 4)})

    def close(self) -> None:
        """After the last client has gone."""
        self.queue.close()
        self.studio.close()


def parse(data: object) -> tuple[int, Command]:
    """(id, command) from a message of a client. Raises Refused."""
    if not isinstance(data, dict) or not is_id(data.get("id")) or not isinstance(data.get("do"), str):
        raise Refused(Problem(kind="input", message='expected {"id": number, "do": name, ...}'))
    kind = COMMANDS.get(data["do"])
    if kind is None:
        raise Refused(Problem(kind="input", message=f"unknown command {data['do'][:40]!r}"))
    fields = {key: value for key, value in data.items() if key not in ("id", "do")}
    try:
        return data["id"], kind.model_validate(fields)
    except ValidationError as error:
        raise Refused(Problem(kind="input", message=first_fault(error, data["do"]))) from None


def is_id(value: object) -> bool:
    """Whether it can number a command: a whole number that JavaScript has too."""
    return type(value) is int and 0 <= value < 1 << 53


def pacer(client: Client, number: int, loop: asyncio.AbstractEventLoop) -> Callable[[float, str], None]:
    """Progress of a command from a worker thread to its page, not more often than every PACE seconds."""
    last = [0.0, ""]

    def report(share: float, stage: str) -> None:
        now = time.monotonic()
        if now - float(last[0]) < PACE and stage == last[1]:
            return
        last[:] = [now, stage]
        shown = client.visitor.client or client
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(shown.say, Progress(re=number, progress=share, stage=stage))

    return report
