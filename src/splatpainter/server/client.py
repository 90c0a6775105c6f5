"""One WebSocket connection: its commands in order and each of them once, `hello` first, `cancel` at once.

What a client is sent is always in this order: Gaussians that bring it to the present version, the state, then what was
waiting for it (answers, previews). So neither a state nor an answer comes before the Gaussians that it speaks of.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import time
from collections.abc import Callable
from functools import cache
from typing import Protocol

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from splatpainter.server import frames
from splatpainter.server.hub import CommandError, Hub, is_id, parse, session_of
from splatpainter.server.limits import parse_json
from splatpainter.server.page_state import PageState
from splatpainter.server.protocol import (
    Answer,
    Cancel,
    Command,
    CommandProgress,
    Failure,
    Greeting,
    Hello,
    Message,
    Problem,
    State,
    Sync,
    ToastEvent,
)
from splatpainter.server.schema import schema_hash
from splatpainter.server.work_queue import Busy, Cancelled, Ticket

MAX_QUEUED_COMMANDS = 64
"""Commands of one client that may wait; those beyond fail."""
PROGRESS_SECONDS = 0.1
"""Seconds between progress messages of one command."""
BACKPRESSURE_MESSAGES = 64
"""Messages that may wait for a client that reads slowly, before its next command has to wait too."""
BACKPRESSURE_BYTES = 64 << 20
"""Bytes of such messages, likewise."""
MAX_UNSENT_MESSAGES = 1024
"""Messages that may wait for a client; one that reads none of more is closed."""
GRACE_SECONDS = 2.0
"""After a page's connection ended, until its layers are shown: a network that blinks shall not make them flicker."""

protocol_hash = cache(schema_hash)
"""Hash of this process's protocol; takes some milliseconds."""


class Socket(Protocol):
    """A connection's sending end; may wait where the client is slow."""

    async def send_text(self, data: str) -> None: ...
    async def send_bytes(self, data: bytes) -> None: ...


