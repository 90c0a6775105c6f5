"""A training run on disk, so that it can go on as if nothing had happened.

    OUT/state/    everything: weights, optimiser, running mean, position; a models.checkpoint folder of its own, so that
                  every file is at most 15 MiB and a kill at any moment leaves a whole one
    OUT/model/    what a user loads: the averaged weights in half precision; notes with a record of every stage

Tensors of the state: weight/NAME, average/NAME, first/NAME and second/NAME (Adam's moments), count/NAME (its steps),
random. `compact` states hold weights and averages in fp16, moments in bf16, and no frozen weights (they come from the
seed or from --from again, and their hash is compared): a third of the size, for machines that take and give back
little; going on from one is then near (to about 5e-4 of a weight), not exact.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from splatpainter.models import checkpoint
from splattrain.data.held_out import NOTE
from splattrain.distributed import Group, gathered, give
from splattrain.optim import Average, Guard

STATE, MODEL = "state", "model"
HALF = "~half"
"""Ending of a tensor that is stored as the bits of fp16, as integers: a checkpoint has one type for all floats."""
MOMENTS = {"first": "exp_avg", "second": "exp_avg_sq"}
LOG = "log.csv"
FIRST_STEPS, LAST_STEPS = 20, 100
"""Steps whose mean loss is recorded, at both ends of a run."""
RECORDED = ("learning_rate", "batch", "perceptual", "seed", "train_encoder", "carrier")
"""Keys of the recipe that a record keeps."""
RECORDED_SAMPLES = ("size", "rows", "surfels", "kinds")


@dataclass
class Progress:
    """Where a run is. JSON values only: they go into the state."""

    step: int = 0
    """Optimiser steps done, skipped ones too: the position in the data."""
    seconds: float = 0.0
    """Time spent training, in all sessions."""
    failed: int = 0
    """Samples that could not be used."""
    history: list[dict[str, Any]] = field(default_factory=list)
    """What the stages before this one were (`history`), first one first."""
    lengths: list[list[int]] = field(default_factory=list)
    """[step, steps that the run was to have from there on], where the rate's schedule changed: steps may differ when a
    run goes on, and the recipe alone says the last."""

    def aim(self, steps: int) -> None:
        """Note the length that the run is to have from here on."""
        if not self.lengths or self.lengths[-1][1] != steps:
            self.lengths.append([self.step, steps])


@dataclass
class TrainingState:
    """What a training run consists of."""

    task: nn.Module
    """Unwrapped: its parameters' names are those in the state."""
    optimizer: torch.optim.Optimizer
    average: Average
    guard: Guard
    progress: Progress


def save(
    folder: Path,
    run: TrainingState,
    config: checkpoint.CheckpointConfig,
    recipe: dict[str, Any],
    group: Group,
    *,
    compact: bool = False,
) -> None:
    """Write OUT/state. All processes call it; the first writes. Raises ValueError for a folder that cannot be
    written."""
    tensors: dict[str, Tensor] = {}
    frozen = hashlib.sha256()
    for name, parameter in run.task.named_parameters():
        tensors[f"weight/{name}"] = gathered(parameter)
        if not parameter.requires_grad:
            frozen.update(tensors[f"weight/{name}"].numpy().tobytes())
            if compact:
                del tensors[f"weight/{name}"]
        held = run.optimizer.state.get(parameter, {})
        for short, key in MOMENTS.items():
            if key in held:
                tensors[f"{short}/{name}"] = gathered(held[key])
        if "step" in held:
            tensors[f"count/{name}"] = held["step"].to("cpu", torch.int64)
        if name in run.average.values:
            tensors[f"average/{name}"] = gathered(run.average.values[name])
    tensors["random"] = torch.get_rng_state()
    if not group.first:
        return
    notes = {
        "progress": dataclasses.asdict(run.progress),
        "guard": dataclasses.asdict(run.guard),
        "recipe": recipe,
        "world": group.world,
        "frozen": frozen.hexdigest(),
    }
    if compact:
        tensors = dict(_half(name, tensor) for name, tensor in tensors.items())
    checkpoint.save(folder / STATE, config, tensors, dtype="bfloat16" if compact else "float32", notes=notes)


def load(folder: Path, run: TrainingState, config: checkpoint.CheckpointConfig, recipe: dict[str, Any]) -> None:
    """Fill a run from OUT/state, in place. Raises ValueError where there is none, where it is damaged, and where it was
    written with another recipe: the line names what differs."""
    held = checkpoint.load(folder / STATE, kind=type(config))
    where = f"{folder / STATE}"
    _same(held.notes.get("recipe", {}), recipe, where)
    tensors = dict(_full(name, tensor) for name, tensor in held.tensors.items())
    named = dict(run.task.named_parameters())
    frozen = hashlib.sha256()
    for name, parameter in named.items():
        if f"weight/{name}" not in tensors:
            if parameter.requires_grad:
                raise ValueError(f"{where}: has no weight/{name}; it is of another model or stage")
            frozen.update(gathered(parameter).numpy().tobytes())
            continue
        value = tensors[f"weight/{name}"]
        if value.shape != parameter.shape:
            raise ValueError(f"{where}: expected {name} {list(parameter.shape)}, got {list(value.shape)}")
        give(parameter, value)
        if name in run.average.values:
            give(run.average.values[name], tensors.get(f"average/{name}", value))
        if f"count/{name}" in tensors and parameter.requires_grad:
            state: dict[str, Any] = {"step": tensors[f"count/{name}"].float()}
            for short, key in MOMENTS.items():
                state[key] = torch.zeros_like(parameter, memory_format=torch.preserve_format).detach()
                give(state[key], tensors[f"{short}/{name}"])
            run.optimizer.state[parameter] = state
    if any(f"weight/{name}" not in tensors for name in named) and frozen.hexdigest() != held.notes.get("frozen"):
        raise ValueError(f"{where}: its frozen weights are not these; give the --from that the run began with")
    torch.set_rng_state(tensors["random"])
    for name, record in (("progress", run.progress), ("guard", run.guard)):
        for key, value in held.notes.get(name, {}).items():
            setattr(record, key, value)
    if not run.progress.lengths and "steps" in held.notes.get("recipe", {}):
        run.progress.lengths.append([0, held.notes["recipe"]["steps"]])


