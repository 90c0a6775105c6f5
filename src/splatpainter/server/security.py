"""Who may talk to the studio: Host, Origin, token, and the headers of every answer. Pure ASGI, HTTP and socket alike.

A page of another site can make the browser send requests to 127.0.0.1 (cross-site requests: the Origin and
Sec-Fetch-Site headers tell), and can give its own name the address 127.0.0.1 (DNS rebinding: the Host header tells).
Programs that are no browsers send neither header; on other machines' requests (--host) all must know the token.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from collections.abc import MutableMapping
from dataclasses import field
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

from splatpainter.system.quick_dataclass import dataclass

COOKIE = "splatpainter"
"""Beginning of the cookie's name, before the port: a browser gives a cookie to every port of a host."""
BRACKETED = re.compile(r"\[([0-9a-f:.]+)\](?::[0-9]{1,5})?")
NAMED = re.compile(r"([a-z0-9._-]+)(?::[0-9]{1,5})?")
"""Host headers, lower case: an IPv6 address in brackets, any other address or name."""
SAFE_METHODS = ("GET", "HEAD")
"""Methods of requests that a link may make from another site."""
LOCAL = ("127.0.0.1", "localhost", "::1")
CSP = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self' 'wasm-unsafe-eval'",
        "worker-src 'self' blob:",
        "style-src 'self' 'unsafe-inline'",  # style attributes; no script can come in by them
        "img-src 'self' blob: data:",
        "font-src 'self' blob:",
        "connect-src 'self' blob: data:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
HEADERS = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


