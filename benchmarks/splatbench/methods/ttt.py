"""Test-time training, with and without polish, a model whose Stage II attends to the pictures instead of adapting, and
the networks apart: test-time training of global edits, and the local network.

Weights are read before any clock starts. Their encodings are never taken from the cache on disk, so that set-up is what
a new asset costs.
"""

from __future__ import annotations

from collections.abc import Callable

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.lift import TABLES, painted
from splatbench.methods.weights import SHIPPED, Weights
from splatpainter.models.local_config import LocalConfig
from splatpainter.painter import EditSettings, Painter

CROSS = Weights(
    ("cross-attention",),
    model="model with refine.mixer cross_attention",
    fits=lambda config: config.refine.mixer == "cross_attention",
    train="refine --model.refine.mixer cross_attention --model.refine.row-tokens 0",
)


def refined(weights: Weights, *, polish: bool = False) -> Callable[[EditTask, Budget], EditResult]:
    """A row: Stage II with these weights, and two rounds of the lift afterwards with polish."""

    def edit(task: EditTask, budget: Budget) -> EditResult:
        return painted(Painter(model=weights.load(budget), settings=EditSettings(polish=polish)), "ttt", task)

    return edit


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


def _method(name: str, label: str, weights: Weights, relit: str = "", **options: bool) -> Method:
    """relit: its label where all edits are global and these weights have their predictor make those, without Stage
    II."""

    def label_of(table: str, budget: Budget) -> str:
        alone = relit and table == "relight" and not weights.missing(budget) and weights.config(budget).predictor_only
        return relit if alone else label

    edit = refined(weights, **options)
    return Method(name, label, edit, TABLES, label_of=label_of, missing=weights.missing, version=weights.version)


METHODS = (
    _method("ttt", "Ours (TTT)", SHIPPED, "Ours (predictor)"),
    _method("ttt-polish", "Ours (TTT + polish)", SHIPPED, "Ours (predictor + polish)", polish=True),
    _method("cross-attention", "Ours (cross-attention)", CROSS),
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
