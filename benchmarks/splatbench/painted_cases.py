"""What `bench painted` asks: an object that training never saw, as an asset; one close-up of it with a stroke, a word
and a sticker; and how the painted surface really looks from near by.

Paint is put on dense surfels, as in training samples (data/edits), so every novel view has a truth. The asset is a
coarse one of the training data (irregular Gaussians with faint layers above and below the surface), or one that 3DGS
fitted to views of the truth. Cases take seconds, fitted ones minutes; they are kept in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatbench.cases import Case, CaseKey, CaseStore, EditStep, PosedImages, Setup, safe
from splatbench.edit_design import (
    BLOCKED_SLACK,
    DESIGN_TRIES,
    is_visible,
    resources,
    strictness,
    surface_point,
    view_of,
    views_beside,
)
from splatbench.ground_truth import GroundTruth, GroundTruthViews, build_asset, changed
from splatbench.objects import drawn_lights, environments, generator, objects
from splatpainter.cameras import Camera
from splatpainter.pictures.drawing import stack_layers
from splatpainter.system import user_folders
from splattrain.data.edits import EditDesign, layer_on_object
from splattrain.data.edits.content import Canvas, EditResources
from splattrain.data.edits.surface_points import SurfacePoint

VERSION = 2
"""Version of how cases are made: those of another one are made anew."""
AssetKind = Literal["coarse", "fitted"]
SOURCES: dict[AssetKind, Literal["surfels", "fitted"]] = {"coarse": "surfels", "fitted": "fitted"}
"""What ground_truth.build_asset calls them."""
LAYERS = ("stroke", "text", "sticker")
"""Layers of every painted view, lowest first."""
LAYER_SHARE = (0.07, 0.18)
"""Part of the object in view that each layer covers: from, to."""
MIN_FILLED = 0.25
"""Part of the edited view that the object fills."""
NOVEL_DEGREES = (15.0, 40.0)
"""Degrees between the edited view and the novel ones: from, to (those of training samples)."""


def cases(setup: Setup, kind: AssetKind, report: Callable[[str], None] | None = None) -> Iterator[Case]:
    """The setup's cases in the order of its objects, from the cache where it has them. Objects that cannot be painted
    are left out, with a line to `report`. Raises ValueError for data that cannot be read."""
    names, lights = objects(setup).names, environments(setup).names
    for name in names:
        settings = {"version": VERSION, "assets": kind, "light": drawn_lights(lights, name, 1, setup.seed)[0]}
        key = CaseKey(f"{safe(name)}-{_digest(setup, settings)}", name, settings)
        store = CaseStore(cache_folder(), f"painted-{kind}")
        if not store.has(key, setup):
            try:
                case = make_case(key, setup)
            except ValueError as error:
                if report:
                    report(f"{name}: left out, {error}")
                continue
            case.save(store.case_folder(key.label))
            store.save(case, store.stamp(key, setup), {"result": case.steps[0].edited.colors[0]})
        yield store.load(key.label)


def cache_folder() -> Path:
    """Where cases are kept; may be deleted at any time."""
    return user_folders.cache_folder() / "bench"


def _digest(setup: Setup, settings: dict[str, Any]) -> str:
    """8 hex digits of sizes, steps and seed, so that cases of several setups lie side by side."""
    values = asdict(replace(setup, objects=0)) | settings
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:8]


def make_case(key: CaseKey, setup: Setup) -> Case:
    """One object, painted. Raises ValueError where its mesh cannot be read, or no paint on it can be seen."""
    truth = GroundTruth.load(key.name, key.settings["light"], setup)
    rng = generator(setup.seed, "painted", key.name)
    base = truth.render(truth.ring(setup.base_views, rng), "base")
    painted, camera, point = paint(truth, base, resources(setup), rng)
    novel = views_beside(truth, camera, point.position, setup.novel_views, NOVEL_DEGREES, rng)
    before, after = (t.render([camera, *novel], "novel") for t in (truth, painted))
    masks = changed(before, after)
    asset = build_asset(truth, base, SOURCES[key.settings["assets"]])
    rest = range(1, 1 + len(novel))
    edited = PosedImages((camera,), after.images.colors[:1])
    return Case(
        protocol="painted",
        name=key.name,
        label=key.label,
        asset=asset.splats,
        base=base.images,
        steps=(EditStep("local", "paint", edited, masks[:1]),),
        before=before.take(rest).images,
        after=after.take(rest).images,
        near=np.ones(len(novel), bool),
        setup_seconds=asset.seconds,
        facts={"asset": asset.method, "light": truth.light.name},
    )


def paint(
    truth: GroundTruth, base: GroundTruthViews, files: EditResources, rng: np.random.Generator
) -> tuple[GroundTruth, Camera, SurfacePoint]:
    """(the painted object, the view in which it was painted, the surface point in its middle). base: views in which
    points are looked for. Raises ValueError after DESIGN_TRIES choices of which nothing could be seen."""
    for attempt in range(DESIGN_TRIES):
        point = surface_point(base, rng)
        camera = view_of(point, "close-up", truth.radius, truth.optics, rng)
        if truth.blocks(camera.position, point.position, BLOCKED_SLACK):
            continue
        before = truth.render([camera], "design")
        layer = paint_layer(before, camera, point, files, rng, strictness(attempt))
        if layer is None:
            continue
        painted = truth.paint(EditDesign("paint", camera, layer))
        after = painted.render([camera], "design")
        mask = changed(before, after)[0]
        if is_visible(before.images.colors[0], after.images.colors[0], mask, strictness(attempt)):
            return painted, camera, point
    raise ValueError(f"{DESIGN_TRIES} choices of paint on it could not be seen")


def paint_layer(
    view: GroundTruthViews,
    camera: Camera,
    point: SurfacePoint,
    files: EditResources,
    rng: np.random.Generator,
    strict: float = 1.0,
) -> np.ndarray | None:
    """[H, W, 4] a stroke, a word and a sticker around a point of the view's picture; None where the object fills too
    little of it, or too much of one would lie beside the object. strict: times MIN_FILLED and the share that has to lie
    on the object."""
    if view.masks[0].mean() < strict * MIN_FILLED:
        return None
    pixels, _ = camera.project(point.position[None])
    filled = float(view.masks[0].sum())
    turn = rng.uniform(0, 2 * np.pi)
    out = None
    for k, kind in enumerate(LAYERS):
        extent = float(np.sqrt(rng.uniform(*LAYER_SHARE) * filled))
        if extent < 2:
            return None
        angle = turn + 2 * np.pi * k / len(LAYERS)
        x, y = pixels[0] + 0.7 * extent * np.array([np.cos(angle), np.sin(angle)])
        canvas = Canvas(view.images.colors[0], (float(x), float(y)), extent)
        layer = layer_on_object(kind, canvas, view.alphas[0], files, rng, strict)
        if layer is None:
            return None
        out = layer if out is None else stack_layers(out, layer)
    return out
