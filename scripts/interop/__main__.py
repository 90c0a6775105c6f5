"""Our files in other people's programs: python scripts/interop [--work DIR] [--docs docs/interop.md]

Installs the programs' packages of today (npm and pip) into DIR, writes a small asset in every format, reads it in each
program, and prints which way it stands there and which numbers differ. Viewers for the web run in headless Chromium
through Playwright. What cannot be installed or run is listed with its reason. Needs npm, Node and a Chromium; nothing
of ours is changed but the page that --docs names and the contact sheet beside it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from asset import TRIALS, write_trials
from compare import Cell, compared
from programs import (
    ABSENT,
    BLENDER_PACKAGES,
    ENVIRONMENTS,
    NODE_PACKAGES,
    PYTHON_PACKAGES,
    Program,
    node_programs,
    python_programs,
    viewers,
)
from report import page, sheet, table

HERE = Path(__file__).resolve().parent
PATIENCE_SECONDS = 900
"""For an installation."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="scripts/interop", description=__doc__)
    parser.add_argument("--work", type=Path, help="folder of the packages, kept; default: a temporary one")
    parser.add_argument("--docs", type=Path, help="Markdown page to write, and a contact sheet (.webp) beside it")
    parser.add_argument("--only", nargs="*", default=[], help="names of programs")
    options = parser.parse_args()
    if options.work is not None:
        return _try_all(options, options.work)
    with tempfile.TemporaryDirectory(prefix="splatpainter-interop-") as folder:
        _try_all(options, Path(folder))


def _try_all(options: argparse.Namespace, work: Path) -> None:
    files = work / "files"
    files.mkdir(parents=True, exist_ok=True)
    rows = write_trials(files)
    reasons: dict[str, str] = dict(ABSENT)
    programs: list[Program] = []
    for packages, install, make in (
        (PYTHON_PACKAGES, _install_python, python_programs),
        (BLENDER_PACKAGES, _install_python, python_programs),
        (NODE_PACKAGES, _install_node, node_programs),
        ((), lambda work, packages: {}, viewers),
    ):
        try:
            programs += make(work, install(work, packages))
        except Exception as error:  # whatever a registry, a compiler or a browser says
            reasons[", ".join(packages) or "viewers for the web"] = " ".join(str(error).split())[:300]
    cells: dict[str, dict[str, Cell]] = {}
    pictures: dict[str, dict[str, bytes]] = {}
    for program in programs:
        if options.only and not any(word in program.title for word in options.only):
            continue
        print(f"{program.title} ...", file=sys.stderr, flush=True)
        try:
            answers = program.read(files, [trial.name for trial in TRIALS])
        except Exception as error:
            reasons[program.title] = " ".join(str(error).split())[:300]
            continue
        cells[program.title] = {name: compared(rows[name], answer) for name, answer in answers.items()}
        drawn = {name: answer["picture"] for name, answer in answers.items() if "picture" in answer}
        if drawn:
            pictures[program.title] = drawn
    print(table(cells))
    print(*(f"not tried: {name}: {reason}" for name, reason in reasons.items()), sep="\n")
    if options.docs is not None:
        contact = sheet(pictures)
        if contact is not None:
            options.docs.with_suffix(".webp").write_bytes(contact)
        options.docs.write_text(
            page(cells, reasons, options.docs.stem if contact else "", list(pictures)), encoding="utf-8"
        )


def _run(words: list[str], folder: Path) -> str:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    if done.returncode:
        raise RuntimeError((done.stderr or done.stdout).strip()[-300:])
    return done.stdout


def _install_python(work: Path, packages: tuple[str, ...]) -> dict[str, str]:
    """The newest of each into a fresh environment; name -> version."""
    environment = work / ENVIRONMENTS.get(packages[0], "python")
    if not environment.exists():
        _run([sys.executable, "-m", "venv", str(environment)], work)
    program = str(next(p for p in (environment / "bin/python", environment / "Scripts/python.exe") if p.exists()))
    _run([program, "-m", "pip", "install", "-q", "--upgrade", *packages], work)
    listed = json.loads(_run([program, "-m", "pip", "list", "--format", "json"], work))
    return {one["name"]: one["version"] for one in listed}


def _install_node(work: Path, packages: tuple[str, ...]) -> dict[str, str]:
    """The newest of each ("ALIAS=NAME@RANGE": of that range, under another name); name -> version."""
    for tool in ("node", "npm"):
        if shutil.which(tool) is None:
            raise RuntimeError(f"{tool} is not installed")
    (work / "package.json").write_text('{"name": "interop", "private": true}\n')
    exact = []
    for package in packages:
        alias, _, name = package.rpartition("=")
        # By number: without one npm takes the newest version that says it fits this Node.
        answer: Any = json.loads(_run(["npm", "view", name, "version", "--json"], work))
        version = answer[-1] if isinstance(answer, list) else answer
        bare = name if name.rfind("@") <= 0 else name[: name.rfind("@")]
        exact.append(f"{alias}@npm:{bare}@{version}" if alias else f"{bare}@{version}")
    _run(["npm", "install", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error", *exact], work)
    versions = {}
    for one in exact:
        name = one[: one.index("@", 1)]
        record = json.loads((work / "node_modules" / name / "package.json").read_text())
        versions[name] = record["version"]
    return versions


if __name__ == "__main__":
    main()
