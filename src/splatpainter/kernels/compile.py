"""Compile the CPU kernels once per machine, and keep numba's cache honest.

numba compiles a kernel when it is first called and caches the result on disk, beside the source or, where that cannot
be written, in the user's cache folder. `ensure_compiled` does all of that at a known moment, with a line to look at; it
imports neither numba nor torch when there is nothing to do.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import hashlib
import importlib
import importlib.util
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

from splatpainter.atomic import writing
from splatpainter.kernels.parallel import cpus
from splatpainter.user_folders import cache_folder

WARMUPS: dict[str, tuple[str, ...]] = {}
"""Registry. "module:function" that calls every kernel of its package once with float32 arrays -> files and folders
(relative to the package) whose edits make its compiled kernels stale. Two processes take entries from the front: those
whose kernels others call come first, and long ones before short ones. A package listed here calls `drop_stale()` before
it loads kernels."""

PACKAGE = Path(__file__).resolve().parents[1]
STAMP = "splatpainter-kernels.json"
COMMAND = "from splatpainter.kernels.compile import run_warmups; run_warmups({!r})"


def ensure_compiled(progress: bool = True) -> None:
    """Compile and cache every float32 kernel, unless that was done before on this machine with these sources.
    progress: write one line to stderr while it takes. Raises RuntimeError with the compiler's last line on failure."""
    current = {**_sources(), "machine": _machine()}
    if _read_stamp().get("compiled") == current:
        return
    drop_stale()
    start = time.monotonic()
    note = "splatpainter: compiling CPU kernels, once after installation ..."
    if progress:
        print(note, end="", file=sys.stderr, flush=True)
    _compile(min(2, cpus(), len(WARMUPS)))
    if progress:
        print(f" {time.monotonic() - start:.0f} s", file=sys.stderr, flush=True)
    _write_stamp({"sources": _sources(), "compiled": current})


def drop_stale() -> None:
    """Delete cached kernels whose sources were edited since they were compiled.

    numba looks only at the file that a kernel is in, and not at those of the functions it calls: without this, an edit
    of geometry.py would go on running the old code of projection.py. Installed copies do not change file by file, so
    only caches beside the sources are looked at.
    """
    now, before = _sources(), _read_stamp().get("sources", {})
    edited = {path for path, state in now.items() if before.get(path) != state}
    changed = sorted({path for paths in WARMUPS.values() if edited.intersection(paths) for path in paths})
    if not changed:
        return
    for path in changed:
        folder = PACKAGE / path
        stem, folder = ("*", folder) if folder.is_dir() else (folder.stem, folder.parent)
        for pattern in (f"{stem}.*.nbi", f"{stem}.*.nbc"):
            for cached in (folder / "__pycache__").glob(pattern):
                with contextlib.suppress(OSError):  # not ours to write: numba then caches in the user's folder
                    cached.unlink()
    _write_stamp({**_read_stamp(), "sources": now})


def load() -> None:
    """Load every kernel in this process (and compile those that are in no cache)."""
    for entry in WARMUPS:
        _run(entry)


def run_warmups(folder: str) -> None:
    """Run the warm-ups that no other process took: each is taken by a file of its number in `folder`.

    Without the garbage collector: numba's intermediate code is many small objects that live as long as they are needed,
    and to walk through them again and again is a quarter of the time of compiling. This process ends soon."""
    gc.disable()
    atexit.register(gc.freeze)  # nor at the end
    for number, entry in enumerate(WARMUPS):
        try:
            Path(folder, str(number)).touch(exist_ok=False)
        except FileExistsError:
            continue
        _run(entry)


def _run(entry: str) -> None:
    module, function = entry.split(":")
    getattr(importlib.import_module(module), function)()


def _compile(processes: int) -> None:
    import subprocess  # costs 10 ms, needed once
    import tempfile

    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGE.parent), *filter(None, sys.path)])}
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stderr": subprocess.PIPE, "env": environment}
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="splatpainter-"))
        children = []
        for _ in range(processes):
            child = subprocess.Popen([sys.executable, "-c", COMMAND.format(folder)], **pipes)
            children.append(stack.enter_context(child))
            stack.callback(child.kill)  # on Ctrl-C, and when the other one fails; after its end this does nothing
        for child in children:
            errors = child.communicate()[1].decode("utf-8", "replace")
            if child.returncode:
                last = errors.strip().splitlines()[-1] if errors.strip() else f"exit code {child.returncode}"
                raise RuntimeError(f"splatpainter: compiling CPU kernels failed: {last}")


def _sources() -> dict[str, str]:
    """Registered path -> hash of its files' names, sizes and times (what numba itself goes by)."""
    states = {}
    for path in sorted({path for paths in WARMUPS.values() for path in paths}):
        source = PACKAGE / path
        files = sorted(source.glob("*.py")) if source.is_dir() else [source]
        listed = [f"{f.name} {f.stat().st_size} {f.stat().st_mtime_ns}" for f in files if f.exists()]
        states[path] = hashlib.sha256("\n".join(listed).encode()).hexdigest()[:16]
    return states


def _machine() -> str:
    """Hash of what compiled code depends on besides its source: CPU, Python, numba, and where numba caches."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n", 1)[0].splitlines()
        processor = "".join(line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part")))
    except (OSError, UnicodeDecodeError):
        processor = f"{platform.machine()} {platform.processor()}"
    spec = importlib.util.find_spec("numba")
    stamp = f"{spec.origin} {os.stat(spec.origin).st_mtime_ns}" if spec and spec.origin else ""
    settings = "".join(f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith("NUMBA_"))
    return hashlib.sha256("\n".join([processor, sys.version, stamp, settings]).encode()).hexdigest()[:16]


def _stamp_paths() -> list[Path]:
    """Where the stamp may lie: beside the cached kernels, so that both vanish together, else in the user's folder."""
    installation = hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:16]
    return [PACKAGE / "rendering" / "cpu" / "__pycache__" / STAMP, cache_folder() / installation / STAMP]


def _read_stamp() -> dict:
    for path in _stamp_paths():
        try:
            stamp = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(stamp, dict):
            return stamp
    return {}


def _write_stamp(stamp: dict) -> None:
    """A stamp that cannot be written only means that the kernels are looked up again next time."""
    for path in _stamp_paths():
        with contextlib.suppress(OSError, ValueError):
            path.parent.mkdir(parents=True, exist_ok=True)
            with writing(path) as file:
                file.write(json.dumps(stamp).encode())
            return
