"""The Gaussian LRM: views of an asset in, a token per patch and a Gaussian per pixel out (GS-LRM, arXiv 2404.19702).

Patches with their rays go through a pre-norm transformer over all views; a linear head turns every token into the
Gaussians of its pixels. Works in the asset's cube (-1..1), returns world units. Knows no voxels and no renderer.

V views of H x W pixels, p pixels per edge of a patch, L = (H / p) (W / p) tokens per view, D width, C input channels,
K SH coefficients. Tokens are counted view by view, row of patches by row. Gaussian i belongs to token i // p^2 and to
its pixel i % p^2, row by row inside the patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from splatpainter.cameras import Camera
from splatpainter.color import sh_from_color
from splatpainter.models.config import LrmConfig
from splatpainter.nn.attention import Groups
from splatpainter.nn.layers import PackedBlock, layer_norm, linear
from splatpainter.nn.precision import exact
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

MAX_VIEWS = 16
MAX_RAY_OFFSET = 1.8
"""A Gaussian lies at most this far along its ray from the ray's point nearest the cube's centre (cube: -1..1, its
corners at 1.73)."""
DEPTH_REACH = 0.1
"""The same from the rendered depth where that is known: 6 voxels of 128."""
MIN_DEPTH_ALPHA = 0.1
"""Alpha from which a rendered depth counts: the mean over a few faint Gaussians is a guess."""
SCALE_BIAS, SCALE_MOST = -2.3, -1.2
"""Log-scale where the head says 0 (0.10 of half the cube), and its upper limit (0.30)."""
OPACITY_BIAS = -2.0
"""Logit opacity where the head says 0 (0.12)."""
SURFACE_OPACITY_BIAS, EMPTY_OPACITY_BIAS = 1.0, -6.0
"""Biases with geometry: on the surface (0.73), and where the views show nothing (0.002: as good as absent)."""
SURFACE_SCALE_PX = 0.7
"""Scale where the head says 0 and the surface is known, in pixels of the view at that depth: neighbours overlap."""


@dataclass(frozen=True)
class AssetViews:
    """Views of an asset from its canonical cameras: torch, float32, on one device."""

    cameras: Sequence[Camera]
    """V, 1 to 16, all of one size."""
    colors: Tensor = field(repr=False)
    """[V, H, W, 3] in 0..1."""
    depth: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 1] expected z-depth, world units, 0 where there is nothing; for a model that sees geometry."""
    alpha: Tensor | None = field(default=None, repr=False)
    """[V, H, W, 1] in 0..1; likewise."""
    center: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    """[3] centre of the asset's cube, world units."""
    half_extent: float = 1.0
    """Half the edge of the asset's cube, world units, > 0."""

    def __post_init__(self) -> None:
        # Sizes are judged before anything is computed: packed tokens would mix views of several sizes up.
        sizes = sorted({(camera.width, camera.height) for camera in self.cameras})
        if not 1 <= len(self.cameras) <= MAX_VIEWS:
            raise ValueError(f"encode: expected 1 to {MAX_VIEWS} views, got {len(self.cameras)}")
        if len(sizes) > 1:
            listed = ", ".join(f"{w}x{h}" for w, h in sizes)
            raise ValueError(f"encode: expected views of one size, got {listed}; render them at one size")
        if not (np.isfinite(self.half_extent) and self.half_extent > 0 and np.isfinite(self.center).all()):
            raise ValueError(
                f"encode: expected a finite cube with half > 0, got {self.half_extent} around {self.center}"
            )
        width, height = sizes[0]
        for name, channels in (("colors", 3), ("depth", 1), ("alpha", 1)):
            values = getattr(self, name)
            shape = [len(self.cameras), height, width, channels]
            if values is not None and list(values.shape) != shape:
                raise ValueError(f"encode: expected {name} {shape}, got {list(values.shape)}")


@dataclass(frozen=True)
class LrmOutput:
    """What the LRM says about an asset."""

    tokens: Tensor
    """[V * L, D] the transformer's last tokens, before the head's LayerNorm."""
    splats: Splats[Tensor]
    """V * H * W Gaussians in world units, torch float32, in the order of this module's first lines."""


