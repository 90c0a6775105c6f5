"""Light for surfels: environments as pictures and as spherical harmonics, shading, exposure and tone map.

Diffuse: albedo / pi x irradiance, from the surfels' transfer (soft shadows included). Specular: split sum (Karis 2013)
with the GGX lobe as a blur of the SH bands. All shading is closed form, in torch, on the surfels' device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from splatpainter.color import LUMA, linear_to_srgb, sh_from_color
from splatpainter.splats import SH_C0
from splatpainter.transforms import fibonacci_sphere, sh_basis
from splattrain.data.surfels import Surfels

SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
"""Factors of the polynomials of band 2."""
SHOULDER_START = 0.8
"""Exposed radiance up to here is shown as it is; what lies above is rolled off towards 1."""
WHITE_RADIANCE = 0.9
"""Exposed radiance of a white diffuse surface that faces the brighter side of an environment."""
WHITE_BALANCE_EXPONENT = 0.6
"""Exponent to which random lights are white-balanced: 1 takes their mean colour away wholly."""
REFLECTANCE_COSINE = 0.7
"""Between normal and line of sight, for which the specular layer's reflectance is taken."""


@dataclass(frozen=True)
class Light:
    """Distant light from all around and the exposure that goes with it."""

    environment: Any
    """[h, w, 3] float32 torch, linear radiance, equirectangular, y up: column u = atan2(x, -z) / 2 pi (mod 1), row
    v = acos(y) / pi (Mitsuba's layout with an identity transform)."""
    coefficients: Any
    """[9, 3] float32 torch: projection of the environment onto real SH of degree 2 (INRIA's signs and order)."""
    exposure: Any
    """[] float32 torch: linear radiance times this goes into `tone_map`."""
    name: str = ""

    def to(self, device: Any) -> Light:
        """The same light on another device."""
        moved = {k: getattr(self, k).to(device) for k in ("environment", "coefficients", "exposure")}
        return replace(self, **moved)


def uniform_light() -> Light:
    """Radiance 1 from everywhere, exposure 1: an open matt surface of albedo a has radiance a."""
    coefficients = torch.zeros(9, 3)
    coefficients[0] = 4 * torch.pi * SH_C0  # exact, without the error of a projection
    return Light(torch.ones(8, 16, 3), coefficients, torch.ones(()), "uniform")


def make_light(environment: Any, name: str = "", stops: float = 0.0) -> Light:
    """A Light of an environment [h, w, 3] (torch or numpy), exposed by `auto_exposure` and `stops` more."""
    picture = torch.as_tensor(environment, dtype=torch.float32)
    coefficients = project_sh(picture)
    return Light(picture, coefficients, auto_exposure(coefficients) * 2.0**stops, name)


def auto_exposure(coefficients: Any) -> Any:
    """[] exposure that gives WHITE_RADIANCE to the luminance of a white diffuse sphere's brightest tenth under SH [9,
    3]."""
    normals = torch.as_tensor(fibonacci_sphere(128), dtype=coefficients.dtype, device=coefficients.device)
    luminance = irradiance(coefficients, normals) @ coefficients.new_tensor(LUMA)
    return WHITE_RADIANCE * torch.pi / torch.quantile(luminance, 0.9).clamp_min(1e-8)


def irradiance(coefficients: Any, normals: Any) -> Any:
    """[N, 3] irradiance at unit normals [N, 3] under SH [9, 3], nothing in the way (Ramamoorthi and Hanrahan 2001)."""
    return ((sh_basis(normals, 2) * _cosine(normals)) @ coefficients).clamp_min(0)


def tone_map(radiance: Any, exposure: Any = 1.0) -> Any:
    """Linear radiance >= 0 -> display sRGB 0..1, torch or numpy: times exposure; above SHOULDER_START s rolled off as
    s + o / (1 + o / (1 - s)) for an excess o (slope 1 there, limit 1); then the curve of IEC 61966-2-1.

    The one tone map of all training data, surfels and path traced.
    """
    if not isinstance(radiance, torch.Tensor):
        return tone_map(torch.from_numpy(np.ascontiguousarray(radiance)), exposure).numpy()
    light = (radiance * exposure).clamp_min(0)
    over = (light - SHOULDER_START).clamp_min(0)
    return linear_to_srgb(light.clamp_max(SHOULDER_START) + over / (1 + over / (1 - SHOULDER_START)))


