"""Views edited nearly everywhere: those that contradict each other are lifted in turn, all others together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift.contradictions import runs_that_agree
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit, lift_local_views
from splatpainter.lift.features import no_features
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import db, rod, sheet

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


def test_detail_of_one_truth_from_two_sides_is_no_contradiction() -> None:
    """Fine stripes lie beside themselves, as surfaces of coarse Gaussians are not where the truth's are."""
    asset, truth = rod(12, 26), rod(48, 120, 0.3)
    cameras = [
        look_at((x, y, 1.15), (0, 0, 0), width=96, height=96, fov=50, background=(0.5, 0.5, 0.5))
        for x, y in ((0.8, 0.27), (-0.8, -0.27))
    ]
    drawn = [sp.render(truth, camera) for camera in cameras]
    views = edit_views(asset, cameras, [out.colors[0] for out in drawn], [out.alphas[0, ..., 0] > 0.5 for out in drawn])
    assert len(runs_that_agree(asset, views)) == 1


def test_what_was_split_twice_comes_of_the_asset() -> None:
    """Of three Gaussians the first edit splits one, the second one splits what came of it and takes another away."""
    splats = sheet(4, opacity=0.98).take(np.arange(5))
    of_four, last = (splats.take(np.arange(count)) for count in (4, 5))
    opacities = last.opacities.copy()
    opacities[2] = 0
    first = LiftedEdit(of_four, np.array([1, 3]), np.array([1, 1]), no_features(np.arange(2)), replaced=np.array([0]))
    second = LiftedEdit(
        replace(last, opacities=opacities), np.array([2, 3, 4]), np.array([2, 3, 3]), no_features(np.arange(3))
    )
    both = first.followed_by(second, 3)
    assert both.ids.tolist() == [1, 2, 3, 4] and both.parents.tolist() == [1, 2, 1, 1]
    assert both.replaced.tolist() == [0] and both.removed.tolist() == [2] and len(both.splats) == 5
