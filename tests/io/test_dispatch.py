"""io.read and io.write: which format, which refusals, and files that appear whole or not at all."""

from __future__ import annotations

import gzip
import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.io import files
from tests.support.io_assets import random_splats


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("a.ply", "ply"),
        ("A.PLY", "ply"),
        ("a.compressed.ply", "compressed.ply"),
        ("A.Compressed.Ply", "compressed.ply"),
        ("a.splat", "splat"),
        ("a.ksplat", "ksplat"),
        ("a.spz", "spz"),
        ("a.sog", "sog"),
        ("folder/meta.json", "sog"),
        ("a.glb", "glb"),
        ("notmeta.json", None),
        ("a.obj", None),
        ("ply", None),
    ],
)
def test_names(name: str, key: str | None) -> None:
    assert io.format_of_name(Path(name)) == key


@pytest.mark.parametrize(
    ("name", "data", "key"),
    [
        ("a.bin", b"ply\nformat ascii 1.0\n", "ply"),
        ("a.bin", b"ply\r\nformat ascii 1.0\r\n", "ply"),
        ("a.compressed.ply", b"ply\nformat ascii 1.0\nend_header\npacked_position", "ply"),
        ("a.ply", b"ply\nelement vertex 1\nproperty uint packed_position\nend_header\n", "compressed.ply"),
        ("a.splat", b"glTF", "glb"),
        ("a.bin", b"PK\x03\x04", "sog"),
        ("a.bin", b"NGSP", "spz"),
        ("a.bin", b"\x1f\x8b\x08", "spz"),
        ("a.splat", b"\x1f\x8b\x08", "splat"),  # two bytes of a float prove nothing
        ("a.ksplat", b"\x00\x01", "ksplat"),
        ("a.splat", b"", "splat"),
    ],
)
def test_content_before_name(tmp_path: Path, name: str, data: bytes, key: str) -> None:
    (tmp_path / name).write_bytes(data)
    assert io.detect(tmp_path / name) == key


def test_every_format_is_said_completely() -> None:
    for key, entry in io.FORMATS.items():
        assert entry.key == key and entry.suffixes and entry.description and entry.exact.endswith(".")
        assert entry.lossy == "" or entry.lossy.endswith(".")
    assert io.FORMATS["ply"].lossy == "" and io.FORMATS["ksplat"].write is None


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda p: p / "none.ply", "no such file"),
        (lambda p: p, "is a folder without meta.json"),
        (lambda p: _file(p / "a.obj", b"v 0 0 0\n"), "unknown format; expected a splat file (.compressed.ply, .ply, "),
        (lambda p: _folder(p / "a.ply"), "is a folder without meta.json"),
    ],
)
def test_unreadable(tmp_path: Path, make, reason: str) -> None:
    with pytest.raises(ValueError) as error:
        io.read(make(tmp_path))
    assert reason in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "ksplat", "spz", "sog", "glb"])
def test_files_that_were_never_written(ending: str, tmp_path: Path) -> None:
    path = _file(tmp_path / f"a.{ending}", b"")
    with pytest.raises(ValueError, match=r"; it is empty \(0 bytes\): its download or copy was not finished"):
        io.read(path)
    with pytest.raises(ValueError, match="begins with 4,096 zero bytes, as no splat file does; its download or copy"):
        io.read(_file(path, bytes(4096)))


