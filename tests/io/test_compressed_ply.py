"""PlayCanvas compressed PLY: bytes by hand, what an edit may change of a file, and files that must be refused."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import splatpainter as sp
from splatpainter import io
from splatpainter.io.formats import compressed_ply, packing
from splatpainter.io.formats.packing import morton_order, stable_order
from tests.support.io_assets import SH_C0, random_splats

FLOATS = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
FLOATS += [name.replace("_", "_scale_") for name in FLOATS]
COLORS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def compressed(chunks: Sequence[Sequence[float]], rows: list[list[int]], sh: list[list[int]] | None = None) -> bytes:
    width = len(chunks[0]) if chunks else 18
    lines = ["ply", "format binary_little_endian 1.0", "comment by hand", f"element chunk {len(chunks)}"]
    lines += [f"property float {n}" for n in (FLOATS + COLORS)[:width]]
    lines += [f"element vertex {len(rows)}", *(f"property uint {n}" for n in WORDS)]
    if sh is not None:
        lines += [f"element sh {len(sh)}", *(f"property uchar f_rest_{k}" for k in range(len(sh[0])))]
    body = b"".join(struct.pack(f"<{width}f", *chunk) for chunk in chunks)
    body += b"".join(struct.pack("<4I", *row) for row in rows) + b"".join(bytes(row) for row in sh or [])
    return "\n".join([*lines, "end_header\n"]).encode() + body


def save(folder: Path, data: bytes) -> Path:
    path = folder / "a.compressed.ply"
    path.write_bytes(data)
    return path


CHUNK = [0, 0, 0, 1, 2, 4, -4, -4, -4, 0, 0, 0, 0, 0, 0, 1, 1, 2]
FIELDS = (2047 << 21) | (0 << 11) | 0
ROW = [
    FIELDS,
    3 << 30 | 1023 << 20 | 0 << 10 | 1023,
    (0 << 21) | (1023 << 11) | 2047,
    255 << 24 | 0 << 16 | 51 << 8 | 102,
]


@pytest.mark.parametrize("width", [12, 18])
def test_by_hand(tmp_path: Path, width: int) -> None:
    data = compressed([CHUNK[:width]], [ROW])
    splats = io.read(save(tmp_path, data))
    assert splats.means.tolist() == [[1, 0, 0]]
    # Largest component third of w x y z; the others at the ends of +-1/sqrt(2), which leaves nothing for it.
    np.testing.assert_allclose(splats.quats, [[math.sqrt(0.5), -math.sqrt(0.5), math.sqrt(0.5), 0]], atol=1e-6)
    np.testing.assert_allclose(splats.scales, [[math.exp(-4), 1, 1]], rtol=1e-6)
    blue = 0.4 if width == 18 else 0.2
    np.testing.assert_allclose(0.5 + SH_C0 * splats.sh[0, 0], [1, 0, blue], atol=1e-6)
    np.testing.assert_allclose(splats.opacities, [0.4], atol=1e-7)
    assert splats.source is not None and splats.source.format == "compressed.ply"
    assert splats.source.problems == (() if width == 18 else OLD)
    io.write(tmp_path / "b.compressed.ply", splats)
    assert (tmp_path / "b.compressed.ply").read_bytes() == data


OLD = ("an older file without colour ranges: base colours are limited to 0..1",)


def test_sh_by_hand(tmp_path: Path) -> None:
    sh = [0, 1, 127, 128, 129, 254, 255, 0, 128]
    splats = io.read(save(tmp_path, compressed([CHUNK], [ROW], [sh])))
    exact = [-4 if v == 0 else 4 if v == 255 else 8 * ((v + 0.5) / 256 - 0.5) for v in sh]
    assert splats.sh[0, 1:].T.reshape(-1).tolist() == exact


def test_recognised_under_a_plain_name(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(compressed([CHUNK], [ROW]))
    splats = io.read(path)
    assert splats.source is not None and splats.source.format == "compressed.ply"


@dataclass
class Parts:
    """A file of the standard layout cut by position."""

    header: bytes
    chunks: np.ndarray
    """[C, 18] uint32 bits of the floats."""
    rows: np.ndarray
    """[N, 4] uint32."""
    sh: bytes


def cut(path: Path, count: int) -> Parts:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    chunks = -(-count // 256)
    table = np.frombuffer(body, "<u4", 18 * chunks).reshape(-1, 18)
    rows = np.frombuffer(body, "<u4", 4 * count, 72 * chunks).reshape(-1, 4)
    return Parts(header, table, rows, body[72 * chunks + 16 * count :])


@pytest.fixture
def asset(tmp_path: Path) -> sp.Splats:
    """600 rows (2 full chunks and 88 rows) of SH degree 1, as read from a compressed file."""
    io.write(tmp_path / "source.compressed.ply", random_splats(600, 1))
    return io.read(tmp_path / "source.compressed.ply")


def edited(splats: sp.Splats, **changes: tuple[tuple[int, ...], float]) -> sp.Splats:
    arrays = {}
    for name, (index, value) in changes.items():
        arrays[name] = getattr(splats, name).copy()
        arrays[name][index] = value
    return replace(splats, **arrays)


def save_again(splats: sp.Splats, folder: Path) -> tuple[Parts, Parts, sp.Splats]:
    """(parts of the source file, parts of the file written, what it reads as)"""
    io.write(folder / "out.compressed.ply", splats)
    return (
        cut(folder / "source.compressed.ply", 600),
        cut(folder / "out.compressed.ply", len(splats)),
        io.read(folder / "out.compressed.ply"),
    )


def test_quantisation_of_a_new_file(asset: sp.Splats) -> None:
    truth = random_splats(600, 1)
    for chunk in (slice(0, 256), slice(256, 512), slice(512, 600)):
        for name, levels in (("means", [2047, 1023, 2047]), ("scales", [2047, 1023, 2047]), ("base", [255] * 3)):
            ours, exact = (_values(s, name)[chunk] for s in (asset, truth))
            step = np.ptp(exact, 0) / np.array(levels)
            assert (np.abs(ours - exact) <= step * 0.501 + 1e-6).all(), name
    assert np.abs(asset.opacities - truth.opacities).max() <= 0.501 / 255
    assert np.abs(asset.sh[:, 1:] - truth.sh[:, 1:]).max() <= 8 / 256 * 0.501
    unit = truth.quats / np.linalg.norm(truth.quats, axis=1, keepdims=True)
    assert np.abs((asset.quats * unit).sum(1)).min() > math.cos(3 * math.sqrt(2) / 1023)


def _values(splats: sp.Splats, name: str) -> np.ndarray:
    if name == "scales":
        return np.log(splats.scales.astype(np.float64))
    return 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64) if name == "base" else splats.means.astype(np.float64)


def test_unchanged_is_the_same_file(asset: sp.Splats, tmp_path: Path) -> None:
    io.write(tmp_path / "out.compressed.ply", asset)
    assert (tmp_path / "out.compressed.ply").read_bytes() == (tmp_path / "source.compressed.ply").read_bytes()


def test_a_value_within_its_range_changes_its_field_only(asset: sp.Splats, tmp_path: Path) -> None:
    green = float(asset.sh[256:512, 0, 1].mean())
    old, new, again = save_again(edited(asset, sh=((300, 0, 1), green), opacities=((10,), 0.5)), tmp_path)
    assert new.header == old.header and new.sh == old.sh
    np.testing.assert_array_equal(new.chunks, old.chunks)
    differs = new.rows ^ old.rows
    assert set(zip(*np.nonzero(differs), strict=True)) <= {(300, 3), (10, 3)}
    assert differs[300, 3] & ~np.uint32(0xFF0000) == 0 and differs[10, 3] & ~np.uint32(0xFF) == 0
    assert abs(again.sh[300, 0, 1] - green) < 0.02 and abs(again.opacities[10] - 0.5) < 0.01


def test_a_value_beyond_its_range_renews_that_axis_of_its_chunk(asset: sp.Splats, tmp_path: Path) -> None:
    old, new, again = save_again(edited(asset, sh=((300, 0, 0), 9.0)), tmp_path)
    changed = set(zip(*np.nonzero(new.chunks != old.chunks), strict=True))
    assert changed == {(1, 15)}  # max_r of the second chunk
    differs = new.rows ^ old.rows
    assert (differs & ~np.uint32(0xFF000000) == 0).all() and not differs[:256].any() and not differs[512:].any()
    step = (9.0 * SH_C0 + 0.5) / 255 / SH_C0
    assert np.abs(again.sh[256:512, 0, 0] - np.where(np.arange(256) == 44, 9, asset.sh[256:512, 0, 0])).max() < step
    assert (again.sh[:256] == asset.sh[:256]).all() and (again.means == asset.means).all()


def test_one_sh_coefficient_changes_one_byte(asset: sp.Splats, tmp_path: Path) -> None:
    old, new, again = save_again(edited(asset, sh=((599, 3, 2), 1.5)), tmp_path)
    assert [k for k in range(len(old.sh)) if old.sh[k] != new.sh[k]] == [599 * 9 + 8]
    assert abs(again.sh[599, 3, 2] - 1.5) <= 4 / 256
    np.testing.assert_array_equal(new.rows, old.rows)


def test_appended_rows_that_fit_leave_all_bytes(asset: sp.Splats, tmp_path: Path) -> None:
    children = asset.take(np.arange(520, 540))  # of the last chunk: everything fits
    children = replace(children, opacities=children.opacities / 2)
    old, new, again = save_again(asset.append(children), tmp_path)
    assert b"element vertex 620\n" in new.header and b"element sh 620\n" in new.header
    np.testing.assert_array_equal(new.chunks, old.chunks)
    np.testing.assert_array_equal(new.rows[:600], old.rows)
    assert new.sh.startswith(old.sh)
    np.testing.assert_array_equal(again.means[600:], asset.means[520:540])


def test_appended_rows_beyond_a_full_chunk(tmp_path: Path) -> None:
    io.write(tmp_path / "source.compressed.ply", random_splats(512, 0))
    asset = io.read(tmp_path / "source.compressed.ply")
    far = replace(random_splats(300, 0, seed=1), means=np.full((300, 3), 50, np.float32))
    io.write(tmp_path / "out.compressed.ply", asset.append(far))
    old, new = cut(tmp_path / "source.compressed.ply", 512), cut(tmp_path / "out.compressed.ply", 812)
    assert len(new.chunks) == 4
    np.testing.assert_array_equal(new.chunks[:2], old.chunks)
    np.testing.assert_array_equal(new.rows[:512], old.rows)
    assert (io.read(tmp_path / "out.compressed.ply").means[512:] == 50).all()


def test_removed_rows(asset: sp.Splats, tmp_path: Path) -> None:
    """Chunks ahead of the gap keep their bytes; behind it rows move to other chunks and are packed again."""
    keep = np.delete(np.arange(600), [256 + 7])
    old, new, again = save_again(asset.take(keep), tmp_path)
    np.testing.assert_array_equal(new.rows[:263], old.rows[:263])
    np.testing.assert_array_equal(new.rows[:, 1], old.rows[keep, 1])  # rotations need no range
    np.testing.assert_array_equal(new.rows[:, 3] & 0xFF, old.rows[keep, 3] & 0xFF)
    assert np.abs(again.means - asset.means[keep]).max() < np.ptp(asset.means) / 1023
    assert new.sh == old.sh[: 263 * 9] + old.sh[264 * 9 :]


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_another_sh_degree(asset: sp.Splats, tmp_path: Path, degree: int) -> None:
    sh = np.zeros((600, (degree + 1) ** 2, 3), np.float32)
    shared = min(4, sh.shape[1])
    sh[:, :shared] = asset.sh[:, :shared]
    old, new, again = save_again(replace(asset, sh=sh), tmp_path)
    np.testing.assert_array_equal(new.rows, old.rows)
    np.testing.assert_array_equal(new.chunks, old.chunks)
    assert again.sh_degree == degree
    np.testing.assert_array_equal(again.sh[:, :shared], sh[:, :shared])
    assert np.abs(again.sh[:, shared:]).max(initial=0) <= 4 / 256


def test_extras_are_kept(tmp_path: Path) -> None:
    data = compressed([CHUNK], [ROW]).replace(b"element vertex", b"element note 2\nproperty short n\nelement vertex")
    at = len(data) - 16
    data = data[:at] + b"\x01\x00\x02\x00" + data[at:] + b"tail"
    splats = io.read(save(tmp_path, data))
    assert splats.source is not None
    assert splats.source.problems == ("4 trailing bytes (kept as they are)", "extra elements (kept as they are): note")
    io.write(tmp_path / "b.compressed.ply", edited(splats, opacities=((0,), 1.0)))
    opaque = data.replace(bytes([102, 51, 0, 255]), bytes([255, 51, 0, 255]))
    assert (tmp_path / "b.compressed.ply").read_bytes() == opaque


def test_rows_that_cannot_be_drawn(tmp_path: Path) -> None:
    splats = edited(random_splats(40, 0), means=((3, 1), np.nan), scales=((4, 0), np.inf), quats=((5,), 0.0))
    io.write(tmp_path / "a.compressed.ply", splats)
    again = io.read(tmp_path / "a.compressed.ply")
    bad = np.isin(np.arange(40), [3, 4, 5])
    assert again.drawable.all() and (again.opacities[bad] == 0).all()
    assert np.abs(again.means - splats.means)[~bad].max() < np.ptp(splats.means[~bad]) / 1023


def test_no_rows(tmp_path: Path) -> None:
    io.write(tmp_path / "a.compressed.ply", random_splats(0, 2))
    again = io.read(tmp_path / "a.compressed.ply")
    assert len(again) == 0 and again.sh_degree == 2
    more = replace(random_splats(3, 2), source=None)
    io.write(tmp_path / "b.compressed.ply", again.append(more))
    assert len(io.read(tmp_path / "b.compressed.ply")) == 3


@given(seed=st.integers(0, 2**32), edits=st.integers(0, 8), removed=st.integers(0, 3), added=st.integers(0, 200))
@settings(max_examples=40, deadline=None, database=None)
def test_fields_of_untouched_values(
    tmp_path_factory: pytest.TempPathFactory, seed: int, edits: int, removed: int, added: int
) -> None:
    """Where a chunk's range stayed, every untouched value of its own rows has the same bits; where it did not, every
    value is within half a step of what it was."""
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("edits")
    io.write(folder / "source.compressed.ply", random_splats(600, 0, seed % 1000))
    splats = io.read(folder / "source.compressed.ply")
    touched = np.zeros((600, 3), bool)
    means = splats.means.copy()
    for _ in range(edits):
        row, axis = rng.integers(600), rng.integers(3)
        means[row, axis] += rng.normal(0, 0.5)
        touched[row, axis] = True
    keep = np.sort(rng.permutation(600)[removed:])
    out = replace(splats, means=means).take(keep).append(splats.take(rng.integers(0, 600, added)))
    old, new, again = save_again(out, folder)
    origin = out.origin
    assert origin is not None
    chunk = np.arange(len(out)) // 256
    for axis, (shift, mask) in enumerate(((21, 2047), (11, 1023), (0, 2047))):
        stayed = (new.chunks[:, [axis, 3 + axis]][chunk] == old.chunks[:, [axis, 3 + axis]][origin // 256]).all(1)
        stayed &= ~np.concatenate([touched[keep, axis], np.zeros(added, bool)])
        fields = (new.rows[:, 0] >> shift & mask, old.rows[origin, 0] >> shift & mask)
        np.testing.assert_array_equal(fields[0][stayed], fields[1][stayed])
        ends = new.chunks.view(np.float32).astype(np.float64)
        step = ((ends[:, 3 + axis] - ends[:, axis]) / mask)[chunk]
        assert (np.abs(again.means[:, axis] - out.means[:, axis]) <= 0.501 * step + 1e-6).all()


def test_morton_order() -> None:
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 2**21, (200, 3))
    cells[:2] = [[0, 0, 0], [2**21 - 1] * 3]  # the box, so that cells are what morton_order sees

    def key(cell: np.ndarray) -> int:
        return sum((int(cell[axis]) >> bit & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3))

    means = cells.astype(np.float64)
    means[5] = np.nan
    expected = sorted((k for k in range(200) if k != 5), key=lambda k: key(cells[k]))
    assert morton_order(means).tolist() == [*expected, 5]
    assert len(morton_order(np.zeros((0, 3)))) == 0
    assert morton_order(np.full((3, 3), np.nan)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("count", [0, 1, 2, 1000])
def test_keys_that_agree_in_their_upper_bits_are_sorted_by_all_of_them(count: int) -> None:
    rng = np.random.default_rng(1)
    # Fewer values than keys, so that some agree altogether too; far below the place of a thousand rows.
    keys = rng.integers(0, 300, count).astype(np.uint64) | (
        rng.integers(0, 4, count).astype(np.uint64) << np.uint64(40)
    )
    keys[::7] = np.iinfo(np.uint64).max
    np.testing.assert_array_equal(stable_order(keys), np.argsort(keys, kind="stable"))


GOOD = compressed([CHUNK], [ROW], [[128] * 9])
REFUSED = {
    "text": (GOOD.replace(b"binary_little_endian", b"ascii"), "expected a binary compressed PLY"),
    "no chunk": (GOOD.replace(b"element chunk 1", b"element chonk 1"), "without element 'chunk'"),
    "chunk type": (GOOD.replace(b"float max_z", b"int max_z"), "element 'chunk' of a compressed PLY file lacks"),
    "word type": (GOOD.replace(b"uint packed_scale", b"int packed_scale"), "lacks 'uint packed_scale'"),
    "half the colours": (GOOD.replace(b"min_r", b"min_q"), "lacks 'float min_r'"),
    "chunk count": (GOOD.replace(b"vertex 1\n", b"vertex 257\n"), "expected 2 chunks for 257 rows, found 1"),
    "sh count": (GOOD.replace(b"element sh 1", b"element sh 2"), "expected 1 rows in element 'sh', found 2"),
    "sh width": (GOOD.replace(b"property uchar f_rest_8\n", b""), "expected 9, 24, 45 or 72 f_rest_* properties"),
    "truncated": (GOOD[:-1], "truncated: 1 rows of element 'sh' need 9 bytes, 8 are left"),
    "lying": (
        GOOD.replace(b"chunk 1\n", b"chunk 400000000000\n").replace(b"vertex 1\n", b"vertex 102400000000000\n")
        .replace(b"sh 1\n", b"sh 102400000000000\n")[:-1],
        "truncated: 400000000000 rows of element 'chunk' need 28800000000000 bytes, ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_one_line(tmp_path: Path, name: str) -> None:
    data, reason = REFUSED[name]
    with pytest.raises(ValueError) as error:
        io.read(save(tmp_path, data))
    message = str(error.value)
    assert reason in message and "\n" not in message


@pytest.mark.parametrize("ends", [(-np.inf, np.inf), (0.0, np.inf), (-np.inf, 0.0), (np.nan, 1.0), (3e38, -3e38)])
def test_ranges_that_no_value_can_lie_in_are_quantised_without_a_warning(ends: tuple[float, float]) -> None:
    low, high = (np.full((2, 3), end) for end in ends)
    levels = np.array([2047, 1023, 2047])
    assert (packing.quantise(np.array([[0.0, 1.0, -1.0], [1e30, -1e30, 0.5]]), low, high, levels) == 0).all()


@pytest.mark.parametrize("threads", ["1", "3"])
def test_chunks_are_packed_alike_alone_and_together(
    threads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    io.write(tmp_path / "source.compressed.ply", random_splats(1000, 2))
    splats, written = io.read(tmp_path / "source.compressed.ply"), []
    splats = replace(splats, means=splats.means + np.linspace(0, 1, 1000, dtype=np.float32)[:, None])
    splats.means[300] = np.nan  # is packed as the mean of all others
    for rows in (256, 1024):
        monkeypatch.setattr(compressed_ply, "PACKED_ROWS", rows)
        path = tmp_path / f"{rows}.compressed.ply"
        io.write(path, splats)
        written.append(path.read_bytes())
    assert written[0] == written[1]
