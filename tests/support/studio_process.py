"""`splatpainter studio` in a process of its own, which tests kill and start again."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from splatpainter.io import write
from splatpainter.server.launch import listen
from splatpainter.system.user_folders import PROJECTS_VARIABLE
from tests.support import studio_scenes
from tests.support.studio_pages import Page, window


class Server:
    """`splatpainter studio` in a process of its own, on one port whenever it is started."""

    def __init__(self, asset: Path, folder: Path) -> None:
        with listen("127.0.0.1", 0) as free:
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/"
        self._command = [sys.executable, "-m", "splatpainter", "studio", str(asset), "--no-browser"]
        self._command += ["--port", str(self.port)]
        self.projects = folder / "projects"
        """Where its projects are."""
        self._environment = {**os.environ, PROJECTS_VARIABLE: str(self.projects)}
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Until it serves."""
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=self._environment
        )
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if self.url in line:
                return
        raise AssertionError("the studio did not start")

    def send(self, number: int) -> None:
        """Send its process a signal."""
        assert self._process is not None
        self._process.send_signal(number)

    def finished(self) -> tuple[str, str]:
        """(what it printed, what it complained of since it served), interrupted as by Ctrl-C."""
        assert self._process is not None
        self._process.send_signal(signal.SIGINT)
        out, errors = self._process.communicate()
        self._process = None
        return out, errors

    def end(self, crash: bool) -> None:
        if self._process is not None:
            if crash:
                self._process.kill()
            else:
                self._process.send_signal(signal.SIGINT)
            self._process.communicate()
        self._process = None


@contextlib.contextmanager
def served_page(browser: Any, folder: Path) -> Iterator[tuple[Server, Page]]:
    """A studio with a ball in a process that may be killed, and its page, which may complain of lost connections."""
    asset = folder / "ball.ply"
    write(asset, studio_scenes.ball(600))
    server = Server(asset, folder)
    try:
        server.start()
        with window(browser, server.url, still=True) as page:
            yield server, page
            page.problems = [one for one in page.problems if "WebSocket" not in one and "ERR_" not in one]
    finally:
        with contextlib.suppress(ProcessLookupError):
            server.end(crash=False)
