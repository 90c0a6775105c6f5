"""The native library: what kernels refuse, what a stale or missing library says, and constants that both sides have."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpainter import splats
from splatpainter.kernels import library
from splatpainter.kernels.arrays import aligned, readonly
from splatpainter.kernels.library import Kernels, hash_of_sources, kernels
from splatpainter.kernels.parallel import run
from splatpainter.rendering import profiles
from splatpainter.rendering.cpu import geometry

ROOT = Path(library.__file__).resolve().parents[3]
OFFSETS, OUT = np.array([0, 1]), np.zeros((1, 6), np.float32)
SUMS = np.ones((1, 8), np.float32)
READ_ONLY = readonly(OUT, np.float32)


def not_aligned() -> np.ndarray:
    return np.zeros(33, np.uint8)[1:].view(np.float32).reshape(1, 8)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((OFFSETS, SUMS, READ_ONLY), ("argument 2", "a writable C-contiguous float32", "read-only")),
        ((OFFSETS, SUMS.astype(np.float64), OUT), ("argument 2", "float64", "got float32")),
        ((OFFSETS.astype(np.int32), SUMS, OUT), ("argument 0", "int64", "got int32 [2]")),
        ((OFFSETS, SUMS[:, :7].copy(), OUT), ("argument 1", "[?, 8]", "got float32 [1, 7]")),
        ((OFFSETS, np.ones((1, 16), np.float32)[:, ::2], OUT), ("argument 1", "not contiguous")),
        ((OFFSETS, not_aligned(), OUT), ("argument 1", "C-contiguous")),
        ((OFFSETS, SUMS[0], OUT), ("argument 1", "got float32 [8]")),
        ((OFFSETS, SUMS.astype(np.float16), OUT), ("argument 1", "float32 or float64", "float16")),
        ((OFFSETS, [[1.0] * 8], OUT), ("argument 1", "float32 or float64", "None")),
        (([0, 1], SUMS, OUT), ("argument 0", "got list [0, 1]")),
        ((OFFSETS, SUMS), ("expected 3 arguments, got 2",)),
    ],
)
def test_arrays_of_another_kind_are_refused_in_one_line(arguments: tuple, words: tuple[str, ...]):
    with pytest.raises(TypeError, match="^reduce_pairs: ") as error:
        run(kernels.reduce_pairs, *arguments)
    assert all(word in str(error.value) for word in words) and "\n" not in str(error.value), str(error.value)


@pytest.mark.parametrize("number", [1.5, "2", None, np.zeros(2)])
def test_numbers_of_another_kind_are_refused(number: object):
    m = np.zeros(1)
    with pytest.raises(TypeError, match="probe_spans: expected numbers: argument 2: a number .int64., got"):
        kernels.probe_spans(m, m, number, 7, np.zeros((1, 5), np.int64), 0, 1)


def test_none_is_an_array_without_entries_and_numpy_numbers_are_numbers():
    kernels.reduce_pairs(None, SUMS, OUT[:0], 0, 1)
    out = np.zeros((1, 5), np.int64)
    kernels.probe_spans(np.full(1, 20.0), np.full(1, 3.0), np.int32(0), np.uint8(7), out, np.int64(0), 1)
    assert out[0, :3].tolist() == [7, 1, 2]


def test_unknown_kernels_and_kinds_of_cpu_are_named(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(AttributeError, match="no kernel 'project' in native/"):
        _ = kernels.project
    with pytest.raises(ValueError, match="SPLATPAINTER_CPU: expected one of .*base, got 'v9'"), library.using("v9"):
        pass
    assert library.current().cpus[-1] == "base" and "rasterize_tiles" in dir(library.current())


def test_a_library_that_is_missing_or_broken_says_what_to_run(tmp_path: Path):
    with pytest.raises(OSError, match=r"kernels are missing; in a checkout, run `make native`"):
        Kernels(tmp_path / "nothing.so")
    (tmp_path / "broken.so").write_bytes(b"no library")
    with pytest.raises(OSError, match=r"cannot be loaded .* run `make native`") as error:
        Kernels(tmp_path / "broken.so")
    assert "\n" not in str(error.value)


@pytest.mark.skipif(not (ROOT / "native").is_dir(), reason="no checkout: native/ is absent")
def test_a_library_older_than_its_sources_says_what_to_run(tmp_path: Path):
    """A copy of the package, as in a checkout, whose sources were edited afterwards."""
    package = tmp_path / "src" / "splatpainter"
    shutil.copytree(ROOT / "native", tmp_path / "native", ignore=shutil.ignore_patterns("__pycache__"))
    (package / "kernels").mkdir(parents=True)
    shutil.copy(ROOT / "src" / "splatpainter" / "kernels" / library.LIBRARY, package / "kernels")
    shutil.copy(library.__file__, package / "kernels" / "library.py")
    for folder in (package, package / "kernels"):
        (folder / "__init__.py").touch()
    script = "from splatpainter.kernels.library import current; print(current().cpu)"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "src")}
    environment.pop(library.LIBRARY_VARIABLE, None)

    def result() -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)

    assert result().stdout.strip() in library.current().cpus, result().stderr
    with open(tmp_path / "native" / "rows.cpp", "a") as file:
        file.write("// edited\n")
    stale = result()
    last = stale.stderr.strip().splitlines()[-1]
    assert stale.returncode and "are older than" in last and "make native" in last, stale.stderr
    shutil.rmtree(tmp_path / "native")  # an installed package has no sources: nothing to compare
    assert not result().returncode


@pytest.mark.skipif(not (ROOT / "native").is_dir(), reason="no checkout: native/ is absent")
def test_the_build_and_the_loader_agree_on_the_hash():
    build = runpy.run_path(str(ROOT / "native" / "build.py"))
    assert build["hash_of_sources"]() == hash_of_sources(ROOT / "native")


def test_the_version_is_that_of_the_loaded_core(monkeypatch: pytest.MonkeyPatch):
    """Asked once an edit: the sources of a checkout are not read for it again."""
    assert library.current().version
    monkeypatch.setattr(library, "hash_of_sources", lambda folder: pytest.fail("read again"))
    assert library.version() == library.current().version
    if (ROOT / "native").is_dir():
        assert hash_of_sources(ROOT / "native").startswith(library.version())


def test_constants_of_kernels_are_those_of_python():
    expected = [
        profiles.MIN_ALPHA,
        profiles.MAX_ALPHA,
        profiles.MIN_TRANSMITTANCE,
        profiles.PLAYCANVAS_MAX_ALPHA,
        profiles.PLAYCANVAS_FALLOFF,
        profiles.NEAR_PLANE,
        profiles.EPS2D,
        profiles.MAX_DISTANCE_PX,
        splats.MAX_MAGNITUDE,
        splats.MIN_QUAT,
        geometry.TILE,
        geometry.COLUMNS,
        len(range(geometry.EYE_Z + 1)),
        geometry.GAUSSIANS_PER_BLOCK,
    ]
    out = np.empty(len(expected))
    kernels.probe_constants(out, 0, 1)
    np.testing.assert_allclose(out, expected, rtol=1e-15)


def test_arrays_are_aligned_and_inputs_read_only():
    for dtype in (np.float32, np.float64):
        assert aligned((3, 5), np.dtype(dtype)).ctypes.data % 64 == 0
    source = np.asfortranarray(np.ones((3, 4)))
    view = readonly(source, np.float32)
    assert view.flags.c_contiguous and not view.flags.writeable and source.flags.writeable
