"""Views edited nearly everywhere: those that contradict each other are lifted in turn, all others together."""

from __future__ import annotations

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift.contradictions import runs_that_agree
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import lift_local_views
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import db, sheet

WARM, COOL = (1.3, 0.7, 0.6), (0.6, 0.8, 1.3)


def close(degrees: float) -> Camera:
    """Of the plane z = 0, which fills its picture."""
    angle = np.radians(degrees)
    return look_at((1.1 * np.sin(angle), 0, 1.1 * np.cos(angle)), (0, 0, 0), width=64, height=64, fov=40)


def graded(splats: Splats, looks: list[tuple[float, tuple[float, float, float]]]) -> list[EditView]:
    cameras = [close(degrees) for degrees, _ in looks]
    drawn = [sp.render(splats, camera).colors[0] for camera in cameras]
    pictures = [np.clip(image * np.array(gains) + 0.1, 0, 1) for image, (_, gains) in zip(drawn, looks, strict=True)]
    return edit_views(splats, cameras, pictures, [np.ones((64, 64), bool) for _ in looks])


def lifted(splats: Splats, views: list[EditView]):
    return lift_local_views(splats, voxelize(splats), views, "lift", features=False, surface=Surface.of(splats))


def test_the_later_of_two_looks_that_contradict_each_other_wins_in_one_call_as_in_two() -> None:
    """They came out as their mean."""
    splats = sheet(50, opacity=0.98)
    views = graded(splats, [(0, WARM), (20, COOL)])
    assert [len(run) for run in runs_that_agree(splats, views)] == [1, 1]
    result = lifted(splats, views)
    assert db(sp.render(result.splats, views[1].camera).colors[0], views[1].edited, views[1].mask) > 27
    first = lifted(splats, views[:1]).splats
    second = lift_local_views(
        first,
        None,
        graded_again(first, views[1]),
        "lift",
        features=False,
        surface=Surface.of(splats),
        originals=len(splats),
    )
    for name in ("means", "sh", "opacities"):
        assert np.array_equal(getattr(result.splats, name), getattr(second.splats, name))
    # What is said of it is true of the asset as it was.
    count, same = len(splats), np.ones(len(splats), bool)
    same[result.ids[result.ids < count]] = False
    assert np.array_equal(result.splats.sh[:count][same], splats.sh[same])
    assert result.parents.max() < count and len(result.parents) == len(result.ids)
    assert (result.splats.opacities[result.removed] == 0).all()


def graded_again(splats: Splats, view: EditView) -> list[EditView]:
    return edit_views(splats, [view.camera], [view.edited], [view.mask])


@pytest.mark.parametrize("degrees", [0, 25, 50])
def test_views_of_one_look_are_lifted_together(degrees: float) -> None:
    splats = sheet(50, opacity=0.98)
    assert len(runs_that_agree(splats, graded(splats, [(0, WARM), (degrees, WARM)]))) == 1
    views = graded(splats, [(0, WARM), (degrees, WARM), (10, COOL), (-10, COOL)])
    assert [len(run) for run in runs_that_agree(splats, views)] == [2, 2]
    assert len(runs_that_agree(splats, views[1:2])) == 1


def test_views_of_different_places_do_not_contradict_each_other() -> None:
    splats = sheet(50, opacity=0.98)
    views = graded(splats, [(0, WARM), (0, COOL)])
    left, right = np.zeros((64, 64), bool), np.zeros((64, 64), bool)
    left[:, :30], right[:, 34:] = True, True
    cameras, pictures = [view.camera for view in views], [view.edited for view in views]
    assert len(runs_that_agree(splats, edit_views(splats, cameras, pictures, [left, right]))) == 1
