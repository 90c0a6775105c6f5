"""From a recipe to a task: the model with the weights it starts from, its loss, its stage."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from splatpainter.models import checkpoint
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.local_network import LocalNetwork
from splatpainter.models.model import SplatPainterModel
from splattrain import state
from splattrain.data.samples import GLOBAL
from splattrain.loss import perceptual_or_not
from splattrain.recipes import Recipe, Stage
from splattrain.report import alex_or_none
from splattrain.stages.compress import CopyTask, HiddenColors
from splattrain.stages.gaussian_edit_task import GaussianEditOptions, GaussianEditTask
from splattrain.stages.lrm import LrmTask
from splattrain.stages.painted_gaussians_task import PaintedGaussiansTask
from splattrain.stages.predict import PredictTask
from splattrain.stages.refine import RefineOptions, RefineTask
from splattrain.stages.task import Task

Say = Callable[[str], None]
TRAINED = {
    "lrm": ("lrm.",),
    "compress": ("lrm.", "compressor."),
    "predict": ("lrm.", "compressor.", "predictor.", "refiner.", "head."),
    "rows": ("lrm.", "compressor.", "predictor.", "refiner.", "head."),
    "refine": ("lrm.", "compressor.", "predictor.", "refiner.", "head."),
}
"""Stage, in the order of training -> the parts of the model that a checkpoint of it has trained. The predictor stands
beside the others: training it keeps whatever there is of them."""
PARTS_OF_STAGE = {"lrm": ("lrm.",), "compress": ("compressor.", "head."), "predict": ("predictor.",)}
"""Stage -> the parts that it trains itself; of all others ("refiner.", "head.")."""
SETTINGS = ("preset", "lrm.views", "lrm.image_size", "refine.edit_strength", "compress.min_opacity", "predict.alone")
"""Keys of a model's config that its weights do not depend on."""


def start(recipe: Recipe, weights: Path | None, report: Say = print, until: Stage | None = None) -> SplatPainterModel:
    """The recipe's model, untrained (seed torch before), with what a checkpoint has trained of it: of this stage or an
    earlier one its own parts, of a later one what this stage builds on; the rest stays new. until: of the checkpoint
    only what was trained up to this stage. Raises ValueError naming what differs where it is of another model."""
    model = SplatPainterModel(recipe.model)
    if weights is None:
        return model
    saved = checkpoint.load(weights)
    stage = str(saved.notes.get("stage", "refine"))
    parts, order = TRAINED.get(stage, TRAINED["refine"]), list(TRAINED)
    if recipe.stage == "compress" and stage in order[order.index("compress") + 1 :]:
        parts = TRAINED["lrm"]
    if stage == recipe.stage == "compress" and saved.config.representation == "copy":
        parts = (*parts, "head.")
    if until is not None:
        if not set(TRAINED.get(until, "?")) <= set(TRAINED.get(stage, TRAINED["refine"])):
            raise ValueError(f"{weights}: expected --from-stage to be one up to {stage}, got {until}")
        parts = TRAINED[until]
        if saved.config.predict.features:  # it stands beside the stages
            parts = tuple(dict.fromkeys((*parts, "predictor.")))
    if recipe.model.refine.latents and not saved.config.refine.latents:
        raise ValueError(
            f"{weights}: weights without LRM and Stage I, which this model has; start from those of train compress"
        )
    if not recipe.model.refine.latents:
        parts = tuple(part for part in parts if part not in ("lrm.", "compressor."))
    sizes = [(c.predict.features, c.predict.hidden) for c in (saved.config, recipe.model)]
    if sizes[0] != sizes[1] and (recipe.stage == "predict" or not saved.config.predict.features):  # a new predictor
        parts = tuple(part for part in parts if part != "predictor.")
    if recipe.stage == "rows" and (saved.config.refine, saved.config.decoder) != (
        recipe.model.refine,
        recipe.model.decoder,
    ):  # a new Stage II on the same encoder
        parts = tuple(part for part in parts if part not in ("refiner.", "head."))
    untrained = _untrained_keys(parts)

    def free(key: str) -> bool:
        return key in SETTINGS or key.endswith("checkpoint_activations") or key.startswith(untrained)

    differing = state.differing_config(saved.config, recipe.model, free)
    if differing:
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        hint = _stage_two_hint(recipe.stage, differing)
        raise ValueError(f"{weights}: weights of another model: {'; '.join(differing[:3])}{more}{hint}")
    initial = model.state_dict()
    used = {name: t for name, t in saved.tensors.items() if name.startswith(parts)}
    checkpoint.fill(model, {**initial, **used}, str(weights))
    past = state.history(weights, saved.notes)
    # What was trained and is not taken is no part of this model's history.
    model.notes = {
        "history": [
            one for one in past if {*PARTS_OF_STAGE.get(one.get("stage", ""), ("refiner.", "head."))} & {*parts}
        ]
    }
    report(f"starting from {weights}: {', '.join(p.rstrip('.') for p in parts)} as trained by stage {stage}")
    return model