def shade(surfels: Surfels, light: Light, degree: int = 0) -> Any:
    """[N, K, 3] display sRGB SH (K = (degree + 1)^2, degree 0, 1 or 2) of the surfels under the light; see
    `shade_all`. Raises ValueError for other degrees."""
    return shade_all(surfels, light.coefficients, light.exposure, degree)


def shade_all(surfels: Surfels, coefficients: Any, exposure: Any, degree: int = 0) -> Any:
    """[..., N, K, 3] display sRGB SH under lights with SH `coefficients` [..., 9, 3] and `exposure` [...].

    Degree 0: diffuse light plus the reflection averaged over the directions that see the surfel. Degree 1 and 2: exact
    when seen along the normal; the tone curve is linear around there, by the slope of a chord over the lobe's range.
    """
    if degree not in (0, 1, 2):
        raise ValueError(f"shade: expected a degree of 0, 1 or 2, got {degree}")
    lamps = torch.as_tensor(exposure, dtype=torch.float32, device=coefficients.device)[..., None, None]
    diffuse = _diffuse(surfels, coefficients)
    gloss = _reflectance(surfels) * surfels.occlusion[:, None]  # [N, 3]
    reach = _blur(surfels.roughness)  # [N, 9]
    around = sh_basis(surfels.normals, 2)
    if degree == 0:
        mean = (around * reach * _cosine(around) / torch.pi) @ coefficients
        return sh_from_color(tone_map(diffuse + gloss * mean.clamp_min(0), lamps))[..., None, :]
    lobe = mirrored_sh(coefficients, surfels.normals) * reach[:, :, None] * gloss[:, None]
    lobe = lobe[..., : (degree + 1) ** 2, :]  # [..., N, K, 3] radiance per direction from the camera
    towards = sh_basis(-surfels.normals, 2)[:, 1 : lobe.shape[-2], None]
    bent = (lobe[..., 1:, :] * towards).sum(-2)  # what bands >= 1 add when seen along the normal
    center = diffuse + (lobe[..., 0, :] * SH_C0 + bent).clamp_min(0)
    spread = 1.5 * (lobe[..., 1:, :].square().sum(-2) / (4 * torch.pi)).sqrt() + 1e-3 / lamps
    low, high = (center - spread).clamp_min(0), center + spread
    slope = (tone_map(high, lamps) - tone_map(low, lamps)) / (high - low)
    base = (tone_map(center, lamps) - 0.5 - slope * bent) / SH_C0
    return torch.cat([base[..., None, :], slope[..., None, :] * lobe[..., 1:, :]], -2)


BLOCKER_RADIANCE = 0.6
"""Radiance of what blocks a direction, over albedo times the mean radiance of the environment."""


def _diffuse(surfels: Surfels, coefficients: Any) -> Any:
    """[..., N, 3] linear radiance that leaves each surfel in all directions."""
    received = (surfels.transfer @ coefficients).clamp_min(0)
    # Blocked directions are not black: they show a neighbour of about the same colour in average light.
    mean = (coefficients[..., 0, :] * SH_C0).clamp_min(0)[..., None, :]
    returned = (1 - surfels.occlusion)[:, None] * (BLOCKER_RADIANCE * torch.pi) * surfels.albedo * mean
    return (1 - surfels.metallic)[:, None] * surfels.albedo * (received + returned) / torch.pi


def _reflectance(surfels: Surfels) -> Any:
    """[N, 3] share of light that the specular layer reflects: F0 A + B of the split sum (Karis' fit, 2014)."""
    metallic, rough = surfels.metallic[:, None], surfels.roughness[:, None]
    f0 = 0.04 * (1 - metallic) + surfels.albedo * metallic
    x, y, z, w = 1 - rough, 0.0425 - 0.0275 * rough, 1.04 - 0.572 * rough, 0.022 * rough - 0.04
    a = torch.minimum(x * x, torch.full_like(x, 2.0 ** (-9.28 * REFLECTANCE_COSINE))) * x + y
    return f0 * (-1.04 * a + z) + (1.04 * a + w).clamp_min(0)


def _blur(roughness: Any) -> Any:
    """[N, 9] what a GGX lobe of perceptual `roughness` leaves of each SH coefficient: exp(-l (l + 1) alpha^2), the lobe
    as a spherical Gaussian of sharpness 1 / (2 alpha^2) (Wang et al. 2009), alpha = roughness^2."""
    width = roughness.clamp(0, 1)[:, None] ** 4
    band = torch.tensor([0, 1, 1, 1, 2, 2, 2, 2, 2], dtype=roughness.dtype, device=roughness.device)
    return torch.exp(-band * (band + 1) * width)


