"""Imports point one way: no circles at all (also not lazy or type-checking ones), packages in the order of the
design, and start-up loads nothing heavy."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.support.syntax import nodes, statements

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "splatpainter": ROOT / "src" / "splatpainter",
    "splattrain": ROOT / "train" / "splattrain",
    "splatbench": ROOT / "benchmarks" / "splatbench",
}
DISTRIBUTIONS = {"splatpainter": 0, "splattrain": 1, "splatbench": 2}
"""Of each package how far up it stands: it imports itself and what is below."""
ORDER = (
    ("_version", "extras", "system"),
    ("array_types", "order_statistics"),
    ("splats", "transforms", "color", "kernels"),
    ("cameras",),
    ("image_files",),
    ("io",),
    ("captures",),
    ("text_tables", "contact_sheet", "doubts", "output_paths"),
    ("rendering",),
    ("metrics",),
    ("demo_asset",),
    ("lighting",),
    ("voxels",),
    ("surface",),
    ("fit",),
    ("lift",),
    ("holes",),
    ("spread",),
    ("nn",),
    ("models",),
    ("comparison", "receipts"),
    ("painting",),
    ("painter",),
    ("pictures",),
    ("sources",),
    ("gatekeeper",),
    ("grading",),
    ("decals",),
    ("lights",),
    ("scene",),
    ("view_files",),
    ("video",),
    ("source_edits",),
    ("operations",),
    ("session",),
    ("editing",),
    ("batch",),
    ("server",),
    ("commands",),
    ("cli", "__main__"),
)
"""Modules and subpackages of splatpainter, lowest first. Each may import what stands above it here, and itself; those
on one line may import each other. The package's own __init__ is the public face: it names everybody."""
LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}
MAX_LINES = 700
"""Of a file."""
HEAVY = ("torch", "PIL", "tyro", "scipy", "safetensors", "fastapi")
"""What `import splatpainter` and `splatpainter --help` must not load."""


def name_of(path: Path) -> str:
    """Dotted name of a module's file."""
    for package, folder in PACKAGES.items():
        if path.is_relative_to(folder):
            parts = (package, *path.relative_to(folder).with_suffix("").parts)
            return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    raise ValueError(path)


@cache
def modules() -> dict[str, Path]:
    return {name_of(path): path for folder in PACKAGES.values() for path in sorted(folder.rglob("*.py"))}


def name_called(call: ast.Call) -> str:
    """The last part of what is called; "" for what has no name. Far cheaper than ast.unparse."""
    return str(getattr(call.func, "attr", getattr(call.func, "id", "")))


def imports(source: str, package: str) -> Iterator[str]:
    """Dotted names that a source imports anywhere in it: modules, names in them, literals of import_module. package:
    that which relative imports start from."""
    for node in nodes(source) if "import_module" in source else statements(source):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base += node.module.split(".") if node.module else []
            yield from (".".join([*base, alias.name]) for alias in node.names)
        elif isinstance(node, ast.Call) and name_called(node).endswith("import_module") and node.args:
            if isinstance(literal := node.args[0], ast.Constant):
                yield str(literal.value)


@cache
def targets() -> dict[str, tuple[str, ...]]:
    """Module -> what it imports, as written (see `imports`); parsed once for all tests."""
    out = {}
    for name, path in modules().items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        out[name] = tuple(imports(path.read_text(encoding="utf-8"), package))
    return out


def graph() -> dict[str, set[str]]:
    """Module -> modules that it imports, lazily or not. `from package import name` is the package where that is no
    module of it."""
    edges: dict[str, set[str]] = {}
    for name in modules():
        edges[name] = set()
        for target in targets()[name]:
            while target and target not in modules():
                target = target.rpartition(".")[0]
            if target and target != name:
                edges[name].add(target)
    return edges


