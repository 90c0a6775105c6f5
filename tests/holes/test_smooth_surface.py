"""Thin plates: what they go through, and knots that leave one open."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.holes.smooth_surface import ThinPlate


def test_a_plane_is_continued_whatever_one_value_says() -> None:
    rng = np.random.default_rng(0)
    points, queries = rng.uniform(-1, 1, (40, 2)), rng.uniform(-2, 2, (30, 2))
    values = 0.5 + points @ (2.0, -1.0)
    values[7] += 3.0
    plate = ThinPlate.fit(points, values, noise=1e-3)
    assert plate.at(queries) == pytest.approx(0.5 + queries @ (2.0, -1.0), abs=0.02)


def test_knots_on_a_line_say_nothing_about_the_way_across() -> None:
    along = np.linspace(0, 1, 12)
    plate = ThinPlate.fit(np.stack([along, along], 1), along**2, noise=1e-3)
    line = np.linspace(0.1, 0.9, 5)
    assert plate.at(np.stack([line, line], 1)) == pytest.approx(line**2, abs=0.01)
    left, right = (plate.at(np.stack([line + side, line - side], 1)) for side in (0.2, -0.2))
    assert left == pytest.approx(right, abs=1e-6)
