"""`splatpainter data`: training and evaluation data. The rendering itself is in `data`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.commands.parts.terminal import count, progress, size, warn
from splatpainter.output_paths import check_folder
from splattrain.data.object_sources import HELD_OUT_SHARE

if TYPE_CHECKING:
    from splattrain.data.jobs import RenderJob
    from splattrain.data.sample_recipes import SampleRecipe

SUMMARIES = {
    "render": "render samples of every object into WebDataset shards; resumes where it stopped",
    "check": "compare shards with their index; exit 1 if one is damaged or scenes are missing",
    "list": "list the objects of a source, why some cannot be read, and the split",
}
MAX_LINES = 12
"""Lines of skipped objects and of problems that people see; --json has all."""
SourceArgument = Annotated[Positional[str], arg(metavar="SOURCE")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
OfRecipe = Annotated[int | None, arg(metavar="INT", help_behavior_hint="")]


def dispatch(words: Sequence[str]) -> Outcome:
    """`data NAME ...`. Raises ValueError for another NAME."""
    if not words or words[0] in ("-h", "--help"):
        return Outcome({"data": SUMMARIES}, [_help()])
    if words[0] not in SUMMARIES:
        raise ValueError(f"splatpainter data: expected one of {', '.join(SUMMARIES)}, got {words[0]!r}")
    kind, run = {"render": (RenderConfig, render), "check": (CheckConfig, check), "list": (ListConfig, listing)}[
        words[0]
    ]
    config = parse(kind, f"splatpainter data {words[0]}", words[1:])
    outcome = run(config)
    return outcome.as_json() if config.json else outcome


@dataclass(frozen=True)
class RenderConfig:
    """Render training samples into shards. Stopped and started again, it loses at most the scenes in progress.

    example:
      splatpainter data render meshes/ --out shards --environments hdris/ --workers 4
      splatpainter data render procedural:200 --out shards --kinds stroke text relight --size 128
      splatpainter data render meshes/ --out truth --truth path --split validation --linear
      splatpainter data render objaverse/ --out shards --recipe paper --workers 16
    """

    source: SourceArgument
    """A folder of meshes (GLB, glTF, OBJ), a folder of splat assets, or procedural:COUNT."""
    out: Annotated[Path, arg(metavar="SHARDS")]
    """Folder for the shards and their index.json; made if missing, continued if it holds shards of the same options."""
    truth: Literal["surfels", "path"] = "surfels"
    """surfels: milliseconds a view, every kind of edit; path: Mitsuba, seconds a view, relight, zoom and plain."""
    recipe: str = "unified"
    """Recipe to start from: unified, local, global, lrm, paper, or a JSON file of `train` (its samples)."""
    kinds: tuple[str, ...] = ()
    """Only these kinds of edits, in equal parts; default: the recipe's (path traced: relight and zoom)."""
    size: OfRecipe = None
    """Pixels of every picture's edge; default: the recipe's (128; paper: 512)."""
    rows: OfRecipe = None
    """Gaussians of each asset; default: the recipe's (8,000; paper: 60,000)."""
    surfels: OfRecipe = None
    """Surfels (dense Gaussians) of each ground truth; default: the recipe's (60,000; paper: 400,000)."""
    base_views: OfRecipe = None
    """Views of the unedited object, which `train lrm` of models without geometry reads (preset paper: 9); default: the
    recipe's (6; lrm: 8; paper: 16)."""
    novel_views: OfRecipe = None
    """Views for the loss; default: the recipe's (4)."""
    sh_degree: OfRecipe = None
    """Spherical harmonics of asset and truth, 0 to 2; default: the recipe's (1; paper: 2)."""
    samples: int = 8
    """Samples per scene; they share the object, its light and the asset."""
    scenes: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None
    """How many scenes; default: one per object. More go through the objects again, in other light."""
    seed: int = 0
    """Equal seeds and options give equal samples."""
    split: Literal["all", "train", "validation"] = "all"
    """Which objects: all, or one side of the split (see data list)."""
    share: float = HELD_OUT_SHARE
    """Share of the objects that is for validation."""
    environments: Folder = None
    """Folder of .hdr and .exr light; without it, procedural skies."""
    decals: Folder = None
    """Folder of stickers (pictures with transparency)."""
    fonts: Folder = None
    """Folder of TrueType and OpenType fonts."""
    textures: Folder = None
    """Folder of photos, for photo patches and procedural objects."""
    spp: int = 64
    """Paths per pixel (path traced)."""
    bounces: int = 5
    """Most bounces of a path (path traced)."""
    linear: bool = False
    """Keep 16-bit linear pictures (OpenEXR halves) beside the PNGs (path traced)."""
    per_shard: int = 32
    """Scenes per shard file."""
    workers: int = 1
    """Worker processes; with --ray and an address: how many tasks at a time (1: as many as the cluster has CPUs)."""
    ray: Annotated[tuple[str, ...] | None, arg(metavar="[ADDRESS]", help_behavior_hint="")] = None
    """Spread scenes by Ray: over the cluster at ADDRESS (auto, HOST:PORT, ray://HOST:PORT), or a local Ray."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class CheckConfig:
    """Compare every shard with its size and checksum in index.json.

    example:
      splatpainter data check shards
    """

    shards: Annotated[Positional[Path], arg(metavar="SHARDS")]
    """Folder written by data render."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class ListConfig:
    """Show the objects of a source, which of them cannot be read and why, and on which side of the split each is.

    example:
      splatpainter data list meshes/
    """

    source: SourceArgument
    """A folder of meshes, a folder of splat assets, or procedural:COUNT."""
    share: float = HELD_OUT_SHARE
    """Share of the objects that is for validation."""
    seed: int = 0
    """Seed of procedural objects."""
    names_only: bool = False
    """List names only; do not read the files."""
    json: bool = False
    """Print one JSON object instead of text."""


