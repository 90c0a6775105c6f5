"""One name for one thing: one class and one module for each name; and scripts/words.py, which holds the words of
docs/guide/glossary.md."""

from __future__ import annotations

import ast
import re
import runpy
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (ROOT / "src" / "splatpainter", ROOT / "benchmarks" / "splatbench", ROOT / "train" / "splattrain")
TESTS = (ROOT / "tests", ROOT / "benchmarks" / "tests", ROOT / "train" / "tests")
SHARED = {"Config"}
"""Classes of one name by design: each command's options."""
NAMESAKES = {
    FOLDERS[0] / "operations",
    FOLDERS[0] / "commands",
    FOLDERS[0] / "server" / "commands",
    FOLDERS[2] / "commands",
    FOLDERS[2] / "stages",
    FOLDERS[1],
    FOLDERS[1] / "methods",
}
"""Folders whose modules may have the name of what they run: an operation, a command, a page's commands, a stage of
training, a benchmark, a row of its tables."""
SHARED_MODULES = {"__init__", "warm", "options", "page", "schema", "fill"}
"""Modules of one name by design: a folder's face, the kernels that it has compiled, the settings of its room, one HTML
page, the one definition of a format; source_edits/fill.py colours what holes/fill.py fills."""


@cache
def sources() -> dict[Path, str]:
    """The text of each file of FOLDERS and TESTS; read once for all tests."""
    paths = (path for folder in (*FOLDERS, *TESTS) for path in sorted(folder.rglob("*.py")))
    return {path: path.read_text(encoding="utf-8") for path in paths}


def public_classes(source: str) -> set[str]:
    """Of the module itself, not within functions or other classes."""
    return {node.name for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name[0] != "_"}


def product() -> dict[Path, str]:
    """The sources of FOLDERS together."""
    return {path: source for path, source in sources().items() if any(map(path.is_relative_to, FOLDERS))}


def test_a_class_has_its_name_for_itself() -> None:
    homes = defaultdict(list)
    for path, source in product().items():
        for name in set(re.findall(r"^class (\w+)", source, re.MULTILINE)) - SHARED:
            homes[name].append(path)
    assert len(homes) > 20
    for name, paths in homes.items():
        if len(paths) > 1:
            paths = [path for path in paths if name in public_classes(sources()[path])]
        assert len(paths) <= 1, (name, paths)


def test_a_module_has_its_name_for_itself() -> None:
    homes = defaultdict(list)
    for path in product():
        if path.parent not in NAMESAKES and path.stem not in SHARED_MODULES:
            homes[path.stem].append(str(path.relative_to(ROOT)))
    assert len(homes) > 100
    assert not [paths for paths in homes.values() if len(paths) > 1]


WORDS = runpy.run_path(str(ROOT / "scripts" / "words.py"))


def test_names_are_the_words_of_the_glossary(capsys: pytest.CaptureFixture[str]) -> None:
    assert WORDS["main"]([]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "names"),
    [
        (
            "class A:\n  def b(self, known):\n    self.kept = told = [own for own in f]\n",
            {"known", "kept", "told", "own"},
        ),
        ("class Own: ...\ndef place(): ...\nplace_pairs = in_place = 1\n", {"Own", "place"}),
        ("MARGIN = 1\nMARGIN_PX, RIM = 2, 3\ndef f():\n  MARGIN = 4\n", {"MARGIN", "RIM"}),
        ("rows = 1\n", {"rows"}),
        ("rows, columns = 1, 2\n", set()),
        ("# own = 1\n'known = 2'\nprint(wanted.told)\n", set()),
    ],
)
def test_a_name_against_the_words_is_seen(source: str, names: set[str]) -> None:
    offences = WORDS["offences"](source, "src/splatpainter/lift/example.py")
    assert {offence.name for offence in offences} == names
    assert all(offence.rule.why and offence.rule.instead for offence in offences)


@pytest.mark.parametrize(
    ("source", "lines"),
    [
        ('A = 1\n"""Pixels, ..."""\nB = 2\n"""... and rows."""\n', [2, 4]),
        ('def f():\n    """... and more.\n    """\n', [2]),
        ('"""Whole. [..., 3] colours, a, b ... c."""\ns = """... a value ..."""\n', []),
    ],
)
def test_a_docstring_is_a_whole_sentence(source: str, lines: list[int]) -> None:
    assert WORDS["half_sentences"](source) == lines
