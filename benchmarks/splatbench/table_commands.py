"""`splatpainter bench refine|relight|creative|compress|sequence|ablate`: the paper's tables; `bench report`: a page of
them. The measuring itself is in `evaluate/paper`, whose heavy parts are loaded once the words are understood."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from splatbench.tables import Setup
from splatpainter.commands import Outcome
from splatpainter.commands.options import parse
from splatpainter.commands.targets import check_folder
from splatpainter.commands.terminal import PROGRAM, complain, watched

QUICK: dict[str, Any] = {
    "objects": 2,
    "held_out": False,
    "size": 128,
    "detail": 2,
    "samples": 8,
    "truth": "surfels",
    "rows": 3000,
    "asset_steps": 20,
    "novel_views": 4,
    "lights": 1,
    "steps": 20,
    "processes": 2,
    "parallel_methods": True,
    "out": Path("out/bench-quick"),
}
"""--quick: enough that every number is there. Its seconds mean nothing, so that methods may share the machine."""
QUICK_OF: dict[str, dict[str, Any]] = {"ablate": {"objects": 1}}
"""Of single tables: ablate has two cases for each object asked for, and the most rows."""
FULL: dict[str, Any] = {
    "objects": 370,
    "size": 512,
    "detail": 4,
    "samples": 256,
    "truth": "traced",
    "base_views": 9,
    "rows": 200_000,
    "asset_steps": 30_000,
    "novel_views": 32,
    "lights": 24,
    "steps": 30_000,
}
"""--full: the paper's sizes (its Section 4.1 and supplement). It says neither its paths per pixel nor the steps of its
3DGS rows: 30,000 is the original's default. Its asset is what an LRM makes of the base views; here it is fitted."""
LEAST = {
    "objects": 1,
    "size": 32,
    "detail": 1,
    "samples": 1,
    "base_views": 1,
    "rows": 100,
    "asset_steps": 0,
    "novel_views": 2,
    "lights": 1,
    "seed": 0,
    "steps": 1,
    "processes": 1,
}
FOLDERS = ("data", "environments", "decals", "fonts", "textures", "perceptual_weights")
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]


@dataclass(frozen=True)
class Config(Setup):
    """Measure one of the paper's tables: the asset before, ours, optimisation, other systems, upper bounds.

    Results go to OUT/PROTOCOL: table.md, table.tex, results.csv, summary.csv, sheet.png, and a record per method and
    case. Started again, it goes on where it was. Exit code 0: every row that could run has all figures; 1: some lack,
    the notes say which.

    example:
      splatpainter bench refine --data meshes/ --environments hdris/ --objects 20 --out out/tables
      splatpainter bench relight --quick
    """

    data: Folder = None
    """Folder of meshes (for creative and ablate also of splat assets); default: procedural objects."""
    environments: Folder = None
    """Folder of HDRIs (.hdr, .exr); default: procedural light."""
    decals: Folder = None
    """Folder of stickers (PNG with transparency)."""
    fonts: Folder = None
    """Folder of fonts."""
    textures: Folder = None
    """Folder of photos."""
    objects: int = Setup.objects
    """How many objects."""
    held_out: bool = True
    """Only objects that training never sees (their names decide), or any."""
    truth: Literal["traced", "surfels"] = "traced"
    """traced: by Mitsuba; surfels: of dense Gaussians, in seconds instead of minutes, with approximate light."""
    base_views: int = Setup.base_views
    """Views that an asset is built from."""
    novel_views: int = Setup.novel_views
    """Views that answers are scored on."""
    seed: int = 0
    """Of objects, views, edits and methods."""
    methods: tuple[str, ...] = ()
    """Rows to measure, by name, or "all"; default: those that belong to the table. "list" names them."""
    steps: int = 1000
    """Of methods that optimise."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the methods run."""
    curve: bool = False
    """Also measure what methods that optimise had on the way, for the plot of quality against seconds."""
    weights: Annotated[tuple[str, ...], arg(metavar="NAME=FOLDER ...", help_behavior_hint="")] = ()
    """Weights for rows that need others than the package's."""
    adapters: Annotated[Path | None, arg(metavar="TOML", help_behavior_hint="")] = None
    """File that says how systems outside this package are called; default: none is installed."""
    perceptual_weights: Folder = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL; without them LPIPS is n/a."""
    out: Path = Path("out/bench")
    """Folder for all tables of one setup: cases of other sizes or another seed need another folder, or --redo all."""
    processes: int = 1
    """How many make ground truth at once."""
    parallel_methods: bool = False
    """Let methods run side by side, too (as many as --processes); their seconds then compare less well."""
    shard: str = "0/1"
    """K/N: only every N-th object from number K on, so that N machines fill one folder."""
    redo: Literal["nothing", "errors", "all"] = "nothing"
    """What is measured again though nothing changed; "all" also makes cases of another setup anew."""
    quick: bool = False
    """Two small objects, few views and steps: shows in a minute or two that every part works (out/bench-quick)."""
    full: bool = False
    """The paper's sizes. Days on a processor."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class ReportConfig:
    """Build one HTML page of tables, plots and pictures from folders that benches wrote.

    example:
      splatpainter bench report out/bench --out out/report
      splatpainter bench report out/bench --markdown docs/RESULTS.md
    """

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="OUT ...", help_behavior_hint="")]
    """Folders of benches: OUT, or OUT/PROTOCOL."""
    out: Path = Path("out/report")
    """Folder for index.html and its pictures."""
    markdown: Annotated[Path | None, arg(metavar="FILE.md", help_behavior_hint="")] = None
    """Also write the tables as Markdown, with plots and sheets in a folder beside it."""
    about: Annotated[Path | None, arg(metavar="FILE.md", help_behavior_hint="")] = None
    """Text that stands first in --markdown."""
    json: bool = False
    """Print one JSON object instead of text."""


