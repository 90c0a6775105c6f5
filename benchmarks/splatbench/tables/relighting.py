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

from splatbench import assets
from splatbench import ground_truth as ground
from splatbench.cases import Case, CaseKey, EditStep, PosedImages, Setup, safe
from splatbench.objects import drawn_lights, environments, generator, objects
from splatbench.scoring import object_masks, scored
from splatbench.tables import beside_truth, measures
from splatpainter.data import viewpoints

if TYPE_CHECKING:
    from splatbench.methods import EditResult
    from splatpainter.cameras import Camera
    from splatpainter.data.lights import Light

VIEWS = (1, 2, 4)
"""Relit views handed in."""
TURNS = (0.0, 180.0, 90.0, 270.0)
"""Degrees around the object of each relit view from the first: any of VIEWS spreads evenly."""
HEIGHTS = (0.0, 35.0)
"""Elevation of relit views, degrees: least, most."""


class Relight:
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
                for count in VIEWS:
                    settings = {"source": source, "target": target, "views": count}
                    keys.append(CaseKey(f"{safe(name)}-{safe(target)}-{count}views", name, settings))
        return keys

    def make(self, key: CaseKey, setup: Setup) -> Case:
        source, target, count = (key.settings[k] for k in ("source", "target", "views"))
        stage = _stage(key.name, source, setup)
        relit = _relit(key.name, source, target, setup)
        step = EditStep("global", "relight", relit.edited.pictures.take(range(count)), relit.edited.masks[:count])
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=stage.asset.splats,
            base=stage.base,
            steps=(step,),
            before=stage.novel,
            after=relit.novel,
            near=np.ones(len(stage.novel), bool),  # the edit is everywhere
            true_views=relit.around,
            setup_seconds=stage.asset.seconds,
            facts={
                **ground.told(setup),
                "asset": stage.asset.how,
                "light": source,
                "environment": target,
                "views": count,
            },
        )

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        return dict(scored(results[-1].splats, case.after, object_masks(case.after), perceptual))

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        return beside_truth(case, results, 0)


def protocol() -> Relight:
    return Relight()


@dataclass(frozen=True)
class _Stage:
    """An object in its source light, and the cameras that see it in others."""

    subject: ground.Subject
    asset: assets.Asset
    base: PosedImages
    novel: PosedImages
    edited: tuple[Camera, ...]
    """As many as the most of VIEWS."""


@dataclass(frozen=True)
class _Relit:
    """It in one target light."""

    edited: ground.Shown
    novel: PosedImages
    around: PosedImages
    """The base views and the edited ones."""


# Cases that share pictures follow each other: the last ones made are enough.


@lru_cache(maxsize=1)
def _stage(name: str, source: str, setup: Setup) -> _Stage:
    what = ground.subject(name, objects(setup).load(name), setup)
    light = _light(source, setup)
    rng = generator(setup.seed, "relight", name)
    optics = ground.optics(setup)
    ring = viewpoints.ring(what.radius, optics, setup.base_views, rng)
    start = float(rng.uniform(0, 360))
    edited = [viewpoints.around(what.radius, optics, start + t, float(rng.uniform(*HEIGHTS))) for t in TURNS]
    novel = viewpoints.ring(what.radius, optics, setup.novel_views, rng)
    shown = ground.show(what, light, [*ring, *novel], setup, "source")
    count = len(ring)
    base = ground.Shown(shown.pictures.take(range(count)), shown.alphas[:count], shown.depths[:count])
    if not base.masks.any():
        raise ValueError(f"{name}: nothing of it can be seen")
    asset = assets.build(what, light, base, setup)
    after = shown.pictures.take(range(count, len(shown.pictures)))
    return _Stage(what, asset, base.pictures, after, tuple(edited))


@lru_cache(maxsize=1)
def _relit(name: str, source: str, target: str, setup: Setup) -> _Relit:
    stage = _stage(name, source, setup)
    cameras = [*stage.edited, *stage.base.cameras, *stage.novel.cameras]
    shown = ground.show(stage.subject, _light(target, setup), cameras, setup, f"target {target}")
    first, last = len(stage.edited), len(stage.edited) + len(stage.base)
    edited = ground.Shown(shown.pictures.take(range(first)), shown.alphas[:first], shown.depths[:first])
    return _Relit(edited, shown.pictures.take(range(last, len(cameras))), shown.pictures.take(range(last)))


def _light(name: str, setup: Setup) -> Light:
    return environments(setup).load(name)
