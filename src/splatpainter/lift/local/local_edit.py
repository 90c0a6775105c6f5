"""Local lift: an edited region of one view is written onto the Gaussians that make it; those too coarse are split.

Works on the tiles and Gaussians that the edit reaches, so a brush dab costs milliseconds.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.lift.local.patch import MIN_PIXEL_SHARE, PATCHING, Patch
from splatpainter.lift.local.split import Lattice, projected_sizes
from splatpainter.lift.options import LOCAL_DEFAULTS, LocalOptions
from splatpainter.lift.sheets.sparse_edit import EditedGaussians, SparseEdit
from splatpainter.rendering.cpu.projected_view import MaskSums, ProjectedView, project, tiles_of_mask
from splatpainter.rendering.cpu.recent_views import drawn_view
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

MIN_VISIBLE_SHARE = 0.05
"""Mean share of a Gaussian that must reach the camera inside the mask (weight / alpha), or it is behind the surface."""
NOTHING_THERE = "edit: no Gaussian contributes to the masked pixels; paint on the asset, or check the camera"
WIDE_EDIT_FRACTION = 0.4
"""An edit of a larger share of the picture's pixels than this is one of what it shows as a whole."""
CLOSE_UP_FRACTION = 0.1
"""The least share of the picture's pixels that detail of a close-up changes. Taste."""
CLOSE_UP_COVER = 0.75
"""Share of what a close-up shows of the asset from which an edit of it is one of all that. Pictures of the truth in
close-ups that the asset fills by 20 to 40 % cover 0.75 to 0.99 of it (25 of as many objects)."""
CLOSE_UP_INSIDE = 0.75
"""Share of the Gaussians that lie in a view above which it is one of the asset and no close-up. Taste."""
CLOSE_UP_SAMPLE = 16_384
"""About how many Gaussians are looked at for that."""
SOLID_ALPHA = 0.5
"""Pixels that the asset covers by more show it."""
MAX_DOUBT_WIDE = 0.8
"""Above this doubt (Evidence.doubt) about a wide edit, split or not, Gaussians are neither split nor given a detail
layer: detail that is everywhere finer than the asset, as in close-ups, would be right in this view alone. What is
painted on a part is wanted as it is, however fine."""


class NothingPaintableError(ValueError):
    """No Gaussian makes the edited pixels, or all of these lie beyond the limits of their view."""


def is_wide(mask: np.ndarray) -> bool:
    """Whether an edit of these pixels ([H, W] bool) is one of the whole picture."""
    return bool(np.count_nonzero(mask) / mask.size > WIDE_EDIT_FRACTION)


