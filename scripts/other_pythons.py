"""Install the wheel into several Pythons and compare what they make:

    python scripts/other_pythons.py python3.11 python3.14 python3.14t --wheel dist/splatpainter-*.whl
    python scripts/other_pythons.py python3.11 "chroot /srv/forky python3.15" --only starts demo
    python scripts/other_pythons.py python3.11 "wine python.exe" --installed --only starts demo bytes

An interpreter is a command; each gets a venv and the wheel with the extra `batch`, or with --installed is taken as it
is. Warnings are errors. The checks, each in a process of its own:

    starts   every module that needs no extra is imported; a free-threaded Python is still one afterwards
    demo     `splatpainter demo` and `verify`; the bytes of the edited assets
    bytes    scripts/same_bytes.py: some 220 files of every command, of a session with undo, of a batch
    at_once  the same command lines on three threads of one process: the bytes that each makes alone
    threads  tests/test_threads.py and other tests of work that runs at once, with pytest
    studio   the studio answers a request (where its packages can be installed)

Prints a table: "ok" and the first digits of a hash where a check has one. Exit 1 if a check fails, or a hash is not
that of the first interpreter.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_SECONDS = 7200
"""Of one check; emulated machines take some twenty times as long."""
TESTS = ("tests/test_threads.py", "tests/test_recent.py", "tests/kernels/test_parallel.py")
STARTS = """
import importlib, json, pkgutil, platform, sys, sysconfig
import splatpainter
failed = {}
for module in pkgutil.walk_packages(splatpainter.__path__, "splatpainter."):
    if module.name.endswith(("__main__", ".splatpainter_kernels")):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        # What an extra brings may be missing; a module of the package or of the standard library may not.
        if (error.name or "").split(".")[0] in {"splatpainter", *sys.stdlib_module_names}:
            raise
        failed[module.name] = error.name
free = bool(sysconfig.get_config_var("Py_GIL_DISABLED"))
if free and sys._is_gil_enabled():
    sys.exit("the GIL came back with an import")
