"""`splatpainter studio` and `sp.studio(asset)`."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

import splatpainter as sp
from splatpainter.cli import main
from splatpainter.commands.studio import Config, run
from splatpainter.io import write
from splatpainter.server import launch
from splatpainter.server.launch import address, listen
from splatpainter.server.security import Access
from splatpainter.server.uploads.storage import demo
from tests.support.studio_process import Server
from tests.support.studio_scenes import Browser, ball, view, wire
from tests.support.systems import posix_only


@posix_only
def test_the_command_serves_until_interrupted(tmp_path: Path) -> None:
    write(tmp_path / "ball.ply", ball(50))
    command = [
        sys.executable,
        "-m",
        "splatpainter",
        "studio",
        str(tmp_path / "ball.ply"),
        "--no-browser",
        "--port",
        "0",
    ]
    environment = {"XDG_DATA_HOME": str(tmp_path / "data"), "HOME": str(tmp_path)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment}
    ) as process:
        assert process.stderr is not None and process.stdout is not None
        url = None
        for line in process.stderr:
            address = re.search(r"http://\S+", line)
            if address:
                url = address.group()
                break
        assert url is not None and url.startswith("http://127.0.0.1:")
        assert "Ctrl-C ends the studio" in process.stderr.readline()
        state = httpx.get(f"{url}api/state", timeout=30).json()
        assert state["asset"]["name"] == "ball.ply" and state["asset"]["gaussians"] == 50
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=30)
    assert process.returncode == 0 and out == "stopped; everything is saved\n", errors
    assert "Traceback" not in errors
    assert not list((tmp_path / "data").rglob("*.splatproj*"))  # nothing was done, nothing is kept


@posix_only
def test_where_the_project_was_deleted_it_says_where_the_work_is(tmp_path: Path) -> None:
    write(tmp_path / "ball.ply", ball(50))
    server = Server(tmp_path / "ball.ply", tmp_path)
    server.start()
    fields = {"name": "front", "camera": wire(view())}
    assert httpx.post(f"{server.url}api/do/bookmark.add", json=fields, timeout=30).status_code == 200
    (project,) = server.projects.glob("*.splatproj")
    project.unlink()
    out, errors = server.finished()
    assert out == "stopped\n", "not all is saved where it was"
    assert f"was deleted or moved while it was open; what was done in it is in {project.stem}.rescued" in errors
    assert "Warning" not in errors and len(list(server.projects.glob("*.rescued.splatproj"))) == 1


@pytest.mark.parametrize(
    ("words", "pattern"),
    [
        (["missing.ply"], "no such file"),
        (["--port", "70000"], "--port"),
        (["--host", "http://x"], "--host"),
        (["--host", "192.0.2.1", "--port", "0"], "cannot listen"),
        (["FILE", "--folder", "nowhere"], "no such folder"),
    ],
)
def test_bad_options_are_one_line(
    words: list[str], pattern: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("HOME", str(tmp_path))
    write(tmp_path / "ball.ply", ball(20))
    given = [str(tmp_path / "ball.ply") if word == "FILE" else word for word in words]
    assert main(["studio", "--no-browser", *given]) == 2
    line = capsys.readouterr().err
    assert pattern in line and line.count("\n") == 1


def test_the_demo_asset_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def small() -> sp.Splats:
        made.append(1)
        return ball(30)

    monkeypatch.setattr("splatpainter.demo_asset.demo_asset", small)
    first, again = demo(tmp_path / "cache"), demo(tmp_path / "cache")
    assert len(made) == 1 and first.sha256 == again.sha256 and len(first) == 30
    assert np.allclose(first.means[:, 1], -ball(30).means[:, 1])  # captures have y down
    next((tmp_path / "cache").iterdir()).write_bytes(b"ply\nbroken")
    assert demo(tmp_path / "cache").sha256 == first.sha256 and len(made) == 2
    (tmp_path / "file").write_text("no folder")
    assert len(demo(tmp_path / "file")) == 30


def test_a_taken_port_is_said_and_a_free_one_found() -> None:
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port}.*choose another"):
            listen("127.0.0.1", port)
        assert address(Access(), taken) == f"http://127.0.0.1:{port}/"
        assert address(Access.of("0.0.0.0", "t0"), taken) == f"http://localhost:{port}/?token=t0"


def test_a_notebook_keeps_its_session_beside_the_page(tmp_path: Path) -> None:
    running = sp.studio(ball(300), port=0, projects=tmp_path)
    try:
        assert repr(running) == f"studio at {running.url}"
        with connect(running.url.replace("http", "ws") + "ws", max_size=None) as socket:
            browser = Browser(socket)
            browser.hello()
            browser.stroke(view(), (36, 36), 24, (250, 0, 0, 255))
            assert len(running.session.layers) == 1 and browser.mirror.agrees(running.session.splats)
    finally:
        running.stop()
    with pytest.raises(httpx.ConnectError):
        httpx.get(running.url)
    assert len(list(tmp_path.glob("*.splatproj"))) == 1


@pytest.mark.parametrize("step", ["make_server", "warm"])
def test_what_ends_it_before_it_listens_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """A SIGTERM in its first moments: the note of the project's holder and the empty project stayed."""
    home = tmp_path / "projects"
    write(tmp_path / "ball.ply", ball(50))

    def terminated(*_: object) -> None:
        assert list(home.glob("*.splatproj-host"))
        raise SystemExit(143)

    monkeypatch.setenv("SPLATPAINTER_PROJECTS", str(home))
    monkeypatch.setattr(launch, step, terminated)
    with pytest.raises(SystemExit):
        run(Config(tmp_path / "ball.ply", port=0, no_browser=True))
    assert not list(home.iterdir())
