"""Rows of Tab. 4: what the asset looks like after the LRM and after each kind of Stage I, with nothing edited.

    stage1-voxel-att      the mean token of each voxel (the paper's VoxelAtt)
    stage1-latent-query   attention inside voxels, learned queries
    stage1-feats-query    the same, the kept rows' own codes as queries: the paper's, and ours
    stage1-before         before compression: the LRM's Gaussians

Each is a reconstruction from what its LRM was trained on: the asset's canonical views with geometry where the LRM sees
that, else the base views. So all rows with one LRM differ by Stage I alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatbench.methods import Budget, Done, Method, Work
from splatbench.methods.learned import SHIPPED, Needed, compressed, dense
from splatpainter.models.config import Grouping, ModelConfig

if TYPE_CHECKING:
    import torch

    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import SplatPainterModel

GROUPINGS: dict[str, tuple[Grouping, str]] = {
    "voxel-att": ("voxel_mean", "VoxelAtt"),
    "latent-query": ("latent_query", "LocalAtt + latent query"),
    "feats-query": ("feats_query", "LocalAtt + feats query (ours)"),
}
"""Name of the weights -> (compress.grouping, label in the paper's words)."""
BEFORE = Needed((*reversed(GROUPINGS), SHIPPED))
"""Any model that has an LRM; those of the rows that it is compared with first."""


def _grouped_so(config: ModelConfig, grouping: Grouping) -> bool:
    return config.representation == "copy" and config.compress.grouping == grouping


def needed(name: str) -> Needed:
    """The weights of a row of GROUPINGS."""
    grouping = GROUPINGS[name][0]
    return Needed(
        (name,),
        f"model of representation copy with compress.grouping {grouping}",
        partial(_grouped_so, grouping=grouping),
        f"compress --model.representation copy --model.compress.grouping {grouping}",
    )


def seen(model: SplatPainterModel, work: Work, device: torch.device) -> AssetViews:
    """What the model's LRM is shown of an unedited asset, as in training. Raises ValueError for fewer base views than
    it wants."""
    import torch

    from splatpainter.data.samples import Sample, Views
    from splatpainter.train.stages.lrm import input_views

    base = Views(work.base.cameras, torch.from_numpy(np.ascontiguousarray(work.base.colors, np.float32)))
    none = Views((), base.colors[:0])
    nothing = np.zeros(0, bool)
    sample = Sample("", "plain", "global", work.asset, base, none, nothing, none, none, nothing)
    return input_views(model, sample, device)


def reconstructed(weights: Needed, *, compress: bool) -> Callable[[Work, Budget], Done]:
    """A row: LRM, and Stage I with compress. All of it is set-up, there is no edit."""

    def edit(work: Work, budget: Budget) -> Done:
        import torch

        from splatpainter.nn.precision import autocast
        from splatpainter.voxels.grid import voxelize

        model = weights.load(budget)
        start = time.perf_counter()
        with torch.inference_mode(), autocast(budget.device):
            views = seen(model, work, torch.device(budget.device))
            if compress:
                splats, numbers = compressed(model, model.copy_rows(views))
            else:
                splats, numbers = dense(model, views).rows, {}
            splats = splats.numpy()
        seconds = time.perf_counter() - start
        if not compress:
            count, grid = float(len(splats)), voxelize(splats, model.config.compress.resolution)
            numbers = {"gaussians_before": count, "voxels": float(len(grid.keys)), "gaussians_kept": count}
        pictures = f"{len(views.cameras)} {'canonical renders' if views.alpha is not None else 'base views'}"
        note = f"from {pictures} of {views.cameras[0].width} px; {weights.source(budget)}"
        return Done(splats, seconds, 0.0, keeps_rows=False, numbers=numbers, note=note)

    return edit


def _compressing(name: str) -> Method:
    weights = needed(name)
    row = reconstructed(weights, compress=True)
    label = GROUPINGS[name][1]
    return Method(f"stage1-{name}", label, row, ("compress",), missing=weights.missing, version=weights.version)


METHODS = (
    *(_compressing(name) for name in GROUPINGS),
    Method(
        name="stage1-before",
        label="Before compression (GS-LRM)",
        edit=reconstructed(BEFORE, compress=False),
        protocols=("compress",),
        missing=BEFORE.missing,
        version=BEFORE.version,
    ),
)
