"""A training recipe: one dataclass that is the command line, the JSON in the run's folder and the documentation.

Recipes are found by name in recipes/ beside this file (`compact`, `paper`, per stage) or as JSON files. A JSON recipe
names only what differs from the defaults here; unknown keys are errors. Stages of other distributions bring their own.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from splatpainter.io.files import read_all
from splatpainter.models.config import COMPACT, PRESETS, ModelConfig
from splatpainter.models.local_config import LocalConfig
from splatpainter.system import jsonio
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.samples import KINDS, SampleRecipe

Stage = Literal["lrm", "compress", "predict", "rows", "refine", "densify"]
STAGES: tuple[Stage, ...] = get_args(Stage)
Encoder = Literal["nothing", "compress", "all"]
Parallel = Literal["ddp", "fsdp"]
Carrier = Literal["stage2", "predictor", "pictures"]
FOLDER = Path(__file__).with_name("recipes")
ENTRY_POINTS = "splatpainter.training_stages"
"""Group of entry points by which other distributions add stages: modules with RECIPE_CLASS, a subclass of
`Recipe`, RECIPES, the folder of its recipes, and `make_task(recipe, weights, say)`."""
DISTRIBUTIONS = {
    "densify": "the distribution splatpainter-bench: pip install ./benchmarks ./networks, in the repository"
}
"""Stages that are not in this package -> what brings them."""


@dataclass(frozen=True)
class Recipe:
    """How a stage is trained."""

    MODEL_PRESETS: ClassVar[dict[str, Any]] = {"model": PRESETS}
    """Key of a model's config -> its presets."""
    stage: Stage = "refine"
    """lrm: the Gaussian LRM; compress: Stage I; predict: the predictor of unseen Gaussians; rows: Stage II or the
    predictor without pictures, on edits that are known exactly where they are shown; refine: Stage II; densify: a model
    of its own, a baseline."""
    model: ModelConfig = COMPACT
    """The model; not of stage densify, and not where pictures are the carrier of stage rows."""
    local: LocalConfig = field(default_factory=LocalConfig)
    """rows with carrier pictures only: the local network."""
    samples: SampleRecipe = field(default_factory=SampleRecipe)
    """What samples look like."""
    steps: int = 20_000
    """Optimiser steps; the learning rate's cosine ends there."""
    batch: int = 1
    """Samples per step, over all processes; a multiple of their number."""
    learning_rate: float = 4e-4
    """Peak learning rate."""
    warmup: int = 200
    """Steps over which the learning rate rises linearly."""
    final_rate: float = 0.02
    """Where the cosine ends, as a share of the peak."""
    weight_decay: float = 0.05
    """Weight decay of matrices; not of norms, biases and fast weights."""
    clip: float = 1.0
    """Gradients are scaled to this norm at most."""
    spike: float = 20.0
    """Steps whose gradient norm exceeds this many running means are skipped; 0: none are."""
    average: float = 0.998
    """Decay of the running mean of the weights, which validation and the saved model use."""
    perceptual: float = 0.5
    """lambda, weight of the LPIPS (squeeze) term; 0: none."""
    decibels: bool = False
    """Minimise the logarithm of the loss of pictures, so that every sample counts by what it gains in dB; its gradients
    are some hundred times larger, so give `clip` as much."""
    perceptual_views: int = 1
    """Views per sample that the LPIPS term looks at, chosen anew each time."""
    loss_views: int = 0
    """Stage II and densify: views per sample that are rendered and compared, a third of them edited ones; 0: all."""
    gradient_rows: int = 0
    """Stage II: Gaussians per sample that gradients go through, a random choice of those shown; densify: Gaussians that
    are replaced, those that views pull at hardest; 0: all."""
    keep: float = 0.25
    """Weight of a pixel that a local edit must leave as it is, against 1 for an edited one."""
    sequence: float = 0.2
    """Probability that an edit of several views comes as two, the second on the state that the first left."""
    train_encoder: Encoder = "nothing"
    """Stage II only: what else is trained. nothing (the paper), compress (Stage I), all (Stage I and the LRM)."""
    carrier: Carrier = "stage2"
    """rows only: what learns, Stage II, the predictor, or from edited pictures the local network."""
    teachers: int = 256
    """rows only: Gaussians per edit that are shown, a random choice."""
    readers: int = 256
    """rows only: Gaussians per edit that are not shown and count in the loss, a random choice."""
    fitted: bool = True
    """rows only: train on assets fitted by 3DGS, too, not on coarse ones alone."""
    edits: int = 4096
    """rows with carrier pictures only: edits that are drawn, and kept in --assets; then they come again."""
    pull_steps: int = 1000
    """LRM without known geometry only: first steps that pull points into place."""
    seed: int = 0
    """Seed of weights, data order and random choices."""
    validation_share: float = HELD_OUT_SHARE
    """Share of the objects that are never trained on; benches measure those of the default."""
    validation_samples: int = 24
    """Fixed samples of these objects."""
    validate_every: int = 500
    """Steps between validations, each with a contact sheet; 0: none."""
    report_every: int = 50
    """Steps between lines on stderr."""
    save_minutes: float = 5.0
    """Minutes between checkpoints."""
    workers: int = 0
    """Processes that prepare samples ahead; 0: the training process does. Not of stages predict and rows, whose samples
    cost nothing once an object is known."""
    parallel: Parallel = "ddp"
    """With several processes: ddp (every one holds the model) or fsdp (sharded)."""

    def __post_init__(self) -> None:
        zero_up = "warmup validate_every pull_steps workers perceptual_views seed loss_views gradient_rows"
        for names_of_rule, holds, rule in (
            ("steps batch report_every validation_samples teachers readers edits", lambda v: v >= 1, "of at least 1"),
            (f"{zero_up} weight_decay spike perceptual keep", lambda v: v >= 0, "of 0 or more"),
            ("learning_rate clip save_minutes", lambda v: v > 0, "above 0"),
            ("final_rate average sequence validation_share", lambda v: 0 <= v <= 1, "0..1"),
        ):
            for name in names_of_rule.split():
                if not holds(getattr(self, name)):
                    raise ValueError(f"recipe: expected {name} {rule}, got {getattr(self, name)}")
        # Every kind by name, so that the command line offers each, and equal recipes are equal.
        kinds = {kind: float(self.samples.kinds.get(kind, 0.0)) for kind in KINDS}
        object.__setattr__(self, "samples", dataclasses.replace(self.samples, kinds=kinds))

    @property
    def samples_per_object(self) -> int:
        """Consecutive samples that share an object."""
        return self.samples.steps_per_object

    def to_dict(self) -> dict[str, Any]:
        """Nested plain values, as in the JSON."""
        return jsonio.plain(self)

    def to_json(self) -> str:
        """Every field."""
        return json.dumps(self.to_dict(), indent=2)


