"""From an asset to what Stage II reads: canonical views, tokens, Stage I. Once per asset; of models without LRM and
Stage I, voxels alone.

N Gaussians of the asset, K latents, V canonical views. In `native` representation the latents belong to the asset's own
Gaussians; in `copy` the asset is replaced by what Stage I decodes of the LRM's Gaussians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.models.config import LrmConfig
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid, bounding_cube, voxelize

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from splatpainter.models.compress import Latents
    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import SplatPainterModel

FOV = 50.0
"""Vertical field of view of the canonical cameras, degrees."""
FRAMED_HALF_EXTENTS = 1.3
"""What the canonical views show whole: a ball of this many half edges of the asset's cube."""
MAX_ELEVATION_DEGREES = 60.0
"""Canonical cameras stand at most this far above or below the asset, degrees."""
GOLDEN_ANGLE_DEGREES = 180.0 * (3.0 - math.sqrt(5.0))
"""Degrees from one camera to the next: any number of them is spread evenly (spherical Fibonacci lattice)."""


@dataclass(frozen=True)
class Encoded:
    """An encoded asset."""

    latents: Latents
    """K latents; latents.groups.order are indices into `gaussians`. Gaussians that cannot be drawn have none."""
    gaussians: Splats[Tensor] = field(repr=False)
    """Torch float32. native: the N Gaussians that were encoded. copy: K Gaussians, decoded by Stage I; they are the
    asset now."""

    @cached_property
    def latent_ids(self) -> np.ndarray:
        """[len(gaussians)] int64 index into latents.values of each Gaussian's latent; -1 for Gaussians without one."""
        order = self.latents.groups.order
        out = np.full(len(self.gaussians), -1, np.int64)
        out[order] = np.arange(len(order))
        return out


def canonical_cameras(splats: Splats, config: LrmConfig) -> list[Camera]:
    """config.views cameras around the asset's cube, config.image_size pixels square. Deterministic. Raises ValueError
    when no Gaussian can be drawn."""
    lo, size = bounding_cube(splats)
    center, distance = lo + size / 2, FRAMED_HALF_EXTENTS * size / 2 / math.sin(math.radians(FOV / 2))
    # By the golden angle: any number of cameras is spread evenly, and the same every time.
    first, cameras = config.views // 3, []  # the first camera looks slightly down
    for k in range(first, first + config.views):
        # Heights of equal area between both limits.
        height = math.sin(math.radians(MAX_ELEVATION_DEGREES)) * (1 - (2 * (k % config.views) + 1) / config.views)
        around = math.radians((k % config.views - first) * GOLDEN_ANGLE_DEGREES)
        level = math.sqrt(1 - height**2)
        away = np.array([level * math.sin(around), -height, level * math.cos(around)])  # assets have y down
        eye = center + distance * away
        cameras.append(
            look_at(eye, center, (0.0, -1.0, 0.0), width=config.image_size, height=config.image_size, fov=FOV).local
        )
    return cameras


def asset_views(splats: Splats[Any], cameras: Sequence[Camera], grid: VoxelGrid) -> tuple[AssetViews, np.ndarray]:
    """(rendered colours, depth and alpha, in the cube of `grid`; contributions [V, N] float32, pixels per Gaussian and
    view). The views are torch float32, on the device of the splats (CPU for numpy), without gradients."""
    import torch

    from splatpainter.models.lrm import AssetViews
    from splatpainter.rendering import render

    with torch.no_grad():
        # Contributions come with the pictures: they say which patches tell of which Gaussian.
        drawn = render(splats, list(cameras), contributions=True)
    assert drawn.contributions is not None  # they were asked for
    colors, depths, alphas = (torch.as_tensor(x).float() for x in (drawn.colors, drawn.depths, drawn.alphas))
    seen = drawn.contributions if isinstance(drawn.contributions, np.ndarray) else drawn.contributions.cpu().numpy()
    views = AssetViews(
        cameras,
        colors.clamp(0, 1),
        depths,
        alphas,
        center=grid.min_corner + grid.extent / 2,
        half_extent=grid.extent / 2,
    )
    return views, seen.astype(np.float32, copy=False)


def encode_asset(
    model: SplatPainterModel,
    splats: Splats,
    grid: VoxelGrid | None = None,
    *,
    dtype: torch.dtype | None = None,
) -> Encoded:
    """LRM and Stage I of an asset, on the model's device; with gradients where torch has them enabled. A model without
    them has latents of zeros, and only the voxels are made.

    splats: numpy or torch; grid: its voxels where they are at hand already (another resolution than the model's is
    ignored); dtype: how latents are kept, default float32. Raises ValueError when no Gaussian can be drawn."""
    import torch

    from splatpainter.models.gaussian_groups import links_from_views

    config = model.config
    kind, device = dtype or torch.float32, next(model.parameters()).device
    arrays = splats.numpy()
    if grid is None or grid.resolution != config.compress.resolution:
        grid = voxelize(arrays, config.compress.resolution)
    gaussians = splats.torch(str(device))
    if not config.refine.latents:
        from splatpainter.models.compress import Latents

        groups = model.groups(grid).most_opaque(1.0)[0]
        # One row for all of them: a million would be a gigabyte of zeros.
        nothing = torch.zeros(1, config.compress.dim, device=device).expand(len(groups), -1)
        return Encoded(Latents(nothing, groups), gaussians)
    cameras = canonical_cameras(arrays, config.lrm)
    views, contributions = asset_views(gaussians if device.type == "cuda" else arrays, cameras, grid)
    if config.representation == "copy":
        return _copied(model, views, kind)
    tokens = model.encode_views(views)
    # Gaussians that cannot be drawn contribute nothing; their NaN must not reach the arithmetic.
    means = np.where(arrays.drawable[:, None], arrays.means, 0)
    links = links_from_views(means, cameras, contributions, config.lrm.patch)
    return Encoded(model.compressor(tokens, gaussians, links, model.groups(grid), dtype=kind), gaussians)


def _copied(model: SplatPainterModel, views: AssetViews, dtype: torch.dtype) -> Encoded:
    """What the LRM saw, thinned out and decoded by Stage I: latent i belongs to Gaussian i."""
    from splatpainter.models.compress import Latents

    copy = model.copied_gaussians(views)
    # The copy has places of its own, so its voxels are not those of the user's Gaussians.
    grid = voxelize(copy.gaussians.numpy(), model.config.compress.resolution)
    latents = model.compressor(copy.tokens, copy.gaussians, copy.links, model.groups(grid), dtype=dtype)
    gaussians = model.decode_latents(latents, copy.gaussians)
    groups = replace(latents.groups, order=np.arange(len(latents.groups), dtype=np.int64))
    return Encoded(Latents(latents.values, groups), gaussians)