def bench(name: str, words: Sequence[str]) -> Outcome:
    """One table. Raises ValueError, before any work, for words and files that make no sense."""
    program = f"{PROGRAM} bench {name}"
    config = preset(parse(Config, program, words), words, name)
    check(config, program)
    perceptual = _perceptual(config.perceptual_weights)
    from splatbench.methods import Budget, all_methods

    known = all_methods()
    if config.methods == ("list",):
        shown = {m.name: m.label + ("" if name in m.protocols else " (not by default)") for m in known.values()}
        lines = [f"{method:<24} {label}" for method, label in shown.items()]
        return _shown({"methods": shown}, lines, 0, config.json)
    own = tuple(m.name for m in known.values() if name in m.protocols)
    chosen = own if not config.methods else tuple(known) if "all" in config.methods else config.methods
    if unknown := [method for method in chosen if method not in known]:
        raise ValueError(f"{program}: expected --methods of {', '.join(known)}, got {unknown[0]!r}")
    from splatbench.report.gallery import write_contact_sheet
    from splatbench.runner import Asked, run
    from splatpainter.kernels.compile import ensure_compiled

    weights = named_folders(config.weights, program)
    asked = Asked(
        protocol=name,
        setup=Setup(**{field.name: getattr(config, field.name) for field in dataclasses.fields(Setup)}),
        methods=chosen,
        budget=Budget(config.steps, config.device, config.seed, weights, config.adapters, curve=config.curve),
        out=config.out,
        processes=config.processes,
        shard=shard(config.shard, program),
        redo=config.redo,
        perceptual=perceptual,
        parallel_methods=config.parallel_methods,
        named=bool(config.methods),
    )
    ensure_compiled(progress=watched())
    done = run(asked, _say)
    sheet = write_contact_sheet(done.folder, done.folder / "sheet.png")
    lines = [done.table, "", *(f"- {note}" for note in done.notes), f"-> {done.folder}"]
    record = {
        "protocol": name,
        "out": done.folder,
        "sheet": sheet,
        "complete": done.complete,
        "rows": [dataclasses.asdict(row) for row in done.rows],
        "notes": done.notes,
    }
    return _shown(record, lines, 0 if done.complete else 1, config.json)


def report(words: Sequence[str]) -> Outcome:
    """The page. Raises ValueError: no folder of a bench among those given, a place that cannot be written."""
    program = f"{PROGRAM} bench report"
    config = parse(ReportConfig, program, words)
    check_folder(config.out)
    folders = table_folders(config.folders, program)
    from splatbench.report.page import write_page

    record, lines = {"page": write_page(folders, config.out), "folders": folders}, []
    if config.markdown is not None:
        from splatbench.report.page import write_markdown
        from splatpainter.io.files import read_all

        about = "" if config.about is None else read_all(config.about).decode(errors="replace")
        record["markdown"] = write_markdown(folders, config.markdown, about)
        lines.append(f"-> {config.markdown}")
    return _shown(record, [*lines, f"-> {record['page']}"], 0, config.json)


