"""Optimisation on true edited views from all around, which no artist has.

The edit-generate-lift family (Instruct-GS2GS, GaussianEditor, DGE) makes edited views with a generative model and fits
the asset to them. With the true views in their place no generator can do better, so these rows say what is left to the
fit itself: one with the asset's Gaussians and their colours and opacities alone, as DGE masks its gradients, and one
that may also move them and add finer ones. They bound that family and no other method: what lays out Gaussians of its
own, or is fitted to the edited views alone, is above them there.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatbench.cases import Budget
from splatbench.methods import Curve, EditResult, EditTask, Method
from splatbench.methods.gs3d import APPEARANCE, fit_views
from splatpainter.lift.local.local_edit import gaussians_in_mask
from splatpainter.splats import ATTRIBUTES
from splatpainter.voxels.grid import voxelize
from splatpainter.voxels.raycast import editable_gaussians

if TYPE_CHECKING:
    from splatpainter.fit.optimize import TrainingView

SSIM_SHARE = 0.2
"""Share of 1 - SSIM in the loss; the rest is L1."""


def edit(all_attributes: bool, task: EditTask, budget: Budget) -> EditResult:
    """Fit the asset to true edited views. all_attributes: of all Gaussians, with density control; else colours and
    opacities of those that the edit reaches (of a global one: all). Raises ValueError where the case has no true edited
    views, and where a local edit reaches no Gaussian."""
    from splatpainter.fit.optimize import FitOptions, optimize

    views = true_views(task)
    curve = Curve(budget.curve)
    gaussian_ids = None if all_attributes or task.step.mode == "global" else reached(task)
    options = FitOptions(
        steps=budget.steps,
        densify=all_attributes,
        attributes=ATTRIBUTES if all_attributes else APPEARANCE,
        ssim=SSIM_SHARE,
        seed=budget.seed,
        device=budget.device,
    )
    fitted = optimize(task.asset, views, options, gaussian_ids=gaussian_ids, watch=curve.watch)
    numbers = {"steps": float(fitted.steps), "views": float(len(views))}
    if gaussian_ids is not None:
        numbers["rows_reached"] = float(len(gaussian_ids))
    what = "all attributes, density control" if all_attributes else "SH and opacity"
    where = "Gaussians that the edit reaches" if gaussian_ids is not None else "all Gaussians"
    return EditResult(
        fitted.splats,
        0.0,
        curve.seconds,
        keeps_gaussians=not all_attributes,
        numbers=numbers,
        note=f"{fitted.steps} steps on true edited views from all around; {what} of {where}; "
        f"L1 + {SSIM_SHARE:g} D-SSIM",
        curve=tuple(curve.points),
    )


def true_views(task: EditTask) -> list[TrainingView]:
    """The true views from around the object and the edited ones that everybody gets. Raises ValueError where there are
    none of the first."""
    if task.true_views is None:
        raise ValueError("oracle: this case has no true edited views: the edit was made on a picture alone")
    return fit_views(task.true_views) + fit_views(task.step.edited)


def reached(task: EditTask) -> np.ndarray:
    """[M] int64 Gaussians that make the masked pixels of any edited view: the same that a local edit of the painter may
    change. Raises ValueError where there is none."""
    grid = voxelize(task.asset)
    out = np.zeros(len(task.asset), bool)
    for camera, mask in zip(task.step.edited.cameras, task.step.masks, strict=True):
        out |= gaussians_in_mask(task.asset, camera, mask, editable_gaussians(grid, task.asset, camera, mask))
    return np.flatnonzero(out)


def _method(name: str, label: str, all_attributes: bool) -> Method:
    return Method(
        name=name,
        label=label,
        edit=partial(edit, all_attributes),
        protocols=("refine", "relight", "creative"),
        sees_truth=True,
        version=lambda _: f"2-{SSIM_SHARE:g}",
    )


METHODS = (
    _method("oracle-fit", "Colours fitted to true edited views all around", False),
    _method("oracle-fit-all", "All attributes fitted to true edited views all around", True),
)
