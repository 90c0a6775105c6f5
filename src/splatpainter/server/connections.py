"""Connections that ask for nothing, or read nothing, are closed; there are never more than so many. For uvicorn.

A browser sends a request's head at once and reads what it asked for. What does not, holds memory and one of the
process's file handles for as long as it likes: heads that come a byte at a time, bodies that stop, downloads and
sockets that nobody reads.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol


@dataclass(frozen=True)
class ConnectionLimits:
    """Of the server."""

    connections: int = 256
    """Open at a time, sockets of pages included; one more is answered 503 and closed."""
    head_seconds: float = 10.0
    """From a connection's beginning, or the end of the request before, until a request's head is complete."""
    body_seconds: float = 20.0
    """In which `body_bytes` of a request's body must come, while the server is ready to take them."""
    body_bytes: int = 1024
    send_seconds: float = 30.0
    """After which a client that has read nothing of what waits for it is closed."""
    check_seconds: float = 1.0
    """Between two looks at a connection."""


class _Watch:
    """Looks at one connection again and again, and aborts it where it stands still."""

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
        self._timer = self.loop.call_later(limits.check_seconds, self._look)

    def head_expected(self) -> None:
        """A new request may come now."""
        self._head_since = self.loop.time()

    def stop(self) -> None:
        """The connection has ended, or is somebody else's."""
        self._timer.cancel()

    def _look(self) -> None:
        now = self.loop.time()
        if self._stands_still(now):
            self.protocol.transport.abort()  # close() would wait until all is sent
            return
        self._timer = self.loop.call_later(self.limits.check_seconds, self._look)

    def _stands_still(self, now: float) -> bool:
        waiting = self.protocol.transport.get_write_buffer_size()
        sent = (waiting, self.drained)
        if not waiting or sent != self._sent:
            self._sent, self._sent_since = sent, now
        if now - self._sent_since > self.limits.send_seconds:
            return True
        return isinstance(self.protocol, BoundedHttp) and self._sends_nothing(self.protocol, now)

    def _sends_nothing(self, http: BoundedHttp, now: float) -> bool:
        if http.conn.their_state is h11.IDLE:
            self._body_since, self._body_from = now, self.received
            return now - self._head_since > self.limits.head_seconds
        if http.conn.their_state is not h11.SEND_BODY or http.flow.read_paused:
            self._body_since, self._body_from = now, self.received
            return False
        if now - self._body_since <= self.limits.body_seconds:
            return False
        slow = self.received - self._body_from < self.limits.body_bytes
        self._body_since, self._body_from = now, self.received
        return slow


class BoundedHttp(H11Protocol):
    """uvicorn's HTTP connection with limits; `bounded` gives the class for some limits."""

    limits = ConnectionLimits()
    watch: _Watch | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > self.limits.connections:
            transport.write(b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-length: 0\r\n\r\n")
            transport.close()
            return
        self.watch = _Watch(self, self.limits)

    def connection_lost(self, exc: Exception | None) -> None:
        self._unwatch()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self.transport.is_closing():
            return
        if self.watch is not None:
            self.watch.received += len(data)
        super().data_received(data)

    def on_response_complete(self) -> None:
        if self.watch is not None:
            self.watch.head_expected()
        super().on_response_complete()

    def resume_writing(self) -> None:
        if self.watch is not None:
            self.watch.drained += 1
        super().resume_writing()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._unwatch()
        super().handle_websocket_upgrade(event)

    def _unwatch(self) -> None:
        if self.watch is not None:
            self.watch.stop()
            self.watch = None


class BoundedSocket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket connection with limits."""

    limits = ConnectionLimits()
    watch: _Watch | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.watch = _Watch(self, self.limits)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.watch is not None:
            self.watch.stop()
        super().connection_lost(exc)

    def resume_writing(self) -> None:
        if self.watch is not None:
            self.watch.drained += 1
        super().resume_writing()


def bounded(limits: ConnectionLimits) -> tuple[type[BoundedHttp], type[BoundedSocket]]:
    """The classes of connections with these limits, as uvicorn.Config takes them (`http`, `ws`)."""
    http = type("BoundedHttp", (BoundedHttp,), {"limits": limits})
    return http, type("BoundedSocket", (BoundedSocket,), {"limits": limits})
