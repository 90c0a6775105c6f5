"""What a client may use up: bodies are bounded before anything reads them, JSON before anything parses it, and
connections that ask for nothing, or read nothing, are closed.

A browser sends a request's head at once and reads what it asked for. What does not, holds memory and one of the
process's file handles for as long as it likes: heads that come a byte at a time, bodies that stop, downloads and
sockets that nobody reads.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Coroutine, MutableMapping
from typing import Any

import h11
from fastapi import HTTPException, Request, Response
from fastapi.routing import APIRoute
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from splatpainter.server.protocol import MAX_VIEW_PIXELS
from splatpainter.system.quick_dataclass import dataclass

MAX_COMMAND_BYTES = 1 << 18
"""Most bytes of a command as JSON; all but `paint.dab` fit easily."""
MAX_DAB_BYTES = 6 * MAX_VIEW_PIXELS + MAX_COMMAND_BYTES
"""Most bytes of `paint.dab`: over all of the largest view it is 16/3 bytes a pixel."""
DAB = "paint.dab"
MAX_JSON_SEPARATORS = 20_000
"""Commas, brackets and braces of a command. Text costs next to nothing to parse; what they separate costs a thousand
times as much, and nobody else is served meanwhile."""
MAX_INLINE_JSON_BYTES = 1 << 16
"""Up to here JSON is parsed on the event loop: half a millisecond."""


class BadBody(HTTPException):
    """A body that is no JSON of a bearable size."""


class BodyLimit:
    """Middleware: longer bodies are answered with 413. limit: bytes by path; None: a path with a limit of its own."""

    def __init__(self, app: Any, limit: Callable[[str], int | None]) -> None:
        self.app, self.limit = app, limit

    async def __call__(self, scope: MutableMapping[str, Any], receive: Any, send: Any) -> None:
        # Sockets have limits of their own (ws_max_size), and uploads count while they are written.
        limit = None if scope["type"] != "http" else self.limit(scope["path"])
        if limit is None:
            await self.app(scope, receive, send)
            return
        # What the header says is refused before a byte is read; a length that is no number is no length.
        declared = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
        if not declared.isdigit() or int(declared[:20]) > limit:
            await _refuse(send, limit)
            return
        total, started = 0, False

        # Chunked bodies state no length, and a header may be wrong: bytes are counted as they come.
        async def counted() -> MutableMapping[str, Any]:
            nonlocal total
            message = await receive()
            total += len(message.get("body", b""))
            if total > limit:
                raise BadBody(413)
            return message

        async def noted(message: MutableMapping[str, Any]) -> None:
            nonlocal started
            started = True
            await send(message)

        # Once an answer has begun no other may follow; then the connection simply ends.
        try:
            await self.app(scope, counted, noted)
        except BadBody:
            if not started:
                await _refuse(send, limit)


async def _refuse(send: Any, limit: int) -> None:
    headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
    await send({"type": "http.response.start", "status": 413, "headers": headers})
    await send({"type": "http.response.body", "body": f"expected at most {limit} bytes".encode()})


def body_limit(path: str) -> int | None:
    """Most bytes of a request's body by its path; None: an upload, which counts for itself."""
    if path == "/api/blobs":
        return None
    return MAX_DAB_BYTES if path == f"/api/do/{DAB}" else MAX_COMMAND_BYTES


async def parse_json(text: str | bytes) -> Any:
    """The values of a command's text. Raises ValueError of one line: no JSON, too many values."""
    # Short text is parsed sooner than a thread would start; long text must not hold up everybody else.
    if len(text) <= MAX_INLINE_JSON_BYTES:
        return _parsed(text)
    return await asyncio.to_thread(_parsed, text)


def _parsed(text: str | bytes) -> Any:
    separators = b",[{" if isinstance(text, bytes) else ",[{"
    # Counted before parsing: the separators bound the number of Python objects that can come of it.
    if sum(text.count(separators[k : k + 1]) for k in range(3)) > MAX_JSON_SEPARATORS:  # type: ignore[arg-type]
        raise ValueError(f"expected JSON of at most {MAX_JSON_SEPARATORS} values")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("expected JSON") from None
    # On the socket every command comes by the same way, so the smaller limit is held here.
    if len(text) > MAX_COMMAND_BYTES and isinstance(data, dict) and data.get("do", DAB) != DAB:
        raise ValueError(f"expected a command of at most {MAX_COMMAND_BYTES} bytes, got {len(text)}")
    return data


class _CommandRequest(Request):
    async def json(self) -> Any:
        try:
            return await parse_json(await self.body())
        except ValueError as error:
            raise BadBody(400, str(error)) from None


