"""Commands of all clients to what does them, and the answer, or what went wrong in one line, back. Knows no HTTP."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sqlite3
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from pydantic import ValidationError

from splatpainter.server import describe, frames
from splatpainter.server.commands import COMMANDS, HANDLERS
from splatpainter.server.commands.context import CommandContext, Handler
from splatpainter.server.page_state import Connection, PageState, PageStates
from splatpainter.server.protocol import Answer, Command, Message, Problem, State, ToastEvent, first_fault
from splatpainter.server.studio import Studio
from splatpainter.server.work_queue import Busy, Cancelled, Ticket, WorkQueue
from splatpainter.session import Session
from splatpainter.session.project.database import UnwritableError

log = logging.getLogger("splatpainter.server")


ANOTHER_PROJECT = Problem(
    kind="project",
    message="Another project was opened before this was done; nothing was changed.",
    hint="Look at the project that is open now, or go back to the one before.",
)


class CommandError(Exception):
    """A command that failed, as its client gets it."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.message)
        self.problem = problem


class Hub:
    """All clients of a studio, and the queue that orders their work."""

    def __init__(self, studio: Studio, queue: WorkQueue | None = None) -> None:
        self.studio, self.queue = studio, queue or WorkQueue()
        self.clients: set[Connection] = set()
        self.pages = PageStates()
        self.handlers: dict[type[Command], Handler] = HANDLERS
        self.closing: set[asyncio.Task[None]] = set()
        """Work of clients whose connection was closed, to its end."""
        self.leaving: set[asyncio.Task[None]] = set()
        """What is done once a page does not come back."""
        self._background: set[Ticket] = set()
        """Tickets of long commands in work."""
        self._diffs: tuple[State, dict[tuple[int, int], tuple[State, str]]] | None = None
        self._delta: tuple[Session, int, int, asyncio.Future[tuple[int, list[bytes]]]] | None = None

    def with_clients(self, state: State) -> State:
        """A state as clients get it."""
        return state.model_copy(update={"clients": len(self.clients)})

    def state_diff(self, before: State, now: State) -> str:
        """The event that turns one state into another; made once for all clients that have the first."""
        clients = len(self.clients)
        # All clients that lag by the same state get the same text, so it is made once for all of them.
        if self._diffs is None or self._diffs[0] is not now:
            self._diffs = (now, {})
        cached, key = self._diffs[1], (id(before), clients)
        if key not in cached:  # `before` is kept beside the text, or another state could get its id
            cached[key] = before, describe.changes(before, now, clients).model_dump_json()
        return cached[key][1]

    async def frames(self, since: int | None, stale_ids: np.ndarray, shapes: bool) -> tuple[int, list[bytes]]:
        """(version, frames that bring a client from version `since` (None: nothing) there, and previewed Gaussians
        `stale_ids` back). shapes: previews have moved Gaussians too, or added some. The last delta is kept, for mostly
        all clients want the same one."""
        session, now = self.studio.session, self.studio.session.version
        # What concerns one page's previews is of no use to another, so it is not kept.
        if len(stale_ids) or shapes or since is None:
            return await asyncio.to_thread(_frames, session, since, stale_ids, shapes)
        cached = self._delta
        if cached is None or cached[0] is not session or cached[1] != since or cached[2] != now:
            task = asyncio.ensure_future(asyncio.to_thread(_frames, session, since, stale_ids, False))
            cached = self._delta = (session, since, now, task)
        # Shielded: the first to ask may leave, and others wait for the same frames.
        return await asyncio.shield(cached[3])

    def mark_dirty(self) -> None:
        """Something changed: every client is sent what it lacks."""
        for client in self.clients:
            client.mark_dirty()

    def publish(self, message: Message) -> None:
        """Send a message to every client."""
        for client in self.clients:
            if client.greeted:
                client.send(message)

    async def execute(
        self,
        command: Command,
        page: PageState,
        ticket: Ticket,
        client: Connection | None,
        session: str | None = None,
    ) -> Answer:
        """Run a command and return its answer. session: id of the one that it is meant for; None: whichever is open.
        Raises CommandError where it failed; nothing has changed then."""
        # A context of its own for each command: what it previews or says belongs to this one alone.
        handler = self.handlers[type(command)]
        context = CommandContext(self.studio, page, ticket)
        # Long commands that only read run beside the rest; what they write after all goes through the writer's queue.
        if handler.background:
            context.writer = self._writer(asyncio.get_running_loop())
            self._background.add(ticket)
        seconds, opened, before = 0.0, False, ""
        if client is not None:
            loop, page_client = asyncio.get_running_loop(), client  # the page may have another connection by then

            def show(frame: bytes, gaussian_ids: np.ndarray) -> None:
                receiver = page_client.page.client or page_client
                loop.call_soon_threadsafe(receiver.show_preview, frame, gaussian_ids, before)

            context.show = show

        # Runs on the queue's thread. The session may be another one afterwards, which all other clients must learn.
        def job() -> Answer:
            nonlocal seconds, opened, before
            start, before = time.perf_counter(), self.studio.session_id
            # Now that its turn has come: another window, or the command before, may have opened another project.
            if handler.bound and session not in (None, before):
                raise CommandError(ANOTHER_PROJECT)
            try:
                answer = self._run(handler, context, command)
                opened = self.studio.session_id != before
                # Before the answer: whoever reads it may ask for the state that it speaks of.
                if handler.writes:
                    self.studio.refresh()
                return answer.model_copy(update={"version": self.studio.session.version})
            finally:
                seconds = time.perf_counter() - start

        # Whatever fails becomes one line for the client; its preview would otherwise stay for good.
        try:
            answer = await self.queue.run(handler.lane, job, ticket)
        except Exception as error:
            if client is not None and context.clear_preview:
                (client.page.client or client).end_previews()
            raise CommandError(self.studio.public_problem(problem_of(error))) from error
        finally:
            self._background.discard(ticket)
        if client is not None:  # the page may have another connection by now
            receiver = client.page.client or client
            if context.clear_preview:
                receiver.end_previews()
            receiver.show_preview(context.preview, context.previewed_ids, before)
        # Whatever it was that changed: each client's own loop finds out what that client lacks.
        if handler.writes:
            self.mark_dirty()
        # The others are told that their asset was replaced; without a word they would think it a fault.
        notice = f"Another window opened {self.studio.name}." if handler.writes and opened else context.notice
        for other in self.clients - {client} if notice else ():
            if other.greeted:
                other.send(ToastEvent(level="info", message=notice))
        for line in self.studio.take_news() if handler.writes else ():
            self.publish(ToastEvent(level="warning", message=line))
        return answer.model_copy(update={"seconds": round(seconds, 4)})

    def _run(self, handler: Handler, context: CommandContext, command: Command) -> Answer:
        """The answer of a command, on its thread. What it wrote is on the disk; the log is folded into the project file
        when the answer is on its way, before the next command that writes."""
        if not handler.writes:
            return handler.run(context, command)
        project = self.studio.session.files
        try:
            with project.settling_later():
                return handler.run(context, command)
        finally:
            self.queue.follow(project.settle)

    def _writer(self, loop: asyncio.AbstractEventLoop) -> Callable[[Callable[[], Any]], Any]:
        """CommandContext's `write` for this loop."""

        def write(work: Callable[[], Any]) -> Any:
            def job() -> Any:
                # Refreshed whether it worked or not: clients are to see what is so.
                try:
                    return work()
                finally:
                    self.studio.refresh()

            result = self.queue.write(job)
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self.mark_dirty)
            return result

        return write

    def stop(self) -> None:
        """Cancel long commands: the studio is being closed."""
        for ticket in self._background:
            ticket.cancel()
        for task in self.leaving:
            task.cancel()

    def close(self) -> None:
        """After the last client was closed."""
        self.queue.close()
        self.studio.close()


