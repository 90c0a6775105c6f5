"""What the networks are told of a Gaussian besides its latent: colour, normal, place, size, and the light it gets.

numpy: an edit by the stored predictor needs no torch. N Gaussians.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels import portable
from splatpainter.splats import SH_C0, Splats

FACTS = 21
"""Numbers per Gaussian: `gaussian_facts`."""
INPUT_CHANNELS = FACTS + 8 + 27
"""Facts, eight polynomials of the normal, and transfer times colour: `described`."""
LARGEST_DISTANCE = 3.0
"""Places farther than this many radii of the asset's ball are told as that far: specks around captures."""


def gaussian_facts(splats: Splats, normals: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """[N, 21] float32: base colour - 0..1 as -1..1 -, normal, place in the asset's ball, opacity, log of the mean scale
    over the ball's radius, transfer and open share. splats: numpy; normals: [N, 3] of `outward_normals`; transfer:
    [N, 10] of `prt_transfer`. Gaussians that cannot be drawn get zeros. At least one Gaussian must be drawable."""
    drawn = splats.drawable
    means = splats.means[drawn]
    middle = np.median(means, 0)
    away = (means - middle).astype(np.float64)
    radius = max(float(np.quantile(np.linalg.norm(away, axis=1), 0.98)), 1e-12)
    size = portable.log(np.maximum(splats.scales[drawn].mean(1, dtype=np.float64) / radius, 1e-9))
    facts = np.zeros((len(splats), FACTS), np.float32)
    facts[drawn] = np.concatenate(
        [
            2 * np.clip(0.5 + SH_C0 * splats.sh[drawn, 0], 0, 1) - 1,
            normals[drawn],
            np.clip(away / radius, -LARGEST_DISTANCE, LARGEST_DISTANCE),
            2 * splats.opacities[drawn, None] - 1,
            size[:, None] / 2 + 2,
            transfer[drawn, :9],
            2 * transfer[drawn, 9:] - 1,
        ],
        1,
    )
    return facts


def described(facts: np.ndarray) -> np.ndarray:
    """[N, INPUT_CHANNELS] float32 what networks see of Gaussians. facts: [N, 21] of `gaussian_facts`."""
    x, y, z = facts[:, 3:6].T
    turns = np.stack([x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y, x * x, y * y, z * z], 1)
    lit = facts[:, 11:20, None] * (facts[:, None, :3] + 1) / 2
    return np.concatenate([facts, turns, lit.reshape(len(facts), -1)], 1)


def evenly_spread(values: np.ndarray, most: int) -> np.ndarray:
    """At most `most` of these, evenly over their order."""
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(np.int64)]
