"""3DGS optimisation (Kerbl et al. 2023) of the given asset on the edited views: what an artist's edit costs without us.

As the supplement of the paper runs it: refinement from the base views, the edited ones and 48 more of the asset, with
density control; relighting from the relit views alone, with SH and opacity only.

Pictures of the object before a local edit show the old look where the edit is. They count as much as the Gaussians that
the edit reaches do not: in a view of the asset a pixel whose colour comes from such Gaussians by half or more has no
weight, one that they do not touch has all of it. Close-ups (kind "zoom") contradict no base view, only renders of the
asset. Edited views count in full: outside the mask they show the unedited truth. Earlier edits of a sequence stay among
the views, without the pixels that a later one reaches.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import Curve, EditResult, EditTask, Method
from splatpainter.cameras import Camera, spherical_cameras
from splatpainter.lift.local.local_edit import gaussians_in_mask
from splatpainter.rendering import render
from splatpainter.rendering.pixel_shares import share_of
from splatpainter.splats import ATTRIBUTES, Splats

if TYPE_CHECKING:
    from splatpainter.fit.optimize import TrainingView  # needs torch, which no other row's process should carry

ASSET_VIEWS = 48
"""Views of the asset before the edit."""
EDITED_SHARE = 0.25
"""Least share of the steps that edited views get: as 2 of 59 views they would be seen 34 times in 1,000 steps, of the
original's 30,000 a thousand times."""
APPEARANCE = ("sh", "opacities")
CONTRADICTED = 2.0
"""A pixel loses all weight where reached Gaussians give one over this of its colour."""


@dataclass(frozen=True)
class Settings:
    """One row of the tables."""

    asset_views: int = 0
    appearance: bool = False
    """SH and opacity alone, no density control, relit views alone."""


def edit(settings: Settings, task: EditTask, budget: Budget) -> EditResult:
    """Optimise the asset. Raises ValueError for views of the asset in a global edit (they show the old look
    everywhere), and where a local edit reaches no Gaussian."""
    from splatpainter.fit.optimize import FitOptions, optimize

    is_global = task.step.mode == "global"
    if is_global and settings.asset_views:
        raise ValueError(
            f"3dgs-{settings.asset_views}: views of the asset show it without the edit; for global edits take "
            "3dgs-colors"
        )
    begin = time.perf_counter()
    asset_views = views_of_asset(task, settings.asset_views)
    setup = time.perf_counter() - begin
    curve = Curve(budget.curve)
    earlier: tuple[EditStep, ...] = task.state or ()
    views = fit_views(task.step.edited) if is_global else local_views(task, earlier, asset_views)
    options = FitOptions(
        steps=budget.steps,
        densify=not settings.appearance,
        attributes=APPEARANCE if settings.appearance else ATTRIBUTES,
        seed=budget.seed,
        device=budget.device,
    )
    fitted = optimize(task.asset, views, options, watch=curve.watch)
    what = "SH and opacity" if settings.appearance else "all attributes, density control"
    source = "edited views alone" if is_global else f"{len(task.base)} base views, {settings.asset_views} of the asset"
    return EditResult(
        fitted.splats,
        setup,
        curve.seconds,
        keeps_gaussians=settings.appearance,
        numbers={"steps": float(fitted.steps), "views": float(len(views)), "rows": float(len(fitted.splats))},
        note=f"{fitted.steps} steps, {what}; {source}"
        + ("" if is_global else f"; {EDITED_SHARE:.0%} of steps on edited views"),
        state=(*earlier, task.step),
        curve=tuple(curve.points),
    )


def fit_views(images: PosedImages) -> list[TrainingView]:
    from splatpainter.fit.optimize import TrainingView

    return [TrainingView(camera, color) for camera, color in images]


def views_of_asset(task: EditTask, count: int) -> PosedImages | None:
    """`count` renders of the asset, evenly around it; None for none. Every other one has the opposite background: over
    one colour alone Gaussians of that colour turn into holes unseen."""
    if not count:
        return None
    cameras = list(orbit(task.asset, task.base, count))
    red, green, blue = (float(value < 0.5) for value in task.base.cameras[0].background)
    cameras[1::2] = [replace(camera, background=(red, green, blue)) for camera in cameras[1::2]]
    return PosedImages(tuple(cameras), np.clip(render(task.asset, cameras).colors, 0, 1))