def _frames(session: Session, since: int | None, stale_ids: np.ndarray, shapes: bool) -> tuple[int, list[bytes]]:
    while True:
        # Taken first and compared after the delta was made: the two must speak of the same version.
        snapshot = session.snapshot
        if since is None:
            return snapshot.version, [frames.snapshot(snapshot.splats, snapshot.version)]
        delta = session.delta(since)
        if delta.version == snapshot.version:  # else a writer was faster: look again
            break
    # The history does not reach back that far, so all Gaussians go out.
    if delta.since is None:
        return snapshot.version, [frames.snapshot(snapshot.splats, snapshot.version)]
    count, out = len(snapshot.splats), []
    # New rows are changed rows to a client that has never seen them.
    changed_ids = np.concatenate([delta.gaussian_ids, np.arange(delta.retained, count)])
    if since != snapshot.version:
        out.append(frames.delta(snapshot.splats, changed_ids, since, snapshot.version, delta.recolored and not shapes))
    added = bool((stale_ids >= count).any()) and not out  # they go with whatever frame says how many there are
    # Those that changed anyway need no second frame to lose their preview.
    stale_ids = np.setdiff1d(stale_ids[stale_ids < count], changed_ids, assume_unique=True)
    if len(stale_ids) or added:
        out.append(frames.preview(snapshot.splats.take(stale_ids), stale_ids, count, snapshot.version, shapes))
    return snapshot.version, out


