"""Edits of most of what their views show: zoom-ins, upscaled and restyled views. All views are lifted at once.

Paint on a part of a picture is wanted as it is; what fills whole pictures is detail, which the asset mostly has already
and should only have sharper. So the Gaussians that the views show are first moved: places, sizes, turns and opacities,
in a few steps of 3DGS towards all views at once, held by views of the asset from around. Gaussians that were fine
enough for the pictures that an asset was made from are off by pixels in close-ups, and no colour mends that. Where it
explains little of the change (another light, noise) they stay where they are. Then those over which the rest of the
change varies are split, in view after view, and all that the views show take new colours, towards all pictures
together; where Gaussians were moved, with more of the close-ups' own (close_up_colors.py). Two things hold these:

- a Gaussian takes the slower steps the less of it the views show, so that what shimmers through from behind, or reaches
  out of the picture, moves little in the few rounds there are;
- small views of the asset from all around count too (`views_around`), with the edit moved there over the surface where
  they see it, and with what they show of the asset where they do not. Where Gaussians were moved, colours change with
  the direction as well (SH band 1): what is badly placed may so follow the close-ups from their side and stay as it was
  from others.

Two close-ups each, dB. Clean (4 meshes sampled into 60,000 Gaussians), novel close-ups / before and after from afar:
nothing done 26.7, without moving 29.7 / 36, with it 32.9 / 46. Fitted by 3DGS (8 meshes, 160 px), novel close-ups / the
whole object: nothing 19.0 / 23.0, without 20.9 / 22.3, with it 21.4 / 22.5, with colours that change with the direction
and the edit as views around see it (see there) 21.7 / 22.9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.kernels import portable
from splatpainter.lift.edit_views import EditView, errors_name
from splatpainter.lift.local.close_up_colors import CloseUps, sharpened
from splatpainter.lift.local.joint_colors import TargetPicture, recolored_together
from splatpainter.lift.local.local_edit import MIN_VISIBLE_SHARE, NOTHING_THERE, split_local
from splatpainter.lift.local.views_around import views_around
from splatpainter.lift.masks import box_mean
from splatpainter.lift.options import LocalOptions
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass

GEOMETRY = ("means", "scales", "quats", "opacities")


@dataclass(frozen=True)
class WideEditThresholds:
    """How far Gaussians may move and split in edits of most of a view. Measured where an entry says on what, else
    taste."""

    rate_scales: tuple[float, float] = (1.5e-2, 5e-2)
    """Per step of those that move Gaussians, at least and at most, by how far the change tells that Gaussians are badly
    sized (`_rate_of_scales`); 3DGS's 5e-3 is for 30,000 steps. Novel close-ups with the one and the other: fitted (8
    meshes) 21.69, 21.83 dB, clean (4) 33.7, 34.0; beside sharpened views of four captures 34.0, 33.4, beside graded
    ones of three 33.0, 32.3."""
    coarse_shares: tuple[float, ...] = (0.08, 0.16, 0.75, 0.9)
    """Share of the change that is coarser than the Gaussians' spacing. Below the first only detail is added to what is
    right (sharpened captures 0.01 to 0.06), above the last colours change (graded views 0.92 to 0.99): the lowest rate.
    From the second to the third the asset is wrong at its own scale (close-ups of the truth 0.12 to 0.68): the
    highest."""
    max_error_left: float = 0.75
    """Squared error in the edited views that moving Gaussians may leave, against before, else they stay. Close-ups of
    the truth: 0.05 to 0.57; noise of one pixel 0.97, of four pixels 0.79; exchanged colours 0.84."""
    width_goal_px: float = 1.4
    """Gaussians are halved until they are about this wide (standard deviation, pixels of the edited view)."""
    max_change_std: float = 0.05
    """Standard deviation of the change over a Gaussian's footprint (0..1) above which it is halved."""
    max_appended: int = 40_000
    """About how many Gaussians splitting may append for each view."""
    min_alpha: float = 0.02
    """Pixels that the asset covers by less are not its."""


WIDE_EDITS = WideEditThresholds()


