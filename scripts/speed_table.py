"""The table of speeds of one installation: what an artist waits for, as calls, processes, files and in the studio.

    .venv/bin/python scripts/speed_table.py --make INPUTS      once: scenes, painted pictures, files of all formats
    PYTHON scripts/speed_table.py INPUTS                       the table of that interpreter's splatpainter, in minutes
    PYTHON scripts/speed_table.py INPUTS --only "process"      lines whose names contain one of these words

Two installations are compared by running it with both interpreters in turn on the same INPUTS. It uses what every
version since 0.1.0's beginnings has; what an installation lacks (torch, the studio, gsply, splat-transform on PATH or
in SPLAT_TRANSFORM) is left out with a line that says so. Each group of lines runs in a process of its own.

The studio's lines need the bench's package: PYTHONPATH=CHECKOUT/benchmarks of that version, where it is not installed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

SIZE = 512
"""Edge of the pictures, pixels."""
SCENES = {"100k": 100_000, "1m": 1_000_000}
CONVERSIONS = (
    ("1m.ply", "compressed.ply"),
    ("1m.ply", "spz"),
    ("1m.ply", "splat"),
    ("1m.ply", "ply"),
    ("1m.sog", "ply"),
)


@dataclass(frozen=True)
class Line:
    """One line of the table; None: not measured."""

    name: str
    median_ms: float | None
    fastest_ms: float | None = None
    cpu_ms: float | None = None
    """User and system, median."""
    peak_mib: float | None = None
    remark: str = ""


def main() -> int:
    parser = argparse.ArgumentParser(description="The table of speeds of this interpreter's splatpainter.")
    parser.add_argument("inputs", type=Path, help="folder of the scenes and pictures that --make made")
    parser.add_argument("--make", action="store_true", help="make them, and measure nothing")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD", help="lines whose names contain one of these")
    parser.add_argument("--json", action="store_true", help="print JSON in place of Markdown")
    parser.add_argument("--group", default="", help=argparse.SUPPRESS)
    config = parser.parse_args()
    if config.make:
        make(config.inputs)
        return 0
    if config.group:
        for line in GROUPS[config.group](config.inputs, config.only):
            print(json.dumps(asdict(line)), flush=True)
        return 0
    if not (config.inputs / "1m.sog").exists():
        parser.error(f"{config.inputs}: no inputs there; make them with --make first")
    lines = (line for group in GROUPS for line in in_a_process(group, config))
    if config.json:
        print(json.dumps([asdict(line) for line in lines], indent=1))
        return 0
    print("| what | median ms | fastest | CPU ms | peak MiB | |\n| --- | ---: | ---: | ---: | ---: | --- |")
    for line in lines:
        numbers = (line.median_ms, line.fastest_ms, line.cpu_ms, line.peak_mib)
        cells = ["" if value is None else f"{value:,.1f}" if value < 100 else f"{value:,.0f}" for value in numbers]
        print(f"| {line.name} | {' | '.join(cells)} | {line.remark} |", flush=True)
    print(f"\n{sys.executable}, load {os.getloadavg()[0]:.1f} at the end")
    return 0


def in_a_process(group: str, config: argparse.Namespace) -> Iterator[Line]:
    """The lines of a group, as they are measured by this interpreter in a process of its own."""
    words = [sys.executable, __file__, str(config.inputs), "--group", group, "--only", *config.only]
    # Bytecode is kept, as installations have it: compiling the modules anew is no part of a command's time.
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        with subprocess.Popen(words, env=variables, stdout=subprocess.PIPE, stderr=errors, encoding="utf-8") as running:
            assert running.stdout is not None
            for text in running.stdout:
                if text.startswith("{"):
                    yield Line(**json.loads(text))
        if running.returncode:
            errors.seek(0)
            reason = (errors.read().strip().splitlines() or [f"exit code {running.returncode}"])[-1]
            yield Line(f"{group}: not measured further", None, remark=reason[:120])


# ---- what is measured


def repeated(
    name: str, only: list[str], prepare: Callable[[], Callable[[], Any]], repeats: int, budget: float = 6.0
) -> Iterator[Line]:
    """A line of a call: once without counting, then so often, or as often as fits the budget (seconds; at least 3
    times)."""
    if only and not any(word in name for word in only):
        return
    try:
        work = prepare()
        work()
    except ImportError as error:
        yield Line(name, None, remark=f"not there: {error.name}")
        return
    walls: list[float] = []
    cpus: list[float] = []
    while len(walls) < repeats and (len(walls) < 3 or sum(walls) < budget):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    yield Line(name, 1000 * statistics.median(walls), 1000 * min(walls), 1000 * statistics.median(cpus))


def process(name: str, only: list[str], command: list[str], repeats: int, code: int = 0) -> Iterator[Line]:
    """A line of a whole process; the first run is not counted. Raises RuntimeError where it ends otherwise."""
    if only and not any(word in name for word in only):
        return
    walls, cpus, peaks = [], [], []
    for k in range(repeats + 1):
        start = time.perf_counter()
        running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        assert running.stderr is not None
        errors = running.stderr.read()
        _, status, used = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
        if running.returncode != code:
            raise RuntimeError(f"{name}: {errors.decode(errors='replace').strip()[-200:]}")
        if k:
            walls.append(time.perf_counter() - start)
            cpus.append(used.ru_utime + used.ru_stime)
            peaks.append(used.ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10))
    medians = (1000 * statistics.median(walls), 1000 * min(walls), 1000 * statistics.median(cpus))
    yield Line(name, *medians, statistics.median(peaks))


def drawing(inputs: Path, only: list[str]) -> Iterator[Line]:
    from splatpainter.io import read
    from splatpainter.rendering import render

    splats, camera = read(inputs / "100k.ply"), camera_of(inputs / "100k_dab.png")
    yield from repeated("render", only, lambda: lambda: render(splats, camera), 15)

    def gradients() -> Callable[[], Any]:
        import torch

        names = ("means", "quats", "scales", "opacities", "sh")
        tensors = splats.torch()
        leaves = {name: getattr(tensors, name).clone().requires_grad_(True) for name in names}
        tensors = replace(tensors, **leaves)
        cotangent = torch.rand((1, SIZE, SIZE, 3), generator=torch.Generator().manual_seed(0))

        def work() -> None:
            for leaf in leaves.values():
                leaf.grad = None
            (render(tensors, camera).colors * cotangent).sum().backward()

        return work

    yield from repeated("render and gradients", only, gradients, 15)

    def rays() -> Callable[[], Any]:
        from splatpainter.voxels.grid import voxelize
        from splatpainter.voxels.raycast import first_hits

        grid = voxelize(splats)
        origin, directions = camera.rays()
        return lambda: first_hits(grid.occupancy, grid, origin, directions)

    yield from repeated("rays of all pixels to voxels", only, rays, 15)


def editing(inputs: Path, only: list[str]) -> Iterator[Line]:
    yield from edits(inputs, only, "100k", "", (("dab", 11), ("text", 7), ("grade", 5)))


def edits(inputs: Path, only: list[str], scene: str, words: str, kinds: tuple[tuple[str, int], ...]) -> Iterator[Line]:
    """Whole edits as calls: mask, lift, receipt with its hashes and scores."""
    import numpy as np
    from PIL import Image

    from splatpainter.io import read
    from splatpainter.painter import Edit, Painter

    names = {"dab": "dab", "text": "text and stroke", "grade": "global edit, one view"}
    painter = Painter.load("lift")
    asset = painter.encode(read(inputs / f"{scene}.ply"))
    assert asset.grid is not None  # once per asset
    for kind, repeats in kinds:
        picture = inputs / f"{scene}_{kind}.png"

        def prepare(picture: Path = picture, mode: Any = "global" if kind == "grade" else "local") -> Callable[[], Any]:
            edit = Edit(np.asarray(Image.open(picture)), camera_of(picture))
            return lambda: painter.apply(asset, [edit], mode=mode)

        yield from repeated(f"{words}{names[kind]}", only, prepare, repeats, 8)


def processes(inputs: Path, only: list[str]) -> Iterator[Line]:
    command = [sys.executable, "-m", "splatpainter"]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.ply"
        demo = [*command, "edit", str(inputs / "demo.ply"), str(inputs / "demo.png"), "--out", str(out)]
        dab = [*command, "edit", str(inputs / "100k.ply"), str(inputs / "100k_dab.png"), "--out", str(out)]
        yield from process("process: the demo's edit", only, [*demo, "--mode", "local", "--overwrite"], 5)
        yield from process("process: a dab's edit", only, [*dab, "--overwrite"], 5)
        out.touch()
        yield from process("process: refused, already exists", only, dab, 5, code=2)
        yield from process("process: info", only, [*command, "info", str(inputs / "demo.ply")], 5)
        yield from process("process: --help", only, [*command, "--help"], 5)


def million(inputs: Path, only: list[str]) -> Iterator[Line]:
    from splatpainter.io import read
    from splatpainter.rendering import render

    splats, camera = read(inputs / "1m.ply"), camera_of(inputs / "1m_dab.png")
    yield from repeated("1 M: render", only, lambda: lambda: render(splats, camera), 7)
    yield from edits(inputs, only, "1m", "1 M: ", (("dab", 5), ("grade", 3)))


def files(inputs: Path, only: list[str]) -> Iterator[Line]:
    """Reading and writing, in turn with gsply."""
    from splatpainter.io import read, write

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.ply"
        splats = read(inputs / "1m.ply")
        sh = splats.sh.copy()
        sh[::100, 0] += 0.1
        edited = replace(splats, sh=sh)

        def gsply_write() -> Callable[[], Any]:
            import gsply

            data = gsply.plyread(str(inputs / "1m.ply"))
            return lambda: gsply.plywrite(str(out), data)

        def gsply_read() -> Callable[[], Any]:
            import gsply

            return lambda: gsply.plyread(str(inputs / "1m.ply"))

        yield from repeated("1 M: read PLY", only, lambda: lambda: read(inputs / "1m.ply"), 7)
        yield from repeated("1 M: read PLY, gsply", only, gsply_read, 7)
        yield from repeated("1 M: write PLY", only, lambda: lambda: write(out, edited, overwrite=True), 7)
        yield from repeated("1 M: write PLY, gsply", only, gsply_write, 7)


def conversions(inputs: Path, only: list[str]) -> Iterator[Line]:
    other = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
    with tempfile.TemporaryDirectory() as folder:
        for source, ending in CONVERSIONS:
            name, paths = f"1 M: convert {source[3:]} to {ending}", (str(inputs / source), f"{folder}/out.{ending}")
            ours = [sys.executable, "-m", "splatpainter", "convert", paths[0], paths[1], "--overwrite"]
            yield from process(name, only, ours, 3)
            if other:
                with contextlib.suppress(RuntimeError):  # a format that this version of it does not write
                    yield from process(f"{name}, splat-transform", only, [*other.split(), "-w", *paths], 3)
        if not other:
            yield Line("1 M: convert, splat-transform", None, remark="not there: SPLAT_TRANSFORM names no program")


def studio(inputs: Path, only: list[str]) -> Iterator[Line]:
    """What the page waits for, over its socket."""
    if only and not any(word in "studio: preview stroke text slider" for word in only):
        return
    try:
        import fastapi  # noqa: F401 - the studio's extra
        from splatbench import studio as bench
        from splatbench.studio_client import browsing, serving
    except ImportError as error:
        yield Line("studio", None, remark=f"not there: {error.name}")
        return
    wanted = {
        "preview of a stroke": "preview of a stroke",
        "stroke committed": "stroke",
        "dab committed": "dab",
        "text committed": "text",
        "slider previewed": "slider",
    }
    for scene, words, repeats in (("100k", "studio", 5), ("1m", "1 M: studio", 3)):
        with tempfile.TemporaryDirectory() as folder, serving(inputs / f"{scene}.ply", Path(folder)) as server:
            with browsing(server.url) as browser:
                view = bench.view(browser.hello()["state"]["asset"]["home"], SIZE)
                for entry in (*bench._painting(browser, view, repeats), *bench._looks(browser, repeats)):
                    if entry.what in wanted:
                        yield Line(f"{words}: {wanted[entry.what]}", entry.median)


GROUPS: dict[str, Callable[[Path, list[str]], Iterator[Line]]] = {
    "drawing": drawing,
    "editing": editing,
    "processes": processes,
    "studio": studio,
    "million": million,
    "files": files,
    "conversions": conversions,
}


# ---- what it is measured on


def camera_of(picture: Path) -> Any:
    from splatpainter.cameras import Camera

    return Camera.from_json(picture.with_suffix(".json").read_text(encoding="utf-8"))


def make(folder: Path) -> None:
    """The bundled asset's surface of 100,000 and 1,000,000 Gaussians, pictures of it with paint, the demo's own edit,
    and a SOG file to convert."""
    from splatbench.scenes import SavedScene, resampled, save_scene

    from splatpainter.commands import demo
    from splatpainter.demo_asset import demo_asset
    from splatpainter.io import write
    from splatpainter.output_paths import save_picture

    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        for name, count in SCENES.items():
            save_scene(Path(temporary) / name, resampled(demo_asset(), count, 1))
            scene = SavedScene(Path(temporary) / name, SIZE)
            shutil.copyfile(scene.ply, folder / f"{name}.ply")
            for kind in ("dab", "text", "grade"):
                save_picture(folder / f"{name}_{kind}.png", scene.edited(kind)[0], scene.camera)
        write(folder / "1m.sog", SavedScene(Path(temporary) / "1m", SIZE).splats, overwrite=True)
        demo.run(demo.Config(Path(temporary) / "demo"))
        shutil.copyfile(Path(temporary) / "demo" / "asset.ply", folder / "demo.ply")
        shutil.copyfile(Path(temporary) / "demo" / "edited.png", folder / "demo.png")


if __name__ == "__main__":
    sys.exit(main())
