"""Fit lift/local/split_table.json: the peaks of the five Gaussians that stand in for one that is halved.

For a unit Gaussian of peak alpha o, children half as wide along x, as wide across, on sites CHILD_SPACING / 2 apart,
get symmetric peaks p_j such that 1 - prod_j(1 - a_j) equals the parent's alpha in the plane (least squares). Alpha
compositing is not additive; what the fit leaves is printed (1.4 % of the parent for faint Gaussians, 6.6 % for opaque).

Run: python scripts/calibrate/split_table.py (a few seconds; needs scipy).
"""

import json
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

CHILD_SPACING, CHILD_REACH_SITES, CHILD_WIDTH = 1.75, 2, 0.5  # as in splatpainter.lift.local.split
OPACITIES = [0.01, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.87, 0.93, 0.97, 0.99, 0.999]
X = np.linspace(-5, 5, 201)[:, None]
Y = np.linspace(0, 3.5, 29)[None]


def residual(logits: np.ndarray, opacity: float) -> np.ndarray:
    peaks = 1 / (1 + np.exp(-logits))
    clear = 0.0
    for j in range(-CHILD_REACH_SITES, CHILD_REACH_SITES + 1):
        alpha = peaks[abs(j)] * np.exp(-((X - j * CHILD_SPACING * CHILD_WIDTH) ** 2) / (2 * CHILD_WIDTH**2) - Y**2 / 2)
        clear = clear + np.log1p(-np.minimum(alpha, 0.9999))
    return ((1 - np.exp(clear)) - opacity * np.exp(-(X**2 + Y**2) / 2)).ravel()


def main() -> None:
    start, peaks = np.full(CHILD_REACH_SITES + 1, -5.0), []
    for opacity in OPACITIES:
        fit = least_squares(residual, np.clip(start, -8, 6.9), args=(opacity,))
        start = fit.x
        peaks.append([round(float(v), 5) for v in 1 / (1 + np.exp(-fit.x))])
        error = np.sqrt((fit.fun**2).sum() / ((opacity * np.exp(-(X**2 + Y**2) / 2)) ** 2).sum())
        print(f"opacity {opacity}: peaks {peaks[-1]}, relative rms error of alpha {error:.3f}")
    target = Path(__file__).parents[2] / "src/splatpainter/lift/local/split_table.json"
    target.write_bytes(json.dumps({"opacities": OPACITIES, "peaks": peaks}).encode() + b"\n")


if __name__ == "__main__":
    main()
