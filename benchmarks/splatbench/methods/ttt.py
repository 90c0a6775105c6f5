"""The networks apart, each row named by the weights that make it: method auto (the best of them by its notes), the
predictor, test-time training of global edits, the local network, a Stage II that attends instead of adapting; and, of
weights that are given, test-time training with and without polish.

Weights are read before any clock starts. Their encodings are never taken from the cache on disk, so that set-up is what
a new asset costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.lift import TABLES, painted
from splatbench.methods.weights import COMPACT, SHIPPED, Weights
from splatpainter.lift.local import correction
from splatpainter.models.local_config import LocalConfig
from splatpainter.painter import EditSettings, Painter

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel

CROSS = Weights(
    ("cross-attention",),
    model="model with refine.mixer cross_attention",
    fits=lambda config: config.refine.mixer == "cross_attention",
    train="rows --recipe compact --model.refine.mixer cross_attention",
)


def refined(weights: Weights, *, polish: bool = False) -> Callable[[EditTask, Budget], EditResult]:
    """A row: Stage II with these weights, and two rounds of the lift afterwards with polish."""

    def edit(task: EditTask, budget: Budget) -> EditResult:
        if task.step.mode == "global" and weights.config(budget).predictor_only:
            raise ValueError("these weights make global edits by their predictor: see the row of that name")
        return painted(Painter(model=weights.load(budget), settings=EditSettings(polish=polish)), "ttt", task)

    return edit


@cache
def stage2_alone(model: SplatPainterModel) -> SplatPainterModel:
    """The model without its predictor, so that Stage II makes global edits (as preset `rows` is of `compact`)."""
    if model.predictor is None:
        return model
    predict = replace(model.config.predict, features=0, alone=False)
    alone = type(model)(replace(model.config, predict=predict))
    alone.load_state_dict({name: x for name, x in model.state_dict().items() if not name.startswith("predictor.")})
    return alone.to(next(model.parameters()).device).eval()


def by_cross_attention(task: EditTask, budget: Budget) -> EditResult:
    """`train rows` leaves a predictor beside the Stage II that it trains; the row is Stage II's."""
    return painted(Painter(model=stage2_alone(CROSS.load(budget))), "ttt", task)


PREDICTOR = Weights(
    packaged=COMPACT,
    model="model whose predictor makes global edits",
    fits=lambda config: config.predictor_only,
    train="predict --recipe compact",
)
ROWS = Weights(
    ("rows",),
    packaged="rows",
    model="model whose Stage II carries global edits",
    fits=lambda config: config.carries,
    train="rows --recipe compact",
)
LOCAL = Weights(
    ("local",), packaged="local", model="local network", train="rows --recipe paint", config_class=LocalConfig
)


def auto(task: EditTask, budget: Budget) -> EditResult:
    """What an edit without options is: each mode by what its weights' notes say is best."""
    model, local = (None if w.missing(budget) else w.load(budget) for w in (SHIPPED, LOCAL))
    return painted(Painter(model=model, local=local), "auto", task)


def by_predictor(task: EditTask, budget: Budget) -> EditResult:
    """Global edits by the predictor, without test-time training."""
    return painted(Painter(model=PREDICTOR.load(budget)), "ttt", task)


def global_ttt(task: EditTask, budget: Budget) -> EditResult:
    """Global edits by test-time training, each from the state that those before left; local ones by the lift."""
    network = ROWS.load(budget)
    if task.step.mode == "global":
        return painted(Painter(model=network), "ttt", task)
    return painted(Painter(model=network), "lift", task, "local edits: the lift alone")


def local_network(task: EditTask, budget: Budget) -> EditResult:
    """Local edits by the local network; global ones by the lift."""
    if task.step.mode == "global":
        return painted(Painter(), "lift", task, "global edits: the lift alone")
    return painted(Painter(local=LOCAL.load(budget)), "ttt", task)


def _method(name: str, label: str, weights: Weights, **options: bool) -> Method:
    """In no table by default."""
    return Method(name, label, refined(weights, **options), (), missing=weights.missing, version=weights.version)


def _auto_version(budget: Budget) -> str:
    return f"{SHIPPED.version(budget)} {LOCAL.version(budget)} {correction.digest()}"


METHODS = (
    Method("auto", "Ours (auto)", auto, TABLES, version=_auto_version),
    Method(
        "predictor",
        "Ours (predictor)",
        by_predictor,
        ("relight",),
        missing=PREDICTOR.missing,
        version=PREDICTOR.version,
    ),
    _method("ttt", "Ours (TTT)", SHIPPED),
    _method("ttt-polish", "Ours (TTT + polish)", SHIPPED, polish=True),
    Method(
        "cross-attention",
        "Ours (cross-attention)",
        by_cross_attention,
        ("relight",),
        missing=CROSS.missing,
        version=CROSS.version,
    ),
    Method(
        "ttt-global",
        "Ours (TTT, global)",
        global_ttt,
        ("relight", "sequence"),
        missing=ROWS.missing,
        version=ROWS.version,
    ),
    Method(
        "network",
        "Ours (network)",
        local_network,
        ("refine", "creative", "sequence"),
        missing=LOCAL.missing,
        version=LOCAL.version,
    ),
)
