"""The renderer's specification: plain torch, every Gaussian at every pixel, differentiable by autograd in any dtype.

Slow and large (it holds [Gaussians, pixels] arrays): for small scenes, tests, and reading. N Gaussians, V those that
can be drawn, P pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.rendering.profiles import (
    EPS2D,
    JACOBIAN_MARGIN,
    MAX_ALPHA,
    MAX_DISTANCE_PX,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_PLANE,
    PLAYCANVAS_FALLOFF,
    PLAYCANVAS_MAX_ALPHA,
    Profile,
)
from splatpainter.splats import MAX_MAGNITUDE, MIN_QUAT, Splats
from splatpainter.transforms import quat_to_matrix


def draw(
    splats: Splats[Tensor],
    cameras: Sequence[Camera],
    background: Tensor,
    contributions: bool,
    profile: Profile = "inria",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """background: [C, 3]. Shapes as in `render.Render`."""
    views = [draw_view(splats, camera, color, profile) for camera, color in zip(cameras, background, strict=True)]
    colors, alphas, depths, weights = (torch.stack(parts) for parts in zip(*views, strict=True))
    return colors, alphas, depths, weights.detach() if contributions else None


def draw_view(
    splats: Splats[Tensor], camera: Camera, background: Tensor, profile: Profile = "inria"
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(colour [H, W, 3], alpha [H, W, 1], depth [H, W, 1], contributions [N])."""
    alpha, depth, color, ids = project(splats, camera, profile)  # [V, P], [V], [V, 3], [V]
    weight, T = composite(alpha, profile)  # [V, P], [P]
    opaque = (1 - T)[:, None]  # [P, 1]
    picture = weight.T @ color + T[:, None] * background  # [P, 3]
    distance = weight.T @ depth[:, None]  # [P, 1]
    distance = torch.where(opaque > 0, distance / torch.where(opaque > 0, opaque, 1), 0)  # [P, 1]
    total = torch.zeros_like(splats.opacities).index_add(0, ids, weight.sum(1))  # [N]
    shape = (camera.height, camera.width, -1)
    return picture.reshape(shape), opaque.reshape(shape), distance.reshape(shape), total


