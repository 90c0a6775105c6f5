"""The ablation table: every switch of the model on a list of held-out training samples, local and global edits apart.

The list is the one that checkpoints are judged on (train/judge.py), with its truth of dense surfels, so it is quick
and speaks of the very task that the weights were trained for. Figures are train/judge.py's: of local edits near the
edit and where it changes the object, of global ones on the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup
from splatbench.scoring import rendered
from splatbench.tables import measures
from splattrain.data.held_out import HeldOut
from splattrain.data.object_sources import HELD_OUT_SHARE
from splattrain.data.sample_recipes import SampleRecipe

if TYPE_CHECKING:
    from splatbench.methods import EditResult
    from splattrain.data.samples import PosedViews, SampleStream
    from splattrain.loss import PictureTarget
    from splattrain.training_data import DataSettings, ResourceFolders

KIND_WEIGHTS = {
    "relight": 3.0,
    "stroke": 2.0,
    "zoom": 2.0,
    "regrade": 1.0,
    "text": 1.0,
    "sticker": 1.0,
    "recolor": 1.0,
    "photo": 0.5,
    "noise": 0.5,
    "conflict": 0.5,
}
"""Shares of kinds in the list; every beginning of it is in proportion."""
SAMPLES_PER_OBJECT = 2
"""Samples per object of `--objects`."""
RELIT_VIEWS = 2
"""Edited views of every relighting."""
PROCEDURAL = "procedural:64"
"""The data without a folder."""
SURFELS_PER_GAUSSIAN = 8
"""Surfels per Gaussian of the truth and of the asset (the training samples have 7.5)."""
MIN_SURFELS = 60_000
MIN_ASSET_ALPHA = 0.5
"""Least alpha of a pixel of the asset."""
UNEDITED_WEIGHT = 0.25
"""Weight of pixels that nobody edited: of the training loss, no figure here depends on it."""


class Ablation:
    """See the module; one case per sample."""

    name = "ablate"
    title = "Ablations on held-out training samples"
    columns = measures()
    split_by = "mode"

    def keys(self, setup: Setup) -> list[CaseKey]:
        from splattrain.judge import apportioned

        possible = _stream(setup, files=False).kinds  # of splat assets neither zooms nor relighting
        order = apportioned({kind: KIND_WEIGHTS[kind] for kind in possible}, SAMPLES_PER_OBJECT * setup.objects)
        return [CaseKey(f"{k:03d}-{kind}", f"sample {k}", {"number": k, "kind": kind}) for k, kind in enumerate(order)]

    def make(self, key: CaseKey, setup: Setup) -> Case:
        number, kind = key.settings["number"], key.settings["kind"]
        sample = _of_kind(_stream(setup), kind)[number]
        views = sample.edited.colors.shape[0]
        case = Case(
            protocol=self.name,
            name=sample.name,
            label=key.label,
            asset=sample.asset.numpy(),
            base=_pictures(sample.base),
            steps=(EditStep(sample.mode, sample.kind, _pictures(sample.edited), np.asarray(sample.masks, bool)),),
            before=_pictures(sample.novel_before),
            after=_pictures(sample.novel_after),
            near=np.asarray(sample.near, bool),
            facts={"mode": sample.mode, "kind": kind, "views": views, "truth": "surfels", "number": number},
        )
        if not bool(_target(case)[1].focus.any()):
            raise ValueError(f"{sample.name}: no novel view shows the edit ({kind})")
        return case

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        import torch

        from splattrain.report import figures

        views, target = _target(case)
        renders = torch.from_numpy(rendered(results[-1].splats, [case.after.cameras[k] for k in views]))
        measured = figures("psnr", renders, target, perceptual)
        return {
            "psnr": measured.get("psnr"),
            "ssim": measured.get("psnr SSIM"),
            "lpips": measured.get("psnr LPIPS-Alex"),
        }

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        views, target = _target(case)
        k = int(target.focus.flatten(1).sum(1).argmax())
        render = rendered(results[-1].splats, [case.after.cameras[views[k]]])[0]
        return {"result": render, "truth": target.colors[k].numpy()}


TABLE = Ablation()


def _data_settings(setup: Setup, resources: ResourceFolders) -> DataSettings:
    """The training data's own samples at the setup's sizes. Raises ValueError for a folder of shards."""
    from splattrain.training_data import DataSettings, is_shards

    data = PROCEDURAL if setup.data is None else str(setup.data)
    if is_shards(data):
        raise ValueError(f"{data}: expected a folder of meshes or splat assets, these are shards")
    recipe = SampleRecipe(
        KIND_WEIGHTS,
        size=setup.size,
        rows=setup.rows,
        surfels=max(MIN_SURFELS, SURFELS_PER_GAUSSIAN * setup.rows),
        base_views=setup.base_views,
        novel_views=setup.novel_views,
        steps_per_object=1,
    )
    names = () if setup.names is None else HeldOut.of_file(setup.names).names
    return DataSettings(data, recipe, setup.seed, HELD_OUT_SHARE, resources, memory=256 << 20, names=names)


@lru_cache(maxsize=2)
def _stream(setup: Setup, files: bool = True) -> SampleStream:
    """Samples of objects that training never sees, unless the setup takes any. files: with lights, stickers, fonts and
    photos, which take time to read. Raises ValueError where no object is held out."""
    from splattrain.training_data import ResourceFolders

    resources = (
        ResourceFolders(setup.environments, setup.decals, setup.fonts, setup.textures) if files else ResourceFolders()
    )
    settings = _data_settings(setup, resources)
    stream = settings.stream(validation=setup.held_out)
    if stream is None:
        raise ValueError(
            f"{settings.data}: none of its objects is held out of training (a share of {HELD_OUT_SHARE:g}); add some"
        )
    return stream


def _of_kind(stream: SampleStream, kind: str) -> SampleStream:
    """Samples of one kind, with the numbers, objects and choices of `train.judge.judged_samples`."""
    from splattrain.judge import MANY_VIEWS

    of_kind = copy(stream)
    of_kind.kinds = {kind: 1.0}
    if kind == MANY_VIEWS:
        of_kind.recipe = replace(stream.recipe, views=(0.0,) * (RELIT_VIEWS - 1) + (1.0,))
    return of_kind


def _pictures(views: PosedViews) -> PosedImages:
    import torch

    return PosedImages(views.cameras, torch.as_tensor(views.colors).cpu().numpy().astype(np.float32))


def _target(case: Case) -> tuple[list[int], PictureTarget]:
    """(indices of the novel views that count, what they should show), as train/stages/refine.py judges."""
    import torch

    from splatpainter.rendering import render
    from splattrain.loss import global_target, local_target

    local = case.steps[-1].mode == "local"
    views = np.flatnonzero(case.near) if local and case.near.any() else np.arange(len(case.after))
    asset = render(case.asset, [case.after.cameras[k] for k in views])
    after, before, now, alpha = (
        torch.from_numpy(np.ascontiguousarray(x, np.float32))
        for x in (case.after.colors[views], case.before.colors[views], asset.colors, asset.alphas[..., 0])
    )
    if local:
        return views.tolist(), local_target(after, before, now, UNEDITED_WEIGHT)
    return views.tolist(), global_target(after, alpha > MIN_ASSET_ALPHA)