def parse(data: object) -> tuple[int, Command]:
    """(id, command) from a message of a client. Raises CommandError."""
    # The frame of the message first, so that a wrong command can be answered by its number.
    if not isinstance(data, dict) or not is_id(data.get("id")) or not isinstance(data.get("do"), str):
        raise CommandError(Problem(kind="input", message='expected {"id": number, "do": name, ...}'))
    kind = COMMANDS.get(data["do"])
    if kind is None:
        raise CommandError(Problem(kind="input", message=f"unknown command {data['do'][:40]!r}"))
    # id, do and session belong to the connection; a command's model refuses fields that it does not know.
    envelope = {"id", "do"} if "session" in kind.model_fields else {"id", "do", "session"}
    fields = {key: value for key, value in data.items() if key not in envelope}
    try:
        return data["id"], kind.model_validate(fields)
    except ValidationError as error:
        raise CommandError(Problem(kind="input", message=first_fault(error, data["do"]))) from None


def session_of(data: object) -> str | None:
    """Id of the session that a message is meant for; None: it names none."""
    session = data.get("session") if isinstance(data, dict) else None
    return session if isinstance(session, str) else None


def is_id(value: object) -> bool:
    """Whether it can number a command: an integer that JavaScript has too."""
    return type(value) is int and 0 <= value < 1 << 53


def problem_of(error: Exception) -> Problem:
    """A failure as clients get it. Wrong input speaks for itself: its last part says what to do."""
    # From the special to the general: some of these are ValueErrors as well.
    if isinstance(error, CommandError):
        return error.problem
    if isinstance(error, Cancelled):
        return Problem(kind="cancelled", message="Cancelled; nothing was changed.")
    if isinstance(error, Busy):
        return Problem(
            kind="busy", message="Too many commands are waiting.", hint="Wait until the work in progress is done."
        )
    if isinstance(error, MemoryError):
        hint = "Use a smaller picture, or an asset of fewer Gaussians."
        return Problem(kind="input", message="Out of memory.", hint=hint)
    if isinstance(error, ValidationError):
        return Problem(kind="input", message=first_fault(error, "studio"))
    # Our own errors end with what to do after the last semicolon; pages show that apart.
    if isinstance(error, ValueError) and not isinstance(error, sqlite3.Error):
        text = " ".join(str(error).encode("utf-8", "replace").decode().split())
        message, _, hint = text.rpartition("; ")
        kind = "storage" if isinstance(error, UnwritableError) else "input"
        return Problem(kind=kind, message=message or hint, hint=hint if message else "")
    # Everything else is ours: it goes to the log whole, and to the client in one shortened line.
    log.error("fault", exc_info=error)
    return Problem(kind="fault", message=f"Fault in the studio: {type(error).__name__}: {error}"[:300])
