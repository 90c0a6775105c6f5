"""Scripts of messages for the studio's application, in this process and without a network: commands made from the
protocol's own schema, bent ones, broken text, binary frames, uploads of bent files, and requests of every kind.

Each script gets a studio of its own. Values that only the server knows (ids of layers, strokes, uploads) stand in a
script as "$layer", "$stroke", "$blob" and are filled in from its answers.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
import random
import shutil
from pathlib import Path
from typing import Any

from splatpainter.kernels import library
from splatpainter.server.app import create_app
from splatpainter.server.client import protocol_hash
from splatpainter.server.commands import COMMANDS
from splatpainter.server.protocol import MAX_VIEW_PIXELS
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.session import Session
from tests.support.session_scenes import FlatPainter

from .mutations import FLOATS, INTEGERS, TEXTS, bend_json, json_bytes, maybe
from .packed_targets import GlbTarget, KsplatTarget, SplatTarget, SpzTarget
from .picture_target import PictureTarget
from .ply_targets import CompressedPlyTarget, PlyTarget
from .project_target import ProjectTarget, camera, sheet
from .sog_targets import SogTarget
from .target import LONGEST_MESSAGE, Fault, Target, Verdict

MESSAGES = 24
"""Of one script."""
PATIENCE = 20.0
"""Seconds that an answer may take."""
SMALL = 48
"""Pixels of the side of a view that is really drawn."""
ALLOWED = {400, 401, 403, 404, 405, 409, 413, 415, 422, 503}
"""HTTP refusals. Not among them: 500."""
READERS = (PlyTarget, CompressedPlyTarget, SplatTarget, KsplatTarget, SpzTarget, GlbTarget, SogTarget, PictureTarget)


class StudioTarget(Target):
    """A script; `inputs` of the summary are scripts, `opened` and `refused` are messages."""

    name = "studio"
    memory_limit = 1 << 30
    seconds_limit = 20.0

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        logging.getLogger("splatpainter.server").addHandler(logging.NullHandler())
        logging.getLogger("splatpainter.server").propagate = False
        for kind in (*READERS, ProjectTarget):
            (folder / kind.__name__).mkdir()
        self.files: list[Target] = [kind(folder / kind.__name__) for kind in (*READERS, ProjectTarget)]
        self.schemas = {name: kind.model_json_schema() for name, kind in COMMANDS.items()}
        self.camera = json.loads(camera(24).to_json())

    def warm_up(self) -> None:
        library.current()

    # ---- making scripts

    def make(self, rng: random.Random) -> dict[str, bytes]:
        hello = {"ws": {"id": 1, "do": "hello", "schema_hash": "$hash", "page": "01234567" * 4}}
        script: list[dict[str, Any]] = [hello] if maybe(rng, 0.95) else []
        uploads = {}
        for number in range(2, MESSAGES):
            kind = rng.randrange(20)
            if kind < 12:
                script.append({"ws": self._command(rng, number)})
            elif kind == 12:
                script.append({"text": self._broken(rng, number)})
            elif kind == 13:
                script.append({"bytes": base64.b64encode(rng.randbytes(rng.choice((0, 1, 32, 5000)))).decode()})
            elif kind < 17:
                target = rng.choice(self.files)
                (name, data), *_ = target.make(rng).items() if maybe(rng, 0.9) else [("a.cube", bent_cube(rng))]
                if len(data) > 1 << 20:
                    continue
                uploads[f"{number}-{name}"] = data
                script.append({"upload": f"{number}-{name}", "name": rng.choice((name, name, name, *TEXTS))})
                script.append({"ws": self._use_of_upload(rng, number + 1000, name)})
            else:
                script.append({"http": self._request(rng, number)})
        return {"script.json": json.dumps(script).encode(), **uploads}

    def _use_of_upload(self, rng: random.Random, number: int, name: str) -> dict[str, Any]:
        do = "project.open" if name.endswith(".splatproj") else "asset.open" if "png" not in name else "picture.check"
        do = do if do in COMMANDS else rng.choice([*COMMANDS])
        if name.endswith(".cube"):
            transfer = {"kind": "lut", "file": "$blob", "strength": rng.choice((1, 0.5, *FLOATS))}
            return {"id": number, "do": rng.choice(("look.preview", "look.commit")), "transfer": transfer}
        command = self._command(rng, number, do)
        for key in ("blob", "picture"):
            if key in self.schemas[do].get("properties", {}):
                for other in ("file", "recent", "demo"):
                    command.pop(other, None)
                command[key] = "$blob"
        return command

    def _command(self, rng: random.Random, number: int, do: str | None = None) -> dict[str, Any]:
        do = do or rng.choice([*COMMANDS])
        schema = self.schemas[do]
        fields = {}
        for key, part in schema.get("properties", {}).items():
            if key in schema.get("required", ()) or maybe(rng, 0.5):
                fields[key] = self._value(rng, key, part, schema)
        if do == "paint.dab":
            side = rng.randrange(1, 8)
            fields |= {"width": side, "height": side, "x": rng.randrange(20), "y": rng.randrange(20)}
            fields["rgba"] = base64.b64encode(rng.randbytes(4 * side * side)).decode()
        if maybe(rng, 0.35):
            fields = bend_json(rng, fields, ("$layer", "$stroke", "$blob", self.camera))
        fields = fields if isinstance(fields, dict) else {"value": fields}
        return {"id": number if maybe(rng, 0.97) else rng.choice((*INTEGERS, "1", None)), "do": do, **tamed(fields)}

    def _value(self, rng: random.Random, key: str, part: dict[str, Any], schema: dict[str, Any]) -> Any:
        if key == "camera" or "Camera" in str(part.get("$ref")):
            made = json.loads(json.dumps(self.camera))
            return bend_json(rng, made) if maybe(rng, 0.2) else made
        if key in ("layer", "lower", "upper", "stroke", "blob", "picture", "mask", "bookmark"):
            return {"lower": "$layer", "upper": "$layer", "picture": "$blob", "mask": "$blob"}.get(key, f"${key}")
        if key == "layers":
            return ["$layer", "$layer"]
        if key == "schema_hash":
            return "$hash"
        if key == "file":
            return rng.choice(("$blob", "a", "b.ply", *TEXTS))
        if key == "source":
            return rng.choice(("upscale", "upscale", "command", *TEXTS))
        if "$ref" in part:
            return self._value(rng, "", schema["$defs"][part["$ref"].rsplit("/", 1)[1]], schema)
        if "const" in part:
            return part["const"]
        if "enum" in part:
            return rng.choice(part["enum"])
        if "anyOf" in part:
            return self._value(rng, key, rng.choice(part["anyOf"]), schema)
        kind = part.get("type")
        if kind == "array":
            if "prefixItems" in part:
                return [self._value(rng, "", one, schema) for one in part["prefixItems"]]
            count = max(part.get("minItems", 0), rng.randrange(4))
            return [self._value(rng, "", part.get("items", {}), schema) for _ in range(count)]
        if kind == "object":
            names = part.get("properties", {})
            return {name: self._value(rng, name, one, schema) for name, one in names.items() if maybe(rng, 0.7)}
        if kind == "integer":
            return max(part.get("minimum", -5), min(part.get("maximum", 40), rng.randrange(-2, 40)))
        if kind == "number":
            low, high = part.get("minimum", -2.0), part.get("maximum", 2.0)
            return rng.choice((low, high, rng.uniform(low, high), 0.0, 1.0, *FLOATS[3:9]))
        return {"boolean": maybe(rng, 0.5), "null": None}.get(
            str(kind), rng.choice(("a", "b.ply", "c.splatproj", *TEXTS))
        )

    def _broken(self, rng: random.Random, number: int) -> str:
        text = json_bytes(rng, self._command(rng, number)).decode("utf-8", "replace")
        return rng.choice((text, text[: len(text) // 2], "", "[]", "null", "1", '"a"', "[" * 50_000, "{" + text, "NaN"))

    def _request(self, rng: random.Random, number: int) -> dict[str, Any]:
        do = rng.choice([*COMMANDS, "nothing", "../state"])
        body = self._command(rng, number) if do not in COMMANDS else self._command(rng, number, do)
        body.pop("id", None)
        body.pop("do", None)
        paths = [f"/api/do/{do}"] * 4 + ["/api/state", "/api/splats", "/api/blobs/$blob", "/api/blobs/x", "/", "/api"]
        paths += ["/api/files/x/y", "/../../etc/passwd", "/%2e%2e/x", "/api/openapi.json", "/ws", "/studio.js", "/\x00"]
        query = ""
        if maybe(rng, 0.15):
            paths, view = ["/api/view.png"], json.loads(json.dumps(self.camera))
            if maybe(rng, 0.7):
                view = bend_json(rng, view)
            text = json_bytes(rng, tamed({"camera": view})["camera"]).decode("utf-8", "replace")
            query = "camera=" + "".join(f"%{byte:02x}" for byte in text.encode("utf-8", "replace"))
        headers = {"host": "localhost", "content-type": "application/json"}
        if maybe(rng, 0.15):
            odd = (
                "",
                "[::1].evil",
                "evil.example",
                "localhost:99999999",
                "1",
                "\x00",
                "chunked",
                "-1",
                "null",
                "a" * 5000,
            )
            names = (
                "host",
                "origin",
                "content-length",
                "content-type",
                "cookie",
                "authorization",
                "sec-fetch-site",
                "range",
            )
            headers[rng.choice(names)] = rng.choice(odd)
        text = json_bytes(rng, body).decode("utf-8", "replace")
        method = rng.choice(("POST", "POST", "POST", "GET", "HEAD", "PUT", "DELETE", "OPTIONS", "X"))
        path = rng.choice(paths)
        method = "GET" if query or (path.startswith("/api/blobs") and maybe(rng, 0.8)) else method
        return {"method": method, "path": path, "query": query, "headers": headers, "body": text}

    # ---- trying them

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        path = self.folder / "studio"
        shutil.rmtree(path, ignore_errors=True)
        (path / "shared").mkdir(parents=True)
        session = Session(sheet(), path / "own.splatproj", painter=FlatPainter())  # type: ignore[arg-type]
        studio = Studio(
            session, "sheet", StudioOptions(path / "shared" if rng.random() < 0.3 else None, path / "projects")
        )
        return asyncio.run(self._play(studio, json.loads(files["script.json"]), files))

    async def _play(self, studio: Studio, script: list[dict[str, Any]], files: dict[str, bytes]) -> Verdict:
        app = create_app(studio)
        verdict, pool = Verdict(), {"$hash": [protocol_hash()]}
        async with app.router.lifespan_context(app):
            socket = Socket(app)
            try:
                for entry in script:
                    entry = filled(entry, pool)
                    if "http" in entry or "upload" in entry:
                        ok = await self._http(app, entry, files, pool)
                    else:
                        if socket.over:
                            socket.check()
                            socket = Socket(app)
                        ok = await socket.send(entry, pool)
                    verdict.opened, verdict.refused = verdict.opened + ok, verdict.refused + (not ok)
                await socket.leave()
                last = Socket(app)  # the studio goes on: a fresh client is greeted and answered
                for number, do in ((1, "hello"), (2, "receipt")):
                    fields = {"schema_hash": protocol_hash(), "page": "fedcba98" * 4} if do == "hello" else {}
                    if not await last.send({"ws": {"id": number, "do": do, **fields}}, pool):
                        raise Fault(f"afterwards {do} does not work: {(last.heard or ['no answer'])[-1][:300]}")
                await last.leave()
            finally:
                await socket.leave()
        return verdict

    async def _http(self, app: Any, entry: dict[str, Any], files: dict[str, bytes], pool: dict[str, list]) -> bool:
        if "upload" in entry:
            name = "".join(f"%{byte:02x}" for byte in entry["name"].encode("utf-8", "replace"))
            request = {
                "method": "POST",
                "path": "/api/blobs",
                "query": f"name={name}",
                "headers": {"host": "localhost"},
            }
            body = files[entry["upload"]]
        else:
            request = entry["http"]
            body = request["body"].encode("utf-8", "replace")
        status, data = await http(app, request, body)
        if status >= 400 and status not in ALLOWED:
            raise Fault(f"HTTP {status} for {request['method']} {request['path'][:80]!r}: {data[:200]!r}")
        with contextlib.suppress(ValueError):
            answer = json.loads(data)
            if isinstance(answer, dict):
                learn(answer, pool)
                problem(answer, request["path"])
        return status < 400

    def close(self) -> None:
        for target in self.files:
            target.close()


class Socket:
    """One connection, as the server sees it."""

    def __init__(self, app: Any) -> None:
        self._in: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._out: asyncio.Queue[str | None] = asyncio.Queue()
        self.heard: list[str] = []
        self._in.put_nowait({"type": "websocket.connect"})
        scope = {"type": "websocket", "path": "/ws", "raw_path": b"/ws", "query_string": b"", "scheme": "ws"}
        scope |= {"headers": [(b"host", b"localhost")], "subprotocols": [], "root_path": "", "client": ("127.0.0.1", 1)}
        self._task = asyncio.create_task(app(scope, self._in.get, self._take))
        self._task.add_done_callback(lambda _: self._out.put_nowait(None))

    async def _take(self, message: Any) -> None:
        if message["type"] == "websocket.send" and message.get("text") is not None:
            await self._out.put(message["text"])

    @property
    def over(self) -> bool:
        return self._task.done()

    def check(self) -> None:
        """Raise what ended the connection, if it was not its close."""
        if self._task.done() and not self._task.cancelled() and (error := self._task.exception()) is not None:
            raise Fault(f"the connection ended with {type(error).__name__}: {str(error)[:200]}") from error

    async def send(self, entry: dict[str, Any], pool: dict[str, list]) -> bool:
        """Send a message and wait for its answer; whether that was a success. The server may close the connection."""
        if "bytes" in entry:
            message = {"type": "websocket.receive", "bytes": base64.b64decode(entry["bytes"])}
        else:
            message = {"type": "websocket.receive", "text": entry.get("text") or json.dumps(entry.get("ws"))}
        self._in.put_nowait(message)
        while True:
            try:
                # Binary frames may be answered or ignored, and so may nothing at all.
                text = await asyncio.wait_for(self._out.get(), 0.02 if "bytes" in entry else PATIENCE)
            except TimeoutError:
                if "bytes" in entry:
                    return False
                raise Fault(f"no answer to {str(entry)[:300]}") from None
            if text is None:
                self.check()
                return False
            self.heard.append(text)
            answer = json.loads(text)
            learn(answer, pool)
            if "ok" in answer:
                problem(answer, str(entry))
                return bool(answer["ok"])

    async def leave(self) -> None:
        self._in.put_nowait({"type": "websocket.disconnect", "code": 1000})
        done, _ = await asyncio.wait([self._task], timeout=PATIENCE)
        if not done:
            raise Fault("a connection that was closed does not end")
        self.check()


async def http(app: Any, request: dict[str, Any], body: bytes) -> tuple[int, bytes]:
    """(status, body) of one request."""
    out: list[bytes] = []
    status = [0]
    pieces = [body[k : k + 4096] for k in range(0, len(body), 4096)] or [b""]

    async def receive() -> dict[str, Any]:
        if pieces:
            piece = pieces.pop(0)
            return {"type": "http.request", "body": piece, "more_body": bool(pieces)}
        await asyncio.sleep(PATIENCE)
        return {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            status[0] = message["status"]
        elif message["type"] == "http.response.body":
            out.append(message.get("body", b""))

    headers = {**request["headers"]}
    headers.setdefault("content-length", str(len(body)))
    pairs = [(name.encode(), value.encode("latin-1", "replace")) for name, value in headers.items()]
    path = request["path"]
    scope = {"type": "http", "method": request["method"], "path": path, "raw_path": path.encode(), "scheme": "http"}
    scope |= {"query_string": request["query"].encode(), "headers": pairs, "root_path": "", "http_version": "1.1"}
    scope |= {"client": ("127.0.0.1", 1), "server": ("localhost", 80)}
    await asyncio.wait_for(app(scope, receive, send), PATIENCE)
    return status[0], b"".join(out)


def learn(answer: dict[str, Any], pool: dict[str, list]) -> None:
    """Keep the ids that an answer names."""
    for key in ("stroke", "blob", "picture", "bookmark"):
        if isinstance(answer.get(key), str):
            pool.setdefault("$blob" if key == "picture" else f"${key}", []).append(answer[key])
    if isinstance(answer.get("layer"), dict):
        pool.setdefault("$layer", []).append(answer["layer"].get("id"))
    state = answer.get("state")
    if isinstance(state, dict) and isinstance(state.get("layers"), list):
        pool["$layer"] = [layer["id"] for layer in state["layers"]] or pool.get("$layer", [])


def filled(value: Any, pool: dict[str, list]) -> Any:
    """The value with its "$..." replaced by the newest of what the server named so."""
    if isinstance(value, dict):
        return {key: filled(one, pool) for key, one in value.items()}
    if isinstance(value, list):
        return [filled(one, pool) for one in value]
    if isinstance(value, str) and value.startswith("$"):
        return pool[value][-1] if pool.get(value) else "0" * 64
    return value.replace("$blob", pool["$blob"][-1]) if isinstance(value, str) and pool.get("$blob") else value


def problem(answer: dict[str, Any], of: str) -> None:
    """Raise Fault for an answer that speaks of a fault of the program, or in more than a line."""
    error = answer.get("error")
    if not isinstance(error, dict):
        return
    if error.get("kind") == "fault":
        raise Fault(f"fault: {error.get('message')}: {of[:200]}")
    for part in (error.get("message", ""), error.get("hint", "")):
        if "\n" in part or len(part) > LONGEST_MESSAGE:
            raise Fault(f"a message that is not one short line: {part[:200]!r} for {of[:200]}")


def bent_cube(rng: random.Random) -> bytes:
    """A LUT of two entries along each axis, mostly with something wrong in it."""
    size = rng.choice((2, 2, 2, 3, 0, -1, 10**12))
    words = rng.choice(("LUT_3D_SIZE", "LUT_3D_SIZE", "LUT_1D_SIZE", "DOMAIN_MIN", *TEXTS))
    rows = [
        " ".join(str(rng.choice((0, 1, 0.5, *FLOATS))) for _ in range(3)) for _ in range(rng.choice((8, 8, 8, 2, 9)))
    ]
    return f"{words} {size}\n{chr(10).join(rows)}\n".encode("utf-8", "replace")


def tamed(fields: dict[str, Any]) -> dict[str, Any]:
    """Views that would be drawn are small, and turntables short: those are correct commands that only take long."""
    several = fields.get("views")
    for view in (fields.get("camera"), *(several if isinstance(several, list) else ())):
        view = view.get("camera", view) if isinstance(view, dict) else None
        if isinstance(view, dict):
            width, height = view.get("width"), view.get("height")
            if type(width) is int and type(height) is int and SMALL**2 < width * height <= MAX_VIEW_PIXELS:
                view["width"] = view["height"] = SMALL
    for key in ("frames", "size", "width"):
        if type(fields.get(key)) is int and fields[key] > SMALL and key != "width":
            fields[key] = 4
    if type(fields.get("seconds")) in (int, float) and fields["seconds"] > 1:
        fields["seconds"] = 0.2
    return fields


TARGETS = {"studio": StudioTarget}