def _stage_two_hint(stage: Stage, differing: Sequence[str]) -> str:
    """What to do where only Stage II differs (lines of `state.differing_config`), such as the shipped one, which learnt
    without pictures; "" elsewhere."""
    if stage != "refine" or not all(line.startswith(("refine.", "decoder ")) for line in differing):
        return ""
    if any(line.startswith("refine.picture_tokens False there") for line in differing):
        return (
            "; its Stage II learnt without pictures (train rows): train another on its encoder, --from-stage compress"
        )
    words = [line.split("'") for line in differing if line.startswith("refine.inputs ")]
    same = f"--model.refine.inputs {words[0][1]}" if words and len(differing) == 1 else "the same settings"
    return f"; go on with {same}, or train a new Stage II on its encoder with --from-stage compress"


def make_painted_task(recipe: Recipe, weights: Path | None, report: Say = print) -> PaintedGaussiansTask:
    """The task of stage rows with pictures as the carrier: a local network, new (seed torch before) or that of a
    checkpoint. Raises ValueError naming what differs where the checkpoint is of another one."""
    network = LocalNetwork(recipe.local)
    if weights is not None:
        saved = checkpoint.load(weights, kind=LocalConfig)
        free = ("preset", "refine.edit_strength")
        if differing := state.differing_config(saved.config, recipe.local, lambda key: key in free):
            raise ValueError(f"{weights}: weights of another model: {'; '.join(differing[:3])}")
        checkpoint.fill(network, saved.tensors, str(weights))
        network.notes = {"history": state.history(weights, saved.notes)}
        report(f"starting from {weights}")
    return PaintedGaussiansTask(network, recipe.readers)


def make_task(recipe: Recipe, model: SplatPainterModel, perceptual_weights: Path | None, report: Say = print) -> Task:
    """The task of the recipe's stage. say: told where the perceptual term has no weights and is dropped."""
    if recipe.stage in ("lrm", "compress") and not model.encoders:
        raise ValueError(f"train {recipe.stage}: expected a model with LRM and Stage I; give --model.refine.latents")
    device = next(model.parameters()).device
    views = recipe.perceptual_views
    if recipe.stage == "predict":
        return PredictTask(model)
    if recipe.stage == "rows":
        return GaussianEditTask(model, GaussianEditOptions(recipe.carrier, recipe.teachers, recipe.readers))
    if recipe.stage == "compress" and model.config.representation == "native":
        return HiddenColors(model, objects=2 * recipe.batch)
    loss, problem = perceptual_or_not(recipe.perceptual, perceptual_weights, device)
    if problem:
        report(problem)
    loss = replace(loss, decibels=recipe.decibels)
    if recipe.stage == "lrm":
        return LrmTask(model, loss, recipe.pull_steps, views)
    if recipe.stage == "compress":
        return CopyTask(model, loss, views)
    options = RefineOptions(
        recipe.keep,
        recipe.sequence,
        recipe.train_encoder,
        views,
        recipe.loss_views,
        recipe.gradient_rows,
        objects=2 * recipe.batch,
    )
    modes = {"global" if kind in GLOBAL else "local" for kind, weight in recipe.samples.kinds.items() if weight > 0}
    return RefineTask(model, options, loss, sorted(modes), alex_or_none(perceptual_weights, device))


def _untrained_keys(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Beginnings of config keys that only concern parts that are not taken over."""
    keys = {
        "compressor.": ("compress.", "representation"),
        "refiner.": ("refine.",),
        "head.": ("decoder",),
        "predictor.": ("predict.",),
    }
    return tuple(key for part, initial in keys.items() if part not in parts for key in initial)
