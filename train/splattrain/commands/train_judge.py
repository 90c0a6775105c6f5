"""`splatpainter train judge`: what trained weights reach on held-out objects."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from splatpainter.commands import Outcome
from splatpainter.commands.parts.terminal import count, progress
from splatpainter.output_paths import check_folder
from splattrain import recipes
from splattrain.recipes import STAGES, Recipe

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel
    from splattrain.judge import SampleScore
    from splattrain.training_data import DataSettings

Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
Checkpoint = Annotated[Positional[Path], arg(metavar="CHECKPOINT")]
MAX_PROBLEM_LINES = 5
"""Lines about samples that could not be used that people see; --json has all."""


@dataclass(frozen=True)
class JudgeConfig:
    """Judge a trained model on objects held out of training: Stage II by kind of edit and, for relighting, by number of
    edited views; earlier stages by what they reproduce. Equal data, seed and sample settings give equal samples for
    every checkpoint.

    example:
      splatpainter train judge runs/refine/model --data meshes/ --out judged
      splatpainter train judge runs/refine/model --data meshes/ --out judged --kinds relight --views 1 2 4 --samples 20
    """

    checkpoint: Checkpoint
    """Folder of weights, such as OUT/model of a run."""
    data: str = ""
    """The data it was trained on: procedural:N, or a folder of meshes, splat assets or shards."""
    out: Path = Path("judged")
    """Folder for judged.csv, judged.md and the contact sheet judged.png."""
    samples: int = 48
    """How many samples to judge, over all kinds."""
    kinds: tuple[str, ...] = ()
    """Only these kinds of edits, in equal parts; default: those of the recipe, in its proportions."""
    views: tuple[int, ...] = (1, 2, 4)
    """Numbers of edited views that every relighting is judged with."""
    seed: int = 0
    """Seed of the samples and of the confidence intervals."""
    recipe: Path | None = None
    """JSON file with the recipe whose samples are used; default: the one in the checkpoint."""
    names: Path | None = None
    """Text file of the objects that were held out of training, for weights that were trained with one."""
    write_notes: bool = False
    """Put the gain and the table into the checkpoint's notes: method auto and scripts/model_card.py read them there."""
    device: str = "auto"
    """cpu, cuda, cuda:1, ...; auto: CUDA where there is one."""
    environments: Folder = None
    """Folder of HDRIs (.hdr, .exr)."""
    decals: Folder = None
    """Folder of stickers (PNG with transparency)."""
    fonts: Folder = None
    """Folder of fonts."""
    textures: Folder = None
    """Folder of photos."""
    perceptual_weights: Folder = None
    """Folder of the LPIPS weights; default: that of SPLATPAINTER_PERCEPTUAL; without them, no LPIPS."""
    json: bool = False
    """Print one JSON object instead of text."""

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ValueError(f"splatpainter train judge: expected --samples of at least 1, got {self.samples}")
        if not self.views or min(self.views) < 1 or max(self.views) > 16:
            raise ValueError(f"splatpainter train judge: expected --views of 1 to 16, got {self.views}")
        if self.seed < 0:
            raise ValueError(f"splatpainter train judge: expected --seed of 0 or more, got {self.seed}")


