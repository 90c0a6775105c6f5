"""Our files in gsply and in GaussForge (with Niantic's own SPZ library), theirs in ours: row by row, value by value."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.doubts import doubts
from splatpainter.io.formats.spz import write_spz
from splatpainter.splats import Splats
from tests.support.io_assets import random_splats
from tests.support.io_packed import quats_apart
from tests.support.python_oracles import gaussforge_convert, gaussforge_read, gsply_spz, gsply_write_spz

READERS: dict[str, Callable[[Path], Splats]] = {
    "gsply": gsply_spz,
    "gaussforge": lambda path: gaussforge_read(path, "spz"),
}


def write_with(program: str, path: Path, splats: Splats, version: int) -> None:
    if program == "gsply":
        gsply_write_spz(path, splats, version)
    else:
        io.write(path.with_suffix(".ply"), splats)
        gaussforge_convert(path.with_suffix(".ply"), "ply", path, "spz", version)


def assert_alike(theirs: Splats, ours: Splats, quats: float = 1e-6) -> None:
    """The same values of the same words, up to the rounding of exp, log and square roots."""
    assert np.array_equal(theirs.means, ours.means) and np.array_equal(theirs.sh[:, 1:], ours.sh[:, 1:])
    assert np.allclose(theirs.sh[:, 0], ours.sh[:, 0], atol=2e-6)
    assert np.allclose(theirs.scales, ours.scales, rtol=1e-5) and np.allclose(
        theirs.opacities, ours.opacities, atol=1e-5
    )
    assert quats_apart(theirs.quats, ours.quats) < quats


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("program", READERS)
def test_our_spz_files_stand_upright_there(program: str, degree: int, version: int, tmp_path: Path) -> None:
    """The numbers of the PLY in every version: nothing is turned on the way."""
    splats = random_splats(300, degree)
    write_spz(tmp_path / "a.spz", splats, version)
    theirs = READERS[program](tmp_path / "a.spz")
    assert np.abs(theirs.means - splats.means).max() < 2e-4
    assert_alike(theirs, io.read(tmp_path / "a.spz"), 2e-3 if version == 2 else 1e-6)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("program", READERS)
def test_their_spz_files_stand_upright_here(program: str, degree: int, version: int, tmp_path: Path) -> None:
    splats = random_splats(300, degree)
    path = tmp_path / "theirs.spz"
    write_with(program, path, splats, version)
    ours = io.read(path)
    assert ours.source is not None and (ours.source.axes, ours.source.axes_from) == ("rdf", "format")
    assert np.abs(ours.means - splats.means).max() <= 0.51 / 4096
    assert quats_apart(ours.quats, splats.quats) < 3e-3 and np.abs(ours.opacities - splats.opacities).max() < 0.003
    assert np.abs(ours.sh[:, 1:] - np.clip(splats.sh[:, 1:], -1, 1)).max(initial=0) < 0.1  # they keep 5 and 4 bits
    assert_alike(READERS[program](path), ours)
    io.write(tmp_path / "same.spz", ours)
    assert (tmp_path / "same.spz").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.sog"])
@pytest.mark.parametrize("degree", [0, 3])
def test_other_formats_in_gaussforge(name: str, degree: int, tmp_path: Path) -> None:
    io.write(tmp_path / name, random_splats(300, degree))
    theirs, ours = gaussforge_read(tmp_path / name, name.removeprefix("a.")), io.read(tmp_path / name)
    assert np.allclose(theirs.means, ours.means, atol=1e-6) and np.allclose(theirs.sh, ours.sh, atol=1e-5)
    assert np.allclose(theirs.scales, ours.scales, rtol=1e-5) and np.allclose(
        theirs.opacities, ours.opacities, atol=1e-5
    )
    assert quats_apart(theirs.quats, ours.quats) < 1e-5


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_ksplat_of_gaussforge_has_its_own_order_of_harmonics(degree: int, tmp_path: Path) -> None:
    """Channel by channel; GaussianSplats3D, three.js and splat-transform read band by band (test_ksplat.py)."""
    splats = random_splats(60, degree)
    io.write(tmp_path / "a.ply", splats)
    gaussforge_convert(tmp_path / "a.ply", "ply", tmp_path / "a.ksplat", "ksplat", 3)
    theirs = io.read(tmp_path / "a.ksplat")
    assert np.abs(theirs.sh[:, 1:] - splats.sh[:, 1:]).max(initial=0) < 1e-6
    lines = [doubt.line for doubt in doubts(theirs) if "GaussForge" in doubt.line]
    assert len(lines) == (degree > 1) and all("channel by channel" in line for line in lines)
