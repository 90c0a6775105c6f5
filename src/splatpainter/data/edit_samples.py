"""One edit of one stage, of each kind: what the edited views show, their masks, and the truth from new sides.

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
from splatpainter.data import edit_types as kinds
from splatpainter.data import edits, viewpoints
from splatpainter.data.edit_types import Canvas, Stock
from splatpainter.data.edits import Coat
from splatpainter.data.lights import Light, shade
from splatpainter.data.lit_scenes import Shots, Stage, Views, recolored, shoot
from splatpainter.data.recipes import SampleRecipe
from splatpainter.sources.looks import random_look
from splatpainter.splats import Splats

COVERED = 0.18
"""Least part of a close-up that the object fills."""
SMALLEST, LARGEST = 0.004, 0.5
"""Part of the first edited view that an edit changes."""
SHOWN = 0.002
"""Least part of another view that counts as showing the edit."""
ON_OBJECT = 0.6
"""Least part of a layer that lies on the object."""
DIFFERENT = 0.02
"""Least mean difference, per channel over the object, of a global edit or a zoom."""


@dataclass(frozen=True)
class Plan:
    """What a take is to be like."""

    recipe: SampleRecipe
    views: int = 1
    """Edited views."""
    strict: float = 1.0
    """Times COVERED and ON_OBJECT: thin objects need patience first and lower standards then."""


@dataclass(frozen=True)
class Take:
    """See samples.Sample for the fields."""

    edited: Views
    masks: np.ndarray = field(repr=False)
    before: Views
    after: Views
    near: np.ndarray


def paint(stage: Stage, kind: str, plan: Plan, stock: Stock, rng: np.random.Generator) -> Take | None:
    """A stroke, text, sticker, photo, noise or recolouring in one close-up; further views show the same edit from near
    by."""
    found = _spot(stage, plan, rng)
    if found is None:
        return None
    spot, camera, shot = found
    coat = _coat(stage, stage.truth, kind, spot, camera, shot, plan, stock, rng)
    if coat is None:
        return None
    after = recolored(stage.truth, edits.painted(stage.truth.sh, coat))
    target = _target(stage, spot)
    cameras = [camera, *(viewpoints.neighbour(camera, target, rng, (8, 30)) for _ in range(plan.views - 1))]
    edited = shoot(after, cameras).views
    before = shot.views.colors if len(cameras) == 1 else shoot(stage.truth, cameras).views.colors
    masks = edits.change_masks(before, edited.colors, close=camera.width // 40 if kind == "noise" else 0)
    parts = masks.float().mean((1, 2)).tolist()
    if not SMALLEST <= parts[0] <= LARGEST:
        return None
    shown = [k for k, part in enumerate(parts) if k == 0 or part >= SHOWN]
    edited = Views(tuple(cameras[k] for k in shown), edited.colors[shown])
    return _local_take(stage, stage.truth, after, edited, masks[shown], target, plan, rng)


def conflict(stage: Stage, plan: Plan, stock: Stock, rng: np.random.Generator) -> Take | None:
    """Two views, one after the other, paint over one region; each picture shows the object as it was then, each mask
    what that picture changed. The truth is the object after the second."""
    found = _spot(stage, plan, rng)
    if found is None:
        return None
    spot, camera, shot = found
    target = _target(stage, spot)
    first_kind, second_kind = rng.choice(["stroke", "text", "sticker", "photo"], 2)
    first = _coat(stage, stage.truth, first_kind, spot, camera, shot, plan, stock, rng)
    if first is None:
        return None
    between = recolored(stage.truth, edits.painted(stage.truth.sh, first))
    other = viewpoints.neighbour(camera, target, rng, (5, 30))
    seen_there = shoot(between, [other])
    second = _coat(stage, between, second_kind, spot, other, seen_there, plan, stock, rng)
    if second is None:
        return None
    both = float((first.coverage * second.coverage).sum())
    if both < 0.2 * min(float(first.coverage.sum()), float(second.coverage.sum())):
        return None
    after = recolored(between, edits.painted(between.sh, second))
    colors = torch.cat([shoot(between, [camera]).views.colors, shoot(after, [other]).views.colors])
    masks = edits.change_masks(torch.cat([shot.views.colors, seen_there.views.colors]), colors)
    parts = masks.float().mean((1, 2))
    if float(parts.min()) < SMALLEST or float(parts.max()) > LARGEST:
        return None
    return _local_take(stage, stage.truth, after, Views((camera, other), colors), masks, target, plan, rng)


def zoom(stage: Stage, plan: Plan, rng: np.random.Generator) -> Take | None:
    """Tiles of a large picture with the true detail; before is the asset, after is the truth."""
    cameras: list[Camera] = []
    spots = []
    for _ in range(plan.views):
        spot = _choice(stage, rng)
        normal = stage.subject.surfels.normals[spot].cpu().numpy().astype(np.float64)
        whole = viewpoints.around(stage.subject.radius, stage.optics, *viewpoints.sight(normal, rng))
        cameras.append(viewpoints.crop(whole, _target(stage, spot), rng.uniform(*plan.recipe.zoom)))
        spots.append(spot)
    shots, coarse = shoot(stage.truth, cameras), shoot(stage.coarse, cameras)
    masks = shots.alphas > 0.5
    kept = [
        k
        for k in range(len(cameras))
        if float(masks[k].float().mean()) > COVERED * plan.strict
        and _difference(shots.views.colors[k], coarse.views.colors[k], masks[k]) > DIFFERENT / 2
    ]
    if not kept:
        return None
    edited = Views(tuple(cameras[k] for k in kept), shots.views.colors[kept])
    centers = [(cameras[k], _target(stage, spots[k])) for k in kept]
    novel, near = _novel(stage, centers, plan, rng)
    before, after = shoot(stage.coarse, novel).views, shoot(stage.truth, novel).views
    return Take(edited, masks[kept].cpu().numpy(), before, after, near)


def relight(stage: Stage, light: Light, plan: Plan, rng: np.random.Generator) -> Take | None:
    """The whole object under another light."""
    sh = shade(stage.subject.surfels, light, plan.recipe.sh_degree)
    return _global_take(stage, recolored(stage.truth, sh), plan, rng)


def regrade(stage: Stage, plan: Plan, rng: np.random.Generator) -> Take | None:
    """The whole object with another look."""
    return _global_take(stage, recolored(stage.truth, edits.regraded(stage.truth.sh, random_look(rng))), plan, rng)


def plain(stage: Stage, plan: Plan, rng: np.random.Generator) -> Take:
    """No edit: novel views of the object as it is."""
    cameras = viewpoints.ring(stage.subject.radius, stage.optics, plan.recipe.novel_views, rng)
    views = shoot(stage.truth, cameras).views
    size = stage.optics.size
    nothing = Views((), views.colors.new_zeros(0, size, size, 3))
    return Take(nothing, np.zeros((0, size, size), bool), views, views, np.zeros(len(cameras), bool))


def _coat(
    stage: Stage,
    splats: Splats,
    kind: str,
    spot: int,
    camera: Camera,
    shot: Shots,
    plan: Plan,
    stock: Stock,
    rng: np.random.Generator,
) -> Coat | None:
    """An edit of a kind around row `spot`, designed on the picture `shot` of `splats` from `camera`; None when too much
    of it would lie beside the object."""
    surfels = stage.subject.surfels
    extent = camera.width * rng.uniform(*np.sqrt(plan.recipe.share))
    if kind == "recolor":
        z = float(np.linalg.norm(camera.position - _target(stage, spot)))
        coat = kinds.recoloring(edits.base_colors(splats.sh), surfels.means, spot, 0.8 * extent * z / camera.fy, rng)
        return _shown(stage, coat, camera, shot)
    x, y, z = camera.world_to_camera[:3, :3] @ _target(stage, spot) + camera.world_to_camera[:3, 3]
    place = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    place = place + rng.normal(0, 0.04, 2) * camera.width
    canvas = Canvas(shot.views.colors[0].cpu().numpy(), (float(place[0]), float(place[1])), extent)
    layer = torch.from_numpy(kinds.PAINTED[kind](canvas, stock, rng)).to(splats.sh.device)
    on_object = (layer[..., 3] * shot.alphas[0]).sum()
    if float(on_object) < plan.strict * ON_OBJECT * float(layer[..., 3].sum()):
        return None
    colors, coverage = edits.carried(layer, camera, surfels.means)
    if kind != "noise" and stage.subject.sh is None and rng.random() < plan.recipe.lit_paint:
        colors = edits.lit(colors, stage.truth.sh, surfels.albedo)
    return _shown(stage, Coat(colors, coverage), camera, shot)


def _shown(stage: Stage, coat: Coat, camera: Camera, shot: Shots) -> Coat:
    """The coat on those rows only that the view shows."""
    surfels = stage.subject.surfels
    rows = (coat.coverage >= edits.LEAST).nonzero()[:, 0]
    normals = None if stage.subject.two_sided else surfels.normals[rows]
    seen = edits.seen(surfels.means[rows], normals, camera, shot.depths[0], shot.alphas[0])
    coverage = torch.zeros_like(coat.coverage)
    coverage[rows] = coat.coverage[rows] * seen
    return Coat(coat.colors, coverage)


def _spot(stage: Stage, plan: Plan, rng: np.random.Generator) -> tuple[int, Camera, Shots] | None:
    """A row, a close-up that shows it, and its picture; None when the row is hidden or the view too empty."""
    spot = _choice(stage, rng)
    target, surfels = _target(stage, spot), stage.subject.surfels
    normal = surfels.normals[spot].cpu().numpy().astype(np.float64)
    if stage.subject.two_sided and normal @ target < 0:
        normal = -normal
    window = stage.subject.radius * rng.uniform(*plan.recipe.window)
    camera = viewpoints.facing(target, normal, window, stage.optics, rng)
    shot = shoot(stage.truth, [camera])
    if float((shot.alphas > 0.5).float().mean()) < COVERED * plan.strict:
        return None
    part = slice(spot, spot + 1)
    normals = None if stage.subject.two_sided else surfels.normals[part]
    shown = edits.seen(surfels.means[part], normals, camera, shot.depths[0], shot.alphas[0])
    return (spot, camera, shot) if float(shown) > 0.5 else None


def _choice(stage: Stage, rng: np.random.Generator) -> int:
    """A row out in the open: the most open of three."""
    rows = rng.integers(0, len(stage.truth), 3)
    openness = stage.subject.surfels.occlusion[torch.from_numpy(rows).to(stage.truth.sh.device)]
    return int(rows[int(openness.argmax())])


def _target(stage: Stage, spot: int) -> np.ndarray:
    return stage.subject.surfels.means[spot].cpu().numpy().astype(np.float64)


def _local_take(
    stage: Stage,
    before: Splats,
    after: Splats,
    edited: Views,
    masks: Tensor,
    target: np.ndarray,
    plan: Plan,
    rng: np.random.Generator,
) -> Take | None:
    cameras, near = _novel(stage, [(edited.cameras[-1], target)], plan, rng)
    old, new = shoot(before, cameras).views, shoot(after, cameras).views
    if near.any():
        parts = edits.change_masks(old.colors[: near.sum()], new.colors[: near.sum()]).float().mean((1, 2))
        if float(parts.max()) < SHOWN:
            return None
    return Take(edited, masks.cpu().numpy(), old, new, near)


def _global_take(stage: Stage, after: Splats, plan: Plan, rng: np.random.Generator) -> Take | None:
    cameras = viewpoints.ring(stage.subject.radius, stage.optics, plan.views, rng)
    shots, old = shoot(after, cameras), shoot(stage.truth, cameras)
    masks = shots.alphas > 0.5
    if _difference(shots.views.colors, old.views.colors, masks) < DIFFERENT:
        return None
    centers = [(camera, np.zeros(3)) for camera in cameras]
    novel, near = _novel(stage, centers, plan, rng)
    before, new = shoot(stage.truth, novel).views, shoot(after, novel).views
    return Take(shots.views, masks.cpu().numpy(), before, new, near)


def _novel(
    stage: Stage, centers: Sequence[tuple[Camera, np.ndarray]], plan: Plan, rng: np.random.Generator
) -> tuple[list[Camera], np.ndarray]:
    """(cameras, near [W] bool): the first half beside the edited views in turn, the others around the object."""
    close = (plan.recipe.novel_views + 1) // 2
    cameras = [viewpoints.neighbour(*centers[k % len(centers)], rng) for k in range(close)]
    cameras += viewpoints.ring(stage.subject.radius, stage.optics, plan.recipe.novel_views - close, rng)
    return cameras, np.arange(plan.recipe.novel_views) < close


def _difference(one: Tensor, other: Tensor, mask: Tensor) -> float:
    """Mean absolute difference inside a mask, per channel; 0 where it is empty."""
    inside = mask[..., None].to(one.dtype)
    return float(((one - other).abs() * inside).sum() / (3 * inside.sum()).clamp(min=1))
