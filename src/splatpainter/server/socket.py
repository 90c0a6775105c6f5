"""One WebSocket connection: its commands in order and each of them once, `hello` first, `cancel` at once."""

from __future__ import annotations

import asyncio
import contextlib
import functools

from starlette.websockets import WebSocket, WebSocketDisconnect

from splatpainter.server.hub import Client, Hub, is_id, pacer, parse
from splatpainter.server.limits import parse_json
from splatpainter.server.messages import Answer, Command, Problem
from splatpainter.server.messages.connection import Cancel, Greeting, Hello, Sync
from splatpainter.server.problems import Refused, failure
from splatpainter.server.queue import Ticket
from splatpainter.server.schema import schema_hash

AHEAD = 64
"""Commands of one client that may wait; beyond that it is told so."""


own_hash = functools.cache(schema_hash)
"""Of the protocol of this process; some milliseconds of work."""


async def serve(hub: Hub, socket: WebSocket) -> None:
    """Until the client goes."""
    await socket.accept()
    client = Client(hub, socket)
    hub.clients.add(client)
    connection = Connection(hub, client)
    worker = asyncio.create_task(connection.work_all())
    doing = (client.send_all(), connection.read_all(socket), client.overrun.wait())
    talking = [asyncio.create_task(work) for work in doing]
    try:
        await asyncio.wait(talking, return_when=asyncio.FIRST_COMPLETED)
    finally:
        hub.clients.discard(client)
        for task in talking:
            task.cancel()
        await asyncio.gather(*talking, return_exceptions=True)
        hub.leaving.add(worker)
        worker.add_done_callback(hub.leaving.discard)
        connection.leave()
        hub.announce()


class Connection:
    """The commands of one client."""

    def __init__(self, hub: Hub, client: Client) -> None:
        self.hub, self.client = hub, client
        self._commands: asyncio.Queue[tuple[int, Command, Ticket] | None] = asyncio.Queue(AHEAD + 1)
        self._taken: set[int] = set()
        """Numbers of its commands that wait or are in work."""
        self._asides: dict[asyncio.Task[None], Ticket] = {}

    async def read_all(self, socket: WebSocket) -> None:
        """Take messages until the client goes."""
        with contextlib.suppress(WebSocketDisconnect):
            while True:
                await self._take(await socket.receive_text())

    async def _take(self, text: str) -> None:
        number = 0
        try:
            try:
                data = await parse_json(text)
            except ValueError as error:
                raise Refused(Problem(kind="input", message=str(error))) from None
            if isinstance(data, dict) and is_id(data.get("id")):
                number = data["id"]
            number, command = parse(data)
            if isinstance(command, Cancel):
                self._cancel(number, command)
                return
            if not self.client.greeted and not isinstance(command, Hello):
                raise Refused(Problem(kind="input", message="expected hello as the first message"))
            if number in self._taken or self._commands.qsize() >= AHEAD:
                why = "is still in work" if number in self._taken else "came too fast"
                raise Refused(Problem(kind="busy", message=f"command {number} {why}", hint="Wait for the answers."))
        except Refused as refused:
            self.client.say(failure(number, refused.problem))
            return
        if isinstance(command, Hello):
            self._greet(number, command)
            return
        ticket = Ticket(pacer(self.client, number, asyncio.get_running_loop()))
        self._taken.add(number)
        self.client.visitor.tickets.setdefault(number, ticket)
        self._commands.put_nowait((number, command, ticket))

    def _greet(self, number: int, command: Hello) -> None:
        """Answer `hello`; rows go out before it by themselves."""
        own = own_hash()
        if command.schema_hash != own:
            text = "This page is of another version than the studio."
            self.client.say(failure(number, Problem(kind="schema", message=text, hint="Reload the page.")))
            return
        studio, client = self.hub.studio, self.client
        if command.session == studio.session_id and command.since is not None and command.since >= 0:
            client.session, client.version = studio.session_id, command.since
        known = self.hub.visitors.enter(client, command.page)
        client.greeted = True
        greeting = Greeting(re=number, schema_hash=own, client=client.name, known=known, state=self.hub.state())
        client.say(greeting.model_copy(update={"version": studio.session.version}))
        for other in self.hub.clients - {client}:
            other.notice()

    def _cancel(self, number: int, command: Cancel) -> None:
        ticket = self.client.visitor.tickets.get(command.of)
        if ticket is not None:
            ticket.cancel()
        self.client.say(Answer(re=number, version=self.hub.studio.session.version))

    async def work_all(self) -> None:
        """Carry out commands, one after the other; long ones that change nothing run beside the rest."""
        while (entry := await self._commands.get()) is not None:
            number, command, ticket = entry
            await self.client.room()
            if isinstance(command, Sync):
                self.client.version = -1 if command.since is None else command.since
                self.client.say(Answer(re=number, version=self.hub.studio.session.version))
                self._done(number, ticket)
            elif self.hub.handlers[type(command)].aside:
                task = asyncio.create_task(self._work(number, command, ticket))
                self._asides[task] = ticket
                task.add_done_callback(self._asides.pop)
            else:
                await self._work(number, command, ticket)

    async def _work(self, number: int, command: Command, ticket: Ticket) -> None:
        client = self.client
        visitor = client.visitor

        async def work() -> Answer:
            return await self.hub.carry_out(command, visitor.desk, ticket, client)

        try:
            looks = self.hub.handlers[type(command)].aside  # these end with their connection, and may be done again
            answer = await (work() if looks else visitor.once(number, work))
            client.say(answer.model_copy(update={"re": number}))
        except Refused as refused:
            client.say(failure(number, refused.problem))
        finally:
            self._done(number, ticket)

    def _done(self, number: int, ticket: Ticket) -> None:
        self._taken.discard(number)
        if self.client.visitor.tickets.get(number) is ticket:
            del self.client.visitor.tickets[number]

    def leave(self) -> None:
        """The client has gone. What it asked for is still done (it may come back for it), long looks are stopped."""
        for ticket in self._asides.values():
            ticket.cancel()
        self._commands.put_nowait(None)
        self.client.gone()
        self.hub.visitors.leave(self.client)
