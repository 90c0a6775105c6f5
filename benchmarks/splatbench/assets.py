"""The asset that an artist has before any edit: built from the base views alone, or thinned from the truth's surface.

"fitted": base views' pixels put at their true depth, then 3DGS optimisation on the base views. "surfels": the coarse
asset of the training data (data/degrade.py), which knows the surface all around but no picture. Knows no edit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatbench.cases import Setup
    from splatbench.ground_truth import Shown, Subject
    from splatpainter.data.lights import Light
    from splatpainter.fit.optimize import View

Way = Literal["fitted", "surfels"]
DEFAULT: Way = "fitted"
DEGREE = 1
"""Of the asset's SH."""
OPACITY, SIZE = 0.9, 0.6
"""Of first rows (fit/start.py): true depth is a surface, not a cloud. Against 3DGS's own 0.1 and 1 after 300 steps on
9 path traced views at 256 px, 30,000 rows (a rover, a coffee packet): novel views 24.1 and 25.6 dB, not 23.1 and 24.7;
base views 29.2 and 29.5, not 28.1 and 28.0. 500 steps: novel 24.4 and 26.0, base 31.4 and 31.6. The asset of surfels,
whose light is approximate: novel 19.5 and 23.3."""
GROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""Backgrounds that the base views are fitted over. Over the pictures' own grey alone, rows of that grey were left
hanging beside the object, which no view told from holes."""
FUZZ = 0.3
"""How rough the asset of surfels is."""
DENSE = 4
"""Surfels per row of it, where the subject has none of its own."""


@dataclass(frozen=True)
class Asset:
    """What was built."""

    splats: Splats = field(repr=False)
    """Numpy float32, at most `setup.rows` rows."""
    seconds: float
    how: str
    """In words, for the case's facts."""


def build(what: Subject, light: Light, base: Shown, setup: Setup, way: Way = DEFAULT) -> Asset:
    """The asset of a subject in a light. base: the views that it is built from. Raises ValueError where they show
    nothing."""
    start = time.perf_counter()
    splats = _fitted(base, setup) if way == "fitted" else _thinned(what, light, setup)
    seconds = time.perf_counter() - start
    if way == "fitted":
        how = f"{len(base.pictures)} base views at true depth, then {setup.asset_steps} steps of 3DGS optimisation"
    else:
        how = "coarse surfels of the truth"
    return Asset(splats.numpy(), seconds, how)


def _fitted(base: Shown, setup: Setup) -> Splats:
    from splatpainter.fit.optimize import FitOptions, optimize
    from splatpainter.fit.start import from_depths

    cameras, colors = base.pictures.cameras, base.pictures.colors
    kind = {"opacity": OPACITY, "size": SIZE}
    start = from_depths(cameras, colors, base.depths, base.alphas, setup.rows, setup.seed, DEGREE, **kind)
    if setup.asset_steps == 0:
        return start
    views = [view for ground in GROUNDS for view in _over(base, ground)]
    return optimize(start, views, FitOptions(steps=setup.asset_steps, densify=False, seed=setup.seed)).splats


def _over(base: Shown, ground: tuple[float, float, float]) -> list[View]:
    """The base views with another background."""
    from splatpainter.fit.optimize import View

    views = []
    for camera, color, alpha in zip(base.pictures.cameras, base.pictures.colors, base.alphas, strict=True):
        change = np.subtract(ground, camera.background, dtype=np.float32)
        views.append(View(replace(camera, background=ground), color + (1 - alpha[..., None]) * change))
    return views


def _thinned(what: Subject, light: Light, setup: Setup) -> Splats:
    from splatpainter.data.lights import shade
    from splatpainter.data.surfels import coarse_asset, sample_surfels, to_splats

    dense = what.surfels
    if dense is None or len(dense) < setup.rows:
        dense = sample_surfels(what.mesh, DENSE * setup.rows, setup.seed)
    coarse = coarse_asset(dense, setup.rows, setup.seed, FUZZ)
    return to_splats(coarse, shade(coarse, light, DEGREE))
