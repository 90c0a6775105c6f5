"""`bench peers`: ours beside other programs on the same files in one run: reading, writing, drawing, converting.

Peers are what is installed: gsply (pip), Mitsuba's `ellipsoids` (pip, with libLLVM) and PlayCanvas's splat-transform
(npm). One that is not there has a line that says so. They do not all do the same work: notes say what differs.
"""

from __future__ import annotations

import math
import os
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.process import in_fresh_process
from splatbench.scenes import SavedScene, resampled, save_scene
from splatbench.timing import installed_version, machine, measure
from splatpainter import text_tables as tables
from splatpainter._version import __version__
from splatpainter.io import read, write

Report = Callable[[str], None]
OURS, GSPLY, MITSUBA, TRANSFORM = "splatpainter", "gsply", "mitsuba", "splat-transform"
CONVERSIONS = (
    ("scene.ply", "out.compressed.ply"),
    ("scene.ply", "out.spz"),
    ("scene.ply", "out.splat"),
    ("scene.ply", "out.ply"),
    ("scene.sog", "out.ply"),
)
VARIANT = "llvm_ad_rgb"
MAX_DEPTH = 64
"""Most ellipsoids that a ray of Mitsuba blends."""
NOTES = (
    "Median and fastest of the repeats, programs in turn. Reading and writing are in one process of each program, "
    "after one untimed call; gsply takes and gives logarithms and logits as they stand in the file, ours activates, "
    "hashes and, when writing, syncs to the disk. Conversions are whole processes; ours reads back what it wrote and "
    "measures the loss. Mitsuba traces rays against the same Gaussians, one sample a pixel, without a sort.",
    "CPU seconds are of all threads, user and system.",
)


@dataclass(frozen=True)
class PeersBench:
    """Measure ours beside gsply, Mitsuba and splat-transform on the same files, with their versions.

    example:
      splatpainter bench peers --rows 100000 --out out/bench-peers
      splatpainter bench peers --splat-transform "npx @playcanvas/splat-transform"
    """

    out: Path = Path("out/bench-peers")
    """Folder for peers.csv and peers.md; made if missing."""
    rows: int = 100_000
    """Gaussians of the scene."""
    size: int = 512
    """Edge of the square picture, pixels."""
    repeats: int = 5
    """Runs of each line."""
    splat_transform: str = "splat-transform"
    """How splat-transform is called; a line says so where it cannot be."""
    quick: bool = False
    """A tiny scene and one run: numbers that only show that it works."""


@dataclass(frozen=True)
class Peer:
    """One line of the table."""

    task: str
    program: str
    version: str
    milliseconds: float | None
    """Median; None where it did not run."""
    fastest: float | None
    cpu_seconds: float | None
    """Median CPU seconds of a process; None within one, and where the system does not tell."""
    note: str = ""
    """Why it did not run."""


def run(config: PeersBench, report: Report | None = None) -> list[Peer]:
    """Measure, write peers.csv and peers.md, and return the lines. Raises ValueError for numbers that make no sense."""
    from splatpainter.demo_asset import demo_asset

    if config.quick:
        config = replace(config, rows=2000, size=64, repeats=1)
    if config.rows < 100 or config.repeats < 1 or not 16 <= config.size <= 8192:
        raise ValueError(
            "bench peers: expected --rows of at least 100, --repeats of at least 1 and --size of 16 to 8192, got "
            f"{config.rows}, {config.repeats} and {config.size}"
        )
    where, results = machine(), list[Peer]()

    def add(lines: Sequence[Peer]) -> None:
        for line in lines:
            results.append(line)
            time_ = line.note or f"{tables.cell_text(line.milliseconds)} ms"
            (report or (lambda _: None))(f"{line.task}, {line.program}: {time_}")

    with tempfile.TemporaryDirectory(prefix="splatpainter-bench-") as temporary:
        folder = Path(temporary) / "scene"
        save_scene(folder, resampled(demo_asset(), config.rows, 3))
        write(folder / "scene.sog", read(folder / "scene.ply"))
        for task, works in TASKS.items():
            add(_within_processes(task, works, folder, config))
        for source, target in CONVERSIONS:
            add(_conversions(folder / source, folder / target, config))
    config.out.mkdir(parents=True, exist_ok=True)
    tables.write_csv(config.out / "peers.csv", results, where)
    tables.write_markdown(config.out / "peers.md", results, where, NOTES)
    return results


# Work within a process: called by name in fresh ones.


def read_ours(folder: str, size: int) -> Callable[[], Any]:
    return lambda: read(Path(folder, "scene.ply"))


def read_gsply(folder: str, size: int) -> Callable[[], Any]:
    import gsply

    return lambda: gsply.plyread(Path(folder, "scene.ply"))


def write_ours(folder: str, size: int) -> Callable[[], Any]:
    splats = replace(read(Path(folder, "scene.ply")), source=None, origin=None)
    return lambda: write(Path(folder, "ours.ply"), splats, overwrite=True)


