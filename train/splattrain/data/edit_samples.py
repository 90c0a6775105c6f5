"""One edit of a lit scene, of each kind: what the edited views show, their masks, and the truth from new sides.

Every function returns None when the choice made no edit worth learning from (nothing visible, too small, too large);
the caller tries again with other random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.grading.color_grading import random_grade
from splatpainter.splats import Splats
from splattrain.data import viewpoints
from splattrain.data.edits import (
    MAX_EDIT_FRACTION,
    MIN_EDIT_FRACTION,
    EditDesign,
    change_masks,
    layer_on_object,
)
from splattrain.data.edits.content import Canvas, EditResources, PaintCoverage, Recoloring
from splattrain.data.edits.on_surfels import apply_paint, grade_sh, paint_coverage, view_visibility
from splattrain.data.lights import Light, shade
from splattrain.data.lit_scenes import LitScene, PosedViews, Renders, recolored, render_views
from splattrain.data.sample_recipes import SampleRecipe

MIN_FILLED = 0.18
"""Part of a close-up that the object fills."""
MIN_FURTHER_FRACTION = 0.002
"""Part of another view that an edit changes, to count as shown there."""
MIN_DIFFERENCE = 0.02
"""Mean difference, per channel over the object, of a global edit or a zoom."""


@dataclass(frozen=True)
class SampleSpec:
    """What an edit sample is to be like."""

    recipe: SampleRecipe
    views: int = 1
    """Edited views."""
    strictness: float = 1.0
    """Times MIN_FILLED and MIN_ON_OBJECT: thin objects need patience first and lower standards then."""


@dataclass(frozen=True)
class EditSample:
    """See samples.Sample for the fields."""

    edited: PosedViews
    masks: np.ndarray = field(repr=False)
    before: PosedViews
    after: PosedViews
    near: np.ndarray
    truth: Splats[Tensor] = field(repr=False)
    """Dense, torch: the object after the edit."""


def paint(
    scene: LitScene, kind: str, spec: SampleSpec, resources: EditResources, rng: np.random.Generator
) -> EditSample | None:
    """A stroke, text, sticker, photo, noise or recolouring in one close-up; further views show the same edit from near
    by."""
    close_up = _close_up(scene, spec, rng)
    if close_up is None:
        return None
    surfel, camera, render = close_up
    coverage = _painted(scene, scene.truth, kind, surfel, camera, render, spec, resources, rng)
    if coverage is None:
        return None
    after = recolored(scene.truth, apply_paint(scene.truth.sh, coverage))
    target = _position(scene, surfel)
    cameras = [camera, *(viewpoints.neighbour(camera, target, rng, (8, 30)) for _ in range(spec.views - 1))]
    edited = render_views(after, cameras).views
    before = render.views.colors if len(cameras) == 1 else render_views(scene.truth, cameras).views.colors
    masks = change_masks(before, edited.colors, close_px=camera.width // 40 if kind == "noise" else 0)
    parts = masks.float().mean((1, 2)).tolist()
    if not MIN_EDIT_FRACTION <= parts[0] <= MAX_EDIT_FRACTION:
        return None
    ids = [k for k, part in enumerate(parts) if k == 0 or part >= MIN_FURTHER_FRACTION]
    edited = PosedViews(tuple(cameras[k] for k in ids), edited.colors[ids])
    return _local_sample(scene, scene.truth, after, edited, masks[ids], target, spec, rng)


def conflict(
    scene: LitScene, spec: SampleSpec, resources: EditResources, rng: np.random.Generator
) -> EditSample | None:
    """Two views, one after the other, paint over one region; each picture shows the object as it was then, each mask
    what that picture changed. The truth is the object after the second."""
    close_up = _close_up(scene, spec, rng)
    if close_up is None:
        return None
    surfel, camera, render = close_up
    target = _position(scene, surfel)
    first_kind, second_kind = rng.choice(["stroke", "text", "sticker", "photo"], 2)
    first = _painted(scene, scene.truth, first_kind, surfel, camera, render, spec, resources, rng)
    if first is None:
        return None
    between = recolored(scene.truth, apply_paint(scene.truth.sh, first))
    other = viewpoints.neighbour(camera, target, rng, (5, 30))
    unpainted = render_views(between, [other])
    second = _painted(scene, between, second_kind, surfel, other, unpainted, spec, resources, rng)
    if second is None:
        return None
    both = float((first.coverage * second.coverage).sum())
    if both < 0.2 * min(float(first.coverage.sum()), float(second.coverage.sum())):
        return None
    after = recolored(between, apply_paint(between.sh, second))
    colors = torch.cat([render_views(between, [camera]).views.colors, render_views(after, [other]).views.colors])
    masks = change_masks(torch.cat([render.views.colors, unpainted.views.colors]), colors)
    parts = masks.float().mean((1, 2))
    if float(parts.min()) < MIN_EDIT_FRACTION or float(parts.max()) > MAX_EDIT_FRACTION:
        return None
    return _local_sample(scene, scene.truth, after, PosedViews((camera, other), colors), masks, target, spec, rng)


def zoom(scene: LitScene, spec: SampleSpec, rng: np.random.Generator) -> EditSample | None:
    """Tiles of a large picture with the true detail; before is the asset, after is the truth."""
    cameras: list[Camera] = []
    targets = []
    for _ in range(spec.views):
        surfel = _open_surfel(scene, rng)
        normal = scene.object.surfels.normals[surfel].cpu().numpy().astype(np.float64)
        overview = viewpoints.object_camera(scene.object.radius, scene.optics, *viewpoints.view_angles(normal, rng))
        targets.append(_position(scene, surfel))
        cameras.append(viewpoints.crop(overview, targets[-1], rng.uniform(*spec.recipe.zoom)))
    renders, coarse = render_views(scene.truth, cameras), render_views(scene.coarse, cameras)
    masks = renders.alphas > 0.5
    ids = [
        k
        for k in range(len(cameras))
        if float(masks[k].float().mean()) > MIN_FILLED * spec.strictness
        and _difference(renders.views.colors[k], coarse.views.colors[k], masks[k]) > MIN_DIFFERENCE / 2
    ]
    if not ids:
        return None
    edited = PosedViews(tuple(cameras[k] for k in ids), renders.views.colors[ids])
    centers = [(cameras[k], targets[k]) for k in ids]
    novel, near = _novel(scene, centers, spec, rng)
    before, after = render_views(scene.coarse, novel).views, render_views(scene.truth, novel).views
    return EditSample(edited, masks[ids].cpu().numpy(), before, after, near, scene.truth)


def relight(scene: LitScene, light: Light, spec: SampleSpec, rng: np.random.Generator) -> EditSample | None:
    """The whole object under another light."""
    sh = shade(scene.object.surfels, light, spec.recipe.sh_degree)
    return _global_sample(scene, recolored(scene.truth, sh), spec, rng)


def regrade(scene: LitScene, spec: SampleSpec, rng: np.random.Generator) -> EditSample | None:
    """The whole object with another look."""
    return _global_sample(scene, recolored(scene.truth, grade_sh(scene.truth.sh, random_grade(rng))), spec, rng)


def plain(scene: LitScene, spec: SampleSpec, rng: np.random.Generator) -> EditSample:
    """No edit: novel views of the object as it is."""
    cameras = viewpoints.ring(scene.object.radius, scene.optics, spec.recipe.novel_views, rng)
    views = render_views(scene.truth, cameras).views
    size = scene.optics.size
    no_views = PosedViews((), views.colors.new_zeros(0, size, size, 3))
    near = np.zeros(len(cameras), bool)
    return EditSample(no_views, np.zeros((0, size, size), bool), views, views, near, scene.truth)


def _painted(
    scene: LitScene,
    splats: Splats[Tensor],
    kind: str,
    surfel: int,
    camera: Camera,
    render: Renders,
    spec: SampleSpec,
    resources: EditResources,
    rng: np.random.Generator,
) -> PaintCoverage | None:
    """What an edit of a kind around a surfel puts on all of them, designed on the picture `render` of `splats` from
    `camera`; None when too much of it would lie beside the object."""
    item, target = scene.object, _position(scene, surfel)
    extent = camera.width * rng.uniform(*np.sqrt(spec.recipe.share))
    (center,), (depth,) = camera.project(target[None])
    unpainted = None
    if kind == "recolor":
        content = Recoloring(target, 0.8 * extent * depth / camera.fy, rng)
    else:
        x, y = center + rng.normal(0, 0.04, 2) * camera.width
        canvas = Canvas(render.views.colors[0].cpu().numpy(), (float(x), float(y)), extent)
        alpha = render.alphas[0].cpu().numpy()
        content = layer_on_object(kind, canvas, alpha, resources, rng, spec.strictness)
        if content is None:
            return None
        if kind != "noise" and item.sh is None and rng.random() < spec.recipe.lit_paint:
            unpainted = scene.truth.sh
    return paint_coverage(
        EditDesign(kind, camera, content),
        item.surfels,
        splats.sh,
        render.depths[0],
        render.alphas[0],
        unpainted_sh=unpainted,
        two_sided=item.two_sided,
    )


def _close_up(scene: LitScene, spec: SampleSpec, rng: np.random.Generator) -> tuple[int, Camera, Renders] | None:
    """A surfel, a view that shows it from near by, and its picture; None when it is hidden or the view too empty."""
    surfel = _open_surfel(scene, rng)
    target, surfels, two_sided = _position(scene, surfel), scene.object.surfels, scene.object.two_sided
    normal = surfels.normals[surfel].cpu().numpy().astype(np.float64)
    if two_sided and normal @ target < 0:
        normal = -normal
    window = scene.object.radius * rng.uniform(*spec.recipe.window)
    camera = viewpoints.facing(target, normal, window, scene.optics, rng)
    render = render_views(scene.truth, [camera])
    if float((render.alphas > 0.5).float().mean()) < MIN_FILLED * spec.strictness:
        return None
    part = slice(surfel, surfel + 1)
    normals = None if two_sided else surfels.normals[part]
    visibility = view_visibility(surfels.means[part], normals, camera, render.depths[0], render.alphas[0])
    return (surfel, camera, render) if float(visibility) > 0.5 else None


def _open_surfel(scene: LitScene, rng: np.random.Generator) -> int:
    """The most open surfel of three random ones."""
    ids = rng.integers(0, len(scene.truth), 3)
    openness = scene.object.surfels.occlusion[torch.from_numpy(ids).to(scene.truth.sh.device)]
    return int(ids[int(openness.argmax())])


def _position(scene: LitScene, surfel: int) -> np.ndarray:
    """[3] float64."""
    return scene.object.surfels.means[surfel].cpu().numpy().astype(np.float64)


def _local_sample(
    scene: LitScene,
    before: Splats[Tensor],
    after: Splats[Tensor],
    edited: PosedViews,
    masks: Tensor,
    target: np.ndarray,
    spec: SampleSpec,
    rng: np.random.Generator,
) -> EditSample | None:
    cameras, near = _novel(scene, [(edited.cameras[-1], target)], spec, rng)
    old, new = render_views(before, cameras).views, render_views(after, cameras).views
    if near.any():
        parts = change_masks(old.colors[: near.sum()], new.colors[: near.sum()]).float().mean((1, 2))
        if float(parts.max()) < MIN_FURTHER_FRACTION:
            return None
    return EditSample(edited, masks.cpu().numpy(), old, new, near, after)


def _global_sample(
    scene: LitScene, after: Splats[Tensor], spec: SampleSpec, rng: np.random.Generator
) -> EditSample | None:
    cameras = viewpoints.ring(scene.object.radius, scene.optics, spec.views, rng)
    renders, old = render_views(after, cameras), render_views(scene.truth, cameras)
    masks = renders.alphas > 0.5
    if _difference(renders.views.colors, old.views.colors, masks) < MIN_DIFFERENCE:
        return None
    centers = [(camera, np.zeros(3)) for camera in cameras]
    novel, near = _novel(scene, centers, spec, rng)
    before, new = render_views(scene.truth, novel).views, render_views(after, novel).views
    return EditSample(renders.views, masks.cpu().numpy(), before, new, near, after)


def _novel(
    scene: LitScene, centers: Sequence[tuple[Camera, np.ndarray]], spec: SampleSpec, rng: np.random.Generator
) -> tuple[list[Camera], np.ndarray]:
    """(cameras, near [W] bool): the first half beside the edited views in turn, the others around the object."""
    close = (spec.recipe.novel_views + 1) // 2
    cameras = [viewpoints.neighbour(*centers[k % len(centers)], rng) for k in range(close)]
    cameras += viewpoints.ring(scene.object.radius, scene.optics, spec.recipe.novel_views - close, rng)
    return cameras, np.arange(spec.recipe.novel_views) < close


def _difference(one: Tensor, other: Tensor, mask: Tensor) -> float:
    """Mean absolute difference inside a mask, per channel; 0 where it is empty."""
    inside = mask[..., None].to(one.dtype)
    return float(((one - other).abs() * inside).sum() / (3 * inside.sum()).clamp(min=1))
