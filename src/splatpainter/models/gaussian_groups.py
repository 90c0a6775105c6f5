"""Gaussians as Stage I sees them: grouped by voxel, described by their attributes, tied to tokens of the LRM.

Knows no network. N Gaussians of the asset, M in groups (packed), B groups (voxels), P LRM tokens (patches of all
canonical views), S links and A features per Gaussian.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class GaussianGroups:
    """Which Gaussians share a voxel: packed, group after group. Host arrays; made once per asset."""

    order: np.ndarray = field(repr=False)
    """[M] int64 Gaussians, group after group; in a group by falling opacity, equal ones in their order (VoxelGrid)."""
    starts: np.ndarray = field(repr=False)
    """[B + 1] int64: group b is order[starts[b] : starts[b + 1]] (cu_seqlens of packed attention)."""
    centers: np.ndarray = field(repr=False)
    """[B, 3] float64 centres of the groups' voxels, world units."""
    voxel: float
    """Edge of a voxel, world units."""
    center: np.ndarray = field(repr=False)
    """[3] float64 centre of the asset's cube, world units."""
    half_extent: float
    """Half the edge of the asset's cube, world units."""

    @staticmethod
    def of(grid: VoxelGrid, max_size: int = 0) -> GaussianGroups:
        """The groups of a grid, shorter ones first: in every run of groups attention then finds batches of one length
        as they lie. max_size: voxels with more Gaussians than this become several groups; 0: never."""
        starts = np.asarray(grid.starts, np.int64)
        lengths = np.diff(starts)
        # A crowded voxel is cut: attention grows with the square of its number.
        pieces = np.maximum(-(-lengths // max_size), 1) if max_size else np.ones_like(lengths)
        nth = _within(pieces)  # 0, 1, ... inside each voxel
        cut = np.append(np.repeat(starts[:-1], pieces) + nth * max_size, starts[-1])
        # Sorted by length, as batches of one length need no padding.
        rank = np.argsort(np.diff(cut), kind="stable")
        counts = np.diff(cut)[rank]
        indices = np.repeat(cut[:-1][rank], counts) + _within(counts)
        return GaussianGroups(
            order=np.asarray(grid.order, np.int64)[indices],
            starts=np.append(0, np.cumsum(counts)).astype(np.int64),
            centers=np.repeat(grid.centers(grid.keys), pieces, axis=0)[rank],
            voxel=grid.voxel,
            center=grid.min_corner + grid.extent / 2,
            half_extent=grid.extent / 2,
        )

    def __len__(self) -> int:
        """M, the number of grouped Gaussians."""
        return len(self.order)

    @cached_property
    def lengths(self) -> np.ndarray:
        """[B] int64 Gaussians per group."""
        return np.diff(self.starts)

    def gaussian_centers(self, indices: np.ndarray | None = None) -> np.ndarray:
        """[M, 3] float64 voxel centre of each grouped Gaussian, or of those at `indices` in the packed order."""
        if indices is None:
            return np.repeat(self.centers, self.lengths, axis=0)
        return self.centers[np.searchsorted(self.starts, indices, side="right") - 1]

    def part(self, first: int, last: int) -> GaussianGroups:
        """Groups first .. last - 1."""
        a, b = self.starts[first], self.starts[last]
        return replace(
            self, order=self.order[a:b], starts=self.starts[first : last + 1] - a, centers=self.centers[first:last]
        )

    def chunks(self, size: int) -> Iterator[GaussianGroups]:
        """Runs of complete groups of at most `size` Gaussians each (one group, where that alone has more)."""
        first, count = 0, len(self.lengths)
        while first < count:
            last = int(np.searchsorted(self.starts, self.starts[first] + size, side="right")) - 1
            last = max(last, first + 1)
            yield self.part(first, last)
            first = last

    def most_opaque(self, share: float) -> tuple[GaussianGroups, np.ndarray]:
        """The most opaque K = max(floor(share N_k), 1) Gaussians of every group (none of an empty group), and their
        indices [K_all] int64 in the packed order."""
        counts = np.minimum(np.maximum(np.floor(share * self.lengths).astype(np.int64), 1), self.lengths)
        indices = np.repeat(self.starts[:-1], counts) + _within(counts)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        return replace(self, order=self.order[indices], starts=starts), indices


def _within(counts: np.ndarray) -> np.ndarray:
    """[sum(counts)] 0 .. counts[b] - 1 for every b, one after the other."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)


def feature_count(degree: int) -> int:
    """A, the features that `attribute_features` gives for SH degree `degree`."""
    return 14 + 3 * (degree + 1) ** 2


def attribute_features(gaussians: Splats[torch.Tensor], groups: GaussianGroups, degree: int) -> torch.Tensor:
    """[M, A] float32 what a Gaussian is: centre relative to its voxel (voxel units) and the voxel in the cube (-1..1),
    log scale in voxels, unit quaternion with w >= 0, logit opacity, SH of bands 0..degree (zeros where it has fewer).

    gaussians: the N of the asset, with torch attributes. Every feature is of order 1 and bounded, also for outliers
    beyond the cube. Differentiable in the attributes.
    """
    import torch

    device = gaussians.means.device
    index = torch.from_numpy(groups.order).to(device)
    voxel_center = torch.from_numpy(groups.gaussian_centers()).to(device)
    cube_center = torch.from_numpy(groups.center).to(device)
    # Float64 until the difference is taken: captures lie kilometres from their origin.
    offset = (gaussians.means[index].double() - voxel_center) / groups.voxel
    position = (voxel_center - cube_center) / groups.half_extent
    scale = torch.log((gaussians.scales[index].float() / groups.voxel).clamp(1e-6, 1e6))
    quat = torch.nn.functional.normalize(gaussians.quats[index].float(), dim=1)
    # A quaternion and its negative are one rotation, and should look like one.
    quat = torch.where(quat[:, :1] < 0, -quat, quat)
    opacity = torch.logit(gaussians.opacities[index].float(), eps=1e-4)
    bands = (degree + 1) ** 2
    sh = gaussians.sh[index][:, :bands].float().clamp(-16, 16)
    sh = torch.nn.functional.pad(sh.flatten(1), (0, 3 * (bands - sh.shape[1])))
    parts = (offset.float().clamp(-4, 4), position.float(), scale / 4, quat, opacity[:, None] / 4, sh)
    return torch.cat(parts, dim=1)


def drift_features(now: Splats[torch.Tensor], encoded: Splats[torch.Tensor], voxel: float) -> torch.Tensor:
    """[J, 7] float32 how Gaussians differ from those that their latents describe: centre (voxels), log scale, opacity.
    Zeros for the same ones; one that the lift split off says where in its parent it lies.

    now, encoded: J Gaussians each, torch; voxel: edge of a voxel, world units. Bounded, as attribute_features."""
    import torch

    offset = ((now.means - encoded.means) / voxel).clamp(-4, 4)
    size = torch.log((now.scales / encoded.scales).clamp(1e-6, 1e6))
    return torch.cat([offset, size / 4, (now.opacities - encoded.opacities)[:, None]], dim=1).float()


@dataclass(frozen=True)
class TokenLinks:
    """Which LRM tokens describe a Gaussian, and how much of each."""

    patches: np.ndarray = field(repr=False)
    """[N, S] int64 tokens, 0..P - 1."""
    weights: np.ndarray = field(repr=False)
    """[N, S] float32 >= 0; sum to 1, or to 0 for one that no view shows."""

    def __post_init__(self) -> None:
        if self.patches.shape != self.weights.shape or self.patches.ndim != 2:
            raise ValueError(f"links: expected two [N, S], got {self.patches.shape} and {self.weights.shape}")


def links_from_views(
    means: np.ndarray, cameras: Sequence[Camera], contributions: np.ndarray, patch: int, max_links: int = 4
) -> TokenLinks:
    """Tie each Gaussian to the patches that its centre falls into, weighted by how much of it each view shows.

    means: [N, 3] world; cameras: the V canonical views, in the LRM's order; contributions: [V, N] pixels per Gaussian
    and view (`Render.contributions`); patch: pixels per edge. Only the `max_links` views that show most of a Gaussian
    count. Tokens are numbered view by view, in each row by row of patches. Raises ValueError for contributions of
    another shape.
    """
    count, n = len(cameras), len(means)
    if contributions.shape != (count, n):
        raise ValueError(f"links: expected contributions [{count}, {n}], got {list(contributions.shape)}")
    patches = np.zeros((count, n), np.int64)
    weights = np.zeros((count, n), np.float32)
    first = 0
    for view, camera in enumerate(cameras):
        wide, high = -(-camera.width // patch), -(-camera.height // patch)
        pixels, z = camera.project(means)
        # A centre beside the picture has no patch there, whatever of its edge is seen.
        inside = (z > 1e-9) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
        column, line = (np.where(inside[:, None], pixels, 0).astype(np.int64) // patch).T
        patches[view] = first + line * wide + column
        weights[view] = np.where(inside, np.maximum(contributions[view], 0), 0)
        first += wide * high
    if max_links < count:
        # Stable: equal views keep their order, so that two runs agree.
        best = np.argsort(-weights, axis=0, kind="stable")[:max_links]
        patches, weights = np.take_along_axis(patches, best, 0), np.take_along_axis(weights, best, 0)
    # Gaussians that no view shows keep zeros: there is no token that tells of them.
    total = weights.sum(0)
    weights = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)
    return TokenLinks(np.ascontiguousarray(patches.T), np.ascontiguousarray(weights.T))
