"""Drafts: what an edit wants of an asset before the network has its say, and how both become one asset again.

    views = edit_views(splats, cameras, targets, masks)
    draft = draft_local(splats, grid, views, base)         or draft_global(splats, views, base)
    state, rows, further = refine_draft(model, state, encoded, draft, views)
    edited = assemble(draft, rows, further)

With base "own" the residual is on the row's own attributes, and a draft changes nothing. With base "lift" the draft is
the analytic lift's answer, split and appended rows included, and the residual is on that. So an untrained network
returns the asset, or the lift, bit for bit. N rows of the asset, A appended by the lift, J chosen rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.models.color_refine import polish_local
from splatpainter.models.config import Base
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from splatpainter.voxels.grid import VoxelGrid, voxelize

if TYPE_CHECKING:
    from splatpainter.lift.global_edit import GlobalOptions, Predict
    from splatpainter.lift.local_edit import LocalOptions
    from splatpainter.models.encode import Encoded
    from splatpainter.models.image_tokens import Pictures
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState

TOLD_ROUNDS = 4
"""Colour rounds behind the lift features of base "own": a hint, and half of what a lift would cost."""
SAME_PART = 0.3
"""Share of a view's rows from which a later one counts as showing the same part. On 20 painted training meshes with 2
to 4 edited views, near them: 26.4 dB with a detail layer per view, 27.3 with one for the last; in the edited views 29.0
and 29.5."""
HALF_SEEN = 2.0
"""Pixels of weight at which a row counts as half seen (as GlobalOptions.half_seen)."""


@dataclass(frozen=True)
class EditView:
    """One edited picture with what the asset shows there now. `edit_views` makes them (of any sizes; the network wants
    one)."""

    camera: Camera
    target: np.ndarray = field(repr=False)
    """[H, W, 3] float32 the edited picture, 0..1."""
    mask: np.ndarray = field(repr=False)
    """[H, W] bool pixels that were edited."""
    before: np.ndarray = field(repr=False)
    """[H, W, 3] float32 render of the asset."""
    depth: np.ndarray | None = field(default=None, repr=False)
    """[H, W] float32 its expected z-depth, 0 where there is nothing; for models whose pictures hold "geometry"."""
    alpha: np.ndarray | None = field(default=None, repr=False)
    """[H, W] float32 its alpha; likewise."""
    name: str = "edit"
    """What errors call it."""

    @property
    def wanted(self) -> np.ndarray:
        """[H, W, 3] the whole picture to reach: the edited one inside the mask, the render outside."""
        return np.where(self.mask[..., None], self.target, self.before)


@dataclass(frozen=True)
class Draft:
    """What the network's residual is added to."""

    splats: Splats
    """Numpy, N + A rows: the asset (base "own") or the lift's answer (base "lift"; global: A = 0)."""
    rows: np.ndarray = field(repr=False)
    """[J] int64 rows of `splats` that the network may change."""
    parents: np.ndarray = field(repr=False)
    """[J] int64 the asset's row whose latent each of them reads: itself, or the row that it was split from."""
    lift: np.ndarray = field(repr=False)
    """[J, 13] float32: base colour before and after the lift, how much was seen, base colour that a global lift's
    regression predicts (0..1 each), unit normal, outwards or towards the edited views."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N] float32 0..1, of a global lift: seen (1) or predicted (towards 0)."""
    detail: bool = False
    """Whether the network's second set is wanted (local, base "own": with "lift" the children are the lift's)."""

    def owners(self, count: int) -> np.ndarray:
        """[N + A] int64 the asset's row that each row of `splats` is or was split from. count: N."""
        return np.append(np.arange(count), self.parents[self.rows >= count])


