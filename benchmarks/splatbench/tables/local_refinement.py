"""Tab. 1: detail from zoomed-in views. An asset of base views, two close-ups of textured points, scored near them.

The close-ups are crops of pictures `setup.detail` times larger, from the same truth and light as everything else: what
is asked is texture that the asset lacks. All figures are over the object's pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, Setup, safe
from splatbench.edit_design import TexturedPoint, textured_points, views_beside
from splatbench.ground_truth import GroundTruth, build_asset
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import object_masks, rendered, scored
from splatbench.tables import beside_truth, measures
from splatpainter.cameras import Camera
from splattrain.data import viewpoints

if TYPE_CHECKING:
    from splatbench.methods import EditResult

CLOSE_UPS = 2
TRUE_CLOSE_UPS = 12
"""True close-ups for methods that see the truth."""
MAX_TURN_DEGREES = (12.0, 8.0)
"""Degrees by which a close-up's line of sight differs from the base view in which its point was found: around the
object, and up or down."""
NEAR_DEGREES = (8.0, 30.0)
"""Degrees between a close-up and the novel views near it: from, to."""
WIDE_DEGREES = (5.0, 45.0)
"""The same degrees for the true close-ups."""
MAX_VIEW_TRIES = 20
"""Tries for a view that something stands in the way of."""
MAX_SURFACE_OFFSET = 0.01
"""World units that a surface may lie before a point and still be its own."""


class LocalRefinement:
    """See the module; one case per object."""

    name = "refine"
    title = "High-fidelity refinement from zoomed-in views (Tab. 1)"
    columns = (*measures("Near the close-ups"), *measures("Whole object", "_around"))
    split_by = ""

    def keys(self, setup: Setup) -> list[CaseKey]:
        lights = environments(setup).names
        keys = []
        for name in objects(setup).names:
            settings = {"light": drawn_lights(lights, name, 1, setup.seed)[0], "zooms": CLOSE_UPS}
            keys.append(CaseKey(f"{safe(name)}-refine", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        truth = GroundTruth.load(key.name, key.settings["light"], setup)
        rng = generator(setup.seed, "refine", key.name)
        ring = truth.ring(setup.base_views, rng)
        base = truth.render(ring, "base")
        try:
            points = textured_points(base, max(setup.size // setup.detail, 3), key.settings["zooms"], rng)
        except ValueError as error:
            raise ValueError(f"{key.name}: {error}") from None
        zooms = [_close_up(truth, point, ring[point.view], rng) for point in points]
        near = (setup.novel_views + 1) // 2
        novel = _beside(truth, zooms, points, near, NEAR_DEGREES, rng)
        novel += truth.ring(setup.novel_views - near, rng)
        around = _beside(truth, zooms, points, TRUE_CLOSE_UPS, WIDE_DEGREES, rng)
        # One call for all pictures of a light: path tracing builds its scene once per call.
        views = truth.render([*zooms, *novel, *around], "refine")
        count, end = len(zooms), len(zooms) + len(novel)
        after = views.images.take(range(count, end))
        step = EditStep("local", "zoom", views.images.take(range(count)), views.masks[:count])
        asset = build_asset(truth, base)
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=asset.splats,
            base=base.images,
            steps=(step,),
            before=after,
            after=after,
            near=np.arange(len(novel)) < near,
            true_views=views.images.take(range(end, end + TRUE_CLOSE_UPS)),
            setup_seconds=asset.seconds,
            facts={
                **truth.facts,
                "asset": asset.method,
                "light": truth.light.name,
                "views": count,
                "detail": setup.detail,
                "contrast": [round(point.contrast, 4) for point in points],
            },
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        splats, masks = results[-1].splats, object_masks(case.after)
        near, rest = case.near, np.logical_not(case.near)
        close = scored(splats, case.after.take(near), masks[near], perceptual)
        around = scored(splats, case.after.take(rest), masks[rest], perceptual)
        return close | {f"{name}_around": value for name, value in around.items()}

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        pictures = beside_truth(case, results, int(np.argmax(case.near)))
        rest = np.flatnonzero(np.logical_not(case.near))
        if len(rest):
            pictures["whole"] = rendered(results[-1].splats, case.after.take(rest[:1]).cameras)[0]
        return pictures


TABLE = LocalRefinement()


def _close_up(truth: GroundTruth, point: TexturedPoint, base: Camera, rng: np.random.Generator) -> Camera:
    """A tile of a large picture of the whole object, from about where `base` stands, around the point."""
    azimuth, elevation = viewpoints.angles(base.position)
    full = base
    for k in range(MAX_VIEW_TRIES + 1):
        turn, tilt = (1 - k / MAX_VIEW_TRIES) * rng.uniform(-1, 1, 2) * MAX_TURN_DEGREES
        height = float(np.clip(elevation + tilt, viewpoints.MIN_ELEVATION, viewpoints.MAX_ELEVATION))
        full = viewpoints.object_camera(truth.radius, truth.optics, azimuth + turn, height)
        if not truth.blocks(full.position, point.position, MAX_SURFACE_OFFSET):
            break
    return viewpoints.crop(full, point.position, truth.setup.detail)


def _beside(
    truth: GroundTruth,
    zooms: Sequence[Camera],
    points: Sequence[TexturedPoint],
    count: int,
    degrees: tuple[float, float],
    rng: np.random.Generator,
) -> list[Camera]:
    """`count` views of the close-ups' points in turn, as close, from other sides that see them."""
    how = {"nearest_degrees": degrees[0], "tries": MAX_VIEW_TRIES, "slack": MAX_SURFACE_OFFSET}
    cameras = []
    for i in range(count):
        zoom, position = zooms[i % len(zooms)], points[i % len(points)].position
        cameras += views_beside(truth, zoom, position, 1, degrees, rng, **how)
    return cameras
