"""Who may talk to the studio, and what uploads and names may do."""

from __future__ import annotations

import asyncio
import gzip
import io
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator, MutableMapping
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from splatpainter.server.limits import BodyLimit
from splatpainter.server.security import COOKIE, CSP, Access, AccessGuard, is_loopback
from splatpainter.server.uploads.storage import Blobs, Folder, UploadLimits
from tests.support.studio_scenes import Live, live, make_studio, view

TOKEN = "a-secret-of-this-test"


async def inner(scope: MutableMapping[str, Any], receive: Any, send: Any) -> None:
    """An application that answers everything with "in"."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    while (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"in"})


def ask(access: Access, path: str = "/", headers: dict[str, str] | None = None, method: str = "GET") -> httpx.Response:
    async def run() -> httpx.Response:
        transport = httpx.ASGITransport(AccessGuard(inner, access))
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8750") as client:
            return await client.request(method, path, headers=headers)

    return asyncio.run(run())


def shake(access: Access, headers: dict[str, str]) -> str:
    """Type of the first answer to a socket's handshake."""
    sent: list[MutableMapping[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope: dict[str, Any] = {"type": "websocket", "scheme": "ws", "path": "/ws", "query_string": b"", "headers": pairs}
    scope["server"] = ("127.0.0.1", 8750)
    asyncio.run(AccessGuard(inner, access)(scope, receive, send))
    return sent[0]["type"]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"host": "localhost:1234"}, 200),
        ({"host": "[::1]:8750"}, 200),
        ({"host": "[::1].evil"}, 400),
        ({"host": "[::1]evil.example:80"}, 400),
        ({"host": "[::1"}, 400),
        ({"host": "localhost:evil"}, 400),
        ({"host": "localhost@evil.example"}, 400),
        ({"host": "127.0.0.1:8750:9"}, 400),
        ({"host": "evil.example:8750"}, 400),  # a rebound name
        ({"host": "127.0.0.1.evil.example"}, 400),
        ({"host": ""}, 400),
        ({"origin": "http://127.0.0.1:8750"}, 200),
        ({"origin": "http://127.0.0.1:9999"}, 403),  # another program's page on this machine
        ({"origin": "https://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"host": "evil.example", "origin": "http://evil.example"}, 400),
        ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, 403),  # <img src="http://127.0.0.1/...">
        ({"sec-fetch-site": "same-site", "sec-fetch-mode": "cors"}, 403),
        ({"sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"}, 200),
        ({"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, 200),  # a link to the studio
    ],
)
def test_hosts_and_origins(headers: dict[str, str], status: int) -> None:
    answer = ask(Access(), headers=headers)
    assert answer.status_code == status
    assert answer.headers["content-security-policy"] == CSP and answer.headers["x-content-type-options"] == "nosniff"
    if "sec-fetch-site" not in headers:
        opened = "websocket.accept" if status == 200 else "websocket.close"
        assert shake(Access(), {"host": "127.0.0.1:8750", **headers}) == opened


def test_a_link_may_only_get() -> None:
    headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert ask(Access(), headers=headers, method="HEAD").status_code == 200
    for method in ("POST", "PUT", "DELETE", "PATCH"):
        assert ask(Access(), "/api/do/undo", headers, method).status_code == 403


def test_two_studios_on_one_host_keep_their_own_tokens() -> None:
    def enter(port: int, cookies: list[str]) -> httpx.Response:
        async def run() -> httpx.Response:
            transport = httpx.ASGITransport(AccessGuard(inner, Access.of("0.0.0.0", f"token{port}")))
            async with httpx.AsyncClient(transport=transport, base_url=f"http://10.0.0.1:{port}") as client:
                query = "" if cookies else f"?token=token{port}"
                return await client.get(f"/{query}", headers={"cookie": "; ".join(cookies)})

        return asyncio.run(run())

    cookies = [enter(port, []).headers["set-cookie"].split(";")[0] for port in (8750, 8751)]
    assert len({cookie.split("=")[0] for cookie in cookies}) == 2
    assert [enter(port, cookies).text for port in (8750, 8751)] == ["in", "in"]  # a browser sends both to both
    assert enter(8752, cookies).status_code == 401


def test_a_socket_of_another_site_is_refused_also_as_a_navigation() -> None:
    headers = {"host": "127.0.0.1:8750", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    assert shake(Access(), headers) == "websocket.close"


def test_the_policy_lets_in_no_foreign_or_inline_script() -> None:
    rules = {rule.partition(" ")[0]: rule.partition(" ")[2] for rule in CSP.split("; ")}
    assert rules["script-src"] == "'self' 'wasm-unsafe-eval'" and rules["default-src"] == "'none'"
    assert rules["worker-src"] == "'self' blob:" and rules["frame-ancestors"] == "'none'"
    assert not any("http" in value or "*" in value for value in rules.values())


def test_other_machines_need_the_token() -> None:
    access = Access.of("0.0.0.0", TOKEN)
    here = {"host": "192.168.1.5:8750"}
    assert ask(access, headers=here).status_code == 401
    assert ask(access, "/api/state", headers={**here, "cookie": f"{COOKIE}-8750=wrong"}).status_code == 401
    assert ask(access, "/?token=wrong", headers=here).status_code == 401
    assert ask(access, f"/?token={TOKEN}", headers=here, method="POST").status_code == 401
    entered = ask(access, f"/page?x=1&token={TOKEN}", headers=here)
    assert entered.status_code == 303 and entered.headers["location"] == "/page?x=1"
    cookie = entered.headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    with_cookie = {**here, "cookie": cookie.split(";")[0]}
    assert ask(access, headers=with_cookie).text == "in"
    assert ask(access, headers={**here, "authorization": f"Bearer {TOKEN}"}).text == "in"
    assert shake(access, here) == "websocket.close" and shake(access, with_cookie) == "websocket.accept"
    assert shake(access, {**with_cookie, "origin": "http://evil.example"}) == "websocket.close"
    assert ask(access, headers={**with_cookie, "host": "evil.example"}).status_code == 400


def test_the_token_address_leads_nowhere_else() -> None:
    access = Access.of("0.0.0.0", TOKEN)
    for path in ("//evil.example/x", "/%0d%0aset-cookie:x=1", "/\\evil.example"):
        answer = ask(access, f"{path}?token={TOKEN}", headers={"host": "10.0.0.1"})
        location = answer.headers["location"]
        assert location.startswith("/") and not location.startswith(("//", "/\\")) and "\n" not in location


def test_a_token_is_made_for_every_address_but_loopback() -> None:
    assert (
        Access.of("127.0.0.1").token is None and Access.of("localhost").token is None and Access.of("::1").token is None
    )
    assert len(Access.of("0.0.0.0").token or "") >= 32 and Access.of("0.0.0.0").token != Access.of("0.0.0.0").token
    assert Access.of("studio.local").knows_host("studio.local:8750") and not is_loopback("studio.local")
    with pytest.raises(ValueError, match="--host"):
        Access.of("http://x")


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    (tmp_path / "shared").mkdir()
    (tmp_path / "secret.ply").write_bytes(b"ply\n")
    limits = UploadLimits(upload=200_000, picture=100_000, total=400_000, gaussians=1000)
    with live(make_studio(tmp_path, shared=tmp_path / "shared", limits=limits)) as served:
        yield served


def test_the_real_server_refuses_foreign_pages(studio: Live) -> None:
    assert studio.http.get("/api/state", headers={"origin": "http://evil.example"}).status_code == 403
    assert studio.http.post("/api/do/undo", headers={"origin": "http://evil.example"}).status_code == 403
    assert studio.http.get("/api/state", headers={"host": "evil.example"}).status_code == 400
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(studio.url.replace("http", "ws") + "/ws", origin=Origin("http://evil.example")),
    ):
        pass
    assert refused.value.response.status_code == 403
    assert studio.http.get("/").headers["content-security-policy"] == CSP


@pytest.mark.parametrize(
    "name",
    ["../secret.ply", "/etc/passwd", "..", ".hidden.ply", "a/b.ply", "a\\b.ply", "C:x.ply", "x\0.ply", "link.ply"],
)
def test_names_do_not_leave_the_folder(studio: Live, tmp_path: Path, name: str) -> None:
    if name == "link.ply" and sys.platform == "win32":
        pytest.skip("needs links")
    if name == "link.ply":
        (tmp_path / "shared" / "link.ply").symlink_to(tmp_path / "secret.ply")
    answer = studio.http.post("/api/do/asset.open", json={"file": name})
    assert answer.status_code == 400 and answer.json()["error"]["kind"] == "input"
    with pytest.raises(ValueError):
        Folder(tmp_path / "shared").file(name)
    if name != "link.ply":  # a project of that name gets its own ending
        assert studio.http.post("/api/do/project.save_as", json={"file": name}).status_code == 400
    camera = view().to_json()
    body = f'{{"camera": {camera}, "to": "folder", "name": "../out"}}'
    assert studio.http.post("/api/do/view.export", content=body).status_code == 400
    assert not (tmp_path / "out.png").exists()


@pytest.mark.parametrize(
    "path", ["/api/blobs/..%2f..%2fetc%2fpasswd", "/api/files/x/..%2fpasswd", "/..%2f..%2fapp.py", "/%2e%2e/app.py"]
)
def test_addresses_do_not_leave_the_page(studio: Live, path: str) -> None:
    assert studio.http.get(path).status_code == 404


def bomb(size: int) -> bytes:
    """A PNG of size x size pixels in a few kilobytes at most: only the header is honest work."""
    file = io.BytesIO()
    Image.new("1", (16, 16)).save(file, "PNG")
    data = bytearray(file.getvalue())
    data[16:24] = struct.pack(">II", size, size)
    data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    return bytes(data)


def spz_of(count: int) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, count, 0, 12, 0, 0))


