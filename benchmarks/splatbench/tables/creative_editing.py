"""Tab. 3: paint, stickers, lettering, photo patches and recolouring in one view of an asset.

As the paper: the edited region against the input edit, and all else before against after. Beyond it, for meshes: novel
views near the edit against the truth, where the paint is on the surface itself. A folder of splat assets serves too (as
in the paper); there the asset itself is the truth before the edit, and of the edit nothing is known but its picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.edit_design import (
    DESIGN_TRIES,
    KINDS,
    Framing,
    design_edit,
    draw_edit,
    invisible,
    is_visible,
    resources,
    strictness,
    surface_point,
    view_of,
    views_beside,
)
from splatbench.ground_truth import GroundTruth, GroundTruthViews, build_asset, changed, changes, optics
from splatbench.objects import drawn_lights, environments, generator, is_splat_folder, objects
from splatbench.scoring import compared, object_masks, rendered, scored
from splatbench.tables import Column, beside_truth, measures
from splatpainter.cameras import Camera
from splatpainter.splats import Splats, changed_rows
from splattrain.data import viewpoints
from splattrain.data.edits import EditDesign
from splattrain.data.edits.surface_points import SurfacePoint

if TYPE_CHECKING:
    from splatbench.methods import EditResult

FRAMINGS: tuple[Framing, ...] = ("close-up", "whole")
"""Framings of edited views, in turn."""
NEAR_DEGREES = (10.0, 35.0)
"""Degrees between the edited view and the novel views near it: from, to."""
TRUE_NEAR, TRUE_AROUND = 6, 6
"""True edited views for methods that see the truth: beside the edited view, and of the whole object."""
WIDE_DEGREES = (5.0, 45.0)
"""Degrees between the edited view and the first of these."""
MAX_EDITS_PER_OBJECT = 3
"""Edits that are shown in full before an object is given up."""
EDITED_REGION, OUTSIDE_REGION, NOVEL, GAUSSIANS = (
    "Edited region",
    "Non-edited region",
    "Novel views of the edit",
    "Gaussians",
)
MIN_CENTER_OPACITY = 0.1
"""Fainter Gaussians do not decide where a splat asset is."""


class CreativeEditing:
    """See the module; one case per object, with one edited view."""

    name = "creative"
    title = "Creative editing: painted, stickered, lettered and recoloured views (Tab. 3)"
    columns = (
        *measures(EDITED_REGION),
        *measures(OUTSIDE_REGION, "_outside"),
        *measures(NOVEL, "_novel"),
        Column("touched", "touched", GAUSSIANS, "", 0),
        Column("appended", "appended", GAUSSIANS, "", 0),
        Column("equal", "bitwise equal, %", GAUSSIANS, "higher"),
    )
    split_by = ""

    def keys(self, setup: Setup) -> list[CaseKey]:
        splats = is_splat_folder(setup.data)
        names = splat_names(setup) if splats else objects(setup).names
        lights = () if splats else environments(setup).names
        keys = []
        for k, name in enumerate(names):
            settings: dict[str, Any] = {"kind": KINDS[k % len(KINDS)], "framing": FRAMINGS[k % len(FRAMINGS)]}
            if not splats:
                settings["light"] = drawn_lights(lights, name, 1, setup.seed)[0]
            keys.append(CaseKey(f"{safe(name)}-{settings['kind']}", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        return _of_mesh(key, setup) if "light" in key.settings else _of_splats(key, setup)

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        step, last = case.steps[-1], results[-1]
        figures = scored(last.splats, step.edited, step.masks, perceptual)
        novel = changes(case.before.colors, case.after.colors)
        # What an edit may not change: views of it, and around the object where the truth says what it changed there.
        cameras = [*step.edited.cameras, *case.after.cameras]
        before = rendered(case.asset, cameras)
        outside = object_masks(PosedImages(tuple(cameras), before)) & ~np.concatenate([step.masks, novel])
        outside_figures = compared(rendered(last.splats, cameras), before, outside, perceptual) if outside.any() else {}
        near = scored(last.splats, case.after.take(case.near), novel[case.near], perceptual)
        for name in ("psnr", "ssim", "lpips"):
            figures |= {f"{name}_outside": outside_figures.get(name), f"{name}_novel": near[name]}
        return figures | changed_gaussians(case.asset, last)

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        edited = case.steps[-1].edited.take([0])
        first = rendered(results[-1].splats, edited.cameras)[0]
        view = case.most_changed_view if case.near.any() else None
        if view is None:
            return {"result": first, "truth": edited.colors[0]}
        return beside_truth(case, results, view) | {"edited view": first}


TABLE = CreativeEditing()


def changed_gaussians(asset: Splats, result: EditResult) -> dict[str, float | None]:
    """{"touched": Gaussians of the asset whose bits changed, "appended", "equal": per cent}; None for a new asset."""
    if not result.keeps_gaussians:
        return {"touched": None, "appended": None, "equal": None}
    count = len(changed_rows(asset.numpy(), result.splats.numpy()))
    share = 100 * (1 - count / len(asset))
    return {"touched": float(count), "appended": float(len(result.splats) - len(asset)), "equal": share}


def _of_mesh(key: CaseKey, setup: Setup) -> Case:
    truth = GroundTruth.load(key.name, key.settings["light"], setup)
    kind, framing = key.settings["kind"], key.settings["framing"]
    rng = generator(setup.seed, "creative", key.name)
    base = truth.render(truth.ring(setup.base_views, rng), "base")
    preview, files, near = truth.preview(), resources(setup), (setup.novel_views + 1) // 2
    for _ in range(MAX_EDITS_PER_OBJECT):
        design, point = design_edit(preview, base, kind, framing, files, rng)
        painted = truth.paint(design)
        novel = views_beside(truth, design.camera, point.position, near, NEAR_DEGREES, rng)
        novel += truth.ring(setup.novel_views - near, rng)
        before, after = (t.render([design.camera, *novel], "novel") for t in (truth, painted))
        masks = changed(before, after)[:1]
        if is_visible(before.images.colors[0], after.images.colors[0], masks[0], 0.5):
            break
    else:
        raise ValueError(f"{key.name}: {MAX_EDITS_PER_OBJECT} choices of a {kind} edit could not be seen in this light")
    rest = range(1, 1 + len(novel))
    around = views_beside(truth, design.camera, point.position, TRUE_NEAR, WIDE_DEGREES, rng)
    around += truth.ring(TRUE_AROUND, rng)
    asset = build_asset(truth, base)
    facts = {"asset": asset.method, "light": truth.light.name, "truth of the edit": "paint on the surface"}
    return Case(
        protocol="creative",
        name=key.name,
        label=key.label,
        asset=asset.splats,
        base=base.images,
        steps=(EditStep("local", kind, after.images.take([0]), masks),),
        before=before.images.take(rest),
        after=after.images.take(rest),
        near=np.arange(len(novel)) < near,
        true_views=painted.render(around, "oracle").images,
        setup_seconds=asset.seconds,
        facts={**truth.facts, **facts, **_edit_facts(key, masks)},
    )


def _of_splats(key: CaseKey, setup: Setup) -> Case:
    truth = load_splats(key.name, setup)
    rng = generator(setup.seed, "creative", key.name)
    ring = viewpoints.ring(truth.radius, optics(setup), setup.base_views, rng)
    base = truth.render([truth.placed(camera) for camera in ring])
    edit = painted_view(truth, base, key.settings["kind"], key.settings["framing"], setup, rng)
    none = PosedImages((), np.zeros((0, setup.size, setup.size, 3), np.float32))
    edited = PosedImages((edit.design.camera,), edit.picture[None])
    return Case(
        protocol="creative",
        name=key.name,
        label=key.label,
        asset=truth.splats,
        base=base.images,
        steps=(EditStep("local", edit.design.kind, edited, edit.mask[None]),),
        before=none,
        after=none,
        near=np.zeros(0, bool),
        facts={
            "truth": "asset",
            "size": setup.size,
            "asset": f"as the file has it, {len(truth.splats)} Gaussians",
            "truth of the edit": "its picture alone",
            **_edit_facts(key, edit.mask[None]),
        },
    )


def _edit_facts(key: CaseKey, masks: np.ndarray) -> dict[str, Any]:
    share = round(float(masks.mean()), 4)
    return {
        "kind": key.settings["kind"],
        "framing": key.settings["framing"],
        "views": len(masks),
        "edited share": share,
    }


# Cases of splat assets.


@dataclass(frozen=True)
class SplatTruth:
    """An asset, and the frame in which it is about the origin, y up, its Gaussians within about -1..1."""

    name: str
    splats: Splats = field(repr=False)
    """Numpy float32; those that cannot be drawn are left out."""
    center: np.ndarray
    """[3] in the asset's frame."""
    scale: float
    """Scale of the frame, times the asset's units."""
    radius: float
    """Radius in the frame."""

    def placed(self, camera: Camera) -> Camera:
        """A camera of the frame, in the asset's frame (y down, as files of this kind have it)."""
        w2c = camera.world_to_camera.copy()
        rotation = w2c[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        w2c[:3, 3] = w2c[:3, 3] / self.scale - rotation @ self.center
        w2c[:3, :3] = rotation
        return replace(camera, world_to_camera=w2c)

    def framed(self, point: SurfacePoint) -> SurfacePoint:
        """A point of the asset, in the frame."""
        turn = np.array([1.0, -1.0, -1.0])
        return SurfacePoint((point.position - self.center) * self.scale * turn, point.normal * turn)

    def render(self, cameras: Sequence[Camera]) -> GroundTruthViews:
        """Pictures from cameras of the asset's frame."""
        from splatpainter.rendering import render

        drawn = render(self.splats, list(cameras))
        colors = np.clip(drawn.colors, 0, 1).astype(np.float32)
        return GroundTruthViews(PosedImages(tuple(cameras), colors), drawn.alphas[..., 0], drawn.depths[..., 0])


def splat_names(setup: Setup) -> list[str]:
    """The setup's assets, fewer where there are fewer. Raises ValueError as data.object_sources.SplatFolder."""
    from splattrain.data.object_sources import SplatFolder

    assert setup.data is not None
    folder = SplatFolder(setup.data)
    order = np.random.default_rng([setup.seed, *b"objects"]).permutation(len(folder))
    return [folder.name(int(k)) for k in sorted(order[: setup.objects])]


def load_splats(name: str, setup: Setup) -> SplatTruth:
    """Raises ValueError for a file that cannot be read, and one of which nothing can be drawn."""
    from splattrain.data.object_sources import SplatFolder

    assert setup.data is not None
    splats = SplatFolder(setup.data, [name]).splats(0).numpy()
    if not splats.drawable.all():
        splats = splats.take(np.flatnonzero(splats.drawable))
    if not len(splats):
        raise ValueError(f"{name}: none of its Gaussians can be drawn")
    opaque = splats.opacities > MIN_CENTER_OPACITY
    means = (splats.means[opaque] if opaque.any() else splats.means).astype(np.float64)
    low, high = np.quantile(means, [0.01, 0.99], axis=0)  # captures have stray Gaussians
    center, scale = (low + high) / 2, 2 / max(float((high - low).max()), 1e-6)
    radius = scale * float(np.quantile(np.linalg.norm(means - center, axis=1), 0.98))
    return SplatTruth(name, splats, center, scale, radius)


@dataclass(frozen=True)
class DesignedView:
    """A picture of the asset with an edit on it."""

    design: EditDesign
    picture: np.ndarray = field(repr=False)
    """[H, W, 3] display colours."""
    mask: np.ndarray = field(repr=False)
    """[H, W] bool what was edited."""


def painted_view(
    truth: SplatTruth, base: GroundTruthViews, kind: str, framing: Framing, setup: Setup, rng: np.random.Generator
) -> DesignedView:
    """An edit of a kind in a view made for it; as design_edit. base: views in which points are looked for."""
    files = resources(setup)
    for attempt in range(DESIGN_TRIES):
        point = surface_point(base, rng)
        camera = truth.placed(view_of(truth.framed(point), framing, truth.radius, optics(setup), rng))
        before = truth.render([camera])
        design = draw_edit(kind, camera, point, before, files, rng, strictness(attempt))
        if design is None:
            continue
        picture = composed(before, design)
        mask = changes(before.images.colors, picture[None])[0]
        if is_visible(before.images.colors[0], picture, mask, strictness(attempt)):
            return DesignedView(design, picture, mask)
    raise invisible(truth.name, kind)


def composed(view: GroundTruthViews, design: EditDesign) -> np.ndarray:
    """[H, W, 3] the picture with the edit on the asset's pixels of it: all that is known of the edit."""
    import torch

    before, alpha = view.images.colors[0], view.alphas[0]
    if isinstance(design.content, np.ndarray):
        colors, coverage = design.content[..., :3], design.content[..., 3]
    else:
        solid = view.masks[0]
        colors, coverage = before.copy(), np.zeros_like(alpha)
        points = design.camera.unproject(view.depths[0].astype(np.float64))[solid]
        paint = design.content.paint(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(before[solid]))
        colors[solid], coverage[solid] = paint.colors.numpy(), paint.coverage.numpy()
    share = (coverage * alpha)[..., None]
    return (before + share * (colors - before)).astype(np.float32)
