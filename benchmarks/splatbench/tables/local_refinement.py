"""Tab. 1: detail from zoomed-in views. An asset of base views, two close-ups of textured spots, scored near them.

The close-ups are crops of pictures `setup.detail` times larger, from the same truth and light as everything else: what
is asked is texture that the asset lacks. All figures are over the object's pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench import assets
from splatbench import ground_truth as ground
from splatbench.cases import Case, CaseKey, EditStep, Setup, safe
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import drawn, object_masks, scored
from splatbench.surface_points import textured
from splatbench.tables import beside_truth, measures
from splatpainter.cameras import Camera
from splatpainter.data import viewpoints
from splatpainter.data.meshes import Mesh

if TYPE_CHECKING:
    from splatbench.methods import EditResult
    from splatbench.surface_points import Spot

ZOOMS = 2
"""Close-ups handed in."""
ORACLE = 12
"""True close-ups for methods that are upper bounds."""
TURN = (12.0, 8.0)
"""Degrees by which a close-up's line of sight differs, at most, from the base view in which its spot was found: around
the object, and up or down."""
NEAR = (8.0, 30.0)
"""Degrees between a close-up and the novel views near it: least, most."""
WIDE = (5.0, 45.0)
"""The same for the oracle's."""
TRIES = 20
"""Of a view that something stands in the way of."""


class Refine:
    """See the module; one case per object."""

    name = "refine"
    title = "High-fidelity refinement from zoomed-in views (Tab. 1)"
    columns = (*measures("Near the close-ups"), *measures("Whole object", "_around"))
    split_by = ""

    def keys(self, setup: Setup) -> list[CaseKey]:
        lights = environments(setup).names
        keys = []
        for name in objects(setup).names:
            settings = {"light": drawn_lights(lights, name, 1, setup.seed)[0], "zooms": ZOOMS}
            keys.append(CaseKey(f"{safe(name)}-refine", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        what = ground.subject(key.name, objects(setup).load(key.name), setup)
        light = environments(setup).load(key.settings["light"])
        rng = generator(setup.seed, "refine", key.name)
        optics = ground.optics(setup)
        ring = viewpoints.ring(what.radius, optics, setup.base_views, rng)
        base = ground.show(what, light, ring, setup, "base")
        try:
            spots = textured(base, max(setup.size // setup.detail, 3), key.settings["zooms"], rng)
        except ValueError as error:
            raise ValueError(f"{key.name}: {error}") from None
        zooms = [_zoom(what, spot, ring[spot.view], optics, setup.detail, rng) for spot in spots]
        near = (setup.novel_views + 1) // 2
        novel = _beside(what.mesh, zooms, spots, near, NEAR, rng)
        novel += viewpoints.ring(what.radius, optics, setup.novel_views - near, rng)
        around = _beside(what.mesh, zooms, spots, ORACLE, WIDE, rng)
        # One call for all pictures of a light: path tracing builds its scene once per call.
        shown = ground.show(what, light, [*zooms, *novel, *around], setup, "refine")
        count, first = len(zooms), len(zooms) + len(novel)
        truth, oracle = (shown.pictures.take(range(*span)) for span in ((count, first), (first, first + ORACLE)))
        step = EditStep("local", "zoom", shown.pictures.take(range(count)), shown.masks[:count])
        built = assets.build(what, light, base, setup)
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=built.splats,
            base=base.pictures,
            steps=(step,),
            before=truth,
            after=truth,
            near=np.arange(len(novel)) < near,
            true_views=oracle,
            setup_seconds=built.seconds,
            facts={
                **ground.told(setup),
                "asset": built.how,
                "light": light.name,
                "views": count,
                "detail": setup.detail,
                "contrast": [round(spot.contrast, 4) for spot in spots],
            },
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        splats, masks = results[-1].splats, object_masks(case.after)
        near, others = case.near, np.logical_not(case.near)
        close = scored(splats, case.after.take(near), masks[near], perceptual)
        around = scored(splats, case.after.take(others), masks[others], perceptual)
        return close | {f"{name}_around": value for name, value in around.items()}

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        found = beside_truth(case, results, int(np.argmax(case.near)))
        whole = np.flatnonzero(np.logical_not(case.near))
        if len(whole):
            found["whole"] = drawn(results[-1].splats, case.after.take(whole[:1]).cameras)[0]
        return found


def protocol() -> Refine:
    return Refine()


def _zoom(
    what: ground.Subject, spot: Spot, seen: Camera, optics: viewpoints.Optics, detail: int, rng: np.random.Generator
) -> Camera:
    """A tile of a large picture of the whole object, from about where `seen` stands, around the spot."""
    azimuth, elevation = viewpoints.angles(seen.position)
    for k in range(TRIES + 1):
        turn, tilt = (1 - k / TRIES) * rng.uniform(-1, 1, 2) * TURN
        height = float(np.clip(elevation + tilt, viewpoints.MIN_ELEVATION, viewpoints.MAX_ELEVATION))
        whole = viewpoints.around(what.radius, optics, azimuth + turn, height)
        if not ground.blocked(what.mesh, whole.position, spot.place):
            break
    return viewpoints.crop(whole, spot.place, detail)


def _beside(
    mesh: Mesh,
    zooms: Sequence[Camera],
    spots: Sequence[Spot],
    count: int,
    apart: tuple[float, float],
    rng: np.random.Generator,
) -> list[Camera]:
    """`count` views of the close-ups' spots in turn, as close, from other sides that see them."""
    cameras = []
    for i in range(count):
        zoom, spot = zooms[i % len(zooms)], spots[i % len(spots)]
        for k in range(TRIES + 1):  # nearer and nearer to the close-up, which sees its spot
            most = apart[0] + (apart[1] - apart[0]) * (1 - k / TRIES)
            camera = viewpoints.neighbour(zoom, spot.place, rng, (apart[0] * (1 - k / TRIES), most))
            if not ground.blocked(mesh, camera.position, spot.place):
                break
        cameras.append(camera)
    return cameras
