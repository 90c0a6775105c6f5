"""Rows gathered and compared by all threads, against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.io.formats.splat import pack
from splatpainter.kernels import library, rows
from splatpainter.kernels.parallel import run
from splatpainter.kernels.row_bits import differing
from splatpainter.receipts import untouched_hashes
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats, changed_rows
from tests.support.lift_scenes import bits, same_bits
from tests.support.render_scenes import scene

COUNT = 200


def asset(seed: int = 0) -> Splats:
    return replace(scene(COUNT, 1, seed, dtype=np.float32), origin=np.arange(COUNT))


@pytest.mark.parametrize("threads", ["1", "3"])
def test_taken_is_numpys_take(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    values, rng = np.arange(1000) * 7, np.random.default_rng(0)
    for count in (0, 3, 2 * rows.BLOCK_ROWS + 5):
        ids = rng.integers(0, len(values), count)
        np.testing.assert_array_equal(rows.taken(values, ids), values[ids])


@pytest.mark.parametrize("threads", ["1", "3"])
def test_blocks_are_all_rows_once(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    for count in (0, 1, 10, rows.MIN_ROWS, rows.BLOCK_ROWS, 3 * rows.BLOCK_ROWS + 1):
        seen = np.zeros(count, int)

        def count_up(block: slice, seen: np.ndarray = seen) -> None:
            assert block.stop - block.start <= rows.BLOCK_ROWS
            seen[block] += 1

        rows.by_blocks(count_up, count)
        assert (seen == 1).all()


@pytest.mark.parametrize("threads", ["1", "3"])
def test_many_rows_are_taken_as_few_are(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    monkeypatch.setattr(rows, "MIN_ROWS", 0)
    splats = asset()
    splats.sh[3, 0] = np.array([0x7FC00123, 0x80000000, 1], np.uint32).view(np.float32)  # NaN, -0, the smallest
    for ids in (np.random.default_rng(1).integers(0, COUNT, 500), np.array([3])):
        taken = rows.take(splats, ids)
        assert same_bits(taken, splats.take(ids))
        np.testing.assert_array_equal(np.asarray(taken.origin), ids)
    assert rows.take(replace(splats, origin=None), np.array([1])).origin is None
    nobody = np.zeros(0, np.int64)
    for some in (splats, splats.take(nobody)):
        assert rows.take(some, nobody).sh.shape == (0, 4, 3)


@pytest.mark.parametrize("threads", ["1", "3"])
def test_large_arrays_are_extended_as_small_ones_are(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    monkeypatch.setattr(rows, "MIN_ROWS", 0)
    splats = asset()
    splats.sh[3, 0] = np.array([0x7FC00123, 0x80000000, 1], np.uint32).view(np.float32)  # NaN, -0, the smallest
    for first, second in ((splats.sh, splats.sh[:7]), (splats.opacities[:2], splats.opacities), (splats.sh[:0],) * 2):
        assert rows.extended(first, second).tobytes() == np.concatenate([first, second]).tobytes()
        assert rows.extended(first, second).shape[1:] == first.shape[1:]
    both = rows.extended(splats.opacities, splats.opacities.astype(np.float64))
    assert both.dtype == np.float64 and len(both) == 2 * COUNT


@pytest.mark.parametrize("count", [200, 40_000])
def test_changed_rows_are_those_with_any_other_bit(count: int):
    """count: rows; the many are compared by a kernel."""
    rng = np.random.default_rng(count)
    before = asset().take(rng.integers(0, COUNT, count))
    before.means[5] = np.nan, 0, 0
    after = asset().take(np.append(np.zeros(0, np.int64), rng.integers(0, COUNT, count + 3)))
    after = replace(
        after, **{name: np.append(getattr(before, name), getattr(after, name)[-3:], 0) for name in ATTRIBUTES}
    )
    assert not len(changed_rows(before, after)), "a NaN is itself"
    after.means[7, 1], after.sh[9, 3, 2], after.quats[count - 1, 0] = 3, 5, 7
    after.means[5, 1] = -0.0
    after.opacities[11] = np.nextafter(after.opacities[11], 2, dtype=np.float32)
    expected = [5, 7, 9, 11, count - 1]
    assert changed_rows(before, after).tolist() == expected
    assert changed_rows(after, before).tolist() == expected
    assert untouched_hashes(before, after, np.array(expected), compared=True) == untouched_hashes(
        before, after, np.array(expected)
    )


def test_rows_of_float64_are_taken_as_they_are(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rows, "MIN_ROWS", 0)
    splats = scene(20, 1, 0)
    assert rows.take(splats, np.array([4, 2])).means.dtype == np.float64
    np.testing.assert_array_equal(rows.take(splats, np.array([4, 2])).means, splats.means[[4, 2]])


def test_rows_differ_where_any_bit_does():
    before, ids = asset().sh, np.random.default_rng(1).permutation(COUNT)[:150]
    after = before.copy()
    after[ids[::3], 1, 2] = np.nextafter(after[ids[::3], 1, 2], np.float32(9))
    before[ids[1], 0, 0], after[ids[1], 0, 0] = 0.0, -0.0
    before[ids[2]] = after[ids[2]] = np.nan
    expected = (bits(before) != bits(after)).reshape(COUNT, -1).any(1)[ids]
    assert expected[:3].tolist() == [True, True, False] and not expected.all()
    np.testing.assert_array_equal(differing(before, after, ids), expected)
    np.testing.assert_array_equal(differing(before, np.concatenate([after, after]), ids), expected)
    assert not differing(before, before, ids).any()


@pytest.mark.parametrize("threads", ["1", "3"])
def test_columns_are_put_bit_for_bit(threads: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    rng = np.random.default_rng(2)
    words = rng.integers(0, 1 << 32, (COUNT, 7), np.uint32)  # NaN with payloads among them
    columns = np.array([5, 0, 3])
    before, origin = np.ascontiguousarray(words[:, columns]).view(np.float32), rng.integers(-1, COUNT, 90)
    after = before[origin].copy()
    after[origin < 0] = 4.0
    after[7, 2] = 1.5
    target = np.full((90, 7), 2.0, np.float32)
    expected = target.copy()
    new = (after.view(np.uint32) != before[origin].view(np.uint32)) | (origin < 0)[:, None]
    for k, column in enumerate(columns):
        expected[new[:, k], column] = after[new[:, k], k]
    rows.put(target, columns, after, before, origin)
    np.testing.assert_array_equal(target, expected)
    assert (target != 2.0).sum() == 3 * np.count_nonzero(origin < 0) + (origin[7] >= 0)


@pytest.mark.parametrize("cpu", library.current().cpus)
@pytest.mark.parametrize("threads", ["1", "2", "3"])
def test_bytes_of_splat_files_are_numpys(cpu: str, threads: str, monkeypatch: pytest.MonkeyPatch):
    """Packed as the formulas of the format read in numpy, halves to the even byte, and every byte looked up."""
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    splats = asset(3)
    splats.quats[:] = np.random.default_rng(4).normal(size=(COUNT, 4))
    # All halves between two bytes, and what is no number.
    splats.opacities[:] = (np.arange(COUNT) + 0.5).astype(np.float32) / np.float32(255)
    splats.opacities[:5] = np.nan, np.inf, -np.inf, -0.0, 1e30
    splats.sh[:9, 0] = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 0, -0.0, 1e-45, 1e9], np.float32)[:, None]
    splats.quats[:4] = [[0, 0, 0, 0], [np.nan, 1, 0, 0], [np.inf, 1, 0, 0], [3e38, -3e38, 3e38, 1]]
    splats.quats[4:7] = [[1, 0, 0, 0], [-1, 0, 0, 0], [3, 4, 0, -12]]

    def nearest(values: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(np.nan_to_num(values)), 0, 255).astype(np.uint8)

    with np.errstate(all="ignore"):
        wide = splats.quats.astype(np.float64)
        norms = np.sqrt(np.cumsum(wide * wide, axis=1)[:, 3:])
        colors = (0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64)).astype(np.float32) * np.float32(255)
        expected = {
            "means": splats.means,
            "scales": splats.scales,
            "rgb": nearest(colors),
            "alpha": nearest(splats.opacities * np.float32(255)),
            "quats": nearest(wide / np.where(norms > 0, norms, 1) * 128 + 128),
        }
    with library.using(cpu):
        packed = pack(splats)
        for name, values in expected.items():
            np.testing.assert_array_equal(packed[name], values, name)
        table = np.random.default_rng(5).normal(size=256).astype(np.float32)
        records = np.random.default_rng(6).integers(0, 256, (COUNT, 9), np.uint8)
        for first, width in ((0, 9), (4, 3), (8, 1)):
            out = np.full((COUNT, width), np.nan, np.float32)
            run(library.current().look_up_bytes, records, first, table, out)
            np.testing.assert_array_equal(out, table[records[:, first : first + width]])
