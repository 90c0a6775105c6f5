"""The same edit gives the same bytes on every machine: what makes edits asks no BLAS and no LAPACK, none of numpy's
functions that depend on the CPU, and no unstable order of equal values (`kernels.portable` has what to use instead)."""

from __future__ import annotations

import ast
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpainter.io.formats import sog_container
from splatpainter.kernels import portable

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "splatpainter"
FOLDERS = (
    *("lift", "lights", "spread", "surface", "voxels", "rendering/cpu", "kernels"),
    *("grading", "holes", "io/formats", "operations", "session/document", "session/kinds", "session/replay"),
    *("session/selection", "session/measures", "session/commands", "gatekeeper"),
    *("captures", "decals", "pictures", "scene", "source_edits", "painting", "video", "server/strokes"),
)
FILES = (
    *("splats.py", "cameras.py", "transforms.py", "color.py", "lighting.py", "painter.py"),
    *("io/axes.py", "models/apply_edit.py", "models/stored_predictor.py", "models/gaussian_facts.py"),
    *("view_files.py", "commands/demo.py", "commands/parts/demo_paint.py", "server/commands/relief.py"),
)
FUNCTIONS = {
    *("dot", "vdot", "inner", "matmul", "tensordot", "einsum", "interp", "correlate", "convolve", "polyfit"),
    *("cov", "average"),
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "power", "float_power", "cbrt", "hypot"),
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "sinh", "cosh", "tanh"),
}
MATH = {"exp", "log", "log2", "log10", "pow", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "hypot"}
EXCEPTIONS = {
    "io/formats/codebooks.py: @": "which entry of a lossy palette is nearest: a BLAS takes a tenth of the time",
    "color.py: **": "tensors alone",
    "grading/cube_lut.py: **": "whole numbers",
    "io/axes.py: **": "of 1 and -1",
    "io/formats/sog.py: math.log": "tolerances",
    "voxels/raycast.py: **": "whole numbers",
    "gatekeeper/color_drift.py: math.log2": "receipts",
    "gatekeeper/color_drift.py: np.log2": "receipts, and limits of what is refused",
    "cameras.py: @": "tensors alone",
    "cameras.py: np.linalg.inv": "the path tracer of training data alone",
}


def dependent(tree: ast.AST) -> list[str]:
    """What a file uses whose bits depend on the machine."""
    seen = []
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            seen.append("@")
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and not is_exact(node):
            seen.append("**")
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        owner, name = ast.unparse(node.func.value), node.func.attr
        keywords = {keyword.arg for keyword in node.keywords}
        if owner == "np" and name in FUNCTIONS or owner == "math" and name in MATH:
            seen.append(f"{owner}.{name}")
        elif owner == "np.linalg" and not (name == "norm" and "axis" in keywords):
            seen.append(f"{owner}.{name}")
        elif owner == "np" and name in ("argsort", "argpartition") and "kind" not in keywords:
            seen.append(f"np.{name}")
    return seen


def is_exact(power: ast.BinOp) -> bool:
    """Powers of a written number, squares, integer powers of a name: of arrays numpy has only squares of its own."""
    match power.left, power.right:
        case (ast.Constant(), _) | (_, ast.Constant(value=2)) | (ast.Name(), ast.Constant(value=int())):
            return True
    return False


def paths() -> list[Path]:
    inside = [path for folder in FOLDERS for path in sorted((PACKAGE / folder).rglob("*.py"))]
    return inside + [PACKAGE / name for name in FILES]


@pytest.mark.parametrize("path", paths(), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_bits_depend_on_the_machine(path: Path):
    name = path.relative_to(PACKAGE).as_posix()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert [what for what in dependent(tree) if f"{name}: {what}" not in EXCEPTIONS] == []


def test_what_depends_on_the_machine_is_seen():
    dependent_lines = ["x**0.4", "x[i] ** 3", "np.exp(x)", "a @ b", "np.linalg.norm(x)", "np.argsort(x)"]
    exact = ["x**2", "2**x", "np.linalg.norm(x, axis=1)", "np.argsort(x, kind='stable')"]
    assert dependent(ast.parse("\n".join(exact))) == []
    seen = [dependent(ast.parse(line)) for line in dependent_lines]
    assert seen == [["**"], ["**"], ["np.exp"], ["@"], ["np.linalg.norm"], ["np.argsort"]]


def test_files_fills_and_matches_have_the_same_bytes_with_another_numpy_and_blas():
    """As on a machine whose CPU has nothing beyond what numpy was built for, and as on one with a single thread."""
    beyond = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])  # pyright: ignore[reportOptionalSubscript]
    older = {"NPY_DISABLE_CPU_FEATURES": " ".join(beyond), "OPENBLAS_CORETYPE": "Nehalem", "OMP_NUM_THREADS": "1"}
    single = {"SPLATPAINTER_CPU": "base", "SPLATPAINTER_THREADS": "1", "OPENBLAS_CORETYPE": "Haswell"}
    command = [sys.executable, "-m", "tests.support.portable_bytes"]

    def hashes(changed: dict[str, str]) -> str:
        root = PACKAGE.parents[1]
        environment = os.environ | changed
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    here = hashes({})
    assert len(here.splitlines()) == 12
    assert hashes(older) == here
    assert hashes(single) == here


@pytest.mark.parametrize(
    ("size", "single", "double"),
    [
        (7, "06ce8040", "172682b3c0191040"),
        (8192, "3aaaaa45", "32d1fd304755b540"),
        (8193, "f6b1aa45", "a19b2aa83e56b540"),
        (88_680, "0cef6647", "0cb5797be1ddec40"),
        (300_001, "fe4f4348", "2f0289baff690841"),
    ],
)
def test_long_sums_are_those_of_newer_numpy(size: int, single: str, double: str) -> None:
    """Sums of numpy 2.4.6. Before 2.3 it added up long arrays in pieces: one Gaussian in twenty of the demo's evening
    had another last bit."""
    numbers = np.sqrt(np.arange(size) * 0.6180339887498949 % 1)
    small = numbers.astype(np.float32)
    assert portable.total(numbers).tobytes().hex() == double
    assert portable.total(small).tobytes().hex() == single
    assert portable.total(small.reshape(1, -1, 1)).tobytes().hex() == single
    # What is cast is added up in double precision, not cast from a sum.
    assert portable.total(small, np.float64) == pytest.approx(math.fsum(small.tolist()), rel=1e-13)
    assert portable.mean(small) == np.float32(portable.total(small) / np.float32(size))


def test_a_sog_has_the_same_bytes_on_windows(monkeypatch: pytest.MonkeyPatch):
    here = sog_container._bundle({"meta.json": b"{}", "means_l.webp": b"RIFF"}, "")
    monkeypatch.setattr(sys, "platform", "win32")  # which zipfile asks
    assert sog_container._bundle({"meta.json": b"{}", "means_l.webp": b"RIFF"}, "") == here
