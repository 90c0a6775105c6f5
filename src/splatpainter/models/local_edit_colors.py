"""A local edit's colours by the local network: what it says of the Gaussians that the lift has laid out, held against
what the picture says of them.

The picture does not determine their colours: many lie under one pixel, and what one view makes of those at grazing
angles other views pay for. The lift lets the old colour decide where the picture does not; here the network does. From
its answer the lift's own rounds start, held to it the more the surer it is: damped least squares, in which a pixel
counts as a measurement of its variance and the network's answer as one of its own. J Gaussians.

A close-up shows parts of many Gaussians, and what it does not show of them other views do: there the answer counts by
the share that is shown, and the lift's, which views from around have held, for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np
import torch

from splatpainter.color import base_color
from splatpainter.lift.colors import MAX_COLOR, lift_colors
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.edits import LiftedEdit
from splatpainter.lift.local.evidence import footprints
from splatpainter.lift.local.local_edit import fills_view
from splatpainter.models.local_network import LocalNetwork, Patches, Readers
from splatpainter.models.picture_patches import PatchReaders, PatchTokens, cosine_basis, picture_regions
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class HeldColorThresholds:
    """How the network's answer is held against the pictures. Measured where an entry says on what, else taste."""

    pixel_variance: float = 2.5e-4
    """Of a pixel as a measurement of the colours that make it: (4 levels of 255)^2."""
    hold: tuple[float, float] = (0.01, 1.0)
    """Pixels' worth of weight that the network's answer has, at least and at most."""
    rounds: int = 12
    """Rounds of colours from the network's answer."""
    min_change: float = 1 / 1024
    """Colours that move by no more than this keep their bits."""
    hold_hidden: float = 0.05
    """Pixels' worth of weight, per pixel of a Gaussian that a close-up hides, that its colour has there. 20 zoom-ins of
    training objects, views near them / of the whole / edited: the lift 26.27 / 27.49 / 36.0 dB, the network without
    shares and hidden pixels 26.18 / 26.90 / 38.0, with shares and 0: 26.38 / 27.37 / 38.3, 0.05: 26.41 / 27.49 / 37.5,
    0.2: 26.39 / 27.51 / 36.8."""


HELD_COLORS = HeldColorThresholds()


@dataclass(frozen=True)
class NetworkColors:
    """What the network says of a lifted edit."""

    colors: np.ndarray = field(repr=False)
    """[J, 3] float32 0..MAX_COLOR, towards the view."""
    variance: np.ndarray = field(repr=False)
    """[J] float32 of a channel; infinite where no picture was read."""


def network_colors(
    network: LocalNetwork, asset: Splats, lifted: LiftedEdit, views: Sequence[EditView], strength: float | None = None
) -> NetworkColors:
    """Each view teaches and is asked alone, and of several the answers are weighed by how sure each is. asset: before
    the edit, numpy. Raises ValueError as `picture_regions`."""
    count = len(lifted.ids)
    # Weighed by how sure each view is: of a Gaussian that one shows from the front it knows best.
    total, weight = np.zeros((count, 3)), np.zeros(count)
    for view in views:
        for region in picture_regions(asset, lifted, view):
            if not len(region.index):
                continue
            with torch.no_grad():
                patches = patches_of(region.tokens)
                state = network.adapt(network.initial_state(), patches, strength)
                answer = network.read(state, readers_of(region.readers), strength)
            sure = np.exp(-answer.log_variance.numpy().astype(np.float64))
            total[region.index] += sure[:, None] * answer.colors.numpy()
            weight[region.index] += sure
    # Gaussians that no picture was read for keep the lift's colours: their variance says so.
    read = weight > 0
    colors = np.where(read[:, None], total / np.maximum(weight, 1e-9)[:, None], 0).astype(np.float32)
    variance = np.where(read, 1 / np.maximum(weight, 1e-9), np.inf).astype(np.float32)
    return NetworkColors(np.clip(colors, 0, MAX_COLOR), variance)


def repainted(
    network: LocalNetwork, asset: Splats, lifted: LiftedEdit, views: Sequence[EditView], originals: int | None = None
) -> LiftedEdit:
    """A lifted edit in the network's colours, held against the pictures: what `Painter.apply` makes of it. asset:
    before the edit, numpy; originals: how many of its Gaussians are the original's (default: all)."""
    count = len(asset) if originals is None else originals
    return applied(lifted, network_colors(network, asset, lifted, views), views, count)