def sog_of(count: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("meta.json", f'{{"version": 2, "count": {count}}}')
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("page.html", b"<html><script>alert(1)</script></html>", "expected a picture"),
        ("page.svg", b'<svg xmlns="http://www.w3.org/2000/svg"/>', "expected a picture"),
        ("page.png", b"<html>", "expected a picture"),
        ("a.gif", b"GIF89a" + b"\0" * 40, "expected a picture"),
        ("empty.png", b"", "is empty"),
        ("bomb.png", bomb(60_000), "megapixels"),
        (
            "bomb.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nend_header\n",
            "Gaussians",
        ),
        ("bomb.spz", spz_of(2_000_000_000), "Gaussians"),
        ("bomb.sog", sog_of(2_000_000_000), "Gaussians"),
        ("bomb.splat", b"\1" * 32 * 1001, "Gaussians"),
        ("long.splat", b"\0" * 200_001, "MiB"),
        ("large.png", bomb(10) + b"\0" * 150_000, "MiB"),
    ],
)
def test_uploads_are_judged_before_they_are_decoded(studio: Live, name: str, data: bytes, reason: str) -> None:
    answer = studio.http.post(f"/api/blobs?name={name}", content=data)
    assert answer.status_code == (413 if reason == "MiB" else 400) and reason in str(answer.json()["error"]), (
        answer.text
    )
    assert studio.studio.blobs.size == 0


