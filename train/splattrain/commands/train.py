"""`splatpainter train STAGE`: the Gaussian LRM, Stage I, the predictor, Stage II (on rows or on pictures), and stages
that other distributions add. The training itself is in `train`, judging in train_judge.py."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_parsing import parse
from splatpainter.output_paths import check_folder, make_folder
from splatpainter.system.jsonio import field_types
from splattrain import recipes
from splattrain.recipes import Recipe, Stage

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel
    from splattrain.data.held_out import HeldOut
    from splattrain.distributed import Group
    from splattrain.stages.task import Task
    from splattrain.training_data import TrainingData

SUMMARIES = {
    "lrm": "the Gaussian LRM: views of an asset to tokens and Gaussians",
    "compress": "Stage I: Gaussians and tokens to latents",
    "predict": "the predictor of Gaussians that no picture shows: minutes, beside the other stages",
    "rows": "Stage II without pictures: from the change of shown Gaussians to that of hidden ones",
    "refine": "Stage II: edits to changes of the asset",
    "densify": "a baseline (GenDen) of splatpainter-bench: close-ups to finer Gaussians",
}
AFTERWARDS = {
    "judge": "measure trained weights on objects held out of training",
}


@dataclass(frozen=True)
class Config(Recipe):
    """Train one stage; it can be stopped at any time (Ctrl-C, SIGTERM, --minutes) and goes on with --resume.

    Most options are fields of the recipe and change it; --out keeps the recipe as it was used. With torchrun, several
    processes share the work.

    example:
      splatpainter train refine --recipe compact --data procedural:500 --out runs/refine --minutes 60
      splatpainter train refine --recipe compact --data procedural:500 --out runs/refine --resume
    """

    recipe: str = "compact"
    """compact, paper, or a JSON file."""
    data: str = ""
    """procedural:N, or a folder of meshes (GLB, glTF, OBJ), splat assets or shards (`data render`)."""
    out: Path = Path("run")
    """Folder of the run: model/, state/, log.csv, validation.csv, sheets/, tensorboard/."""
    weights: Path | None = None
    """Checkpoint to start from (also written --from): the stage before, or this one."""
    from_stage: Stage | None = None
    """Take of --from only what was trained up to this stage, e.g. compress for another Stage II on the same Stage I."""
    names: Path | None = None
    """Text file: objects that are held out of training, one name a line (`data list`), in place of a share."""
    minutes: float = 0.0
    """Stop after this many minutes, and save; 0: no limit."""
    session_steps: int = 0
    """Stop after this many steps of this session, and save; 0: no limit."""
    resume: bool = False
    """Go on from what --out holds (or begin, if it holds nothing)."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ...; auto: CUDA where there is one."""
    environments: Path | None = None
    """Folder of HDRIs (.hdr, .exr)."""
    decals: Path | None = None
    """Folder of stickers (PNG with transparency)."""
    fonts: Path | None = None
    """Folder of fonts."""
    textures: Path | None = None
    """Folder of photos."""
    assets: Path | None = None
    """rows only: folder in which fitted assets are kept, so that they are fitted once; default: the user's cache."""
    perceptual_weights: Path | None = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL."""
    compact_state: bool = False
    """Store the state in half precision and without frozen weights: a third of the size; going on is then not exact."""
    json: bool = False
    """Print one JSON object instead of text."""


def dispatch(words: Sequence[str]) -> Outcome:
    """`train STAGE ...`, or what comes afterwards. Raises ValueError for another stage, and for what is wrong with the
    options or the data."""
    if not words or words[0] in ("-h", "--help"):
        return Outcome({"stages": SUMMARIES, "afterwards": AFTERWARDS}, [_help()])
    stage = words[0]
    if stage in AFTERWARDS:
        from splattrain.commands import train_judge

        judging = parse(train_judge.JudgeConfig, f"splatpainter train {stage}", words[1:])
        outcome = train_judge.judge(judging)
        return outcome.as_json() if judging.json else outcome
    if stage not in SUMMARIES:
        names = ", ".join([*SUMMARIES, *AFTERWARDS])
        raise ValueError(f"splatpainter train: expected one of {names}, got {stage!r}")
    rest = ["--weights" + word.removeprefix("--from") if word.split("=")[0] == "--from" else word for word in words[1:]]
    recipe = recipes.load(_named(rest), stage)  # type: ignore[arg-type]
    config = parse(_with_defaults(recipe), f"splatpainter train {stage}", rest)
    if config.stage != stage:
        raise ValueError(
            f"splatpainter train {stage}: expected the stage as first word only, got --stage {config.stage}"
        )
    outcome = run(config)
    return outcome.as_json() if config.json else outcome


def run(config: Config) -> Outcome:
    """Train. Raises ValueError before anything is written where data, weights or the folder do not fit."""
    from splattrain.data.held_out import NOTE, HeldOut
    from splattrain.distributed import join
    from splattrain.loop import Limits, Loop
    from splattrain.state import exists
    from splattrain.training_data import (
        DataSettings,
        ResourceFolders,
        check_pictures,
        open_gaussian_edits,
        open_global_edits,
        open_painted_gaussians,
        open_training_data,
    )

    stage = recipes.additional_stage(config.stage)
    kind = stage.RECIPE_CLASS if stage else Recipe
    recipe = kind(**{f.name: getattr(config, f.name) for f in dataclasses.fields(kind)})
    if not config.data:
        raise ValueError(f"splatpainter train {config.stage}: --data is missing: procedural:N, or a folder")
    started = exists(config.out)
    if started and not config.resume:
        raise ValueError(f"{config.out}: holds a run already; go on with --resume, or choose another --out")
    if config.stage == "refine" and config.model.representation == "copy" and not (started or config.weights):
        raise ValueError("splatpainter train refine: 'copy' models start from their Stage I; give --from CHECKPOINT")
    lrm = config.model.lrm
    copies = config.stage == "compress" and config.model.representation == "copy"
    if not lrm.geometry and (config.stage == "lrm" or copies):
        check_pictures(config.data, recipe.samples, lrm.views, lrm.image_size)
    held_out = HeldOut(recipe.validation_share) if config.names is None else HeldOut.of_file(config.names)
    _refuse_leak(config, held_out, started)
    check_folder(config.out)
    make_folder(config.out)
    group = join(config.device)
    try:
        report = _say if group.first else lambda line: None
        resources = ResourceFolders(config.environments, config.decals, config.fonts, config.textures)
        settings = DataSettings(
            config.data, recipe.samples, recipe.seed, held_out.share, resources, str(group.device), names=held_out.names
        )
        count = recipe.validation_samples if recipe.validate_every else 0
        if recipe.stage == "predict":
            data = open_global_edits(settings, count)
        elif recipe.stage == "rows":
            from splatpainter.models.cache import cache_folder

            folder = config.assets or cache_folder() / "rows"
            if recipe.carrier == "pictures":
                data = open_painted_gaussians(settings, count, folder, recipe.edits)
            else:
                data = open_gaussian_edits(settings, count, folder, recipe.fitted)
        else:
            data = open_training_data(settings, batch=recipe.batch, count=count, workers=recipe.workers)
        task = _task(config, recipe, group, report)
        report(_first_line(recipe, task, data, group))
        if recipe.warmup >= recipe.steps:
            report(
                f"the warm-up of {recipe.warmup} steps is no shorter than the run of {recipe.steps}: the learning rate "
                f"never reaches {recipe.learning_rate:g}; give --warmup"
            )
        kind: Any = {"resume": started, "compact": config.compact_state, "report": report}
        kind["notes"] = {NOTE: held_out.note()}
        loop = Loop(task, recipe, data.training, data.validation, config.out, group, **kind)
        if group.first:
            (config.out / "recipe.json").write_text(recipe.to_json() + "\n", encoding="utf-8", newline="\n")
        result = loop(Limits(config.minutes, config.session_steps))
        if recipe.workers and recipe.stage not in ("predict", "rows"):
            data.training.close()
    finally:
        group.close()
    lines = [
        f"step {result.step} of {recipe.steps} ({result.ended}): loss {result.loss:.5g}, "
        f"{result.skipped} steps skipped, {result.failed} samples failed",
        *(f"  {kind}: " + ", ".join(f"{n} {v:.2f}" for n, v in f.items()) for kind, f in result.validation.items()),
        f"-> {config.out / 'model'}" + ("" if result.step >= recipe.steps else "   (go on with --resume)"),
    ]
    return Outcome({**dataclasses.asdict(result), "out": config.out}, lines)


def _refuse_leak(config: Config, held_out: HeldOut, started: bool) -> None:
    """Raises ValueError where the weights that training starts from, or goes on with, have learnt from objects that
    this run holds out."""
    from splatpainter.models import checkpoint

    for folder in ([config.out / "model"] if started else []) + ([config.weights] if config.weights else []):
        if not (folder / checkpoint.INDEX).is_file():
            continue  # said where it is read
        notes = checkpoint.notes(folder)
        if problem := held_out.leak(notes):
            raise ValueError(f"{folder}: {problem}, so validation would be of objects that it learnt from")


def _task(config: Config, recipe: Recipe, group: Group, report: Any) -> Task:
    """The stage with its model on its device."""
    import torch

    from splattrain.build import make_painted_task, make_task, start

    torch.manual_seed(recipe.seed)
    if stage := recipes.additional_stage(recipe.stage):
        return stage.make_task(recipe, config.weights, report).to(group.device)
    if recipe.stage == "rows" and recipe.carrier == "pictures":
        return make_painted_task(recipe, config.weights, report).to(group.device)
    model: SplatPainterModel = start(recipe, config.weights, report, config.from_stage)
    return make_task(recipe, model.to(group.device), config.perceptual_weights, report).to(group.device)


def _named(words: Sequence[str]) -> str:
    """The recipe's name among the words."""
    for k, word in enumerate(words):
        if word == "--recipe" and k + 1 < len(words):
            return words[k + 1]
        if word.startswith("--recipe="):
            return word.removeprefix("--recipe=")
    return Config.recipe