@dataclass(frozen=True)
class Access:
    """The rules of one server."""

    host: str = "127.0.0.1"
    """The address it listens on."""
    token: str | None = None
    """Whoever knows it may come in; None: everybody on this machine."""
    names: tuple[str, ...] = field(default=LOCAL)
    """Host names (without port) that requests may be addressed to; where `host` is not loopback, any numeric address
    too, for a rebound name is never one."""

    @staticmethod
    def of(host: str, token: str | None = None) -> Access:
        """Access to a server on `host`: on any but a loopback address a token is needed, and made where none is given.
        Raises ValueError where `host` is neither an address nor a name."""
        # A whole URL is the likely mistake here; it is named before anything listens.
        if not host or any(sign in host for sign in "/@ \\"):
            raise ValueError(f"studio: expected --host as an address or a name, got {host!r}")
        if is_loopback(host):
            return Access(host, token)
        # Reachable from other machines: then nobody comes in without a token, whether one was asked for or not.
        return Access(host, token or secrets.token_urlsafe(32), (*LOCAL, host.lower()))

    def knows_host(self, header: str | None) -> bool:
        """Whether a Host header is one of ours."""
        name = _name_of(header or "")
        # From other machines the studio has addresses that it does not know; a rebound name is never one.
        if name in self.names:
            return True
        return not is_loopback(self.host) and _is_address(name)

    def knows_token(self, given: str | None) -> bool:
        """Whether this is the token, compared in constant time."""
        return self.token is None or hmac.compare_digest((given or "").encode(), self.token.encode())


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach a server on `host`."""
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


class AccessGuard:
    """ASGI middleware: refuses (400, 403, 401) what the rules forbid; adds HEADERS to every answer."""

    def __init__(self, app: Any, access: Access) -> None:
        self.app, self.access = app, access

    async def __call__(self, scope: MutableMapping[str, Any], receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = _headers(scope)
        # Who may not talk at all is refused first, whatever token it brings.
        refusal = self._refusal(scope, headers)
        if scope["type"] == "websocket":
            if refusal is None and not self._authorised(scope, headers):
                refusal = (403, "")
            if refusal is None:
                await self.app(scope, receive, send)
            else:  # before the handshake: the client sees HTTP 403
                await receive()
                await send({"type": "websocket.close", "code": 1008})
            return
        # From here on HTTP: each answer, refusals included, carries the headers.
        outgoing = _with_headers(send)
        if refusal is not None:
            await _answer(outgoing, *refusal)
        elif self._authorised(scope, headers):
            await self.app(scope, receive, outgoing)
        else:
            await self._ask(scope, outgoing)

    def _refusal(self, scope: MutableMapping[str, Any], headers: dict[str, str]) -> tuple[int, str] | None:
        host = headers.get("host")
        # DNS rebinding: the browser believes it talks to another site, and only the Host header shows it.
        if not self.access.knows_host(host):
            return 400, "This server does not go by that name (Host header). Use the address that the studio printed."
        # Cross-site requests: a browser names the site of the page that sends them, and no page can change that.
        origin = headers.get("origin")
        scheme = "https" if scope["scheme"] in ("https", "wss") else "http"
        if origin is not None and origin.lower() != f"{scheme}://{host}".lower():
            return 403, "Requests from other sites are not answered (Origin header)."
        # A link from another site may open the page, which shows nothing of ours to that site; nothing else may.
        linked = scope["type"] == "http" and scope["method"] in SAFE_METHODS
        navigating = linked and headers.get("sec-fetch-mode") == "navigate"
        if headers.get("sec-fetch-site") in ("cross-site", "same-site") and not navigating:
            return 403, "Requests from other sites are not answered (Sec-Fetch-Site header)."
        return None

    def _authorised(self, scope: MutableMapping[str, Any], headers: dict[str, str]) -> bool:
        # Without a token everybody on this machine may come in, so nothing has to be shown.
        if self.access.token is None:
            return True
        kind, _, value = headers.get("authorization", "").partition(" ")
        given = value if kind.lower() == "bearer" else _cookie(headers.get("cookie", ""), cookie_name(scope))
        return self.access.knows_token(given)

    async def _ask(self, scope: MutableMapping[str, Any], send: Any) -> None:
        """A page address with the right ?token= gets the cookie and is sent on without it; everything else is 401."""
        # Only a page address is taken, for a browser will follow it; programs send the token as a header.
        query = parse_qsl(scope["query_string"].decode("latin-1"))
        given = dict(query).get("token")
        if scope["method"] != "GET" or given is None or not self.access.knows_token(given):
            await _answer(send, 401, "This studio needs its token: open the address that it printed when it started.")
            return
        # The token leaves the address, or it would stay in the browser's history and on the screen.
        rest = urlencode([pair for pair in query if pair[0] != "token"])
        location = "/" + quote(scope["path"].lstrip("/")) + (f"?{rest}" if rest else "")
        # SameSite=Strict: no other site's request carries it. HttpOnly: no script reads it.
        cookie = f"{cookie_name(scope)}={self.access.token}; Path=/; HttpOnly; SameSite=Strict"
        await _answer(send, 303, "", {"location": location, "set-cookie": cookie})


def cookie_name(scope: MutableMapping[str, Any]) -> str:
    """Name of this server's cookie, so that two studios on one host do not take each other's tokens away."""
    server = scope.get("server")
    return f"{COOKIE}-{server[1] or 0}" if server else COOKIE


def _headers(scope: MutableMapping[str, Any]) -> dict[str, str]:
    """Lower-case name -> value. Of a name that comes twice both are kept, and then fit nothing."""
    out: dict[str, str] = {}
    # Latin-1 takes any byte, so that no header can fail to be read before it is judged.
    for raw, value in scope["headers"]:
        name, text = raw.decode("latin-1").lower(), value.decode("latin-1")
        out[name] = f"{out[name]}, {text}" if name in out else text
    return out


def _name_of(header: str) -> str:
    """The name in a Host header, without port and brackets; "" where it is none."""
    text = header.lower()
    bracketed = BRACKETED.fullmatch(text)
    if bracketed:
        return bracketed[1] if _is_address(bracketed[1]) else ""
    named = NAMED.fullmatch(text)
    return named[1] if named else ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _cookie(header: str, name: str) -> str | None:
    try:
        morsel = SimpleCookie(header).get(name)
    except CookieError:
        return None
    return morsel.value if morsel else None


def _with_headers(send: Any) -> Any:
    extra = [(name.encode(), value.encode()) for name, value in HEADERS.items()]

    async def outgoing(message: MutableMapping[str, Any]) -> None:
        # Only where an answer has not set its own, as downloads may.
        if message["type"] == "http.response.start":
            present = {name.lower() for name, _ in message.get("headers", ())}
            message["headers"] = [*message.get("headers", ()), *(pair for pair in extra if pair[0] not in present)]
        await send(message)

    return outgoing


async def _answer(send: Any, status: int, text: str, headers: dict[str, str] | None = None) -> None:
    values = {"content-type": "text/plain; charset=utf-8", "cache-control": "no-store", **(headers or {})}
    pairs = [(name.encode(), value.encode("latin-1")) for name, value in values.items()]
    await send({"type": "http.response.start", "status": status, "headers": pairs})
    await send({"type": "http.response.body", "body": text.encode()})
