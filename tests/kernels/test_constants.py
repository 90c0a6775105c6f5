"""Constants that Python explains and kernels compute with are the same. A header names its module before its code."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

NATIVE = Path(__file__).resolve().parents[2] / "native"
DECLARATION = re.compile(r"^constexpr \w+ ([^;]+);", re.M)
VALUE = re.compile(r"(\w+) = (-?[0-9.]+(?:e-?[0-9]+)?)f?(?: (<<|/) ([0-9.]+))?(?=,|$)")
"""A number, a shifted one or a quotient; what is computed from other constants is left out."""
MODULE = re.compile(r"splatpainter/[\w/]+(?=\.py)")


def constants(text: str) -> dict[str, float]:
    """Those of a header."""
    out: dict[str, float] = {}
    for declaration in DECLARATION.findall(text):
        for name, first, sign, second in VALUE.findall(declaration):
            out[name] = int(first) << int(second) if sign == "<<" else float(first) / float(second or 1)
    return out


def pairs() -> dict[str, tuple[float, float]]:
    """ "module: NAME" -> its value in the header and in Python."""
    out = {}
    for header in sorted(NATIVE.rglob("*.h")):
        text = header.read_text(encoding="utf-8")
        for path in MODULE.findall(text.split("#pragma once")[0]):
            module = importlib.import_module(path.replace("/", "."))
            for name, value in constants(text).items():
                if isinstance(getattr(module, name, None), (int, float)):
                    out[f"{module.__name__}: {name}"] = value, getattr(module, name)
    return out


PAIRS = pairs()


@pytest.mark.parametrize("name", PAIRS)
def test_a_constant_is_the_same_in_python_and_in_its_kernel(name: str):
    native, python = PAIRS[name]
    assert native == pytest.approx(python, rel=1e-6)


def test_constants_are_read():
    text = "constexpr double A = 0.3, B = 1.0 / 4, C = 2 * A;\nconstexpr float D = 2e-2f;\n"
    text += "constexpr i64 E = 1 << 20, F = E;"
    assert constants(text) == {"A": 0.3, "B": 0.25, "D": 0.02, "E": 1 << 20}
    assert len(PAIRS) > 10


def test_lines_of_kernels_fit_as_pythons_do():
    files = [path for path in NATIVE.rglob("*") if path.suffix in (".h", ".cpp")]
    lines = [(f"{f.name}:{k}", line) for f in files for k, line in enumerate(f.read_text("utf-8").split("\n"), 1)]
    long = [where for where, line in lines if len(line) > 120]
    assert len(files) > 20 and not long
