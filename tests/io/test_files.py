"""Large files, read and compared by all threads."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io import files, losses
from splatpainter.io.formats import ply
from splatpainter.kernels.parallel import THREADS_VARIABLE
from splatpainter.splats import ATTRIBUTES
from tests.support.io_assets import random_splats


def test_what_passes_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    with files.passing(), files.writing(tmp_path / "a") as file:
        file.write(b"abc")
    assert not synced and (tmp_path / "a").read_bytes() == b"abc"
    # Samples that are written to be measured pass; whatever is written behind them does not.
    losses.measured_as(random_splats(10, 1), "spz")
    assert not synced
    with files.writing(tmp_path / "b") as file:
        file.write(b"abc")
    assert synced


@pytest.mark.parametrize("at", [0, files.COMPARED_BYTES, 2 * files.COMPARED_BYTES + 99])
def test_every_piece_of_a_file_is_compared(tmp_path: Path, at: int) -> None:
    data = bytearray(2 * files.COMPARED_BYTES + 100)
    path = tmp_path / "file"
    path.write_bytes(data)
    assert files.holds(path, [memoryview(bytes(data))])
    data[at] ^= 1
    assert not files.holds(path, [memoryview(bytes(data))])


ROW = np.dtype([("a", "<f4"), ("b", "u1"), ("c", "<i2")])


@pytest.mark.parametrize("threads", ["1", "3"])
@pytest.mark.parametrize("has_preadv", [True, False])
def test_arrays_are_what_fromfile_reads(
    threads: str, has_preadv: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    monkeypatch.setattr(files, "SHARED_BYTES", 64)
    if not has_preadv:
        monkeypatch.delattr("os.preadv", raising=False)
    data = np.random.default_rng(0).bytes(7 * 100 + 5)
    (tmp_path / "a").write_bytes(data)
    for start, count, there in ((0, 100, 100), (5, 100, 100), (3, 1, 1), (3, 0, 0), (705, 4, 0), (600, 50, 15)):
        with files.reading(tmp_path / "a") as file:
            file.seek(start)
            rows = files.read_array(file, ROW, count)
            assert rows.tobytes() == data[start : start + 7 * there]
            assert file.read() == data[min(start + 7 * count, len(data)) :]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_a_file_holds_its_own_bytes_and_no_others(
    threads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    monkeypatch.setattr(files, "SHARED_BYTES", 10)
    data = np.random.default_rng(1).bytes(95)
    pieces = [data[:3], b"", memoryview(data)[3:60], data[60:]]
    path = tmp_path / "a"
    path.write_bytes(data)
    assert files.holds(path, pieces)
    for at in (0, 2, 3, 12, 59, 60, 94):
        path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
        assert not files.holds(path, pieces), at
    for other in (data + b"\0", data[:-1], b""):
        path.write_bytes(other)
        assert not files.holds(path, pieces)
    with pytest.raises(ValueError, match="no such file"):
        files.holds(tmp_path / "b", pieces)


def test_many_new_rows_are_written_as_few_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = replace(random_splats(100, 2), source=None, origin=None)
    io.write(tmp_path / "a.ply", splats)
    for rows in (1, 33, 50, 99, 100):
        monkeypatch.setattr(ply, "NEW_BLOCK_ROWS", rows)
        io.write(tmp_path / "b.ply", splats, overwrite=True)
        assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_a_copy_is_known_by_its_bytes(tmp_path: Path) -> None:
    io.write(tmp_path / "a.ply", replace(random_splats(30, 1), source=None, origin=None))
    data = (tmp_path / "a.ply").read_bytes()
    source = io.read(tmp_path / "a.ply").source
    assert source is not None and ply.is_copy(source.detail, tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    assert not ply.is_copy(source.detail, tmp_path / "b.ply")
    text = data.split(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    text += b"\n".join(
        b" ".join(b"%r" % float(x) for x in row) for row in np.frombuffer(data[-30 * 26 * 4 :], "<f4").reshape(30, 26)
    )
    (tmp_path / "c.ply").write_bytes(text)  # its last line has no end
    source = io.read(tmp_path / "c.ply").source
    assert source is not None and ply.is_copy(source.detail, tmp_path / "c.ply")
    assert source.sha256 == files.file_sha256(tmp_path / "c.ply")


@pytest.mark.parametrize("threads", ["1", "3"])
def test_losses_of_many_rows_are_those_of_few(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, threads)
    rng, before = np.random.default_rng(4), replace(random_splats(90, 1), source=None, origin=None)
    moved = {name: getattr(before, name).copy() for name in ATTRIBUTES}
    for values in moved.values():
        values[20:70] += rng.normal(scale=0.01, size=values[20:70].shape).astype(np.float32)
    moved |= {"opacities": moved["opacities"].clip(0, 1), "scales": np.abs(moved["scales"])}
    after = replace(before, **moved)
    expected = losses.measure(before, after)
    assert expected.move_largest > 0 and expected.rotation_rms > 0 and expected.sh_rms > 0
    for rows in (1, 7, 32):
        monkeypatch.setattr(losses, "LOSSES", replace(losses.LOSSES, block_rows=rows))
        for name, value in losses.measure(before, after).record().items():
            assert value == pytest.approx(getattr(expected, name), rel=1e-12), name


def test_equal_numbers_at_other_places_have_moved() -> None:
    before = replace(random_splats(20, 0), source=None, origin=None)
    moved = losses.measure(before, replace(before, offset=(0.0, 2.0, 0.0)))
    assert moved.move_largest == pytest.approx(float((2 / before.scales.max(1)).max()))
    assert moved.moved_share == float((2 / before.scales.max(1) > 1).mean())


def test_large_files_tell_how_much_of_them_was_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also to whoever cancels meanwhile: what is raised ends the reading, on whichever thread it came."""
    monkeypatch.setattr(files, "SHARED_BYTES", 1 << 12)
    path = tmp_path / "large"
    data = np.random.default_rng(0).integers(0, 256, 50_000, np.uint8).tobytes()
    path.write_bytes(data)

    def as_array() -> bytes:
        with files.reading(path) as file:
            return files.read_array(file, np.dtype(np.uint8), len(data)).tobytes()

    for read in (lambda: files.read_all(path), as_array):
        for threads in ("1", "2"):
            monkeypatch.setenv(THREADS_VARIABLE, threads)
            pieces: list[int] = []
            with files.watched(pieces.append):
                assert read() == data
            assert len(pieces) > 10 and sum(pieces) == len(data)
            assert read() == data and sum(pieces) == len(data), "no longer watched"

            def stopped(count: int) -> None:
                raise RuntimeError(count)

            with pytest.raises(RuntimeError), files.watched(stopped):
                read()
