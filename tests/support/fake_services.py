"""A server on this machine that speaks the interfaces of image services, answers what a test wants, and keeps what it
was sent: http.server in a thread, with web sockets of short messages."""

from __future__ import annotations

import base64
import contextlib
import email
import email.policy
import hashlib
import io
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
from PIL import Image


@dataclass(frozen=True)
class Call:
    """A request that came in."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        return json.loads(self.body)

    def form(self) -> list[tuple[str, str | None, bytes]]:
        """(name, file name, content) of each part of a multipart form."""
        head = f"Content-Type: {self.headers['content-type']}\r\n\r\n".encode()
        message = email.message_from_bytes(head + self.body, policy=email.policy.HTTP)
        return [
            (
                str(part.get_param("name", header="content-disposition")),
                part.get_filename(),
                part.get_payload(decode=True),
            )
            for part in message.iter_parts()  # type: ignore[attr-defined]
        ]


@dataclass
class Reply:
    """What the server answers."""

    body: bytes | Any = b""
    """Bytes, or what becomes JSON."""
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    wait: threading.Event | None = None
    """The body comes once this is set."""
    endless: bool = False
    """The body never ends."""


class FakeService:
    """A server at `url` that answers with `replies` in turn, the last one again and again; or by `handler`."""

    def __init__(self, handler: Callable[[Call], Reply] | None = None) -> None:
        self.calls: list[Call] = []
        self.replies: list[Reply] = []
        self.handler = handler or (lambda call: self.replies.pop(0) if len(self.replies) > 1 else self.replies[0])
        self.socket: Callable[[Call, Callable[[Any], Any]], None] | None = None
        """Serves a web socket: is given a function that sends a message as JSON (bytes: as a binary message)."""
        self.stopped = threading.Event()
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), self._request_handler())
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    def _request_handler(self) -> type[BaseHTTPRequestHandler]:
        service = self

        class Handler(BaseHTTPRequestHandler):
            def handle_call(self) -> None:
                size = int(self.headers.get("content-length", 0))
                headers = {name.lower(): value for name, value in self.headers.items()}
                call = Call(self.command, self.path, headers, self.rfile.read(size))
                service.calls.append(call)
                if service.socket is not None and "upgrade" in headers:
                    self.close_connection = True
                    with contextlib.suppress(OSError):
                        self.wfile.write(_handshake(headers["sec-websocket-key"]))
                        service.socket(call, lambda message: self.wfile.write(_frame(message)))
                    return
                with contextlib.suppress(ConnectionError):
                    self.reply(service.handler(call))

            def reply(self, reply: Reply) -> None:
                is_json = not isinstance(reply.body, bytes)
                body = json.dumps(reply.body).encode() if is_json else reply.body
                headers = {"Content-Type": "application/json" if is_json else "application/octet-stream"}
                headers |= {"Connection": "close"} if reply.endless else {"Content-Length": str(len(body))}
                if reply.wait is not None:
                    while not (reply.wait.wait(0.02) or service.stopped.is_set()):
                        pass
                self.send_response(reply.status)
                for name, value in (headers | reply.headers).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)
                while reply.endless and not service.stopped.is_set():
                    self.wfile.write(bytes(1 << 16))

            do_GET = do_POST = handle_call

            def log_message(self, *_: Any) -> None:
                pass

        return Handler


def _handshake(key: str) -> bytes:
    """RFC 6455, 4.2.2."""
    digest = hashlib.sha1(f"{key}258EAFA5-E914-47DA-95CA-C5AB0DC85B11".encode()).digest()
    lines = ["HTTP/1.1 101 Switching Protocols", "Upgrade: websocket", "Connection: Upgrade"]
    lines.append(f"Sec-WebSocket-Accept: {base64.b64encode(digest).decode()}")
    return "\r\n".join([*lines, "", ""]).encode()


def _frame(message: Any) -> bytes:
    """One unmasked message, RFC 6455, 5.2."""
    kind, data = (0x82, message) if isinstance(message, bytes) else (0x81, json.dumps(message).encode())
    size = bytes([len(data)]) if len(data) < 126 else bytes([126]) + len(data).to_bytes(2, "big")
    return bytes([kind]) + size + data


@contextlib.contextmanager
def serving(handler: Callable[[Call], Reply] | None = None) -> Iterator[FakeService]:
    """A server as long as the block lasts."""
    service = FakeService(handler)
    thread = threading.Thread(target=service.server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield service
    finally:
        service.stopped.set()
        service.server.shutdown()
        service.server.server_close()
        thread.join(5)


def png(width: int = 32, height: int = 24, color: tuple[int, ...] = (255, 0, 0)) -> bytes:
    """A picture of one colour."""
    return encoded(Image.new("RGBA" if len(color) == 4 else "RGB", (width, height), color))


def encoded(image: Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def animated() -> bytes:
    """A picture of two frames."""
    frames = [Image.new("RGB", (8, 8), (shade, 0, 0)) for shade in (0, 255)]
    return encoded(frames[0], save_all=True, append_images=frames[1:])


def inks() -> bytes:
    """A picture in CMYK."""
    return encoded(Image.new("CMYK", (8, 8)), "JPEG")


def bomb() -> bytes:
    """A PNG of a hundred bytes that claims 30,000 x 30,000 pixels."""
    data = bytearray(png(1, 1))
    data[16:24] = (30000).to_bytes(4, "big") * 2
    import zlib

    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    return bytes(data)


def pixels(data: bytes) -> np.ndarray:
    """[H, W, C] uint8 of a picture file."""
    return np.asarray(Image.open(io.BytesIO(data)))


def text64(data: bytes) -> str:
    return base64.b64encode(data).decode()
