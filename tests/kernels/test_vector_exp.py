"""exp in vector code, against the one of the C library."""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.kernels.vector_exp import LOWEST, exp64


@njit
def _of(values, out):
    for k in range(len(values)):
        out[k] = exp64(values[k])


def test_exp_is_that_of_numpy_to_the_last_place_and_ends_at_0():
    rng = np.random.default_rng(0)
    values = np.concatenate([-rng.random(2000) * scale for scale in (1e-17, 1e-9, 1e-3, 1, 10, 700)])
    values = np.concatenate([values, [0.0, -0.0, LOWEST, 1.001 * LOWEST, -1e9, -np.inf, np.nan]])
    out = np.empty(len(values))
    _of(values, out)
    expected = np.exp(values)
    expected[values < LOWEST] = 0
    assert np.isnan(out[-1]) and (out[-4:-1] == 0).all()
    np.testing.assert_array_max_ulp(out[:-1], expected[:-1], 1)
    exact = np.array([np.exp(np.longdouble(value)) for value in values[:-4]])
    assert float((np.abs(out[:-4] - exact) / (exact * 2.0**-52)).max()) < 0.8