def edit_views(
    splats: Splats, cameras: Sequence[Camera], targets: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> list[EditView]:
    """Edited pictures with the asset rendered from their cameras. splats: numpy or torch; targets: [H, W, 3] float
    each; masks: [H, W] bool each."""
    from splatpainter.rendering import render

    own, views = splats.numpy(), []
    for camera, target, mask in zip(cameras, targets, masks, strict=True):
        drawn = render(own, camera)
        seen = (drawn.colors[0], drawn.depths[0, ..., 0], drawn.alphas[0, ..., 0])
        views.append(EditView(camera, np.ascontiguousarray(target, np.float32), np.asarray(mask, bool), *seen))
    return views


def draft_local(
    splats: Splats,
    grid: VoxelGrid,
    views: Sequence[EditView],
    base: Base,
    options: LocalOptions | None = None,
    *,
    features: bool = True,
) -> Draft:
    """Rows that visibly make the edited pixels; later views win. splats: numpy, N rows; grid: its voxels; options: of
    the lift; features: False leaves `lift` zero, for models that do not read it. Raises ValueError, naming the view,
    where an edit reaches no row."""
    from splatpainter.lift.local_edit import LocalOptions

    options = options or LocalOptions()
    if base == "lift":
        lifted, rows, owners = _lifted(splats, grid, views, options)
        told = _local_features(splats, lifted, rows, owners, views) if features else _nothing(rows)
        return Draft(lifted, rows, owners, told)
    reached = rows_reached(splats, grid, views)
    rows = np.flatnonzero(reached)
    told = _nothing(rows)
    if features:
        pictures = [(view.camera, view.wanted) for view in views]
        painted = polish_local(splats, pictures, reached, min(options.rounds, TOLD_ROUNDS))
        told = _local_features(splats, painted, rows, rows, views)
    return Draft(splats, rows, rows, told, detail=True)


def draft_global(
    splats: Splats,
    views: Sequence[EditView],
    base: Base,
    options: GlobalOptions | None = None,
    *,
    features: bool = True,
    normals: np.ndarray | None = None,
    predict: Predict | None = None,
) -> Draft:
    """All rows that can be drawn. splats: numpy, N rows; options and features: as in `draft_local`; normals and
    predict: as in `lift_global`. Raises ValueError, naming the views, where they show no solid part of it."""
    from splatpainter.lift.global_edit import GlobalOptions, lift_global

    rows = np.flatnonzero(splats.drawable)
    if base == "own" and not features:
        return Draft(splats, rows, rows, _nothing(rows))
    with errors_name(", ".join(dict.fromkeys(view.name for view in views))):
        shown = [(v.camera, v.target, v.mask) for v in views]
        lift = lift_global(splats, shown, options or GlobalOptions(), normals, predict)
    told = _nothing(rows)
    if features:
        further = (lift.seen[rows, None], np.clip(lift.predicted[rows], 0, 1), lift.normals[rows])
        told = np.concatenate([_colors(splats, rows), _colors(lift.splats, rows), *further], 1, dtype=np.float32)
    return Draft(lift.splats if base == "lift" else splats, rows, rows, told, lift.confidence)


def refine_draft(
    model: SplatPainterModel, state: RefineState, encoded: Encoded, draft: Draft, views: Sequence[EditView]
) -> tuple[RefineState, Splats, Splats | None]:
    """Stage II and the decoder: (next state, J torch rows in place of draft.splats[draft.rows], J further rows to
    append, each belonging to the row of its place, or None). state: model.initial_state() for the first edit;
    draft.parents count rows of encoded.rows. Differentiable in the model's parameters and in the latents; without
    gradients in chunks. Raises ValueError for views of several sizes or without depth and alpha where the model needs
    them, and for rows that were not encoded."""
    import torch

    from splatpainter.models.gaussian_groups import drift_features

    config = model.config.refine
    device = encoded.latents.values.device
    places = encoded.places[draft.parents]
    if (places < 0).any():
        raise ValueError(f"refine: {int((places < 0).sum())} of the {len(places)} rows were not encoded; encode again")
    base = draft.splats.take(draft.rows).torch(str(device))
    drift = None
    if config.base == "lift":
        drift = drift_features(base, encoded.rows.take(draft.parents), encoded.latents.groups.voxel)
    state, decoded = model.edit(
        state,
        encoded.latents,
        _pictures(views, str(device)),
        encoded.rows,
        places=places,
        lift=torch.from_numpy(draft.lift).to(device) if config.lift_features else None,
        drift=drift,
        base=base,
        detail=draft.detail and config.detail,
    )
    further = decoded.further
    return state, decoded.splats, further if further is not None and len(further) else None


def assemble(draft: Draft, rows: Splats, further: Splats | None) -> Splats:
    """The whole edited asset: N + A rows with `rows` (J, torch) in the places draft.rows, then `further`. Torch, on
    their device and differentiable, where `rows` need gradients; else numpy, where numbers that did not change keep
    their bits, and attributes of which none changed their array."""
    if any(getattr(rows, name).requires_grad for name in ATTRIBUTES):
        import torch

        device = rows.means.device
        whole, index = draft.splats.torch(str(device)), torch.from_numpy(draft.rows).to(device)
        changed = {name: getattr(whole, name).index_copy(0, index, getattr(rows, name)) for name in ATTRIBUTES}
        result = replace(whole, **changed)
        return result if further is None else result.append(further)
    own, written = rows.numpy(), {}
    for name in ATTRIBUTES:
        old, new = getattr(draft.splats, name), getattr(own, name)
        if not np.array_equal(new.view(np.int32), old[draft.rows].view(np.int32)):
            written[name] = old.copy()
            written[name][draft.rows] = new
    result = replace(draft.splats, **written) if written else draft.splats
    return result if further is None else result.append(further.numpy())


def rows_reached(splats: Splats, grid: VoxelGrid, views: Sequence[EditView]) -> np.ndarray:
    """[N] bool rows in voxels that edited pixels show, and that really contribute to these pixels, of any view. Raises
    ValueError, naming the view, for one without such rows."""
    from splatpainter.lift.local_edit import reached_rows
    from splatpainter.voxels.raycast import editable_rows

    reached = np.zeros(len(splats), bool)
    for view in views:
        with errors_name(view.name):
            allowed = editable_rows(grid, splats, view.camera, view.mask)
            reached |= reached_rows(splats, view.camera, view.mask, allowed)
    return reached


@contextmanager
def errors_name(name: str) -> Iterator[None]:
    """Among several edits, the one that is wrong is named."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {str(error).removeprefix('edit: ')}") from None


def _lifted(
    splats: Splats, grid: VoxelGrid, views: Sequence[EditView], options: LocalOptions
) -> tuple[Splats, np.ndarray, np.ndarray]:
    """One view after the other, each on the result of those before: (N + A rows, [J] those that were changed or
    appended, [J] rows of `splats` that they come from). A view gets no detail layer where a later one shows the same
    part: from another side its rows stand in the way (SAME_PART)."""
    from splatpainter.lift.local_edit import lift_local
    from splatpainter.voxels.raycast import editable_rows

    owners, changed = np.arange(len(splats)), np.zeros(len(splats), bool)
    again = _shown_again(splats, grid, views)
    for k, view in enumerate(views):
        with errors_name(view.name):
            grid = grid if k == 0 else voxelize(splats, grid.resolution)
            allowed = editable_rows(grid, splats, view.camera, view.mask)
            how = replace(options, detail=1.0) if again[k] else options
            lifted = lift_local(splats, view.camera, view.target, view.mask, how, allowed)
        changed[lifted.touched] = True
        changed = np.append(changed, np.ones(len(lifted.appended), bool))
        owners = np.append(owners, owners[lifted.appended])
        splats = lifted.splats
    rows = np.flatnonzero(changed)
    return splats, rows, owners[rows]


def _shown_again(splats: Splats, grid: VoxelGrid, views: Sequence[EditView]) -> list[bool]:
    """For each view, whether a later one edits SAME_PART of the rows that it edits."""
    if len(views) == 1:
        return [False]
    parts = [rows_reached(splats, grid, [view]) for view in views]
    return [
        any((part & later).sum() > SAME_PART * part.sum() for later in parts[k + 1 :]) for k, part in enumerate(parts)
    ]


def _seen(splats: Splats, views: Sequence[EditView]) -> np.ndarray:
    """[N] float32 0..1: how much of each row the edited pixels show; HALF_SEEN pixels of weight are a half."""
    from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask

    weight = np.zeros(len(splats), np.float32)
    for view in views:
        frame = project(splats, view.camera, tiles=tiles_of_mask(view.mask))
        sums = frame.backproject(np.zeros_like(view.target), view.mask.astype(np.float32))
        weight[frame.gaussian_ids] += sums.weight
    return weight / (weight + HALF_SEEN)


def _local_features(
    before: Splats, after: Splats, rows: np.ndarray, parents: np.ndarray, views: Sequence[EditView]
) -> np.ndarray:
    """[J, 13]: nothing is predicted, so that is the colour after; normals look at the middle of the cameras. rows: [J]
    of `after`; parents: [J] of `before`."""
    from splatpainter.lift.split import rotations

    new = _colors(after, rows)
    turns = rotations(np.ascontiguousarray(after.quats[rows]))
    normals = turns[np.arange(len(rows)), :, after.scales[rows].argmin(1)]
    towards = np.mean([view.camera.position for view in views], axis=0) - after.means[rows]
    normals = np.where(np.einsum("ni,ni->n", normals, towards)[:, None] < 0, -normals, normals)
    parts = (_colors(before, parents), new, _seen(after, views)[rows, None], new, normals)
    return np.concatenate(parts, 1, dtype=np.float32)


def _colors(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """[J, 3] base colours, within 0..1."""
    return np.clip(0.5 + SH_C0 * splats.sh[rows, 0], 0, 1)


def _nothing(rows: np.ndarray) -> np.ndarray:
    return np.zeros((len(rows), 13), np.float32)


def _pictures(views: Sequence[EditView], device: str) -> Pictures:
    """Raises ValueError for views of several sizes."""
    import torch

    from splatpainter.models.image_tokens import Pictures, one_size

    cameras = [view.camera for view in views]
    one_size(cameras)

    def stacked(name: str) -> torch.Tensor | None:
        images = [getattr(view, name) for view in views]
        if any(image is None for image in images):
            return None
        whole = torch.from_numpy(np.stack(images).astype(np.float32)).to(device)
        return whole if whole.ndim == 4 else whole[..., None]

    edited = stacked("wanted")  # outside the mask a picture may differ by how it was stored or scaled
    assert edited is not None
    return Pictures(cameras, edited, *(stacked(name) for name in ("before", "depth", "alpha", "mask")))