def additional_stage(stage: Stage) -> Any | None:
    """The module of a stage that another distribution adds; None for those of this package. Raises ValueError where
    that distribution is missing."""
    if stage not in DISTRIBUTIONS:
        return None
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINTS, name=stage):
        return entry_point.load()
    raise ValueError(f"splatpainter train {stage}: not installed; it comes with {DISTRIBUTIONS[stage]}")


def names() -> list[str]:
    """Names that `load` knows for some stage."""
    return sorted({path.stem.rsplit("-", 1)[0] for path in FOLDER.glob("*-*.json")})


def load(name: str | Path, stage: Stage) -> Recipe:
    """The recipe of a name or JSON file, for a stage. Raises ValueError: no such recipe, or what is wrong in it."""
    module = additional_stage(stage)
    path = (module.RECIPES if module else FOLDER) / f"{name}-{stage}.json"
    if not path.is_file():
        path = Path(name)
        if not path.is_file():
            raise ValueError(f"--recipe {name}: expected one of {', '.join(names())}, or a JSON file")
    return parse(read_all(path).decode(errors="replace"), stage, str(path))


def parse(text: str, stage: Stage, where: str = "recipe") -> Recipe:
    """A recipe from JSON: the defaults with what the text says. A "preset" ("compact", "paper") in "model" stands
    for the other values of that model. Raises ValueError naming `where` and the key, and as additional_stage."""
    data = jsonio.load_object(text, where, "recipe")
    if data.get("stage", stage) != stage:
        raise ValueError(f"{where}: is a recipe of stage {jsonio.brief(data['stage'])}, not of '{stage}'")
    module = additional_stage(stage)
    base: Recipe = (module.RECIPE_CLASS if module else Recipe)(stage=stage)
    for key, presets in base.MODEL_PRESETS.items():
        model = data.get(key)
        if isinstance(model, dict) and str(model.get("preset")) in presets:
            base = dataclasses.replace(base, **{key: presets[model["preset"]]})
    return jsonio.build(type(base), data, where, what="recipe", base=base)
