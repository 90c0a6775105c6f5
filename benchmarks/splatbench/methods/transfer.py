"""Colour transfer: relighting as a change of colours learnt from the relit views alone, without any network.

Three rows, from stiff to loose: one affine map of display colours for the whole asset; one per cluster of rows; and
every row by itself, where rows that no view shows keep their colours. Stand-ins for methods that estimate the target
light (reference: Reinhard et al., "Color Transfer between Images", 2001, for the idea), cheap, and strong at one view.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from splatbench.methods import Budget, Done, Method, Work

if TYPE_CHECKING:
    from splatbench.methods.transfer_affine import Shown
    from splatpainter.splats import Splats

CLUSTERS = 32
RIDGE = 0.05
"""Pull of each cluster's map towards the one of the whole asset, in parts of the pixels per cluster."""
ROUNDS = 5
"""Closed-form steps of all rows at once."""
DAMPING = 0.3
"""Of SH bands >= 1 in the per-row fit: few views cannot know view dependence."""
DEGREE = 3

Fit = Callable[["Splats", "list[Shown]", int], "tuple[Splats, dict[str, float]]"]
"""(asset, views, seed) -> (recoloured asset, numbers)."""


def affine(splats: Splats, views: list[Shown], seed: int) -> tuple[Splats, dict[str, float]]:
    """One 3 x 4 map for all rows."""
    from splatbench.methods.transfer_affine import fit_affine, recolored

    return recolored(splats, fit_affine(views)[None]), {}


def clusters(splats: Splats, views: list[Shown], seed: int) -> tuple[Splats, dict[str, float]]:
    """One map per cluster of rows alike in colour, place and normal."""
    from splatbench.methods.transfer_affine import fit_clusters, recolored
    from splatbench.methods.transfer_clusters import kmeans, row_features

    labels = kmeans(row_features(splats), CLUSTERS, seed)
    maps, seen = fit_clusters(views, labels, RIDGE)
    numbers = {"clusters": float(len(maps)), "clusters_seen": float((seen > 1).sum())}
    return recolored(splats, maps, labels), numbers


def rows(splats: Splats, views: list[Shown], seed: int) -> tuple[Splats, dict[str, float]]:
    """Every row that the views show, by itself."""
    from splatbench.methods.transfer_rows import fit_rows

    fitted, seen = fit_rows(splats, views, ROUNDS, DAMPING, DEGREE)
    return fitted, {"rows_seen": float(seen.sum())}


def edit(fit: Fit, note: str, work: Work, budget: Budget) -> Done:
    """Recolour the asset by its edited views. Raises ValueError for a local edit, and where no masked pixel shows the
    asset."""
    from splatbench.methods.transfer_affine import shown

    if work.step.mode != "global":
        raise ValueError(f"colour transfer: is for global edits, got a {work.step.mode} one ({work.step.kind})")
    start = time.perf_counter()
    splats, numbers = fit(work.asset, shown(work.asset, work.step), budget.seed)
    seconds = time.perf_counter() - start
    return Done(splats, 0.0, seconds, numbers=numbers, note=note)


def _method(name: str, label: str, fit: Fit, note: str, settings: str) -> Method:
    return Method(
        name=name,
        label=label,
        edit=partial(edit, fit, note),
        protocols=("relight",),
        version=lambda _: settings,
    )


METHODS = (
    _method(
        "transfer-affine",
        "Colour transfer, one affine map",
        affine,
        "one affine map of display colours, least squares on all masked pixels; SH bands >= 1 by its linear part",
        "1",
    ),
    _method(
        "transfer-clusters",
        f"Colour transfer, {CLUSTERS} clusters",
        clusters,
        f"an affine map for each of {CLUSTERS} clusters (k-means on colour, position, normal), solved together, "
        f"ridge {RIDGE:g} towards the one map of the whole asset, which clusters out of view get",
        f"1-{CLUSTERS}-{RIDGE:g}",
    ),
    _method(
        "transfer-rows",
        "Colour transfer, row by row",
        rows,
        f"least squares per row, {ROUNDS} closed-form rounds, SH bands >= 1 damped by {DAMPING:g}; rows out of view "
        "keep their colours",
        f"1-{ROUNDS}-{DAMPING:g}-{DEGREE}",
    ),
)