@pytest.mark.parametrize("ending", ["glb", "sog"])
def test_other_files_packed_by_gzip_say_so(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{ending}"
    io.write(path, random_splats(20, 0))
    with pytest.raises(ValueError, match="is packed by gzip; unpack it first"):
        io.read(_file(path, gzip.compress(path.read_bytes())))


def test_gzip_in_gzip_and_a_packed_splat_say_what_to_do(tmp_path: Path) -> None:
    for ending in ("spz", "splat"):
        io.write(tmp_path / f"a.{ending}", random_splats(20, 0))
    with pytest.raises(ValueError, match="is packed by gzip twice; unpack it once"):
        io.read(_file(tmp_path / "b.spz", gzip.compress((tmp_path / "a.spz").read_bytes())))
    with pytest.raises(ValueError, match=r"inside the gzip stream, found .*; unpack it first \(gunzip\)"):
        io.read(_file(tmp_path / "a.splat.gz", gzip.compress((tmp_path / "a.splat").read_bytes())))


def _file(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root reads everything")
def test_no_permission(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.ply", b"ply\n")
    path.chmod(0)
    with pytest.raises(ValueError, match="cannot be read"):
        io.read(path)


def test_overwriting_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    io.write(path, random_splats(2, 0))
    before = path.read_bytes()
    with pytest.raises(ValueError, match="already exists"):
        io.write(path, random_splats(3, 0))
    assert path.read_bytes() == before
    io.write(str(path), random_splats(3, 0), overwrite=True)
    assert len(io.read(str(path))) == 3


def test_over_its_own_source(tmp_path: Path) -> None:
    """The rows in memory do not depend on the file they came from."""
    path = tmp_path / "a.ply"
    io.write(path, random_splats(50, 1))
    splats, before = io.read(path), path.read_bytes()
    half = splats.take(np.arange(25))
    io.write(path, half, overwrite=True)
    io.write(path, splats, overwrite=True)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("a.obj", "unknown format"),
        ("a.ksplat", "read only"),
        ("none/a.ply", "cannot be written"),
        ("a", "unknown format"),
    ],
)
def test_unwritable(tmp_path: Path, name: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        io.write(tmp_path / name, random_splats(2, 0))
    assert "\n" not in str(error.value) and list(tmp_path.iterdir()) == []


def test_inconsistent_rows(tmp_path: Path) -> None:
    splats = random_splats(4, 0)
    io.write(tmp_path / "a.ply", splats)
    read = io.read(tmp_path / "a.ply")
    for wrong, reason in (
        (replace(splats, quats=splats.quats[:, :3]), "expected quats of shape"),
        (replace(splats, opacities=splats.opacities[:3]), "expected opacities of shape"),
        (replace(splats, sh=np.zeros((4, 5, 3), np.float32)), "expected 1, 4, 9, 16 or 25 SH coefficients, got 5"),
        (replace(read, origin=np.arange(3)), "expected origin of shape"),
        (replace(read, origin=np.full(4, 4)), "expected origins from -1 to 3"),
    ):
        with pytest.raises(ValueError, match=reason):
            io.write(tmp_path / "b.ply", wrong)
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat"])
def test_torch_attributes(tmp_path: Path, name: str) -> None:
    import torch

    io.write(tmp_path / name, random_splats(300, 0))
    splats = io.read(tmp_path / name)
    for dtype in (torch.float32, torch.float64):
        io.write(tmp_path / f"b{name}", splats.torch(dtype=dtype), overwrite=True)
        assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()
    wide = replace(splats, means=splats.means.astype(np.float64))
    io.write(tmp_path / f"b{name}", wide, overwrite=True)
    assert (tmp_path / f"b{name}").read_bytes() == (tmp_path / name).read_bytes()


def test_a_failed_write_leaves_nothing_and_harms_nothing(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.bin", b"before")
    with pytest.raises(RuntimeError), files.writing(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert path.read_bytes() == b"before" and [p.name for p in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.skipif(os.name != "posix", reason="POSIX permissions and links")
def test_permissions_and_links_stay(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.bin", b"before")
    path.chmod(0o640)
    link = tmp_path / "link.bin"
    link.symlink_to(path)
    with files.writing(link) as file:
        file.write(b"after")
    assert link.is_symlink() and path.read_bytes() == b"after"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_take_is_bounded() -> None:
    data = bytes(range(10))
    assert bytes(files.take(data, 2, 3, "a.spz", "rows")) == b"\x02\x03\x04"
    with pytest.raises(ValueError, match="a.spz: truncated: rows needs 9 bytes at byte 2, the file has 10"):
        files.take(data, 2, 9, "a.spz", "rows")
    with pytest.raises(ValueError, match="negative"):
        files.take(data, 2, -1, "a.spz", "rows")


def test_reading_a_ply_imports_neither_torch_nor_numba(tmp_path: Path) -> None:
    io.write(tmp_path / "a.ply", random_splats(2, 0))
    code = f"import splatpainter as sp, sys; sp.read({str(tmp_path / 'a.ply')!r})\n"
    code += "assert not {'torch', 'numba', 'PIL'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
