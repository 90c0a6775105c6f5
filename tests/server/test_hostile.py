"""The studio against hostile uploads, messages and connections: refused in one line, and everybody else is served."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import socket
import sqlite3
import struct
import sys
import threading
import time
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from pydantic import ValidationError
from websockets.exceptions import ConnectionClosed

from splatpainter.io import write
from splatpainter.server.client import MAX_UNSENT_MESSAGES, Client
from splatpainter.server.hub import Hub
from splatpainter.server.launch import listen, make_server
from splatpainter.server.limits import MAX_COMMAND_BYTES, MAX_JSON_SEPARATORS, ConnectionLimits
from splatpainter.server.protocol import Answer, Hello, first_fault
from splatpainter.server.security import Access
from splatpainter.server.uploads import watched_folder
from splatpainter.server.uploads.storage import Blobs, Folder, UploadLimits
from splatpainter.session import Session
from tests.support.studio_scenes import Live, ball, make_studio, view, wire

SHORT = ConnectionLimits(
    connections=256, head_seconds=0.6, body_seconds=0.6, body_bytes=64, send_seconds=0.6, check_seconds=0.1
)
PATIENCE = 20.0
"""Seconds after which a test gives up; what is waited for takes one."""


@contextlib.contextmanager
def serving(folder: Path, limits: ConnectionLimits = SHORT, **how) -> Iterator[Live]:
    import httpx

    (folder / "shared").mkdir(exist_ok=True)
    bound = listen("127.0.0.1", 0)
    hosted = make_studio(folder, shared=folder / "shared", **how)
    server = make_server(hosted, Access(), limits)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
    thread.start()
    url = f"http://127.0.0.1:{bound.getsockname()[1]}"
    try:
        with httpx.Client(base_url=url, timeout=60, verify=False) as client:
            yield Live(hosted, url, client)
    finally:
        server.should_exit = True
        thread.join(60)
        assert not thread.is_alive()


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with serving(tmp_path, ConnectionLimits()) as served:
        yield served


def raw(studio: Live, data: bytes = b"") -> socket.socket:
    port = int(studio.url.rpartition(":")[2])
    connection = socket.create_connection(("127.0.0.1", port), PATIENCE)
    connection.sendall(data)
    return connection


def ended(connection: socket.socket) -> bytes:
    """What is read until the other side closes."""
    out = b""
    with connection, contextlib.suppress(ConnectionResetError):
        while piece := connection.recv(65536):
            out += piece
    return out


# Uploads


def glb(text: bytes) -> bytes:
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


def bundle(meta: bytes, how: int = zipfile.ZIP_STORED, name: str = "meta.json") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", how) as archive:
        archive.writestr(name, meta)
    return file.getvalue()


def long_directory() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for k in range(300):
            archive.writestr(f"{k}".ljust(20_000, "x"), b"")
    return file.getvalue()


HOSTILE = {
    "list.glb": glb(b"[]"),
    "text.glb": glb(b'"x"'),
    "accessors.glb": glb(b'{"accessors": 7}'),
    "entries.glb": glb(b'{"accessors": [7]}'),
    "infinite.glb": glb(b'{"accessors": [{"count": 1e999}]}'),
    "negative.glb": glb(b'{"accessors": [{"count": -5}]}'),
    "deep.glb": glb(b"[" * 200_000),
    "deep2.glb": glb(b'{"a":' * 200_000),
    "short.glb": glb(b"{}")[:19],
    "cut.glb": glb(b"{}" + b" " * 100)[:-50],
    "bytes.glb": glb(b"\xff\xfe"),
    "list.sog": bundle(b"[]"),
    "null.sog": bundle(b"null"),
    "infinite.sog": bundle(b'{"version": 2, "count": 1e999}'),
    "none.sog": bundle(b'{"version": 2, "count": null}'),
    "deep.sog": bundle(b"[" * 200_000),
    "other.sog": bundle(b"{}", name="x.json"),
    "unnamed.sog": bundle(b"{}", name="abc").replace(b"abc", b"\0bc"),
    "bzip2.sog": bundle(b'{"version": 2, "count": 1}' + b" " * (1 << 20), zipfile.ZIP_BZIP2),
    "lzma.sog": bundle(b'{"version": 2, "count": 1}' + b" " * (1 << 20), zipfile.ZIP_LZMA),
    "long.sog": bundle(b'{"version": 2, "count": 1}' + b" " * (17 << 20), zipfile.ZIP_DEFLATED),
    "directory.sog": long_directory(),
    "cut.sog": bundle(b"{}")[:-10],
    "short.spz": b"\x1f\x8b\x08",
    "short.ksplat": b"\0" * 10,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_malformed_uploads_are_one_line(tmp_path: Path, name: str) -> None:
    store = Blobs(UploadLimits())
    try:
        with pytest.raises(ValueError) as error:
            store.put(HOSTILE[name], name)
        text = str(error.value)
        assert text.startswith(f"{name}: ") and "\n" not in text and str(store.folder) not in text and len(text) < 400
        assert store.size == 0 and not list(store.folder.glob("*.part"))
    finally:
        store.close()


def test_uploads_over_http_are_400_or_413_and_never_500(tmp_path: Path) -> None:
    with serving(tmp_path, limits=ConnectionLimits(), **{}) as studio:
        for name in ("list.glb", "deep.glb", "infinite.sog", "lzma.sog", "unnamed.sog"):
            answer = studio.http.post(f"/api/blobs?name={name}", content=HOSTILE[name])
            error = answer.json()["error"]
            assert answer.status_code == 400 and error["kind"] == "input" and error["message"].startswith(name)
        studio.studio.blobs.limits = replace(studio.studio.blobs.limits, upload=1000)
        for content in (b"x" * 1001, iter([b"x" * 600] * 3)):  # declared, and not
            answer = studio.http.post("/api/blobs?name=a.splat", content=content)
            assert answer.status_code == 413 and "MiB" in answer.json()["error"]["message"]
        assert studio.studio.blobs.size == 0 and not list(studio.studio.blobs.folder.glob("*.part"))


def test_a_full_disk_is_said_of_the_upload(studio: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full(io.BytesIO):
        def write(self, data) -> int:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("splatpainter.server.uploads.storage.open", lambda *_: Full(), raising=False)
    answer = studio.http.post("/api/blobs?name=a.splat", content=b"\1" * 320)
    assert answer.json()["error"]["message"] == "a.splat: cannot be kept (No space left on device)"


def project_of(tmp_path: Path, where: str) -> bytes:
    """A project that names a file as its original."""
    ply, path = tmp_path / "source.ply", tmp_path / "source.splatproj"
    write(ply, ball(50), overwrite=True)
    Session(ply, path, embed=False, overwrite=True).close()
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("UPDATE facts SET value = ? WHERE name = 'path'", (where,))
    connection.close()
    return path.read_bytes()


def test_an_uploaded_project_opens_no_file_of_the_machine(studio: Live, tmp_path: Path) -> None:
    before = studio.studio.session
    reply = set()
    for where in (tmp_path / "source.ply", tmp_path / "missing.ply", "/dev/zero"):
        blob = studio.send(project_of(tmp_path, str(where)), "theirs.splatproj")
        answer = studio.http.post("/api/do/project.open", json={"blob": blob})
        assert answer.status_code == 400
        reply.add(json.dumps(answer.json()))
    assert len(reply) == 1 and "theirs.splatproj: names a file" in reply.pop()
    assert studio.studio.session is before and not list(studio.studio.projects.root.iterdir())
    (tmp_path / "shared" / "named.splatproj").write_bytes(project_of(tmp_path, str(tmp_path / "source.ply")))
    answer = studio.http.post("/api/do/project.open", json={"file": "named.splatproj"})
    message = answer.json()["error"]["message"]
    assert "outside the folder shared" in message and str(tmp_path) not in message
    assert studio.post("undo")["ok"]


def test_a_project_that_does_not_open_leaves_nothing(studio: Live, tmp_path: Path) -> None:
    write(tmp_path / "x.ply", ball(50))
    Session(tmp_path / "x.ply", tmp_path / "x.splatproj").close()
    connection = sqlite3.connect(tmp_path / "x.splatproj", isolation_level=None)
    connection.execute("UPDATE original SET bytes = x'00'")
    connection.close()
    blob = studio.send((tmp_path / "x.splatproj").read_bytes(), "x.splatproj")
    error = studio.http.post("/api/do/project.open", json={"blob": blob}).json()["error"]
    assert error["kind"] == "input" and error["message"].startswith("x.splatproj: ")
    assert "splatpainter-" not in error["message"] and str(tmp_path) not in error["message"]
    assert not list(studio.studio.projects.root.iterdir())


def test_what_cannot_be_told_to_clients_does_not_replace_what_is_open(studio: Live, tmp_path: Path) -> None:
    write(tmp_path / "x.ply", ball(50))
    with Session(tmp_path / "x.ply", tmp_path / "shared" / "x.splatproj") as session:
        session.bookmarks.add("front", view())
    connection = sqlite3.connect(tmp_path / "shared" / "x.splatproj", isolation_level=None)
    connection.execute("UPDATE bookmarks SET camera = json_set(camera, '$.width', 100000)")
    connection.close()
    before = studio.studio.session
    error = studio.http.post("/api/do/project.open", json={"file": "x.splatproj"}).json()["error"]
    assert error["kind"] == "input" and "damaged" in error["message"] and "\n" not in error["message"]
    assert studio.studio.session is before and studio.post("undo")["ok"]
    assert not (tmp_path / "shared" / "x.splatproj-lock").exists()


# Messages


def test_commands_have_small_bodies(studio: Live) -> None:
    large = {"layer": "1", "name": "x" * MAX_COMMAND_BYTES}
    assert studio.http.post("/api/do/layer.set", json=large).status_code == 413
    pieces = iter([b"x" * 65536] * 10)  # not declared
    assert studio.http.post("/api/do/undo", content=pieces).status_code == 413
    many = b'{"stroke": "s", "rgba": [' + b"0," * 10_000_000 + b"0]}"
    other = []
    done = threading.Event()

    def ask() -> None:
        while not done.wait(0.02):
            start = time.monotonic()
            studio.http.get("/api/version")
            other.append(time.monotonic() - start)

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        answer = studio.http.post("/api/do/paint.dab", content=many, headers={"content-type": "application/json"})
    finally:
        done.set()
        asking.join()
    assert answer.status_code == 400 and f"at most {MAX_JSON_SEPARATORS} values" in answer.json()["error"]["message"]
    assert max(other) < 5  # it took all of 28 seconds


@pytest.mark.parametrize("body", [b"[" * 50_000, b'{"to": 1' + b"0" * 5000 + b"}", b"{", b"\xff", b'"\\ud800"'])
def test_odd_json_is_one_line(studio: Live, body: bytes) -> None:
    answer = studio.http.post("/api/do/layer.move", content=body, headers={"content-type": "application/json"})
    message = answer.json()["error"]["message"]
    assert answer.status_code == 400 and message.startswith("/api/do/layer.move: ") and "\n" not in message


def test_sockets_take_no_large_commands_either(studio: Live) -> None:
    with studio.greeted() as browser:
        for text in (
            json.dumps({"id": 7, "do": "layer.set", "layer": "1", "name": "x" * MAX_COMMAND_BYTES}),
            json.dumps({"id": 7, "do": "paint.dab", "rgba": [0] * MAX_JSON_SEPARATORS}),
            "[" * 10_000,
            json.dumps({"id": 10**400, "do": "undo"}),
            json.dumps({"id": True, "do": "undo"}),
        ):
            browser.socket.send(text)
            reply = json.loads(browser.socket.recv(PATIENCE))
            while reply.get("ok") is not False:
                reply = json.loads(browser.socket.recv(PATIENCE))
            assert reply["error"]["kind"] == "input" and "expected" in reply["error"]["message"]
        assert browser.do("undo")["ok"]


def test_parameters_that_no_client_could_read_are_refused(studio: Live) -> None:
    layer = studio.post("look.commit", look={"exposure": 1.0})["layer"]["id"]
    body = json.dumps({"layer": layer, "parameters": {"look": "gain", "note": "\ud800"}})
    answer = studio.http.post("/api/do/layer.set", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 400 and studio.http.get("/api/state").status_code == 200


# Connections


def test_heads_that_come_slowly_are_not_waited_for(tmp_path: Path) -> None:
    with serving(tmp_path) as studio:
        silent, slow = raw(studio), raw(studio, b"GET / HTTP/1.1\r\n")
        end = time.monotonic() + PATIENCE
        with contextlib.suppress(OSError):
            while time.monotonic() < end:
                slow.sendall(b"x: y\r\n")
                time.sleep(0.1)
        assert time.monotonic() < end
        slow.close()
        assert ended(silent) == b""
        assert studio.http.get("/api/state").status_code == 200


def test_bodies_that_stop_are_not_waited_for(tmp_path: Path) -> None:
    with serving(tmp_path) as studio:
        head = b"POST /api/blobs?name=a.png HTTP/1.1\r\nhost: localhost\r\ncontent-length: 100000\r\n\r\nabc"
        assert ended(raw(studio, head)) == b""
        end = time.monotonic() + PATIENCE
        while list(studio.studio.blobs.folder.glob("*.part")):  # what came is dropped
            assert time.monotonic() < end
            time.sleep(0.05)
        refused = raw(studio, head.replace(b"localhost", b"evil.example"))  # answered before its body
        assert ended(refused).startswith(b"HTTP/1.1 400")


def test_downloads_that_nobody_reads_are_ended(tmp_path: Path) -> None:
    with serving(tmp_path, splats=ball(60_000)) as studio:
        connection = raw(studio)
        connection.sendall(b"GET /api/splats HTTP/1.1\r\nhost: localhost\r\n\r\n" * 4)
        time.sleep(2.5)
        full = len(studio.http.get("/api/splats").content)
        assert len(ended(connection)) < 4 * full


def test_a_socket_that_nobody_reads_is_closed(tmp_path: Path) -> None:
    with serving(tmp_path, splats=ball(60_000)) as studio:
        key = "GET /ws HTTP/1.1\r\nhost: localhost\r\nupgrade: websocket\r\nconnection: upgrade\r\n"
        connection = socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", int(studio.url.rpartition(":")[2])))
        connection.sendall(
            (key + "sec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==\r\nsec-websocket-version: 13\r\n\r\n").encode()
        )
        from splatpainter.server.schema import schema_hash

        hello = json.dumps({"id": 1, "do": "hello", "schema_hash": schema_hash()}).encode()
        connection.sendall(b"\x81\xfe" + struct.pack(">H", len(hello)) + b"\0\0\0\0" + hello)
        clients = studio.http.get("/api/state").json()["clients"]
        end = time.monotonic() + PATIENCE
        while clients != 0 and time.monotonic() < end:
            time.sleep(0.2)
            clients = studio.http.get("/api/state").json()["clients"]
        assert clients == 0
        connection.close()


def test_patient_clients_stay(tmp_path: Path) -> None:
    with serving(tmp_path) as studio, studio.greeted() as browser:
        time.sleep(1.5)
        assert browser.do("undo")["ok"]


def test_there_are_never_more_than_so_many_connections(tmp_path: Path) -> None:
    with serving(tmp_path, replace(SHORT, connections=4, head_seconds=60)) as studio:
        held = [raw(studio) for _ in range(4)]
        time.sleep(0.3)
        assert ended(raw(studio)).startswith(b"HTTP/1.1 503")
        for connection in held:
            connection.close()
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            with contextlib.suppress(Exception):
                if studio.http.get("/api/state").status_code == 200:
                    break
        assert time.monotonic() < end


def test_a_client_for_whom_too_much_waits_is_let_go(tmp_path: Path) -> None:
    hosted = make_studio(tmp_path)

    async def run() -> None:
        client = Client(Hub(hosted), None)  # type: ignore[arg-type]
        for number in range(MAX_UNSENT_MESSAGES):
            client.send(Answer(re=number))
        assert not client.overrun.is_set()
        client.send(Answer(re=0))
        assert client.overrun.is_set() and not client._unsent

    asyncio.run(run())
    hosted.close()


# The folder


def test_odd_files_are_toasts_and_the_watch_goes_on(tmp_path: Path) -> None:
    hosted = make_studio(tmp_path, shared=_made(tmp_path / "shared"))
    hub, toasts = Hub(hosted), []
    hub.publish = toasts.append  # type: ignore[method-assign]
    shared = tmp_path / "shared"
    (shared / "folder.png").mkdir()
    (shared / "half.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (shared / "page.png").write_bytes(b"<html>")
    names = ["folder.png", "half.png", "page.png", "gone.png", ".hidden.png", "rows.ply"]
    expected = {"folder.png": "a pipe or a device", "half.png": "expected a picture", "page.png": "expected a picture"}
    if sys.platform != "win32":
        os.mkfifo(shared / "pipe.png")
        names.append("pipe.png")
        expected["pipe.png"] = "a pipe or a device"
    with contextlib.suppress(OSError):
        (shared / "round.png").symlink_to(shared / "round.png")
        names.append("round.png")
        expected["round.png"] = "cannot be read"
    for name in names:
        asyncio.run(watched_folder.offer(hub, name))
    assert [toast.event for toast in toasts] == ["toast"] * len(expected)
    for toast, (name, why) in zip(toasts, expected.items(), strict=True):
        assert toast.message.startswith(f"{name}: ") and why in toast.message and str(tmp_path) not in toast.message

    def broken(studio, name):
        raise RuntimeError("anything")

    toasts.clear()
    (shared / "odd\udcff.png" if os.name == "posix" else shared / "odd.png").write_bytes(b"x")
    name = next(entry for entry in os.listdir(shared) if entry.startswith("odd"))
    asyncio.run(watched_folder.offer(hub, name, broken))
    assert len(toasts) == 1 and toasts[0].model_dump_json()
    hub.close()


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def test_a_watch_that_fails_is_begun_again_and_shutdown_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def failing(folder):
        begun.append(1)
        raise RuntimeError("no such folder any more")

    monkeypatch.setattr(watched_folder, "SavedPictures", failing)
    hosted = make_studio(tmp_path, shared=_made(tmp_path / "shared"))

    async def run() -> None:
        task = asyncio.create_task(watched_folder.watch(Hub(hosted), 0.01))
        while len(begun) < 3:
            await asyncio.sleep(0.01)
        assert not task.done()
        task.cancel()
        await asyncio.wait([task])

    asyncio.run(asyncio.wait_for(run(), PATIENCE))
    hosted.close()


def test_shutdown_ends_whatever_the_watch_did(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def broken(hub) -> None:
        raise RuntimeError("anything")

    monkeypatch.setattr(watched_folder, "watch", broken)
    with serving(tmp_path) as studio:
        assert studio.http.get("/api/state").status_code == 200
    Session.load(tmp_path / "own.splatproj", readonly=False).close()  # it was closed


# Read only, left-overs


def test_a_read_only_project_says_why(studio: Live, tmp_path: Path) -> None:
    write(tmp_path / "x.ply", ball(50))
    path = tmp_path / "shared" / "x.splatproj"
    with Session(tmp_path / "x.ply", path):
        studio.post("project.open", file="x.splatproj")
        project = studio.http.get("/api/state").json()["project"]
        assert project["read_only"] and project["read_only_reason"].startswith("open elsewhere")
        error = studio.http.post("/api/do/look.commit", json={"look": {"exposure": 1.0}}).json()["error"]
        assert "open elsewhere" in error["message"]


def test_the_next_studio_sweeps_what_a_killed_one_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    temporary = _made(tmp_path / "temporary")
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    shared = _made(tmp_path / "shared")
    first = make_studio(tmp_path, shared=shared)
    killed = list(temporary.iterdir())
    first.blobs._scratch._lock._connection.close()  # type: ignore[union-attr]
    first.scratch._lock._connection.close()  # type: ignore[union-attr]
    first.session._core.project._db.close()
    first.session._core.project._lock._connection.close()  # type: ignore[union-attr]
    (shared / ".x.splatproj.part").write_bytes(b"")
    (tmp_path / "own.splatproj").rename(tmp_path / "first.splatproj")
    second = make_studio(tmp_path, shared=shared)
    try:
        assert killed and not any(folder.exists() for folder in killed) and not list(shared.iterdir())
    finally:
        second.close()
    assert not list(temporary.iterdir())


def test_a_closed_connection_is_the_end_of_its_socket(studio: Live) -> None:
    with studio.greeted() as browser:
        browser.socket.close()
        with pytest.raises(ConnectionClosed):
            browser.socket.send("x")
    assert studio.http.post("/api/do/pick", json={"camera": wire(view()), "x": 1, "y": 1}).status_code == 200


def test_names_of_fields_are_told_in_one_line() -> None:
    with pytest.raises(ValidationError) as caught:
        Hello.model_validate({"id": 1, "do": "hello", "schema_hash": "0", "\n" * 300: 1})
    line = first_fault(caught.value, "hello")
    assert "\n" not in line and len(line) < 200 and "not permitted" in line


@pytest.mark.parametrize("name", ["x" * 300 + ".json", "\u00e9" * 150])
def test_names_that_no_folder_can_hold_are_refused(tmp_path: Path, name: str) -> None:
    for new in (False, True):
        with pytest.raises(ValueError, match="at most 255 bytes") as caught:
            Folder(tmp_path).file(name, new=new)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 150
