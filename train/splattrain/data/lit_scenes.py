"""An object ready to be edited: its dense truth, the coarse asset that an artist would have, one light, base views.

`SceneObject` is an object without light (costly to make, worth keeping); `LitScene` is one under one light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.color import base_color, srgb_to_linear
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from splattrain.data.lights import Light, shade
from splattrain.data.meshes import Mesh
from splattrain.data.object_sources import SplatSource
from splattrain.data.surfels import Surfels, coarse_asset, sample_surfels, to_splats
from splattrain.data.viewpoints import Optics, ring


@dataclass(frozen=True)
class PosedViews:
    """V pictures of one size and their cameras."""

    cameras: tuple[Camera, ...]
    """V."""
    colors: Tensor = field(repr=False)
    """[V, H, W, 3] float32, display sRGB 0..1, over each camera's background."""

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Renders:
    """What the renderer says of V views: colours as in PosedViews, and geometry."""

    views: PosedViews
    alphas: Tensor
    """[V, H, W] 0..1."""
    depths: Tensor
    """[V, H, W] expected z-depth, world units."""


@dataclass(frozen=True)
class SceneObject:
    """An object without light, about the origin, y up, within -1..1."""

    name: str
    surfels: Surfels
    """The truth, dense."""
    coarse: Surfels
    """The asset's Gaussians."""
    radius: float
    """Radius of the sphere about the origin that holds it."""
    two_sided: bool = False
    """The sign of the normals means nothing (splat assets): what faces away is left to the depth test."""
    sh: Tensor | None = field(default=None, repr=False)
    """[N, K, 3] the surfels' own colours where the object brings its light with it (splat assets); else None."""

    @property
    def nbytes(self) -> int:
        sets = (self.surfels, self.coarse)
        return sum(getattr(s, f.name).nbytes for s in sets for f in fields(s))


@dataclass(frozen=True)
class LitScene:
    """An object under one light."""

    object: SceneObject
    truth: Splats[Tensor]
    """Dense, torch: what every picture is rendered from."""
    asset: Splats
    """What the artist has, numpy float32."""
    coarse: Splats[Tensor]
    """The asset as torch on the truth's device."""
    base: PosedViews
    optics: Optics


def mesh_object(
    name: str, mesh: Mesh, surfels: int, gaussians: int, roughness: float, seed: int, device: str
) -> SceneObject:
    """The object of a mesh. Raises ValueError for a bad mesh."""
    dense = sample_surfels(mesh, surfels, seed, device)
    coarse = coarse_asset(dense, gaussians, seed, roughness)
    return SceneObject(name, dense, coarse, float(dense.means.norm(dim=1).max()))


def splat_object(source: SplatSource, i: int, device: str) -> SceneObject:
    """Asset i of a source of splats, as its own truth: centred, scaled into -1..1, turned from y down to y up, without
    view dependence. What cannot be drawn is left out. Raises ValueError when none are left."""
    splats = source.splats(i)
    splats = splats.take(np.flatnonzero(splats.drawable)).torch(device)
    if len(splats) == 0:
        raise ValueError(f"{source.name(i)}: none of its Gaussians can be drawn")
    low, high = splats.means.quantile(0.01, 0), splats.means.quantile(0.99, 0)  # captures have stray Gaussians
    scale = 2 / float((high - low).max().clamp(min=1e-6))
    flip = splats.means.new_tensor([1.0, -1.0, -1.0])
    means, scales = (splats.means - (low + high) / 2) * scale * flip, splats.scales * scale
    w, x, y, z = torch.nn.functional.normalize(splats.quats, dim=-1).unbind(-1)
    quats = torch.stack([-x, w, -z, y], -1)  # half a turn about x, after the Gaussian's rotation
    thin = scales.argmin(1)
    normals = quat_to_matrix(quats)[torch.arange(len(means), device=means.device), :, thin]
    sh = splats.sh[:, :1].clone()
    zeros, ones = torch.zeros_like(splats.opacities), torch.ones_like(splats.opacities)
    albedo = srgb_to_linear(base_color(sh).clamp(0, 1))
    transfer = means.new_zeros(len(means), 9)
    surfels = Surfels(means, normals, quats, scales, splats.opacities, albedo, zeros, ones, ones, transfer)
    radius = float(means.norm(dim=1).quantile(0.98))
    return SceneObject(source.name(i), surfels, surfels, radius, True, sh)


def illuminate(
    item: SceneObject, light: Light | None, degree: int, optics: Optics, views: int, rng: np.random.Generator
) -> LitScene:
    """The object under a light (None: its own), with `views` base views around it. degree: of the SH, 0 to 2."""
    if item.sh is not None:
        truth = coarse = to_splats(item.surfels, item.sh)
    elif light is not None:
        truth = to_splats(item.surfels, shade(item.surfels, light, degree))
        coarse = to_splats(item.coarse, shade(item.coarse, light, degree))
    else:
        raise ValueError(f"{item.name}: expected a light for an object that has none")
    base = render_views(truth, ring(item.radius, optics, views, rng)).views
    return LitScene(item, truth, coarse.numpy(), coarse, base, optics)


def render_views(splats: Splats[Any], cameras: Sequence[Camera]) -> Renders:
    """Render without gradients. splats: torch."""
    from splatpainter.rendering import render

    with torch.no_grad():
        drawn: Any = render(splats, cameras)
    colors = drawn.colors.clamp(0, 1)
    return Renders(PosedViews(tuple(cameras), colors), drawn.alphas[..., 0], drawn.depths[..., 0])


def recolored(splats: Splats[Tensor], sh: Tensor) -> Splats[Tensor]:
    """The Gaussians in other colours."""
    return replace(splats, sh=sh)
