"""Real spherical harmonics of degree 2 in torch: projection, evaluation, and mirroring of a function in a plane.

INRIA's order and signs, as everywhere in the package; float32 or float64, any device, any leading dimensions.
"""

from __future__ import annotations

from typing import Any

import torch

C0, C1 = 0.28209479177387814, 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)


def basis(directions: Any) -> Any:
    """[..., 9] Y_k of unit directions [..., 3]."""
    x, y, z = directions.unbind(-1)
    terms = [
        torch.full_like(x, C0),
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (3 * z * z - 1),
        -C2[0] * x * z,
        C2[2] * (x * x - y * y),
    ]
    return torch.stack(terms, -1)


def mirrored(coefficients: Any, normals: Any) -> Any:
    """[..., N, 9, 3] coefficients of g(d) = f(d - 2 (n . d) n) for every normal n [N, 3], from those of f [..., 9, 3].

    Exact: band 1 is a vector m, which becomes H m; band 2 is a symmetric traceless matrix Q, which becomes H Q H, with
    the Householder matrix H = I - 2 n n^T.
    """
    n = normals
    lead = coefficients.unsqueeze(-3)  # [..., 1, 9, 3]
    vector = torch.stack([-lead[..., 3, :], -lead[..., 1, :], lead[..., 2, :]], -2)  # [..., 1, 3 xyz, 3 rgb]
    vector = vector - 2 * n[:, :, None] * (n[:, :, None] * vector).sum(-2, keepdim=True)
    q = _matrix(lead)  # [..., 1, 3, 3, rgb]
    nq = (n[:, :, None, None] * q).sum(-3)  # [..., N, 3, rgb] = n^T Q
    nqn = (n[:, :, None] * nq).sum(-2)  # [..., N, rgb]
    outer = n[:, :, None, None] * nq.unsqueeze(-3)  # n_i (nQ)_j
    nn = n[:, :, None, None] * n[:, None, :, None]
    turned = q - 2 * (outer + outer.transpose(-3, -2)) + 4 * nn * nqn[..., None, None, :]
    band2 = _coefficients(turned)
    band0 = lead[..., 0, :].expand(band2.shape[:-2] + (3,))
    vector = vector.expand(band2.shape[:-2] + (3, 3))
    band1 = torch.stack([-vector[..., 1, :], vector[..., 2, :], -vector[..., 0, :]], -2)
    return torch.cat([band0.unsqueeze(-2), band1, band2], -2)


def _matrix(c: Any) -> Any:
    """[..., 3, 3, rgb] symmetric traceless Q with d^T Q d = sum of band 2 at unit d; c: [..., 9, rgb]."""
    xy, yz, zz, xz, xx = c[..., 4, :], c[..., 5, :], c[..., 6, :], c[..., 7, :], c[..., 8, :]
    a, b, e = C2[0] / 2 * xy, -C2[0] / 2 * yz, -C2[0] / 2 * xz
    z, w = C2[1] * zz, C2[2] * xx  # 3 z^2 - 1 = 2 z^2 - x^2 - y^2 on the sphere
    rows = [[w - z, a, e], [a, -w - z, b], [e, b, 2 * z]]
    return torch.stack([torch.stack(row, -2) for row in rows], -3)


def _coefficients(q: Any) -> Any:
    """[..., 5, rgb], the inverse of `_matrix`."""
    return torch.stack(
        [
            q[..., 0, 1, :] * (2 / C2[0]),
            q[..., 1, 2, :] * (-2 / C2[0]),
            q[..., 2, 2, :] / (2 * C2[1]),
            q[..., 0, 2, :] * (-2 / C2[0]),
            (q[..., 0, 0, :] - q[..., 1, 1, :]) / (2 * C2[2]),
        ],
        -2,
    )


def directions(height: int, width: int, device: Any = "cpu", dtype: Any = torch.float32) -> tuple[Any, Any]:
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


def project(environment: Any) -> Any:
    """[9, 3] coefficients of an equirectangular picture [h, w, 3]."""
    towards, area = directions(environment.shape[0], environment.shape[1], environment.device, environment.dtype)
    weighted = basis(towards) * area[..., None]
    return torch.einsum("hwk,hwc->kc", weighted, environment)