def judge(config: JudgeConfig) -> Outcome:
    """Judge, write the tables, and the notes if asked to. Raises ValueError before any work where the weights, the data
    or the folder do not fit."""
    from splatpainter.models import checkpoint, weights
    from splatpainter.models.model import SplatPainterModel
    from splattrain.distributed import join
    from splattrain.judge import (
        as_json,
        copy_rows,
        edit_rows,
        gains,
        goals,
        judge_copies,
        judge_edits,
        judged_samples,
        looking_tasks,
        refine_task,
        table,
        write_table,
    )

    if not config.data:
        raise ValueError("splatpainter train judge: --data is missing: procedural:N, or a folder")
    if config.write_notes and config.kinds:
        raise ValueError("splatpainter train judge: --write-notes is for all kinds of the recipe; leave --kinds out")
    check_folder(config.out)
    if weights.is_local(config.checkpoint):
        return _judge_local(config)
    model = SplatPainterModel.load(config.checkpoint)
    recipe = _recipe(config, model)
    device = join(config.device).device
    model.to(device)
    source_settings = _data_settings(config, recipe, str(device))
    if problem := source_settings.held_out.leak(model.notes):
        raise ValueError(f"{config.checkpoint}: {problem}")
    kinds = _kinds(config, recipe)
    samples = progress(
        judged_samples(source_settings, kinds, config.samples, max(config.views)), config.samples, "judge"
    )
    remark = ""
    if recipe.stage == "refine":
        scores_or_lines = judge_edits(
            refine_task(recipe, model, config.perceptual_weights).to(device), samples, config.views
        )
    else:
        tasks, remark = looking_tasks(recipe, model, config.checkpoint)
        scores_or_lines = judge_copies(tasks, samples)
    scores, problems = _sorted(scores_or_lines)
    if not scores:
        raise ValueError(f"{config.data}: none of {config.samples} samples could be judged; the first: {problems[0]}")
    edited = edit_rows(scores, config.seed) if recipe.stage == "refine" else []
    rows = edited or copy_rows(scores, config.seed)
    held_names = {f.name for f in scores}
    judged = {
        "rows": as_json(rows),
        "samples": len({f.sample for f in scores}),
        "objects": dict(zip(("training", "validation"), source_settings.counts(), strict=True)),
        "judged_objects": len(held_names),
        "skipped": len(problems),
        "seed": config.seed,
        "data": config.data if config.data.startswith("procedural:") else Path(config.data).name,
        "size": recipe.samples.size,
    }
    gain = {"gain": gains(edited)} if edited else {}
    config.out.mkdir(parents=True, exist_ok=True)
    heading = (
        f"stage {recipe.stage}, step {model.notes.get('step', '?')}: {judged['samples']} samples of "
        f"{len(held_names)} held-out objects of {judged['data']}, {recipe.samples.size} px, seed {config.seed}"
    )
    remarks = [*goals(rows), *([remark] if remark else []), *problems]
    paths = write_table(config.out, rows, scores, heading, ["\n".join(f"- {r}" for r in remarks)])
    if config.write_notes:
        checkpoint.add_notes(config.checkpoint, {**gain, "judged": judged})
    hidden = len(problems) - MAX_PROBLEM_LINES
    lines = [
        heading,
        table(rows),
        *goals(rows),
        *([remark] if remark else []),
        *problems[:MAX_PROBLEM_LINES],
        *([f"... and {count(hidden, 'more sample')} that could not be used"] if hidden > 0 else []),
        f"-> {', '.join(map(str, paths))}" + (f", notes of {config.checkpoint}" if config.write_notes else ""),
    ]
    return Outcome({**judged, **gain, "problems": problems, "files": paths}, lines)


def _judge_local(config: JudgeConfig) -> Outcome:
    """As `judge`, of a local network: painted close-ups of held-out objects. A gain above 0 is no note: method auto
    would go by it, and captures were not measured."""
    from splatpainter.models import checkpoint
    from splatpainter.models.local_network import LocalNetwork
    from splattrain.judge import as_json, edit_rows, gains, judge_painted, table, write_table
    from splattrain.stages.painted_gaussians_task import PaintedGaussiansTask
    from splattrain.training_data import painted_gaussian_streams

    network = LocalNetwork.load(config.checkpoint)
    stored = network.notes.get("recipe")
    if not isinstance(stored, dict):
        raise ValueError(f"{config.checkpoint}: its notes hold no recipe")
    recipe = recipes.parse(json.dumps(stored), "rows", f"{config.checkpoint}: recipe")
    if config.kinds:
        samples = dataclasses.replace(recipe.samples, kinds=dict.fromkeys(config.kinds, 1.0))
        recipe = dataclasses.replace(recipe, samples=samples)
    settings = _data_settings(config, recipe, "cpu")
    if problem := settings.held_out.leak(network.notes):
        raise ValueError(f"{config.checkpoint}: {problem}")
    _, stream = painted_gaussian_streams(settings, None, recipe.edits)
    if stream is None:
        raise ValueError(f"--data {config.data}: no object of it is held out of training; give more objects")
    results = judge_painted(PaintedGaussiansTask(network, recipe.readers), stream, config.samples)
    scores, problems = _sorted(progress(results, config.samples, "judge"))
    if not scores:
        raise ValueError(f"{config.data}: none of {config.samples} samples could be judged; the first: {problems[0]}")
    rows = edit_rows(scores, config.seed)
    judged = {
        "rows": as_json(rows),
        "samples": len(scores),
        "judged_objects": len({score.name for score in scores}),
        "skipped": len(problems),
        "seed": config.seed,
        "data": config.data if config.data.startswith("procedural:") else Path(config.data).name,
        "size": recipe.samples.size,
    }
    config.out.mkdir(parents=True, exist_ok=True)
    heading = (
        f"local network, step {network.notes.get('step', '?')}: {len(scores)} painted close-ups of "
        f"{judged['judged_objects']} held-out objects of {judged['data']}, {recipe.samples.size} px, seed {config.seed}"
    )
    paths = write_table(config.out, rows, scores, heading, ["\n".join(f"- {line}" for line in problems)])
    if config.write_notes:
        behind = {mode: gain for mode, gain in gains(rows).items() if gain <= 0}
        checkpoint.add_notes(config.checkpoint, {"judged": judged} | ({"gain": behind} if behind else {}))
    return Outcome({**judged, "problems": problems, "files": paths}, [heading, table(rows), *problems[:5]])


