"""`splatpainter bench`: tables of measured numbers. Only words are understood here; what measures is loaded after."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from splatbench.cases import DATA_FOLDERS, Budget, RunConfig, Setup
from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.commands.parts.terminal import PROGRAM, complain, watched
from splatpainter.io.files import read_all
from splatpainter.output_paths import check_folder

MEASUREMENTS = {
    "speed": "time and peak memory of every stage, on scenes of several sizes",
    "peers": "ours beside gsply, Mitsuba and splat-transform on the same files",
    "lift": "quality of local edits on given assets, with a contact sheet",
    "painted": "quality of paint on held-out meshes, in novel views, against the painted surface",
    "adapt": "what carries an edit to Gaussians that no picture shows: test-time training and others, at equal cost",
    "spread": "how well mode spread carries a recoloured material on to where the edited view does not look",
    "light": "quality of new light on held-out meshes, in novel views, against path-traced truth",
    "studio": "what an artist waits for in the studio, and its server's memory",
}
TABLES = {
    "refine": "the paper's Tab. 1: detail from zoomed-in views",
    "relight": "the paper's Tab. 2: light from one, two and four relit views",
    "creative": "the paper's Tab. 3: painted, stickered, lettered and recoloured views",
    "compress": "the paper's Tab. 4: what Stage I keeps of an asset",
    "sequence": "edits in a row: views one after the other, conflicts, forgetting",
    "ablate": "ablations: every switch of the design",
}
REPORT = {"report": "one HTML page of the paper's tables that were measured"}
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
"""--quick of single tables: ablate has two cases for each object asked for, and the most methods."""
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
MINIMUM = {
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
FOLDERS = (*DATA_FOLDERS, "perceptual_weights")
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]


@dataclass(frozen=True)
class TableOptions(Setup):
    """Measure one of the paper's tables: the asset before, ours, optimisation, other systems.

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
    """How many objects to measure."""
    held_out: bool = True
    """Only objects that training never sees (their names decide); --no-held-out: any object."""
    names: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Text file: the objects to measure, one name a line, which training held out by the same list."""
    truth: Literal["traced", "surfels"] = "traced"
    """traced: by Mitsuba; surfels: of dense Gaussians, in seconds instead of minutes, with approximate light."""
    base_views: int = Setup.base_views
    """Views that an asset is built from."""
    novel_views: int = Setup.novel_views
    """Views that results are scored on."""
    seed: int = 0
    """Seed of objects, views, edits and methods."""
    methods: tuple[str, ...] = ()
    """Methods (rows of the table) to measure, by name, or "all"; default: those that belong to the table. "list" names
    them."""
    steps: int = 1000
    """Steps of methods that optimise."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the methods run."""
    curve: bool = False
    """Also measure intermediate results of methods that optimise, for the plot of quality against seconds."""
    weights: Annotated[tuple[str, ...], arg(metavar="NAME=FOLDER ...", help_behavior_hint="")] = ()
    """Weights for rows that need others than the package's."""
    adapters: Annotated[Path | None, arg(metavar="TOML", help_behavior_hint="")] = None
    """File that says how systems outside this package are called; default: none is installed."""
    perceptual_weights: Folder = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL; without them LPIPS is n/a."""
    out: Path = Path("out/bench")
    """Folder for all tables of one setup: cases of other sizes or another seed need another folder, or --redo all."""
    processes: int = 1
    """Processes that make ground truth at once."""
    parallel_methods: bool = False
    """Let methods run side by side, too (as many as --processes); their seconds then compare less well."""
    shard: str = "0/1"
    """K/N: only every N-th object from number K on, so that N machines fill one folder."""
    redo: Literal["nothing", "errors", "all"] = "nothing"
    """What is measured again though nothing changed; "all" also makes cases of another setup anew."""
    quick: bool = False
    """Two small objects, few views and steps: shows in a minute or two that every part works (out/bench-quick)."""
    full: bool = False
    """The paper's sizes: days on a CPU."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class ReportOptions:
    """Build one HTML page of tables, plots and pictures from folders that benches wrote.

    example:
      splatpainter bench report out/bench --out out/report
      splatpainter bench report out/bench --markdown docs/RESULTS.md
    """

    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="OUT ...", help_behavior_hint="")]
    """Folders of benches: OUT, or OUT/PROTOCOL."""
    out: Path = Path("out/report")
    """Folder for index.html, which holds everything."""
    markdown: Annotated[Path | None, arg(metavar="FILE.md", help_behavior_hint="")] = None
    """Also write the tables as Markdown, with plots and sheets in a folder beside it."""
    about: Annotated[Path | None, arg(metavar="FILE.md", help_behavior_hint="")] = None
    """Text that stands first in --markdown."""
    json: bool = False
    """Print one JSON object instead of text."""