@dataclass(frozen=True)
class WideLift:
    """Result of `lift_wide`."""

    splats: Splats
    """N Gaussians at their old indices, then the appended ones."""
    touched: Ids = field(repr=False)
    """[T] int64 ascending: old Gaussians of which any attribute changed."""
    parents: Ids = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from."""


def lift_wide(splats: Splats, views: Sequence[EditView], options: LocalOptions) -> WideLift:
    """Write the masked pixels of all views onto the splats together. options: `rounds` and `damping` count.

    Raises ValueError, naming the view, where no Gaussian contributes to its masked pixels."""
    lifted, close_ups = soft_lift(splats, views, options)
    result = lifted.splats
    # What Gaussians were moved for is detail of the truth, of which the rounds that views around hold leave some out.
    if close_ups is not None and options.rounds:
        result = replace(result, sh=sharpened(result, close_ups))
    return replace(lifted, splats=result, touched=changed_rows(splats, result))


def soft_lift(splats: Splats, views: Sequence[EditView], options: LocalOptions) -> tuple[WideLift, CloseUps | None]:
    """(`lift_wide` without more of the close-ups' own, None where no Gaussian was moved); `touched` is of splitting
    alone."""
    # Geometry first: badly placed Gaussians cannot be mended by colours.
    moved = _moved(splats, views)
    degree = min(splats.sh_degree, 1) if moved is not splats else 0
    # Views around hold what the close-ups do not show, drawn from the asset as it was.
    around = views_around(splats, views, directional=degree > 0)
    split = _split(moved, views)
    projected = [project(split.splats, view.camera) for view in views]
    movable = _visible(split.splats, views, projected)
    pictures = [
        TargetPicture.of(p, view.target, _solid(view), movable) for p, view in zip(projected, views, strict=True)
    ]
    # Both kinds of pictures go into one solve, each with its weight.
    further = [TargetPicture.of(project(split.splats, camera), image, use, movable) for camera, image, use in around]
    result = replace(split.splats, sh=recolored_together(split.splats, pictures, further, options, degree))
    close_ups = None
    if moved is not splats:
        before = splats.sh[np.append(np.arange(len(splats)), split.parents), 0]
        close_ups = CloseUps(views, [_solid(view) for view in views], before, movable)
    return replace(split, splats=result), close_ups


def _moved(splats: Splats, views: Sequence[EditView]) -> Splats:
    """The Gaussians that the views show, where steps of 3DGS towards all of them put them; the same colours. They stay
    where that leaves more than WIDE_EDITS.max_error_left."""
    from splatpainter.fit.edited import EditFitOptions, fit_edited

    projected, pictures, before = [project(splats, view.camera) for view in views], [], 0.0
    visible = _visible(splats, views, projected)
    if not visible.any():
        raise ValueError(NOTHING_THERE)
    coarse = 0.0
    for view, projection in zip(views, projected, strict=True):
        # Unedited pixels ask for what is there, so that moving Gaussians does not spoil them.
        image = projection.rasterize()[0]  # `view.before` may show the tiles of its mask alone
        pictures.append((view.camera, np.where(view.mask[..., None], view.edited, image)))
        before += _error(image, view)
        coarse += _coarse_error(image, view, int(visible[projection.gaussian_ids].sum()))
    # Colours stay: they are solved afterwards, when everything is in its place.
    how = EditFitOptions(attributes=GEOMETRY, rate_scales=_rate_of_scales(coarse / max(before, 1e-12)))
    moved = fit_edited(splats, splats, pictures, np.flatnonzero(visible), how)
    # Kept only if the views say that it helped; noise or another light does not.
    after = sum(_error(project(moved, view.camera).rasterize()[0], view) for view in views)
    return moved if after < WIDE_EDITS.max_error_left * before else splats


def _error(image: np.ndarray, view: EditView) -> float:
    """Sum of squared differences from the view's edited pixels."""
    return float(portable.total(_solid(view)[view.mask, None] * (image - view.edited)[view.mask] ** 2, np.float64))


def _coarse_error(image: np.ndarray, view: EditView, count: int) -> float:
    """What is left of `_error` when the change is averaged over squares of the standard deviation that is the spacing
    of the Gaussians that the view shows, `count` of them."""
    counted = (_solid(view) * view.mask)[..., None]
    spacing = float(np.sqrt(portable.total(counted, np.float64) / max(count, 1)))
    radius = max(round(np.sqrt(3) * spacing - 0.5), 1)  # a square of 2 r + 1 pixels deviates by (2 r + 1) / sqrt(12)
    radius = min(radius, min(view.mask.shape) // 2)
    mean = box_mean(counted * (view.edited - image), radius) / np.maximum(box_mean(counted, radius), 1e-6)
    return float(portable.total(counted * mean**2, np.float64))


def _rate_of_scales(coarse: float) -> float:
    """coarse: share of the change that is coarser than the Gaussians' spacing."""
    low, high = WIDE_EDITS.rate_scales
    return float(portable.interp(coarse, WIDE_EDITS.coarse_shares, (low, high, high, low)))


def _visible(splats: Splats, views: Sequence[EditView], projected: Sequence[ProjectedView]) -> Bools:
    """[N] bool: Gaussians of which some view shows more than MIN_VISIBLE_SHARE."""
    visible = np.zeros(len(splats), bool)
    for view, projection in zip(views, projected, strict=True):
        sums = projection.backproject(view.edited, _solid(view))
        visible[projection.gaussian_ids[sums.weight > MIN_VISIBLE_SHARE * sums.alpha]] = True
    return visible


def _solid(view: EditView) -> Floats:
    """[H, W] float32: 1 where the picture is the asset's."""
    if view.alpha is None:
        return np.ones(view.mask.shape, np.float32)
    return (np.asarray(view.alpha) > WIDE_EDITS.min_alpha).astype(np.float32)


def _split(splats: Splats, views: Sequence[EditView]) -> WideLift:
    """The Gaussians over which the change of any view varies, split; colours are as they were."""
    options = LocalOptions(
        goal_px=WIDE_EDITS.width_goal_px, tolerance=WIDE_EDITS.max_change_std, max_appended=WIDE_EDITS.max_appended
    )
    count = len(splats)
    ancestry, touched = np.arange(count), np.zeros(count, bool)
    for view in views:
        with errors_name(view.name):
            part = split_local(splats, view.camera, view.target, view.mask, options)
        # Gaussians split twice name the asset's Gaussian, not the piece in between.
        old = ancestry[part.touched]
        touched[old[part.touched < count]] = True
        ancestry = np.append(ancestry, ancestry[part.parents])
        splats = part.splats
    return WideLift(splats, np.flatnonzero(touched), ancestry[count:])