def _recipe(config: JudgeConfig, model: SplatPainterModel) -> Recipe:
    """The checkpoint's own recipe, or the named one, around the checkpoint's model. A predictor is judged by the edits
    that the whole model makes with it, as Stage II is."""
    stage = model.notes.get("stage", "refine")
    if stage not in STAGES:
        raise ValueError(f"{config.checkpoint}: expected weights of stage {', '.join(STAGES)}, got {stage!r}")
    as_edits = "refine" if stage in ("predict", "rows") else stage
    if config.recipe is not None:
        return dataclasses.replace(recipes.load(config.recipe, as_edits), model=model.config)
    stored = model.notes.get("recipe")
    if not isinstance(stored, dict):
        raise ValueError(f"{config.checkpoint}: its notes hold no recipe; name the one it was trained by with --recipe")
    parsed = recipes.parse(json.dumps(stored), stage, f"{config.checkpoint}: recipe")
    return dataclasses.replace(parsed, stage=as_edits, model=model.config)


def _data_settings(config: JudgeConfig, recipe: Recipe, device: str) -> DataSettings:
    from splattrain.data.held_out import HeldOut
    from splattrain.training_data import DataSettings, ResourceFolders

    resources = ResourceFolders(config.environments, config.decals, config.fonts, config.textures)
    share, memory = recipe.validation_share, 64 << 20
    names = () if config.names is None else HeldOut.of_file(config.names).names
    return DataSettings(config.data, recipe.samples, config.seed, share, resources, device, memory, names)


def _kinds(config: JudgeConfig, recipe: Recipe) -> dict[str, float]:
    """Kind -> weight, as asked for; the recipe's otherwise."""
    from splattrain.data.sample_recipes import GLOBAL, KINDS

    possible = [kind for kind in KINDS if (kind == "plain") != (recipe.stage == "refine")]
    if recipe.stage == "refine" and not recipe.model.edits_locally:
        possible = [kind for kind in possible if kind in GLOBAL]
    for kind in config.kinds:
        if kind not in possible:
            what = f"stage {recipe.stage}" if recipe.model.edits_locally else "weights that make global edits alone"
            raise ValueError(f"--kinds: expected some of {', '.join(possible)} for {what}, got {kind!r}")
    stored = {kind: weight for kind, weight in recipe.samples.kinds.items() if weight > 0 and kind in possible}
    if recipe.model.predictor_only and not set(stored) & set(GLOBAL):  # Stage II does not train on them
        stored |= {kind: sum(stored.values()) * share for kind, share in (("relight", 0.75), ("regrade", 0.25))}
    return dict.fromkeys(config.kinds, 1.0) or stored or dict.fromkeys(possible, 1.0)


def _sorted(scores_or_lines: Iterable[SampleScore | str]) -> tuple[list[SampleScore], list[str]]:
    """(scores, lines about the others). Only the first strip of a table row stays in memory."""
    scores: list[SampleScore] = []
    problems: list[str] = []
    strips: set[tuple[str, int | None]] = set()
    for item in scores_or_lines:
        if isinstance(item, str):
            problems.append(item)
            continue
        key = item.kind, item.views
        scores.append(item if key not in strips else dataclasses.replace(item, strip=()))
        strips.add(key)
    return scores, problems