class GaussianLrm(nn.Module):
    """The LRM with its weights: no biases, all linear weights from N(0, 0.02), no positional code (rays carry it)."""

    def __init__(self, config: LrmConfig) -> None:
        super().__init__()
        self.config = config
        area = config.patch**2
        self.patches = linear(area * (11 if config.geometry else 9), config.dim)
        self.norm_in = layer_norm(config.dim)
        self.blocks = nn.ModuleList(
            PackedBlock(config.dim, config.heads, config.hidden, mlp="gelu") for _ in range(config.layers)
        )
        self.norm_out = layer_norm(config.dim)
        # Per pixel: 3 depth logits, SH, 3 log-scales, a quaternion, a logit opacity.
        self.head = linear(config.dim, area * (11 + 3 * (config.sh_degree + 1) ** 2))

    def forward(self, views: AssetViews) -> LrmOutput:
        """Raises ValueError where the size is no multiple of the patch, or depth or alpha is missing."""
        tokens = self.encode(views)
        return LrmOutput(tokens, self.decode(tokens, views))

    def encode(self, views: AssetViews) -> Tensor:
        """[V * L, D] float32 tokens: what a model of the user's own Gaussians needs. Raises ValueError as forward."""
        height, width = views.colors.shape[1:3]
        if height % self.config.patch or width % self.config.patch:
            raise ValueError(
                f"encode: expected views whose size is a multiple of {self.config.patch} pixels, got {width}x{height}"
            )
        x = self.tokenize(views)
        groups = Groups.of([len(x)], x.device)  # every token sees all views
        again = self.config.checkpoint_activations and torch.is_grad_enabled()
        for block in self.blocks:
            x = checkpoint(block, x, groups, use_reentrant=False) if again else block(x, groups)
        return x

    def tokenize(self, views: AssetViews) -> Tensor:
        """[V * L, D] float32 tokens of patches, which know nothing of each other yet. Views of other sizes than whole
        patches are padded right and below with zeros. Raises ValueError where depth or alpha is missing."""
        patch, channels = self.config.patch, self._channels(views)
        height, width = channels.shape[1:3]
        x = patchify(nn.functional.pad(channels, (0, 0, 0, -width % patch, 0, -height % patch)), patch)
        with exact(x.device):  # rays and depths; and what the blocks add to stays float32
            return self.norm_in(self.patches(x))

    def decode(self, tokens: Tensor, views: AssetViews) -> Splats[Tensor]:
        """One Gaussian per pixel from tokens [V * L, D] of these views. In training mode centres are clipped to the
        cube."""
        patch, count = self.config.patch, (self.config.sh_degree + 1) ** 2
        with exact(tokens.device):  # positions, and opacities that Gaussians are put in order by
            raw = self.head(self.norm_out(tokens.float())).unflatten(1, (patch**2, -1)).flatten(0, 1)
        depth, sh, scales, quats, opacities = raw.split([3, 3 * count, 3, 4, 1], dim=1)
        origins, directions = rays(views)
        # Along the ray of its pixel: a Gaussian may be at a wrong depth, never beside what the view shows.
        start, reach = _depth_range(views, origins, directions, self.config.geometry)
        start, reach, directions = (patchify(x, patch).unflatten(1, (patch**2, -1)) for x in (start, reach, directions))
        # 2 sigmoid(x) - 1 = tanh(x / 2). The mean of three logits: the head's three outputs for xyz share one depth.
        along = start + reach * torch.tanh(depth.mean(1).view(start.shape) / 2)
        means = origins.repeat_interleave(len(tokens) // len(origins), 0)[:, None] + along * directions  # [V L, p^2, 3]
        if self.training:
            means = means.clamp(-1, 1)
        center = torch.as_tensor(np.asarray(views.center, np.float32)).to(means.device)
        sh = sh.unflatten(1, (count, 3))
        scale_bias, opacity_bias = torch.full_like(scales[:, :1], SCALE_BIAS), OPACITY_BIAS
        if self.config.geometry:
            # The surface and its colours are given: where the head says 0, the views' own pixels lie on it.
            assert views.alpha is not None
            on_asset = patchify(views.alpha, patch).reshape(-1, 1) > MIN_DEPTH_ALPHA
            focal = min(views.cameras[0].fx, views.cameras[0].fy)
            footprint = torch.log(SURFACE_SCALE_PX / focal * along.flatten(0, 1).detach().clamp_min(1e-3))
            scale_bias = torch.where(on_asset, footprint, scale_bias)
            opacity_bias = torch.where(on_asset[:, 0], SURFACE_OPACITY_BIAS, EMPTY_OPACITY_BIAS)
            base = sh_from_color(patchify(views.colors, patch).reshape(-1, 1, 3))
            sh = torch.cat([sh[:, :1] + base, sh[:, 1:]], dim=1)
        return Splats(
            means=means.flatten(0, 1) * views.half_extent + center,
            quats=quats,
            scales=torch.exp((scales + scale_bias).clamp_max(SCALE_MOST)) * views.half_extent,
            opacities=torch.sigmoid(opacities[:, 0] + opacity_bias),
            sh=sh,
        )

    def on_surface(self, views: AssetViews, splats: Splats[Tensor]) -> Tensor:
        """[V * H * W] bool: Gaussians (one per pixel, of `decode`) that are worth drawing: with known geometry those of
        pixels that show the asset, the rest of the picture teaches nothing."""
        if not self.config.geometry or views.alpha is None:
            return torch.ones_like(splats.opacities, dtype=torch.bool)
        return patchify(views.alpha, self.config.patch).reshape(-1) > MIN_DEPTH_ALPHA

    def _channels(self, views: AssetViews) -> Tensor:
        """[V, H, W, C]: colour in -1..1, ray direction, the ray's point nearest the cube's centre; with geometry the
        place of the surface along the ray from that point (0 where unknown), and alpha in -1..1."""
        origins, directions = rays(views)
        parts = [2 * views.colors - 1, directions, nearest_points(origins, directions)]
        if self.config.geometry:
            if views.depth is None or views.alpha is None:
                raise ValueError("encode: this model needs depth and alpha; render them with the views")
            start, _ = _depth_range(views, origins, directions, True)
            parts += [start - _nearest_along(origins, directions), 2 * views.alpha - 1]
        return torch.cat(parts, dim=-1)


def rays(views: AssetViews) -> tuple[Tensor, Tensor]:
    """(origins [V, 3], unit directions [V, H, W, 3] through the pixel centres) in the asset's cube, on the device of
    the colours."""
    device, (height, width) = views.colors.device, views.colors.shape[1:3]
    origins = np.stack([(camera.position - np.asarray(views.center)) / views.half_extent for camera in views.cameras])
    lenses = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in views.cameras])
    turns = np.stack([camera.world_to_camera[:3, :3] for camera in views.cameras])
    origin, lens, turn = (torch.from_numpy(x.astype(np.float32)).to(device) for x in (origins, lenses, turns))
    fx, fy, cx, cy = lens[:, :, None, None].unbind(1)  # [V, 1, 1] each
    u = (torch.arange(width, device=device) + 0.5 - cx) / fx  # [V, 1, W]
    v = (torch.arange(height, device=device)[:, None] + 0.5 - cy) / fy  # [V, H, 1]
    # Written out: under bf16 autocast a matmul would round the rays to 8 bits.
    world = u[..., None] * turn[:, None, None, 0] + v[..., None] * turn[:, None, None, 1] + turn[:, None, None, 2]
    return origin, nn.functional.normalize(world, dim=-1)


