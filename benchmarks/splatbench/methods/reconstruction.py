"""Reconstruction models alone: a new asset from pictures, by the Gaussian LRM with or without Stage I after it.

    lrm                   one pass over base and edited views: the paper's GS-LRM row
    stage-1               LRM and Stage I of a `copy` model on all views: the paper's "Ours (stage I)"
    stage1-voxel-att      Tab. 4, nothing edited: Stage I by the mean token of each voxel (the paper's VoxelAtt)
    stage1-latent-query   by attention inside voxels, learned queries
    stage1-feats-query    the same, the codes of the Gaussians kept as queries: the paper's, and ours
    stage1-before         before compression: the LRM's Gaussians

Rows of Tab. 4 reconstruct from what their LRM was trained on: the asset's canonical views with geometry where the LRM
sees that, else the base views. So all rows with one LRM differ by Stage I alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Budget, PosedImages
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.weights import COMPACT, LATENTS, Weights
from splatpainter.models.config import Grouping, LrmConfig, ModelConfig
from splatpainter.nn.precision import autocast
from splatpainter.splats import ATTRIBUTES

if TYPE_CHECKING:
    import torch

    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import Copy, SplatPainterModel
    from splatpainter.splats import Splats

MAX_UPSCALE = 2
"""Pictures for the LRM: at most this many times the size of those that it was trained on. Twice is measured to be
better than once: 21.1 instead of 18.4 dB near a close-up."""
GROUPINGS: dict[str, tuple[Grouping, str]] = {
    "voxel-att": ("voxel_mean", "VoxelAtt"),
    "latent-query": ("latent_query", "LocalAtt + latent query"),
    "feats-query": ("feats_query", "LocalAtt + feats query (ours)"),
}
"""Name of the weights -> (compress.grouping, label in the paper's words)."""


def sized(images: PosedImages, config: LrmConfig) -> PosedImages:
    """The pictures at a size that the LRM takes: whole patches, at most MAX_UPSCALE times what it was trained at
    (pixels are averaged; larger ones would take minutes). Those that fit stay as they are."""
    import torch
    from torch.nn.functional import interpolate

    height, width = images.colors.shape[1:3]
    scale = min(1.0, MAX_UPSCALE * config.image_size / max(height, width))
    high, wide = (max(int(edge * scale) // config.patch, 1) * config.patch for edge in (height, width))
    if (high, wide) == (height, width):
        return images
    colors = torch.from_numpy(np.ascontiguousarray(images.colors, np.float32)).permute(0, 3, 1, 2)
    small = interpolate(colors, size=(high, wide), mode="area").permute(0, 2, 3, 1)
    return PosedImages(tuple(camera.resized(wide, high) for camera in images.cameras), small.contiguous().numpy())


def all_views(model: SplatPainterModel, task: EditTask, edited: PosedImages) -> AssetViews:
    """Base views, evenly fewer where all would be more than the LRM takes, then the edited ones. With geometry, depth
    and alpha are rendered from the asset, and pictures put before black, as in training. Raises ValueError for
    pictures of several sizes."""
    import torch

    from splatpainter.models.lrm import MAX_VIEWS, AssetViews
    from splatpainter.rendering import render
    from splatpainter.voxels.grid import bounding_cube

    if len(edited) > MAX_VIEWS:
        raise ValueError(f"lrm: expected at most {MAX_VIEWS} edited views in all, got {len(edited)}")
    count = min(MAX_VIEWS - len(edited), len(task.base))
    base = task.base.take(np.arange(count) * len(task.base) // max(count, 1))
    images = sized(joined(base, edited), model.config.lrm)
    cameras, colors = images.cameras, images.colors.astype(np.float32)
    min_corner, extent = bounding_cube(task.asset)
    device = next(model.parameters()).device
    geometry: dict[str, torch.Tensor] = {}
    if model.config.lrm.geometry:
        rendered = render(task.asset, list(cameras))
        background = np.array([camera.background for camera in cameras], np.float32)[:, None, None]
        colors = np.clip(colors - (1 - rendered.alphas) * background, 0, 1)
        for name, values in (("depth", rendered.depths), ("alpha", rendered.alphas)):
            geometry[name] = torch.as_tensor(values, dtype=torch.float32).to(device)
    center, half = min_corner + extent / 2, extent / 2
    return AssetViews(cameras, torch.from_numpy(colors).to(device), **geometry, center=center, half_extent=half)


def dense(model: SplatPainterModel, views: AssetViews) -> Copy:
    """`model.copied_gaussians` for views of several focal lengths: one pass of the transformer over all of them, but
    the Gaussians of each view get sizes of that view's own pixels (a close-up's are smaller). Raises ValueError as
    copied_gaussians."""
    import torch

    from splatpainter.models.gaussian_groups import TokenLinks
    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import Copy

    tokens = model.lrm.encode(views)
    parts = []
    for k, part in enumerate(tokens.chunk(len(views.cameras))):
        one = slice(k, k + 1)
        geometry = {name: x[one] for name in ("depth", "alpha") if (x := getattr(views, name)) is not None}
        cube = {"center": views.center, "half_extent": views.half_extent}
        view = AssetViews([views.cameras[k]], views.colors[one], **geometry, **cube)
        parts.append(model.lrm.decode(part, view))
    splats = replace(parts[0], **{name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES})
    visible = (splats.opacities > model.config.compress.min_opacity) & model.lrm.on_surface(views, splats)
    gaussian_ids = torch.nonzero(visible)[:, 0]
    if len(gaussian_ids) == 0:
        raise ValueError("encode: the model makes no visible Gaussian of the views; check that they show the asset")
    patches = (gaussian_ids // model.config.lrm.patch**2).cpu().numpy()[:, None]
    return Copy(splats.take(gaussian_ids), tokens, TokenLinks(patches, np.ones(patches.shape, np.float32)))


def compressed(model: SplatPainterModel, copy: Copy) -> tuple[Splats[torch.Tensor], dict[str, float]]:
    """(what Stage I makes of the LRM's Gaussians, numbers of Gaussians at its ends)."""
    from splatpainter.voxels.grid import voxelize

    grid = voxelize(copy.gaussians.numpy(), model.config.compress.resolution)
    latents = model.compressor(copy.tokens, copy.gaussians, copy.links, model.groups(grid))
    splats = model.decode_latents(latents, copy.gaussians)
    counts = {"gaussians_before": len(copy.gaussians), "voxels": len(grid.keys), "latents": len(latents.values)}
    return splats, {name: float(count) for name, count in counts.items()} | {"gaussians_kept": float(len(splats))}


def reconstruction(weights: Weights, *, stage_one: bool) -> Callable[[EditTask, Budget], EditResult]:
    """A row: a new asset from base and edited views (of all steps so far) in one pass, by the LRM alone or with Stage I
    after it. There is no set-up: every edit is the whole pass."""

    def edit(task: EditTask, budget: Budget) -> EditResult:
        import torch

        model = weights.load(budget)
        start = time.perf_counter()
        edited = joined(task.state, task.step.edited)
        with torch.inference_mode(), autocast(budget.device):
            views = all_views(model, task, edited)
            copy = dense(model, views)
            splats, numbers = compressed(model, copy) if stage_one else (copy.gaussians, {})
            splats = splats.numpy()
        numbers["lrm_gaussians"] = float(len(copy.gaussians))
        seconds = time.perf_counter() - start
        note = f"{len(views.cameras)} views of {views.cameras[0].width} px at once; {weights.source(budget)}"
        return EditResult(splats, 0.0, seconds, keeps_gaussians=False, numbers=numbers, note=note, state=edited)

    return edit


def joined(earlier: PosedImages | None, new: PosedImages) -> PosedImages:
    """All of them, in order. Raises ValueError for pictures of several sizes."""
    if earlier is None:
        return new
    if earlier.colors.shape[1:] != new.colors.shape[1:]:
        sizes = " and ".join(f"{images.colors.shape[2]}x{images.colors.shape[1]}" for images in (earlier, new))
        raise ValueError(f"lrm: expected views of one size, got {sizes}")
    return PosedImages.joined([earlier, new])


def training_views(model: SplatPainterModel, task: EditTask, device: torch.device) -> AssetViews:
    """What the model's LRM is given of an unedited asset, as in training. Raises ValueError for fewer base views than
    it needs."""
    import torch

    from splattrain.data.samples import PosedViews, Sample
    from splattrain.stages.lrm import input_views

    base = PosedViews(task.base.cameras, torch.from_numpy(np.ascontiguousarray(task.base.colors, np.float32)))
    none = PosedViews((), base.colors[:0])
    nothing = np.zeros(0, bool)
    sample = Sample("", "plain", "global", task.asset, base, none, nothing, none, none, nothing)
    return input_views(model, sample, device)


def unedited(weights: Weights, *, compress: bool) -> Callable[[EditTask, Budget], EditResult]:
    """A row of Tab. 4: LRM, and Stage I with compress. All of it is set-up, there is no edit."""

    def edit(task: EditTask, budget: Budget) -> EditResult:
        import torch

        from splatpainter.voxels.grid import voxelize

        model = weights.load(budget)
        start = time.perf_counter()
        with torch.inference_mode(), autocast(budget.device):
            views = training_views(model, task, torch.device(budget.device))
            if compress:
                splats, numbers = compressed(model, model.copied_gaussians(views))
            else:
                splats, numbers = dense(model, views).gaussians, {}
            splats = splats.numpy()
        seconds = time.perf_counter() - start
        if not compress:
            count, grid = float(len(splats)), voxelize(splats, model.config.compress.resolution)
            numbers = {"gaussians_before": count, "voxels": float(len(grid.keys)), "gaussians_kept": count}
        pictures = f"{len(views.cameras)} {'canonical renders' if views.alpha is not None else 'base views'}"
        note = f"from {pictures} of {views.cameras[0].width} px; {weights.source(budget)}"
        return EditResult(splats, seconds, 0.0, keeps_gaussians=False, numbers=numbers, note=note)

    return edit


def _is_copy(config: ModelConfig, grouping: Grouping | None = None) -> bool:
    return config.representation == "copy" and grouping in (None, config.compress.grouping)


def grouping_weights(name: str) -> Weights:
    """The weights of a row of GROUPINGS."""
    grouping = GROUPINGS[name][0]
    return Weights(
        (name,),
        model=f"model of representation copy with compress.grouping {grouping}",
        fits=partial(_is_copy, grouping=grouping),
        train=f"compress --model.representation copy --model.compress.grouping {grouping}",
    )


COPY = Weights(
    ("copy", "feats-query"),
    model="model of representation copy",
    fits=_is_copy,
    train="compress --model.representation copy",
)
HAS_LRM: dict[str, Any] = {
    "model": "model with an LRM",
    "fits": lambda config: config.refine.latents,
    "train": "lrm --recipe compact",
}
LRM = Weights((LATENTS, COMPACT), LATENTS, **HAS_LRM)
BEFORE = Weights((*reversed(GROUPINGS), LATENTS, COMPACT), LATENTS, **HAS_LRM)
"""Any model that has an LRM; those of the rows that it is compared with first."""


def _method(
    name: str, label: str, weights: Weights, edit: Callable[[EditTask, Budget], EditResult], table: str
) -> Method:
    return Method(name, label, edit, (table,), missing=weights.missing, version=weights.version)


def _compressing(name: str) -> Method:
    weights = grouping_weights(name)
    return _method(f"stage1-{name}", GROUPINGS[name][1], weights, unedited(weights, compress=True), "compress")


METHODS = (
    _method("lrm", "GS-LRM, all views", LRM, reconstruction(LRM, stage_one=False), "refine"),
    _method("stage-1", "Ours (Stage I)", COPY, reconstruction(COPY, stage_one=True), "refine"),
    *(_compressing(name) for name in GROUPINGS),
    _method("stage1-before", "GS-LRM, uncompressed", BEFORE, unedited(BEFORE, compress=False), "compress"),
)
