"""`bench speed`: seconds, Gaussians per second and peak memory of every stage, on the demo asset's surface."""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from splatbench.process import in_fresh_process
from splatbench.scenes import SavedScene, resampled, save_scene
from splatbench.speed_cases import OPERATIONS
from splatbench.timing import Timing, calibration, machine, measure
from splatpainter import text_tables as tables
from splatpainter.image_files import write_png

Report = Callable[[str], None]
REFERENCE_GAUSSIANS, REFERENCE_PX = 2000, 64
"""A scene that the torch reference, which holds [Gaussians, pixels] arrays, can draw and differentiate."""
LARGE_SCENE = 500_000
"""Gaussians from which on only the operations marked `large` are timed, and only at LARGE_PX."""
LARGE_PX = 512
SMALL_SCENE = "small scene"
EDIT_FILE = "from start to end: open a PLY, edit it (dab), save it"
INFO = "from start to end: splatpainter info"
NOTES = (
    "Median and fastest of the repeats, after one untimed call. Every line is a process of its own: its peak memory "
    "holds the interpreter, the kernels and the scene. `local edit` is the whole of `Painter.apply`: mask, lift, and "
    "receipt with hashes and scores; the voxel grid, made once per asset, is the line `voxels`. The dab is a disc of "
    "64 pixels and the letters are 90 pixels high at 512 pixels, and as large a part of other sizes. Scenes: the demo "
    "asset with Gaussians thinned and enlarged, or replaced by smaller ones. `ttt`: the preset `compact`, untrained "
    "weights (they cost what trained ones do), a painted disc of 67 pixels at 256; `encode` is once per asset.",
    "`small scene`: our kernels and the plain-torch reference (the specification, not a competitor) in turn in "
    "one process; `reference ratio` is the reference's seconds divided by the line's. `from start to end`: a fresh "
    "process, imports included, until it has ended; `within it` are its parts. `calibrated`: the fastest repeat "
    "divided by the seconds of a fixed piece of numpy's work on one core in the same run.",
)


@dataclass(frozen=True)
class SpeedBench:
    """Measure time and peak memory of every stage; write them as a table with the machine named.

    example:
      splatpainter bench speed --rows 10000 100000 --out out/bench-speed
    """

    out: Path = Path("out/bench-speed")
    """Folder for speed.csv and speed.md; made if missing."""
    rows: tuple[int, ...] = (10_000, 100_000, 1_000_000)
    """Sizes of the scenes; from 500,000 on only some operations are timed."""
    sizes: tuple[int, ...] = (256, 512, 1024)
    """Edges of the square pictures, pixels."""
    sh_degree: int = 1
    """Spherical harmonics of the scenes, 0 to 3."""
    only: tuple[str, ...] = ()
    """Time only lines whose name contains one of these words; none: all."""
    quick: bool = False
    """One tiny scene and few repeats: seconds instead of minutes, numbers that only show that it works."""

    def wants(self, name: str) -> bool:
        """Whether a line of this name is to be measured."""
        return not self.only or any(word in name for word in self.only)


@dataclass(frozen=True)
class Speed:
    """One line of the table."""

    operation: str
    rows: int | None
    """Gaussians of the scene; None where there is none."""
    size: int | None
    """Edge of the square picture, pixels; None where there is none."""
    milliseconds: float
    """Milliseconds, median."""
    fastest: float
    """Milliseconds of the fastest repeat: on a busy machine nearer to what the work costs."""
    rows_per_second: float | None
    """Gaussians per second at the median; None where the work is not over the whole asset."""
    peak_mib: float | None
    """Largest resident memory of the process; None where it cannot be measured."""
    repeats: int
    reference_ratio: float | None = None
    """Time of the torch reference / ours."""
    calibrated: float | None = None
    """Fastest repeat in parts of a fixed piece of numpy's work, timed before and after the lines of the same run:
    compares between machines and days."""


def run(config: SpeedBench, report: Report | None = None) -> list[Speed]:
    """Measure, write speed.csv and speed.md, and return the lines. report: called with one sentence per measurement.
    Raises ValueError for rows, sizes, degrees or words that make no sense."""

    config = _checked(config)
    report = report or (lambda _: None)
    where = machine()
    results: list[Speed] = []
    yardstick = calibration()

    def add(lines: Iterator[Speed]) -> None:
        for line in lines:
            results.append(line)
            report(
                f"{line.operation}, {tables.cell_text(line.rows)} Gaussians: {tables.cell_text(line.milliseconds)} ms"
            )

    with tempfile.TemporaryDirectory(prefix="splatpainter-bench-") as temporary:
        folder = Path(temporary)
        scenes = _scenes(config, folder)
        for gaussians, scene in scenes.items():
            add(_stages(config, gaussians, scene))
        add(_against_reference(config, folder))
        add(_programs(config, max(scenes), scenes[max(scenes)], folder))
    yardstick = min(yardstick, calibration())
    results = [replace(line, calibrated=line.fastest / (1000 * yardstick)) for line in results]
    where += f"; calibration {1000 * yardstick:.2f} ms"
    config.out.mkdir(parents=True, exist_ok=True)
    tables.write_csv(config.out / "speed.csv", results, where)
    tables.write_markdown(config.out / "speed.md", results, where, NOTES)
    return results


