"""Points near to points, against all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.voxels import neighbours
from splatpainter.voxels.neighbours import near_pairs


def test_pairs_are_all_that_are_near_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "PAIRS_AT_ONCE", 100)
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * (1, 1, 0.2)
    one, two = near_pairs(points, 0.3)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    expected = np.argwhere(np.triu(distance <= 0.3, 1))
    pairs = np.sort(np.stack([one, two], 1), 1)
    np.testing.assert_array_equal(pairs[np.lexsort(pairs.T[::-1])], expected)
    assert len(expected) > 300


def test_no_points_have_no_pairs() -> None:
    for points in (np.zeros((0, 3)), np.zeros((1, 3))):
        assert [len(part) for part in near_pairs(points, 1.0)] == [0, 0]
