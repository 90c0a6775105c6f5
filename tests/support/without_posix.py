"""The package's main paths on a Python without what only POSIX has. Run as a program in an empty folder: prints "done".

Libraries come first: each has its own code for every system. What the package itself looks up under `sys.platform` is
for pyright (scripts/check_platforms.py).
"""

from __future__ import annotations

import asyncio  # noqa: F401
import builtins
import importlib
import io
import multiprocessing.connection  # noqa: F401
import os
import pkgutil
import signal
import sys
import urllib.request
from pathlib import Path
from typing import Any

import fastapi  # noqa: F401
import filelock  # noqa: F401
import httpx  # noqa: F401
import mitsuba  # noqa: F401
import numpy as np
import PIL.Image
import platformdirs  # noqa: F401
import tensorboard  # noqa: F401
import torch.utils.tensorboard  # noqa: F401
import trimesh  # noqa: F401
import tyro  # noqa: F401
import uvicorn.protocols.http.auto  # noqa: F401
import webdataset  # noqa: F401
import websockets.sync.client  # noqa: F401

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "readline")
FUNCTIONS = (
    "fork", "forkpty", "killpg", "getpgrp", "getpgid", "setsid", "setpgid", "waitid", "getuid", "geteuid", "getgid",
    "chown", "mkfifo", "sched_getaffinity", "nice", "statvfs", "openpty",
)  # fmt: skip
SIGNALS = ("SIGKILL", "SIGHUP", "SIGALRM", "SIGQUIT", "SIGUSR1", "SIGUSR2", "SIGCHLD", "SIGPIPE", "SIGSTOP")


def hide() -> None:
    """Take away what Windows does not have."""
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for name in FUNCTIONS:
        if hasattr(os, name):
            delattr(os, name)
    for name in SIGNALS:
        if hasattr(signal, name):
            delattr(signal, name)
    real = builtins.open

    def without_proc(file: Any, *rest: Any, **more: Any) -> Any:
        name = os.fspath(file) if isinstance(file, str | os.PathLike) else ""
        if name.startswith(("/proc", "/dev", "/sys")) and not name.startswith("/dev/shm"):  # the tests' own files
            raise FileNotFoundError(2, "No such file or directory", os.fspath(file))
        return real(file, *rest, **more)

    builtins.open = io.open = without_proc


def main() -> None:
    import splatpainter as sp

    hide()
    for module in pkgutil.walk_packages(sp.__path__, "splatpainter."):
        # One runs in another system's environment, the other is the native core, which is no module.
        if not module.name.endswith(("decode_slat", "splatpainter_kernels")):
            importlib.import_module(module.name)
    from splatbench import timing

    from splatpainter.cli import main as command
    from splattrain.data.shards import RenderedScene, ShardWriter
    from tests.support.cli_scenes import ball, saved

    asset = saved(Path("ball.ply"), ball(400))
    assert command(["info", str(asset)]) == 0
    assert command(["render", str(asset), "--out", "views", "--size", "64", "--views", "1"]) == 0
    with PIL.Image.open("views/view_000.png") as picture:
        pixels, text = np.array(picture.convert("RGB")), picture.info["splatpainter"]
    pixels[24:36, 24:36] = (20, 160, 40)
    camera = sp.Camera.from_json(text)
    from splatpainter.image_files import write_png

    write_png("painted.png", pixels, camera)
    assert command(["edit", str(asset), "painted.png", "--out", "out.ply", "--method", "lift"]) == 0
    assert command(["verify", str(asset), "out.ply"]) == 0

    with sp.Session(sp.read(asset)) as session:
        session.files.save_as("ball.splatproj")
    with sp.Session.load("ball.splatproj") as session:
        assert len(session.snapshot.splats) == 400
    with ShardWriter(Path("shards"), {"seed": 3}, 1, 1) as writer:
        writer.add(0, RenderedScene("thing", [{"txt": b"text"}], ["plain"]))
    running = sp.studio(asset, port=0, projects="projects")
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(running.url, timeout=60) as page:
        assert page.status == 200 and b"<html" in page.read().lower()
    running.stop()
    assert "cores" in timing.machine()
    print("done")


if __name__ == "__main__":
    main()
