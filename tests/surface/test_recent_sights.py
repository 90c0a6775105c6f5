"""Estimates of the latest edit: the next one from its camera takes them, to the bit, and nobody else's."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.kernels import arrays
from splatpainter.lift.sheets.paint import paint_view
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.surface import recent_sights
from splatpainter.surface.estimate import Surface, SurfacePoints
from tests.support.lift_scenes import disk, front
from tests.support.studio_scenes import ball

CAMERA = front(96)


@pytest.fixture
def queries(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many places the surface was asked about, edit by edit."""
    counts: list[int] = []
    at = Surface.at

    def counted(self: Surface, points: np.ndarray, *args: np.ndarray) -> SurfacePoints:
        counts.append(len(points))
        return at(self, points, *args)

    monkeypatch.setattr(Surface, "at", counted)
    monkeypatch.setattr(recent_sights, "_latest", [])
    return counts


def painted(splats: Splats, surface: Surface, radius: float = 12, camera: Camera = CAMERA) -> Splats:
    mask = disk(camera, 48, 48, radius)
    picture = np.where(mask[..., None], np.float32(0.2), render(splats, camera).colors[0])
    return paint_view(splats, surface, camera, picture, mask).splats


def test_paint_over_paint_asks_again_only_what_is_new_and_changes_no_bit(
    queries: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = ball(3000)
    surface = Surface.of(splats)
    once = painted(splats, surface)
    again = painted(splats, surface)
    first, second = queries
    assert first > 100 and second == 0
    wider = painted(splats, surface, 18)
    over = painted(once, surface)  # the paint lies a little beside what was there
    # Each of them alone.
    monkeypatch.setattr(recent_sights, "RECENT_SIGHTS", replace(recent_sights.RECENT_SIGHTS, most_lines=0))
    recent_sights._latest.clear()
    queries_before = queries[2:]
    queries.clear()
    for shared, alone in (
        (again, painted(splats, surface)),
        (wider, painted(splats, surface, 18)),
        (over, painted(once, surface)),
    ):
        for name in ATTRIBUTES:
            assert getattr(shared, name).tobytes() == getattr(alone, name).tobytes()
    assert queries[0] == first and 0 < queries_before[0] < queries[1] and queries_before[1] < queries[2]


def test_other_surfaces_cameras_and_processes_know_nothing_of_it(queries: list[int]) -> None:
    splats = ball(3000)
    surface = Surface.of(splats)
    painted(splats, surface)
    painted(splats, Surface.of(splats))
    painted(splats, surface)
    painted(splats, surface, camera=replace(CAMERA, fx=CAMERA.fx + 1))
    assert all(count > 100 for count in queries) and queries[0] == queries[1] == queries[2]


def test_it_is_kept_no_longer_than_its_surface_nor_where_memory_is_dear(
    queries: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    splats = ball(3000)
    surface = Surface.of(splats)
    painted(splats, surface)
    assert recent_sights._latest
    del surface
    gc.collect()
    assert not recent_sights._latest
    monkeypatch.setattr(arrays._idle, "limits", replace(arrays.IDLE_LIMITS, most_bytes=0))
    surface = Surface.of(splats)
    painted(splats, surface)
    assert not recent_sights._latest
    monkeypatch.undo()
    monkeypatch.setattr(recent_sights, "RECENT_SIGHTS", replace(recent_sights.RECENT_SIGHTS, most_lines=100))
    painted(splats, surface)
    assert not recent_sights._latest
