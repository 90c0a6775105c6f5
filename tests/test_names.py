"""Names that a stranger would guess: no word that says nothing, a Gaussian is no row, one class and one module for one
name, constants that say what they limit."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Callable
from functools import cache
from pathlib import Path

from tests.support.syntax import identifiers, nodes

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = (ROOT / "src" / "splatpainter", ROOT / "benchmarks" / "splatbench", ROOT / "train" / "splattrain")
TESTS = (ROOT / "tests", ROOT / "benchmarks" / "tests", ROOT / "train" / "tests")
VAGUE = {
    "told",
    "own",
    "found",
    "wanted",
    "known",
    "mine",
    "shown",
    "asked",
    "said",
    "taught",
    "whole",
    "kept",
    "others",
    "wish",
    "sound",
    "homeless",
    "lap",
    "laps",
    "got",
}
"""Say nothing of what a value is: nouns do (result, target, expected, position, visible, ...). Not alone, and not as a
word of a longer name."""
VAGUE_ALONE = {"place", "places"}
"""Not alone; in a longer name it is a verb (`place_pairs`) or says that nothing is copied (`in_place`)."""
EXCEPTIONS = {("predictor.py", "own"), ("protocol.py", "kept"), ("edits.py", "_shown_again")}
"""A name of parameters in stored weights, a key of messages, and a function."""
WITHOUT_ROWS = ("models", "fit", "rendering")
"""Rooms that work on Gaussians. A row is a row of a file, of a table or of a picture, never a Gaussian."""
ROW_EXCEPTIONS = {
    ("config.py", "row_tokens"),
    ("refine.py", "rows"),
    ("refine.py", "norm_rows"),
    ("refine.py", "norm_rows_mlp"),
    ("refine.py", "mlp_rows"),
    ("image_loss.py", "rows"),
}
"""A key of recipes and of weights, four names of parameters in stored weights, and rows of pixels."""
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
BARE = """
ahead alike ball behind better bins block blur bounce candidates cell cells checkpoint chunk company confidence conflict
count edge extent facing faint fine grid haste heal inputs inside jumps largest lean least level lights like main margin
memory most mostly older outside overlap patch patience power quantile rays reach rim rings rounds shares sides size
slack smallest soft solid spot spread step stiffness sweeps taps thickness tolerance tries upright views voxels wide
width
"""
"""Words that are no constant's name by themselves: they do not say of what, nor in which unit."""
CONSTANTS = re.compile(r"^([A-Z]\w*(?:, [A-Z]\w*)*)(?:: [^=\n]+)? = ", re.MULTILINE)


def assigned(tree: list[ast.AST]) -> set[str]:
    """Names of variables, parameters, attributes, functions and classes that a module's nodes make."""
    names = set()
    for node in tree:
        if isinstance(node, ast.Name | ast.Attribute):
            if isinstance(node.ctx, ast.Store):
                names.add(node.id if isinstance(node, ast.Name) else node.attr)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
    return names


@cache
def sources() -> dict[Path, str]:
    """The text of each file of FOLDERS and TESTS; read once for all tests."""
    paths = (path for folder in (*FOLDERS, *TESTS) for path in sorted(folder.rglob("*.py")))
    return {path: path.read_text(encoding="utf-8") for path in paths}


def suspects(source: str, suspicious: Callable[[str], bool]) -> set[str]:
    """Suspicious names that a source makes. It is parsed only where such a word is in its code at all."""
    candidates = {name for name in identifiers(source) if suspicious(name)}
    return candidates & assigned(nodes(source)) if candidates else set()


def public_classes(source: str) -> set[str]:
    """Of the module itself, not within functions or other classes."""
    return {node.name for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name[0] != "_"}


@cache
def words(name: str) -> set[str]:
    """The words of snake_case and CamelCase, lower case."""
    return set(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().strip("_").split("_"))


def is_vague(name: str) -> bool:
    """The names of tests are sentences."""
    vague = bool(words(name) & VAGUE) or name.strip("_").lower() in VAGUE_ALONE
    return vague and not name.startswith("test_")


def is_row(name: str) -> bool:
    return bool(words(name) & {"row", "rows"})


def test_no_name_is_vague() -> None:
    vague = {
        f"{path.relative_to(ROOT)}: {name}"
        for path, source in sources().items()
        for name in suspects(source, is_vague)
        if (path.name, name) not in EXCEPTIONS
    }
    assert not vague


def test_a_gaussian_is_no_row() -> None:
    rows = {
        f"{path.relative_to(ROOT)}: {name}"
        for path, source in sources().items()
        if path.is_relative_to(FOLDERS[0]) and path.relative_to(FOLDERS[0]).parts[0] in WITHOUT_ROWS
        for name in suspects(source, is_row)
        if (path.name, name) not in ROW_EXCEPTIONS
    }
    assert not rows


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


def test_a_constant_says_what_it_limits() -> None:
    bare = {
        f"{path.relative_to(ROOT)}: {name}"
        for path, source in product().items()
        for names in CONSTANTS.findall(source)
        for name in names.split(", ")
        if name.isupper() and name.lower() in BARE.split()
    }
    assert not bare
    assert CONSTANTS.findall('A = 1\nB_C, D = 2, 3\nE: int = 4\nf = "\\nG = 5"\nH(I)\n') == ["A", "B_C, D", "E"]


def test_the_search_sees_every_kind_of_name() -> None:
    source = "class A:\n  def b(self, c):\n    self.d = e = [f for f in c]\n"
    assert assigned(nodes(source)) == {"A", "b", "self", "c", "d", "e", "f"}
    assert words("_KnownGradient") == {"known", "gradient"} and words("whole_FOLDER2") == {"whole", "folder2"}
    vague = "class Own:\n  def b(self, known):\n    self.kept = wanted = [told for told in f'{(found := 1)}']\n"
    assert suspects(vague, is_vague) == {"Own", "known", "kept", "wanted", "told", "found"}
    assert public_classes("class A: ...\nclass _B:\n  class C: ...\n'''\nclass D: ...'''\n") == {"A"}


def test_the_search_looks_at_code_alone() -> None:
    source = r'''a = f"{[b for b in c]} 'd'" # e
g = "h" + r"\"" + rf\'{j}\' + """k "l" """; m = 'n"'; o = "p#"; q'''.replace("\\'", "'")
    assert identifiers(source) == {*"abcdgmoq", "for", "in", "f", "j", "r", "rf"}
    assert not suspects("# own = 1\n'known = 2'\nprint(wanted.told)\n", is_vague)
