"""The `splatpainter` command: find the command, parse its options, print what it found, turn every failure into one
line and an exit code.

0 done; 1 `verify` found a difference; 2 bad input or options; 70 a fault of ours; 130 Ctrl-C; 143 terminated.
Importing this module loads neither numpy nor torch.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any

from splatpainter._version import __version__
from splatpainter.commands import DISTRIBUTIONS, ENTRY_POINTS, SUMMARIES, Outcome
from splatpainter.commands.parts.terminal import PROGRAM, complain, reason
from splatpainter.extras import EXTRAS, missing

DEBUG = "SPLATPAINTER_DEBUG"
"""Set to 1: errors show where they come from."""
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
"""What numpy's wheels are asked by how many threads a matrix product takes."""
BAD_INPUT, FAULT, INTERRUPTED, TERMINATED = 2, 70, 130, 143
GARBAGE_OBJECTS = {"studio": 10_000}
"""Made since the last collection, after which the garbage collector looks at the young ones, by command."""
MOST_GARBAGE_OBJECTS = 100_000
"""The same of the others, which end soon: an edit makes as many, most of them parts of modules that stay."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line (default: the process's own) and return its exit code. Raises nothing for users, unless
    SPLATPAINTER_DEBUG is set."""
    # A process of its own may be tuned; a caller in Python keeps its settings.
    words = list(sys.argv[1:] if argv is None else argv)
    if argv is None:
        _collect_garbage_seldom(words)
        _keep_blas_to_one_thread(words)
    _write_what_the_terminal_can()
    try:
        with _terminated_like_interrupted():
            return _show(_run(words))
    except SystemExit as done:  # --help of a command, SIGTERM
        return done.code if isinstance(done.code, int) else 0
    except KeyboardInterrupt:
        complain("interrupted; every file that was there before is unharmed")
        return INTERRUPTED
    except (ValueError, OSError, MemoryError) as error:
        if os.environ.get(DEBUG):
            raise
        complain(_one_line(error))
        return BAD_INPUT
    except Exception as error:
        if os.environ.get(DEBUG):
            raise
        absent = (error.name or "").split(".")[0] if isinstance(error, ModuleNotFoundError) else ""
        if absent in EXTRAS:
            complain(missing(absent, f"{PROGRAM} {words[0]}"))
            return BAD_INPUT
        complain(f"fault in splatpainter: {type(error).__name__}: {error}; set {DEBUG}=1 to see where")
        return FAULT


def _collect_garbage_seldom(words: list[str]) -> None:
    """A third of the time of a small edit went into walks through the objects of imported libraries, most of it at the
    end of the process, which frees its memory without them."""
    gc.set_threshold(GARBAGE_OBJECTS.get(words[0] if words else "", MOST_GARBAGE_OBJECTS), 10, 10)
    atexit.register(_leave_garbage)  # registered first, so it comes last: after it nothing is left to walk through


def _leave_garbage() -> None:
    # OpenImageIO counts its objects at the end, and prints a page of those that are left.
    if "OpenImageIO" not in sys.modules:
        gc.freeze()


def _keep_blas_to_one_thread(words: list[str]) -> None:
    """numpy's BLAS starts its threads when it is imported, a third of the time of a refusal, and no command of this
    package multiplies large matrices by it (CONVENTIONS.md: the kernels do); training and benches may."""
    if words and words[0] not in DISTRIBUTIONS:
        os.environ.setdefault(BLAS_THREADS, "1")


