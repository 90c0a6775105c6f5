"""Bodies of requests are bounded before anything reads them. Pure ASGI."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any


class _TooLong(Exception):
    pass


class BodyLimit:
    """Middleware: more than `limit` bytes of body are answered with 413. free: paths with a limit of their own."""

    def __init__(self, app: Any, limit: int, free: tuple[str, ...] = ()) -> None:
        self.app, self.limit, self.free = app, limit, free

    async def __call__(self, scope: MutableMapping[str, Any], receive: Any, send: Any) -> None:
        if scope["type"] != "http" or scope["path"] in self.free:
            await self.app(scope, receive, send)
            return
        declared = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
        if not declared.isdigit() or int(declared) > self.limit:
            await self._refuse(send)
            return
        total, started = 0, False

        async def counted() -> MutableMapping[str, Any]:
            nonlocal total
            message = await receive()
            total += len(message.get("body", b""))
            if total > self.limit:
                raise _TooLong
            return message

        async def noted(message: MutableMapping[str, Any]) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self.app(scope, counted, noted)
        except _TooLong:
            if not started:
                await self._refuse(send)

    async def _refuse(self, send: Any) -> None:
        headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"connection", b"close")]
        await send({"type": "http.response.start", "status": 413, "headers": headers})
        await send({"type": "http.response.body", "body": f"expected at most {self.limit} bytes".encode()})
