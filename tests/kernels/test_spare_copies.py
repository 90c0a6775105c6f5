"""Copies that are made ahead of an edit: written into once, equal to what it would copy, gone with their owner."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.kernels import spare_copies
from splatpainter.kernels.rows import extended
from splatpainter.lift.sheets.sparse_edit import SparseEdit
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.lift_scenes import same_bits
from tests.support.render_scenes import scene

COUNT = 200


@pytest.fixture(autouse=True)
def any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = replace(spare_copies.SPARE_LIMITS, smallest_bytes=0)
    monkeypatch.setattr(spare_copies, "SPARE_LIMITS", limits)


def asset(count: int = COUNT, seed: int = 0) -> Splats:
    return replace(scene(count, 1, seed, dtype=np.float32), origin=np.arange(count))


def an_edit(appended: int = 5) -> SparseEdit:
    ids, tail = np.array([2, 30]), asset(appended, 2)
    return SparseEdit(ids, asset(seed=1).take(ids), np.array([7]), tail, np.arange(appended))


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def test_an_edit_copies_no_array_that_was_copied_ahead(monkeypatch: pytest.MonkeyPatch):
    splats = asset()
    before = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    expected = an_edit().apply(splats)
    copies = spare_copies.spare_copies(splats)
    addresses = [address(copy._copies[0]) for copy in copies]
    joined = []
    monkeypatch.setattr(np, "concatenate", lambda arrays, *rest: joined.append(arrays) or concatenate(arrays, *rest))
    after = an_edit().apply(splats)
    arrays = [getattr(splats, name) for name in ATTRIBUTES]
    assert joined and not any(one[0] is array for one in joined for array in arrays)
    assert [address(getattr(after, name)) for name in ATTRIBUTES] == addresses
    assert same_bits(after, expected) and after.sh.flags.c_contiguous
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(splats, name), before[name])
    # Used once: the next edit of the same Gaussians writes elsewhere.
    again = an_edit().apply(splats)
    assert not {address(getattr(again, name)) for name in ATTRIBUTES} & {*addresses} and same_bits(again, expected)


concatenate = np.concatenate


def test_a_copy_is_of_one_array_has_bounded_room_and_goes_with_its_owner():
    splats, tail = asset(), np.zeros((1, 3), np.float32)
    copies = spare_copies.spare_copies(splats)
    assert spare_copies.spare_copy_of(splats.means.copy(), COUNT) is None
    room = int(spare_copies.SPARE_LIMITS.room * COUNT)
    expected = an_edit(room + 1).apply(asset())
    assert same_bits(an_edit(room + 1).apply(splats), expected)  # no room: as without a copy
    copies = spare_copies.spare_copies(splats)
    assert len(copies) == len(ATTRIBUTES)
    del copies
    gc.collect()
    assert spare_copies.spare_copy_of(splats.means, COUNT) is None
    np.testing.assert_array_equal(extended(splats.means, tail), np.append(splats.means, tail, 0))


def test_small_and_very_large_assets_are_not_copied(monkeypatch: pytest.MonkeyPatch):
    splats = asset()
    for limits in ({"smallest_bytes": splats.sh.nbytes + 1}, {"most_bytes": splats.sh.nbytes}):
        monkeypatch.setattr(spare_copies, "SPARE_LIMITS", replace(spare_copies.SPARE_LIMITS, **limits))
        assert not spare_copies.spare_copies(splats)
        monkeypatch.undo()
        monkeypatch.setattr(spare_copies, "SPARE_LIMITS", replace(spare_copies.SPARE_LIMITS, smallest_bytes=0))
