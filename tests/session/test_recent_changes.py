"""Changes between assets that were compared lately: the same rows as by comparing all values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.session.replay import recent_changes
from splatpainter.session.replay.recent_changes import changes, note_changes
from splatpainter.splats import Splats, changed_rows
from tests.support.render_scenes import scene


def edited(splats: Splats, rows: list[int], more: int = 0) -> Splats:
    """With other opacities in some rows and `more` appended."""
    opacities = splats.opacities.copy()
    opacities[rows] = opacities[rows] * np.float32(0.5)
    return replace(splats, opacities=opacities, means=splats.means.copy()).append(splats.take(np.arange(more)))


@pytest.fixture
def compared(monkeypatch):
    """[rows that `changed_rows` was asked about, None: all], for each time that it was."""
    requests = []

    def count(before: Splats, after: Splats, among: np.ndarray | None = None) -> np.ndarray:
        requests.append(None if among is None else among.tolist())
        return changed_rows(before, after, among)

    monkeypatch.setattr(recent_changes, "changed_rows", count)
    recent_changes._recent.clear()
    yield requests
    recent_changes._recent.clear()


def test_what_was_compared_is_not_compared_again_in_either_direction(compared):
    first = scene(60, seed=1, dtype=np.float32)
    second = edited(first, [3, 9], 4)
    note_changes(first, second, np.array([3, 9]))
    for pair in ((first, second), (second, first), (first, replace(second, origin=np.arange(64)))):
        assert changes(*pair).tolist() == [3, 9]
    assert compared == []
    assert changes(first, edited(first, [5])).tolist() == [5]
    assert compared == [None]


def test_over_a_third_asset_only_what_changed_on_the_way_is_compared(compared):
    first = scene(60, seed=2, dtype=np.float32)
    second = edited(first, [3, 9], 4)
    third = edited(second, [9, 20, 62], 2)
    third.opacities[3] = first.opacities[3]  # as it was
    note_changes(first, second, np.array([3, 9]))
    note_changes(second, third, changed_rows(second, third))
    assert changes(first, third).tolist() == changed_rows(first, third).tolist() == [9, 20]
    assert compared == [[3, 9, 20]]
    assert changes(third, first).tolist() == [9, 20] and len(compared) == 1


def test_a_shorter_asset_on_the_way_does_not_hide_what_came_after_it(compared):
    first = scene(60, seed=3, dtype=np.float32)
    long = edited(first, [1], 8)
    other = edited(long, [2, 65])
    note_changes(long, first, changed_rows(long, first))
    note_changes(first, other, changed_rows(first, other))
    assert changes(long, other).tolist() == changed_rows(long, other).tolist() == [2, 65]
    assert compared == [None]
