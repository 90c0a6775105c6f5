"""Upper bounds: optimisation on true edited views from all around, which no artist has.

The edit-generate-lift family (Instruct-GS2GS, GaussianEditor, DGE) makes edited views with a generative model and fits
the asset to them. With the true views in their place no generator can do better, so these rows bound the family: one
with the asset's own rows and their colours and opacities alone, as DGE masks its gradients, and one that may also move
rows and add finer ones.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatbench.cases import Pictures
from splatbench.methods import Budget, Done, Method, Work
from splatbench.methods.curve import Curve
from splatpainter.splats import ATTRIBUTES

if TYPE_CHECKING:
    from splatpainter.fit.optimize import View

APPEARANCE = ("opacities", "sh")
SSIM = 0.2
"""Share of 1 - SSIM in the loss; the rest is L1."""


def edit(everything: bool, work: Work, budget: Budget) -> Done:
    """Fit the asset to true edited views. everything: all attributes of all rows, with density control; else colours
    and opacities of the rows that the edit reaches (of a global one: all). Raises ValueError where the case has no true
    edited views, and where a local edit reaches no row."""
    from splatpainter.fit.optimize import FitOptions, optimize

    views = true_views(work)
    curve = Curve(budget.curve)
    rows = None if everything or work.step.mode == "global" else reached(work)
    options = FitOptions(
        steps=budget.steps,
        densify=everything,
        attributes=ATTRIBUTES if everything else APPEARANCE,
        ssim=SSIM,
        seed=budget.seed,
        device=budget.device,
    )
    fitted = optimize(work.asset, views, options, rows=rows, watch=curve.watch)
    numbers = {"steps": float(fitted.steps), "views": float(len(views))}
    if rows is not None:
        numbers["rows_reached"] = float(len(rows))
    what = "all attributes, density control" if everything else "SH and opacity"
    where = "rows that the edit reaches" if rows is not None else "all rows"
    return Done(
        fitted.splats,
        0.0,
        curve.seconds,
        keeps_rows=not everything,
        numbers=numbers,
        note=f"{fitted.steps} steps on true edited views from all around; {what} of {where}; L1 + {SSIM:g} D-SSIM",
        curve=tuple(curve.points),
    )


def true_views(work: Work) -> list[View]:
    """The true views from around the object and the edited ones that everybody gets. Raises ValueError where there are
    none of the first."""
    from splatpainter.fit.optimize import View

    if work.oracle is None:
        raise ValueError("oracle: this case has no true edited views: the edit was made on a picture alone")
    shown: tuple[Pictures, ...] = (work.oracle, work.step.edited)
    return [View(camera, some.colors[k]) for some in shown for k, camera in enumerate(some.cameras)]


def reached(work: Work) -> np.ndarray:
    """[M] int64 rows that make the masked pixels of any edited view: the same that a local edit of the painter may
    change. Raises ValueError where there is none."""
    from splatpainter.lift.local_edit import reached_rows
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import editable_rows

    grid = voxelize(work.asset)
    out = np.zeros(len(work.asset), bool)
    for camera, mask in zip(work.step.edited.cameras, work.step.masks, strict=True):
        out |= reached_rows(work.asset, camera, mask, editable_rows(grid, work.asset, camera, mask))
    return np.flatnonzero(out)


def _method(name: str, label: str, everything: bool) -> Method:
    return Method(
        name=name,
        label=label,
        edit=partial(edit, everything),
        protocols=("refine", "relight", "creative"),
        oracle=True,
        version=lambda _: f"2-{SSIM:g}",
    )


METHODS = (
    _method("oracle-fit", "Edit-and-fit from true views (upper bound)", False),
    _method("oracle-fit-all", "Edit-and-fit from true views, all attributes, finer rows (upper bound)", True),
)