def table_folders(given: Sequence[Path], program: str) -> list[Path]:
    """OUT/PROTOCOL of every folder given, in the order of the tables. Raises ValueError for one that holds none."""
    from splatbench.tables import NAMES

    found: list[Path] = []
    for folder in given:
        if not folder.is_dir():
            raise ValueError(f"{program}: {folder}: no such folder; expected one that benches wrote")
        inside = [folder / name for name in NAMES if (folder / name / "records").is_dir()]
        own = [folder] if folder.name in NAMES and (folder / "records").is_dir() else []
        if not inside and not own:
            raise ValueError(f"{program}: {folder}: holds no table that a bench wrote ({', '.join(NAMES)})")
        found += own or inside
    return sorted(found, key=lambda folder: NAMES.index(folder.name))


def preset(config: Config, words: Sequence[str], name: str) -> Config:
    """The config of a table with the sizes of --quick or --full, where the words do not say otherwise."""
    if config.quick and config.full:
        raise ValueError(f"{PROGRAM} bench {name}: expected --quick or --full, got both")
    said = {word.split("=", 1)[0].removeprefix("--").removeprefix("no-").replace("-", "_") for word in words}
    sizes = QUICK | QUICK_OF.get(name, {}) if config.quick else FULL if config.full else {}
    return dataclasses.replace(config, **{name: value for name, value in sizes.items() if name not in said})


def check(config: Config, program: str) -> None:
    """Raises ValueError for what cannot be: a number too small, a folder or file that is not there."""
    for name, least in LEAST.items():
        if getattr(config, name) < least:
            option = name.replace("_", "-")
            raise ValueError(f"{program}: expected --{option} of at least {least}, got {getattr(config, name)}")
    for name in FOLDERS:
        folder = getattr(config, name)
        if folder is not None and not folder.is_dir():
            raise ValueError(f"{program}: --{name.replace('_', '-')}: {folder}: no such folder")
    if config.adapters is not None and not config.adapters.is_file():
        raise ValueError(f"{program}: --adapters: {config.adapters}: no such file")
    named_folders(config.weights, program)
    shard(config.shard, program)
    check_folder(config.out)


def named_folders(words: Sequence[str], program: str) -> dict[str, str]:
    """NAME=FOLDER words. Raises ValueError: another form, a name given twice, no such folder."""
    found: dict[str, str] = {}
    for word in words:
        name, sign, folder = word.partition("=")
        if not name or not sign or not folder:
            raise ValueError(f"{program}: expected --weights NAME=FOLDER, got {word!r}")
        if name in found:
            raise ValueError(f"{program}: --weights: {name} was given twice")
        if not Path(folder).is_dir():
            raise ValueError(f"{program}: --weights: {name}: {folder}: no such folder")
        found[name] = str(Path(folder).absolute())
    return found


def shard(text: str, program: str) -> tuple[int, int]:
    """ "0/4" -> (0, 4). Raises ValueError."""
    number, sign, count = text.partition("/")
    if not (sign and number.isdecimal() and count.isdecimal() and int(number) < int(count)):
        raise ValueError(f"{program}: expected --shard K/N with K from 0 to N - 1, got {text!r}")
    return int(number), int(count)


def _perceptual(folder: Path | None) -> Path | None:
    """Folder of LPIPS weights, asked for or of the environment. Raises ValueError where one asked for holds none."""
    from splatpainter.metrics.lpips import VARIABLE

    place = folder or Path(os.environ.get(VARIABLE) or "/")
    if (place / "lpips_alex.safetensors").is_file():
        return place
    if folder is not None:
        raise ValueError(f"--perceptual-weights: {folder}: holds no lpips_alex.safetensors")
    return None


def _say(line: str) -> None:
    if watched():
        complain(line)


def _shown(record: dict[str, Any], lines: list[str], code: int, as_json: bool) -> Outcome:
    outcome = Outcome(record, lines, code)
    return outcome.as_json() if as_json else outcome