def nearest_points(origins: Tensor, directions: Tensor) -> Tensor:
    """[V, H, W, 3] the point of each ray (origins [V, 3], unit directions [V, H, W, 3]) that is nearest (0, 0, 0)."""
    return origins[:, None, None] + _nearest_along(origins, directions) * directions


def slants(cameras: Sequence[Camera], directions: Tensor) -> Tensor:
    """[V, H, W, 1] z-depth per length along the rays of unit directions [V, H, W, 3]."""
    forward = np.stack([camera.forward for camera in cameras]).astype(np.float32)
    return (directions * torch.from_numpy(forward).to(directions.device)[:, None, None]).sum(-1, keepdim=True)


def patchify(images: Tensor, patch: int) -> Tensor:
    """[V, H, W, C] -> [V * L, p * p * C]: row by row inside a patch, channels fastest. H and W are multiples of p."""
    views, height, width, channels = images.shape
    cut = images.reshape(views, height // patch, patch, width // patch, patch, channels)
    return cut.transpose(2, 3).reshape(-1, patch * patch * channels)


def _nearest_along(origins: Tensor, directions: Tensor) -> Tensor:
    """[V, H, W, 1] distance along each ray to its point nearest (0, 0, 0)."""
    return -(origins[:, None, None] * directions).sum(-1, keepdim=True)


def _depth_range(views: AssetViews, origins: Tensor, directions: Tensor, geometry: bool) -> tuple[Tensor, Tensor]:
    """(start, reach), both [V, H, W, 1] in the cube: a Gaussian lies on its ray at start -+ reach."""
    nearest = _nearest_along(origins, directions)
    if not geometry:
        return nearest, torch.full_like(nearest, MAX_RAY_OFFSET)
    assert views.depth is not None and views.alpha is not None
    slant = slants(views.cameras, directions)
    # Where the depth is a guess, the Gaussian may be anywhere in the cube along its ray.
    has_depth = (views.alpha > MIN_DEPTH_ALPHA) & (views.depth > 0)
    # z-depth to distance along the ray; clamped, since a background Gaussian may lie far behind the cube.
    along = (views.depth / (slant * views.half_extent) - nearest).clamp(-MAX_RAY_OFFSET, MAX_RAY_OFFSET) + nearest
    return torch.where(has_depth, along, nearest), torch.where(has_depth, DEPTH_REACH, MAX_RAY_OFFSET).to(nearest.dtype)
