"""Rows of the ablation table: every switch of the model, one at a time.

The networks that ship (local edits: the local network, global ones: Stage II of preset "rows"), or for all edits that
of --weights compact=FOLDER, are run with one setting changed or one input taken away; weights that were trained with
another setting are not at their best then. A row whose setting is the weights' own is not run twice: it says that it is
the row "same-as-trained". Models that were trained with a switch are compared where training costs a minute,
without pictures: `bench adapt`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.lift import painted
from splatbench.methods.ttt import LOCAL, ROWS
from splatbench.methods.weights import COMPACT, SHIPPED, Weights
from splatpainter.models.config import ModelConfig
from splatpainter.models.local_config import LocalConfig
from splatpainter.painter import Painter

if TYPE_CHECKING:
    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel

AnyConfig = TypeVar("AnyConfig", ModelConfig, LocalConfig)
AnyNetwork = TypeVar("AnyNetwork", "SplatPainterModel", "LocalNetwork")
PREDICTOR = "predictor.expected.weight"
"""Without these weights the predictor counts as untrained, and the lift's own regression takes its place."""
AS_TRAINED = "as trained: the row 'same-as-trained'"


@dataclass(frozen=True)
class Change:
    """What is different from the weights' own settings."""

    refine: Mapping[str, Any] = field(default_factory=dict)
    """Fields of config.refine, and their values."""
    zeroed: tuple[str, ...] = ()
    """Weights of the model that become zero: what they read has no effect."""

    def of(self, config: AnyConfig) -> AnyConfig:
        return dataclasses.replace(config, refine=dataclasses.replace(config.refine, **self.refine))

    def idle(self, config: ModelConfig | LocalConfig) -> bool:
        """Whether a model of this config has nothing to change, or makes all its edits without what is changed."""
        if self == Change():  # as trained
            return False
        if not isinstance(config, ModelConfig):
            return self.of(config) == config
        if config.predictor_only and not config.edits_locally:
            return PREDICTOR not in self.zeroed
        active = {
            "refiner.lift.weight": config.refine.lift_features,
            "refiner.drift.weight": config.refine.base == "lift",
            PREDICTOR: config.predict.features > 0,
        }
        return self.of(config) == config and not any(active[name] for name in self.zeroed)


def altered(model: AnyNetwork, change: Change) -> AnyNetwork:
    """A network of the same weights (shared, not copied) with another setting; tensors that it has no use for are left
    out. Raises ValueError for a setting that these weights do not fit."""
    import torch

    with torch.device("meta"):
        other = type(model)(change.of(model.config))  # pyright: ignore[reportArgumentType]
    tensors, expected = model.state_dict(), other.state_dict()
    unfit = [name for name, tensor in expected.items() if name not in tensors or tensors[name].shape != tensor.shape]
    if unfit:
        raise ValueError(f"ablation: these weights have no '{unfit[0]}' as this setting needs it; train with it")
    used = {name: torch.zeros_like(tensors[name]) if name in change.zeroed else tensors[name] for name in expected}
    other.load_state_dict(used, assign=True)
    other.notes = model.notes
    return other.eval()


def _networks(budget: Budget) -> tuple[Weights, ...]:
    """Whose setting is changed: the weights that are given, or those that ship."""
    return (SHIPPED,) if COMPACT in budget.weights else (ROWS, LOCAL)


def _row(change: Change) -> Callable[[EditTask, Budget], EditResult]:
    def edit(task: EditTask, budget: Budget) -> EditResult:
        if COMPACT in budget.weights:
            painter = Painter(model=altered(SHIPPED.load(budget), change))
        elif task.step.mode == "local":
            painter = Painter(local=altered(LOCAL.load(budget), change))
        else:
            painter = Painter(model=altered(ROWS.load(budget), change))
        return painted(painter, "ttt", task)

    return edit


def _idle(budget: Budget, change: Change) -> str:
    networks = _networks(budget)
    if problem := next((text for weights in networks if (text := weights.missing(budget))), ""):
        return problem
    try:
        return AS_TRAINED if all(change.idle(weights.config(budget)) for weights in networks) else ""
    except ValueError as error:
        return f"these weights cannot: {error}"


def _version(budget: Budget, change: Change) -> str:
    versions = " ".join(weights.version(budget) for weights in _networks(budget))
    return f"{versions} Change(refine={change.refine}, silent={change.zeroed})"  # as records have it


def _changed(name: str, label: str, change: Change) -> Method:
    """A method that is one row: the model with one setting changed."""
    return Method(
        name=f"same-{name}",
        label=f"{label} (same weights)",
        edit=_row(change),
        protocols=("ablate",),
        missing=partial(_idle, change=change),
        version=partial(_version, change=change),
    )


METHODS = (
    _changed("as-trained", "As trained", Change()),
    _changed("inner-steps-1", "1 inner step", Change({"inner_steps": 1})),
    _changed("inner-steps-5", "5 inner steps", Change({"inner_steps": 5})),
    _changed("inner-dot", "Inner loss dot", Change({"inner_loss": "dot"})),
    _changed("inner-l2", "Inner loss l2", Change({"inner_loss": "l2"})),
    _changed("newton-schulz-0", "Plain gradient, no Newton-Schulz", Change({"newton_schulz_steps": 0})),
    _changed("newton-schulz-2", "2 Newton-Schulz iterations", Change({"newton_schulz_steps": 2})),
    _changed("newton-schulz-5", "5 Newton-Schulz iterations", Change({"newton_schulz_steps": 5})),
    _changed("strength-0", "Edit strength 0: no adaptation", Change({"edit_strength": 0.0})),
    _changed("no-detail", "Without the second set", Change({"detail": False})),
    _changed("strength-0.5", "Edit strength 0.5", Change({"edit_strength": 0.5})),
    _changed("strength-1", "Edit strength 1", Change({"edit_strength": 1.0})),
    _changed("strength-2", "Edit strength 2", Change({"edit_strength": 2.0})),
    _changed("no-lift-features", "Without lift features", Change(zeroed=("refiner.lift.weight",))),
    _changed("no-drift", "Without drift features", Change(zeroed=("refiner.drift.weight",))),
    _changed("no-mask-tokens", "All tokens teach alike", Change({"mask_tokens": False})),
    _changed("no-row-tokens", "No teaching Gaussians", Change({"row_tokens": 0})),
    _changed("no-predictor", "Unseen Gaussians by the lift's regression", Change(zeroed=(PREDICTOR,))),
)
"""Strength 0 leaves the fast weights as training left them: what is then lost is what adapting is worth."""