def test_what_is_kept_is_bounded(tmp_path: Path) -> None:
    store = Blobs(UploadLimits(upload=4000, total=10_000))
    try:
        stored = [store.put(bytes([k]) * 3200, f"{k}.splat") for k in range(6)]
        assert store.size <= 10_000 and store.get(stored[-1].sha256).size == 3200
        assert sum(blob.path.exists() for blob in stored) == 3
        with pytest.raises(ValueError, match="send it again"):
            store.get(stored[0].sha256)
        with pytest.raises(ValueError, match="expected a picture, got an asset"):
            store.get(stored[-1].sha256, "picture")
    finally:
        folder = stored[-1].path.parent
        store.close()
    assert not folder.exists()


def test_only_pictures_are_served_as_what_they_are(studio: Live) -> None:
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "PNG")
    sent = studio.http.post("/api/blobs?name=<script>.png", content=file.getvalue()).json()
    actual = studio.http.get(f"/api/blobs/{sent['blob']}")
    assert actual.headers["content-type"] == "image/png" and actual.content == file.getvalue()
    stored = studio.http.post("/api/blobs?name=x.splat", content=b"\1" * 320).json()
    actual = studio.http.get(f"/api/blobs/{stored['blob']}")
    assert actual.headers["content-type"] == "application/octet-stream"
    assert actual.headers["content-disposition"] == "attachment"
    assert actual.headers["x-content-type-options"] == "nosniff"


def test_bodies_are_bounded_also_without_a_declared_length() -> None:
    async def run(content: Any, path: str = "/") -> int:
        transport = httpx.ASGITransport(BodyLimit(inner, {"/": 1000}.get))
        async with httpx.AsyncClient(transport=transport, base_url="http://x") as client:
            return (await client.post(path, content=content)).status_code

    async def pieces() -> Any:
        for _ in range(20):
            yield b"x" * 100

    assert asyncio.run(run(b"x" * 1000)) == 200 and asyncio.run(run(b"x" * 1001)) == 413
    assert asyncio.run(run(pieces())) == 413 and asyncio.run(run(pieces(), "/free")) == 200


def test_a_huge_message_ends_the_connection_and_not_the_server(studio: Live) -> None:
    from websockets.exceptions import ConnectionClosed

    with studio.browser() as browser, pytest.raises(ConnectionClosed):
        browser.socket.send("x" * 40_000_000)
        browser.receive()
    assert studio.http.get("/api/state").status_code == 200
