"""Split Gaussians that look alike once they are painted become one again.

Splitting halves whatever the paint's edge crosses, in every layer of a capture's fog: of the pieces most lie within the
paint or beside it, where their neighbours want the same colour. Those are joined, two by two, by their moments, across
the layers too: in the edited view they lie behind one another, and from other sides the one that takes their place is
as thick as the fog was. Greedy merging of mixtures by the bound of Runnalls (2007) on what a merger loses.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.rendering.profiles import EPS2D, MIN_ALPHA
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import matrix_to_quat, principal_axes, quat_to_matrix, turned


@dataclass(frozen=True)
class MergingThresholds:
    """When two Gaussians are joined into one. Measured where an entry says so, else taste."""

    max_rounds: int = 12
    """Rounds of pairs, at most."""
    min_merged_share: float = 0.01
    """There is no further round after one that joined less than this share of the Gaussians."""
    first_cell_px: float = 2.0
    """Edge of the cells in which partners are looked for in the first round, pixels."""
    cell_growth: float = 1.15
    """Factor by which that edge grows from round to round: what is joined is larger and farther apart."""
    depth_share: float = 0.5
    """Pixels across the line of sight that a pixel along it counts as in those cells."""
    blur_px: float = 0.5
    """Shapes that differ by less than this (standard deviation) do not differ. With 2 along the line of sight a tenth
    fewer Gaussians remain, and what is not painted loses 0.4 dB from other sides."""
    max_loss: float = 0.3
    """Loss of shape of a pair that is joined, nats per Gaussian; two round ones of equal size at most 1.8 widths
    apart."""
    max_cost: float = 0.1
    """Variance of the wanted colour (0..1) that joining a pair loses, summed over the pixels that show it."""
    shape_cost: float = 0.02
    """Cost of a nat of lost shape, per pixel that shows it, in the same units."""
    unseen_px: float = 0.02
    """Pixels as which hidden Gaussians count."""
    peak_overlap_loss: float = 0.15
    """What overlap costs: of a sum A of peaks at one place, A - peak_overlap_loss A^2 is left: between what Gaussians
    beside one another (split.py: 0.1) and what those behind one another (0.25) would want. Of 0.15, 0.1 and 0.25 none
    was better by more than 0.1 dB."""
    min_flatness: float = 1e-4
    """Thickness over length, at least."""


MERGING = MergingThresholds()


_CELLS = 1 << 20
"""Cells along an axis run from -_CELLS to _CELLS."""


@dataclass(frozen=True)
class _Mixture:
    """M Gaussians in picture space: x, y in pixels, and as depth fx ln(z), of which a pixel's worth is as long."""

    points: np.ndarray = field(repr=False)
    """[M, 3]"""
    covariances: np.ndarray = field(repr=False)
    """[M, 3, 3]"""
    peaks: np.ndarray = field(repr=False)
    """[M] peak alphas."""
    colors: np.ndarray = field(repr=False)
    """[M, 3] wanted in the edited view."""
    pixels: np.ndarray = field(repr=False)
    """[M] how many show each, > 0."""
    slots: Bools = field(repr=False)
    """[M] bool: no two of these are joined."""

    def __len__(self) -> int:
        return len(self.peaks)

    def areas(self) -> np.ndarray:
        """[M] of the projections, pixels over 2 pi."""
        c = self.covariances
        return np.sqrt(np.maximum((c[:, 0, 0] + EPS2D) * (c[:, 1, 1] + EPS2D) - c[:, 0, 1] ** 2, 1e-12))

    def partners(self, cell: float) -> np.ndarray:
        """[M] the one with which each is joined at the least cost, among those within about `cell` pixels; -1: none."""
        # Partners are looked for in the same and neighbouring cells, so a cell's edge is about the largest distance.
        index = np.clip(np.floor(self.points * (1, 1, MERGING.depth_share) / cell), 1 - _CELLS, _CELLS - 2).astype(
            np.int64
        )
        index += _CELLS
        keys = (index[:, 0] * 2 * _CELLS + index[:, 1]) * 2 * _CELLS + index[:, 2]
        order = np.argsort(keys, kind="stable")
        blurred = self.covariances + MERGING.blur_px**2 * np.eye(3)
        # Mass is what a Gaussian adds to the picture: peak times projected area.
        masses = self.peaks * self.areas()
        log_volumes = portable.log(_determinants(blurred))
        out = np.full(len(self), -1, np.int64)
        points, colors, pixels, slots = self.points[order], self.colors[order], self.pixels[order], self.slots[order]
        shapes = (points, blurred[order], log_volumes[order], masses[order])
        # Pairs farther apart than `limit` surely lose more than max_loss: turned down before their determinant.
        costs, limit = np.full(len(self), MERGING.max_cost), portable.exp(2 * MERGING.max_loss) - 1
        kernels.find_partners(keys[order], *shapes, colors, pixels, slots, limit, costs, out, 0, 1)
        partners = np.full(len(self), -1, np.int64)
        # Back from the order of keys to that of the mixture.
        partners[order] = np.where(out >= 0, order[out], -1)
        return partners

    def joined(self, first: np.ndarray, second: Ids) -> _Mixture:
        """Pairs (first, second: [P] int64, no index twice) joined at the first's index; the seconds left out."""
        areas = self.areas()
        masses = self.peaks * areas
        total = masses[first] + masses[second]
        share = masses[first] / total
        points, apart = self.points.copy(), self.points[second] - self.points[first]
        points[first] += (1 - share)[:, None] * apart
        covariances, peaks, colors = self.covariances.copy(), self.peaks.copy(), self.colors.copy()
        # Moments of a mixture of two: mean covariance, plus how far their means lie apart.
        spread = (share * (1 - share))[:, None, None] * apart[:, :, None] * apart[:, None, :]
        one, other = share[:, None, None], (1 - share)[:, None, None]
        covariances[first] = one * self.covariances[first] + other * self.covariances[second] + spread
        pixels, slots = self.pixels.copy(), self.slots.copy()
        pixels[first] += self.pixels[second]
        # Colours are averaged by how many pixels show each, not by mass: a hidden one must not tint a visible one.
        weight = (self.pixels[second] / pixels[first])[:, None]
        colors[first] = (1 - weight) * self.colors[first] + weight * self.colors[second]
        slots[first] |= self.slots[second]
        new = _Mixture(points, covariances, peaks, colors, pixels, slots)
        # The peak that keeps the mass, less what overlap costs in alpha compositing, which is not additive.
        height = total / new.areas()[first]
        peaks[first] = np.clip(
            height - MERGING.peak_overlap_loss * np.minimum(height, 1 / (2 * MERGING.peak_overlap_loss)) ** 2, 0, 0.999
        )
        left = np.ones(len(self), bool)
        left[second] = False
        return _Mixture(*(values[left] for values in (points, covariances, peaks, colors, pixels, slots)))


