"""GenDen-style feed-forward densification (arXiv 2412.06234), with this package's densifier (models/densification).

As the supplement of the paper runs it: all base and edited views at once, on the given asset. Rows that the views pull
at hardest are replaced by finer ones; nothing is optimised. There is no set-up: every edit is the whole pass.
"""

from __future__ import annotations

import hashlib
import json
import time
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from splatbench.methods import Budget, Done, Method, Work

if TYPE_CHECKING:
    from splatpainter.models.densification.densifier import Densifier

NAME = "genden"
"""Of the weights: key of Budget.weights, and their folder in the package."""
MISSING = "no weights: train with `splatpainter train densify --data MESHES --out RUN`, then --weights genden=RUN/model"
VERSION = "1"
"""Of how this row uses them."""


def edit(work: Work, budget: Budget) -> Done:
    """One pass over base views and edited views of all steps so far, always from the asset as it was before the first.
    Raises ValueError where there are no weights, or as densified."""
    import numpy as np
    import torch

    from splatpainter.models.densification.densifier import densified

    problem = missing(budget)
    folder = found(budget)
    if folder is None or problem:
        raise ValueError(problem)
    model = _loaded(str(folder), _digest(folder), budget.device)
    start = time.perf_counter()
    asset, earlier = work.memory or (work.asset, ())
    edits = (*earlier, work.step.edited)
    cameras, colors = [], []
    for pictures in (work.base, *edits):
        cameras += pictures.cameras
        colors += list(pictures.colors.astype(np.float32))
    with torch.no_grad():
        made = densified(model, asset, cameras, colors)
    splats = made.splats.numpy()
    seconds = time.perf_counter() - start
    numbers = {"rows": len(splats), "rows_replaced": len(made.chosen), "rows_generated": len(made.parents)}
    note = (
        f"{len(cameras)} views; {len(made.chosen)} of {len(asset)} rows replaced by {len(made.parents)}; "
        f"{model.notes.get('step', 0)} training steps"
    )
    return Done(
        splats,
        0.0,
        seconds,
        keeps_rows=False,
        numbers={name: float(value) for name, value in numbers.items()},
        note=note,
        memory=(asset, edits),
    )


def found(budget: Budget) -> Path | None:
    """The folder of the weights, or None."""
    from splatpainter.models import weights

    return Path(budget.weights[NAME]) if NAME in budget.weights else weights.find(NAME)


def missing(budget: Budget) -> str:
    """Why there are no weights that fit, or ""."""
    folder = found(budget)
    if folder is None:
        return MISSING
    try:
        _digest(folder)
    except ValueError as error:
        return f"no weights: weights '{NAME}': {error}"
    return ""


def version(budget: Budget) -> str:
    """Changes with the weights and their config."""
    folder = found(budget)
    try:
        return f"{VERSION}-none" if folder is None else f"{VERSION}-{_digest(folder)}"
    except ValueError:
        return f"{VERSION}-none"


def _digest(folder: Path) -> str:
    """16 hex digits that change with config or weights, without reading these. Raises ValueError, without the folder's
    name, where it holds no densifier."""
    from splatpainter.models.checkpoint import INDEX
    from splatpainter.models.densification.config import DensifyConfig

    try:
        index = json.loads((folder / INDEX).read_bytes())
        if index["format"] != DensifyConfig.format:
            raise ValueError(f"expected format '{DensifyConfig.format}', got {index['format']!r}")
        DensifyConfig.from_json(json.dumps(index["config"]), INDEX)
        told = json.dumps([index["config"], index["tensors"], index["shards"]], sort_keys=True)
    except OSError as error:
        raise ValueError(f"expected a folder with {INDEX} and its shards ({error.strerror})") from None
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"expected a {INDEX} of a densifier of this version ({error})") from None
    return hashlib.sha256(told.encode()).hexdigest()[:16]


@cache
def _loaded(folder: str, digest: str, device: str) -> Densifier:
    """Once per process; digest: so that other weights in the same folder are read."""
    from splatpainter.models.densification.densifier import Densifier

    return Densifier.load(folder).to(device)


METHODS = (Method(NAME, "GenDen (ours, compact)", edit, ("refine",), missing=missing, version=version),)