def dispatch(words: Sequence[str]) -> Outcome:
    """`bench NAME ...`. Raises ValueError for another NAME."""
    summaries = MEASUREMENTS | TABLES | REPORT
    if not words or words[0] in ("-h", "--help"):
        return Outcome({"benches": summaries}, [_help(summaries)])
    name, rest = words[0], words[1:]
    if name in MEASUREMENTS:
        return measure(name, rest)
    if name in TABLES:
        return bench(name, rest)
    if name in REPORT:
        return report(rest)
    raise ValueError(f"{PROGRAM} bench: expected one of {', '.join(summaries)}, got {name!r}")


@dataclass(frozen=True)
class JsonOption:
    json: bool = False
    """Print one JSON object instead of text."""


def measure(name: str, words: Sequence[str]) -> Outcome:
    """One of MEASUREMENTS. Raises ValueError for words and files that make no sense."""
    from splatpainter.text_tables import markdown

    module_name, options_name = {
        "speed": ("speed", "SpeedBench"),
        "peers": ("peers", "PeersBench"),
        "lift": ("local_edits", "LiftBench"),
        "painted": ("painted", "PaintedBench"),
        "adapt": ("adapt", "AdaptBench"),
        "spread": ("spread", "SpreadBench"),
        "light": ("light", "LightBench"),
        "studio": ("studio", "StudioBench"),
    }[name]
    try:
        module = import_module(f"splatbench.{module_name}")
    except ImportError as error:
        raise ValueError(f"{PROGRAM} bench {name}: needs {error.name}; pip install 'splatpainter[studio]'") from None
    options = getattr(module, options_name)
    kind = dataclasses.make_dataclass("Options", [], bases=(JsonOption, options), frozen=True)
    kind.__doc__ = options.__doc__
    config = parse(kind, f"{PROGRAM} bench {name}", words)
    check_folder(config.out)
    lines = module.run(config, _say)
    record = {"out": config.out, "lines": [asdict(line) for line in lines]}
    return _outcome(record, [markdown(lines), f"-> {config.out}"], 0, config.json)


def bench(name: str, words: Sequence[str]) -> Outcome:
    """One table. Raises ValueError, before any work, for words and files that make no sense."""
    program = f"{PROGRAM} bench {name}"
    options = preset(parse(TableOptions, program, words), words, name)
    check(options, program)
    perceptual = _perceptual(options.perceptual_weights)
    from splatbench.methods import ALIASES, all_methods

    methods = all_methods()
    if options.methods == ("list",):
        labels = {m.name: m.label + ("" if name in m.protocols else " (not by default)") for m in methods.values()}
        lines = [f"{method:<24} {label}" for method, label in labels.items()]
        return _outcome({"methods": labels}, lines, 0, options.json)
    by_default = tuple(m.name for m in methods.values() if name in m.protocols)
    given = tuple(ALIASES.get(method, method) for method in options.methods)
    chosen = by_default if not given else tuple(methods) if "all" in given else given
    if unknown := [method for method in chosen if method not in methods]:
        raise ValueError(f"{program}: expected --methods of {', '.join(methods)}, got {unknown[0]!r}")
    from splatbench.report.gallery import write_contact_sheet
    from splatbench.runner import run

    weights = named_folders(options.weights, program)
    refuse_seen_objects(options, weights, program)
    config = RunConfig(
        protocol=name,
        setup=Setup(**{field.name: getattr(options, field.name) for field in dataclasses.fields(Setup)}),
        methods=chosen,
        budget=Budget(options.steps, options.device, options.seed, weights, options.adapters, curve=options.curve),
        out=options.out,
        processes=options.processes,
        shard=shard(options.shard, program),
        redo=options.redo,
        perceptual=perceptual,
        parallel_methods=options.parallel_methods,
        named=bool(options.methods),
    )
    result = run(config, _say)
    sheet = write_contact_sheet(result.folder, result.folder / "sheet.png")
    lines = [result.table, "", *(f"- {note}" for note in result.notes), f"-> {result.folder}"]
    record = {
        "protocol": name,
        "out": result.folder,
        "sheet": sheet,
        "complete": result.complete,
        "rows": [{"asked" if k == "all_cases" else k: v for k, v in asdict(row).items()} for row in result.rows],
        "notes": result.notes,
    }
    return _outcome(record, lines, 0 if result.complete else 1, options.json)


def refuse_seen_objects(setup: Setup, weights: Mapping[str, str], program: str) -> None:
    """Raises ValueError where given weights were trained on objects that the setup takes for held out, as far as their
    notes tell; and for --names without what they are names of."""
    from splatpainter.models import checkpoint
    from splattrain.data.held_out import HeldOut

    if setup.names is not None and (setup.data is None or not setup.held_out):
        raise ValueError(f"{program}: --names needs --data, and no --no-held-out")
    rule = HeldOut() if setup.names is None else HeldOut.of_file(setup.names)
    if setup.data is None or not setup.held_out:
        return
    for name, folder in weights.items():
        try:
            problem = rule.leak(checkpoint.notes(folder))
        except ValueError:
            continue  # the method that needs them says what is wrong
        if problem:
            raise ValueError(f"{program}: --weights {name}={folder}: {problem}; --no-held-out measures any object")