def render(config: RenderConfig) -> Outcome:
    """Make the scenes that are missing, and write them as they come. Raises ValueError as `job_of`, and where not one
    sample could be made."""
    from splatpainter.batch.cluster import LostTask
    from splattrain.data.jobs import open_source
    from splattrain.data.shards import RenderedScene, ShardWriter

    job, dark = job_of(config)
    source = open_source(job)
    check_folder(config.out)
    scene_count = len(source) if config.scenes is None else config.scenes
    kinds: Counter[str] = Counter()
    with ShardWriter(config.out, job.spec(), scene_count, config.per_shard) as writer:
        missing = writer.missing()
        with closing(_results(config, job, missing)) as results:
            for number, scene in progress(results, len(missing), "scenes"):
                if isinstance(scene, LostTask):
                    scene = RenderedScene(source.name(number % len(source)), skipped=[scene.reason])
                writer.add(number, scene)
                kinds.update(scene.kinds)
        index = writer.index
    samples = sum(len(scene["samples"]) for shard in index["shards"] for scene in shard["scenes"])
    reasons = [f"{entry['object']}: {entry['reason']}" for entry in index["skipped"]]
    if not samples:
        scenes, last = count(index["scenes"], "scene"), reasons[-1] if reasons else "there was none"
        raise ValueError(f"splatpainter data render: no sample of {scenes} could be made; the last: {last}")
    written = sum(shard["bytes"] for shard in index["shards"])
    record = {
        "out": config.out,
        "scenes": index["scenes"],
        "made": len(missing),
        "kinds": dict(sorted(kinds.items())),
        "samples": samples,
        "shards": len(index["shards"]),
        "bytes": written,
        "skipped": index["skipped"],
        "environments_skipped": dark,
    }
    made = f"{count(len(missing), 'scene')} made, {index['scenes'] - len(missing):,} there before"
    lines = [f"{count(samples, 'sample')} in {count(len(index['shards']), 'shard')} ({size(written)}); {made}"]
    if kinds:
        lines.append("made: " + ", ".join(f"{number} {kind}" for kind, number in sorted(kinds.items())))
    return Outcome(record, [*lines, *_some("skipped", reasons), f"-> {config.out}"])