@dataclass(frozen=True)
class Merged:
    """Result of `merge`."""

    splats: Splats
    """R Gaussians; those that were joined with none have their bits."""
    source: Ids = field(repr=False)
    """[R] int64 one that each was, or was joined from: the slot, where there is one among them."""
    group: Ids = field(repr=False)
    """[S] int64 which of the R each one went into; -1: left out, as none of it is ever drawn."""


def merge(splats: Splats, camera: Camera, may: Bools, slots: Bools, colors: np.ndarray, pixels: np.ndarray) -> Merged:
    """Join some of S Gaussians. may: [S] bool, those that may be joined; slots: [S] bool, those whose index is an old
    Gaussian's: all stay, and no two are joined; colors: [S, 3] that the edited view wants of each, 0..1; pixels: [S] >=
    0 how many pixels show it."""
    count = len(splats)
    # What is never drawn and is no slot can go without a trace.
    drawn = splats.opacities >= MIN_ALPHA
    chosen = may & (drawn | slots) & (camera.to_camera(splats.means)[:, 2] > 0)
    ids = np.flatnonzero(chosen)
    group = np.arange(count)
    group[may & ~drawn & ~slots] = -1
    mixture = _picture_space(splats.take(ids), camera, colors[ids], pixels[ids] + MERGING.unseen_px, slots[ids])
    label = np.arange(len(ids))  # [C] which of the mixture each went into
    source = ids.copy()  # [M] of the mixture
    cell = MERGING.first_cell_px
    for _ in range(MERGING.max_rounds):
        if len(mixture) < 2:
            break
        # Only mutual best partners are joined, so a round's result does not depend on the order of pairs.
        partner = mixture.partners(cell)
        first = np.flatnonzero((partner >= 0) & (partner[partner] == np.arange(len(mixture))))
        first = first[first < partner[first]]
        second = partner[first]
        # Renumber: the second of each pair goes, and its label becomes the first's.
        number = np.ones(len(mixture), bool)
        number[second] = False
        number = np.cumsum(number) - 1
        number[second] = number[first]
        # A slot's index belongs to an old Gaussian and has to survive as the source.
        source[first] = np.where(mixture.slots[second], source[second], source[first])
        left = np.ones(len(mixture), bool)
        left[second] = False
        mixture, label, source = mixture.joined(first, second), number[label], source[left]
        if len(first) < MERGING.min_merged_share * len(number):
            break
        # What was joined is larger: the next partners are farther away.
        cell *= MERGING.cell_growth
    return _put_together(splats, camera, mixture, ids, label, source, group, pixels)


