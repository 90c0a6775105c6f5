"""New Gaussians with fewer significant bits than float32 has, so that projects which store them stay small.

Floats of Gaussians hardly compress: their low mantissa bits are noise. What stays is finer than any compressed file
format of splats is; means keep all that their Gaussian's own thickness can tell.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.splats import Splats
from splatpainter.transforms import row_max

SIGNIFICANT_BITS = 12
"""Significant bits of quats, scales and opacities: a relative error of 2^-12 at most."""
SH_STEP = 2.0**-11
"""Step of SH coefficients: 0.00007 of a colour where there is one band, 0..1."""
MEAN_STEPS = 16
"""Steps of a mean within the smallest standard deviation, at least; a power of two."""


def rounded(splats: Splats) -> Splats:
    """The same Gaussians (S of them, finite, scales > 0), rounded; doing it twice changes nothing more."""
    smallest = -row_max(-splats.scales)
    # A power of two below the Gaussian's own thickness: rounding moves it by less than it can show.
    step = np.ldexp(np.ones(len(splats)), np.frexp(smallest)[1] - 1 - (MEAN_STEPS.bit_length() - 1))[:, None]
    means = np.rint(splats.means.astype(np.float64) / step) * step
    arrays = {name: _significant(getattr(splats, name)) for name in ("quats", "scales", "opacities")}
    sh = np.rint(splats.sh / SH_STEP) * SH_STEP
    return replace(splats, means=means.astype(splats.means.dtype), sh=sh.astype(splats.sh.dtype), **arrays)


def _significant(values: np.ndarray) -> np.ndarray:
    """Values of any shape to SIGNIFICANT_BITS."""
    mantissa, exponent = np.frexp(values)
    steps = np.rint(np.ldexp(mantissa, SIGNIFICANT_BITS))
    return np.ldexp(steps, exponent - SIGNIFICANT_BITS).astype(values.dtype, copy=False)