def job_of(config: RenderConfig) -> tuple[RenderJob, dict[str, str]]:
    """(the job that the options ask for, environments that cannot be used: name -> why). Raises ValueError."""
    from splattrain.data.jobs import RenderJob, open_source
    from splattrain.data.pathtrace import PathOptions

    for name, value, low in (
        ("--scenes", 1 if config.scenes is None else config.scenes, 1),
        ("--workers", config.workers, 1),
        ("--per-shard", config.per_shard, 1),
        ("--bounces", config.bounces, 1),
        ("--seed", config.seed, 0),
    ):
        if value < low:
            raise ValueError(f"splatpainter data render: expected {name} of at least {low}, got {value}")
    if config.ray is not None and len(config.ray) > 1:
        raise ValueError(f"splatpainter data render: expected one address behind --ray, got {len(config.ray)}")
    traced = config.truth == "path"
    chosen = config.kinds or (("relight", "zoom") if traced and config.recipe != "lrm" else ())
    named = ("size", "rows", "surfels", "base_views", "novel_views", "sh_degree")
    given = {name: value for name in named if (value := getattr(config, name)) is not None}
    kinds = {"kinds": dict.fromkeys(chosen, 1.0)} if chosen else {}
    recipe = replace(_sample_recipe(config.recipe), **kinds, **given, steps_per_object=config.samples)
    lights, dark = _environments(config.environments)
    job = RenderJob(
        config.source if config.source.startswith("procedural:") else str(Path(config.source).resolve()),
        recipe,
        config.truth,
        config.seed,
        config.split,
        config.share,
        environments=lights,
        decals=_folder(config.decals, "decals"),
        fonts=_folder(config.fonts, "fonts"),
        textures=_folder(config.textures, "textures"),
        path=PathOptions(config.spp, config.bounces + 1, config.seed % 2**32),
        exr=config.linear,
    )
    if config.linear and not traced:
        raise ValueError("splatpainter data render: --linear needs --truth path; surfels are made in display colours")
    if traced:
        from splattrain.data.mitsuba_backend import use_mitsuba
        from splattrain.data.path_samples import refuse_kinds

        refuse_kinds(recipe)
        use_mitsuba()
        if not hasattr(open_source(job), "mesh"):
            raise ValueError(f"{config.source}: holds splat assets; path tracing needs meshes, use --truth surfels")
    return job, dark


def _sample_recipe(name: str) -> SampleRecipe:
    """The samples of a name, or of a recipe of training. Raises ValueError for neither, and for what is wrong in it."""
    from splattrain.data.sample_recipes import RECIPES

    if name in RECIPES:
        return RECIPES[name]
    if not Path(name).is_file():
        raise ValueError(
            f"splatpainter data render: --recipe {name}: expected one of {', '.join(RECIPES)}, or a JSON file of train"
        )
    from splatpainter.system.jsonio import load_object
    from splattrain import recipes

    text = Path(name).read_text(encoding="utf-8", errors="replace")
    return recipes.parse(text, load_object(text, name, "recipe").get("stage", "refine"), name).samples


def check(config: CheckConfig) -> Outcome:
    """Say what is in the shards, and what is wrong with them."""
    from splattrain.data.shards import check as examine

    health = examine(config.shards)
    record = {
        "shards": health.shards,
        "samples": health.samples,
        "scenes": {"wanted": health.scenes, "in shards or skipped": health.finished, "waiting": health.waiting},
        "skipped": health.skipped,
        "problems": health.problems,
        "complete": health.complete,
    }
    lines = [
        f"{count(health.samples, 'sample')} in {count(health.shards, 'shard')}; "
        f"{health.finished:,} of {count(health.scenes, 'scene')} finished, {health.skipped:,} skipped"
    ]
    if health.waiting:
        lines.append(f"{count(health.waiting, 'scene')} more, waiting for a full shard")
    if health.finished < health.scenes:
        lines.append("not complete: run the same data render again to resume")
    lines += _some("problem", list(health.problems))
    if health.complete:
        lines.append("all shards are as they were written")
    return Outcome(record, lines, 0 if health.complete else 1)


