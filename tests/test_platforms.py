"""Linux, macOS and Windows: what only one of them has is not needed, and what each takes amiss is not done."""

from __future__ import annotations

import ast
import io
import mimetypes
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from splatbench.adapters.systems import link

from splatpainter.cli import main
from splatpainter.commands import SUMMARIES
from splatpainter.kernels.parallel import cpus
from splatpainter.server.launch import listen
from splatpainter.session.project.lock import ProjectLock
from splatpainter.system import atomic, processes, user_folders
from tests.support.cli_scenes import Capture, ball, run, saved
from tests.support.studio_scenes import live, make_studio
from tests.support.syntax import nodes
from tests.support.systems import posix_only

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [*sorted((ROOT / "src").rglob("*.py")), *sorted((ROOT / "scripts").glob("*.py"))]
WINDOWS = SimpleNamespace(platform="win32", executable=sys.executable)


def test_the_main_paths_need_nothing_that_only_posix_has(tmp_path: Path) -> None:

    script = Path(__file__).parent / "support" / "without_posix.py"
    variables = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), "SPLATPAINTER_THREADS": "2"}
    folders = [str(ROOT / name) for name in ("src", "train", "benchmarks", ".")]
    path = os.pathsep.join(filter(None, [*folders, os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env={**variables, "PYTHONPATH": path},
        capture_output=True,
        encoding="utf-8",
        timeout=600,
    )
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stderr[-3000:]


OPENERS = {"open", "fdopen", "read_text", "write_text", "_read_text", "NamedTemporaryFile", "TemporaryFile"}
MAY_OPEN = re.compile(r"(open|_text|TemporaryFile)\s*\(|\b(text|universal_newlines)\s*=")


def unsaid_encodings(source: str) -> list[int]:
    """Lines of calls that open text in whatever encoding the system prefers (cp1252 on Windows)."""
    lines = []
    for node in nodes(source) if MAY_OPEN.search(source) else ():
        if not isinstance(node, ast.Call):
            continue
        last = str(getattr(node.func, "attr", getattr(node.func, "id", "")))
        given = {keyword.arg: keyword.value for keyword in node.keywords}
        if last not in OPENERS and not given.keys() & {"text", "universal_newlines"}:
            continue
        name = ast.unparse(node.func)
        text = False
        if name in ("open", "io.open", "os.fdopen"):
            mode = given.get("mode", node.args[1] if len(node.args) > 1 else None)
            text = not (isinstance(mode, ast.Constant) and "b" in str(mode.value))
        elif last in ("read_text", "write_text") and name not in ("read_text", "_read_text"):
            text = len(node.args) < (1 if last == "read_text" else 2)
        elif last in ("NamedTemporaryFile", "TemporaryFile"):
            mode = given.get("mode", node.args[0] if node.args else None)
            text = isinstance(mode, ast.Constant) and "b" not in str(mode.value)
        elif "text" in given or "universal_newlines" in given:
            text = last in ("run", "Popen", "check_output", "begin")
        if text and "encoding" not in given:
            lines.append(node.lineno)
    return lines


def test_every_text_file_says_its_encoding() -> None:
    assert {str(path): lines for path in SOURCES if (lines := unsaid_encodings(path.read_text("utf-8")))} == {}


def test_the_checker_of_encodings_sees_them() -> None:
    wrong = [
        "open(p)", "open(p, 'w')", "os.fdopen(1, 'w')", "p.read_text()", "p.write_text('a')", "open(p, mode='a')",
        "subprocess.run(c, text=True)", "tempfile.NamedTemporaryFile('w')",
    ]  # fmt: skip
    right = [
        "open(p, 'rb')", "open(p, encoding='utf-8')", "p.read_text('utf-8')", "p.write_text('a', encoding='utf-8')",
        "subprocess.run(c, encoding='utf-8')", "tempfile.NamedTemporaryFile()", "Image.open(p)", "_read_text(p)",
    ]  # fmt: skip
    assert [unsaid_encodings(line) for line in wrong] == [[1]] * len(wrong)
    assert [unsaid_encodings(line) for line in right] == [[]] * len(right)


def console(monkeypatch: pytest.MonkeyPatch, encoding: str) -> Callable[[], str]:
    """Standard streams as a redirected console of that encoding has them; what was written to both."""
    streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding, write_through=True) for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    return lambda: b"".join(stream.buffer.getvalue() for stream in streams).decode(encoding)  # type: ignore[attr-defined]


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
@pytest.mark.parametrize("command", SUMMARIES)
def test_the_help_of_every_command_fits_an_old_console(
    command: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = console(monkeypatch, encoding)
    code = main([command, "--help"])
    text = written()
    monkeypatch.undo()
    assert code == 0 and len(text) > 200, text


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_a_name_that_the_console_lacks_is_written_as_an_escape(
    encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "va\u0107a \u2192 \u03a9.ply"
    saved(tmp_path / name, ball(20))
    written = console(monkeypatch, encoding)
    codes = [main(["info", str(tmp_path / name)]), main(["info", str(tmp_path / f"no {name}")])]
    text = written()
    monkeypatch.undo()
    assert codes == [0, 2] and "\\u2192 \\u03a9.ply" in text
    assert "no such file" in text and "fault in splatpainter" not in text


@pytest.mark.parametrize(
    "name", ["NUL.ply", "con", "Aux.tar.gz", "com1.ply", "LPT\u00b9", "nul .ply", "a:b.ply", "a?.ply", "a.ply.", "a "]
)
def test_names_that_windows_takes_for_something_else(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic, "sys", WINDOWS)
    for refuse in (atomic.check_name, lambda path: atomic.writing(path).__enter__()):
        with pytest.raises(ValueError, match="choose another name") as caught:
            refuse(tmp_path / name)
        assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["null.ply", "console.ply", "com10.ply", "a.con", "com.ply", ".nul", "\u03a9 x.ply"])
def test_names_that_windows_allows(name: str) -> None:
    assert atomic.windows_refuses(name) == ""


def test_a_command_refuses_a_reserved_name_in_one_line(
    tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(tmp_path / "ball.ply", ball(20))
    monkeypatch.setattr(atomic, "sys", WINDOWS)
    line = run(capfd, "convert", tmp_path / "ball.ply", tmp_path / "nul.ply").error
    assert line.endswith("nul.ply: is the name of a device on Windows; choose another name")


def test_two_outputs_may_not_differ_in_case_alone(tmp_path: Path, capfd: Capture) -> None:
    saved(tmp_path / "ball.ply", ball(20))
    (tmp_path / "view.json").write_text("{}", encoding="utf-8")
    words = ["edit", tmp_path / "ball.ply", tmp_path / "view.png", "--out", tmp_path / "out.ply"]
    line = run(capfd, *words, "--receipt", tmp_path / "OUT.PLY").error
    assert "OUT and the receipt need different names" in line


def test_a_file_that_a_scanner_holds_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = os.replace, []

    def held(*names: Any) -> None:
        calls.append(names)
        if len(calls) < 4:
            error = PermissionError(13, "held by another program")
            error.winerror = (5, 32, 33)[len(calls) - 1]  # type: ignore[attr-defined]
            raise error
        real(*names)

    monkeypatch.setattr(os, "replace", held)
    with atomic.writing(tmp_path / "a.bin") as file:
        file.write(b"after")
    assert len(calls) == 4 and (tmp_path / "a.bin").read_bytes() == b"after"
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("number", atomic.BUSY_ERRORS)
def test_a_rename_that_a_served_folder_finds_busy_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Folders of Windows and of virtual machines, mounted here."""
    real, calls = os.replace, []

    def busy(*names: Any) -> None:
        calls.append(names)
        if len(calls) < 3:
            raise OSError(number, "busy")
        real(*names)

    monkeypatch.setattr(os, "replace", busy)
    with atomic.writing(tmp_path / "a.bin") as file:
        file.write(b"after")
    assert len(calls) == 3 and (tmp_path / "a.bin").read_bytes() == b"after"
    monkeypatch.setattr(atomic, "REPLACE_SECONDS", 0.05)
    monkeypatch.setattr(os, "replace", lambda *names: (_ for _ in ()).throw(OSError(number, "busy")))
    with pytest.raises(ValueError, match=r"a\.bin: cannot be written \(busy\)$"):
        atomic.write_text(tmp_path / "a.bin", "never")
    assert (tmp_path / "a.bin").read_bytes() == b"after"


def test_a_folder_without_permissions_of_its_own_takes_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """vboxsf, 9p and exFAT refuse to change them."""

    def refused(*words: Any, **how: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "chmod", refused)
    for text in ("first", "second"):
        atomic.write_text(tmp_path / "a.txt", text)
        assert (tmp_path / "a.txt").read_text() == text


@pytest.mark.parametrize("windows", [False, True])
def test_a_file_that_stays_refused_is_one_line(windows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def refused(*names: Any) -> None:
        calls.append(names)
        error = PermissionError(13, "Permission denied")
        if windows:
            error.winerror = 32  # type: ignore[attr-defined]
        raise error

    monkeypatch.setattr(os, "replace", refused)
    monkeypatch.setattr(atomic, "REPLACE_SECONDS", 0.1)
    with pytest.raises(ValueError, match=r"a\.bin: cannot be written \(Permission denied\)$"):
        with atomic.writing(tmp_path / "a.bin") as file:
            file.write(b"never")
    assert (len(calls) > 1) == windows and not list(tmp_path.iterdir())


def test_a_lock_file_that_cannot_be_removed_while_it_is_open_goes_afterwards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = ProjectLock.take(tmp_path / "a.splatproj")
    assert lock is not None
    real, calls = Path.unlink, []

    def windows(self: Path, missing_ok: bool = False) -> None:
        calls.append(self.name)
        if len(calls) == 1:
            raise PermissionError(13, "in use")
        real(self, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", windows)
    lock.release()
    assert calls == ["a.splatproj-lock"] * 2 and not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="folders of Linux")
def test_folders_on_linux_are_those_of_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_CACHE_HOME", "XDG_DATA_HOME", user_folders.PROJECTS_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_folders.cache_folder() == tmp_path / ".cache" / "splatpainter"
    assert user_folders.projects_folder() == tmp_path / ".local" / "share" / "splatpainter" / "projects"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "d"))
    assert user_folders.cache_folder() == tmp_path / "c" / "splatpainter"
    assert user_folders.projects_folder() == tmp_path / "d" / "splatpainter" / "projects"
    monkeypatch.setenv(user_folders.PROJECTS_VARIABLE, str(tmp_path / "p"))
    assert user_folders.projects_folder() == tmp_path / "p"


def test_processors_are_those_that_this_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 5, 7}, raising=False)
    assert cpus() == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert cpus() == 64


def test_scripts_of_the_page_are_scripts_whatever_the_registry_says(tmp_path: Path) -> None:
    mimetypes.add_type("text/plain", ".js")  # as some programs leave the registry of Windows
    with live(make_studio(tmp_path)) as studio:
        answer = studio.http.get("/studio.js")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/javascript")


def test_a_port_is_listened_on_once() -> None:
    with listen("127.0.0.1", 0) as bound:
        with pytest.raises(ValueError, match="cannot listen on 127.0.0.1 port"):
            listen("127.0.0.1", bound.getsockname()[1])


def test_links_are_copies_where_the_system_allows_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "a.txt").write_bytes(b"a")

    def refused(self: Path, target: Path, target_is_directory: bool = False) -> None:
        raise OSError(22, "A required privilege is not held by the client")

    monkeypatch.setattr(Path, "symlink_to", refused)
    link(tmp_path / "views", Path("base"))
    link(tmp_path / "b.txt", tmp_path / "base" / "a.txt")
    assert (tmp_path / "views" / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes() == b"a"


@posix_only
def test_children_on_windows_are_a_console_group_and_end_as_a_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would be called there; it has never been run there."""
    calls: list[Any] = []

    class Child:
        pid, returncode = 4711, None

        def __init__(self, command: Any, **options: Any) -> None:
            calls.append(("begin", command, options))

        def poll(self) -> None:
            return None

        def send_signal(self, sign: int) -> None:
            calls.append(("signal", sign))

        def wait(self, timeout: float | None = None) -> int:
            return 1

        def kill(self) -> None:
            calls.append("kill")

    monkeypatch.setattr(processes, "sys", WINDOWS)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 512, raising=False)
    monkeypatch.setattr(processes.signal, "CTRL_BREAK_EVENT", 1, raising=False)
    monkeypatch.setattr(subprocess, "Popen", Child)
    monkeypatch.setattr(subprocess, "run", lambda command, **options: calls.append(command))
    child = processes.begin(["a"], cwd="b")
    processes.interrupt(child)
    processes.end(child)
    tree = ["taskkill", "/F", "/T", "/PID", "4711"]
    begun = ("begin", ["a"], {"creationflags": 512, "cwd": "b"})
    assert calls == [begun, ("signal", 1), ("signal", 1), tree, "kill"]
    assert processes.watch_command(4711)[-1] == "4711" and "/bin/sh" not in processes.watch_command(4711)
