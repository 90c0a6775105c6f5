"""Imports point only up the list of the design; importing the package costs no torch and no numba; files stay small."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "splatpainter"
ORDER = (
    ("atomic", "user_folders", "processes", "jsonio"),
    ("splats",),
    ("transforms", "color", "image_files"),
    ("cameras",),
    ("kernels",),
    ("io",),
    ("text_tables", "contact_sheet"),
    ("rendering",),
    ("metrics",),
    ("demo_asset",),
    ("lighting",),
    ("voxels",),
    ("lift",),
    ("fit",),
    ("nn",),
    ("models",),
    ("painter", "comparison", "receipts", "proof"),
    ("aovs",),
    ("sources",),
    ("view_files",),
    ("session",),
    ("server",),
    ("data",),
    ("train",),
    ("commands",),
    ("cli", "__main__"),
)
"""Modules and subpackages of splatpainter, lowest first. Each may import what stands above it here, and itself; those
on one line may import each other. The package's own __init__ is the public face: it names everybody, and nobody in the
package imports a name from it but the version."""
LEAVES = {"data", "train"}
FRONT = {"train", "commands", "cli"}
"""Those that may import leaves: training stands on the data, and the command line on all of them."""
LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}
LONGEST = 700


def modules() -> list[Path]:
    return [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


def home(path: Path) -> str:
    """The entry of ORDER that a file belongs to."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def imported(source: str, package: tuple[str, ...]) -> set[str]:
    """Entries of ORDER (first names below splatpainter) that a source imports, anywhere in it, also by relative import
    and by import_module with a literal. package: the dotted name of the folder that the source is in."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            targets = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            base += node.module.split(".") if node.module else []
            targets = [[*base, alias.name] for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module") and node.args:
            literal = node.args[0]
            targets = [str(literal.value).split(".")] if isinstance(literal, ast.Constant) else []
        else:
            continue
        found |= {target[1] if len(target) > 1 else "" for target in targets if target[0] == "splatpainter"}
    return found


def complaint(importer: str, target: str) -> str | None:
    """Why `importer` may not import `target`, or None."""
    if target in (importer, "__version__"):
        return None
    if target not in LEVEL:
        return f"{importer} imports {target!r} from splatpainter itself: import it from the module that defines it"
    if target in LEAVES and importer not in FRONT:
        return f"{importer} imports {target}, a leaf that only the command line may import"
    if LEVEL[target] > LEVEL[importer]:
        return f"{importer} imports {target}, which stands below it"
    return None


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_up_the_list(path: Path) -> None:
    importer = home(path)
    assert importer in LEVEL, f"{importer} has no place in ORDER: give it one"
    package = ("splatpainter", *path.relative_to(PACKAGE).parts[:-1])
    targets = imported(path.read_text(encoding="utf-8"), package)
    wrong = [line for target in sorted(targets) if (line := complaint(importer, target))]
    assert not wrong, wrong


def test_the_checker_sees_every_kind_of_import() -> None:
    source = """
import os, splatpainter.io.ply as ply
from splatpainter import render, Splats
from splatpainter.lift.colors import lift
from . import sog
from ..painter import apply
def later():
    from splatpainter.models import lrm
    import importlib
    return importlib.import_module("splatpainter.train.loop")
"""
    expected = {"io", "render", "Splats", "lift", "painter", "models", "train"}
    assert imported(source, ("splatpainter", "io")) == expected
    assert imported("import splatpainter\nimport numpy.random", ("splatpainter",)) == {""}


def test_the_checker_refuses_what_the_design_forbids() -> None:
    refused = [
        ("io", "rendering"),
        ("voxels", "lift"),
        ("lift", "painter"),
        ("painter", "train"),
        ("data", "train"),
        ("session", "data"),
    ]
    allowed = [
        ("lift", "voxels"),
        ("painter", "receipts"),
        ("cli", "data"),
        ("io", "io"),
        ("train", "models"),
        ("train", "data"),
    ]
    assert all(complaint(*pair) for pair in [*refused, ("lift", ""), ("lift", "Splats")])
    assert not any(complaint(*pair) for pair in allowed)


@pytest.mark.parametrize("name", ["splatpainter", "splatpainter.cli"])
def test_importing_the_package_or_the_command_line_loads_neither_torch_nor_numba(name: str) -> None:
    if name.endswith(".cli") and not ((PACKAGE / "cli.py").exists() or (PACKAGE / "cli").is_dir()):
        pytest.skip("no command line yet")
    command = f"import sys, {name}; print([m for m in ('torch', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_file_is_longer_than_a_reader_can_hold() -> None:
    files = [*PACKAGE.rglob("*.py"), *Path(__file__).parent.rglob("*.py")]
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}
