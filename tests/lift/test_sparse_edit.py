"""Sparse edits: what they write, share and say; what remains beside a sheet; and views cut out of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.lift.local.split import Lattice
from splatpainter.lift.sheets.pieces import Pieces, joined_view
from splatpainter.lift.sheets.sparse_edit import EditedGaussians, SparseEdit
from splatpainter.rendering.cpu.projected_view import project, tile_shape
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.lift_scenes import bits, differing, front, same_bits
from tests.support.render_scenes import cameras, scene

NONE = np.zeros(0, np.int64)


def numbered(count: int, seed: int = 0) -> Splats:
    return replace(scene(count, 1, seed, dtype=np.float32), origin=np.arange(count))


def test_an_edit_writes_empties_and_appends():
    splats, other = numbered(30), numbered(30, 1)
    tail = replace(other.take(np.array([5, 6])), origin=np.array([3, 9]))
    ids, emptied = np.array([2, 3, 20]), np.array([7, 9])
    splats.opacities[9] = 0
    after = SparseEdit(ids, other.take(ids), emptied, tail, np.array([3, 9])).apply(splats)
    for name in ATTRIBUTES:
        values = np.concatenate([getattr(splats, name), getattr(tail, name)])
        values[ids] = getattr(other, name)[ids]
        np.testing.assert_array_equal(getattr(after, name)[: len(splats)][ids], getattr(other, name)[ids])
        if name == "opacities":
            values[emptied] = 0
        np.testing.assert_array_equal(bits(getattr(after, name)), bits(values))
    np.testing.assert_array_equal(np.asarray(after.origin)[-3:], [29, 3, 9])
    edit = SparseEdit(ids, other.take(ids), emptied, tail, np.array([3, 9]))
    np.testing.assert_array_equal(edit.touched(splats), [2, 3, 7, 20])  # 9 was empty before
    some = np.array([31, 3, 9, 0, 7, 30, 20])
    assert same_bits(edit.take(splats, some), after.take(some))
    np.testing.assert_array_equal(edit.take(splats, some).origin, after.take(some).origin)


def edits_in_turn(splats: Splats, seed: int) -> tuple[SparseEdit, SparseEdit]:
    """An edit, and one of the Gaussians that it makes, some of which it wrote, emptied or appended."""
    rng, count = np.random.default_rng(seed), len(splats)
    some = rng.permutation(count)
    ids, emptied = np.sort(some[:30]), np.sort(some[30:45])
    tail = replace(numbered(12, seed + 1), origin=rng.integers(-1, count, 12))
    first = SparseEdit(ids, numbered(30, seed + 2), emptied, tail, rng.integers(0, count, 12))
    after = first.apply(splats)
    again = np.sort(np.concatenate([ids[::3], emptied[::3], some[45:60], count + np.arange(0, 12, 4)]))
    values = replace(numbered(len(again), seed + 3), origin=np.asarray(after.origin)[again])
    more = replace(numbered(7, seed + 4), origin=np.full(7, -1))
    parents = np.append(rng.integers(0, len(after), 6), count + 5)  # one of them is itself appended
    return first, SparseEdit(again, values, NONE, more, parents)


@pytest.mark.parametrize("seed", range(3))
def test_two_edits_in_turn_are_one(seed: int):
    splats = numbered(120, seed)
    first, later = edits_in_turn(splats, seed + 10)
    splats.opacities[first.emptied[:2]] = 0  # empty before
    after = first.apply(splats)
    both, expected = first.then(later, splats), later.apply(after)
    assert same_bits(both.apply(splats), expected)
    np.testing.assert_array_equal(both.apply(splats).origin, expected.origin)
    np.testing.assert_array_equal(both.touched(splats), np.flatnonzero(differing(splats, expected)[: len(splats)]))
    stay_empty = np.setdiff1d(first.emptied, later.ids)
    np.testing.assert_array_equal(both.emptied, stay_empty[splats.opacities[stay_empty] != 0])
    assert len(both.emptied) and not np.isin(both.ids, both.emptied).any()
    ancestry = np.append(np.arange(len(splats)), first.parents)
    np.testing.assert_array_equal(both.parents, [*first.parents, *ancestry[later.parents]])


@pytest.mark.parametrize("share", [1.1, 0.5, 0.1])
def test_a_view_of_edited_gaussians_is_that_of_all_projected_anew(share: float):
    camera, splats = cameras(150, 110)[0], numbered(300, 4)
    splats = splats.take(np.concatenate([np.arange(300), np.arange(60)]))  # some at equal depths
    first, _ = edits_in_turn(splats, 7)
    moved = first.values.take(np.arange(30))
    moved.means[:10] = splats.means[first.ids[:10]]  # and some of the edit's own
    edited = EditedGaussians(splats, replace(first, values=moved), project(splats, camera))
    after = edited.edit.apply(splats)
    tiles = np.random.default_rng(2).random(tile_shape(camera)) < share
    view, anew = edited.view(tiles), project(after, camera, tiles=tiles)
    assert view.num_gaussians == len(edited) == len(after) and len(view) > 20
    lists = ("gaussian_ids", "pair_offsets", "flatten_ids", "pair_ids", "tile_ids", "isect_offsets")
    for name in ("projected", "tiles", *lists):
        np.testing.assert_array_equal(getattr(view, name), getattr(anew, name))
    ids = np.array([len(after) - 1, 0, int(first.ids[3]), int(first.emptied[2])])
    assert same_bits(edited.take(ids), after.take(ids))
    assert same_bits(edited.geometry(ids), after.geometry(ids))


def test_arrays_in_which_nothing_changes_are_shared():
    splats = numbered(12)
    ids, none = np.array([1, 4]), splats.take(NONE)
    values = splats.take(ids)
    after = SparseEdit(ids, replace(values, sh=values.sh + 1), NONE, none, NONE).apply(splats)
    assert [getattr(after, name) is getattr(splats, name) for name in ATTRIBUTES] == [True] * 4 + [False]
    after = SparseEdit(NONE, none, ids, none, NONE).apply(splats)
    shared = {name for name in ATTRIBUTES if getattr(after, name) is getattr(splats, name)}
    assert shared == {*ATTRIBUTES} - {"opacities"} and not after.opacities[ids].any()


def test_an_edit_of_some_is_one_of_more():
    splats, some = numbered(40), np.arange(3, 40, 3)
    part = splats.take(some)
    ids = np.array([0, 4])
    edit = SparseEdit(ids, numbered(40, 2).take(ids), np.array([7]), numbered(2, 3), np.array([1, 7]))
    full = edit.within(some)
    after = full.apply(splats)
    np.testing.assert_array_equal(np.flatnonzero(differing(splats, after)), some[[0, 4, 7]])
    assert same_bits(after.take(np.append(some, [40, 41])), edit.apply(part))
    np.testing.assert_array_equal(full.parents, some[[1, 7]])


def cut_some(splats: Splats, seed: int) -> tuple[Pieces, Lattice, np.ndarray]:
    """Every third Gaussian in a lattice, some of these halved, and some of those and of the others gone."""
    rng, ids = np.random.default_rng(seed), np.arange(0, len(splats), 3)
    sized = ids[rng.random(len(ids)) < 0.5]
    lattice = Lattice.of(splats, front(), ids, sized)
    lattice, _ = lattice.halved(np.isin(ids, sized), 0.5)
    gone = (rng.random(len(lattice)) < 0.4) & (lattice.parent % 3 > 0)  # of some all pieces stay
    return Pieces.of(lattice, gone), lattice, gone


def test_a_lattice_of_some_is_that_of_all_where_these_may_be_halved():
    splats = numbered(40)
    ids, sized = np.arange(0, 40, 2), np.arange(0, 40, 4)
    some, every = Lattice.of(splats, front(), ids, sized), Lattice.of(splats.take(ids), front())
    np.testing.assert_array_equal(some.widths[::2], every.widths[::2])
    assert not some.widths[1::2].any()
    halved = [lattice.halved(np.arange(20) % 2 == 0, 0.5)[0] for lattice in (some, every)]
    assert len(halved[0]) > 30
    assert same_bits(halved[0].splats(), halved[1].splats())
    np.testing.assert_array_equal(halved[0].parent, ids[halved[1].parent])


@pytest.mark.parametrize("share", [1.1, 0.4])
def test_a_view_of_what_remains_and_a_sheet_is_that_of_both_projected_anew(share: float):
    camera, splats = cameras(150, 110)[0], numbered(300, 4)
    splats = splats.take(np.concatenate([np.arange(300), np.arange(60)]))  # some at equal depths
    pieces, lattice, gone = cut_some(splats, 5)
    sheet = splats.take(np.arange(40, 70))
    rest, parent_ids = pieces.remaining_gaussians(splats)
    halved = lattice.level.any(1)
    left = np.setdiff1d(np.arange(360), lattice.parent[halved | gone])
    expected = np.sort(np.concatenate([left, lattice.parent[halved & ~gone]]))
    np.testing.assert_array_equal(parent_ids, expected)
    assert len(pieces.parent_ids) > 50 and len(left) > 100
    tiles = np.random.default_rng(2).random(tile_shape(camera)) < share
    view = joined_view(pieces, pieces.splats.append(sheet), project(splats, camera), tiles)
    anew = project(rest.append(sheet), camera, tiles=tiles)
    drawn = np.diff(anew.pair_offsets) > 0
    for name in ("projected", "isect_offsets", "pair_ids"):
        some = drawn if name == "projected" else slice(None)
        np.testing.assert_array_equal(getattr(view, name), getattr(anew, name)[some])
    for one, other in zip(view.rasterize(), anew.rasterize(), strict=True):
        np.testing.assert_array_equal(one, other)
    ids = view.gaussian_ids
    everything = splats.append(pieces.splats).append(sheet)
    assert view.num_gaussians == len(everything)
    assert same_bits(everything.take(ids), rest.append(sheet).take(anew.gaussian_ids[drawn]))