import numpy, PIL
print(json.dumps({
    "python": platform.python_version() + ("t" if free else ""), "system": sys.platform, "machine": platform.machine(),
    "numpy": numpy.__version__, "pillow": PIL.__version__, "without": sorted(set(failed.values())),
}))
"""
DEMO = """
import sys
from splatpainter.cli import main
assert main(["demo", "--out", sys.argv[1], "--size", "96"]) == 0
assert main(["verify", sys.argv[1] + "/asset.ply", sys.argv[1] + "/painted.ply"]) == 0
"""
STUDIO = """
import subprocess, sys, urllib.request
from pathlib import Path
from splatpainter.demo_asset import demo_asset
from splatpainter.io import write
from splatpainter.system import processes
path = Path(sys.argv[1])
path.unlink(missing_ok=True)
write(path, demo_asset())
words = [sys.executable, "-m", "splatpainter", "studio", str(path), "--no-browser", "--port", "0"]
server = processes.begin(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
try:
    said = []
    for line in server.stderr:
        said.append(line.decode())
        if "http://" in said[-1]:
            break
    else:
        sys.exit("".join(said))
    url = "http://" + said[-1].split("http://")[1].split()[0]
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    for path in ("", "studio.js", "api/state"):
        with opener.open(url.rstrip("/") + "/" + path, timeout=300) as answer:
            assert answer.status == 200 and answer.read(), path
finally:
    processes.interrupt(server)
    processes.end(server)
"""


@dataclass(frozen=True)
class Python:
    """One that the package is installed into."""

    name: str
    """As it was asked for."""
    command: tuple[str, ...]
    folder: Path
    """Of its own."""

    def run(self, *words: str | Path, log: str) -> tuple[int, str]:
        """(exit code, what it printed). Paths must be absolute: what enters another root forgets where it was."""
        environment = {**os.environ, "PYTHONUTF8": "1", "PYTHONDONTWRITEBYTECODE": ""}
        environment.pop("PYTHONPATH", None)
        # Pipes alone: on files and on /dev/null Wine's Python does not start.
        done = subprocess.run(
            [*self.command, *map(str, words)],
            env=environment,
            input=b"",
            capture_output=True,
            timeout=TIMEOUT_SECONDS,
            check=False,
        )
        (self.folder / f"{log}.log").write_bytes(done.stdout + done.stderr)
        return done.returncode, done.stdout.decode(errors="replace")


def made(interpreter: str, number: int, folder: Path, wheel: Path | None) -> Python:
    """A venv of that interpreter with the wheel; None: the interpreter as it is. Raises CalledProcessError."""
    place = folder / str(number)
    place.mkdir(parents=True, exist_ok=True)
    command = tuple(shlex.split(interpreter))
    if wheel is None:
        return Python(interpreter, command, place)
    venv = place / "venv"
    subprocess.run([*command, "-m", "venv", str(venv)], check=True)
    python = venv / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    # What comes before the interpreter stays: what enters another root, or emulates another machine.
    found = Python(interpreter, (*command[:-1], str(python)), place)
    # Rather an older numpy than one to be compiled: newer ones have no wheels of free-threaded 3.13.
    pip = [*found.command, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--prefer-binary"]
    subprocess.run([*pip, f"{wheel}[batch]"], check=True)
    # Not every Python has wheels of these (OpenImageIO has none for free-threaded ones): the check then says so.
    subprocess.run([*pip, "--only-binary", ":all:", "fastapi", "uvicorn", "websockets", "pytest-xdist"], check=False)
    return found


def starts(python: Python) -> tuple[bool, str]:
    code, printed = python.run("-W", "error", "-c", STARTS, log="starts")
    if code:
        return False, ""
    facts = json.loads(printed.strip().splitlines()[-1])
    without = ", ".join(facts["without"])
    print(f"  {facts['python']} on {facts['system']} {facts['machine']}, numpy {facts['numpy']}, Pillow "
          f"{facts['pillow']}; not there: {without or 'nothing'}", flush=True)  # fmt: skip
    return True, ""


def demo(python: Python) -> tuple[bool, str]:
    code, _ = python.run("-W", "error", "-c", DEMO, python.folder / "demo", log="demo")
    if code:
        return False, ""
    digest = hashlib.sha256()
    for name in ("asset.ply", "painted.ply", "evening.ply"):
        digest.update((python.folder / "demo" / name).read_bytes())
    return True, digest.hexdigest()


def same_bytes(python: Python) -> tuple[bool, str]:
    script = ROOT / "scripts" / "same_bytes.py"
    code, _ = python.run("-W", "error", script, python.folder / "bytes", log="bytes")
    sums = python.folder / "bytes" / "sums.txt"
    # Under Wine a process that died can say 0.
    if code or not sums.is_file():
        return False, ""
    return True, hashlib.sha256(sums.read_bytes()).hexdigest()


def at_once(python: Python) -> tuple[bool, str]:
    script = ROOT / "scripts" / "same_bytes.py"
    code, printed = python.run("-W", "error", script, python.folder / "at_once", "--at-once", "3", log="at_once")
    return code == 0 and printed.rstrip().endswith(" 0 files differ"), ""


def threads(python: Python) -> tuple[bool, str]:
    tests = [ROOT / name for name in TESTS]
    code, _ = python.run(
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        ROOT,
        "-c",
        ROOT / "pyproject.toml",
        *tests,
        log="threads",
    )
    return code == 0, ""


def studio(python: Python) -> tuple[bool, str]:
    code, _ = python.run("-c", STUDIO, python.folder / "studio.ply", log="studio")
    return code == 0, ""


CHECKS: dict[str, Callable[[Python], tuple[bool, str]]] = {
    "starts": starts, "demo": demo, "bytes": same_bytes, "at_once": at_once, "threads": threads, "studio": studio,
}  # fmt: skip
"""Each tells (whether it passed, the hash of what it made or "")."""


def newest_wheel() -> Path:
    wheels = sorted((ROOT / "dist").glob("splatpainter-*.whl"), key=lambda path: path.stat().st_mtime)
    if not wheels:
        raise SystemExit("expected --wheel, or a wheel in dist/: python scripts/build_wheels.py makes them")
    return wheels[-1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("interpreters", nargs="+", metavar="PYTHON", help="a command, of one or more words")
    parser.add_argument("--wheel", type=Path, help="default: the newest of dist/")
    parser.add_argument("--installed", action="store_true", help="they have the package: install nothing")
    parser.add_argument("--only", nargs="+", choices=CHECKS, default=list(CHECKS), help="checks; default: all")
    parser.add_argument("--folder", type=Path, help="for venvs, files and logs, kept; default: a temporary one")
    args = parser.parse_args()
    wheel = None if args.installed else (args.wheel or newest_wheel()).resolve()
    with tempfile.TemporaryDirectory() as temporary:
        return compared(args.interpreters, wheel, args.only, (args.folder or Path(temporary)).resolve())


def compared(interpreters: list[str], wheel: Path | None, checks: list[str], folder: Path) -> int:
    """Runs the checks and prints the table; the exit code."""
    rows, expected, failed = [], {}, False
    for number, name in enumerate(interpreters):
        print(f"{name}:", flush=True)
        try:
            python = made(name, number, folder, wheel)
        except (subprocess.CalledProcessError, OSError) as error:
            print(f"  cannot be installed into: {error}", flush=True)
            rows.append([name, *["not installed"] * len(checks)])
            failed = True
            continue
        cells = []
        for check in checks:
            begin = time.monotonic()
            passed, digest = CHECKS[check](python)
            equal = not passed or digest == expected.setdefault(check, digest)
            cells.append("FAILS" if not passed else f"{'ok' if equal else 'DIFFERS'} {digest[:8]}".strip())
            failed |= not (passed and equal)
            print(f"  {check}: {cells[-1]}, {time.monotonic() - begin:.0f} s", flush=True)
            if not passed:
                log = (python.folder / f"{check}.log").read_text(encoding="utf-8", errors="replace")
                print("    " + "\n    ".join(log.strip().splitlines()[-12:]), flush=True)
        rows.append([name, *cells])
    table = [["", *checks], *rows]
    widths = [max(len(row[k]) for row in table) for k in range(len(table[0]))]
    for row in table:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