def test_there_are_no_circles() -> None:
    try:
        TopologicalSorter(graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_the_search_for_circles_finds_one() -> None:
    lazy = "def later():\n    from a import b\n"
    assert list(imports(lazy, "c")) == ["a.b"]
    nested = "class A:\n  try:\n    pass\n  except OSError:\n    with b:\n      match c:\n        case 1: import d\n"
    assert list(imports(nested + "  else:\n    import e\n  finally:\n    import f\n", "c")) == ["e", "f", "d"]
    with pytest.raises(CycleError):
        TopologicalSorter({"a": {"b"}, "b": {"a"}}).prepare()


def complaint(importer: str, target: str) -> str | None:
    """Why one entry of ORDER may not import another, or None."""
    if target == importer:
        return None
    if target not in LEVEL:
        return f"{importer} imports {target!r} from splatpainter itself: import it from the module that defines it"
    if LEVEL[target] > LEVEL[importer]:
        return f"{importer} imports {target}, which stands below it"
    return None


def test_imports_point_up_the_list() -> None:
    wrong = []
    for name in modules():
        if name == "splatpainter" or not name.startswith("splatpainter."):
            continue
        importer = name.split(".")[1]
        assert importer in LEVEL, f"{importer} has no line in ORDER: give it one"
        for target in targets()[name]:
            parts = target.split(".")
            if parts[0] == "splatpainter":
                wrong.append(complaint(importer, parts[1] if len(parts) > 1 else ""))
    assert not [line for line in wrong if line], sorted({line for line in wrong if line})


def test_distributions_import_only_what_they_require() -> None:
    """The core knows neither training nor benchmarks, training no benchmarks."""
    wrong = [
        f"{name} imports {target}"
        for name in modules()
        for target in targets()[name]
        if DISTRIBUTIONS.get(target.split(".")[0], 0) > DISTRIBUTIONS[name.split(".")[0]]
    ]
    assert not wrong


def test_the_order_refuses_what_the_design_forbids() -> None:
    refused = [("io", "rendering"), ("voxels", "lift"), ("lift", "painter"), ("models", "session")]
    allowed = [("lift", "voxels"), ("painter", "receipts"), ("io", "io"), ("commands", "models")]
    assert all(complaint(*pair) for pair in [*refused, ("lift", ""), ("lift", "Splats")])
    assert not any(complaint(*pair) for pair in allowed)


@pytest.mark.parametrize("words", ["import splatpainter", "from splatpainter.cli import main; main(['--help'])"])
def test_start_up_loads_nothing_heavy(words: str) -> None:
    """Counted in modules: seconds would depend on the machine."""
    program = f"import sys; {words}; print('\\n' + '\\n'.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert not [name for name in HEAVY if name in loaded]
    assert len(loaded) < 600


STROKE = """
import sys
import numpy as np
import splatpainter.server.hub
from splatpainter.cameras import look_at
from splatpainter.painter import Edit
from splatpainter.server.strokes.stroke import Stroke
from splatpainter.session import Session
from tests.support.surface_shapes import sphere

session, camera = Session(sphere(2000, 0.6)), look_at((0, 0, 3), (0, 0, 0), width=64, height=64)
stroke = Stroke(camera, session=session)
stroke.prepare(session.splats, session.original, 1)
session.surface.prepare(camera)
stroke.patch(26, 26, 10, 10, np.full((10, 10, 4), 200, np.uint8).tobytes())
stroke.preview(session.splats, session.original, 1, (26, 26, 36, 36))
before = set(sys.modules)
session.layers.add("paint", [Edit(stroke.picture(session.splats, session.original, 1), camera, stroke.mask)])
print(*(set(sys.modules) - before))
"""


def test_the_first_stroke_waits_for_no_module() -> None:
    """What it needs was imported when it began."""
    done = subprocess.run([sys.executable, "-c", STROKE], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == []


def test_no_file_is_longer_than_a_reader_can_hold() -> None:
    files = [*modules().values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks" / "tests").rglob("*.py")]
    files += (ROOT / "train" / "tests").rglob("*.py")
    lengths = {str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert {name: length for name, length in lengths.items() if length > MAX_LINES} == {}