async def serve(hub: Hub, socket: WebSocket) -> None:
    """Until the client's connection ends."""
    await socket.accept()
    client = Client(hub, socket)
    hub.clients.add(client)
    reader = CommandReader(hub, client)
    # The reader's work is no part of the tasks that end with the connection: commands that came are carried out.
    worker = asyncio.create_task(reader.work_all())
    # Whichever ends first ends the connection: sending breaks, the client leaves, or it reads too little.
    tasks = [asyncio.create_task(work) for work in (client.send_all(), reader.read_all(socket), client.overrun.wait())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        # Out of the list first, so that nothing more is queued for it while its tasks end.
        hub.clients.discard(client)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        # The hub waits for the rest of its commands when the server is closed; the other clients learn the new count.
        hub.closing.add(worker)
        worker.add_done_callback(hub.closing.discard)
        reader.close()
        showing = asyncio.create_task(_show_held(hub, client.page, worker))
        hub.leaving.add(showing)
        showing.add_done_callback(hub.leaving.discard)
        hub.mark_dirty()


async def _show_held(hub: Hub, page: PageState, commands: asyncio.Task[None]) -> None:
    """Show what a page hides whose connection has ended, unless it comes back soon. commands: what is still done of
    those that it sent."""
    studio = hub.studio
    await asyncio.wait([commands])
    await asyncio.sleep(GRACE_SECONDS)
    if page.client is not None or not studio.held_layers.of(page):
        return

    def job() -> None:
        studio.held_layers.show(studio.session, page)
        studio.refresh()

    with contextlib.suppress(Busy, Cancelled, RuntimeError):  # closed: the studio shows them then
        await hub.queue.run("write", job, Ticket())
        hub.mark_dirty()


class Client:
    """What one connection has been sent so far, and what waits to be."""

    def __init__(self, hub: Hub, socket: Socket) -> None:
        self.hub, self.socket = hub, socket
        self.name = secrets.token_hex(4)
        self.page = PageState("")
        """Page whose connection this is; `hello` says so."""
        self.session, self.version = "", -1
        """Which Gaussians it has; -1: none yet."""
        self.greeted = self._closed = False
        self._state: State | None = None
        """The state that it was sent last; None: no greeting has gone out yet."""
        self._state_due = False
        self._unsent: list[str | _Preview | Greeting] = []
        self._unsent_bytes = 0
        self.overrun = asyncio.Event()
        """Set where it reads so little that it has to be closed."""
        self._wake, self._writable = asyncio.Event(), asyncio.Event()
        self._writable.set()

    def send(self, message: Message) -> None:
        """Send a message after everything that it may speak of. A greeting goes out with the state of that moment."""
        self._append(message if isinstance(message, Greeting) else message.model_dump_json())

    def mark_dirty(self) -> None:
        """Something changed: send what this client lacks."""
        self._state_due = True
        self._wake.set()

    def show_preview(self, frame: bytes | None, gaussian_ids: np.ndarray | None, session: str) -> None:
        """Send a preview, if there is one. session: id of the one that was open when it was begun; it is dropped where
        another one is open by now."""
        if frame is not None and gaussian_ids is not None:
            self._append(_Preview(frame, gaussian_ids, session))
        self._wake.set()

    def end_previews(self) -> None:
        """Show the true colours of all that was previewed; previews that have not been sent yet never are."""
        self.page.clear_preview = True
        # A preview that waits would otherwise be shown after the true colours and stay on the screen.
        self._unsent_bytes -= sum(item.size for item in self._unsent if isinstance(item, _Preview))
        self._unsent = [item for item in self._unsent if not isinstance(item, _Preview)]
        self._wake.set()

    def _append(self, item: str | _Preview | Greeting) -> None:
        if self._closed:
            return
        # Greetings are counted as messages only: their text is made when they are sent.
        self._unsent.append(item)
        self._unsent_bytes += item.size if isinstance(item, _Preview) else len(item) if isinstance(item, str) else 0
        # First the client's own commands are held back; only one that goes on growing is given up.
        if len(self._unsent) >= BACKPRESSURE_MESSAGES or self._unsent_bytes >= BACKPRESSURE_BYTES:
            self._writable.clear()
        if len(self._unsent) > MAX_UNSENT_MESSAGES:
            self._unsent.clear()
            self.overrun.set()
        self._wake.set()

    def closed(self) -> None:
        """Nobody reads any more: nothing is kept for it, nothing waits for it."""
        self._closed = True
        self._writable.set()

    async def backpressure(self) -> None:
        """Wait until not too much waits to be sent: whoever does not read gets no more work done."""
        await self._writable.wait()

    async def send_all(self) -> None:
        """Send until cancelled or the connection breaks."""
        while True:
            # All that came since the last round is taken together, so many changes cost one state and one delta.
            await self._wake.wait()
            self._wake.clear()
            items, self._unsent = self._unsent, []
            self._unsent_bytes = 0
            self._writable.set()
            # As it is now: what follows while Gaussians are sent may speak of others.
            state, due, self._state_due = self.hub.studio.state, self._state_due, False
            # Gaussians before the state, the state before messages, as the module says; neither before the greeting.
            if self.greeted:
                await self._send_gaussians([item for item in items if isinstance(item, _Preview)])
                if due and self._state is not None:
                    text = self.hub.state_diff(self._state, state)
                    self._state = state
                    await self.socket.send_text(text)
            # Messages keep their order; a preview is dropped where the asset has moved on: it shows what was before.
            for item in items:
                if isinstance(item, str):
                    await self.socket.send_text(item)
                elif isinstance(item, Greeting):
                    self._state = state
                    greeting = item.model_copy(update={"state": self.hub.with_clients(state)})
                    await self.socket.send_text(greeting.model_dump_json())
                elif item.session == self.session and item.version == self.version:
                    # What was previewed is noted, for these Gaussians must be put back when the preview ends.
                    old = self.page.previewed_ids
                    self.page.previewed_ids = np.union1d(old, item.gaussian_ids) if len(old) else item.gaussian_ids
                    self.page.previewed_shapes |= frames.has_shapes(item.frame)
                    await self.socket.send_bytes(item.frame)

    async def _send_gaussians(self, previews: list[_Preview]) -> None:
        """Those that changed since this client's version, and the true colours of those whose preview is over."""
        studio, page = self.hub.studio, self.page
        # Read and cleared before anything waits: a preview that ends meanwhile is then due for another round.
        clear, page.clear_preview = page.clear_preview, False
        version, session_id = studio.session.snapshot.version, studio.session_id
        if self.session == session_id and self.version == version and not clear:
            return
        # Taken away while frames are made, and put back below where the preview goes on.
        old, page.previewed_ids = page.previewed_ids, np.zeros(0, np.int64)
        stale_ids, shapes = old if clear else np.zeros(0, np.int64), page.previewed_shapes
        # Only one that changes colours on this very version can follow without a gap.
        due = previews[-1] if clear and previews and not shapes and previews[-1].version == version else None
        if due is not None:  # Gaussians that are about to be previewed anew need not flicker
            stale_ids = _without(stale_ids, due.gaussian_ids)
        # A delta needs a version of this session; after another project was opened only a snapshot will do.
        since = self.version if self.session == session_id and self.version >= 0 else None
        version, packed = await self.hub.frames(since, stale_ids, shapes)
        if clear:
            page.previewed_shapes = False
        else:
            page.previewed_ids = old
        if due is not None and due.version != version:  # a writer was faster: that preview will not come
            page.previewed_ids = _without(old, stale_ids)
            page.clear_preview = True
            self._wake.set()
        # The version is noted after the last frame: where sending breaks, the client is taken to have nothing of it.
        for frame in packed:
            await self.socket.send_bytes(frame)
        self.session, self.version = session_id, version


def _without(ids: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """Of some Gaussians ([K] int64 ascending) those that are none of others ([M] int64 ascending): on the thread that
    serves all clients, where a slider's previews are mostly of the same ones."""
    if np.array_equal(ids, excluded):
        return ids[:0]
    is_excluded = np.zeros(1 + max(int(some[-1]) for some in (ids, excluded) if len(some)), bool)
    is_excluded[excluded] = True
    return ids[~is_excluded[ids]]


class _Preview:
    """A frame that shows what is not (yet) so."""

    def __init__(self, frame: bytes, gaussian_ids: np.ndarray, session: str) -> None:
        self.frame, self.gaussian_ids, self.session = frame, gaussian_ids, session
        self.size = len(frame) + gaussian_ids.nbytes
        self.version = frames.HEADER.unpack_from(frame)[4]


class CommandReader:
    """The commands of one client."""

    def __init__(self, hub: Hub, client: Client) -> None:
        self.hub, self.client = hub, client
        self._commands: asyncio.Queue[tuple[int, Command, Ticket, str | None] | None] = asyncio.Queue(
            MAX_QUEUED_COMMANDS + 1
        )
        self._active: set[int] = set()
        """Numbers of its commands that wait or are in work."""
        self._background: dict[asyncio.Task[None], Ticket] = {}

    async def read_all(self, socket: WebSocket) -> None:
        """Take messages until the connection ends."""
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._take(await socket.receive_text())

    async def _take(self, text: str) -> None:
        number = 0
        try:
            # The number is looked for before the rest is checked, so that even a malformed command gets its answer.
            try:
                data = await parse_json(text)
            except ValueError as error:
                raise CommandError(Problem(kind="input", message=str(error))) from None
            if isinstance(data, dict) and is_id(data.get("id")):
                number = data["id"]
            number, command = parse(data)
            # At once and past the queue: a cancel that waits behind the command it is to stop would be of no use.
            if isinstance(command, Cancel):
                self._cancel(number, command)
                return
            # Before hello it is not known which page speaks, so an outcome could be stored for nobody.
            if not self.client.greeted and not isinstance(command, Hello):
                raise CommandError(Problem(kind="input", message="expected hello as the first message"))
            # Refused, not held back: the reader must go on reading, or it would never see a cancel.
            if number in self._active or self._commands.qsize() >= MAX_QUEUED_COMMANDS:
                reason = "is still in progress" if number in self._active else "came too fast"
                raise CommandError(
                    Problem(kind="busy", message=f"command {number} {reason}", hint="Wait for the answers.")
                )
        except CommandError as error:
            self.client.send(Failure(re=number, error=error.problem))
            return
        if isinstance(command, Hello):
            self._greet(number, command)
            return
        ticket = Ticket(throttled_progress(self.client, number, asyncio.get_running_loop()))
        # The ticket is kept with the page and not the connection, so that a page that returns can still cancel.
        self._active.add(number)
        self.client.page.tickets.setdefault(number, ticket)
        self._commands.put_nowait((number, command, ticket, session_of(data)))

    def _greet(self, number: int, command: Hello) -> None:
        """Answer `hello`; Gaussians go out before it by themselves."""
        # Checked before all else: a page of another version could misread whatever else it is sent.
        if command.schema_hash != protocol_hash():
            text = "This page is of another version than the studio."
            problem = Problem(kind="schema", message=text, hint="Reload the page.")
            self.client.send(Failure(re=number, error=problem))
            return
        studio, client = self.hub.studio, self.client
        # What the page has already is taken on its word, so that a short break costs a delta and no snapshot.
        if command.session == studio.session_id and command.since is not None and command.since >= 0:
            client.session, client.version = studio.session_id, command.since
        # The state in it is made anew when it is sent (see `send`), after the Gaussians that it speaks of.
        greeting = Greeting(
            re=number,
            version=studio.session.version,
            schema_hash=protocol_hash(),
            client=client.name,
            returning=self.hub.pages.attach(client, command.page),
            state=self.hub.with_clients(studio.state),
        )
        # From here on this client gets states, and whoever returns has seen the notes before.
        client.greeted = True
        client.send(greeting)
        for note in () if greeting.returning else studio.notes():
            client.send(ToastEvent(level="warning", message=note))
        # The number of open windows is part of what everybody is shown.
        for other in self.hub.clients - {client}:
            other.mark_dirty()

    def _cancel(self, number: int, command: Cancel) -> None:
        ticket = self.client.page.tickets.get(command.of)
        if ticket is not None:
            ticket.cancel()
        self.client.send(Answer(re=number, version=self.hub.studio.session.version))

    async def work_all(self) -> None:
        """Execute commands, one after the other; long ones that change nothing run beside the rest."""
        while (entry := await self._commands.get()) is not None:
            number, command, ticket, session = entry
            # Whoever does not read gets no further work done, or its answers would fill the memory.
            await self.client.backpressure()
            # Here and not by a handler: which Gaussians a client has is known to its connection alone.
            if isinstance(command, Sync):
                self.client.version = -1 if command.since is None else command.since
                self.client.send(Answer(re=number, version=self.hub.studio.session.version))
                self._done(number, ticket)
            elif (handler := self.hub.handlers[type(command)]).background:
                task = asyncio.create_task(self._work(number, command, ticket, session))
                # What must not be done twice outlives its connection; the rest is cancelled with it (`close`).
                if handler.once:
                    ticket.ends_with_page = True
                    self.hub.closing.add(task)
                    task.add_done_callback(self.hub.closing.discard)
                else:
                    self._background[task] = ticket
                    task.add_done_callback(self._background.pop)
            else:
                await self._work(number, command, ticket, session)

    async def _work(self, number: int, command: Command, ticket: Ticket, session: str | None) -> None:
        client, page = self.client, self.client.page

        async def work() -> Answer:
            return await self.hub.execute(command, page, ticket, client, session)

        # Mostly what runs in the background ends with its connection, and may be done again.
        handler = self.hub.handlers[type(command)]
        again = handler.background and not handler.once
        try:
            answer = await (work() if again else page.once(number, work))
            client.send(answer.model_copy(update={"re": number}))
        except CommandError as error:
            client.send(Failure(re=number, error=error.problem))
        finally:
            self._done(number, ticket)

    def _done(self, number: int, ticket: Ticket) -> None:
        self._active.discard(number)
        if self.client.page.tickets.get(number) is ticket:
            del self.client.page.tickets[number]

    def close(self) -> None:
        """The connection has ended. Its commands are still done (the page may come back for the answers), but for long
        ones that change nothing."""
        # Only what may be asked for again is stopped; a command that changes the asset is finished.
        for ticket in self._background.values():
            ticket.cancel()
        # None wakes the worker at the end of what is queued already.
        self._commands.put_nowait(None)
        self.client.closed()
        self.hub.pages.detach(self.client)


def throttled_progress(client: Client, number: int, loop: asyncio.AbstractEventLoop) -> Callable[[float, str], None]:
    """CommandProgress of a command from a worker thread to its page, at most every PROGRESS_SECONDS."""
    last_time, last_stage = 0.0, ""

    def report(share: float, stage: str) -> None:
        nonlocal last_time, last_stage
        now = time.monotonic()
        if now - last_time < PROGRESS_SECONDS and stage == last_stage:
            return
        last_time, last_stage = now, stage
        # The page may have come back by another connection since the command began.
        receiver = client.page.client or client
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(receiver.send, CommandProgress(re=number, progress=share, stage=stage))

    return report