def orbit(splats: Splats, base: PosedImages, count: int) -> tuple[Camera, ...]:
    """`count` square cameras evenly around the asset, as far from it and with the same optics as the base views."""
    means = splats.means[splats.drawable]
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    center = (low + high) / 2
    distance = float(np.median([np.linalg.norm(c.position - center) for c in base.cameras]))
    up = -np.mean([c.world_to_camera[1, :3] for c in base.cameras], axis=0)
    up = up if np.linalg.norm(up) > 1e-6 else np.array([0.0, 1.0, 0.0])
    like = base.cameras[0]
    fov = float(np.degrees(2 * np.arctan(like.height / (2 * like.fy))))
    return tuple(
        spherical_cameras(center, distance, count, up=up, size=like.height, fov=fov, backgrounds=(like.background,))
    )


def local_views(task: EditTask, earlier: Sequence[EditStep], asset_views: PosedImages | None) -> list[TrainingView]:
    """Base views, views of the asset and of earlier edits without what contradicts them, and the edited views, which
    are repeated until they are EDITED_SHARE of all."""
    reached_now = reached(task.asset, [task.step])
    unedited: list[TrainingView] = []
    if task.step.kind == "zoom" and not earlier:
        unedited += fit_views(task.base)
    else:
        reached_before = reached(task.asset, [step for step in earlier if step.kind != "zoom"])
        unedited += _without(task.asset, task.base, reached_now | reached_before)
    for images in ([asset_views] if asset_views else []) + [step.edited for step in earlier]:
        unedited += _without(task.asset, images, reached_now)
    return mixed(fit_views(task.step.edited), unedited, EDITED_SHARE)


def mixed(edited: Sequence[TrainingView], unedited: Sequence[TrainingView], share: float) -> list[TrainingView]:
    """All views, the edited ones repeated until they are about `share` (0..1) of them: each round of training takes
    every entry once."""
    times = max(round(share * len(unedited) / ((1 - share) * len(edited))), 1)
    return [*unedited, *(view for _ in range(times) for view in edited)]


def reached(asset: Splats, steps: Sequence[EditStep]) -> np.ndarray:
    """[N] bool: Gaussians that make the masked pixels of any edited view. Raises ValueError where a step reaches
    none."""
    out = np.zeros(len(asset), bool)
    for step in steps:
        for camera, mask in zip(step.edited.cameras, step.masks, strict=True):
            if mask.any():
                out |= gaussians_in_mask(asset, camera, mask)
    return out


def weights_beside(asset: Splats, images: PosedImages, gaussians: np.ndarray) -> np.ndarray:
    """[V, H, W] 0..1: weights of the pictures' pixels by what these Gaussians ([N] bool) do not show of them."""
    shares = np.stack([share_of(asset, camera, gaussians) for camera in images.cameras])
    return np.clip(1 - CONTRADICTED * shares, 0, 1)


def _without(asset: Splats, images: PosedImages, gaussians: np.ndarray) -> list[TrainingView]:
    """The pictures, weighted by what the Gaussians do not show of them; those that show nothing else are left out."""
    out = []
    for view, weights in zip(fit_views(images), weights_beside(asset, images, gaussians), strict=True):
        if weights.any():
            out.append(replace(view, mask=None if weights.min() == 1 else weights))
    return out


def _method(name: str, label: str, settings: Settings, *tables: str) -> Method:
    version = f"2-{settings.asset_views}-{EDITED_SHARE:g}-{CONTRADICTED:g}"
    return Method(name, label, partial(edit, settings), tables, version=lambda _: version)


METHODS = (
    _method("3dgs", "3DGS", Settings(), "refine"),
    _method(
        f"3dgs-{ASSET_VIEWS}",
        f"3DGS + {ASSET_VIEWS} views of the asset",
        Settings(ASSET_VIEWS),
        *("refine", "creative", "sequence"),
    ),
    _method("3dgs-colors", "3DGS (SH and opacity)", Settings(appearance=True), "relight"),
)
