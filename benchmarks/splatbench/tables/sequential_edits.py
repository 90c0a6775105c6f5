"""Edits in a row (the paper's figures on iterative updates and on conflicting inputs, as a table).

Part "views": one edit in 1 to 4 views, one after another (paint, close-ups, another light in turn); novel views after
each. Part "edits": up to 10 different edits; what is left of the earlier ones. Part "conflict": two views paint one
region differently, and the later one must win. Every step has one view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.edit_design import (
    KINDS,
    apart,
    design_edit,
    draw_edit,
    resources,
    surface_point,
    view_of,
    views_beside,
)
from splatbench.ground_truth import GroundTruth, GroundTruthViews, build_asset, changed, changes
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import compared, object_masks, rendered, scored
from splatbench.tables import Column, beside_truth
from splatpainter.cameras import Camera
from splattrain.data import viewpoints
from splattrain.data.edits import MIN_EDIT_FRACTION, EditDesign
from splattrain.data.edits.content import EditResources
from splattrain.data.edits.surface_points import SurfacePoint

if TYPE_CHECKING:
    from splatbench.methods import EditResult

PARTS = ("views", "edits", "conflict")
EDITS = ("paint", "zoom", "relight")
"""Edits of part "views", in turn."""
MAX_VIEWS, MAX_EDITS = 4, 10
SMALL_SIZE_PX = 128
"""Up to here fewer steps are asked, for a quick look."""
SMALL_VIEWS, SMALL_EDITS = 3, 3
SEQUENCE_COLUMN, CONFLICT_COLUMN = "Steps in a row, PSNR", "Conflicts, PSNR"
NEAR_DEGREES = (10.0, 35.0)
"""Degrees between an edited view and the further views of the edit, and the novel views near it: from, to."""
CONFLICT_DEGREES = (5.0, 30.0)
"""Degrees between two views that conflict."""
MIN_OVERLAP = 0.2
"""Part of the smaller of two edits that conflict which the other one covers."""
APART_RADII = (0.4, 0.2, 0.0)
"""Least distance between different edits, in radii of the object: the first of these that can be had."""
MAX_EDIT_TRIES = 6
MIN_OTHER_VIEW = 0.25
"""Times MIN_EDIT_FRACTION: what an edit must still change in views other than that of its design."""


class SequentialEdits:
    """See the module; a case of each part per object."""

    name = "sequence"
    title = "Edits in a row: more views, further edits, conflicts"
    columns = (
        Column("first", "after the first", SEQUENCE_COLUMN, "higher"),
        Column("last", "after the last", SEQUENCE_COLUMN, "higher"),
        Column("forgetting", "lost of earlier edits", SEQUENCE_COLUMN, "lower"),
        Column("later", "later view", CONFLICT_COLUMN, "higher"),
        Column("new", "earlier view, later edit", CONFLICT_COLUMN, "higher"),
        Column("old", "earlier view, earlier edit", CONFLICT_COLUMN, "lower"),
        Column("winner", "later wins, %", CONFLICT_COLUMN, "higher", 0),
    )
    split_by = "part"

    def keys(self, setup: Setup) -> list[CaseKey]:
        lights = environments(setup).names
        small = setup.size <= SMALL_SIZE_PX
        keys = []
        for k, name in enumerate(objects(setup).names):
            light, *targets = drawn_lights(lights, name, 2, setup.seed)
            edit = EDITS[k % len(EDITS)]
            if edit == "relight" and not targets:
                edit = EDITS[0]
            settings: dict[str, dict[str, Any]] = {
                "views": {"edit": edit, "kind": KINDS[k % len(KINDS)], "count": SMALL_VIEWS if small else MAX_VIEWS},
                "edits": {"count": SMALL_EDITS if small else MAX_EDITS},
                "conflict": {"count": 2},
            }
            if edit == "relight":
                settings["views"]["target"] = targets[0]
            for part in PARTS:
                keys.append(CaseKey(f"{safe(name)}-{part}", name, {"part": part, "light": light, **settings[part]}))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        scene, count = EditScene.load(key, setup), key.settings["count"]
        if key.settings["part"] == "edits":
            return different_edits(scene, count)
        if key.settings["part"] == "conflict":
            return conflict(scene)
        makers = {"paint": painted_views, "zoom": zoomed_views, "relight": relit_views}
        return makers[key.settings["edit"]](scene, count)

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        scores = {"views": _score_views, "edits": _score_edits, "conflict": _score_conflict}
        empty: dict[str, float | None] = {column.key: None for column in self.columns}
        return empty | scores[case.facts["part"]](case, results, perceptual)

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        if case.facts["part"] == "conflict":
            earlier = rendered(results[-1].splats, case.after.take([0]).cameras)[0]
            return {"result": earlier, "truth": case.after.colors[0], "first edit": case.steps[0].edited.colors[0]}
        view = case.most_changed_view
        assert view is not None  # every part has novel views
        camera = case.after.cameras[view]
        earlier = {f"step {k + 1}": rendered(r.splats, [camera])[0] for k, r in enumerate(results[:-1])}
        return beside_truth(case, results, view) | earlier


TABLE = SequentialEdits()


# Cases.


@dataclass(frozen=True)
class EditScene:
    """An object that is about to be edited."""

    key: CaseKey
    truth: GroundTruth
    base: GroundTruthViews = field(repr=False)
    rng: np.random.Generator
    files: EditResources = field(repr=False)

    @staticmethod
    def load(key: CaseKey, setup: Setup) -> EditScene:
        """Raises ValueError where the object cannot be read or shown."""
        truth = GroundTruth.load(key.name, key.settings["light"], setup)
        rng = generator(setup.seed, f"sequence {key.settings['part']}", key.name)
        base = truth.render(truth.ring(setup.base_views, rng), "base")
        return EditScene(key, truth, base, rng, resources(setup))

    def nearby_cameras(self, camera: Camera, point: SurfacePoint, count: int) -> list[Camera]:
        return views_beside(self.truth, camera, point.position, count, NEAR_DEGREES, self.rng)

    def near_and_around(self, camera: Camera, point: SurfacePoint) -> tuple[list[Camera], np.ndarray]:
        """(novel views, [W] bool near): beside an edited view first, then of the whole object."""
        count = self.truth.setup.novel_views
        near = (count + 1) // 2
        novel = self.nearby_cameras(camera, point, near) + self.truth.ring(count - near, self.rng)
        return novel, np.arange(count) < near

    def case(
        self, steps: Sequence[EditStep], before: PosedImages, after: PosedImages, near: np.ndarray, **facts: Any
    ) -> Case:
        asset = build_asset(self.truth, self.base)
        part = self.key.settings["part"]
        about = {"asset": asset.method, "light": self.truth.light.name, "steps": len(steps), "part": part}
        return Case(
            protocol="sequence",
            name=self.key.name,
            label=self.key.label,
            asset=asset.splats,
            base=self.base.images,
            steps=tuple(steps),
            before=before,
            after=after,
            near=near,
            setup_seconds=asset.seconds,
            facts={**self.truth.facts, **about, **facts},
        )

    def failure(self, what: str) -> ValueError:
        return ValueError(f"{self.key.name}: {MAX_EDIT_TRIES} choices of {what} changed nothing that can be seen")


def painted_views(scene: EditScene, count: int) -> Case:
    """One painted edit, in its view first and then in others that show it."""
    kind, preview = scene.key.settings["kind"], scene.truth.preview()
    for _ in range(MAX_EDIT_TRIES):
        design, point = design_edit(preview, scene.base, kind, "close-up", scene.files, scene.rng)
        views = [design.camera, *scene.nearby_cameras(design.camera, point, count - 1)]
        novel, near = scene.near_and_around(design.camera, point)
        before, after = (t.render([*views, *novel], "novel") for t in (scene.truth, scene.truth.paint(design)))
        masks = changed(before, after)
        parts = masks[:count].mean((1, 2))
        in_other_views = (parts >= MIN_OTHER_VIEW * MIN_EDIT_FRACTION).all()
        if parts[0] >= MIN_EDIT_FRACTION and in_other_views and masks[count:][near].any():
            break
    else:
        raise scene.failure(f"a {kind} edit in {count} views")
    steps = [EditStep("local", kind, after.images.take([k]), masks[k : k + 1]) for k in range(count)]
    rest = range(count, count + len(novel))
    return scene.case(steps, before.images.take(rest), after.images.take(rest), near, edit="paint", kind=kind)


def zoomed_views(scene: EditScene, count: int) -> Case:
    """More and more close-ups of one point, crops of pictures `setup.detail` times larger."""
    truth = scene.truth
    for _ in range(MAX_EDIT_TRIES):
        point = surface_point(scene.base, scene.rng)
        full = view_of(point, "whole", truth.radius, truth.optics, scene.rng)
        if not truth.blocks(full.position, point.position, 0.02):
            break
    else:
        raise scene.failure("a close-up")
    zoom = viewpoints.crop(full, point.position, truth.setup.detail)
    views = [zoom, *scene.nearby_cameras(zoom, point, count - 1)]
    novel, near = scene.near_and_around(zoom, point)
    images = truth.render([*views, *novel], "novel")
    steps = [EditStep("local", "zoom", images.images.take([k]), images.masks[k : k + 1]) for k in range(count)]
    after = images.images.take(range(count, count + len(novel)))
    return scene.case(steps, after, after, near, edit="zoom", kind="zoom")


def relit_views(scene: EditScene, count: int) -> Case:
    """The object in another light, in more and more views around it (the paper's figure of iterative updates)."""
    truth, target = scene.truth, scene.truth.under(scene.key.settings["target"])
    views, novel = truth.ring(count, scene.rng), truth.ring(truth.setup.novel_views, scene.rng)
    relit = target.render([*views, *novel], "relit")
    steps = [EditStep("global", "relight", relit.images.take([k]), relit.masks[k : k + 1]) for k in range(count)]
    after = relit.images.take(range(count, count + len(novel)))
    before = truth.render(novel, "novel").images
    near = np.zeros(len(novel), bool)
    return scene.case(steps, before, after, near, edit="relight", kind="relight", target=target.light.name)


def different_edits(scene: EditScene, count: int) -> Case:
    """Up to `count` edits of all kinds at different points, each in a close-up made for it.

    The first views of `before` and `after` are those close-ups: just before the edit made there, and after the last."""
    truth, preview = scene.truth, scene.truth.preview()
    steps: list[EditStep] = []
    earlier: list[PosedImages] = []
    points: list[SurfacePoint] = []
    for k in range(count):
        design, point = _another(scene, preview, KINDS[k % len(KINDS)], points)
        painted = truth.paint(design)
        before, after = (t.render([design.camera], f"edit {k}") for t in (truth, painted))
        masks = changed(before, after)
        if masks.mean() < MIN_OTHER_VIEW * MIN_EDIT_FRACTION:
            continue  # seen in the preview alone
        truth, preview = painted, preview.paint(design)
        points.append(point)
        earlier.append(before.images)
        steps.append(EditStep("local", design.kind, after.images, masks))
    if len(steps) < 2:
        raise scene.failure("different edits")
    last = [truth.render(step.edited.cameras, f"edit {k}").images for k, step in enumerate(steps)]
    novel, near = scene.near_and_around(steps[-1].edited.cameras[0], points[-1])
    before, after = (t.render(novel, "novel").images for t in (scene.truth, truth))
    near = np.concatenate([np.zeros(len(steps), bool), near])
    joined = PosedImages.joined
    return scene.case(steps, joined([*earlier, before]), joined([*last, after]), near, kind="several")


def conflict(scene: EditScene) -> Case:
    """Two views, one after the other, paint one region differently; the second picture shows the object with the first
    edit under its paint. The first view of `before` and `after` is that of the first edit."""
    truth, preview, rng = scene.truth, scene.truth.preview(), scene.rng
    for _ in range(MAX_EDIT_TRIES):
        first_kind, second_kind = (str(kind) for kind in rng.choice(["stroke", "text", "sticker", "photo"], 2))
        first, point = design_edit(preview, scene.base, first_kind, "close-up", scene.files, rng)
        between = preview.paint(first)
        (view,) = views_beside(truth, first.camera, point.position, 1, CONFLICT_DEGREES, rng)
        canvas = between.render([view], "design")
        second = draw_edit(second_kind, view, point, canvas, scene.files, rng, 0.5)
        if second is None:
            continue
        once = truth.paint(first)
        twice = once.paint(second)
        plain, one, two = (t.render([first.camera], "first") for t in (truth, once, twice))
        masks, over = changed(plain, one), changed(one, two)
        overlap = MIN_OVERLAP * min(masks.sum(), over.sum())
        one_there, two_there = (t.render([view], "second") for t in (once, twice))
        later = changed(one_there, two_there)
        visible = min(m.mean() for m in (masks, over, later)) >= MIN_EDIT_FRACTION
        if visible and (masks & over).sum() >= max(overlap, 1):
            break
    else:
        raise scene.failure("edits that conflict")
    steps = [
        EditStep("local", first_kind, one.images, masks),
        EditStep("local", second_kind, two_there.images, later),
    ]
    novel, near = scene.near_and_around(view, point)
    before, after = (t.render(novel, "novel").images for t in (truth, twice))
    near, joined = np.concatenate([[False], near]), PosedImages.joined
    return scene.case(steps, joined([plain.images, before]), joined([two.images, after]), near, kind="conflict")


def _another(
    scene: EditScene, preview: GroundTruth, kind: str, points: Sequence[SurfacePoint]
) -> tuple[EditDesign, SurfacePoint]:
    """An edit as far from those at the points as can be had."""
    for radii in APART_RADII:
        accept = apart(points, radii * scene.truth.radius)
        try:
            return design_edit(preview, scene.base, kind, "close-up", scene.files, scene.rng, accept)
        except ValueError:
            if radii == APART_RADII[-1]:
                raise
    raise AssertionError("the last of APART_RADII returns or raises")


# Scores.


def _score_views(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """psnr_k, ssim_k, lpips_k after k views: novel views near the edit, where it changed the object (of close-ups: the
    object there); of another light, the whole object in all of them."""
    if case.facts["edit"] == "relight":
        chosen = np.ones(len(case.after), bool)
        masks = object_masks(case.after)
    else:
        chosen = case.near
        zoom = case.facts["edit"] == "zoom"
        masks = object_masks(case.after) if zoom else changes(case.before.colors, case.after.colors)
    figures: dict[str, float | None] = {}
    for k, result in enumerate(results, 1):
        after = scored(result.splats, case.after.take(chosen), masks[chosen], perceptual)
        figures |= {f"{name}_{k}": value for name, value in after.items()}
    return figures | {"first": figures.get("psnr_1"), "last": figures.get(f"psnr_{len(results)}")}


def _score_edits(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """fresh_k: PSNR of edit k in its view right after it, where later edits leave it alone; end_k: after the last;
    psnr_k: mean over the edits so far, after k of them. forgetting: mean of fresh - end of all but the last, dB."""
    edited = PosedImages.joined([step.edited for step in case.steps])
    masks = np.concatenate([step.masks for step in case.steps])
    count = len(case.steps)
    masks &= np.logical_not(changes(edited.colors, case.after.colors[:count]))
    psnr = np.full((count, count), np.nan)  # [after, edit]
    for k, result in enumerate(results):
        renders = rendered(result.splats, edited.cameras[: k + 1])
        for j in range(k + 1):
            value = compared(renders[j : j + 1], edited.colors[j : j + 1], masks[j : j + 1], None)["psnr"]
            psnr[k, j] = np.nan if value is None else value
    figures: dict[str, float | None] = {}
    for k in range(count):
        figures |= {f"fresh_{k + 1}": _mean(psnr[k, k]), f"end_{k + 1}": _mean(psnr[-1, k])}
        figures[f"psnr_{k + 1}"] = _mean(psnr[k, : k + 1])
    lost = np.diagonal(psnr)[:-1] - psnr[-1, :-1]
    return figures | {"first": figures["psnr_1"], "last": figures[f"psnr_{count}"], "forgetting": _mean(lost)}


def _score_conflict(case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
    """later: the second view, where its edit is. new and old: the first view where both edits painted it, against the
    truth after the second and against the first picture. winner: 100 where the render is nearer to the truth after the
    second than to the first picture and to the unedited object, else 0."""
    first, second = case.steps
    last = results[-1].splats
    truth = case.after.take([0])
    both = first.masks & changes(first.edited.colors, truth.colors)
    later = scored(last, second.edited, second.masks, perceptual)
    versions = (truth, first.edited, case.before.take([0]))
    new, old, plain = (scored(last, pictures, both, None)["psnr"] for pictures in versions)
    winner = None if new is None or old is None or plain is None else 100.0 * (new > max(old, plain))
    fresh = scored(results[0].splats, first.edited, first.masks, None)["psnr"]
    return {
        "later": later["psnr"],
        "new": new,
        "old": old,
        "winner": winner,
        "psnr_1": fresh,
        "psnr_2": later["psnr"],
        "ssim_later": later["ssim"],
        "lpips_later": later["lpips"],
    }


def _mean(values: Any) -> float | None:
    values = np.atleast_1d(values)
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None
