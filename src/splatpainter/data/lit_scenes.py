"""An object ready to be edited: its dense truth, the coarse asset that an artist would have, one light, base views.

`Subject` is an object without light (costly to make, worth keeping); `Stage` is a subject under one light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.data.lights import Light, shade
from splatpainter.data.scenes import MeshSource, SplatSource
from splatpainter.data.surfels import Surfels, coarse_asset, sample_surfels, to_splats
from splatpainter.data.viewpoints import Optics, ring
from splatpainter.sources.looks import to_linear
from splatpainter.splats import SH_C0, Splats


@dataclass(frozen=True)
class Views:
    """V pictures of one size and their cameras."""

    cameras: tuple[Camera, ...]
    """V."""
    colors: Tensor = field(repr=False)
    """[V, H, W, 3] float32, display sRGB 0..1, over each camera's background."""

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Shots:
    """What the renderer says of V views: colours as in Views, and geometry."""

    views: Views
    alphas: Tensor
    """[V, H, W] 0..1."""
    depths: Tensor
    """[V, H, W] expected z-depth, world units."""


@dataclass(frozen=True)
class Subject:
    """An object without light, about the origin, y up, within -1..1."""

    name: str
    surfels: Surfels
    """The truth, dense."""
    coarse: Surfels
    """The asset's rows."""
    radius: float
    """Of the sphere about the origin that holds it."""
    two_sided: bool = False
    """The sign of the normals means nothing (splat assets): what faces away is left to the depth test."""
    sh: Tensor | None = field(default=None, repr=False)
    """[N, K, 3] the surfels' own colours where the object brings its light with it (splat assets); else None."""

    @property
    def nbytes(self) -> int:
        sets = (self.surfels, self.coarse)
        return sum(getattr(s, f.name).nbytes for s in sets for f in fields(s))


@dataclass(frozen=True)
class Stage:
    """A subject under one light."""

    subject: Subject
    truth: Splats
    """Dense, torch: what every picture is rendered from."""
    asset: Splats
    """What the artist has, numpy float32."""
    coarse: Splats
    """The same as torch on the truth's device."""
    base: Views
    optics: Optics


def mesh_subject(source: MeshSource, i: int, surfels: int, rows: int, fuzz: float, seed: int, device: str) -> Subject:
    """Object i of a source of meshes. Raises ValueError for a bad mesh."""
    dense = sample_surfels(source.mesh(i), surfels, seed, device)
    coarse = coarse_asset(dense, rows, seed, fuzz)
    return Subject(source.name(i), dense, coarse, float(dense.means.norm(dim=1).max()))


def splat_subject(source: SplatSource, i: int, device: str) -> Subject:
    """Asset i of a source of splats, as its own truth: centred, scaled into -1..1, turned from y down to y up, without
    view dependence. Rows that cannot be drawn are left out. Raises ValueError when none are left."""
    own = source.splats(i)
    kept = own.take(np.flatnonzero(own.drawable)).torch(device)
    if len(kept) == 0:
        raise ValueError(f"{source.name(i)}: none of its rows can be drawn")
    low, high = kept.means.quantile(0.01, 0), kept.means.quantile(0.99, 0)  # captures have stray rows
    scale = 2 / float((high - low).max().clamp(min=1e-6))
    flip = kept.means.new_tensor([1.0, -1.0, -1.0])
    means, scales = (kept.means - (low + high) / 2) * scale * flip, kept.scales * scale
    w, x, y, z = torch.nn.functional.normalize(kept.quats, dim=-1).unbind(-1)
    quats = torch.stack([-x, w, -z, y], -1)  # half a turn about x, after the row's own rotation
    from splatpainter.lift.split import rotations

    turns = torch.from_numpy(np.ascontiguousarray(rotations(quats.cpu().numpy()))).to(means)
    thin = scales.argmin(1)
    normals = turns[torch.arange(len(means), device=means.device), :, thin]
    sh = kept.sh[:, :1].clone()
    nothing, ones = torch.zeros_like(kept.opacities), torch.ones_like(kept.opacities)
    albedo = to_linear((0.5 + SH_C0 * sh[:, 0]).clamp(0, 1))
    transfer = means.new_zeros(len(means), 9)
    kind = (kept.opacities, albedo, nothing, ones, ones, transfer)
    surfels = Surfels(means, normals, quats, scales, *kind)
    radius = float(means.norm(dim=1).quantile(0.98))
    return Subject(source.name(i), surfels, surfels, radius, True, sh)


def light_up(
    subject: Subject, light: Light | None, degree: int, optics: Optics, views: int, rng: np.random.Generator
) -> Stage:
    """The subject under a light (None: its own), with `views` base views around it. degree: of the SH, 0 to 2."""
    if subject.sh is not None:
        truth = coarse = to_splats(subject.surfels, subject.sh)
    elif light is not None:
        truth = to_splats(subject.surfels, shade(subject.surfels, light, degree))
        coarse = to_splats(subject.coarse, shade(subject.coarse, light, degree))
    else:
        raise ValueError(f"{subject.name}: expected a light for an object that brings none")
    base = shoot(truth, ring(subject.radius, optics, views, rng)).views
    return Stage(subject, truth, coarse.numpy(), coarse, base, optics)


def shoot(splats: Splats, cameras: Sequence[Camera]) -> Shots:
    """Render without gradients. splats: torch."""
    from splatpainter.rendering import render

    with torch.no_grad():
        drawn: Any = render(splats, cameras)
    colors = drawn.colors.clamp(0, 1)
    return Shots(Views(tuple(cameras), colors), drawn.alphas[..., 0], drawn.depths[..., 0])


def recolored(splats: Splats, sh: Tensor) -> Splats:
    """The same rows in other colours."""
    return replace(splats, sh=sh)