def report(words: Sequence[str]) -> Outcome:
    """The page. Raises ValueError: no folder of a bench among those given, a place that cannot be written."""
    program = f"{PROGRAM} bench report"
    config = parse(ReportOptions, program, words)
    check_folder(config.out)
    folders = table_folders(config.folders, program)
    from splatbench.report.page import write_page

    record, lines = {"page": write_page(folders, config.out), "folders": folders}, []
    if config.markdown is not None:
        from splatbench.report.page import write_markdown

        about = "" if config.about is None else read_all(config.about).decode(errors="replace")
        record["markdown"] = write_markdown(folders, config.markdown, about)
        lines.append(f"-> {config.markdown}")
    return _outcome(record, [*lines, f"-> {record['page']}"], 0, config.json)


def table_folders(given: Sequence[Path], program: str) -> list[Path]:
    """OUT/PROTOCOL of every folder given, in the order of the tables. Raises ValueError for one that holds none."""
    from splatbench.tables import NAMES

    tables: list[Path] = []
    for folder in given:
        if not folder.is_dir():
            raise ValueError(f"{program}: {folder}: no such folder; expected one that benches wrote")
        inside = [folder / name for name in NAMES if (folder / name / "records").is_dir()]
        itself = [folder] if folder.name in NAMES and (folder / "records").is_dir() else []
        if not inside and not itself:
            raise ValueError(f"{program}: {folder}: holds no table that a bench wrote ({', '.join(NAMES)})")
        tables += itself or inside
    return sorted(tables, key=lambda folder: NAMES.index(folder.name))


def preset(options: TableOptions, words: Sequence[str], name: str) -> TableOptions:
    """The config of a table with the sizes of --quick or --full, where the words do not say otherwise."""
    if options.quick and options.full:
        raise ValueError(f"{PROGRAM} bench {name}: expected --quick or --full, got both")
    given = {word.split("=", 1)[0].removeprefix("--").removeprefix("no-").replace("-", "_") for word in words}
    sizes = QUICK | QUICK_OF.get(name, {}) if options.quick else FULL if options.full else {}
    return dataclasses.replace(options, **{name: value for name, value in sizes.items() if name not in given})


def check(options: TableOptions, program: str) -> None:
    """Raises ValueError for what cannot be: a number too small, a folder or file that is not there."""
    for name, minimum in MINIMUM.items():
        if getattr(options, name) < minimum:
            option = name.replace("_", "-")
            raise ValueError(f"{program}: expected --{option} of at least {minimum}, got {getattr(options, name)}")
    for name in FOLDERS:
        folder = getattr(options, name)
        if folder is not None and not folder.is_dir():
            raise ValueError(f"{program}: --{name.replace('_', '-')}: {folder}: no such folder")
    if options.adapters is not None and not options.adapters.is_file():
        raise ValueError(f"{program}: --adapters: {options.adapters}: no such file")
    named_folders(options.weights, program)
    shard(options.shard, program)
    check_folder(options.out)


def named_folders(words: Sequence[str], program: str) -> dict[str, str]:
    """NAME=FOLDER words. Raises ValueError: another form, a name given twice, no such folder."""
    folders: dict[str, str] = {}
    for word in words:
        name, sign, folder = word.partition("=")
        if not name or not sign or not folder:
            raise ValueError(f"{program}: expected --weights NAME=FOLDER, got {word!r}")
        if name in folders:
            raise ValueError(f"{program}: --weights: {name} was given twice")
        if not Path(folder).is_dir():
            raise ValueError(f"{program}: --weights: {name}: {folder}: no such folder")
        folders[name] = str(Path(folder).absolute())
    return folders


def shard(text: str, program: str) -> tuple[int, int]:
    """ "0/4" -> (0, 4). Raises ValueError."""
    number, sign, count = text.partition("/")
    if not (sign and number.isdecimal() and count.isdecimal() and int(number) < int(count)):
        raise ValueError(f"{program}: expected --shard K/N with K from 0 to N - 1, got {text!r}")
    return int(number), int(count)


def _perceptual(folder: Path | None) -> Path | None:
    """Folder of LPIPS weights, asked for or of the environment. Raises ValueError where one asked for holds none."""
    from splatpainter.metrics.lpips import VARIABLE

    weights = folder or Path(os.environ.get(VARIABLE) or "/")
    if (weights / "lpips_alex.safetensors").is_file():
        return weights
    if folder is not None:
        raise ValueError(f"--perceptual-weights: {folder}: holds no lpips_alex.safetensors")
    return None


def _say(line: str) -> None:
    if watched():
        complain(line)


def _outcome(record: dict[str, Any], lines: list[str], code: int, as_json: bool) -> Outcome:
    outcome = Outcome(record, lines, code)
    return outcome.as_json() if as_json else outcome


def _help(summaries: dict[str, str]) -> str:
    rows = [f"  {name:<8} {line}" for name, line in summaries.items()]
    example = f"example:\n  {PROGRAM} bench speed --quick\n  {PROGRAM} bench refine --quick"
    return "\n".join([f"usage: {PROGRAM} bench NAME ...", "", "benches:", *rows, "", example])
