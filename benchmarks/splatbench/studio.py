"""`bench studio`: what an artist waits for, measured through the real server from outside, and the server's memory."""

from __future__ import annotations

import gzip
import math
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from splatbench import scenes
from splatbench.scenes import DAB_WIDTH, TEXT_HEIGHT, resampled
from splatbench.studio_client import Browser, Mirror, Server, browsing, encoded, serving
from splatbench.timing import machine
from splatpainter import text_tables as tables
from splatpainter.demo_asset import demo_asset
from splatpainter.io import read, write

Report = Callable[[str], None]
START_MS, PREVIEW_MS, COMMIT_MS, SLIDER_MS = 5000.0, 100.0, 800.0, 300.0
"""Targets of waits, milliseconds."""
MEMORY_MIB, GROWTH_MIB, BUNDLE_MIB = 1.5e9 / 2**20, 1.0, 2.5 * 1e6 / 2**20
"""Targets: memory of the server with the demo; growth per 100 edits and undos (none, but for noise); size of the
page."""
MAX_LOAD_GAUSSIANS = 10_000
"""Gaussians of the load test's asset: the test is about many clients, not about many Gaussians."""
STROKE_BATCHES = 12
"""Dab batches of one stroke."""
MEMORY_SAMPLES = 20
"""Measurements of memory over all edits."""
NOTES = (
    "A fresh `splatpainter studio` process, driven over its socket and HTTP as the page drives it; a target is met "
    "when the median meets it. Every time is from sending to the last byte parsed; Gaussians come before answers. "
    "`start`: from the start of the process to the page (HTML, JS, CSS), then every Gaussian, then a picture of the "
    "first view; what the page itself does with them is not in it. `first run`: every kernel is compiled before.",
    "`preview`: one batch of a stroke, 16 px further at 512 px with a brush of 64 px (as large a part of other sizes), "
    "to its previewed Gaussians. `dab` and `text`: from pen-up to the committed, durable layer and its Gaussians: a "
    "soft disc of 64 px, letters 90 px high at 512 px. `undo` and `redo`: of these. Memory: resident, over edits that "
    "are each painted and undone in a view of half the smallest size; its growth is the slope of a straight line "
    "through the second half.",
)


@dataclass(frozen=True)
class StudioBench:
    """Drive the studio's server as a page does; measure every wait, the bytes sent and the server's memory.

    example:
      splatpainter bench studio --edits 200 --clients 20 --out out/bench-studio
    """

    out: Path = Path("out/bench-studio")
    """Folder for studio.csv and studio.md; made if missing."""
    asset: Path | None = None
    """A splat file to paint on; none: the bundled demo asset."""
    rows: int = 100_000
    """Gaussians that the asset is resampled to."""
    sizes: tuple[int, ...] = (512, 1024)
    """Edges of the square views that are painted on, pixels."""
    repeats: int = 9
    """Repeats of strokes, looks and renders at each size."""
    edits: int = 1000
    """Edits, each of them undone, over which memory is measured."""
    clients: int = 0
    """Clients of the load test, each with 200 edits; 0: none."""
    quick: bool = False
    """A tiny scene, 20 edits, few repeats: numbers that only show that it works."""


@dataclass(frozen=True)
class Measurement:
    """One line of the table."""

    what: str
    size: int | None
    """Edge of the square view, pixels; None where there is none."""
    unit: str
    median: float
    worst: float
    target: float | None
    """Target maximum, in the same unit; None where there is none."""
    met: bool | None
    """Whether the median is not above the target."""
    repeats: int


def line(
    what: str, values: list[float], unit: str = "ms", target: float | None = None, size: int | None = None
) -> Measurement:
    """Median and worst of some values."""
    median = statistics.median(values)
    met = None if target is None or math.isnan(median) else median <= target
    return Measurement(what, size, unit, median, max(values), target, met, len(values))


