"""The analytic lift, alone and with steps of optimisation after it: this package's painter without a network. Also how
any painter is run as a row.

Set-up is everything that is done once per asset (its voxels; with a network its encoding). The edit is what comes after
until the edited asset is there: its pictures beside renders of the asset, the lift, the network. The receipt's own time
(hashes of all rows and the renders that it scores) is left out: it proves the edit and makes nothing of it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from splatbench.methods import Budget, Done, Method, Work

if TYPE_CHECKING:
    from splatpainter.painter import Edit, Painter
    from splatpainter.painter import Method as How

PROOF = "receipt"
"""The stage of a receipt's seconds that is no part of an edit."""
TABLES = ("refine", "relight", "creative", "sequence", "ablate")


def edits_of(work: Work) -> list[Edit]:
    """The step's pictures as the painter takes them."""
    from splatpainter.painter import Edit

    edited = work.step.edited
    return [
        Edit(edited.colors[k], camera, work.step.masks[k], f"view {k + 1}") for k, camera in enumerate(edited.cameras)
    ]


def painted(painter: Painter, how: How, work: Work, note: str = "") -> Done:
    """The step as this painter makes it; it goes on from the painter's asset in work.memory, where there is one."""
    start = time.perf_counter()
    if work.memory is None:
        asset = painter.encode(work.asset, how)
        _ = asset.grid
        setup = time.perf_counter() - start
    else:
        asset, setup = work.memory, 0.0
    result = painter.apply(asset, edits_of(work), work.step.mode, how)
    assert result.receipt is not None
    seconds = result.receipt.seconds
    copies = how == "ttt" and painter.model is not None and painter.model.config.representation == "copy"
    return Done(
        splats=result.splats,
        setup_seconds=setup,
        edit_seconds=sum(s for stage, s in seconds.items() if stage != PROOF),
        keeps_rows=not copies,
        numbers={f"seconds_{stage}": s for stage, s in seconds.items()},
        note="; ".join(filter(None, (note, result.receipt.note))),
        memory=result,
    )


def edit(work: Work, budget: Budget) -> Done:
    """The step by the analytic lift alone, on the CPU."""
    from splatpainter.painter import Painter

    return painted(Painter(), "lift", work)


def edit_and_fit(work: Work, budget: Budget) -> Done:
    """The lift, then method "fit"'s steps on the rows that it painted. Global edits are the lift's alone."""
    from splatpainter.painter import Painter

    if work.step.mode == "global":
        return painted(Painter(), "lift", work, "global edits: the lift alone")
    return painted(Painter(), "fit", work)


METHODS = (
    Method(name="lift", label="Ours (lift)", edit=edit, protocols=TABLES),
    Method(name="lift-fit", label="Ours (lift + fit)", edit=edit_and_fit, protocols=("refine", "creative", "sequence")),
)