def _checked(config: SpeedBench) -> SpeedBench:
    if config.quick:
        config = replace(config, rows=(2000,), sizes=(64,))
    if not config.rows or min(config.rows) < 100:
        raise ValueError(f"bench speed: expected --rows of at least 100, got {list(config.rows)}")
    if not config.sizes or min(config.sizes) < 16 or max(config.sizes) > 8192:
        raise ValueError(f"bench speed: expected --sizes of 16 to 8192 pixels, got {list(config.sizes)}")
    if not 0 <= config.sh_degree <= 3:
        raise ValueError(f"bench speed: expected --sh-degree 0 to 3, got {config.sh_degree}")
    names = (*OPERATIONS, SMALL_SCENE, EDIT_FILE, INFO)
    unknown = [word for word in config.only if not any(word in name for name in names)]
    if unknown:
        raise ValueError(f"bench speed: expected --only words of {'; '.join(names)}; got {unknown[0]!r}")
    return config


def _scenes(config: SpeedBench, folder: Path) -> dict[int, Path]:
    from splatpainter.demo_asset import demo_asset

    base, out = demo_asset(), {}
    for gaussians in sorted({*config.rows, REFERENCE_GAUSSIANS}):
        save_scene(folder / str(gaussians), resampled(base, gaussians, config.sh_degree))
        out[gaussians] = folder / str(gaussians)
    if REFERENCE_GAUSSIANS not in config.rows:
        del out[REFERENCE_GAUSSIANS]
    return out


def _stages(config: SpeedBench, gaussians: int, scene: Path) -> Iterator[Speed]:
    """Lines of every operation that fits the scene."""
    repeats, budget = (2, 0.2) if config.quick else (15, 1.0)
    for name, operation in OPERATIONS.items():
        if not config.wants(name) or gaussians < operation.min_gaussians:
            continue
        sizes = config.sizes if operation.views else config.sizes[:1]
        if gaussians >= LARGE_SCENE:
            if not operation.large:
                continue
            sizes = [size for size in sizes if size == LARGE_PX] or sizes[:1]
        if operation.views:
            sizes = [size for size in sizes if size >= operation.min_px] or [max(sizes)]
            sizes = [size for size in sizes if size <= operation.max_px] or [min(sizes)]
        for size in sizes:
            kind = {"name": name, "folder": str(scene), "size": size, "repeats": repeats, "budget": budget}
            fresh = in_fresh_process("splatbench.speed_cases:run_operation", kind)
            edge = size if operation.views else None
            yield _line(name, gaussians, edge, fresh.result, peak=fresh.peak_mib, throughput=operation.throughput)


def _line(
    name: str,
    gaussians: int | None,
    size: int | None,
    timing: dict[str, Any],
    *,
    peak: float = math.nan,
    throughput: bool = False,
    ratio: float | None = None,
) -> Speed:
    """timing: a Timing as a dict."""
    seconds, rate = timing["seconds"], None
    if throughput and gaussians is not None:
        rate = gaussians / seconds
    memory = None if math.isnan(peak) else peak
    return Speed(
        name, gaussians, size, 1000 * seconds, 1000 * timing["fastest"], rate, memory, timing["repeats"], ratio
    )


def _against_reference(config: SpeedBench, folder: Path) -> Iterator[Speed]:
    """The kernels and the torch reference on one small scene, in one process."""
    if not config.wants(SMALL_SCENE):
        return
    kind = {"folder": str(folder / str(REFERENCE_GAUSSIANS)), "size": REFERENCE_PX, "repeats": 1 if config.quick else 5}
    fresh = in_fresh_process("splatbench.speed_cases:small_scene", kind)
    for name, pair in fresh.result.items():
        ratio = pair["reference"]["seconds"] / pair["ours"]["seconds"]
        for who, share in (("ours", ratio), ("reference", 1.0)):
            label = f"{SMALL_SCENE}: {name}, {who}"
            yield _line(label, REFERENCE_GAUSSIANS, REFERENCE_PX, pair[who], throughput=True, ratio=share)


def _programs(config: SpeedBench, gaussians: int, scene: Path, folder: Path) -> Iterator[Speed]:
    """Fresh processes from start to end, as a user's shell sees them."""
    repeats = 1 if config.quick else 3
    ply = scene / "scene.ply"
    if config.wants(EDIT_FILE):
        size = config.sizes[0] if config.quick else LARGE_PX
        view = SavedScene(scene, size)
        write_png(folder / "edited.png", view.edited("dab")[0], view.camera)
        arguments = {"ply": str(ply), "picture": str(folder / "edited.png")}
        runs = [in_fresh_process("splatbench.speed_cases:edit_file", arguments) for _ in range(repeats)]
        for name in ("", *runs[0].result):
            times = sorted(run.result[name] if name else run.seconds for run in runs)
            timing = asdict(Timing(statistics.median(times), times[0], repeats))
            peak = math.nan if name else max(run.peak_mib for run in runs)
            yield _line(f"within it: {name}" if name else EDIT_FILE, gaussians, size, timing, peak=peak)
    if config.wants(INFO):
        command = [sys.executable, "-m", "splatpainter", "info", str(ply)]
        timing = measure(
            partial(subprocess.run, command, check=True, capture_output=True), repeats=repeats + 2, budget=30
        )
        yield _line(INFO, gaussians, None, asdict(timing))