def run(config: StudioBench, report: Report | None = None) -> list[Measurement]:
    """Measure, write studio.csv and studio.md, and return the lines. report: called with one sentence per measurement.
    Raises ValueError for settings that make no sense, RuntimeError where the studio does not do what it should."""
    config = _checked(config)
    report = report or (lambda _: None)
    where, results = machine(), []

    def add(lines: Iterator[Measurement]) -> None:
        for entry in lines:
            results.append(entry)
            end = "" if entry.target is None else f", target {tables.cell_text(entry.target)}"
            verdict = {None: "", True: ": met", False: ": MISSED"}[entry.met]
            median, worst = tables.cell_text(entry.median), tables.cell_text(entry.worst)
            edge = "" if entry.size is None else f" at {entry.size} px"
            report(f"{entry.what}{edge}: {median} {entry.unit} (worst {worst}){end}{verdict}")

    with tempfile.TemporaryDirectory(prefix="splatpainter-bench-") as temporary:
        folder = Path(temporary)
        asset = _scene(config, folder, config.rows)
        add(_page())
        add(_starts(config, asset, folder))
        with serving(asset, folder) as server, browsing(server.url) as browser:
            home = browser.hello()["state"]["asset"]["home"]
            for size in config.sizes:
                add(_painting(browser, view(home, size), config.repeats))
                add(_renders(server, browser, view(home, size), config.repeats))
            add(_looks(browser, config.repeats))
            add(_memory(server, browser, view(home, min(config.sizes) // 2), config.edits))
        if config.clients:
            with serving(_scene(config, folder, min(config.rows, MAX_LOAD_GAUSSIANS)), folder) as server:
                add(_load(server, config.clients, 5 if config.quick else 200))
    config.out.mkdir(parents=True, exist_ok=True)
    tables.write_csv(config.out / "studio.csv", results, where)
    tables.write_markdown(config.out / "studio.md", results, where, NOTES)
    return results


def _checked(config: StudioBench) -> StudioBench:
    if config.quick:
        few = min(config.clients, 3)
        config = replace(
            config, rows=min(config.rows, 2000), sizes=(96,), repeats=2, edits=min(config.edits, 20), clients=few
        )
    if config.rows < 100:
        raise ValueError(f"bench studio: expected --rows of at least 100, got {config.rows}")
    if not config.sizes or min(config.sizes) < 64 or max(config.sizes) > 4096:
        raise ValueError(f"bench studio: expected --sizes of 64 to 4096 pixels, got {list(config.sizes)}")
    if config.repeats < 1 or config.edits < 4 or not 0 <= config.clients <= 200:
        raise ValueError(
            "bench studio: expected --repeats of at least 1, --edits of at least 4 and --clients of 0 to 200, got "
            f"{config.repeats}, {config.edits} and {config.clients}"
        )
    return config


def _scene(config: StudioBench, folder: Path, gaussians: int) -> Path:
    """A PLY of so many Gaussians."""
    path = folder / f"{gaussians}.ply"
    if not path.exists():
        write(path, resampled(demo_asset() if config.asset is None else read(config.asset), gaussians, 1))
    return path


def view(home: dict[str, Any], size: int) -> dict[str, Any]:
    """The asset's first view (a camera on the wire) as a square picture of `size` pixels."""
    scale = size / min(home["width"], home["height"])
    focal = {"fx": home["fx"] * scale, "fy": home["fy"] * scale}
    return {**home, **focal, "width": size, "height": size, "cx": size / 2, "cy": size / 2}


def _page() -> Iterator[Measurement]:
    static = resources.files("splatpainter.server") / "static"
    packed = sum(len(gzip.compress(entry.read_bytes(), mtime=0)) for entry in static.iterdir() if entry.is_file())
    yield line("page: bundle, gzipped", [packed / 2**20], "MiB", BUNDLE_MIB)


def _starts(config: StudioBench, asset: Path, folder: Path) -> Iterator[Measurement]:
    warm = 1 if config.quick else 3
    kinds: list[tuple[str, Path | None]] = [("start", asset)]
    if not config.quick:
        kinds.append(("start with the demo", None))
    for name, opened in kinds:
        times: dict[str, list[float]] = {}
        resident = []
        for _ in range(warm):
            with serving(opened, folder) as server:
                for step, seconds in _first_picture(server).items():
                    times.setdefault(step, []).append(1000 * seconds)
                resident.append(server.memory()[0])
        for step, values in times.items():
            yield line(f"{name}: to the {step}", values, target=START_MS if step == "first picture" else None)
        yield line(f"memory: after {name}", resident, "MiB", MEMORY_MIB)


def _first_picture(server: Server) -> dict[str, float]:
    """Seconds since the process's start after each step that a page takes."""
    seconds = {"address": time.perf_counter() - server.started}
    for path in ("", "studio.js", "studio.css"):
        server.get(path)
    seconds["page"] = time.perf_counter() - server.started
    with browsing(server.url) as browser:
        home = browser.hello()["state"]["asset"]["home"]
        seconds["rows"] = time.perf_counter() - server.started
        server.get("api/blobs/" + browser.do("view.render", camera=home)["picture"])
        seconds["first picture"] = time.perf_counter() - server.started
    return seconds


def _ask(browser: Browser, name: str, /, **fields: Any) -> tuple[dict[str, Any], float]:
    """(a command's answer, milliseconds from sending until it and its Gaussians were parsed)."""
    start = time.perf_counter()
    answer = browser.do(name, **fields)
    return answer, 1000 * (time.perf_counter() - start)


@dataclass(frozen=True)
class StrokePatch:
    """New pixels of a stroke, as the page sends them."""

    x: int
    y: int
    width: int
    height: int
    rgba: str

    @staticmethod
    def of(layer: np.ndarray, box: tuple[float, float, float, float]) -> StrokePatch:
        """The patch of a [H, W, 4] layer (scenes.py) within left, top, right, bottom."""
        height, width = layer.shape[:2]
        left, top = max(int(box[0]), 0), max(int(box[1]), 0)
        right, bottom = min(math.ceil(box[2]), width), min(math.ceil(box[3]), height)
        pixels = (layer[top:bottom, left:right] * 255 + 0.5).astype(np.uint8)
        return StrokePatch(left, top, right - left, bottom - top, encoded(pixels))


def dab_at(size: int, x: float, y: float, tone: int = 0) -> StrokePatch:
    """A soft disc around x, y of a view of `size` pixels."""
    width = DAB_WIDTH * size
    layer = scenes.stroke_layer((size, size), np.array([(x, y)]), width, size / 128, scenes.PALETTE[tone])
    return StrokePatch.of(layer, (x - width / 2, y - width / 2, x + width / 2, y + width / 2))


def stroke_patches(size: int, height: float) -> list[StrokePatch]:
    """Batches of one stroke to the right, at `height` (0..1) of the picture: each holds all paint in its rectangle."""
    half, step = DAB_WIDTH * size / 2, size / 32
    points = np.array([(0.3 * size + k * step, height * size) for k in range(STROKE_BATCHES)])
    out = []
    for k, (x, y) in enumerate(points):
        layer = scenes.stroke_layer((size, size), points[: k + 1], 2 * half, size / 128, scenes.PALETTE[0])
        out.append(StrokePatch.of(layer, (x - half - step * bool(k), y - half, x + half, y + half)))
    return out


def text_patch(size: int, height: float) -> StrokePatch:
    """Letters, their middle at `height` (0..1) of a view."""
    middle = (size / 2, height * size)
    layer = scenes.text_layer("TEA", (size, size), middle, TEXT_HEIGHT * size, scenes.PALETTE[1])
    rows, columns = (np.flatnonzero(layer[..., 3].any(axis)) for axis in (1, 0))
    return StrokePatch.of(layer, (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1))


@dataclass
class StrokeTiming:
    """Milliseconds and bytes of one stroke."""

    begin: float
    previews: list[float]
    preview_bytes: list[int]
    end: float
    end_bytes: int


def stroke(browser: Browser, camera: dict[str, Any], patches: list[StrokePatch]) -> StrokeTiming:
    """Draw and commit. Raises RuntimeError where the paint reached nothing."""
    started, begin = _ask(browser, "paint.begin", camera=camera)
    previews, sizes, reached = [], [], 0
    for patch in patches:
        answer, milliseconds = _ask(browser, "paint.dab", stroke=started["stroke"], **vars(patch))
        previews.append(milliseconds)
        sizes.append(browser.received)
        reached += answer["gaussians"]
    ended, end = _ask(browser, "paint.end", stroke=started["stroke"])
    if not reached or not ended["layer"]["gaussians_edited"]:
        raise RuntimeError("bench: a stroke reached nothing of the asset")
    return StrokeTiming(begin, previews, sizes, end, browser.received)


def _painting(browser: Browser, camera: dict[str, Any], repeats: int) -> Iterator[Measurement]:
    """Strokes, dabs and text on one view, each of them undone, redone and undone."""
    size = camera["width"]
    heights = np.linspace(0.45, 0.55, repeats)
    kinds = {
        "stroke": [stroke_patches(size, height) for height in heights],
        "dab": [[dab_at(size, size / 2, height * size)] for height in heights],
        "text": [[text_patch(size, height)] for height in heights],
    }
    for kind, all_patches in kinds.items():
        painted, times = [], {"undo": [], "redo": []}
        for patches in all_patches:
            painted.append(stroke(browser, camera, patches))
            for command in ("undo", "redo", "undo"):
                times[command].append(_ask(browser, command)[1])
        if kind == "stroke":
            yield line("pen down: view projected", [one.begin for one in painted], size=size)
        previews = [value for one in painted for value in one.previews]
        sent = [count / 1024 for one in painted for count in one.preview_bytes]
        target = PREVIEW_MS if kind == "stroke" else None
        yield line(f"preview of a {kind}", previews, target=target, size=size)
        yield line(f"preview of a {kind}: rows sent", sent, "KiB", size=size)
        yield line(f"{kind} committed", [one.end for one in painted], target=COMMIT_MS, size=size)
        yield line(f"{kind} committed: rows sent", [one.end_bytes / 1024 for one in painted], "KiB", size=size)
        for command, values in times.items():
            yield line(f"{command} of a {kind}", values, size=size)


def _renders(server: Server, browser: Browser, camera: dict[str, Any], repeats: int) -> Iterator[Measurement]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        server.get("api/blobs/" + browser.do("view.render", camera=camera)["picture"])
        times.append(1000 * (time.perf_counter() - start))
    yield line("view rendered and fetched", times, size=camera["width"])


def _looks(browser: Browser, repeats: int) -> Iterator[Measurement]:
    """Sliders that are dragged, one after the other, then kept."""
    times, sent = [], []
    settings = [{"exposure": 0.1 + 0.05 * k, "temperature": 0.2, "contrast": 0.1} for k in range(3 * repeats)]
    for look in settings:
        times.append(_ask(browser, "look.preview", look=look)[1])
        sent.append(browser.received / 1024)
    yield line("slider previewed", times, target=SLIDER_MS)
    yield line("slider previewed: rows sent", sent, "KiB")
    committed, undone = [], []
    for look in settings[:repeats]:
        committed.append(_ask(browser, "look.commit", look=look)[1])
        undone.append(_ask(browser, "undo")[1])
    yield line("slider kept as a layer", committed)
    yield line("undo of a slider", undone)


def _memory(server: Server, browser: Browser, camera: dict[str, Any], edits: int) -> Iterator[Measurement]:
    """Dabs here and there, each of them undone."""
    size, rng = camera["width"], np.random.default_rng(0)
    yield line("memory: before the edits", [server.memory()[0]], "MiB", MEMORY_MIB)
    every, counts, resident = max(edits // MEMORY_SAMPLES, 1), [], []
    for k in range(1, edits + 1):
        x, y = rng.uniform(0.4, 0.6, 2) * size
        stroke(browser, camera, [dab_at(size, x, y, k % len(scenes.PALETTE))])
        browser.do("undo")
        if k % every == 0:
            counts.append(k)
            resident.append(server.memory()[0])
    half = len(counts) // 2
    growth = 100 * float(np.polyfit(counts[half:], resident[half:], 1)[0])
    yield line(f"memory: after {edits} edits and undos", [resident[-1]], "MiB", MEMORY_MIB)
    yield line("memory: largest", [server.memory()[1]], "MiB", MEMORY_MIB)
    yield line("memory: growth per 100 edits and undos", [growth], "MiB", GROWTH_MIB)


def _load(server: Server, clients: int, edits: int) -> Iterator[Measurement]:
    """All clients at once on one session. Raises RuntimeError where one fails, or where they do not end up with equal
    Gaussians."""
    before = server.memory()[0]
    mirrors = [Mirror() for _ in range(clients)]
    times: list[float] = []
    errors: list[BaseException] = []

    def work(k: int) -> None:
        try:
            with browsing(server.url, mirrors[k]) as browser:
                browser.hello()
                times.extend(_commands_of_one(browser, k, edits))
        except BaseException as error:
            errors.append(error)

    start = time.perf_counter()
    threads = [threading.Thread(target=work, args=(k,)) for k in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    seconds = time.perf_counter() - start
    if errors:
        raise RuntimeError(f"bench: a client of the load test failed: {errors[0]}")
    for mirror in mirrors:
        with browsing(server.url, mirror) as browser:
            browser.hello()  # what came while it was away
        same = all(np.array_equal(mirror.columns[name], mirrors[0].columns[name]) for name in mirror.columns)
        if not same or mirror.version != mirrors[0].version:
            raise RuntimeError("bench: clients of the load test do not show the same Gaussians")
    name = f"load: {clients} clients x {edits} edits"
    yield line(f"{name}, one edit", times)
    yield line(f"{name}, edits a second", [len(times) / seconds], "1/s")
    yield line(f"{name}, memory added", [server.memory()[0] - before], "MiB")


def _commands_of_one(browser: Browser, k: int, edits: int) -> list[float]:
    """Milliseconds of each edit: an adjustment layer is made, hidden, faded and deleted."""
    layer, times, versions = "", [], []
    for n in range(edits):
        if n % 4 == 0:
            look = {"exposure": 0.01 * (k + 1), "tint": 0.0001 * (n + 1)}
            answer, milliseconds = _ask(browser, "look.commit", look=look, name=f"look {k}")
            layer = answer["layer"]["id"]
        elif n % 4 == 1:
            answer, milliseconds = _ask(browser, "layer.set", layer=layer, visible=False)
        elif n % 4 == 2:
            answer, milliseconds = _ask(browser, "layer.set", layer=layer, opacity=0.5)
        else:
            answer, milliseconds = _ask(browser, "layer.delete", layer=layer)
        times.append(milliseconds)
        versions.append(answer["version"])
        if browser.mirror.version < answer["version"]:
            raise RuntimeError("an answer came before its Gaussians")
    if versions != sorted(versions):
        raise RuntimeError("answers came out of order")
    return times