def _with_defaults(recipe: Recipe) -> type:
    """Config whose defaults are the recipe's: so --help shows them, and options change them one by one."""
    types = field_types(type(recipe))  # resolved: this module does not know their names
    space: dict[str, Any] = {"__annotations__": types, "__doc__": Config.__doc__, "__module__": Config.__module__}
    for name in types:
        value = getattr(recipe, name)
        space[name] = dataclasses.field(default_factory=lambda value=value: value)
    return dataclass(frozen=True)(type("Config", (Config,), space))


def _first_line(recipe: Recipe, task: Task, data: TrainingData, group: Group) -> str:
    trained = sum(p.numel() for p in task.parameters() if p.requires_grad)
    every = sum(p.numel() for p in task.parameters())
    return (
        f"{recipe.stage}: {trained / 1e6:.1f} of {every / 1e6:.1f} million weights, {data.objects[0]} objects, "
        f"{len(data.validation)} validation samples of {data.objects[1]} others, "
        f"batch {recipe.batch} on {group.world} x {group.device}"
    )


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _help() -> str:
    rows = [f"  {name:<9} {line}" for name, line in SUMMARIES.items()]
    example = "example:\n  splatpainter train refine --recipe compact --data procedural:500 --out runs/refine"
    after = [f"  {name:<9} {line}" for name, line in AFTERWARDS.items()]
    usage = ["usage: splatpainter train STAGE ...", "       splatpainter train judge CHECKPOINT ..."]
    return "\n".join([*usage, "", "stages:", *rows, "", "afterwards:", *after, "", example])
