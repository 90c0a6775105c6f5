"""Names that a stranger would guess: none of the private language of the first version, one class for one name."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (ROOT / "src" / "splatpainter", ROOT / "benchmarks" / "splatbench")
VAGUE = {"told", "own", "found", "wanted", "known", "mine", "place", "places", "shown", "asked", "said", "taught"}
"""Say nothing of what a value is: nouns do (result, target, expected, position, visible, ...)."""
EXCEPTIONS = {("session.py", "shown"), ("predictor.py", "own")}
"""An old public name that still answers, and a name of parameters in stored weights."""
SHARED = {"Config"}
"""Classes of one name by design: each command's options."""


def assigned(tree: ast.AST) -> set[str]:
    """Names of variables, parameters, attributes, functions and classes that a module makes."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.id if isinstance(node, ast.Name) else node.attr)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
    return names


def trees() -> dict[Path, ast.Module]:
    return {p: ast.parse(p.read_text(encoding="utf-8")) for folder in FOLDERS for p in sorted(folder.rglob("*.py"))}


def test_no_name_is_vague() -> None:
    vague = {
        f"{path.relative_to(ROOT)}: {name}"
        for path, tree in trees().items()
        for name in assigned(tree)
        if name.strip("_").lower() in VAGUE and (path.name, name) not in EXCEPTIONS
    }
    assert not vague


def test_a_class_has_its_name_for_itself() -> None:
    for folder in FOLDERS:
        homes = defaultdict(list)
        for path, tree in trees().items():
            if path.is_relative_to(folder):
                for node in tree.body:
                    if isinstance(node, ast.ClassDef) and not node.name.startswith("_") and node.name not in SHARED:
                        homes[node.name].append(str(path.relative_to(ROOT)))
        assert not {name: paths for name, paths in homes.items() if len(paths) > 1}


def test_the_search_sees_every_kind_of_name() -> None:
    source = "class A:\n  def b(self, c):\n    self.d = e = [f for f in c]\n"
    assert assigned(ast.parse(source)) == {"A", "b", "self", "c", "d", "e", "f"}