def save_model(
    folder: Path, run: TrainingState, config: checkpoint.CheckpointConfig, group: Group, notes: dict[str, Any]
) -> None:
    """Write OUT/model: the averaged weights of the model inside the task (the parameters below `model.`), fp16."""
    tensors = {}
    for name, parameter in run.task.named_parameters():
        value = gathered(run.average.values.get(name, parameter))
        if name.startswith("model."):
            tensors[name.removeprefix("model.")] = value
    if group.first:
        checkpoint.save(folder / MODEL, config, tensors, dtype="float16", notes=notes)


def read_outs(folder: Path) -> dict[str, Tensor]:
    """Name -> averaged weights, float32, of what a run's task owns besides its model; empty where the folder holds no
    state."""
    if not exists(folder):
        return {}
    tensors = dict(_full(name, tensor) for name, tensor in checkpoint.load(folder / STATE).tensors.items())
    names = [
        n.removeprefix("weight/") for n in tensors if n.startswith("weight/") and not n.startswith("weight/model.")
    ]
    return {name: tensors.get(f"average/{name}", tensors[f"weight/{name}"]) for name in names}


def exists(folder: Path) -> bool:
    """Whether a run can go on there."""
    return (folder / STATE / checkpoint.INDEX).is_file()


FREE = ("steps", "parallel", "validate_every", "save_minutes", "sheet_every", "report_every", "workers")
"""Recipe keys that may differ when a run goes on: they change how it runs, not what it learns (steps: also the rate
from there on)."""


def _same(old: dict[str, Any], new: dict[str, Any], where: str) -> None:
    differing = [
        f"{key} {was!r} there, {now!r} now"
        for key, was, now in _differences(old, new)
        if key not in FREE and not key.endswith("checkpoint_activations")
    ]
    if differing:
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise ValueError(
            f"{where}: written with another recipe: {'; '.join(differing[:3])}{more}; "
            "use that recipe, or start from its weights with --from in a new folder"
        )


def _differences(old: Any, new: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    """(dotted key, old, new) of every leaf that differs; keys of one side only differ from None."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = list(dict.fromkeys([*old, *new]))
        return [
            d for key in keys for d in _differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
        ]
    return [] if json.dumps(old) == json.dumps(new) else [(path, old, new)]


def differing_config(
    old: checkpoint.CheckpointConfig, new: checkpoint.CheckpointConfig, free: Callable[[str], bool]
) -> list[str]:
    """What differs between two model configs, one text per key, except keys that `free` accepts."""
    a, b = (json.loads(c.to_json()) for c in (old, new))
    return [f"{key} {was!r} there, {now!r} here" for key, was, now in _differences(a, b) if not free(key)]


def _half(name: str, tensor: Tensor) -> tuple[str, Tensor]:
    if name.split("/", 1)[0] not in ("weight", "average"):
        return name, tensor
    return name + HALF, tensor.half().view(torch.int16)


def _full(name: str, tensor: Tensor) -> tuple[str, Tensor]:
    if name.endswith(HALF):
        return name.removesuffix(HALF), tensor.view(torch.float16).float()
    return name, tensor.float() if tensor.is_floating_point() else tensor


def history(folder: Path, notes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Records of all stages up to the checkpoint in `folder`, which has these notes."""
    return [*notes.get("history", []), record(folder, notes)]


def record(folder: Path, notes: Mapping[str, Any]) -> dict[str, Any]:
    """{"stage", "step", "seconds", "recipe": some of it, "loss": {"first", "last"} from the log beside the folder, or
    from the notes of weights that have left it, "judged" where `train judge` has noted it}. JSON values."""
    recipe = notes.get("recipe", {})
    recipe_part = {key: recipe[key] for key in RECORDED if key in recipe}
    samples = recipe.get("samples", {})
    recipe_part["samples"] = {key: samples[key] for key in RECORDED_SAMPLES if key in samples}
    facts = {key: notes[key] for key in ("stage", "step", "seconds", "judged", NOTE) if key in notes}
    losses = _losses(folder.parent / LOG) or notes.get("loss")
    return facts | {"recipe": recipe_part} | ({"loss": losses} if losses else {})


def _losses(path: Path) -> dict[str, float] | None:
    if not path.is_file():
        return None
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    values = np.array([float(row["loss"]) for row in rows if row.get("loss") and not row.get("skipped")])
    values = values[np.isfinite(values)]
    return (
        {"first": float(values[:FIRST_STEPS].mean()), "last": float(values[-LAST_STEPS:].mean())}
        if len(values)
        else None
    )
