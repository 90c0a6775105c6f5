"""Disks that fail, quotas that are used up, disks that become read-only: one line that says which, nothing is lost."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from splatpainter.session.project import disk_probe
from splatpainter.session.project.database import UnwritableError, one_line
from tests.support.cli_scenes import ball, saved

LIBRARY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>
/* Writes below FAIL_DIR fail with FAIL_ERRNO while the file FAIL_SWITCH is there. */
static int fails(int fd) {
    const char *dir = getenv("FAIL_DIR"), *on = getenv("FAIL_SWITCH");
    char link[64], path[4096];
    if (!dir || !on || access(on, F_OK)) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0 || (path[length] = 0, strncmp(path, dir, strlen(dir)))) return 0;
    errno = atoi(getenv("FAIL_ERRNO"));
    return 1;
}
#define REAL(name, ...) static __typeof__(name) *real; if (!real) real = dlsym(RTLD_NEXT, #name); \
    return fails(fd) ? -1 : real(__VA_ARGS__)
ssize_t write(int fd, const void *p, size_t n) { REAL(write, fd, p, n); }
ssize_t pwrite64(int fd, const void *p, size_t n, off64_t at) { REAL(pwrite64, fd, p, n, at); }
ssize_t pwrite(int fd, const void *p, size_t n, off_t at) { REAL(pwrite, fd, p, n, at); }
int fsync(int fd) { REAL(fsync, fd); }
int fdatasync(int fd) { REAL(fdatasync, fd); }
"""
SESSION = """
import os, sys
from pathlib import Path
from tests.support.session_scenes import BLUE, RED, dab, flat, load
folder, switch = Path(sys.argv[1]), Path(os.environ["FAIL_SWITCH"])
path, other = folder / "a.splatproj", folder.parent / "other.splatproj"
def tried(*steps):
    for step in steps:
        try:
            step()
            print("done")
        except ValueError as error:
            print(error)
with flat(project=path) as session:
    session.layers.add("paint", [dab(RED)])
    switch.touch()
    tried(lambda: session.layers.add("paint", [dab(BLUE)]), session.undo,
          lambda: session.files.save_as(folder / "b.splatproj"), lambda: session.files.export(folder / "a.ply"))
    print(len(session.layers))
    switch.unlink()
    tried(lambda: session.layers.add("paint", [dab(BLUE)]))
    switch.touch()
    tried(lambda: session.layers.add("paint", [dab(RED)]), lambda: session.files.save_as(other))
    tried(lambda: session.layers.add("paint", [dab(RED)]))
    switch.unlink()
for file in (path, other):
    with load(file) as session:
        print(len(session.layers), session.verify(), repr(session.read_only))
print(sorted(entry.name for entry in folder.iterdir()))
"""
COMMANDS = """
import sys
from splatpainter.cli import main
asset, folder = sys.argv[1:]
for words in (["convert", asset, f"{folder}/a.spz"], ["grade", asset, "--exposure", "0.2", "--out", f"{folder}/a.ply"],
              ["render", asset, "--out", f"{folder}/views", "--size", "32", "--views", "1"],
              ["compare", asset, asset, "--out", f"{folder}/c", "--size", "32", "--views", "1"],
              ["convert", asset, f"{folder}/planes/meta.json"]):
    try:
        code = main(words)
    except SystemExit as end:
        code = end.code
    print(code, flush=True)
"""


@pytest.fixture
def failing(tmp_path: Path) -> tuple[Path, Path, dict[str, str]]:
    """(folder, switch, environment) of a process whose writes into the folder fail while the switch is there."""
    if sys.platform != "linux" or shutil.which("gcc") is None:
        pytest.skip("needs Linux and a C compiler")
    source, library = tmp_path / "fail.c", tmp_path / "fail.so"
    source.write_text(LIBRARY)
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True, capture_output=True)
    folder, switch = tmp_path / "disk", tmp_path / "switch"
    folder.mkdir()
    root = str(Path(__file__).parents[2])
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]),
        "FAIL_DIR": str(folder),
        "FAIL_SWITCH": str(switch),
        "LD_PRELOAD": str(library),
    }
    return folder, switch, environment


@pytest.mark.parametrize("number", [errno.EIO, errno.EDQUOT, errno.EROFS, errno.ENOSPC])
def test_a_session_whose_disk_fails(number: int, failing: tuple[Path, Path, dict[str, str]]) -> None:
    folder, _, environment = failing
    words = "database or disk is full" if number == errno.ENOSPC else os.strerror(number)
    command = [sys.executable, "-c", SESSION, str(folder)]
    environment["FAIL_ERRNO"] = str(number)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    add, undo, save_as, export, layers, again, third, elsewhere, there, first, second, left = done.stdout.splitlines()
    project = f"{folder}/a.splatproj: cannot be read or written ({words}); nothing was changed"
    assert add == undo == third == project
    assert save_as == project.replace("a.splatproj", "b.splatproj")
    assert export == f"{folder}/a.ply: cannot be written ({os.strerror(number)})"
    assert (layers, again, elsewhere, there) == ("1", "done", "done", "done")
    assert (first, second) == ("2 [] ''", "3 [] ''"), "what was acknowledged is there, and nothing else"
    assert left == "['a.splatproj']"


@pytest.mark.parametrize("number", [errno.EIO, errno.EDQUOT])
def test_commands_whose_disk_fails_leave_nothing(number: int, failing: tuple[Path, Path, dict[str, str]]) -> None:
    folder, switch, environment = failing
    asset = saved(folder.parent / "asset.ply", ball(200))
    switch.touch()
    environment["FAIL_ERRNO"] = str(number)
    command = [sys.executable, "-c", COMMANDS, str(asset), str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == ["2"] * 5, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("splatpainter")]
    assert len(lines) == 5 and all(line.endswith(f"cannot be written ({os.strerror(number)})") for line in lines), lines
    assert f"{folder}/planes/meta.json: " in lines[-1]
    assert list(folder.iterdir()) == [], "no folder, no part of a file"


def test_what_the_system_says_is_asked_where_sqlite_does_not_know(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failed(name: str) -> str:
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorname = name
        with pytest.raises(UnwritableError) as refused, one_line(tmp_path / "a.splatproj"):
            raise error
        return str(refused.value)

    assert "(disk I/O error)" in failed("SQLITE_IOERR_WRITE"), "the folder can be written: nothing better is known"

    def used_up(handle: int) -> None:
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    monkeypatch.setattr(disk_probe.os, "fsync", used_up)
    assert f"({os.strerror(errno.EDQUOT)}); nothing was changed" in failed("SQLITE_IOERR_WRITE")
    assert list(tmp_path.iterdir()) == []
