"""Our readers and writers beside splat-transform's: the same file, read by both, row by row and value by value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from tests.support.io_assets import disagreement, float_columns, random_splats

pytest_plugins = ["tests.support.node_oracle"]

Oracle = Callable[..., str]
REAL = [
    ("biker.compressed.ply", 152746, 0),
    ("massa.compressed.ply", 58649, 0),
    ("massa.l1.ksplat", 58326, 0),
    ("massa.ply", 58649, 0),
    ("massa.splat", 58649, 0),
    ("playbot_lod3.compressed.ply", 31000, 2),
    ("playbot_lod3.l1.ksplat", 31000, 2),
    ("playbot_lod3.ply", 31000, 2),
    ("playbot_lod4.l0.ksplat", 8406, 2),
    ("playbot_lod4_sh3.ply", 8406, 3),
]
CLOSE = {"means": 0, "quats": 1e-6, "scales": 2e-6, "opacities": 2e-6, "base": 0, "rest": 0}
"""Both decode the same bits, so only the rounding of exp, log, sigmoid and normalisation may differ."""
SPLAT_QUATS = 0.012
"""In .splat, it takes a rotation byte b for b / 127.5 - 1; the format's author and we for (b - 128) / 128."""


def agree(path: Path, oracle: Oracle, folder: Path) -> None:
    oracle(path, folder / "oracle.ply")
    difference = disagreement(io.read(path), float_columns(folder / "oracle.ply"))
    close = CLOSE | ({"quats": SPLAT_QUATS} if path.suffix == ".splat" else {})
    assert all(difference[name] <= close[name] for name in difference), difference


@pytest.mark.shared
@pytest.mark.parametrize("splat_transform", ["3"], indirect=True, scope="session")  # 2: what we write
@pytest.mark.parametrize(("name", "rows", "degree"), REAL)
def test_real_files(name: str, rows: int, degree: int, shared: Path, tmp_path: Path, splat_transform: Oracle) -> None:
    path = shared / "data" / "splats" / name
    splats = io.read(path)
    assert (len(splats), splats.sh_degree) == (rows, degree)
    agree(path, splat_transform, tmp_path)


@pytest.mark.shared
@pytest.mark.parametrize("name", [name for name, _, _ in REAL])
def test_real_files_unchanged(name: str, shared: Path, tmp_path: Path) -> None:
    """Read, then write: the same bytes."""
    path = shared / "data" / "splats" / name
    splats = io.read(path)
    assert splats.source is not None
    assert splats.source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    if io.FORMATS[splats.source.format].write is not None:
        io.write(tmp_path / name, splats)
        assert (tmp_path / name).read_bytes() == path.read_bytes()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat"])
def test_what_we_write(name: str, degree: int, tmp_path: Path, splat_transform: Oracle) -> None:
    splats = random_splats(700, degree)
    io.write(tmp_path / name, splats)
    agree(tmp_path / name, splat_transform, tmp_path)
    if name == "a.ply":  # raw floats: the oracle also finds the values that went in, not only those we read back
        difference = disagreement(splats, float_columns(tmp_path / "oracle.ply"))
        assert difference["means"] == difference["base"] == difference["rest"] == 0
        assert max(difference["scales"], difference["opacities"], difference["quats"]) < 2e-6


@pytest.mark.parametrize("degree", [0, 3])
def test_what_it_compresses(degree: int, tmp_path: Path, splat_transform: Oracle) -> None:
    """Its quantisation and ours: equal steps, so rows (which it puts in Morton order) are as close to the truth."""
    truth = random_splats(700, degree)
    io.write(tmp_path / "a.ply", truth)
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.compressed.ply")
    agree(tmp_path / "theirs.compressed.ply", splat_transform, tmp_path)
    theirs = io.read(tmp_path / "theirs.compressed.ply")
    # Written by us in their order, with the same chunks: the same bits.
    nearest = np.argmin(((theirs.means[:, None] - truth.means[None]) ** 2).sum(-1), 1)
    assert sorted(nearest) == list(range(700))
    io.write(tmp_path / "ours.compressed.ply", truth.take(nearest))
    ours, bits = ((tmp_path / f"{who}.compressed.ply").read_bytes() for who in ("ours", "theirs"))
    ours, bits = (np.frombuffer(data.split(b"end_header\n", 1)[1], np.uint8) for data in (ours, bits))
    assert len(ours) == len(bits) and (ours != bits).mean() < 2e-3  # ties of rounding may fall either way


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply"])
def test_edited_files_are_read_elsewhere(name: str, tmp_path: Path, splat_transform: Oracle) -> None:
    """Changed colours, removed rows, appended children: still a sound file for others."""
    io.write(tmp_path / name, random_splats(700, 2))
    splats = io.read(tmp_path / name)
    sh = splats.sh.copy()
    sh[100:200, 0] += 2
    edited = replace(splats, sh=sh).take(np.delete(np.arange(700), [5, 300]))
    children = edited.take(np.arange(50))
    io.write(tmp_path / f"b{name}", edited.append(replace(children, scales=children.scales / 2)))
    agree(tmp_path / f"b{name}", splat_transform, tmp_path)


def test_antialiased_is_understood_elsewhere(tmp_path: Path, splat_transform: Oracle) -> None:
    """Only that the comment harms no other reader: this version of the oracle does not report it."""
    io.write(tmp_path / "a.ply", replace(random_splats(5, 1), antialiased=True))
    agree(tmp_path / "a.ply", splat_transform, tmp_path)
    assert io.read(tmp_path / "a.ply").antialiased
