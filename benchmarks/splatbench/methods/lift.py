"""The analytic lift, alone and with steps of optimisation after it: this package's painter without a network. Also how
any painter is run as a row.

Set-up is everything that is done once per asset (its voxels; with a network its encoding). The edit is what comes after
until the edited asset is there: its pictures beside renders of the asset, the lift, the network. The receipt's own time
(hashes of all Gaussians and the renders that it scores) is left out: it proves the edit and makes nothing of it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatpainter.painter import Edit, Painter

if TYPE_CHECKING:
    from splatpainter.painter import Edit, Painter
    from splatpainter.painter import Method as PainterMethod

PROOF = "receipt"
"""The stage of a receipt's seconds that is no part of an edit."""
TABLES = ("refine", "relight", "creative", "sequence", "ablate")


def edits_of(task: EditTask) -> list[Edit]:
    """The step's pictures as the painter takes them."""
    step = task.step
    return [Edit(color, camera, step.masks[k], f"view {k + 1}") for k, (camera, color) in enumerate(step.edited)]


def painted(painter: Painter, method: PainterMethod, task: EditTask, note: str = "") -> EditResult:
    """The step as this painter makes it; it goes on from the painter's asset in task.state, where there is one. Raises
    ValueError for a step that networks were asked for and that these leave to the lift."""
    chosen, reason = painter.choose(method, task.step.mode)
    if method == "ttt" and chosen != "ttt":
        raise ValueError(reason)
    start = time.perf_counter()
    if task.state is None:
        asset = painter.encode(task.asset, method, (task.step.mode,))
        _ = asset.grid
        setup = time.perf_counter() - start
    else:
        asset, setup = task.state, 0.0
    result = painter.apply(asset, edits_of(task), task.step.mode, method)
    assert result.receipt is not None
    seconds = result.receipt.seconds
    copies = method == "ttt" and painter.model is not None and painter.model.config.representation == "copy"
    return EditResult(
        splats=result.splats,
        setup_seconds=setup,
        edit_seconds=sum(s for stage, s in seconds.items() if stage != PROOF),
        keeps_gaussians=not copies,
        numbers={f"seconds_{stage}": s for stage, s in seconds.items()},
        note="; ".join(filter(None, (note, result.receipt.note))),
        state=result,
    )


def edit(task: EditTask, budget: Budget) -> EditResult:
    """The step by the analytic lift alone, on the CPU."""
    return painted(Painter(), "lift", task)


def edit_and_fit(task: EditTask, budget: Budget) -> EditResult:
    """The lift, then method "fit"'s steps on what it painted. Global edits are the lift's alone."""
    if task.step.mode == "global":
        return painted(Painter(), "lift", task, "global edits: the lift alone")
    return painted(Painter(), "fit", task)


METHODS = (
    Method("lift", "Ours (lift)", edit, TABLES),
    Method("lift-fit", "Ours (lift + fit)", edit_and_fit, ("refine", "creative", "sequence")),
)
