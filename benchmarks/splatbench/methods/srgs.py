"""SRGS (Feng et al., arXiv 2404.10318): 3DGS optimised in high resolution under a super-resolution prior.

As the supplement of the paper runs it: from the given asset, on its base views, the edited ones, and 48 more views of
the asset itself. Base views and those 48 are low-resolution pictures, which a prior makes four times as large; edited
close-ups are true pictures of that resolution and are used as they are.

Both weightings of its loss w L_tex + (1 - w) L_sub: w = 0.4, the line that the released code has commented out, and
w = 1, which it runs. SwinIR's weights are not bundled: the prior is this package's own (srgs_prior.py), or, in rows of
their own, the user's program.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from splatbench.methods import Budget, Done, Method, Work
from splatbench.methods.curve import Curve

if TYPE_CHECKING:
    from splatbench.cases import Pictures
    from splatbench.methods.srgs_prior import Prior
    from splatpainter.fit.optimize import View

FACTOR = 4
EXTRA = 48
"""Views of the asset before the edit."""
PATCHES = 2
"""At most, of each low-resolution picture."""
EDGE = 2
"""Of a patch, in edges of the low-resolution picture: a step draws a quarter of the large picture. Measured (one
object, 128 px, 300 steps, dB on novel views near the edit and far from it): a sixteenth 24.9 and 27.2, a quarter 25.5
and 28.4, all of it 24.9 and 28.6 at 2.7 times the time per step."""
EDITED = 0.25
"""Share of the steps that edited views get, as in optimized.py."""
PAPER, RELEASED = 0.4, 1.0
"""Weights of L_tex."""


def edit(
    texture: float, external: bool, work: Work, budget: Budget, *, factor: int = FACTOR, extra: int = EXTRA
) -> Done:
    """Optimise all attributes of the asset, with density control. texture: w above; external: the user's program makes
    the high-resolution pictures; factor: of their size; extra: views of the asset. Raises ValueError for a global edit
    (base views show the old look everywhere), and where the program is missing or fails."""
    from splatbench.methods import srgs_prior
    from splatbench.methods.srgs_views import SSIM, mixed, srgs_loss
    from splatpainter.fit.optimize import FitOptions, View, optimize

    if work.step.mode == "global":
        raise ValueError(f"srgs: is for local edits, got a global one ({work.step.kind})")
    begin = time.perf_counter()
    if external:
        if budget.scratch is not None:
            budget.scratch.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="super-resolution-", dir=budget.scratch))
        others = _low(work, srgs_prior.program(budget.adapters, factor, folder), budget, factor, extra)
        shutil.rmtree(folder, ignore_errors=True)  # after a failure it stays: its log is named in the error
    else:
        others = _low(work, partial(srgs_prior.lanczos, factor=factor), budget, factor, extra)
    setup = time.perf_counter() - begin
    curve = Curve(budget.curve)
    edited = [View(camera, work.step.edited.colors[k]) for k, camera in enumerate(work.step.edited.cameras)]
    views = mixed(edited, others, EDITED)
    options = FitOptions(steps=budget.steps, ssim=SSIM, seed=budget.seed, device=budget.device)
    fitted = optimize(work.asset, views, options, loss=partial(srgs_loss, texture, factor), watch=curve.watch)
    prior = "the adapters file's program" if external else "Lanczos and back-projection, no network"
    return Done(
        fitted.splats,
        setup,
        curve.seconds,
        keeps_rows=False,
        numbers={"steps": float(fitted.steps), "patches": float(len(others)), "rows": float(len(fitted.splats))},
        note=f"{fitted.steps} steps, each of a window of a large picture ({min(EDGE / factor, 1):.0%} of its edge) or "
        f"({EDITED:.0%}) an edited view; {len(work.base)} base views and {extra} of the asset, x{factor} by {prior}; "
        f"{texture:g} L_tex + {1 - texture:g} L_sub; densification",
        curve=tuple(curve.points),
    )


def _low(work: Work, prior: Prior, budget: Budget, factor: int, extra: int) -> list[View]:
    """Patches of base views and of views of the asset, without what the edit contradicts (optimized.py): of the asset's
    own views, and, where it is no close-up, of base views too."""
    import numpy as np

    from splatbench.methods.optimized import CONTRADICTED, reached, share_of, views_of_asset
    from splatbench.methods.srgs_views import patches

    rows = reached(work.asset, [work.step])

    def beside(pictures: Pictures) -> np.ndarray:
        shares = np.stack([share_of(work.asset, camera, rows) for camera in pictures.cameras])
        return np.clip(1 - CONTRADICTED * shares, 0, 1)

    each = min(PATCHES, max(1, round(budget.steps / (len(work.base) + extra))))
    edge = EDGE * max(max(camera.width, camera.height) for camera in work.base.cameras)
    how = (work.asset, prior, factor, edge, each, np.random.default_rng(budget.seed))
    out: list[View] = [*patches(work.base, *how, None if work.step.kind == "zoom" else beside(work.base))]
    own = views_of_asset(work, extra)
    return out if own is None else out + [*patches(own, *how, beside(own))]


def _missing(external: bool, budget: Budget) -> str:
    from splatbench.methods import srgs_prior

    return srgs_prior.missing(budget.adapters) if external else ""


def _version(external: bool, budget: Budget) -> str:
    from splatbench.methods import srgs_prior

    settings = f"2-{FACTOR}-{EXTRA}-{PATCHES}-{EDGE}-{EDITED:g}"
    return f"{settings}-{srgs_prior.digest(budget.adapters)}" if external else settings


def _method(name: str, label: str, texture: float, external: bool) -> Method:
    return Method(
        name=name,
        label=label,
        edit=partial(edit, texture, external),
        protocols=("refine",),
        missing=partial(_missing, external),
        version=partial(_version, external),
    )


METHODS = (
    _method("srgs", "SRGS (0.4 texture + 0.6 sub-pixel; Lanczos prior)", PAPER, False),
    _method("srgs-released", "SRGS (texture alone, as released; Lanczos prior)", RELEASED, False),
    _method("srgs-program", "SRGS (0.4 texture + 0.6 sub-pixel; own super-resolution program)", PAPER, True),
    _method("srgs-program-released", "SRGS (texture alone; own super-resolution program)", RELEASED, True),
)
