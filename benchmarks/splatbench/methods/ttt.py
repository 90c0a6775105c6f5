"""Test-time training, with and without polish, and a model whose Stage II attends to the pictures instead of adapting.

Weights are read before any clock starts. Their encodings are never taken from the cache on disk, so that set-up is what
a new asset costs.
"""

from __future__ import annotations

from collections.abc import Callable

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.lift import TABLES, painted
from splatbench.methods.weights import SHIPPED, Weights
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
)