def applied(
    lifted: LiftedEdit, answer: NetworkColors, views: Sequence[EditView], originals: int | None = None
) -> LiftedEdit:
    """The lifted edit as an answer changes it: `held`, and of close-ups (views whose whole content is edited) only
    as far as they show each Gaussian. originals: as of `fills_view`."""
    if not all(fills_view(lifted.splats, view.camera, view.mask, originals) for view in views):
        return held(lifted, answer, views)
    parts = [_visible_part(lifted, view) for view in views]
    share = np.max([visible for visible, _ in parts], 0)[:, None]
    before = base_color(lifted.splats.sh[lifted.ids])
    colors = np.where(np.isfinite(answer.variance)[:, None], before + share * (answer.colors - before), before)
    answer = replace(answer, colors=colors.astype(np.float32))
    return held(lifted, answer, views, hidden=[hidden for _, hidden in parts])


def _visible_part(lifted: LiftedEdit, view: EditView) -> tuple[np.ndarray, np.ndarray]:
    """([J] share of each Gaussian, were nothing before it, that the edited pixels show; [J] pixels' worth of it that
    the picture does not show)."""
    projected, count = project(lifted.splats, view.camera), len(lifted.splats)
    everywhere, inside = (
        projected.backproject(np.zeros_like(view.before), mask.astype(np.float32)).weight
        for mask in (np.ones_like(view.mask), view.mask)
    )
    footprint = footprints(projected)
    share, hidden = np.zeros(count), np.zeros(count)
    share[projected.gaussian_ids] = np.minimum(inside / np.maximum(footprint, 1e-6), 1)
    hidden[projected.gaussian_ids] = np.maximum(footprint - everywhere, 0)
    return share[lifted.ids], hidden[lifted.ids]


def with_colors(lifted: LiftedEdit, answer: NetworkColors) -> LiftedEdit:
    """The lifted edit with the network's colours in place of the lift's."""
    sh = lifted.splats.sh.copy()
    read = np.isfinite(answer.variance)
    ids = lifted.ids[read]
    new = ((answer.colors[read] - 0.5) / SH_C0).astype(sh.dtype)
    # Colours that hardly move keep their bits, so that receipts do not name them.
    moved = np.abs(new - sh[ids, 0]).max(1) * SH_C0 > HELD_COLORS.min_change if len(ids) else np.zeros(0, bool)
    sh[ids[moved], 0] = new[moved]
    return replace(lifted, splats=replace(lifted.splats, sh=sh))


def held(
    lifted: LiftedEdit,
    answer: NetworkColors,
    views: Sequence[EditView],
    rounds: int = HELD_COLORS.rounds,
    hidden: Sequence[np.ndarray] = (),
) -> LiftedEdit:
    """The lifted edit in the network's colours, after rounds of the lift that are held to them. Of several views the
    later ones win. hidden: for each view [J] pixels' worth of each Gaussian that it does not show, which count
    HELD_COLORS.hold_hidden; none: 0."""
    result, count = with_colors(lifted, answer), len(lifted.splats)
    # The surer the network is, the more pixels it takes to move its answer; it is never deaf to them.
    sure = np.clip(HELD_COLORS.pixel_variance / np.maximum(answer.variance, 1e-9), *HELD_COLORS.hold)
    editable = np.zeros(count, bool)
    editable[lifted.ids] = True
    for k, view in enumerate(views):
        hold = np.zeros(count, np.float32)
        hold[lifted.ids] = sure + HELD_COLORS.hold_hidden * (hidden[k] if hidden else 0)
        splats = result.splats
        tiles = project(splats, view.camera, gaussian_mask=editable).tiles_of(editable)
        seen = project(splats, view.camera, tiles=tiles)
        target, ids = view.target, seen.gaussian_ids
        everywhere = np.ones(target.shape[:2], np.float32)
        # Towards the whole picture, as what does not change covers what does.
        colors = lift_colors(seen, target, everywhere, editable[ids], rounds, hold[ids])
        change = colors - np.maximum(seen.unclamped_colors, 0)
        moved = editable[ids] & (np.abs(change).max(1) > HELD_COLORS.min_change)
        sh = splats.sh.copy()
        sh[ids[moved], 0] += (change[moved] / SH_C0).astype(sh.dtype)
        result = replace(result, splats=replace(splats, sh=sh))
    return result


def patches_of(tokens: PatchTokens, device: str | torch.device = "cpu") -> Patches:
    """A region's patches as tensors."""
    return Patches(torch.from_numpy(tokens.cells).to(device), torch.from_numpy(tokens.values).to(device))


def readers_of(readers: PatchReaders, device: str | torch.device = "cpu") -> Readers:
    """A region's Gaussians as tensors."""
    arrays = (readers.cells, cosine_basis(readers.inside), readers.facts, readers.before)
    return Readers(*(torch.from_numpy(x).to(device) for x in arrays))
