"""SRGS (Feng et al., arXiv 2404.10318): 3DGS optimised in high resolution under a super-resolution prior.

As the supplement of the paper runs it: from the given asset, on its base views, the edited ones, and 48 more views of
the asset itself. Base views and those 48 are low-resolution pictures, which a prior makes four times as large; edited
close-ups are true pictures of that resolution and are used as they are. The published method draws each view four times
as large as its picture; here a step draws one patch of that (srgs_patches.py), or a step on a CPU would cost many
times one of 3DGS.

Both weightings of its loss w L_tex + (1 - w) L_sub: w = 0.4, the line that the released code has commented out, and
w = 1, which it runs. The prior: super_resolution.py.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatbench.adapters import adapters_file
from splatbench.cases import Budget
from splatbench.methods import Curve, EditResult, EditTask, Method
from splatbench.methods.gs3d import (
    ASSET_VIEWS,
    EDITED_SHARE,
    fit_views,
    mixed,
    reached,
    views_of_asset,
    weights_beside,
)
from splatbench.methods.super_resolution import PROGRAM, Prior, lanczos, missing_program, program

if TYPE_CHECKING:
    from splatpainter.fit.optimize import TrainingView

FACTOR = 4
MAX_PATCHES = 2
"""Most patches of each low-resolution picture."""
PATCH_EDGE = 2
"""Edge of a patch, in edges of the low-resolution picture: a step draws a quarter of the large picture. Measured (one
object, 128 px, 300 steps, dB on novel views near the edit and far from it): a sixteenth 24.9 and 27.2, a quarter 25.5
and 28.4, all of it 24.9 and 28.6 at 2.7 times the time per step."""
PAPER, RELEASED = 0.4, 1.0
"""Weights of L_tex."""


def edit(
    texture: float,
    external: bool,
    task: EditTask,
    budget: Budget,
    *,
    factor: int = FACTOR,
    asset_views: int = ASSET_VIEWS,
) -> EditResult:
    """Optimise all attributes of the asset, with density control. texture: w above; external: the user's program makes
    the high-resolution pictures; factor: of their size; asset_views: views of the asset. Raises ValueError for a global
    edit (base views show the old look everywhere), and where the program is missing or fails."""
    from splatbench.methods.srgs_patches import SSIM_SHARE, srgs_loss
    from splatpainter.fit.optimize import FitOptions, optimize

    if task.step.mode == "global":
        raise ValueError(f"srgs: is for local edits, got a global one ({task.step.kind})")
    begin = time.perf_counter()
    if external:
        if budget.scratch is not None:
            budget.scratch.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="super-resolution-", dir=budget.scratch))
        unedited = low_views(task, program(budget.adapters, factor, folder), budget, factor, asset_views)
        shutil.rmtree(folder, ignore_errors=True)  # after a failure it stays: its log is named in the error
    else:
        unedited = low_views(task, partial(lanczos, factor=factor), budget, factor, asset_views)
    setup = time.perf_counter() - begin
    curve = Curve(budget.curve)
    views = mixed(fit_views(task.step.edited), unedited, EDITED_SHARE)
    options = FitOptions(steps=budget.steps, ssim=SSIM_SHARE, seed=budget.seed, device=budget.device)
    fitted = optimize(task.asset, views, options, loss=partial(srgs_loss, texture, factor), watch=curve.watch)
    prior = "the adapters file's program" if external else "Lanczos and back-projection, no network"
    return EditResult(
        fitted.splats,
        setup,
        curve.seconds,
        keeps_gaussians=False,
        numbers={"steps": float(fitted.steps), "patches": float(len(unedited)), "rows": float(len(fitted.splats))},
        note=f"{fitted.steps} steps, each of a window of a large picture ({min(PATCH_EDGE / factor, 1):.0%} of its "
        f"edge) or ({EDITED_SHARE:.0%}) an edited view; {len(task.base)} base views and {asset_views} of the asset, "
        f"x{factor} by {prior}; {texture:g} L_tex + {1 - texture:g} L_sub; densification",
        curve=tuple(curve.points),
    )


def low_views(task: EditTask, prior: Prior, budget: Budget, factor: int, asset_views: int) -> list[TrainingView]:
    """Patches of base views and of views of the asset, without what the edit contradicts (gs3d.py): of the asset's
    views, and, where it is no close-up, of base views too."""
    from splatbench.methods.srgs_patches import patches

    gaussians = reached(task.asset, [task.step])
    count = min(MAX_PATCHES, max(1, round(budget.steps / (len(task.base) + asset_views))))
    edge = PATCH_EDGE * max(max(camera.width, camera.height) for camera in task.base.cameras)
    settings = (task.asset, prior, factor, edge, count, np.random.default_rng(budget.seed))
    weights = None if task.step.kind == "zoom" else weights_beside(task.asset, task.base, gaussians)
    out: list[TrainingView] = [*patches(task.base, *settings, weights)]
    renders = views_of_asset(task, asset_views)
    if renders is not None:
        out += patches(renders, *settings, weights_beside(task.asset, renders, gaussians))
    return out


def missing(external: bool, budget: Budget) -> str:
    """Why there is no program to call, or ""."""
    return missing_program(budget.adapters) if external else ""


def version(external: bool, budget: Budget) -> str:
    """Changes with the settings and, with a program, with its table of the adapters file."""
    settings = f"2-{FACTOR}-{ASSET_VIEWS}-{MAX_PATCHES}-{PATCH_EDGE}-{EDITED_SHARE:g}"
    return f"{settings}-{adapters_file.digest(budget.adapters, PROGRAM)}" if external else settings


def _method(name: str, label: str, texture: float, external: bool) -> Method:
    return Method(
        name=name,
        label=f"SRGS ({label})",
        edit=partial(edit, texture, external),
        protocols=("refine",),
        missing=partial(missing, external),
        version=partial(version, external),
    )


METHODS = (
    _method("srgs", "0.4 texture + 0.6 sub-pixel; Lanczos prior", PAPER, False),
    _method("srgs-released", "texture alone, as released; Lanczos prior", RELEASED, False),
    _method("srgs-program", "0.4 texture + 0.6 sub-pixel; own super-resolution program", PAPER, True),
    _method("srgs-program-released", "texture alone; own super-resolution program", RELEASED, True),
)
