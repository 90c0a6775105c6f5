"""Views that somebody holds: the same one for the same Gaussians and camera, none for other, none after it is gone."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.kernels import arrays
from splatpainter.kernels.arrays import IDLE_LIMITS
from splatpainter.rendering import render
from splatpainter.rendering.cpu import recent_views
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.cpu.recent_views import RecentViewLimits, drawn_view, hold, note_view, recent_view
from splatpainter.rendering.partial import PartialRender
from splatpainter.splats import Splats
from tests.support.render_scenes import cameras, scene


@pytest.fixture(autouse=True)
def idle_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process that goes on, whatever commands ran in this one before."""
    monkeypatch.setattr(arrays._idle, "limits", IDLE_LIMITS)


def fixed(splats: Splats[np.ndarray]) -> Splats[np.ndarray]:
    """The same, to which nobody can write."""
    splats.fix()
    return splats


def test_a_view_is_there_for_the_same_arrays_and_camera_while_it_is_held():
    splats, camera = scene(50, 1, 1, dtype=np.float32), cameras(40, 30)[0]
    moved = camera.world_to_camera.copy()
    moved[2, 3] += 0.1
    view = project(splats, camera)
    assert recent_view(splats, camera) is None
    note_view(splats, view)
    assert recent_view(replace(splats, origin=np.arange(len(splats))), replace(camera)) is view
    assert recent_view(splats, replace(camera, world_to_camera=moved)) is None
    assert recent_view(splats, replace(camera, background=(1.0, 0.0, 0.0))) is None
    assert recent_view(replace(splats, antialiased=True), camera) is None
    assert recent_view(replace(splats, sh=splats.sh.copy()), camera) is None
    del view
    gc.collect()
    assert recent_view(splats, camera) is None


def test_a_partial_render_of_a_view_at_hand_has_the_same_bits_before_and_after_an_edit():
    splats, camera = scene(300, seed=3, dtype=np.float32), cameras(150, 110)[0]
    tiles = np.zeros((7, 10), bool)
    tiles[2:4, 3:6] = True
    changed = np.arange(0, len(splats), 17)
    means, opacities = splats.means.copy(), splats.opacities.copy()
    means[changed] += np.float32(0.05)
    opacities[changed[::3]] = 0
    edited = replace(splats, means=means, opacities=opacities).append(splats.take(np.arange(5)))
    anew = PartialRender.of(splats, camera, tiles, tiles)
    view = project(splats, camera)
    held = PartialRender.of(splats, camera, tiles, tiles, view)
    assert held.view is view
    pairs = [(held, anew), *zip(held.after(edited, changed), anew.after(edited, changed), strict=True)]
    assert pairs[2][0].tiles.sum() > tiles.sum()
    for one, two in pairs:
        for name in ("tiles", "colors", "alphas", "depths"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_a_drawn_view_is_what_render_shows_and_is_drawn_once_while_it_is_held():
    splats, camera = scene(60, 2, 1, dtype=np.float32), replace(cameras(50, 34)[0], background=(0.2, 0.4, 0.6))
    held = drawn_view(splats, camera)
    anew = render(splats, camera)
    for one, two in ((held.colors, anew.colors), (held.alphas, anew.alphas), (held.depths, anew.depths)):
        np.testing.assert_array_equal(one, two[0].reshape(one.shape))
        assert not one.flags.writeable
    assert drawn_view(replace(splats), replace(camera)) is held
    assert drawn_view(replace(splats, sh=splats.sh.copy()), camera) is not held
    partial = PartialRender.of(splats, camera)
    assert partial.view is held.view and partial.colors is held.colors
    view = held.view
    del held, partial
    gc.collect()
    assert drawn_view(splats, camera).view is view
    del view
    gc.collect()
    assert recent_view(splats, camera) is None
    assert PartialRender.of(splats, camera).view is None
    assert PartialRender.of(splats, camera, keep=True).view is not None
    with pytest.raises(ValueError, match="expected views of 1 to"):
        drawn_view(splats, replace(camera, width=9000))


def test_the_view_of_the_latest_edit_is_held_while_its_gaussians_are_there():
    camera = cameras(50, 34)[0]
    splats, other = (fixed(scene(60, seed, 1, dtype=np.float32)) for seed in (2, 4))
    drawn = drawn_view(splats, camera)
    view = weakref.ref(drawn.view)
    hold(splats, drawn)
    del drawn
    gc.collect()
    assert drawn_view(splats, camera).view is view() is not None
    # One is held: that of other Gaussians takes its place, and goes with any of their arrays.
    hold(other, drawn_view(other, camera))
    gc.collect()
    assert view() is None and recent_view(other, camera) is not None
    other = replace(other, means=other.means.copy())
    gc.collect()
    assert recent_views._held is None and recent_view(other, camera) is None


@pytest.mark.parametrize("before_is_fixed", [False, True])
def test_no_view_is_held_of_gaussians_that_may_be_written_to(before_is_fixed: bool):
    splats, camera = scene(300, seed=3, dtype=np.float32), cameras(150, 110)[0]
    splats = fixed(splats) if before_is_fixed else splats
    edited = replace(splats, sh=splats.sh + np.float32(0.1))
    PartialRender.of(splats, camera, keep=True).after(edited, np.arange(len(splats)))
    for one in (edited,) if before_is_fixed else (splats, edited):
        one.sh[:, 0] *= np.float32(0.5)
        expected = project(one, camera).rasterize()[0]
        np.testing.assert_array_equal(drawn_view(one, camera).colors, expected)


@pytest.mark.parametrize("colors_alone", [False, True])
def test_an_edit_of_the_held_view_is_a_view_with_the_bits_of_a_new_one(colors_alone: bool):
    splats, camera = fixed(scene(300, seed=3, dtype=np.float32)), cameras(150, 110)[0]
    changed = np.arange(0, len(splats), 17)
    sh, means, opacities = splats.sh.copy(), splats.means.copy(), splats.opacities.copy()
    sh[changed, 0] += np.float32(0.2)
    means[changed] += np.float32(0.05)
    opacities[changed[::3]] = 0
    edited = replace(splats, sh=sh)
    if not colors_alone:
        edited = replace(edited, means=means, opacities=opacities).append(splats.take(np.arange(5)))
    PartialRender.of(splats, camera, keep=True).after(fixed(edited), changed)
    # Not of arrays or cameras that are other, even if equal.
    assert drawn_view(replace(edited, sh=edited.sh.copy()), camera).view is not recent_view(edited, camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recent_views, "project", None)  # nothing is projected anew
        drawn = drawn_view(edited, camera)
    anew = project(edited, camera)
    for one, two in zip((drawn.colors, drawn.alphas, drawn.depths), anew.rasterize(), strict=True):
        np.testing.assert_array_equal(one, two)
    for one, two in zip(drawn.view.part().rasterize(), anew.rasterize(), strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(drawn.view.gaussian_ids, anew.part().gaussian_ids)
    np.testing.assert_array_equal(drawn.view.projected, anew.part().projected)


def test_no_view_is_held_beyond_its_limit_or_by_a_process_that_ends_soon(monkeypatch: pytest.MonkeyPatch):
    splats, camera = fixed(scene(60, 2, 1, dtype=np.float32)), cameras(50, 34)[0]
    for limits in (
        (recent_views, "RECENT_VIEWS", RecentViewLimits(most_held_bytes=1000)),
        (arrays._idle, "limits", replace(IDLE_LIMITS, most_bytes=0)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(*limits)
            hold(splats, drawn_view(splats, camera))
            gc.collect()
            assert recent_view(splats, camera) is None
