"""`splatpainter studio`: paint in the browser."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Annotated

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import InAxesOption
from splatpainter.commands.parts.terminal import complain
from splatpainter.system.memory import share_one_heap
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config:
    """Open an asset or a project in the browser studio, on this machine. Everything that is done there is saved as it
    is done; Ctrl-C ends it.

    example:
      splatpainter studio vase.ply --folder pictures
      splatpainter studio vase.splatproj
    """

    asset: Annotated[Positional[Path | None], Argument(metavar="ASSET|PROJECT")] = None
    """A splat file, a folder of INRIA's trainer or a .splatproj project; without one, the demo asset."""
    in_axes: InAxesOption = "auto"
    """Axes of a splat file's numbers: rub is y up, rdf y down; auto: what it says, else what its format has. In the
    page, one click turns an asset that is upside down."""
    port: Annotated[int | None, Argument(metavar="PORT", help_behavior_hint="")] = None
    """Port to listen on; default: 8750, or the next one that is free."""
    host: Annotated[str, Argument(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on. Any but this machine's own needs a token, which is printed."""
    folder: Annotated[Path | None, Argument(metavar="DIR", help_behavior_hint="")] = None
    """The one folder whose files the page may open and save; pictures saved there are offered as edits."""
    no_browser: bool = False
    """Only print the address."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Serve until interrupted."""
    share_one_heap()  # before anything starts a thread
    # The studio's libraries are an extra; without them one line says what to install.
    try:
        from splatpainter.server.launch import address, listen, make_server, open_session, warm
    except ImportError as error:
        raise ValueError(f"splatpainter studio: needs {error.name}; pip install 'splatpainter[studio]'") from None
    from splatpainter.server.security import Access
    from splatpainter.server.studio import Studio, StudioOptions
    from splatpainter.server.uploads.storage import usable_projects

    # The port is taken before the asset is read: a long read for nothing would be worse.
    if config.port is not None and not 0 <= config.port <= 65535:
        raise ValueError(f"splatpainter studio: expected --port from 0 to 65535, got {config.port}")
    access = Access.of(config.host)
    bound = listen(config.host, config.port)
    # Whatever stops it here, the port and the project must be free again.
    session = None
    try:
        projects, note = usable_projects()
        if note:
            complain(note)
        session, name = open_session(config.asset, projects, config.in_axes)
        if session.note:
            complain(session.note)
        studio = Studio(session, name, StudioOptions(config.folder, projects, note=note))
    except BaseException:
        if session is not None:
            session.close()
        bound.close()
        raise
    # The address is printed when it answers and holds the token: only whoever sees it may come in.
    url = address(access, bound)
    warming = None
    try:
        server = make_server(studio, access)
        warming = warm()
        lines = (f"splatpainter studio: {url}", "Every edit is saved at once; Ctrl-C ends the studio.")
        print(*lines, sep="\n", file=sys.stderr, flush=True)
        # A moment later, when the server is listening.
        if not config.no_browser:
            import webbrowser

            threading.Timer(0.5, webbrowser.open, [url]).start()
        # Ctrl-C is the usual end and no error; everything is saved already.
        server.run(sockets=[bound])
    except KeyboardInterrupt:  # uvicorn hands the signal on when all is closed
        pass
    finally:
        if warming is not None:
            warming.join()
        # Whatever stops it before it listens ends it without the shutdown that closes all of this.
        studio.close()
        bound.close()
    # Of a project that another program replaced or deleted meanwhile, closing says where the work is.
    if studio.last_note:
        complain(studio.last_note)
    line = "stopped" if studio.last_note else "stopped; everything is saved"
    # Without the token: the record may end in a log.
    return Outcome({"address": url.partition("?")[0]}, [line])
