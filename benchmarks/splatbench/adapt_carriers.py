"""What carries an edit from the Gaussians that are shown to those that are not: those trained by `bench adapt`, and
their training side by side. Every one gets the same processor time, inputs and edits.

Carriers of Stage II are one network, blocks, inputs and decoder, that differs in what its memory is alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from splatpainter.models import checkpoint
from splatpainter.models.config import ModelConfig
from splatpainter.models.model import SplatPainterModel
from splattrain.data.gaussian_edits import GaussianEdit, GaussianEditStream
from splattrain.optim import Average, Guard, adamw, rate_at
from splattrain.recipes import Carrier, Recipe, load
from splattrain.stages.gaussian_edit_task import GaussianEditOptions, GaussianEditTask

SLICE_SECONDS = 5.0
"""CPU seconds that a carrier trains before the next one does."""
STEPS = 10_000
"""Into which the budget is divided for the learning rate's course."""
STAGE2: dict[str, dict[str, Any]] = {
    "cross-attention": {"mixer": "cross_attention"},
    "TTT, Muon, 1 step": {},
    "TTT, Muon, 5 steps": {"inner_steps": 5},
    "TTT, plain gradient": {"newton_schulz_steps": 0},
}
"""Carriers that are Stage II -> what differs from the recipe's model (RefineConfig)."""
MESA = "ridge on learnt features (Mesa)"
"""The predictor: features are learnt, the edit is solved exactly."""
TRAINED = (MESA, *STAGE2)


@dataclass
class CarrierTraining:
    """A carrier in training."""

    name: str
    task: GaussianEditTask
    optimizer: torch.optim.AdamW = field(repr=False)
    average: Average = field(repr=False)
    guard: Guard = field(repr=False)
    seconds: float = 0.0
    """CPU seconds spent on training steps."""
    steps: int = 0
    problems: int = 0
    """Edits that taught nothing."""


def recipe() -> Recipe:
    """Sizes, rates and the model of `train rows`."""
    return load("compact", "rows")


def carrier_training(name: str, encoder: Path | None, seed: int = 0) -> CarrierTraining:
    """A carrier before its training. encoder: a checkpoint, of which LRM and Stage I are taken; None: the model has
    none, as the recipe says. Raises ValueError for a checkpoint of other sizes."""
    settings = recipe()
    latents = settings.model.refine.latents if encoder is None else True
    refine = replace(settings.model.refine, latents=latents, **STAGE2.get(name, {}))
    config = replace(settings.model, refine=refine)
    torch.manual_seed(seed)
    model = SplatPainterModel(config) if encoder is None else with_encoder(config, encoder)
    carrier: Carrier = "predictor" if name == MESA else "stage2"
    options = GaussianEditOptions(carrier, settings.teachers, settings.readers, objects=1 << 10)
    task = GaussianEditTask(model, options)
    parameters = list(task.named_parameters())
    optimizer = adamw(parameters, settings.learning_rate, settings.weight_decay)
    return CarrierTraining(name, task, optimizer, Average.of(parameters, settings.average), Guard(settings.spike))


def with_encoder(config: ModelConfig, folder: Path) -> SplatPainterModel:
    """A new model with the LRM and Stage I of a checkpoint. Raises ValueError where they are of other sizes."""
    saved = checkpoint.load(folder)
    model = SplatPainterModel(config)
    taken = {name: values for name, values in saved.tensors.items() if name.startswith(("lrm.", "compressor."))}
    checkpoint.fill(model, {**model.state_dict(), **taken}, str(folder))
    return model


def side_by_side(
    trainings: Sequence[CarrierTraining],
    edits: GaussianEditStream,
    budget: float,
    stops: Sequence[float],
    batch: int = 1,
) -> Iterator[float]:
    """Train all, slice by slice, until each has spent `budget` seconds of processor time. Yields at every share of the
    budget in `stops` (rising, 0..1), when all have spent that much. Making and encoding assets is not counted:
    all read the same ones."""
    for stop in stops:
        while True:
            behind = [one for one in trainings if one.seconds < stop * budget - 1e-6]
            if not behind:
                break
            for one in behind:
                train(one, edits, min(one.seconds + SLICE_SECONDS, stop * budget), budget, batch)
        yield stop


def train(one: CarrierTraining, edits: GaussianEditStream, until: float, budget: float, batch: int) -> None:
    """Steps until the carrier has spent `until` of its `budget` seconds."""
    settings, task = recipe(), one.task
    task.train()
    while one.seconds < until:
        samples = [edits[one.steps * batch + k] for k in range(batch)]
        prepare(task, samples)
        begun = time.process_time()
        share = one.seconds / budget
        rate = rate_at(int(share * STEPS), settings.learning_rate, STEPS // 50, STEPS, settings.final_rate)
        for group in one.optimizer.param_groups:
            group["lr"] = rate
        one.optimizer.zero_grad(set_to_none=True)
        for k, sample in enumerate(samples):
            (task(sample, one.steps * batch + k)["loss"] / batch).backward()
            one.problems += bool(task.problem)
        trained = [p for p in task.parameters() if p.requires_grad]
        norm = float(torch.nn.utils.clip_grad_norm_(trained, settings.clip))
        if not one.guard.admit(norm):
            one.optimizer.step()
            one.average.update(task.named_parameters(), one.guard.seen - 1)
        one.steps += 1
        one.seconds += time.process_time() - begun


def prepare(task: GaussianEditTask, samples: Sequence[GaussianEdit]) -> None:
    """Encode what is not encoded yet, outside of what is timed."""
    if task.options.carrier == "stage2":
        for sample in samples:
            task.rows(sample.item)


def share_rows(trainings: Sequence[CarrierTraining]) -> None:
    """Contestants of Stage II read the same encoded assets: LRM and Stage I are the same weights in all."""
    readers = [one for one in trainings if one.task.options.carrier == "stage2"]
    for one in readers[1:]:
        one.task.share_rows(readers[0].task)


def judged(one: CarrierTraining, figures: Callable[[GaussianEditTask], float]) -> float:
    """A figure of the averaged weights."""
    one.task.eval()
    with one.average.used_by(one.task), torch.no_grad():
        return figures(one.task)


def load_trained(one: CarrierTraining, folder: Path, budget: float) -> None:
    """Take the weights of `save`, where they are this carrier's and were trained for the budget. Raises ValueError for
    weights of another model."""
    if not (folder / checkpoint.INDEX).is_file():
        return
    saved = checkpoint.load(folder)
    if saved.notes.get("carrier") != one.name or saved.notes.get("seconds", 0) < budget - 0.1:
        return
    checkpoint.fill(one.task.model, saved.tensors, str(folder))
    one.average = Average.of(one.task.named_parameters(), recipe().average)
    one.seconds, one.steps = max(saved.notes["seconds"], budget), saved.notes["step"]


def save(one: CarrierTraining, folder: Path) -> None:
    """The averaged weights as a checkpoint, with what they are."""
    notes = {"stage": "rows", "step": one.steps, "seconds": round(one.seconds, 1), "carrier": one.name}
    notes["recipe"] = replace(recipe(), model=one.task.model.config, carrier=one.task.options.carrier).to_dict()
    with one.average.used_by(one.task):
        one.task.model.save(folder, notes=notes)