def fills_view(splats: Splats, camera: Camera, mask: np.ndarray, originals: int | None = None) -> bool:
    """Whether an edit of these pixels ([H, W] bool) is one of the whole picture, or, in a close-up, of all that it
    shows of the asset (numpy): a thin object fills little of any picture. originals: how many of its Gaussians are the
    original's (default: all); those that edits of this close-up added would make it one of the asset."""
    if is_wide(mask):
        return True
    if mask.mean() < CLOSE_UP_FRACTION:
        return False
    # The cheapest test first: most views show the whole asset.
    means = splats.means[:originals]
    some = np.ascontiguousarray(means[:: max(len(means) // CLOSE_UP_SAMPLE, 1)], np.float64)
    pixels, depths = camera.within(splats.offset).project(some)
    inside = (depths > 0) & ((pixels >= 0) & (pixels < mask.shape[::-1])).all(1)
    if inside.mean() > CLOSE_UP_INSIDE:
        return False
    solid = drawn_view(splats, camera).alphas > SOLID_ALPHA
    return bool((mask & solid).sum() > CLOSE_UP_COVER * max(int(solid.sum()), 1))


@dataclass(frozen=True)
class LocalLift:
    """Result of a local lift."""

    splats: Splats
    """N Gaussians with the old ones at their old indices, then the appended ones."""
    touched: Ids = field(repr=False)
    """[T] int64 ascending: old Gaussians of which any attribute changed."""
    parents: Ids = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from, or lies on."""


def lift_local(
    splats: Splats,
    camera: Camera,
    target: Floats,
    mask: Bools,
    options: LocalOptions = LOCAL_DEFAULTS,
    allowed: Bools | None = None,
    within: Bools | None = None,
) -> LocalLift:
    """Write the masked pixels of `target` onto the splats.

    target: [H, W, 3] float32 0..1; mask: [H, W] bool; allowed: [N] bool Gaussians that may change (default: all);
    within: [TH, TW] bool tiles of which nothing beyond is looked at.
    Raises NothingPaintableError when no Gaussian contributes to the masked pixels."""
    return _applied(local_edit(splats, camera, target, mask, options, allowed, within), splats)


def local_edit(
    splats: Splats | EditedGaussians,
    camera: Camera,
    target: Floats,
    mask: Bools,
    options: LocalOptions = LOCAL_DEFAULTS,
    allowed: Bools | None = None,
    within: Bools | None = None,
) -> SparseEdit:
    """`lift_local` as what it changes; of edited Gaussians, one more edit of these."""
    # The Gaussians in work are few; they are taken out, edited as a patch, and put back at the end.
    ids, before, patch = _split_patch(splats, camera, target, mask, options, allowed, within)
    # Detail finer than the asset in a whole picture is right in this view alone: the split is taken back.
    wide = is_wide(mask)
    if wide and patch.evidence.doubt > MAX_DOUBT_WIDE:
        patch = before
    detailed = options.rounds > 0 and options.max_error < 1 and not (wide and patch.evidence.doubt > MAX_DOUBT_WIDE)
    # Joining only where a detail layer follows, which mends what it costs.
    patch = patch.merged() if detailed else patch
    painted = patch.painted(options)
    detail = patch.detail(painted, options) if detailed else None
    return _assemble(splats, ids, painted, patch.lattice, detail)


def split_local(
    splats: Splats, camera: Camera, target: np.ndarray, mask: np.ndarray, options: LocalOptions = LOCAL_DEFAULTS
) -> LocalLift:
    """The Gaussians over which the masked change varies, split for it; the picture hardly changes. Arguments and errors
    as of `lift_local`."""
    ids, _, patch = _split_patch(splats, camera, target, mask, options)
    return _applied(_assemble(splats, ids, patch.splats, patch.lattice, None), splats)


def _applied(edit: SparseEdit, splats: Splats) -> LocalLift:
    return LocalLift(edit.apply(splats), edit.ids, edit.parents)


def _view(splats: Splats | EditedGaussians, camera: Camera, tiles: Bools) -> ProjectedView:
    """Some tiles of a view."""
    return splats.view(tiles) if isinstance(splats, EditedGaussians) else project(splats, camera, tiles=tiles)


def _split_patch(
    splats: Splats | EditedGaussians,
    camera: Camera,
    target: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions,
    allowed: np.ndarray | None = None,
    within: np.ndarray | None = None,
) -> tuple[np.ndarray, Patch, Patch]:
    """([S] int64 the Gaussians in work, them as they are, them split)."""
    # First the mask's own tiles say who makes its pixels, then all tiles that those touch are in work.
    view = _view(splats, camera, tiles_of_mask(mask))
    sums = view.mask_sums(mask, np.ones(mask.shape, bool))
    reached = _reached(view, sums[0], allowed)
    editable = reached & ~_hopeless(splats, view, sums, reached, options)
    tiles = view.touched_tiles(editable[view.gaussian_ids])  # all of them make masked pixels
    tiles = tiles if within is None else tiles & within
    view = _view(splats, camera, tiles)
    ids = np.sort(view.gaussian_ids)
    # The view of these alone is the same but for their numbers.
    part = replace(view, gaussian_ids=np.searchsorted(ids, view.gaussian_ids), num_gaussians=len(ids))
    patch = before = Patch.of(splats.take(ids), part, target, mask, editable[ids])
    for _ in range(options.max_halvings):
        # Halve until nobody's change varies over its footprint; a round sees what the last one left.
        coarse = patch.too_coarse(options)
        if not coarse.any():
            break
        patch = patch.split(coarse, options)
    return ids, before, patch


def gaussians_in_mask(
    splats: Splats,
    camera: Camera,
    mask: np.ndarray,
    allowed: Bools | None = None,
    view: ProjectedView | None = None,
    sums: MaskSums | None = None,
) -> Bools:
    """[N] bool Gaussians that visibly contribute to the masked pixels ([H, W] bool). allowed: [N] bool, the only ones
    that count; view: the splats projected onto the mask's tiles, sums: how much of each the masked pixels show there,
    if at hand. Raises NothingPaintableError where there is none."""
    view = view or project(splats, camera, tiles=tiles_of_mask(mask))
    return _reached(view, sums or view.mask_sums(mask, mask)[0], allowed)


def _reached(view: ProjectedView, sums: MaskSums, allowed: Bools | None) -> Bools:
    """`gaussians_in_mask` of a view of the mask's tiles."""
    reached = np.zeros(view.num_gaussians, bool)
    # Both are needed: one bright pixel (peak), and not only a shimmer through the surface (visible share).
    reached[view.gaussian_ids[(sums.peak > MIN_PIXEL_SHARE) & (sums.weight > MIN_VISIBLE_SHARE * sums.alpha)]] = True
    if allowed is not None:
        reached &= allowed
    if not reached.any():
        raise NothingPaintableError(NOTHING_THERE)
    return reached


def _hopeless(
    splats: Splats | EditedGaussians,
    view: ProjectedView,
    sums: tuple[MaskSums, MaskSums],
    reached: np.ndarray,
    options: LocalOptions,
) -> Bools:
    """[N] bool: reached Gaussians that would be held back in the end (large, too faint to split, mostly outside the
    mask), as far as the mask's tiles can say. Without them less of the picture is in work. sums: how much of each in
    the view the mask shows, and how much all pixels do."""
    ids, inside, everywhere = view.gaussian_ids, sums[0], sums[1].weight
    # The large faint ones at the rim would pull the whole rest of the picture into work.
    faint = (
        reached[view.gaussian_ids]
        & (inside.peak <= options.min_share)
        & (inside.weight < PATCHING.min_inside_large * everywhere)
    )
    sizes = projected_sizes(splats.geometry(ids[faint]), view.camera)
    faint[faint] = row_max(sizes) > PATCHING.large_width_goals * options.goal_px
    out = np.zeros(len(splats), bool)
    out[ids[faint]] = True
    # If that leaves nobody, the edit is theirs.
    return out if (reached & ~out).any() else np.zeros(len(splats), bool)


def _assemble(
    splats: Splats | EditedGaussians,
    ids: np.ndarray,
    new: Splats,
    lattice: Lattice,
    detail: tuple[Splats, np.ndarray] | None,
) -> SparseEdit:
    """Put a patch of the Gaussians `ids` back: `new`, as the lattice has it, slots at the indices of their parents, the
    others appended, then the detail layer."""
    # Slots first: each old index keeps a child of its own Gaussian.
    targets = ids[lattice.parent[lattice.slot]]  # [B] what the slots replace
    slots, before = new.take(np.flatnonzero(lattice.slot)), splats.take(targets)
    # A slot whose values are equal is not written: the receipt counts it as untouched.
    changed = np.zeros(len(targets), bool)
    for name in ATTRIBUTES:
        differs = getattr(slots, name) != getattr(before, name)
        changed |= differs.reshape(len(targets), -1).any(1)
    # New ones go last, in the order of the patch, then the detail layer.
    added = np.flatnonzero(~lattice.slot)
    parents, appended = ids[lattice.parent[added]], new.take(added)
    if detail is not None:
        appended = appended.append(detail[0])
        parents = np.concatenate([parents, ids[lattice.parent[detail[1]]]])
    if before.origin is not None and appended.source is not before.source:
        appended = replace(appended, origin=np.full(len(appended), -1, np.int64))
    order = np.flatnonzero(changed)[np.argsort(targets[changed], kind="stable")]
    return SparseEdit(targets[order], slots.take(order), np.zeros(0, np.int64), appended, parents)
