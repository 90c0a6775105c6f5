"""The studio as an ASGI application: HTTP, socket, the page. `create_app(studio)`; launch.py runs it.

HTTP has the same commands as the socket (POST /api/do/NAME, described in /api/openapi.json), uploads, and downloads.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import mimetypes
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

from fastapi import APIRouter, FastAPI, Query, Request, WebSocket
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from pydantic import ValidationError
from starlette.requests import ClientDisconnect
from starlette.routing import BaseRoute

from splatpainter._version import __version__
from splatpainter.server import frames, lock_watch
from splatpainter.server.batches.batch_routes import add_batch_routes, publish_batches
from splatpainter.server.client import serve
from splatpainter.server.commands import COMMANDS
from splatpainter.server.commands.context import CommandContext
from splatpainter.server.commands.viewing import ViewRender, render_view
from splatpainter.server.hub import CommandError, Hub, log, problem_of
from splatpainter.server.limits import BadBody, BodyLimit, CommandRoute, body_limit
from splatpainter.server.packed_files import STATIC
from splatpainter.server.page_files import PageFiles
from splatpainter.server.page_state import PageState
from splatpainter.server.protocol import Cancel, Command, Failure, Hello, Problem, State, Sync, first_fault
from splatpainter.server.schema import schema_hash
from splatpainter.server.security import Access, AccessGuard
from splatpainter.server.studio import Studio
from splatpainter.server.uploads import watched_folder
from splatpainter.server.uploads.storage import TooLarge
from splatpainter.server.work_queue import Ticket

PAGE_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
"""File ending -> its content type: browsers do not guess (x-content-type-options)."""
STATUS = {
    "input": 400,
    "cancelled": 409,
    "busy": 503,
    "schema": 409,
    "storage": 507,
    "project": 409,
    "fault": 500,
}
SOCKET_ONLY: tuple[type[Command], ...] = (Hello, Sync, Cancel)
NO_STORE = {"cache-control": "no-store"}
FOREVER = {"cache-control": "private, max-age=31536000, immutable"}
UNBUILT = "The studio's page is not built: run npm ci && npm run build in web/. The API works without it."


def create_app(studio: Studio, access: Access | None = None) -> FastAPI:
    """The application; it closes the studio when it shuts down. access: by default of this machine only."""
    hub = Hub(studio)

    @contextlib.asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        watches = {"the watched folder": watched_folder.watch(hub), "the project's lock": lock_watch.watch(hub)}
        watching = {asyncio.create_task(watch): name for name, watch in watches.items()}
        publish_batches(hub)
        # Batches and the folder's pictures concern every page, so they are watched once, not for each connection.
        try:
            yield
        finally:
            # In this order: nothing new may arrive, long work is asked to end, and only then may the session be closed.
            for watch in watching:
                watch.cancel()
            hub.stop()
            await asyncio.wait([*watching, *hub.closing])  # whatever they end with
            for watch, name in watching.items():
                if not watch.cancelled() and watch.exception() is not None:
                    log.error(name, exc_info=watch.exception())
            await asyncio.to_thread(hub.close)

    app = FastAPI(
        title="SplatPainter studio",
        version=__version__,
        openapi_url="/api/openapi.json",
        docs_url=None,  # its page would come from another site
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.hub = hub
    _add_commands(app)
    _add_data(app, hub)
    # Exports of batches are downloads like any other, so their routes stand beside those of the commands.
    add_batch_routes(app, hub, _failed, NO_STORE)

    @app.websocket("/ws")
    async def socket(connection: WebSocket) -> None:
        await serve(hub, connection)

    # A checkout without the built page still serves the API: scripts and tests need no Node.
    if (STATIC / "index.html").is_file():
        for ending, kind in PAGE_TYPES.items():  # the registry of Windows may call scripts text/plain
            mimetypes.add_type(kind, ending)
        app.mount("/", PageFiles(STATIC))
    else:
        app.get("/", include_in_schema=False)(lambda: PlainTextResponse(UNBUILT))
    # The guard is added last and so runs first: who may not come in is refused before any byte of a body is counted.
    app.add_middleware(BodyLimit, limit=body_limit)
    app.add_middleware(AccessGuard, access=access or Access())
    return app


def _add_commands(app: FastAPI) -> None:
    # HTTP has no connection that names its page, so all its callers are one page; the lock keeps their strokes apart.
    app.state.http_page, app.state.strokes = PageState("http"), asyncio.Lock()
    app.router.routes.extend(_command_routes())

    @app.exception_handler(BadBody)
    async def unreadable(request: Request, error: BadBody) -> Response:
        if error.status_code == 413:
            raise error  # BodyLimit answers
        return _failed(Problem(kind="input", message=f"{request.url.path}: {error.detail}"))

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        # One line about the first fault, shortened: the message repeats what the client sent, which may be anything.
        fault = error.errors()[0]
        field = ".".join(str(part) for part in fault["loc"] if part != "body")
        text = f"{request.url.path}: {field}: {fault['msg']}"[:300]
        return _failed(Problem(kind="input", message=" ".join(text.encode("utf-8", "replace").decode().split())))


MeantSession = Annotated[
    str | None, Query(description="Id of the session that is meant; refused where another is open")
]


@functools.cache
def _command_routes() -> tuple[BaseRoute, ...]:
    """One route for each command, of any application: it takes a tenth of a second to describe them all."""
    router = APIRouter()

    def add(name: str, kind: type[Command]) -> None:
        async def run(request: Request, command: Any, session: Any = None) -> Response:
            state = request.app.state
            try:
                # Strokes of that one shared page wait for one another; other commands are ordered by the queue alone.
                async with state.strokes if name.startswith("paint.") else contextlib.nullcontext():
                    answer = await state.hub.execute(command, state.http_page, Ticket(), None, session)
            except CommandError as error:
                return _failed(error.problem)
            return Response(answer.model_dump_json(), media_type="application/json", headers=NO_STORE)

        # The class is known only at run time, and FastAPI reads it from the annotations; so they are set by hand.
        run.__annotations__ = {"request": Request, "command": kind, "session": MeantSession, "return": Response}
        if not any(field.is_required() for field in kind.model_fields.values()):
            run.__defaults__ = (kind(), None)  # no body is needed
        # A class without a docstring inherits the base's, which describes no command in particular.
        about = " ".join((kind.__doc__ or "").split()) if kind.__doc__ != Command.__doc__ else ""
        router.add_api_route(
            f"/api/do/{name}",
            run,
            methods=["POST"],
            summary=name,
            description=about,
            operation_id=name.replace(".", "_"),
            response_model=kind.ANSWER,
            responses={status: {"model": Failure} for status in (400, 409, 500, 503)},
            route_class_override=CommandRoute,
        )

    # What belongs to a connection (hello, sync, cancel) has no meaning in a request that stands alone.
    for name, kind in COMMANDS.items():
        if kind not in SOCKET_ONLY:
            add(name, kind)
    return tuple(router.routes)


def _add_data(app: FastAPI, hub: Hub) -> None:
    """State, Gaussians, pictures, files."""
    studio = hub.studio

    @app.get("/api/state", response_model=State, summary="State that all clients share")
    async def state() -> Response:
        now = hub.with_clients(studio.state)
        return Response(now.model_dump_json(), media_type="application/json", headers=NO_STORE)

    @app.get("/api/version", summary="Versions of the package and of the protocol")
    async def version() -> JSONResponse:
        return JSONResponse({"version": __version__, "schema": schema_hash()}, headers=NO_STORE)

    @app.get("/api/splats", response_class=Response, summary="All Gaussians as one binary frame (frames.py)")
    async def splats() -> Response:
        # Taken once: the session may go on while the frame is made, and its version must be that of its Gaussians.
        snapshot = studio.session.snapshot
        data = await asyncio.to_thread(frames.snapshot, snapshot.splats, snapshot.version)
        return Response(data, media_type="application/octet-stream", headers=NO_STORE)

    @app.get("/api/view.png", response_class=Response, summary="A render from a camera (JSON), which the PNG carries")
    async def view(camera: str, which: Literal["now", "original"] = "now") -> Response:
        # The camera comes as JSON within the address, so it is checked here by the model that the socket's command has.
        try:
            command = ViewRender.model_validate({"camera": json.loads(camera), "which": which})
        except ValidationError as error:
            return _failed(Problem(kind="input", message=first_fault(error, "view")))
        except (ValueError, RecursionError):
            return _failed(Problem(kind="input", message="view: expected a camera as JSON"))
        # A page state of its own: a picture that is asked for by its address must not touch anybody's strokes.
        context = CommandContext(studio, PageState("http"), Ticket())
        try:
            rendered = await hub.queue.run("read", lambda: render_view(context, command), context.ticket)
            data, media = await asyncio.to_thread(studio.picture_bytes, rendered.picture)
        except Exception as error:
            return _failed(studio.public_problem(problem_of(error)))
        return Response(data, media_type=media, headers=NO_STORE)

    @app.post("/api/blobs", summary="Send a picture, a splat file, a project or a layer: the body is the file")
    async def upload(request: Request, name: str = "") -> Response:
        try:
            # The length that is declared refuses a large file before it is sent; what is written is counted as well.
            declared = request.headers.get("content-length", "0")
            if declared.isdigit() and int(declared[:20]) > studio.blobs.limits.upload:
                raise TooLarge(f"{name[:200] or 'upload'}: expected at most {studio.blobs.limits.upload >> 20} MiB")
            # Piece by piece, on threads: the file is never whole in memory, and a slow disk holds up no other client.
            with studio.blobs.receive(name) as incoming:
                async for piece in request.stream():
                    await asyncio.to_thread(incoming.write, piece)
                blob = await asyncio.to_thread(incoming.finish)
        except ClientDisconnect:
            return Response(status_code=400)  # nobody reads it
        except Exception as error:
            problem = studio.public_problem(problem_of(error))
            return _failed(problem, 413 if isinstance(error, TooLarge) else None)
        # The page learns what the file is from the server's reading of it, never from its name.
        info = blob.info
        values = {"blob": blob.sha256, "kind": info.kind, "bytes": blob.size, "name": blob.name}
        return JSONResponse({**values, "width": info.width, "height": info.height, "gaussians": info.gaussians})

    @app.get("/api/blobs/{blob}", response_class=Response, summary="A picture that was uploaded or made")
    async def picture(blob: str) -> Response:
        try:
            data, media = await asyncio.to_thread(studio.picture_bytes, blob)
        except ValueError as error:
            return _failed(studio.public_problem(problem_of(error)), 404)
        # Only pictures are shown in place: any other upload of a stranger must not run as a document of this site.
        extra = {} if media.startswith("image/") else {"content-disposition": "attachment"}
        return Response(data, media_type=media, headers={**FOREVER, **extra})

    @app.get("/api/files/{key}/{name}", response_class=Response, summary="A file that was exported")
    async def file(key: str, name: str) -> Response:
        try:
            path = studio.downloads.find(key, name)
        except ValueError as error:
            return _failed(studio.public_problem(problem_of(error)), 404)
        return FileResponse(path, media_type="application/octet-stream", filename=path.name, headers=NO_STORE)


def _failed(problem: Problem, status: int | None = None) -> Response:
    text = Failure(re=0, error=problem).model_dump_json()
    code = STATUS[problem.kind] if status is None else status
    return Response(text, code, media_type="application/json", headers=NO_STORE)
