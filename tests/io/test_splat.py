""".splat: bytes by hand, and what an edit may change of a file."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpainter import io
from tests.support.io_assets import SH_C0, random_splats

ROW = struct.pack("<6f8B", 1.5, -2, 0.25, 0.5, 1, 0.125, 255, 0, 51, 102, 192, 64, 128, 255)


def save(folder: Path, data: bytes) -> Path:
    path = folder / "a.splat"
    path.write_bytes(data)
    return path


def test_by_hand(tmp_path: Path) -> None:
    splats = io.read(save(tmp_path, ROW * 2))
    assert len(splats) == 2 and splats.sh_degree == 0
    assert splats.means[1].tolist() == [1.5, -2, 0.25] and splats.scales[1].tolist() == [0.5, 1, 0.125]
    assert splats.quats[1].tolist() == [0.5, -0.5, 0, 127 / 128]
    np.testing.assert_allclose(0.5 + SH_C0 * splats.sh[1, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(splats.opacities[1], 0.4, atol=1e-7)
    assert splats.sha256 == hashlib.sha256(ROW * 2).hexdigest()


def test_new_file_by_hand(tmp_path: Path) -> None:
    splats = io.read(save(tmp_path, ROW))
    quats = np.array([[3, 4, 0, -12]], np.float32)  # norm 13; the largest component is -0.923
    io.write(tmp_path / "b.splat", replace(splats, quats=quats, source=None, origin=None))
    assert (tmp_path / "b.splat").read_bytes() == ROW[:28] + bytes([158, 167, 128, 10])


def test_sh_is_dropped_and_the_format_says_so(tmp_path: Path) -> None:
    splats = random_splats(20, 3)
    io.write(tmp_path / "a.splat", splats)
    again = io.read(tmp_path / "a.splat")
    assert again.sh_degree == 0 and "SH above degree 0 is dropped" in io.FORMATS["splat"].lossy
    assert np.abs(again.sh[:, 0] - splats.sh[:, 0]).max() <= 0.501 / 255 / SH_C0
    assert np.abs(again.opacities - splats.opacities).max() <= 0.501 / 255
    np.testing.assert_array_equal(again.means, splats.means)
    np.testing.assert_array_equal(again.scales, splats.scales)


@given(data=st.binary(min_size=32, max_size=32 * 6 + 31), seed=st.integers(0, 2**32), edits=st.integers(0, 5))
@settings(max_examples=80, deadline=None, database=None)
def test_untouched_bytes_stay(tmp_path_factory: pytest.TempPathFactory, data: bytes, seed: int, edits: int) -> None:
    """Any bytes at all are a .splat file: NaNs, zero quaternions, a last row cut short."""
    rng = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("edits")
    source = io.read(save(folder, data), lenient=True)
    io.write(folder / "same.splat", source)
    assert (folder / "same.splat").read_bytes() == data
    rows = rng.integers(0, len(source), 5)
    splats = source.take(rows)
    arrays = {"means": splats.means.copy(), "opacities": splats.opacities.copy(), "quats": splats.quats.copy()}
    expected = [data[32 * row : 32 * row + 32] for row in rows]
    for _ in range(edits):
        row, value = int(rng.integers(5)), float(np.float32(rng.uniform(0.1, 0.9)))
        kind = rng.integers(3)
        if kind == 0:
            arrays["means"][row, 1] = value
            expected[row] = expected[row][:4] + struct.pack("<f", value) + expected[row][8:]
        elif kind == 1 and splats.opacities[row] != np.float32(value):
            arrays["opacities"][row] = value
            expected[row] = expected[row][:27] + bytes([round(value * 255)]) + expected[row][28:]
        elif kind == 2:
            arrays["quats"][row] = [0.5, 0.5, -0.5, 0.5]
            if (splats.quats[row] != arrays["quats"][row]).any():
                expected[row] = expected[row][:28] + bytes([192, 192, 64, 192])
    io.write(folder / "out.splat", replace(splats, **arrays))
    result = (folder / "out.splat").read_bytes()
    # A NaN position keeps its payload; the bytes of means are whole floats, so compare row by row.
    assert [result[k : k + 32] for k in range(0, 160, 32)] == expected
    assert result[160:] == data[len(source) * 32 :]


def test_trailing_bytes_are_refused_or_reported(tmp_path: Path) -> None:
    path = save(tmp_path, ROW + b"abc")
    with pytest.raises(ValueError, match="32 bytes a row, got 1 rows and 3 bytes of one more.*lenient"):
        io.read(path)
    splats = io.read(path, lenient=True)
    assert splats.source is not None and len(splats) == 1
    assert splats.source.problems == ("the last row is cut short: 3 trailing bytes (kept as they are)",)


def test_nan_cannot_be_said_in_bytes(tmp_path: Path) -> None:
    splats = random_splats(3, 0)
    sh, quats = splats.sh.copy(), splats.quats.copy()
    sh[0, 0, 1], quats[1] = np.nan, 0
    io.write(tmp_path / "a.splat", replace(splats, sh=sh, quats=quats))
    again = io.read(tmp_path / "a.splat")
    assert again.drawable.tolist() == [True, False, True]


@pytest.mark.parametrize("data", [b"", ROW[:31]])
def test_too_short(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(ValueError, match="32 bytes a row, got"):
        io.read(save(tmp_path, data))


def test_no_rows_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one row"):
        io.write(tmp_path / "a.splat", random_splats(0, 0))
    assert list(tmp_path.iterdir()) == []
