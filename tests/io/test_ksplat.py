""".ksplat: files packed here from the format's description, checked against their values and splat-transform."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from tests.support.io_assets import SH_C0, disagreement, float_columns

pytest_plugins = ["tests.support.node_oracle"]

BLOCK = 5.0


def section(level: int, degree: int, rows: int, rng: np.random.Generator) -> tuple[bytes, bytes, dict[str, np.ndarray]]:
    """(section header, section data, values) of `rows` rows in one full bucket of 4 and two partly filled ones."""
    size, partial = 4, [2, rows - 6]
    centres = rng.integers(-3, 3, (3, 3)) * BLOCK
    bucket = np.repeat([0, 1, 2], [size, *partial])
    fields = rng.integers(0, 65536, (rows, 3))
    means = rng.normal(0, 2, (rows, 3)).astype(np.float32)
    if level:
        means = ((fields - 32767.0) * (BLOCK / 2 / 32767) + centres[bucket]).astype(np.float32)
    scales = np.exp(rng.normal(-3, 1, (rows, 3))).astype(np.float16)
    quats = rng.normal(0, 1, (rows, 4)).astype(np.float16)
    rgba = rng.integers(1, 255, (rows, 4), np.uint8)
    rest = rng.normal(0, 0.4, (rows, 3 * (degree + 1) ** 2 - 3)).astype(np.float16)
    bytes_rest = rng.integers(0, 256, rest.shape, np.uint8)
    data = b""
    if level:
        data += struct.pack("<2I", *partial) + centres.astype("<f4").tobytes()
    for i in range(rows):
        real = "<f4" if level == 0 else "<f2"
        data += means[i].tobytes() if level == 0 else fields[i].astype("<u2").tobytes()
        data += scales[i].astype(real).tobytes() + quats[i].astype(real).tobytes() + rgba[i].tobytes()
        data += bytes_rest[i].tobytes() if level == 2 else rest[i].astype(real).tobytes()
    packed = (
        [rows, rows, size, 3, 0, 12, 32767, len(data), 1, 2] if level else [rows, rows, 0, 0, 0, 0, 0, len(data), 0, 0]
    )
    header = bytearray(1024)
    header[:40] = struct.pack("<10I", *packed)
    header[16:20] = struct.pack("<f", BLOCK if level else 0)
    header[40:42] = struct.pack("<H", degree)
    values = {"means": means, "scales": scales, "quats": quats, "rgba": rgba}
    values["rest"] = bytes_rest / 255 * 3 - 1.5 if level == 2 else rest.astype(np.float64)
    return bytes(header), data, values


def make(folder: Path, level: int, degrees: list[int], version: tuple[int, int] = (0, 1)) -> tuple[Path, list[dict]]:
    rng = np.random.default_rng(level)
    sections = [section(level, degree, 9 + k, rng) for k, degree in enumerate(degrees)]
    rows = sum(len(values["means"]) for _, _, values in sections)
    header = bytearray(4096)
    header[:24] = struct.pack("<4B4IHH", *version, 0, 0, len(sections), len(sections), rows, rows, level, 0)
    path = folder / "a.ksplat"
    path.write_bytes(bytes(header) + b"".join(h for h, _, _ in sections) + b"".join(d for _, d, _ in sections))
    return path, [values for _, _, values in sections]


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degrees", [[0], [1], [2], [3], [0, 3, 1]])
def test_against_the_values_that_were_packed(tmp_path: Path, level: int, degrees: list[int]) -> None:
    path, parts = make(tmp_path, level, degrees)
    splats = io.read(path)
    assert splats.sh_degree == max(degrees)
    start = 0
    for degree, values in zip(degrees, parts, strict=True):
        rows = slice(start, start + len(values["means"]))
        start = rows.stop
        np.testing.assert_allclose(splats.means[rows], values["means"], atol=1e-5)
        np.testing.assert_array_equal(splats.scales[rows], values["scales"].astype(np.float32))
        np.testing.assert_array_equal(splats.quats[rows], values["quats"].astype(np.float32))
        np.testing.assert_allclose(splats.opacities[rows], values["rgba"][:, 3] / 255, atol=1e-7)
        np.testing.assert_allclose(splats.sh[rows, 0], (values["rgba"][:, :3] / 255 - 0.5) / SH_C0, atol=1e-6)
        # Band by band, and within a band all red, then green, then blue.
        for l in range(1, degree + 1):
            band = values["rest"][:, 3 * (l * l - 1) : 3 * ((l + 1) ** 2 - 1)].reshape(-1, 3, 2 * l + 1)
            for c in range(3):
                np.testing.assert_allclose(splats.sh[rows, l * l : (l + 1) ** 2, c], band[:, c], atol=1e-6)
        assert (splats.sh[rows, (degree + 1) ** 2 :] == 0).all()
    assert start == len(splats) and splats.source is not None and splats.source.problems == ()


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_against_splat_transform(tmp_path: Path, level: int, degree: int, splat_transform: Callable[..., str]) -> None:
    path, _ = make(tmp_path, level, [degree])
    splat_transform(path, tmp_path / "oracle.ply")
    difference = disagreement(io.read(path), float_columns(tmp_path / "oracle.ply"))
    assert all(value < 2e-6 for value in difference.values()), difference


def test_cannot_be_written(tmp_path: Path) -> None:
    path, _ = make(tmp_path, 0, [0])
    with pytest.raises(ValueError, match="read only"):
        io.write(tmp_path / "b.ksplat", io.read(path))


def patched(folder: Path, level: int, at: int, value: bytes) -> Path:
    path, _ = make(folder, level, [1])
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("level", "at", "value", "reason"),
    [
        (0, 1, b"\x00", "expected .ksplat version 0.1 or a later 0.x, got 0.0"),
        (0, 0, b"\x01", "got 1.1"),
        (0, 20, b"\x03", "compression level 0, 1 or 2, got 3"),
        (0, 4, struct.pack("<I", 0), "at least one section"),
        (0, 4, struct.pack("<I", 2**32 - 1), "truncated: 4294967295 section headers"),
        (0, 4096, struct.pack("<2I", 2**32 - 1, 2**32 - 1), "truncated: section 0 with 4294967295 rows"),
        (0, 4096, struct.pack("<I", 10), "section 0: 10 rows, but room for 9"),
        (0, 4096 + 40, b"\x04", "expected SH degree 0 to 3, got 4"),
        (1, 4096 + 20, b"\x10", "expected 12 bytes a bucket, got 16"),
        (1, 4096 + 12, struct.pack("<I", 2**32 - 1), "truncated: section 0"),
        (1, 4096 + 8, struct.pack("<I", 2), "9 rows do not fit the 3 buckets"),
    ],
)
def test_refused_in_one_line(tmp_path: Path, level: int, at: int, value: bytes, reason: str) -> None:
    with pytest.raises(ValueError) as error:
        io.read(patched(tmp_path, level, at, value))
    message = str(error.value)
    assert reason in message and "a.ksplat: " in message and "\n" not in message


def test_huge_buckets_overflow_nothing(tmp_path: Path) -> None:
    path = patched(tmp_path, 1, 4096 + 8, struct.pack("<I", 2**32 - 1))
    assert len(io.read(path)) == 9  # all rows are in the first bucket, then


def test_truncated(tmp_path: Path) -> None:
    path, _ = make(tmp_path, 1, [1])
    data = path.read_bytes()
    for size in [0, 1, 100, 4095, 4096, 5000, *range(5120, len(data), 7)]:
        path.write_bytes(data[:size])
        with pytest.raises(ValueError):
            io.read(path)
    path.write_bytes(data[:16] + struct.pack("<I", 77) + data[20:])
    splats = io.read(path)
    assert splats.source is not None and splats.source.problems == ("the header says 77 rows, the sections hold 9",)
