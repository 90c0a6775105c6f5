"""The asset as it is: the lower line of every table, and what "unchanged" costs in the edited region."""

from __future__ import annotations

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method


def edit(task: EditTask, budget: Budget) -> EditResult:
    return EditResult(task.asset, 0.0, 0.0, note="the asset before the edit; nothing is done")


METHODS = (
    Method("nothing", "Asset as it is", edit, ("refine", "relight", "creative", "compress", "sequence", "ablate")),
)