def _cosine(like: Any) -> Any:
    """[9] what a clamped cosine does to each SH coefficient."""
    a, b, c = torch.pi, 2 * torch.pi / 3, torch.pi / 4
    return torch.tensor([a, b, b, b, c, c, c, c, c], dtype=like.dtype, device=like.device)


def random_light(rng: np.random.Generator, environments: Sequence[Any] = (), device: str = "cpu") -> Light:
    """A random light: one of the environments [h, w, 3] turned, cropped and tinted, or, without any (and one time in
    four), a procedural sky with one to three lamps. Deterministic in the generator's state."""
    if len(environments) and rng.random() < 0.75:
        which = int(rng.integers(len(environments)))
        picture, name = _varied(torch.as_tensor(environments[which]).cpu(), rng), f"environment {which}"
    else:
        picture, name = _sky(rng), "sky"
    _, area = equirectangular(*picture.shape[:2])
    mean = (picture * area[..., None]).sum((0, 1)) / (4 * torch.pi)
    cast = (mean / mean.mean().clamp_min(1e-8)).clamp_min(1e-3)
    # Photographers balance most of a colour cast away; what is left, and a random tint, is the look of the light.
    tint = torch.from_numpy(np.exp(rng.normal(0, 0.12, 3)).astype(np.float32)) * cast**-WHITE_BALANCE_EXPONENT
    picture, mean = picture * tint, mean * tint
    picture = picture + float(rng.uniform(0.05, 0.25)) * mean  # a little fill, as rooms and photographers give
    return make_light(picture, name, float(rng.uniform(-0.4, 0.3))).to(device)


def _varied(picture: Any, rng: np.random.Generator) -> Any:
    """The environment cropped to 60-100 % of its width and height, stretched to the whole sphere, turned about the
    vertical and mirrored at random."""
    h, w = picture.shape[:2]
    high, wide = (int(size * rng.uniform(0.6, 1)) for size in (h, w))
    top, turn = int(rng.integers(h - high + 1)), int(rng.integers(w))
    part = torch.roll(picture, turn, 1)[top : top + high, :wide]
    part = torch.nn.functional.interpolate(part.permute(2, 0, 1)[None], (h, w), mode="bilinear")[0].permute(1, 2, 0)
    part = torch.roll(part, int(rng.integers(w)), 1)  # else the crop's seam would always lie ahead
    return part.flip(1) if rng.random() < 0.5 else part


def _sky(rng: np.random.Generator, height: int = 64) -> Any:
    """[64, 128, 3] a sky gradient over a ground, and one to three round lamps with soft rims."""
    towards, _ = equirectangular(height, 2 * height)
    y = towards[..., 1:2]
    zenith, horizon, ground = (
        torch.from_numpy(_tone(rng, low, high)) for low, high in ((0.2, 1), (0.4, 1.4), (0.1, 0.6))
    )
    up = (horizon + (zenith - horizon) * y.clamp_min(0) ** float(rng.uniform(0.4, 1))) * (y > 0)
    picture = up + ground * (y <= 0)
    for _ in range(int(rng.integers(1, 4))):
        axis = rng.normal(size=3)
        axis[1] = abs(axis[1]) + rng.uniform(-0.2, 0.8)
        axis = torch.from_numpy((axis / np.linalg.norm(axis)).astype(np.float32))
        size = float(rng.uniform(0.08, 0.5))  # radians
        rim = float(np.cos(size))
        inside = ((towards @ axis - rim) / (1 - rim) * 2).clamp(0, 1)[..., None]
        power = float(rng.uniform(0.6, 4.0)) / (2 * np.pi * (1 - rim))  # irradiance of the lamp, about
        picture = picture + inside * power * torch.from_numpy(_tone(rng, 0.7, 1.0))
    return picture


def _tone(rng: np.random.Generator, low: float, high: float) -> np.ndarray:
    """[3] float32 a slightly coloured level."""
    level = rng.uniform(low, high)
    return (level * np.exp(rng.normal(0, 0.18, 3))).astype(np.float32)