def project(
    splats: Splats[Tensor], camera: Camera, profile: Profile = "inria"
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gaussians that can be drawn, front to back: alpha at each pixel before occlusion [V, P] (0 where not drawn), z
    [V], colour [V, 3], and which Gaussians they are [V]."""
    like = {"dtype": splats.means.dtype, "device": splats.means.device}
    world_to_camera = torch.as_tensor(camera.world_to_camera, **like)  # [4, 4]
    R, t = world_to_camera[:3, :3], world_to_camera[:3, 3]  # [3, 3], [3]

    with torch.no_grad():
        ok = drawable(splats) & bool(abs(camera.position).max() <= MAX_MAGNITUDE)  # [N]
        z = splats.means @ R[2] + t[2]  # [N]
        x, y = splats.means @ R[0] + t[0], splats.means @ R[1] + t[1]  # [N] each
        near = (
            torch.stack([camera.fx * (x / z) + camera.cx, camera.fy * (y / z) + camera.cy], 1).abs() <= MAX_DISTANCE_PX
        )
        ids = torch.nonzero(ok & (z >= NEAR_PLANE) & near.all(1))[:, 0]  # [V]
        ids = ids[torch.argsort(z[ids], stable=True)]  # equal depths: by id
    means, scales, sh = splats.means[ids], splats.scales[ids], splats.sh[ids]  # [V, 3], [V, 3], [V, K, 3]
    quats, opacity = splats.quats[ids], splats.opacities[ids]  # [V, 4], [V]

    x, y, z = (means @ R.T + t).unbind(1)  # [V] each
    u, v = x / z, y / z  # [V]
    center = torch.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], 1)  # [V, 2] pixels

    width, height, margin = camera.width, camera.height, JACOBIAN_MARGIN
    u = u.clamp((-camera.cx - margin * width) / camera.fx, (width * (1 + margin) - camera.cx) / camera.fx)
    v = v.clamp((-camera.cy - margin * height) / camera.fy, (height * (1 + margin) - camera.cy) / camera.fy)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * u / z], 1),
            torch.stack([zero, camera.fy / z, -camera.fy * v / z], 1),
        ],
        1,
    )  # [V, 2, 3] of the pixel with respect to the camera-space point
    axes = jacobian @ R @ quat_to_matrix(quats) * scales[:, None, :]  # [V, 2, 3]
    sharp = axes @ axes.transpose(1, 2)  # [V, 2, 2]
    covariance = sharp + EPS2D * torch.eye(2, **like)  # [V, 2, 2]
    if splats.antialiased:  # the blur widens the Gaussian: keep its total (Mip-Splatting, arXiv 2311.16493)
        opacity = opacity * (torch.linalg.det(sharp) / torch.linalg.det(covariance)).clamp_min(0).sqrt()  # [V]

    pixels = pixel_centers(camera, **like)  # [P, 2]
    offset = center[:, None, :] - pixels  # [V, P, 2]
    sigma = ((offset @ torch.linalg.inv(covariance)) * offset).sum(2) / 2  # [V, P]
    floor, cap = (0, MAX_ALPHA) if profile == "inria" else (PLAYCANVAS_FALLOFF, PLAYCANVAS_MAX_ALPHA)
    alpha = (opacity[:, None] * (torch.exp(-sigma) - floor)).clamp_max(cap)  # [V, P]
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0)  # [V, P]

    position = torch.as_tensor(camera.position, **like)  # [3]
    direction = torch.nn.functional.normalize(means - position, dim=1)  # [V, 3]
    color = (0.5 + torch.einsum("vk,vkc->vc", harmonics(direction, sh.shape[1]), sh)).clamp_min(0)  # [V, 3]
    return alpha, z, color, ids


def drawable(splats: Splats[Tensor]) -> Tensor:
    """[N] bool: every attribute finite and in its range, see `Splats`. Others are not drawn."""
    ok = (splats.opacities >= 0) & (splats.opacities <= 1) & (splats.scales > 0).all(1)  # [N]
    ok = ok & (splats.quats.abs() >= MIN_QUAT).any(1)
    for values in (splats.means, splats.quats, splats.scales):
        ok = ok & (values.abs() <= MAX_MAGNITUDE).all(1)
    return ok & (splats.sh.abs().sum((1, 2)) <= MAX_MAGNITUDE)


def composite(alpha: Tensor, profile: Profile = "inria") -> tuple[Tensor, Tensor]:
    """Front to back: weights w_i = alpha_i prod_{j < i} (1 - alpha_j) of those that are accepted [V, P], and the
    transmittance that is left [P]. A pixel accepts Gaussians until one would bring its transmittance to
    MIN_TRANSMITTANCE or below; playcanvas: until its transmittance is below it."""
    after = torch.cumprod(1 - alpha, 0)  # [V, P]
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])[: len(alpha)]  # [V, P]
    accepted = after > MIN_TRANSMITTANCE if profile == "inria" else before >= MIN_TRANSMITTANCE
    # [V, P]: once false, false for all behind
    weight = torch.where(accepted, alpha * before, 0)  # [V, P]
    T = torch.where(accepted, 1 - alpha, 1).prod(0)  # [P]
    return weight, T


def pixel_centers(camera: Camera, **like) -> Tensor:
    """[P, 2] x, y of the pixel centres, row by row."""
    y, x = torch.meshgrid(
        torch.arange(camera.height, **like) + 0.5, torch.arange(camera.width, **like) + 0.5, indexing="ij"
    )
    return torch.stack([x.flatten(), y.flatten()], 1)


def harmonics(direction: Tensor, count: int) -> Tensor:
    """[V, 3] unit directions -> [V, count] real spherical harmonics in the order and signs of 3DGS (count: 1 to 25)."""
    x, y, z = direction.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        torch.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
        2.5033429417967046 * x * y * (xx - yy),
        -1.7701307697799304 * y * z * (3 * xx - yy),
        0.9461746957575601 * x * y * (7 * zz - 1),
        -0.6690465435572892 * y * z * (7 * zz - 3),
        0.10578554691520431 * (zz * (35 * zz - 30) + 3),
        -0.6690465435572892 * x * z * (7 * zz - 3),
        0.47308734787878004 * (xx - yy) * (7 * zz - 1),
        -1.7701307697799304 * x * z * (xx - 3 * yy),
        0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
    ]
    return torch.stack(basis[:count], 1)
