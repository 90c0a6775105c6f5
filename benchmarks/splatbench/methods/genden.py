"""GenDen-style feed-forward densification (arXiv 2412.06234), with our densifier (densification/).

As the supplement of the paper runs it: all base and edited views at once, on the given asset. Gaussians that the views
pull at hardest are replaced by finer ones; nothing is optimised. There is no set-up: every edit is the whole pass.
"""

from __future__ import annotations

import time

import numpy as np

from splatbench.cases import Budget, PosedImages
from splatbench.densification.densify_config import DensifyConfig
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.weights import Weights

WEIGHTS = Weights(
    ("genden",), "genden", "densifier", train="densify --data MESHES --out RUN", config_class=DensifyConfig
)


def edit(task: EditTask, budget: Budget) -> EditResult:
    """One pass over base views and edited views of all steps so far, always from the asset as it was before the first.
    Raises ValueError where there are no weights, or as densified."""
    import torch

    from splatbench.densification.densifier import densified

    model = WEIGHTS.load(budget)
    start = time.perf_counter()
    asset, earlier = task.state or (task.asset, ())
    edits: tuple[PosedImages, ...] = (*earlier, task.step.edited)
    views = [view for images in (task.base, *edits) for view in images]
    with torch.no_grad():
        result = densified(model, asset, [camera for camera, _ in views], [c.astype(np.float32) for _, c in views])
    splats = result.splats.numpy()
    seconds = time.perf_counter() - start
    numbers = {"rows": len(splats), "rows_replaced": len(result.chosen), "rows_generated": len(result.parents)}
    return EditResult(
        splats,
        0.0,
        seconds,
        keeps_gaussians=False,
        numbers={name: float(value) for name, value in numbers.items()},
        note=f"{len(views)} views; {len(result.chosen)} of {len(asset)} Gaussians replaced by {len(result.parents)}; "
        f"{model.notes.get('step', 0)} training steps",
        state=(asset, edits),
    )


METHODS = (
    Method("genden", "GenDen (ours, compact)", edit, ("refine",), missing=WEIGHTS.missing, version=WEIGHTS.version),
)