def _run(words: list[str]) -> Outcome:
    if not words or words[0] in ("-h", "--help", "help") and len(words) == 1:
        return Outcome({"commands": SUMMARIES}, [_help()])
    if words[0] in ("-V", "--version"):
        return Outcome({"version": __version__}, [f"{PROGRAM} {__version__}"])
    # `help edit` is `edit --help`. Commands are imported when they are called: each needs its own libraries.
    name, rest = (words[1], ["--help"]) if words[0] == "help" else (words[0], words[1:])
    if name not in SUMMARIES:
        import difflib  # wanted once in a while

        near = difflib.get_close_matches(name, SUMMARIES, 1)
        hint = f"; did you mean {near[0]}?" if near else f"; see {PROGRAM} --help"
        raise ValueError(f"expected a command ({', '.join(SUMMARIES)}), got {name!r}{hint}")
    command = _module(name)
    if hasattr(command, "dispatch"):  # a command of commands
        return command.dispatch(rest)
    from splatpainter.commands.parts.option_parsing import parse

    config = parse(command.Config, f"{PROGRAM} {name}", rest)
    outcome = command.run(config)
    return outcome.as_json() if config.json else outcome


def _module(name: str) -> Any:
    """The module of a command: of this package, or of an installed distribution with the entry point `name` in the
    group `splatpainter.commands`. Raises ValueError where that distribution is missing."""
    if name not in DISTRIBUTIONS:
        return importlib.import_module("splatpainter.commands." + name)
    if not _is_installed(name):
        raise ValueError(f"{PROGRAM} {name}: not installed; it comes with {DISTRIBUTIONS[name]}")
    return _entry_points(name)[0].load()


def _is_installed(name: str) -> bool:
    return name not in DISTRIBUTIONS or bool(_entry_points(name))


def _entry_points(name: str) -> list[Any]:
    from importlib.metadata import entry_points  # a twentieth of a second, which few commands need

    return list(entry_points(group=ENTRY_POINTS, name=name))


def _distribution(name: str) -> str:
    return DISTRIBUTIONS[name].partition(":")[0].rpartition(" ")[2]


def _help() -> str:
    rows = [
        f"  {name:<9} {line}" + ("" if _is_installed(name) else f" (separate: {_distribution(name)})")
        for name, line in SUMMARIES.items()
    ]
    return "\n".join(
        [
            f"usage: {PROGRAM} COMMAND ...",
            "",
            "Edit a picture of a 3D Gaussian asset, and the asset changes; untouched Gaussians keep every bit.",
            "",
            "commands:",
            *rows,
            "",
            "example:",
            f"  {PROGRAM} render vase.ply --out views     # paint on views/view_000.png, save it, then:",
            f"  {PROGRAM} edit vase.ply views/view_000.png --out painted.ply",
            "",
            f"{PROGRAM} COMMAND --help shows the options of a command; --json makes it print one JSON object.",
        ]
    )


def _show(outcome: Outcome) -> int:
    try:
        print("\n".join(outcome.lines), flush=True)
    except BrokenPipeError:  # `| head` took what it wanted
        _abandon_stdout()
    except OSError as error:
        _abandon_stdout()
        raise ValueError(f"standard output: cannot be written ({reason(error)})") from None
    return outcome.code


def _write_what_the_terminal_can() -> None:
    """Redirected output of Windows is in an old code page, and LANG=C is ASCII: a character that it lacks (in a file
    name, a rule of the help) is written as an escape, and is no reason to fail."""
    for stream in (sys.stdout, sys.stderr):  # None without a console
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _one_line(error: Exception) -> str:
    if isinstance(error, MemoryError):
        return "out of memory; use a smaller --size, or an asset with fewer Gaussians"
    if isinstance(error, OSError):
        return reason(error) if error.filename is None else f"{error.filename}: {reason(error)}"
    return str(error)


def _abandon_stdout() -> None:
    """Python flushes stdout once more when it ends, and would complain a second time."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM unwinds like Ctrl-C does, so that files in the making are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(*_: object) -> None:
        raise SystemExit(TERMINATED)

    signs = [signal.SIGTERM]
    if sys.platform == "win32":
        signs.append(signal.SIGBREAK)  # Windows sends no SIGTERM; closing the console or Ctrl-Break sends this
    before = [(sign, signal.signal(sign, stop)) for sign in signs]
    try:
        yield
    finally:
        for sign, handler in before:
            signal.signal(sign, handler)
