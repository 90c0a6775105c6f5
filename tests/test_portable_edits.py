"""The same edit gives the same bytes on every machine: what makes edits asks no BLAS and no LAPACK, none of numpy's
functions that depend on the CPU, and no unstable order of equal values (`kernels.portable` has what to use instead)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "splatpainter"
FOLDERS = ("lift", "lights", "spread", "surface", "voxels", "rendering/cpu", "kernels")
FILES = (
    *("splats.py", "cameras.py", "transforms.py", "color.py", "lighting.py", "painter.py"),
    *("models/apply_edit.py", "models/stored_predictor.py", "models/gaussian_facts.py"),
)
FUNCTIONS = {
    *("dot", "vdot", "inner", "matmul", "tensordot", "einsum", "interp", "correlate", "convolve", "polyfit", "cov"),
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "power", "float_power", "cbrt", "hypot"),
    *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "arctan2", "sinh", "cosh", "tanh"),
}
MATH = {"exp", "log", "log2", "log10", "pow", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "hypot"}
EXCEPTIONS = {
    "cameras.py: @": "tensors alone",
    "cameras.py: np.linalg.inv": "the path tracer of training data alone",
}


def dependent(tree: ast.AST) -> list[str]:
    """What a file uses whose bits depend on the machine."""
    seen = []
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            seen.append("@")
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


def paths() -> list[Path]:
    inside = [path for folder in FOLDERS for path in sorted((PACKAGE / folder).rglob("*.py"))]
    return inside + [PACKAGE / name for name in FILES]


@pytest.mark.parametrize("path", paths(), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_no_bits_depend_on_the_machine(path: Path):
    name = path.relative_to(PACKAGE).as_posix()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert [what for what in dependent(tree) if f"{name}: {what}" not in EXCEPTIONS] == []


def test_what_depends_on_the_machine_is_seen():
    text = (
        "np.exp(x)\na @ b\nnp.linalg.norm(x)\nnp.linalg.norm(x, axis=1)\nnp.argsort(x)\nnp.argsort(x, kind='stable')\n"
    )
    assert sorted(dependent(ast.parse(text))) == ["@", "np.argsort", "np.exp", "np.linalg.norm"]