def _put_together(
    splats: Splats,
    camera: Camera,
    mixture: _Mixture,
    ids: np.ndarray,
    label: np.ndarray,
    source: np.ndarray,
    group: np.ndarray,
    pixels: np.ndarray,
) -> Merged:
    """ids: [C] those that might be joined, into the M of the mixture by label [C]; source: [M]; group: [S], of those
    that are none of these their index, or -1."""
    # Everything in the order of the old Gaussians, so that equal input gives equal rows.
    rest = group >= 0
    rest[ids] = False
    unjoined = np.flatnonzero(rest)
    chosen = np.concatenate([unjoined, source])
    order = np.argsort(chosen, kind="stable")
    number_of = np.empty(len(order), np.int64)
    number_of[order] = np.arange(len(order))
    group = group.copy()
    group[unjoined], group[ids] = number_of[: len(unjoined)], number_of[len(unjoined) :][label]
    out = splats.take(chosen[order])
    members = np.bincount(label, minlength=len(mixture))
    new = np.flatnonzero(members > 1)
    # Only joined ones are written; the rest keep their bits from `take`.
    at = number_of[len(unjoined) :][new]
    means, quats, scales = _world_space(mixture, new, camera)
    # SH is averaged as colours are, by how many pixels show each member.
    weight = pixels[ids] + MERGING.unseen_px
    total = np.bincount(label, weight, len(mixture))[new]
    bands = splats.sh[ids].reshape(len(ids), splats.sh.shape[1] * 3)
    sh = np.stack([np.bincount(label, weight * band, len(mixture))[new] / total for band in bands.T], 1)
    sh = sh.reshape(len(new), *splats.sh.shape[1:])
    values = {"means": means, "quats": quats, "scales": scales, "opacities": mixture.peaks[new], "sh": sh}
    written = {}
    for name, joined in values.items():
        written[name] = getattr(out, name).copy()
        written[name][at] = joined
    return Merged(replace(out, **written), chosen[order], group)


def _picture_space(
    splats: Splats, camera: Camera, colors: np.ndarray, pixels: np.ndarray, slots: np.ndarray
) -> _Mixture:
    """M Gaussians before the camera, in the picture's space."""
    turn = camera.world_to_camera[:3, :3]
    axes = turned(turn, quat_to_matrix(splats.quats.astype(np.float64)) * splats.scales[:, None, :])
    x, y, z = camera.to_camera(splats.means.astype(np.float64)).T
    # Depth as fx ln z: a step along the line of sight measures as many pixels as one across it.
    points = np.stack([x / z * camera.fx, y / z * camera.fy, camera.fx * portable.log(z)], 1)
    axes = portable.matmul(_jacobians(points, z, camera), axes)
    peaks = np.maximum(splats.opacities.astype(np.float64), 1e-6)
    covariances = portable.matmul(axes, axes.transpose(0, 2, 1))
    return _Mixture(points, covariances, peaks, colors.astype(np.float64), pixels.astype(np.float64), slots)


def _jacobians(points: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """[M, 3, 3] picture space by camera space."""
    out = np.zeros((len(z), 3, 3))
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = camera.fx / z, camera.fy / z, camera.fx / z
    out[:, 0, 2], out[:, 1, 2] = -points[:, 0] / z, -points[:, 1] / z
    return out


def _inverse_jacobians(points: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """[M, 3, 3] inverses of `_jacobians`, which are triangular."""
    out = np.zeros((len(z), 3, 3))
    out[:, 0, 0], out[:, 1, 1], out[:, 2, 2] = z / camera.fx, z / camera.fy, z / camera.fx
    out[:, 0, 2] = points[:, 0] / camera.fx * out[:, 2, 2]
    out[:, 1, 2] = points[:, 1] / camera.fy * out[:, 2, 2]
    return out


def _determinants(m: np.ndarray) -> np.ndarray:
    """[M] of symmetric matrices [M, 3, 3]."""
    xx, yy, zz, xy, xz, yz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2], m[:, 0, 1], m[:, 0, 2], m[:, 1, 2]
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)


def _world_space(mixture: _Mixture, ids: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """([K, 3] means, [K, 4] quats, [K, 3] scales) of some of the mixture."""
    points = mixture.points[ids]
    z = portable.exp(points[:, 2] / camera.fx)
    before_camera = np.stack([points[:, 0] / camera.fx * z, points[:, 1] / camera.fy * z, z], 1)
    back = _inverse_jacobians(points, z, camera)
    back = portable.matmul(camera.world_to_camera[:3, :3].T, back)
    covariances = portable.matmul(portable.matmul(back, mixture.covariances[ids]), back.transpose(0, 2, 1))
    # Numerical flatness below 0 would make no Gaussian; thinner than min_flatness says nothing in float32.
    squares, axes = principal_axes(covariances)
    scales = np.sqrt(np.maximum(squares, MERGING.min_flatness**2 * squares[:, -1:]))
    return camera.to_world(before_camera), matrix_to_quat(axes), scales