def write_gsply(folder: str, size: int) -> Callable[[], Any]:
    import gsply

    data = gsply.plyread(Path(folder, "scene.ply"))
    names = ("means", "scales", "quats", "opacities", "sh0", "shN")
    columns: list[Any] = [np.ascontiguousarray(getattr(data, name)) for name in names]
    return lambda: gsply.plywrite(Path(folder, "gsply.ply"), *columns)


def draw_ours(folder: str, size: int) -> Callable[[], Any]:
    from splatpainter.rendering import render

    scene = SavedScene(Path(folder), size)
    splats, camera = scene.splats, scene.camera
    return lambda: render(splats, camera)


def draw_mitsuba(folder: str, size: int) -> Callable[[], Any]:
    import mitsuba

    mitsuba.set_variant(VARIANT)
    camera = SavedScene(Path(folder), size).camera
    to_world: Any = np.linalg.inv(camera.world_to_camera) @ np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic", "max_depth": MAX_DEPTH},
            "sensor": {
                "type": "perspective",
                "fov": math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
                "fov_axis": "y",
                "to_world": mitsuba.ScalarTransform4f(to_world),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "shape": {"type": "ellipsoids", "filename": str(Path(folder, "scene.ply"))},
        }
    )
    return lambda: np.array(mitsuba.render(scene, spp=1))


TASKS: dict[str, dict[str, Callable[[str, int], Callable[[], Any]]]] = {
    "read PLY": {OURS: read_ours, GSPLY: read_gsply},
    "write PLY": {OURS: write_ours, GSPLY: write_gsply},
    "draw": {OURS: draw_ours, MITSUBA: draw_mitsuba},
}


def time_work(task: str, program: str, folder: str, size: int, repeats: int) -> dict[str, float]:
    """Called by name in a fresh process."""
    timing = measure(TASKS[task][program](folder, size), repeats=repeats, budget=60)
    return {"seconds": timing.seconds, "fastest": timing.fastest}


def _within_processes(task: str, works: dict[str, Any], folder: Path, config: PeersBench) -> list[Peer]:
    lines = []
    for program in works:
        version = __version__ if program == OURS else installed_version(program)
        name = f"{task} {config.size} px" if task == "draw" else task
        if program != OURS and find_spec(program) is None:
            lines.append(Peer(name, program, version, None, None, None, "not installed"))
            continue
        words = {"task": task, "program": program, "folder": str(folder), "size": config.size}
        try:
            timed = in_fresh_process("splatbench.peers:time_work", words | {"repeats": config.repeats}).result
        except RuntimeError as error:  # no libLLVM, another version's call
            lines.append(Peer(name, program, version, None, None, None, f"failed: {str(error)[-160:]}"))
            continue
        lines.append(Peer(name, program, version, 1000 * timed["seconds"], 1000 * timed["fastest"], None))
    return lines


# Whole processes.


def _conversions(source: Path, target: Path, config: PeersBench) -> list[Peer]:
    task = f"convert {source.suffix.strip('.')} to {target.name.removeprefix('out.')}, whole process"
    command = shlex.split(config.splat_transform)
    located = shutil.which(command[0]) if command else None
    commands = {OURS: [sys.executable, "-m", "splatpainter", "convert", str(source), str(target), "--overwrite"]}
    if located is not None:
        commands[TRANSFORM] = [located, *command[1:], "-w", str(source), str(target)]
    times: dict[str, list[tuple[float, float]]] = {program: [] for program in commands}
    notes = {program: "" for program in commands}
    for _ in range(config.repeats):
        for program, words in commands.items():
            if notes[program]:
                continue
            target.unlink(missing_ok=True)
            try:
                times[program].append(_timed_process(words))
            except RuntimeError as error:
                notes[program] = f"failed: {str(error)[:160]}"
    transform = "absent" if located is None else _version_of([located, *command[1:]])
    versions = {OURS: __version__, TRANSFORM: transform}
    lines = []
    for program in (OURS, TRANSFORM):
        if not times.get(program):
            note = notes.get(program) or "not installed"
            lines.append(Peer(task, program, versions[program], None, None, None, note))
            continue
        walls, cpus = zip(*times[program], strict=True)
        cpu = statistics.median(cpus)
        wall = 1000 * statistics.median(walls)
        lines.append(Peer(task, program, versions[program], wall, 1000 * min(walls), None if math.isnan(cpu) else cpu))
    return lines


def _timed_process(command: Sequence[str]) -> tuple[float, float]:
    """(seconds, CPU seconds) of a command; the latter NaN on Windows. Raises RuntimeError with its last line."""
    before, start = _children_seconds(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    seconds = time.perf_counter() - start
    if done.returncode:
        lines = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines() or ["no word"]
        raise RuntimeError(lines[-1])
    return seconds, _children_seconds() - before


def _children_seconds() -> float:
    if sys.platform == "win32":
        return math.nan
    times = os.times()
    return times.children_user + times.children_system


def _version_of(command: Sequence[str]) -> str:
    """What splat-transform says of itself."""
    done = subprocess.run([*command, "--version"], capture_output=True, stdin=subprocess.DEVNULL, check=False)
    named = re.search(r"\d+\.\d+\.\d+", (done.stdout + done.stderr).decode(errors="replace"))
    return named[0] if named else "?"