def mirrored_sh(coefficients: Any, normals: Any) -> Any:
    """[..., N, 9, 3] coefficients of g(d) = f(d - 2 (n . d) n) for every normal n [N, 3], from those of f [..., 9, 3].

    Exact: band 1 is a vector m, which becomes H m; band 2 is a symmetric traceless matrix Q, which becomes H Q H, with
    the Householder matrix H = I - 2 n n^T.
    """
    n = normals
    lead = coefficients.unsqueeze(-3)  # [..., 1, 9, 3]
    vector = torch.stack([-lead[..., 3, :], -lead[..., 1, :], lead[..., 2, :]], -2)  # [..., 1, 3 xyz, 3 rgb]
    vector = vector - 2 * n[:, :, None] * (n[:, :, None] * vector).sum(-2, keepdim=True)
    q = _band2_matrix(lead)  # [..., 1, 3, 3, rgb]
    nq = (n[:, :, None, None] * q).sum(-3)  # [..., N, 3, rgb] = n^T Q
    nqn = (n[:, :, None] * nq).sum(-2)  # [..., N, rgb]
    outer = n[:, :, None, None] * nq.unsqueeze(-3)  # n_i (nQ)_j
    nn = n[:, :, None, None] * n[:, None, :, None]
    turned = q - 2 * (outer + outer.transpose(-3, -2)) + 4 * nn * nqn[..., None, None, :]
    band2 = _band2_coefficients(turned)
    band0 = lead[..., 0, :].expand(band2.shape[:-2] + (3,))
    vector = vector.expand(band2.shape[:-2] + (3, 3))
    band1 = torch.stack([-vector[..., 1, :], vector[..., 2, :], -vector[..., 0, :]], -2)
    return torch.cat([band0.unsqueeze(-2), band1, band2], -2)


def _band2_matrix(c: Any) -> Any:
    """[..., 3, 3, rgb] symmetric traceless Q with d^T Q d = sum of band 2 at unit d; c: [..., 9, rgb]."""
    xy, yz, zz, xz, xx = c[..., 4, :], c[..., 5, :], c[..., 6, :], c[..., 7, :], c[..., 8, :]
    a, b, e = SH_C2[0] / 2 * xy, -SH_C2[0] / 2 * yz, -SH_C2[0] / 2 * xz
    z, w = SH_C2[1] * zz, SH_C2[2] * xx  # 3 z^2 - 1 = 2 z^2 - x^2 - y^2 on the sphere
    matrix = [[w - z, a, e], [a, -w - z, b], [e, b, 2 * z]]
    return torch.stack([torch.stack(row, -2) for row in matrix], -3)


def _band2_coefficients(q: Any) -> Any:
    """[..., 5, rgb], the inverse of `_band2_matrix`."""
    return torch.stack(
        [
            q[..., 0, 1, :] * (2 / SH_C2[0]),
            q[..., 1, 2, :] * (-2 / SH_C2[0]),
            q[..., 2, 2, :] / (2 * SH_C2[1]),
            q[..., 0, 2, :] * (-2 / SH_C2[0]),
            (q[..., 0, 0, :] - q[..., 1, 1, :]) / (2 * SH_C2[2]),
        ],
        -2,
    )


def equirectangular(height: int, width: int, device: Any = "cpu", dtype: Any = torch.float32) -> tuple[Any, Any]:
    """(unit directions [h, w, 3] of an equirectangular picture's pixel centres, solid angles [h, 1], steradian).

    Column u = atan2(x, -z) / 2 pi (mod 1), row v = acos(y) / pi: Mitsuba's layout, y up.
    """
    edges = torch.cos(torch.linspace(0, torch.pi, height + 1, device=device, dtype=torch.float64))
    area = ((edges[:-1] - edges[1:]) * (2 * torch.pi / width)).to(dtype)
    v = (torch.arange(height, device=device, dtype=dtype) + 0.5) * (torch.pi / height)
    u = (torch.arange(width, device=device, dtype=dtype) + 0.5) * (2 * torch.pi / width)
    ring, y = torch.sin(v)[:, None], torch.cos(v)[:, None]
    x, z = ring * torch.sin(u), -ring * torch.cos(u)
    return torch.stack([x, y.expand_as(x), z], -1), area[:, None]


def project_sh(environment: Any) -> Any:
    """[9, 3] coefficients of an equirectangular picture [h, w, 3]."""
    towards, area = equirectangular(environment.shape[0], environment.shape[1], environment.device, environment.dtype)
    weighted = sh_basis(towards, 2) * area[..., None]
    return torch.einsum("hwk,hwc->kc", weighted, environment)
