"""Ridge regression of a change of colour on colour and normal: what a global edit does to Gaussians that no view shows.

The change of base colour is regressed on SH_2(normal) x (old colour, 1): the linear cousin of test-time training. N
Gaussians, S of them seen.
"""

from __future__ import annotations

import numpy as np

from splatpainter.lift.options import GlobalOptions

MAX_WEIGHT_PX = 50.0
"""A huge Gaussian must not outvote a thousand small ones."""


def regression_features(colors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[N, 36]: nine real spherical harmonics of the normal, each times (r, g, b, 1); the constant one's four first."""
    x, y, z = normals.T
    basis = np.stack([np.ones_like(x), y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y], 1)
    rgb1 = np.concatenate([colors, np.ones((len(colors), 1), colors.dtype)], 1)
    return (basis[:, :, None] * rgb1[:, None]).reshape(len(colors), 36).astype(np.float32)


def ridge(
    features: np.ndarray, change: np.ndarray, weight: np.ndarray, options: GlobalOptions
) -> tuple[np.ndarray, np.ndarray]:
    """(solution [36, 3], inverse normal matrix [36, 36]) in float64. features: [S, 36]; change: [S, 3]; weight: [S]
    pixels that show each."""
    capped = np.minimum(weight, MAX_WEIGHT_PX).astype(np.float64)
    scaled = features * np.sqrt(capped).astype(np.float32)[:, None]
    gram = (scaled.T @ scaled).astype(np.float64)
    penalty = np.full(36, options.ridge_normals)
    penalty[:4] = options.ridge
    inverse = np.linalg.inv(gram + np.diag(penalty * capped.sum()))
    return inverse @ (scaled.T @ (change * np.sqrt(capped)[:, None]).astype(np.float32)), inverse


def color_matrices(features: np.ndarray, solution: np.ndarray) -> np.ndarray:
    """[N, 3, 3] d new colour / d old colour of the regression, which acts on SH bands >= 1 too; kept within 0..2 on the
    diagonal so that an extrapolation never inverts a highlight."""
    basis = features.reshape(-1, 9, 4)[:, :, 3]  # the SH of the normal (the feature that multiplies 1)
    linear = solution.reshape(9, 4, 3)[:, :3]  # [9, in, out]
    matrix = (basis @ linear.transpose(0, 2, 1).reshape(9, 9).astype(np.float32)).reshape(-1, 3, 3) + np.eye(3)
    diagonal = np.clip(np.einsum("nii->ni", matrix), 0, 2)
    matrix[:, [0, 1, 2], [0, 1, 2]] = diagonal
    return matrix.astype(np.float32)
