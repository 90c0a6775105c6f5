"""New Gaussians are rounded to what can be seen of them, and compress."""

from __future__ import annotations

import numpy as np
import pytest
import zstandard

from splatpainter.lift.sheets.rounding import MEAN_STEPS, SH_STEP, SIGNIFICANT_BITS, rounded
from splatpainter.splats import ATTRIBUTES
from tests.support.io_assets import random_splats
from tests.support.lift_scenes import same_bits


@pytest.mark.parametrize("away", [0.0, 1000.0])
def test_errors_stay_below_what_it_promises(away: float) -> None:
    splats = random_splats(500, 2)
    splats.means[:] += away
    result = rounded(splats)
    assert all(getattr(result, name).dtype == getattr(splats, name).dtype for name in ATTRIBUTES)
    assert np.abs(result.sh - splats.sh).max() <= SH_STEP / 2
    assert not np.remainder(result.sh, SH_STEP).any()
    for name in ("quats", "scales", "opacities"):
        values, new = getattr(splats, name), getattr(result, name)
        assert (np.abs(new - values) <= 2.0**-SIGNIFICANT_BITS * np.abs(values)).all(), name
        assert not (new.view(np.uint32) & ((1 << (24 - SIGNIFICANT_BITS)) - 1)).any(), name
    moved = np.abs(result.means.astype(float) - splats.means.astype(float))
    assert (moved <= splats.scales.min(1, keepdims=True) / MEAN_STEPS).all()
    assert (result.scales > 0).all()


def test_twice_is_once_and_zero_stays() -> None:
    splats = random_splats(200, 1)
    splats.opacities[:5] = 0
    splats.sh[7] = 0
    once = rounded(splats)
    assert same_bits(rounded(once), once)
    assert not once.opacities[:5].any() and not once.sh[7].any()


def test_they_take_less_room() -> None:
    def size(values: np.ndarray) -> int:
        return len(zstandard.compress(np.ascontiguousarray(values.view(np.uint8).reshape(-1, 4).T).tobytes()))

    splats = random_splats(3000, 1)
    result = rounded(splats)
    assert size(result.sh) < 0.65 * size(splats.sh)
    assert size(result.quats) < 0.65 * size(splats.quats)
