"""One HTTP service as a source talks to it: bounded in time and bytes, patient with rate limits, cancelled within a
tenth of a second. Every failure is one SourceError.

Keys come from the environment when a request is made. They go into headers, never into addresses; they are kept in no
object, and redirects, which could carry them to another host, are not followed.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import email.utils
import functools
import html
import json
import os
import re
import ssl
import threading
import time
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar
from urllib.parse import urlsplit

from splatpainter.sources.picture_source import CancelFlag, Progress, SourceCancelled, SourceError

POLL_SECONDS = 0.1
CONNECT_SECONDS = 15.0
FIRST_WAIT_SECONDS = 1.0
"""Seconds before a refused request is sent again, where the service does not say how long; doubled each time."""
MAX_WAIT_SECONDS = 60.0
"""Longest that a service may ask to wait before a request is sent again."""
MAX_TRIES = 5
BUSY = {429: "too many requests", 503: "not available now", 529: "overloaded"}
MAX_JSON_BYTES = 192 << 20
MAX_FILE_BYTES = 256 << 20
MAX_ERROR_BYTES = 1 << 20
"""Most bytes of a body that explains an error: ComfyUI's lists all models of its folder beside the one that is
missing."""
LOOPBACK = ("localhost", "127.0.0.1", "::1")
_T = TypeVar("_T")


class Service:
    """A service at an address, within `run`. source: the name in messages; headers: may hold the key."""

    def __init__(
        self,
        source: str,
        base_url: str,
        headers: dict[str, str],
        progress: Progress,
        key_variables: tuple[str, ...] = (),
    ) -> None:
        self.source, self.base_url, self._headers = source, base_url.rstrip("/"), headers
        self.host = urlsplit(base_url).netloc
        self._progress, self._key_variables = progress, key_variables

    async def json(self, method: str, path: str, **content: Any) -> Any:
        """The JSON that a request is answered with. content: json=, data= and files= as httpx takes them. Raises
        SourceError: refused, out of time, too long, a web page, no JSON."""
        body, kind = await self.send(method, self.base_url + path, MAX_JSON_BYTES, **content)
        # A web page means a wrong address or a proxy's login, whatever the status says.
        if "html" in kind or body.lstrip()[:1] == b"<":
            raise self.error(f"answered with a web page{_title(body)} in place of JSON; is this its address?")
        try:
            return json.loads(body)
        except (ValueError, RecursionError):
            raise self.error(f"expected JSON, got {_excerpt(body)!r}") from None

    async def picture(self, url: str) -> bytes:
        """A picture file at an address that the service gave: on its own host, or by https elsewhere (without the
        key), or in the address itself (data:)."""
        # The picture may be in the address itself, on the same host, or elsewhere; each has its own risk.
        if url.startswith("data:"):
            head, _, data = url.partition(",")
            if not head.endswith(";base64"):
                raise self.error("answered with a data: address that is not base64")
            return decode_base64(data, self.source)
        if url.startswith("/"):
            parts = urlsplit(self.base_url)
            url = f"{parts.scheme}://{parts.netloc}{url}"
        parts = urlsplit(url)
        # The key goes to the host that it is for and to no other.
        same_host = parts.netloc == self.host
        if not same_host and parts.scheme != "https":
            raise self.error("answered with the address of a picture that is neither https nor its own")
        body, kind = await self.send("GET", url, MAX_FILE_BYTES, keyless=not same_host)
        if "html" in kind:
            raise self.error(f"answered with a web page{_title(body)} in place of a picture")
        return body

    async def send(
        self, method: str, url: str, max_bytes: int, keyless: bool = False, **content: Any
    ) -> tuple[bytes, str]:
        """(body, content type) of a request that succeeds; sent again where the service is busy."""
        import httpx

        # No compression: a small answer could unpack to any size.
        headers = {"Accept-Encoding": "identity", **({} if keyless else self._headers)}
        limits = httpx.Timeout(None, connect=CONNECT_SECONDS)  # `run` has the whole time
        # Services on this machine are asked directly, whatever proxy the environment names.
        direct = (urlsplit(url).hostname or "") in LOOPBACK
        problem = ""
        verify = _certificates(not direct)
        async with httpx.AsyncClient(
            timeout=limits, trust_env=not direct, verify=verify, follow_redirects=False
        ) as client:
            # Services that are busy are asked again, after a while and not for ever.
            for attempt in range(MAX_TRIES):
                try:
                    async with client.stream(method, url, headers=headers, **content) as response:
                        kind = response.headers.get("content-type", "").lower()
                        if response.is_success:
                            return await self._body(response, max_bytes), kind
                        # Only the beginning of an error is of use.
                        body = await self._body(response, MAX_ERROR_BYTES, cut=True)
                        status, retry_after = response.status_code, response.headers.get("retry-after")
                        target = response.headers.get("location", "")
                except httpx.HTTPError as error:
                    problem = f"cannot be reached at {self.host} ({_reason(error)})"
                except httpx.InvalidURL:
                    problem = "was given an invalid address"
                else:
                    # What is not busy is refused for good, and so is the last of the tries.
                    if status not in BUSY or attempt == MAX_TRIES - 1:
                        raise self._refusal(status, body, kind, target)
                    await self._wait(status, retry_after, attempt, body, kind)
                    continue
                raise self.error(problem)  # outside of the handler: the first error holds the request
        raise self.error("no answer")  # not reached: the last attempt raises

    async def _body(self, response: Any, max_bytes: int, cut: bool = False) -> bytes:
        """The body while it is read. cut: what is longer is cut off, else refused."""
        # A server that packs in spite of the header is refused: its bytes could not be bounded.
        encoding = response.headers.get("content-encoding", "identity").lower()
        if encoding not in ("identity", ""):
            raise self.error(f"answered in the encoding {encoding[:40]}, which was not accepted")
        # What the header says is refused before a byte is read; a header may be missing or wrong.
        size = response.headers.get("content-length", "")
        if size.isdecimal() and int(size) > max_bytes and not cut:
            raise self.error(f"answers with {int(size) >> 20:,} MiB; expected at most {max_bytes >> 20} MiB")
        chunks, count = [], 0
        # Counted while it comes, and given up as soon as it is too much.
        async for chunk in response.aiter_raw():
            chunks.append(chunk)
            count += len(chunk)
            if count > max_bytes:
                if cut:
                    break
                raise self.error(f"answers with more than {max_bytes >> 20} MiB")
        return b"".join(chunks)[: max_bytes if cut else None]

    async def _wait(self, status: int, retry_after: str | None, attempt: int, body: bytes, kind: str) -> None:
        # The service says how long, within reason; else each wait is twice the one before.
        seconds = retry_seconds(retry_after)
        if seconds is None:
            seconds = FIRST_WAIT_SECONDS * 2**attempt
        elif seconds > MAX_WAIT_SECONDS:
            message = _message(body, kind)
            raise self.error(f"{BUSY[status]} ({status}{message}); it asks to try again in {seconds:,.0f} seconds")
        self._progress(0.0, f"{self.source}: {BUSY[status]}; again in {seconds:.0f} s")
        await asyncio.sleep(seconds)

    def _refusal(self, status: int, body: bytes, kind: str, target: str) -> SourceError:
        message = _message(body, kind)
        # Some services answer a wrong key with 400 and say so in words alone.
        is_key = status in (401, 403) or (status == 400 and re.search(r"api[ _]?key", message, re.IGNORECASE))
        if is_key and self._key_variables:
            variable = next((name for name in self._key_variables if os.environ.get(name)), "")
            key = f"the key in {variable}" if variable else f"a request without a key ({self._key_variables[0]})"
            return self.error(f"refused {key} ({status}{message}); is it right, paid for and not expired?")
        if status in BUSY:
            return self.error(f"{BUSY[status]} ({status}{message}), {MAX_TRIES} times; try again later")
        # Redirects are not followed, for they could carry the key to another host; the user is told the address.
        if 300 <= status < 400:
            where = urlsplit(target).netloc or "another address"
            return self.error(f"redirects to {where} ({status}); give the address that answers")
        return self.error(f"refused the request ({status}{message})")

    def error(self, line: str) -> SourceError:
        """A failure of this service."""
        return SourceError(f"source {self.source}: {line}")


def run(work: Callable[[], Awaitable[_T]], source: str, seconds: float, cancel: CancelFlag) -> _T:
    """What an asynchronous function returns, in a thread with an event loop of its own (the caller may be in one).
    Raises SourceCancelled once `cancel` is set, SourceError after `seconds`, and what the function raises."""
    results: list[_T] = []
    errors: list[BaseException] = []
    abandoned = threading.Event()
    until = time.monotonic() + seconds

    # The loop looks up several times a second, for the work itself may wait for the network alone.
    async def supervise() -> None:
        task = asyncio.ensure_future(work())
        while not task.done():
            await asyncio.wait([task], timeout=POLL_SECONDS)
            if task.done():
                break
            if cancel.is_set() or abandoned.is_set() or time.monotonic() > until:
                # The work gets a moment to clean up: a run on a server wants to be taken back.
                task.cancel()
                await asyncio.wait([task], timeout=CLEANUP_SECONDS)
                if cancel.is_set() or abandoned.is_set():
                    raise SourceCancelled
                raise SourceError(f"source {source}: gave no answer within {seconds:g} seconds (option timeout)")
        results.append(task.result())

    def in_thread() -> None:
        try:
            asyncio.run(supervise())
        except BaseException as error:
            errors.append(error)

    # A thread of its own: the caller may already be within an event loop, as in a notebook.
    thread = threading.Thread(target=in_thread, name=f"source {source}", daemon=True)
    try:
        thread.start()
        # Joined in short steps, so that Ctrl-C is heard while the thread waits.
        while thread.is_alive():
            thread.join(POLL_SECONDS)
    except BaseException:  # Ctrl-C
        abandoned.set()
        if thread.ident is not None:
            thread.join(CLEANUP_SECONDS)
        raise
    if errors:
        raise errors[0]
    return results[0]


CLEANUP_SECONDS = 5.0
"""Seconds that a cancelled request has to clean up."""


def require_httpx(source: str) -> None:
    """Raises SourceError: the library is missing."""
    try:
        import httpx  # noqa: F401
    except ImportError:
        raise SourceError(f"source {source}: needs httpx; pip install 'splatpainter[{source}]'") from None


def read_key(source: str, variables: tuple[str, ...]) -> str:
    """The first key that is set. Raises SourceError: none is set, or it is not a valid one."""
    for name in variables:
        if value := os.environ.get(name, "").strip():
            # A key with blanks or other letters is a paste gone wrong; as a header it would fail less clearly.
            if not value.isascii() or not value.isprintable() or " " in value:
                raise SourceError(f"source {source}: {name} is not a valid key: it has characters that no key has")
            return value
    raise SourceError(f"source {source}: needs a key in the environment: set {' or '.join(variables)}")


def check_url(source: str, name: str, url: str) -> str:
    """The address without a slash at its end. Raises SourceError: no http address, or one with a user, a query."""
    # A key in an address would stand in every error and log.
    parts = urlsplit(url.strip())
    try:
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        good = False
    if not good or parts.username or parts.password or parts.query or parts.fragment or not url.strip().isprintable():
        raise SourceError(f"source {source}: option {name}: expected http(s)://HOST:PORT/PATH without a key")
    return url.strip().rstrip("/")


def is_loopback(url: str) -> bool:
    """Whether an address is one of this machine."""
    return urlsplit(url).hostname in LOOPBACK


def is_open(url: str) -> bool:
    """Whether what is sent to an address can be read on its way."""
    return urlsplit(url).scheme == "http" and not is_loopback(url)


def decode_base64(data: Any, source: str) -> bytes:
    """The bytes. Raises SourceError: not base64, too many."""
    # The size is known from the text, before it is decoded.
    if not isinstance(data, str) or len(data) * 3 // 4 > MAX_FILE_BYTES:
        raise SourceError(f"source {source}: expected a picture as base64 of at most {MAX_FILE_BYTES >> 20} MiB")
    try:
        return base64.b64decode(data, validate=True)
    except (binascii.Error, ValueError):
        raise SourceError(f"source {source}: answered with a picture that is not base64") from None


def retry_seconds(header: str | None) -> float | None:
    """Seconds of a Retry-After header, a number or a date (RFC 9110, 10.2.3); None: there is none that can be read."""
    if header is None:
        return None
    # Services send seconds or a date; either may be nonsense, and then it counts as absent.
    if header.strip().isdecimal():
        return float(header.strip()[:12])
    try:
        return max(0.0, email.utils.parsedate_to_datetime(header).timestamp() - time.time())
    except (ValueError, TypeError, OverflowError):
        return None


def at(value: Any, *path: str | int) -> Any:
    """The value at a path of keys and indices into JSON, or None where it leads nowhere."""
    # Answers of services are not taken on trust: any step may be missing or of another type.
    for step in path:
        if isinstance(step, int) and isinstance(value, list) and -len(value) <= step < len(value):
            value = value[step]
        elif isinstance(step, str) and isinstance(value, dict):
            value = value.get(step)
        else:
            return None
    return value


def node_errors(data: Any) -> str:
    """What ComfyUI says of the nodes of a workflow that it does not take, or ""."""
    entries = at(data, "node_errors")
    # All nodes at once: a workflow is mended in one go.
    lines = []
    for number, entry in entries.items() if isinstance(entries, dict) else ():
        errors = at(entry, "errors")
        for error in errors if isinstance(errors, list) else ():
            details = f" ({at(error, 'details')})" if at(error, "details") else ""
            lines.append(f"node {number} ({at(entry, 'class_type')}): {at(error, 'message')}{details}")
    return "; ".join(lines)[:300]


def _message(body: bytes, kind: str) -> str:
    """ ": ..." with what the body of an error says, or ""."""
    # Services explain their errors in different places; the first text that there is, is used.
    try:
        data = json.loads(body)
    except (ValueError, RecursionError):
        data = None
    if isinstance(data, list) and data:
        data = data[0]
    candidates = [at(data, "error", "message"), at(data, "error"), at(data, "detail"), at(data, "message")]
    text = next((text for text in candidates if isinstance(text, str) and text.strip()), "")
    details = at(data, "error", "details")
    if isinstance(details, str) and details.strip() and details != text:  # of ComfyUI
        text = f"{text} ({details.strip()})"
    if nodes := node_errors(data):
        text = f"{text}: {nodes}"
    # No JSON: perhaps a proxy's page, or plain text.
    if not text and data is None:
        if "html" in kind or body.lstrip()[:1] == b"<":
            return f": a web page{_title(body)}"
        text = body[:300].decode("utf-8", "replace")
    line = " ".join(text.split())[:300]
    return f": {line}" if line else ""


def _title(body: bytes) -> str:
    match = re.search(rb"<title[^>]{0,200}>([^<]{1,200})", body[: 1 << 16], re.IGNORECASE)
    text = html.unescape(match[1].decode("utf-8", "replace")).split() if match else []
    return f" ({' '.join(text)[:80]})" if text else ""


def _excerpt(body: bytes) -> str:
    return " ".join(body[:200].decode("utf-8", "replace").split())[:80]


@functools.cache
def _certificates(trust_env: bool) -> ssl.SSLContext:
    """Certificates of the authorities that servers are believed by: read once, which takes 30 ms, and not for every
    request."""
    import httpx

    return httpx.create_ssl_context(trust_env=trust_env)


def _reason(error: Exception) -> str:
    import httpx

    if isinstance(error, httpx.ConnectTimeout):
        return "no connection in time"
    text = " ".join(str(error).split())
    return text[:150] or type(error).__name__
