"""Tab. 2: another light. An asset under a source light; 1, 2 or 4 views under a target light; scored on other views.

All views show the whole object, and all figures are over its pixels. The views handed in are nested: the one is among
the two, the two among the four.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.ground_truth import BuiltAsset, GroundTruth, GroundTruthViews, build_asset
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import object_masks, scored
from splatbench.tables import beside_truth, measures
from splattrain.data import viewpoints

if TYPE_CHECKING:
    from splatbench.methods import EditResult
    from splatpainter.cameras import Camera

VIEW_COUNTS = (1, 2, 4)
"""Relit views handed in."""
TURN_DEGREES = (0.0, 180.0, 90.0, 270.0)
"""Degrees around the object of each relit view from the first: any of VIEW_COUNTS spreads evenly."""
ELEVATION_DEGREES = (0.0, 35.0)
"""Elevations of relit views: from, to."""


class Relighting:
    """See the module; one case per object, target light and number of views."""

    name = "relight"
    title = "Global relighting from 1, 2 and 4 relit views (Tab. 2)"
    columns = measures()
    split_by = "views"

    def keys(self, setup: Setup) -> list[CaseKey]:
        """Cases of one object and light follow each other: they share pictures."""
        lights = environments(setup).names
        if len(lights) < 2:
            raise ValueError(f"relighting: expected at least two environments, got {len(lights)}")
        keys = []
        for name in objects(setup).names:
            source, *targets = drawn_lights(lights, name, setup.lights + 1, setup.seed)
            for target in targets:
                for count in VIEW_COUNTS:
                    settings = {"source": source, "target": target, "views": count}
                    keys.append(CaseKey(f"{safe(name)}-{safe(target)}-{count}views", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        source, target, count = (key.settings[k] for k in ("source", "target", "views"))
        lit = _source(key.name, source, setup)
        relit = _target(key.name, source, target, setup)
        step = EditStep("global", "relight", relit.edited.images.take(range(count)), relit.edited.masks[:count])
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=lit.asset.splats,
            base=lit.base,
            steps=(step,),
            before=lit.novel,
            after=relit.novel,
            near=np.ones(len(lit.novel), bool),  # the edit is everywhere
            true_views=relit.around,
            setup_seconds=lit.asset.seconds,
            facts={
                **lit.truth.facts,
                "asset": lit.asset.method,
                "light": source,
                "environment": target,
                "views": count,
            },
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        return dict(scored(results[-1].splats, case.after, object_masks(case.after), perceptual))

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        return beside_truth(case, results, 0)


TABLE = Relighting()


@dataclass(frozen=True)
class _Source:
    """An object in its source light, and the cameras that see it in others."""

    truth: GroundTruth
    asset: BuiltAsset
    base: PosedImages
    novel: PosedImages
    edited: tuple[Camera, ...]
    """Edited views, as many as the most of VIEW_COUNTS."""


@dataclass(frozen=True)
class _Target:
    """The object in one target light."""

    edited: GroundTruthViews
    novel: PosedImages
    around: PosedImages
    """The base views and the edited ones."""


# Cases that share pictures follow each other: the last ones made are enough.


@lru_cache(maxsize=1)
def _source(name: str, light: str, setup: Setup) -> _Source:
    truth = GroundTruth.load(name, light, setup)
    rng = generator(setup.seed, "relight", name)
    ring = truth.ring(setup.base_views, rng)
    start = float(rng.uniform(0, 360))
    edited = [
        viewpoints.object_camera(truth.radius, truth.optics, start + turn, float(rng.uniform(*ELEVATION_DEGREES)))
        for turn in TURN_DEGREES
    ]
    views = truth.render([*ring, *truth.ring(setup.novel_views, rng)], "source")
    base = views.take(range(len(ring)))
    if not base.masks.any():
        raise ValueError(f"{name}: nothing of it can be seen")
    novel = views.images.take(range(len(ring), len(views.images)))
    return _Source(truth, build_asset(truth, base), base.images, novel, tuple(edited))


@lru_cache(maxsize=1)
def _target(name: str, source: str, target: str, setup: Setup) -> _Target:
    lit = _source(name, source, setup)
    cameras = [*lit.edited, *lit.base.cameras, *lit.novel.cameras]
    views = lit.truth.under(target).render(cameras, f"target {target}")
    edited, end = len(lit.edited), len(lit.edited) + len(lit.base)
    novel = views.images.take(range(end, len(cameras)))
    return _Target(views.take(range(edited)), novel, views.images.take(range(end)))