def listing(config: ListConfig) -> Outcome:
    """Read every object and say what it is."""
    from splattrain.data.jobs import RenderJob, open_source
    from splattrain.data.object_sources import split
    from splattrain.data.sample_recipes import RECIPES

    source: Any = open_source(RenderJob(config.source, RECIPES["unified"], seed=config.seed))
    names = [source.name(i) for i in range(len(source))]
    validation = set(split(names, share=config.share)[1])
    objects = []
    for i, name in progress(enumerate(names), len(names), "reading"):
        entry = {"name": name, "split": "validation" if name in validation else "train"}
        objects.append(entry if config.names_only else {**entry, **_described(source, i)})
    skipped = {entry["name"]: entry["skipped"] for entry in objects if "skipped" in entry}
    kind = "meshes" if hasattr(source, "mesh") else "splat assets"
    record = {"source": config.source, "kind": kind, "objects": objects, "skipped": skipped}
    width = max(len(name) for name in names)
    lines = [_line(entry, width) for entry in objects if "skipped" not in entry]
    good = len(objects) - len(skipped)
    lines.append(f"{count(good, 'object')} ({kind}), {len(validation):,} of {len(names):,} for validation")
    lines += [f"skipped {reason}" for reason in skipped.values()]
    return Outcome(record, lines)


def _results(config: RenderConfig, job: RenderJob, missing: list[int]) -> Generator[tuple[int, Any]]:
    from splatpainter.batch import cluster
    from splattrain.data.jobs import render_scene

    work = partial(render_scene, job)
    if not missing:
        return cluster.run_here(work, missing)
    if config.ray is not None:
        local = not config.ray
        workers = config.workers if local or config.workers > 1 else None
        return cluster.run_on_ray(work, missing, None if local else config.ray[0], workers)
    if config.workers > 1:
        return cluster.run_in_pool(work, missing, config.workers)
    return cluster.run_here(work, missing)


def _folder(path: Path | None, name: str) -> str:
    if path is None:
        return ""
    if not path.is_dir():
        raise ValueError(f"splatpainter data render: --{name} {path}: no such folder")
    return str(path.resolve())


def _environments(path: Path | None) -> tuple[tuple[str, ...], dict[str, str]]:
    """(files that can be used, name -> why not). Raises ValueError: no such folder, or nothing in it can be used."""
    from splattrain.data.environments import load_environment

    good, bad = [], {}
    folder = _folder(path, "environments")
    if not folder:
        return (), {}
    for file in sorted(Path(folder).iterdir()):
        if file.suffix.lower() in (".hdr", ".exr"):
            try:
                load_environment(file)
                good.append(str(file))
            except ValueError as error:
                bad[file.name] = str(error)
                warn(f"light skipped: {error}")
    if not good:
        raise ValueError(f"{path}: holds no environment (.hdr, .exr) that can be used; {len(bad)} were skipped")
    return tuple(good), bad


def _described(source: Any, i: int) -> dict[str, Any]:
    try:
        if hasattr(source, "mesh"):
            mesh = source.mesh(i)
            return {"triangles": len(mesh.faces), "materials": len(mesh.materials)}
        return {"rows": len(source.splats(i))}
    except ValueError as error:
        return {"skipped": str(error)}


def _line(entry: dict[str, Any], width: int) -> str:
    facts = [f"{entry[key]:>9,} {key}" for key in ("triangles", "materials", "rows") if key in entry]
    return "  ".join([f"{entry['name']:<{width}}", f"{entry['split']:<10}", *facts]).rstrip()


def _some(what: str, lines: list[str]) -> list[str]:
    rest = [f"... and {len(lines) - MAX_LINES:,} more; --json shows all"] if len(lines) > MAX_LINES else []
    return [f"{what:<8} {line}" for line in lines[:MAX_LINES]] + rest


def _help() -> str:
    rows = [f"  {name:<7} {line}" for name, line in SUMMARIES.items()]
    example = "example:\n  splatpainter data render procedural:100 --out shards"
    return "\n".join(["usage: splatpainter data NAME ...", "", "commands:", *rows, "", example])
