"""Views that somebody holds: the same one for the same Gaussians and camera, none for others, none after it is gone."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.recent_views import drawn_view, note_view, recent_view
from splatpainter.rendering.partial import PartialRender
from tests.support.render_scenes import cameras, scene


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


def test_tiles_of_a_drawn_view_are_what_would_be_drawn_of_them(monkeypatch: pytest.MonkeyPatch):
    splats, camera = scene(60, 2, 1, dtype=np.float32), replace(cameras(70, 45)[0], background=(0.2, 0.4, 0.6))
    tiles = np.array([[0, 1, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], bool)
    anew, held = PartialRender.of(splats, camera, tiles, tiles), drawn_view(splats, camera)
    monkeypatch.setattr(ProjectedView, "rasterize", None)
    taken = PartialRender.of(splats, camera, tiles, tiles, held.view)
    for name in ("tiles", "colors", "alphas", "depths"):
        np.testing.assert_array_equal(getattr(anew, name), getattr(taken, name))


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
