"""The light that reaches Gaussians: closed forms where there are any."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lighting import prt_transfer, unoccluded_transfer
from tests.lift.test_global import ball

C0 = 0.28209479177387814


def test_a_ball_stands_in_nobodys_light() -> None:
    splats = ball(2000)
    normals = outward_normals(splats)
    transfer = prt_transfer(splats.means, normals)
    np.testing.assert_allclose(transfer[:, :9], unoccluded_transfer(normals) / np.pi, atol=0.03)
    np.testing.assert_allclose(transfer[:, 0], C0, atol=0.01)  # uniform light of radiance 1 / C0
    assert transfer[:, 9].min() > 0.95


def test_what_lies_between_two_plates_sees_less() -> None:
    side = np.linspace(-1, 1, 160)
    x, z = (v.ravel() for v in np.meshgrid(side, side))
    floor = np.stack([x, np.zeros_like(x), z], 1).astype(np.float32)
    up = np.tile(np.array([0, 1, 0], np.float32), (len(floor), 1))
    roof = floor + np.array([0, 1, 0], np.float32)
    alone = prt_transfer(floor, up)
    under = prt_transfer(np.concatenate([floor, roof]), np.concatenate([up, up]))
    middle = (np.abs(x) < 0.3) & (np.abs(z) < 0.3)
    assert alone[middle, 9].min() > 0.95
    # A square of edge 2 at height 1 above: the view factor of its middle, by Hamilton and Morgan (1952).
    factor = 4 / np.pi * np.sqrt(0.5) * np.arctan(np.sqrt(0.5))
    center = (np.abs(x) < 0.06) & (np.abs(z) < 0.06)
    assert under[: len(floor)][center, 9].mean() == pytest.approx(1 - factor, abs=0.06)
    assert under[len(floor) :, 9][middle].min() > 0.95


def test_gaussians_without_a_normal_count_for_nothing() -> None:
    splats = ball(500)
    normals = outward_normals(splats)
    odd = np.concatenate([splats.means, np.full((2, 3), np.nan, np.float32)])
    held = prt_transfer(odd, np.concatenate([normals, np.zeros((2, 3), np.float32)]))
    np.testing.assert_array_equal(held[:-2], prt_transfer(splats.means, normals))
    assert not held[-2:].any() and not prt_transfer(odd, np.zeros_like(odd)).any()
    assert prt_transfer(odd[:1], normals[:1]).shape == (1, 10)
