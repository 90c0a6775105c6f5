"""Colour transfer row by row: a closed-form least-squares step for every row's SH alone, repeated a few times.

Each round solves, for every row i on its own, min over change d_i of
sum_vp w_ivp |r_vp - B_iv d_i|^2 + sum_v,p w_ivp (d_i + k_i - k0_i)^T L (d_i + k_i - k0_i), with the residual r of the
pictures as they are, the SH basis B_iv towards view v, the coefficients k0_i before the edit, and L = 0 for the
constant band, `damping` * Y_00^2 above. As sum_i w_ip <= 1 this majorises the error of the pictures together with that
penalty: all rows may step at once, and the sum cannot rise (Instant Colorization's setting, arXiv 2604.17155; the
formulas are this package's own). With the constant band alone it is the SIRT iteration of lift/colors.py.
Knows no masks beyond the pixels it is given. N rows, M drawn in a view, K coefficients, V views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatbench.methods.transfer_affine import Shown
from splatpainter.splats import SH_C0, Splats

SEEN = 0.05
"""Rows with less weight than this in all views together, pixels, keep their colours."""
BRIGHTEST = 1.3
"""Base colours stay in 0..BRIGHTEST (or where they were): a row drawn as 0 would sink without end."""
BLOCK = 1 << 13
"""Rows solved at a time."""


def fit_rows(
    splats: Splats, views: Sequence[Shown], rounds: int, damping: float, degree: int
) -> tuple[Splats, np.ndarray]:
    """(the splats with new SH, [N] bool rows that were seen). degree: bands above are left as they are (at most the
    asset's own). Raises nothing; rows that are not seen keep their bits."""
    count = min((degree + 1) ** 2, splats.sh.shape[1])
    total = np.zeros(len(splats))
    parts = []  # (view, [M, K] basis, [M] weight)
    for view in views:
        basis = sh_basis(splats.means[view.frame.gaussian_ids], view.frame.camera.position, splats.sh.shape[1])
        weight = view.frame.backproject(view.target, view.use.astype(np.float32)).weight.astype(np.float64)
        parts.append((view, basis, weight))
        total[view.frame.gaussian_ids] += weight
    seen = total > SEEN
    place = np.cumsum(seen) - 1  # row -> among the S seen ones
    start = splats.sh[seen].astype(np.float64)  # [S, K, 3]
    penalty = np.full(count, damping * SH_C0**2)
    penalty[0] = 0
    gram = np.zeros((len(start), count, count))
    for view, basis, weight in parts:
        own = seen[view.frame.gaussian_ids]
        b = basis[own][:, :count]
        gram[place[view.frame.gaussian_ids[own]]] += weight[own][:, None, None] * b[:, :, None] * b[:, None, :]
    gram[:, range(count), range(count)] += total[seen][:, None] * penalty
    sh = start.copy()
    low, high = np.minimum(0.5 + SH_C0 * start[:, 0], 0), np.maximum(0.5 + SH_C0 * start[:, 0], BRIGHTEST)
    for _ in range(rounds):
        rhs = -total[seen][:, None, None] * penalty[:, None] * (sh - start)[:, :count]
        for view, basis, _ in parts:
            rows = view.frame.gaussian_ids
            own = seen[rows]
            colors = view.frame.unclamped_colors.astype(np.float64).copy()
            colors[own] = 0.5 + np.einsum("mk,mkj->mj", basis[own], sh[place[rows[own]]])
            painted = np.maximum(colors, 0).astype(view.frame.projected.dtype)
            gain, _ = view.frame.sirt_step(view.target, view.use.astype(np.float32), painted)
            rhs[place[rows[own]]] += basis[own][:, :count, None] * gain[own][:, None].astype(np.float64)
        sh[:, :count] += _solved(gram, rhs)
        sh[:, 0] = (np.clip(0.5 + SH_C0 * sh[:, 0], low, high) - 0.5) / SH_C0
    out = splats.sh.copy()
    out[seen] = sh.astype(out.dtype)
    return replace(splats, sh=out), seen


def sh_basis(means: np.ndarray, eye: np.ndarray, count: int) -> np.ndarray:
    """[M, K] float64 real spherical harmonics towards rows at `means` [M, 3] from `eye` [3], INRIA's order and signs
    (the renderer's own, reference.py)."""
    import torch

    from splatpainter.rendering.reference import harmonics

    direction = means.astype(np.float64) - eye
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    return harmonics(torch.from_numpy(direction), count).numpy()


def _solved(gram: np.ndarray, rhs: np.ndarray) -> np.ndarray:
    """[S, K, 3] solutions of S systems; gram: [S, K, K], positive definite."""
    out = np.empty_like(rhs)
    for first in range(0, len(gram), BLOCK):
        part = slice(first, first + BLOCK)
        out[part] = np.linalg.solve(gram[part], rhs[part])
    return out
