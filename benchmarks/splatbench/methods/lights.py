"""Relit views by lights: both environments are estimated from the ratio of pictures, and what reaches each Gaussian
decides; alone, or with the painter where that is better on a part that was held back."""

from __future__ import annotations

import time

from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.methods.lift import edits_of
from splatpainter.lights.match import match_light
from splatpainter.lights.prepared import captured_light
from splatpainter.painter import Painter

UP = "+y"
"""Of the objects of benches, whose light comes from there more than from elsewhere."""


def edit(task: EditTask, budget: Budget) -> EditResult:
    """By light alone."""
    return _matched(task, None)


def edit_with_painter(task: EditTask, budget: Budget) -> EditResult:
    """By light, the lift, or both."""
    return _matched(task, Painter())


def _matched(task: EditTask, painter: Painter | None) -> EditResult:
    start = time.perf_counter()
    captured_light(task.asset, up=UP)
    ready = time.perf_counter()
    matched = match_light(task.asset, edits_of(task), painter, up=UP)
    seconds = time.perf_counter() - ready
    note = f"by {matched.chosen}"
    return EditResult(matched.asset.splats, ready - start, seconds, numbers=matched.scores, note=note)


METHODS = (
    Method("lights", "Ours (estimated lights)", edit, ("relight",)),
    Method("lights-lift", "Ours (estimated lights, lift)", edit_with_painter, ("relight",)),
)
