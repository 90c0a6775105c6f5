"""A tiny model, tiny samples and short runs for the training tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch

from splatpainter.models.config import ModelConfig
from splatpainter.models.model import SplatPainterModel
from splattrain.build import make_task
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import Sample, SampleRecipe, SampleStream
from splattrain.distributed import Group
from splattrain.loop import Loop
from splattrain.recipes import Recipe
from tests.support.model_scenes import TINY, with_refine

SMALL = replace(
    TINY, lrm=replace(TINY.lrm, geometry=True, image_size=32), compress=replace(TINY.compress, resolution=16)
)
LIFT = with_refine(SMALL, base="lift", detail=False)
"""TINY on the analytic lift."""
SAMPLES = SampleRecipe(
    {"stroke": 1.0, "regrade": 1.0}, size=32, rows=200, surfels=2000, base_views=2, novel_views=2, steps_per_object=2
)
RECIPE = Recipe(
    model=LIFT,
    samples=SAMPLES,
    steps=6,
    batch=2,
    learning_rate=3e-3,
    warmup=2,
    perceptual=0.0,
    validate_every=0,
    sequence=0.5,
    loss_views=2,
    gradient_rows=120,
)


@cache
def stream() -> FixedSamples:
    """Samples of two procedural objects, each made once."""
    return FixedSamples(SampleStream(ProceduralSource(2, seed=3), SAMPLES, seed=1))


class FixedSamples:
    """Samples by number, remembered."""

    def __init__(self, source: Any) -> None:
        self.source, self.made = source, dict[int, Sample]()

    def __getitem__(self, i: int) -> Sample:
        if i not in self.made:
            self.made[i] = self.source[i]
        return self.made[i]


def model(config: ModelConfig = LIFT, seed: int = 0) -> SplatPainterModel:
    torch.manual_seed(seed)
    return SplatPainterModel(config)


def loop(
    recipe: Recipe,
    out: Path,
    *,
    samples: Any = None,
    held_out: tuple[Any, ...] = (),
    group: Group | None = None,
    **more: Any,
) -> Loop:
    """A loop around the recipe's stage, with fresh weights."""
    task = make_task(recipe, model(recipe.model, recipe.seed), None, lambda line: None)
    out.mkdir(parents=True, exist_ok=True)
    return Loop(task, recipe, samples or stream(), held_out, out, group or Group(), **more)
