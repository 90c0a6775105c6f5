"""What edited views say of each Gaussian: painted, shown and not painted, or not shown; and whether the paint ends
where the material does, or in the middle of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.color import oklab, to_display
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.spread.descriptors import UNITS
from splatpainter.spread.soft_edges import well_covered
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ExampleThresholds:
    """Which Gaussians are examples of painted and unpainted material. Source: taste, tried on 14 training meshes."""

    min_seen_px: float = 0.1
    """Pixels' worth of a Gaussian that views must show before it is an example."""
    min_visibility: float = 0.1
    """Share of it that nothing hides, over the pixels where it lies."""
    max_weight_px: float = 20.0
    """A large Gaussian must not outvote a hundred small ones."""
    positive: float = 0.7
    """Share of what views show of a Gaussian from which it counts as painted."""
    negative: float = 0.2
    """Share up to which it counts as not painted."""
    border_px: int = 4
    """Radius of the windows on both sides of the paint's edge that are compared, pixels."""
    same_material: float = 0.8
    """Distance of their mean colours, in units of descriptors, up to which both sides are of one material."""
    max_step_px: float = 25.0
    """Step in depth across the edge from which the other side is another surface, pixels' worth of length."""
    min_open_share: float = 0.1
    """Least open share of the paint's edge, from which the paint ends in the middle of a material."""


EXAMPLES = ExampleThresholds()


@dataclass(frozen=True)
class Examples:
    """Which of M Gaussians are examples of the painted material, and which are not."""

    positive: Bools = field(repr=False)
    """[M] bool: painted in some view."""
    negative: Bools = field(repr=False)
    """[M] bool: shown and not painted by a view whose paint ends where the material does; of a partial edit by any."""
    weights: Floats = field(repr=False)
    """[M] float64 pixels that show each, capped."""
    is_partial: bool
    """Whether the paint of every view ends in the middle of the material: what is not painted is no counterexample
    then."""

    @staticmethod
    def of(splats: Splats, views: Sequence[EditView]) -> Examples:
        """splats: numpy, all drawable. Raises ValueError: nothing is painted that can be told, or nothing else is
        shown."""
        count = len(splats)
        visible_px, alpha = np.zeros(count), np.zeros(count)
        positive, complete, other = (np.zeros(count, bool) for _ in range(3))
        for view in views:
            projected = project(splats, view.camera)
            ids, black = projected.gaussian_ids, np.zeros_like(view.edited)
            # How much of each Gaussian the view shows, and how much of that is painted.
            everywhere = projected.backproject(black, np.ones(view.mask.shape, np.float32))
            painted = projected.backproject(black, view.mask.astype(np.float32)).weight
            # A faint edge says neither that this is the material nor that it is not.
            well = well_covered(view)
            thick = painted if well is view.mask else projected.backproject(black, well.astype(np.float32)).weight
            visible_px[ids] += everywhere.weight
            alpha[ids] += everywhere.alpha
            visible = (everywhere.weight > EXAMPLES.min_seen_px) & (
                everywhere.weight > EXAMPLES.min_visibility * everywhere.alpha
            )
            share, thick_share = (weight / np.maximum(everywhere.weight, 1e-9) for weight in (painted, thick))
            positive[ids[visible & (thick_share > EXAMPLES.positive)]] = True
            # Unpainted counts against the material only if the paint ends where the material ends.
            unpainted = ids[visible & (share < EXAMPLES.negative)]
            (other if open_share(view, splats) >= EXAMPLES.min_open_share else complete)[unpainted] = True
        is_partial = not (complete & ~positive).any()
        negative = (other if is_partial else complete) & ~positive
        if not positive.any():
            raise ValueError("edit: spread: the paint covers no Gaussian; paint a larger part of the material")
        if not negative.any():
            raise ValueError(
                "edit: spread: all that the views show was edited, so nothing says what is another material; use mode "
                "global, or leave something unpainted"
            )
        # What is half hidden behind others is a poor example of what it looks like.
        visibility = visible_px / np.maximum(alpha, 1e-9)
        weights = np.minimum(visible_px, EXAMPLES.max_weight_px) * np.minimum(2 * visibility, 1)
        return Examples(positive, negative, weights, is_partial)


def open_share(view: EditView, splats: Splats) -> float:
    """0..1 part of the paint's edge that has the same material on its other side."""
    assert view.alpha is not None and view.depth is not None
    lab = oklab(to_display(np.clip(view.before, 0, 1), splats.color_space).reshape(-1, 3)).reshape(view.before.shape)
    units = np.concatenate(
        [lab[..., :1] / UNITS.lightness, lab[..., 1:] / (lab[..., :1] + UNITS.chroma_lightness_offset) / UNITS.chroma],
        2,
    )
    values = np.concatenate([units, view.depth[..., None]], 2).astype(np.float32)
    solid = view.alpha > 0.9
    # Two pixels off the edge on both sides: the edge itself is a mixture.
    inside = solid & np.logical_not(dilated(~view.mask, 2))
    outside = solid & ~dilated(view.mask, 2)
    inside_mean, inside_share = _mean_within(values, inside)
    outside_mean, outside_share = _mean_within(values, outside)
    edge = view.mask & dilated(~view.mask, 1) & (inside_share > 0.1)
    both = edge & (outside_share > 0.1)
    same = np.linalg.norm(inside_mean[..., :3] - outside_mean[..., :3], axis=2) < EXAMPLES.same_material
    # A step in depth is another surface, whatever its colour.
    step = np.abs(inside_mean[..., 3] - outside_mean[..., 3]) < EXAMPLES.max_step_px * view.depth / view.camera.fx
    return float((both & same & step).sum() / max(edge.sum(), 1))


def _mean_within(values: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, C] mean of values over the chosen pixels of each window, [H, W] their share of it)."""
    share = box_mean(chosen.astype(np.float32), EXAMPLES.border_px)
    return box_mean(values * chosen[..., None], EXAMPLES.border_px) / np.maximum(share, 1e-6)[..., None], share
