"""Which mistakes in core modules no test sees: each mutation is made in a copy of the package, and the tests that
should know better are run on it. Prints survivors; exit code 1 where there are any.

Run: python scripts/mutants.py [WORD ...] [--list]

WORD: only mutations whose file or name holds it. Takes some seconds each. Not part of `make test`; a change of a core
formula comes with its entry in scripts/mutations.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "scripts" / "mutations"
"""The mutations, one file a room."""
PACKAGES = {"splatpainter": ROOT / "src/splatpainter", "splattrain": ROOT / "train/splattrain"}
"""Packages that are copied; files of the first are named without it."""
SLOWEST_SECONDS = 3600.0
"""Of a file of tests without any mutation."""
PATIENCE, LEAST_SECONDS = 10.0, 60.0
"""Tests of a mutation that take this many times as long as without it have noticed it; not before so many seconds."""


@dataclass(frozen=True)
class Mutation:
    """One mistake."""

    name: str
    """What is wrong, in words."""
    file: str
    """Below src/splatpainter, or "splattrain/..."."""
    old: str
    """Text that stands there once."""
    new: str
    tests: tuple[str, ...] = field(repr=False)
    """Files of tests that must see it."""


def mutations() -> list[Mutation]:
    """All of FOLDER: one file a room, in the order of their names. Raises ValueError, TypeError for what is none."""
    files = sorted(FOLDER.glob("*.toml"))
    entries = [entry for file in files for entry in tomllib.loads(file.read_text(encoding="utf-8"))["mutation"]]
    return [Mutation(**{**entry, "tests": tuple(entry["tests"])}) for entry in entries]


@dataclass(frozen=True)
class Options:
    """Mutations of core modules, and which of them no test sees."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Only mutations whose name or file holds one of these words."""
    list: bool = False
    """List the mutations and run nothing."""


def path_of(mutation: Mutation, packages: Mapping[str, Path]) -> Path:
    """Its file. packages: name -> folder."""
    first, _, rest = mutation.file.partition("/")
    return packages[first] / rest if first in packages else packages["splatpainter"] / mutation.file


def survives(mutation: Mutation, copy: Path, seconds: float = SLOWEST_SECONDS) -> bool:
    """Whether the tests pass with this mistake in `copy`, a folder that holds a copy of the package. seconds: those
    that take longer hang. Raises ValueError where the text to be changed does not stand there exactly once."""
    path = path_of(mutation, {name: copy / name for name in PACKAGES})
    text = path.read_text(encoding="utf-8")
    if text.count(mutation.old) != 1:
        raise ValueError(f"{mutation.file}: {mutation.old!r} stands there {text.count(mutation.old)} times, not once")
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8", newline="\n")
    try:
        return passes(mutation.tests, copy, seconds)
    finally:
        path.write_text(text, encoding="utf-8", newline="\n")


def passes(tests: Sequence[str], copy: Path, seconds: float = SLOWEST_SECONDS) -> bool:
    """Whether these tests pass, within so many seconds, with the package in `copy`."""
    environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, timeout=seconds)
        return done.returncode == 0
    except subprocess.TimeoutExpired:
        return False


def main(options: Options) -> int:
    """Run; the exit code."""
    chosen = [m for m in mutations() if not options.words or any(w in f"{m.file} {m.name}" for w in options.words)]
    if options.list or not chosen:
        print("\n".join(f"{m.file}: {m.name}" for m in chosen) or "no such mutation")
        return 0 if chosen else 2
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name, package in PACKAGES.items():
            shutil.copytree(package, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        took: dict[str, float] = {}
        for test in sorted({test for mutation in chosen for test in mutation.tests}):
            begun = time.monotonic()
            if not passes((test,), copy):
                print(f"{test} fails without any mutation: make it pass first")
                return 2
            took[test] = time.monotonic() - begun
        for mutation in chosen:
            alive = survives(mutation, copy, LEAST_SECONDS + PATIENCE * sum(took[test] for test in mutation.tests))
            survivors += [mutation] if alive else []
            print(f"{'SURVIVES' if alive else 'killed':<9} {mutation.file}: {mutation.name}", flush=True)
    print(f"{len(survivors)} of {len(chosen)} survive")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=Options.__doc__)))