class CommandRoute(APIRoute):
    """A route whose body is parsed by `parse_json`."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def run(request: Request) -> Response:
            return await handler(_CommandRequest(request.scope, request.receive))

        return run


@dataclass(frozen=True)
class ConnectionLimits:
    """Limits of the server's connections."""

    connections: int = 256
    """Open at a time, sockets of pages included; one more is answered 503 and closed."""
    head_seconds: float = 10.0
    """Seconds from a connection's beginning, or the end of the request before, until a request's head is complete."""
    body_seconds: float = 20.0
    """Seconds in which `body_bytes` of a request's body must come, while the server is ready to take them."""
    body_bytes: int = 1024
    send_seconds: float = 30.0
    """Seconds after which a client that has read nothing of what waits for it is closed."""
    check_seconds: float = 1.0
    """Seconds between two checks of a connection."""


class _Watchdog:
    """Looks at one connection again and again, and aborts it where it is idle."""

    def __init__(self, protocol: Any, limits: ConnectionLimits) -> None:
        self.protocol, self.limits, self.loop = protocol, limits, protocol.loop
        self.received = 0
        """Bytes so far."""
        now = self.loop.time()
        self._sent: tuple[int, int] = (0, 0)
        self._sent_since = self._head_since = self._body_since = now
        self._body_from = 0
        self.drained = 0
        """How often the buffer of what is to be sent ran empty."""
        self._timer = self.loop.call_later(limits.check_seconds, self._check)

    def head_expected(self) -> None:
        """A new request may come now."""
        self._head_since = self.loop.time()

    def stop(self) -> None:
        """The connection has ended, or is a WebSocket now."""
        self._timer.cancel()

    def _check(self) -> None:
        now = self.loop.time()
        if self._is_idle(now):
            self.protocol.transport.abort()  # close() would wait until all is sent
            return
        self._timer = self.loop.call_later(self.limits.check_seconds, self._check)

    def _is_idle(self, now: float) -> bool:
        # What waits may be large and constant: a client that reads at all either shrinks it or empties it.
        waiting = self.protocol.transport.get_write_buffer_size()
        sent = (waiting, self.drained)
        if not waiting or sent != self._sent:
            self._sent, self._sent_since = sent, now
        if now - self._sent_since > self.limits.send_seconds:
            return True
        # Sockets of pages may be silent for hours; only HTTP owes a request.
        return isinstance(self.protocol, BoundedHttp) and self._receives_nothing(self.protocol, now)

    def _receives_nothing(self, http: BoundedHttp, now: float) -> bool:
        # Between requests nothing is due but the next head, in its time.
        if http.conn.their_state is h11.IDLE:
            self._body_since, self._body_from = now, self.received
            return now - self._head_since > self.limits.head_seconds
        # Not sending a body, or held back by us: the clock of the body starts anew.
        if http.conn.their_state is not h11.SEND_BODY or http.flow.read_paused:
            self._body_since, self._body_from = now, self.received
            return False
        if now - self._body_since <= self.limits.body_seconds:
            return False
        # Judged in spans and not from the start: a long upload may be slow at times, but never stop.
        slow = self.received - self._body_from < self.limits.body_bytes
        self._body_since, self._body_from = now, self.received
        return slow


class BoundedHttp(H11Protocol):
    """uvicorn's HTTP connection with limits; `bounded` gives the class for some limits."""

    limits = ConnectionLimits()
    watchdog: _Watchdog | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        # One connection too many is answered in plain bytes; the application never hears of it.
        if len(self.connections) > self.limits.connections:
            transport.write(b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-length: 0\r\n\r\n")
            transport.close()
            return
        self.watchdog = _Watchdog(self, self.limits)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_watchdog()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        # What comes after the end is thrown away and not counted.
        if self.transport.is_closing():
            return
        if self.watchdog is not None:
            self.watchdog.received += len(data)
        super().data_received(data)

    def on_response_complete(self) -> None:
        if self.watchdog is not None:
            self.watchdog.head_expected()
        super().on_response_complete()

    def resume_writing(self) -> None:
        if self.watchdog is not None:
            self.watchdog.drained += 1
        super().resume_writing()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        # A WebSocket has a class and a watchdog of its own.
        self._stop_watchdog()
        super().handle_websocket_upgrade(event)

    def _stop_watchdog(self) -> None:
        if self.watchdog is not None:
            self.watchdog.stop()
            self.watchdog = None


class BoundedSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket connection with limits."""

    limits = ConnectionLimits()
    watchdog: _Watchdog | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.watchdog = _Watchdog(self, self.limits)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.watchdog is not None:
            self.watchdog.stop()
        super().connection_lost(exc)

    def resume_writing(self) -> None:
        if self.watchdog is not None:
            self.watchdog.drained += 1
        super().resume_writing()


def bounded(limits: ConnectionLimits) -> tuple[type[BoundedHttp], type[BoundedSocket]]:
    """The classes of connections with these limits, as uvicorn.Config takes them (`http`, `ws`)."""
    http = type("BoundedHttp", (BoundedHttp,), {"limits": limits})
    return http, type("BoundedSocket", (BoundedSocket,), {"limits": limits})
