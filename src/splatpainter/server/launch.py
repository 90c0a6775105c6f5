"""Running the studio: a socket of its own choosing, uvicorn, and `studio(asset)` for notebooks."""

from __future__ import annotations

import socket
import sys
import threading
import webbrowser
from pathlib import Path

import uvicorn

from splatpainter.io import read
from splatpainter.server.app import create_app
from splatpainter.server.limits import MAX_DAB_BYTES, ConnectionLimits, bounded
from splatpainter.server.security import Access
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.server.uploads.storage import PROJECT, Projects, demo, usable_projects
from splatpainter.session import Session
from splatpainter.splats import Axes, Splats
from splatpainter.system.old_names import formerly
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.user_folders import projects_folder

DEFAULT_PORT = 8750
PORT_TRIES = 20
"""Ports from the default one on that are tried where none was given."""


def open_session(
    asset: Splats | str | Path | None, projects: Path | None = None, axes: Axes = "auto"
) -> tuple[Session, str]:
    """(a session, its name) of an asset, a splat file, a project, or (None) the demo asset; the project of a new one
    lies in `projects` (None: the user's data folder). axes: of a splat file, as in io.read.
    Raises ValueError for what cannot be read."""
    # A project brings its layers and stays where it is; anything else gets a new project of its own.
    if isinstance(asset, str | Path) and Path(asset).suffix.lower() == PROJECT:
        return Session.load(asset), Path(asset).stem
    name = "demo" if asset is None else "asset" if isinstance(asset, Splats) else Path(asset).absolute().name
    splats = demo() if asset is None else asset if isinstance(asset, Splats) else read(asset, axes=axes)
    return Session(splats, Projects(projects or projects_folder()).fresh(name)), name


def listen(host: str, port: int | None) -> socket.socket:
    """A bound socket. port None: DEFAULT_PORT or one of the next, 0: any. Raises ValueError where none is free."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # A port that was asked for is taken or refused; another one without a word would not be found.
    candidates = range(DEFAULT_PORT, DEFAULT_PORT + PORT_TRIES) if port is None else [port]
    reason = ""
    for number in candidates:
        # asyncio turns Nagle's delays (40 ms an answer) off for sockets that say that they are TCP
        bound = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        if sys.platform == "win32":  # there REUSEADDR lets two programs listen on one port
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((host, number))
            bound.listen(128)
            return bound
        except OSError as error:
            bound.close()
            reason = error.strerror or str(error)
    # The last reason is named with the first port: that is the one that people know.
    raise ValueError(f"studio: cannot listen on {host} port {candidates[0]} ({reason}); choose another --port")


def address(access: Access, bound: socket.socket) -> str:
    """What to open in a browser, the token included."""
    port = bound.getsockname()[1]
    # An address that listens on everything is none that a browser can open.
    host = "localhost" if access.host in ("0.0.0.0", "::") else access.host
    host = f"[{host}]" if ":" in host else host
    return f"http://{host}:{port}/" + (f"?token={access.token}" if access.token else "")


def warm() -> threading.Thread:
    """Load what edits are made of beside everything else, so that the first stroke need not wait for it. To be joined
    before the process ends."""

    # Imported within the thread: that loading is what takes the time.
    def load() -> None:
        from splatpainter.kernels import library
        from splatpainter.lift import edits  # noqa: F401

        library.current()

    thread = threading.Thread(target=load, name="splatpainter-warm")
    thread.start()
    return thread


def make_server(studio: Studio, access: Access, limits: ConnectionLimits | None = None) -> uvicorn.Server:
    """A uvicorn server of the studio; run it with `server.run(sockets=[bound])`."""
    # The limits are part of uvicorn's connection classes, for by the time of the application a body is half read.
    http, socket_class = bounded(limits or ConnectionLimits())
    config = uvicorn.Config(
        create_app(studio, access),
        http=http,
        ws=socket_class,
        ws_max_size=MAX_DAB_BYTES,
        ws_per_message_deflate=False,  # Gaussians do not pack well, and packing them costs more than sending them
        log_level="warning",
        access_log=False,  # addresses may hold the token
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=3,
    )
    return uvicorn.Server(config)


@dataclass
class Running:
    """A studio in the background."""

    url: str
    """Address to open in a browser."""
    session: Session
    """The session that was opened; clients may open another."""
    _server: uvicorn.Server
    _threads: tuple[threading.Thread, ...]

    def stop(self) -> None:
        """Close it; the project file stays. Returns when all is on disk."""
        self._server.should_exit = True
        for thread in self._threads:
            thread.join()

    def __repr__(self) -> str:
        return f"studio at {self.url}"


@formerly(axes="frame")
def studio(
    asset: Splats | str | Path | None = None,
    *,
    port: int | None = None,
    folder: str | Path | None = None,
    projects: str | Path | None = None,
    browser: bool = False,
    axes: Axes = "auto",
) -> Running:
    """Start the studio on 127.0.0.1 in the background, from a notebook or a script: `s = sp.studio("vase.ply"); s.url`.

    asset: splats, a splat file, a project, or None: the demo asset. folder: what clients may open and save; watched for
    pictures. axes: of a splat file, as in io.read. Raises ValueError as `open_session` and `listen`."""
    access = Access.of("127.0.0.1")
    # The port is taken before the asset is read: a long read that ends without a port would be for nothing.
    bound = listen(access.host, port)
    session = None
    try:
        projects_path, note = usable_projects(None if projects is None else Path(projects))
        session, name = open_session(asset, projects_path, axes)
        options = StudioOptions(None if folder is None else Path(folder), projects_path, note=note)
        opened = Studio(session, name, options)
    except BaseException:
        # Whatever stops it, the port and the project file must not stay taken in a notebook that goes on.
        if session is not None:
            session.close()
        bound.close()
        raise
    server = make_server(opened, access)
    # A daemon, so that a notebook ends without `stop`; the session has everything on disk already.
    thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]}, name="splatpainter-studio", daemon=True)
    thread.start()
    warming = warm()
    url = address(access, bound)
    if browser:
        webbrowser.open(url)
    return Running(url, session, server, (thread, warming))
