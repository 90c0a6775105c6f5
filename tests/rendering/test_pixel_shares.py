"""Shares of pixels and means over footprints, against a dense compositor and by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.rendering.pixel_shares import footprint_mean, share_of
from splatpainter.splats import Splats
from tests.support.lift_scenes import dense_weights, front, sheet

SIZE = 48


def asset() -> Splats:
    """An opaque sheet, and another one behind it that faces away."""
    return sheet(24, opacity=0.97).append(sheet(12, z=-0.8, opacity=0.97))


def test_pixel_shares_are_those_of_a_dense_compositor() -> None:
    splats, camera = asset(), replace(front(SIZE), background=(1.0, 0.5, 0.2))
    rng = np.random.default_rng(0)
    dense, _ = dense_weights(splats, camera)
    for weights in (rng.random(len(splats)) < 0.3, rng.random(len(splats))):
        expected = (dense * weights[:, None]).sum(0).reshape(SIZE, SIZE)
        shares = share_of(splats, camera, weights)
        assert shares.dtype == np.float32
        np.testing.assert_allclose(shares, expected, atol=3e-3)  # ours stops at 1e-4 of transmittance


def test_a_footprint_means_the_picture_under_it_whatever_is_before_it() -> None:
    splats, camera = asset(), front(SIZE)
    ramp = np.tile((np.arange(SIZE) + 0.5) / SIZE, (SIZE, 1))
    means = footprint_mean(splats, camera, ramp)
    pixels, _ = camera.project(splats.means)
    inside = np.all((pixels > 8) & (pixels < SIZE - 8), axis=1)
    assert inside[: 24**2].any() and inside[24**2 :].any()
    np.testing.assert_allclose(means[inside], pixels[inside, 0] / SIZE, atol=0.01)
    np.testing.assert_array_equal(footprint_mean(splats, camera, np.ones((SIZE, SIZE), bool))[inside], 1)
    away = camera.cropped(10 * SIZE, 0, SIZE, SIZE)
    assert not footprint_mean(splats, away, ramp).any()
