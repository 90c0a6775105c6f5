"""Bodies of requests are bounded before anything reads them, and JSON before anything parses it. Pure ASGI."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Coroutine, MutableMapping
from typing import Any

from fastapi import HTTPException, Request, Response
from fastapi.routing import APIRoute

from splatpainter.server.messages.base import PIXELS

MAX_COMMAND_BYTES = 1 << 18
"""Of a command as JSON; the largest but one are four views with their cameras."""
MAX_DAB_BYTES = 6 * PIXELS + MAX_COMMAND_BYTES
"""Of `paint.dab`: over the whole of the largest view it is 16/3 bytes a pixel."""
DAB = "paint.dab"
MAX_JSON_SIGNS = 20_000
"""Commas, brackets and braces of a command. Text costs next to nothing to parse; what they separate costs a thousand
times as much, and nobody else is served meanwhile."""
INLINE_BYTES = 1 << 16
"""Up to here JSON is parsed on the event loop: half a millisecond."""


class BadBody(HTTPException):
    """A body that is no JSON of a bearable size."""


class BodyLimit:
    """Middleware: longer bodies are answered with 413. limit: bytes by path; None: a path with a limit of its own."""

    def __init__(self, app: Any, limit: Callable[[str], int | None]) -> None:
        self.app, self.limit = app, limit

    async def __call__(self, scope: MutableMapping[str, Any], receive: Any, send: Any) -> None:
        limit = None if scope["type"] != "http" else self.limit(scope["path"])
        if limit is None:
            await self.app(scope, receive, send)
            return
        declared = next((value for name, value in scope["headers"] if name == b"content-length"), b"0")
        if not declared.isdigit() or int(declared[:20]) > limit:
            await _refuse(send, limit)
            return
        total, started = 0, False

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
    if len(text) <= INLINE_BYTES:
        return _parsed(text)
    return await asyncio.to_thread(_parsed, text)


def _parsed(text: str | bytes) -> Any:
    signs = b",[{" if isinstance(text, bytes) else ",[{"
    if sum(text.count(signs[k : k + 1]) for k in range(3)) > MAX_JSON_SIGNS:  # type: ignore[arg-type]
        raise ValueError(f"expected JSON of at most {MAX_JSON_SIGNS} values")
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("expected JSON") from None
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
