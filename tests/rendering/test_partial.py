"""A view in some tiles is the view, there; and drawn again where an edit changed it, it is the view of the edited."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import look_at
from splatpainter.rendering.partial import PartialRender
from splatpainter.splats import Splats

CAMERA = look_at((0, 0, -3), (0, 0, 0), width=100, height=75, background=(0.2, 0.4, 0.6))


def cloud(count: int, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    means, scales = rng.normal(0, 0.6, (count, 3)), rng.uniform(0.01, 0.15, (count, 3))
    arrays = (means, rng.normal(size=(count, 4)), scales, rng.uniform(0.1, 1, count), rng.normal(0, 0.4, (count, 4, 3)))
    means, quats, scales, opacities, sh = (np.asarray(values, np.float32) for values in arrays)
    return Splats(means, quats, scales, opacities, sh)


def assert_equal(part: PartialRender, splats: Splats) -> None:
    """Drawn tiles hold what a full render does, bit for bit; others the background."""
    full = sp.render(splats, CAMERA)
    pixels = part.tiles.repeat(16, 0).repeat(16, 1)[:75, :100]
    for name, nothing in (("colors", CAMERA.background), ("alphas", (0,)), ("depths", (0,))):
        picture = getattr(part, name).reshape(75, 100, -1)
        expected = np.where(pixels[..., None], getattr(full, name)[0], np.array(nothing, np.float32))
        np.testing.assert_array_equal(picture, expected, name)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_drawn_tiles_are_those_of_the_view(share: float) -> None:
    splats, rng = cloud(300), np.random.default_rng(1)
    tiles = rng.random((5, 7)) < share
    part = PartialRender.of(splats, CAMERA, tiles)
    assert_equal(part, splats)
    more = rng.random((5, 7)) < 0.3
    grown = part.with_tiles(more)
    assert (grown.tiles == tiles | more).all()
    assert_equal(grown, splats)


@pytest.mark.parametrize(("changed", "appended"), [(0, 0), (3, 0), (0, 5), (4, 6), (200, 50)])
def test_an_edit_is_drawn_where_it_changed_the_view(changed: int, appended: int) -> None:
    before, rng = cloud(300), np.random.default_rng(2)
    ids = np.sort(rng.permutation(300)[:changed])
    values = {name: getattr(before, name).copy() for name in ("means", "scales", "opacities", "sh")}
    values["means"][ids] += rng.normal(0, 0.5, (changed, 3)).astype(np.float32)  # from one tile to others
    values["opacities"][ids[::2]] = 0
    values["sh"][ids] += 0.2
    after = replace(before, **values).append(cloud(appended, 3))
    tiles = np.zeros((5, 7), bool)
    tiles[2, 3] = True
    old, new = PartialRender.of(before, CAMERA, tiles).after(after, ids)
    assert (old.tiles >= tiles).all() and (new.tiles == old.tiles).all()
    assert_equal(old, before)
    assert_equal(new, after)
    full = PartialRender.of(before, CAMERA).after(after, ids)[1]
    np.testing.assert_array_equal(full.colors, sp.render(after, CAMERA).colors[0])


@pytest.mark.parametrize("case", ["moved", "recolored", "beyond range", "from beyond range", "appended", "marked"])
def test_a_view_that_was_kept_is_drawn_again_as_it_would_be_anew(case: str) -> None:
    before, rng = cloud(300), np.random.default_rng(5)
    ids = np.sort(rng.permutation(300)[:40])
    if case == "from beyond range":
        before.sh[ids[0], 0] = 3e15
    sh = before.sh.copy()
    sh[ids] = rng.normal(0, 0.4, (40, 4, 3))
    if case == "beyond range":
        sh[ids[0], 0, 1] = np.nan
    after = replace(before, sh=sh)
    if case == "moved":
        after = replace(after, means=before.means + np.float32(0.01))
        ids = np.arange(300)
    if case == "marked":
        after, ids = replace(after, antialiased=True), np.arange(300)
    if case == "appended":
        after = after.append(cloud(7, 3))
    picture = PartialRender.of(before, CAMERA, keep=True)
    assert picture.view is not None
    old, new = picture.after(after, ids)
    assert_equal(old, before)
    assert_equal(new, after)


def test_pictures_beyond_all_measure_are_refused() -> None:
    with pytest.raises(ValueError, match="expected views of 1 to 8192 pixels a side"):
        PartialRender.of(cloud(3), CAMERA.resized(9000, 75), np.zeros((5, 563), bool))
