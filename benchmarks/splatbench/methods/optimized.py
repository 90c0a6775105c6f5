"""3DGS optimisation (Kerbl et al. 2023) of the given asset on the edited views: what an artist's edit costs without us.

As the supplement of the paper runs it: refinement from the base views, the edited ones and 48 more of the asset, with
density control; relighting from the relit views alone, with SH and opacity only.

Pictures of the object before a local edit show the old look where the edit is. They count as much as the rows that the
edit reaches do not: in a view of the asset a pixel whose colour comes from such rows by half or more has no weight, one
that they do not touch has all of it. Close-ups (kind "zoom") contradict no base view, only the asset's own. Edited
views count as a whole: outside the mask they show the unedited truth. Earlier edits of a sequence stay among the views,
without the pixels that a later one reaches.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatbench.cases import Pictures, Step
from splatbench.methods import Budget, Done, Method, Work
from splatbench.methods.curve import Curve
from splatpainter.cameras import Camera
from splatpainter.splats import ATTRIBUTES, Splats

if TYPE_CHECKING:
    from splatpainter.fit.optimize import View

EXTRA = 48
"""Views of the asset before the edit."""
EDITED = 0.25
"""Share of the steps that edited views get, at least: as 2 of 59 views they would be seen 34 times in 1,000 steps, of
the original's 30,000 a thousand times."""
APPEARANCE = ("sh", "opacities")
CONTRADICTED = 2.0
"""A pixel loses all weight where reached rows give one over this of its colour."""


@dataclass(frozen=True)
class Settings:
    """One row of the tables."""

    extra: int = 0
    """Views of the asset."""
    appearance: bool = False
    """SH and opacity alone, no density control, relit views alone."""


def edit(settings: Settings, work: Work, budget: Budget) -> Done:
    """Optimise the asset. Raises ValueError for extra views in a global edit (they show the old look everywhere), and
    where a local edit reaches no row."""
    from splatpainter.fit.optimize import FitOptions, optimize

    whole = work.step.mode == "global"
    if whole and settings.extra:
        raise ValueError(
            f"3dgs-{settings.extra}: views of the asset show its old look all over; for global edits take 3dgs-colors"
        )
    begin = time.perf_counter()
    kept = views_of_asset(work, settings.extra)
    setup = time.perf_counter() - begin
    curve = Curve(budget.curve)
    earlier: tuple[Step, ...] = work.memory or ()
    views = local_views(work, earlier, kept) if not whole else _all(work.step.edited)
    options = FitOptions(
        steps=budget.steps,
        densify=not settings.appearance,
        attributes=APPEARANCE if settings.appearance else ATTRIBUTES,
        seed=budget.seed,
        device=budget.device,
    )
    fitted = optimize(work.asset, views, options, watch=curve.watch)
    what = "SH and opacity" if settings.appearance else "all attributes, density control"
    shown = "edited views alone" if whole else f"{len(work.base)} base views, {settings.extra} of the asset"
    return Done(
        fitted.splats,
        setup,
        curve.seconds,
        keeps_rows=settings.appearance,
        numbers={"steps": float(fitted.steps), "views": float(len(views)), "rows": float(len(fitted.splats))},
        note=f"{fitted.steps} steps, {what}; {shown}" + ("" if whole else f"; {EDITED:.0%} of steps on edited views"),
        memory=(*earlier, work.step),
        curve=tuple(curve.points),
    )


def views_of_asset(work: Work, count: int) -> Pictures | None:
    """`count` renders of the asset, evenly around it; None for none. Every other one has the opposite background: over
    one colour alone rows of that colour turn into holes unseen."""
    from splatbench.methods.srgs_views import around
    from splatpainter.rendering import render

    if not count:
        return None
    cameras = list(around(work.asset, work.base, count))
    red, green, blue = (float(value < 0.5) for value in work.base.cameras[0].background)
    cameras[1::2] = [replace(camera, background=(red, green, blue)) for camera in cameras[1::2]]
    return Pictures(tuple(cameras), np.clip(render(work.asset, cameras).colors, 0, 1))


def local_views(work: Work, earlier: Sequence[Step], kept: Pictures | None) -> list[View]:
    """Base views, views of the asset and of earlier edits without what contradicts them, and the edited views, which
    are repeated until they are EDITED of all."""
    from splatbench.methods.srgs_views import mixed
    from splatpainter.fit.optimize import View

    now = reached(work.asset, [work.step])
    others: list[View] = []
    if work.step.kind == "zoom" and not earlier:
        others += _all(work.base)
    else:
        changed = now | reached(work.asset, [step for step in earlier if step.kind != "zoom"])
        others += _beside(work.asset, work.base, changed)
    for some in ([kept] if kept else []) + [step.edited for step in earlier]:
        others += _beside(work.asset, some, now)
    edited = [
        View(camera, color) for camera, color in zip(work.step.edited.cameras, work.step.edited.colors, strict=True)
    ]
    return mixed(edited, others, EDITED)


def reached(asset: Splats, steps: Sequence[Step]) -> np.ndarray:
    """[N] bool: rows that make the masked pixels of any edited view. Raises ValueError where a step reaches none."""
    from splatpainter.lift.local_edit import reached_rows

    out = np.zeros(len(asset), bool)
    for step in steps:
        for camera, mask in zip(step.edited.cameras, step.masks, strict=True):
            if mask.any():
                out |= reached_rows(asset, camera, mask)
    return out


def share_of(asset: Splats, camera: Camera, rows: np.ndarray) -> np.ndarray:
    """[H, W] part of each pixel's colour that comes from these rows ([N] bool), 0..1."""
    from splatpainter.rendering.cpu.projected_view import project

    frame = project(asset, replace(camera, background=(0.0, 0.0, 0.0)))
    return frame.rasterize(np.repeat(rows[frame.gaussian_ids, None].astype(np.float32), 3, 1))[0][..., 0]


def _all(pictures: Pictures) -> list[View]:
    from splatpainter.fit.optimize import View

    return [View(camera, color) for camera, color in zip(pictures.cameras, pictures.colors, strict=True)]


def _beside(asset: Splats, pictures: Pictures, rows: np.ndarray) -> list[View]:
    """The pictures, weighted by what the rows do not show of them; those that show nothing else are left out."""
    out = []
    for view in _all(pictures):
        weights = np.clip(1 - CONTRADICTED * share_of(asset, view.camera, rows), 0, 1)
        if weights.any():
            out.append(replace(view, mask=None if weights.min() == 1 else weights))
    return out


def _method(name: str, label: str, settings: Settings, protocols: tuple[str, ...]) -> Method:
    return Method(
        name=name,
        label=label,
        edit=partial(edit, settings),
        protocols=protocols,
        version=lambda _: f"2-{settings.extra}-{EDITED:g}-{CONTRADICTED:g}",
    )


METHODS = (
    _method("3dgs", "3DGS", Settings(), ("refine",)),
    _method(f"3dgs-{EXTRA}", f"3DGS + {EXTRA} views of the asset", Settings(EXTRA), ("refine", "creative", "sequence")),
    _method("3dgs-colors", "3DGS (SH and opacity)", Settings(appearance=True), ("relight",)),
)
