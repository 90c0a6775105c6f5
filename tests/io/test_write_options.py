"""What can be chosen when a file is written: that the file has it, what stays exact, and what the receipt says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatpainter.io import FORMATS, read, write
from splatpainter.io.formats.sog import SogFile
from splatpainter.io.formats.spz import SpzFile
from splatpainter.io.size_estimate import estimated_bytes
from splatpainter.io.write_options import WriteOptions
from splatpainter.splats import ATTRIBUTES
from tests.support.io_assets import random_splats

HOLDING_SH = [key for key, entry in FORMATS.items() if entry.write is not None and "sh_degree" in entry.write_options]


def detail(path: Path) -> SpzFile:
    source = read(path).source
    assert source is not None and isinstance(source.detail, SpzFile)
    return source.detail


def sog_file(path: Path) -> SogFile:
    source = read(path).source
    assert source is not None and isinstance(source.detail, SogFile)
    return source.detail


def ending(key: str) -> str:
    return FORMATS[key].suffixes[0]


@pytest.mark.parametrize("key", HOLDING_SH)
def test_a_lower_degree_and_the_mark_arrive_and_the_rest_is_what_it_is_without_them(key: str, tmp_path: Path) -> None:
    splats = random_splats(300, 3)
    write(tmp_path / f"all{ending(key)}", splats)
    write(tmp_path / f"less{ending(key)}", splats, options=WriteOptions(sh_degree=1, antialiased=True))
    one, two = read(tmp_path / f"all{ending(key)}"), read(tmp_path / f"less{ending(key)}")
    assert (two.sh_degree, two.antialiased, one.sh_degree, one.antialiased) == (1, True, 3, False)
    for name in ATTRIBUTES[:-1]:
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    assert np.abs(two.sh - splats.sh[:, :4]).max() < (0.2 if key == "sog" else 0.03)
    assert (tmp_path / f"less{ending(key)}").stat().st_size < (tmp_path / f"all{ending(key)}").stat().st_size


@pytest.mark.parametrize("key", HOLDING_SH)
def test_a_file_that_is_only_lowered_keeps_the_values_of_the_bands_that_stay(key: str, tmp_path: Path) -> None:
    """Words that stay are not rounded a second time."""
    path, less = tmp_path / f"a{ending(key)}", tmp_path / f"b{ending(key)}"
    write(path, random_splats(200, 3), options=WriteOptions(sh_bits=8 if key == "spz" else None))
    splats = read(path)
    write(less, splats, options=WriteOptions(sh_degree=2))
    assert np.array_equal(read(less).sh, splats.sh[:, :9])
    write(less, splats, overwrite=True, options=WriteOptions(sh_degree=3))
    assert less.read_bytes() == path.read_bytes(), "nothing was left out: the file as it was"


def test_spz_versions_and_bits(tmp_path: Path) -> None:
    splats, sizes = random_splats(2000, 3), {}
    for bits in (4, 7, 8):
        write(tmp_path / f"{bits}.spz", splats, options=WriteOptions(sh_bits=bits))
        sizes[bits] = (tmp_path / f"{bits}.spz").stat().st_size
        words = detail(tmp_path / f"{bits}.spz").streams["sh"].astype(int)
        inner = words[(words > 0) & (words < 255)]
        assert not (inner % (1 << (8 - max(bits, 5)))).any()
    assert sizes[4] < sizes[7] < sizes[8]
    write(tmp_path / "usual.spz", splats)
    assert (tmp_path / "usual.spz").read_bytes() == (tmp_path / "7.spz").read_bytes()
    for version in (2, 3, 4):
        write(tmp_path / f"v{version}.spz", read(tmp_path / "usual.spz"), options=WriteOptions(spz_version=version))
        file = detail(tmp_path / f"v{version}.spz")
        assert file.version == version
        assert np.array_equal(file.streams["sh"], detail(tmp_path / "usual.spz").streams["sh"])
    write(tmp_path / "coarser.spz", read(tmp_path / "8.spz"), options=WriteOptions(sh_bits=4))
    assert (tmp_path / "coarser.spz").stat().st_size < 1.05 * sizes[4], "also a file's own words"


def test_a_palette_of_fewer_vectors_is_smaller_and_rougher(tmp_path: Path) -> None:
    splats, errors, sizes = random_splats(3000, 2), [], []
    for count in (None, 1024, 64):
        path = tmp_path / f"{count}.sog"
        write(path, splats, options=WriteOptions(sh_palette=count))
        source = read(path).source
        assert (
            source is not None and source.detail.palette is not None and len(source.detail.palette) <= (count or 2048)
        )
        errors.append(float(np.abs(read(path).sh - splats.sh).mean()))
        sizes.append(path.stat().st_size)
    assert errors == sorted(errors) and sizes == sorted(sizes, reverse=True)
    write(tmp_path / "again.sog", read(tmp_path / "None.sog"), options=WriteOptions(sh_palette=64))
    assert (tmp_path / "again.sog").stat().st_size < 1.1 * sizes[2], "also of an asset that was SOG"


@pytest.mark.parametrize(
    ("name", "options", "reason"),
    [
        ("a.splat", WriteOptions(sh_degree=0), "a.splat: sh_degree is not an option of this format; it has none"),
        (
            "a.ply",
            WriteOptions(spz_version=4),
            "spz_version is not an option of this format; it has sh_degree, antialias",
        ),
        ("a.spz", WriteOptions(spz_version=1), "expected spz_version of 2 to 4, got 1"),
        ("a.spz", WriteOptions(sh_bits=9), "expected sh_bits of 4 to 8, got 9"),
        ("a.sog", WriteOptions(sh_palette=0), "expected sh_palette of 64 to 65536, got 0"),
        ("a.ply", WriteOptions(sh_degree=True), "expected sh_degree of 0 to 4, got True"),
        ("a.ply", WriteOptions(antialiased="yes"), "expected antialiased to be true or false"),  # type: ignore[arg-type]
    ],
)
def test_what_is_refused(name: str, options: WriteOptions, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=reason):
        write(tmp_path / name, random_splats(10, 1), options=options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("key", ["ply", "spz", "sog"])
def test_the_estimate_follows_the_options(key: str, tmp_path: Path) -> None:
    splats = random_splats(4000, 3)
    for options in (WriteOptions(sh_degree=0), WriteOptions(sh_degree=2)):
        path = tmp_path / f"{options.sh_degree}{ending(key)}"
        write(path, splats, options=options)
        assert abs(estimated_bytes(splats, ending(key), options) / path.stat().st_size - 1) < 0.02
