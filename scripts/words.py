"""One word, one thing: names that Python files give, held to docs/guide/glossary.md. Says why, and what to write.
Docstrings are whole sentences: none begins or ends with "...", to go on in the one before or after it.

Run: python scripts/words.py [FILE ...]        without files: all of src, benchmarks, train and tests; exit code 1 where
a name breaks a rule. `make check` and pre-commit run it. A rule that is wrong is changed here, with its reason: an
exception names its file and says why it stays.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src/splatpainter", "benchmarks", "train", "tests")


@dataclass(frozen=True)
class Rule:
    """Words that names do not have."""

    words: frozenset[str]
    why: str
    instead: str
    rooms: tuple[str, ...] = FOLDERS
    """Where it holds: beginnings of paths."""
    alone: bool = False
    """Whether only a name that is such a word, and not one that has it in it."""
    constants: bool = False
    """Whether only constants of modules."""


RULES = (
    Rule(
        frozenset(
            "told own found wanted known mine shown asked said taught whole kept others wish sound homeless lap laps "
            "got".split()
        ),
        "says that somebody did something with a value, not what it is",
        "a noun: result, target, expected, position, visible, remaining",
    ),  # fmt: skip
    Rule(
        frozenset({"place", "places"}),
        "alone it could be a position, a pixel or an index",
        "what it is: position, pixel, index (in a longer name it is a verb: place_pairs)",
        alone=True,
    ),
    Rule(
        frozenset({"row", "rows"}),
        "a row is a line of a file, a table or a picture, never a Gaussian",
        "gaussians, ids, or what they are: seen, pieces, children",
        rooms=tuple(f"src/splatpainter/{room}/" for room in ("models", "fit", "rendering", "lift", "spread", "holes")),
    ),
    Rule(
        frozenset(
            "ahead alike ball behind better bins block blur bounce candidates cell cells checkpoint chunk company "
            "confidence conflict count edge extent facing faint fine grid haste heal inputs inside jumps largest lean "
            "least level lights like main margin memory most mostly older outside overlap patch patience power "
            "quantile rays reach rim rings rounds shares sides size slack smallest soft solid spot spread step "
            "stiffness sweeps taps thickness tolerance tries upright views voxels wide width".split()
        ),
        "does not say of what, nor in which unit",
        "MAX_, MIN_ or the thing, and the unit: MIN_RIM_ALPHA, CELL_PX; several of one algorithm are a table",
        rooms=("src/splatpainter", "benchmarks/splatbench"),
        alone=True,
        constants=True,
    ),
    Rule(
        frozenset({"frame", "frames"}),
        "a frame is a picture of a film, a message of the socket or a compressed stream of zstd",
        "axes: where x, y and z of a file point",
        rooms=tuple(
            f"src/splatpainter/{room}"
            for room in ("io/", "splats.py", "comparison.py", "receipts.py", "operations/", "session/", "batch/")
        ),
    ),
    Rule(
        frozenset({"sticker", "stickers"}),
        "a picture on the surface is a decal, everywhere",
        "decal (a sticker is laid flat on a picture: pictures/drawing.py)",
        rooms=("src/splatpainter/decals/",),
    ),
)  # fmt: skip
EXCEPTIONS = {
    ("session.py", "shown"): "an old public name that still answers",
    ("zstd.py", "frame"): "a compressed stream",
    ("splats.py", "frame"): "an old public name that still answers",
    ("splats.py", "frame_from"): "an old public name that still answers",
    ("receipts.py", "frame"): "an old public name that still answers",
    ("receipts.py", "frame_is_news"): "an old public name that still answers",
    ("predictor.py", "own"): "a name of parameters in stored weights",
    ("protocol.py", "kept"): "a key of messages",
    ("edits.py", "_shown_again"): "a function that says what it asks",
    ("config.py", "row_tokens"): "a key of recipes and of weights",
    ("refine.py", "rows"): "a name of parameters in stored weights",
    ("refine.py", "norm_rows"): "a name of parameters in stored weights",
    ("refine.py", "norm_rows_mlp"): "a name of parameters in stored weights",
    ("refine.py", "mlp_rows"): "a name of parameters in stored weights",
    ("image_loss.py", "rows"): "rows of pixels",
    ("nearest.py", "rows"): "rows of pixels",
}
"""(file, name) -> why it stays."""
HALF = re.compile(r"\A\.\.\.|\.\.\.\Z")
WITH_COLUMNS = {"column", "columns"}
"""A file that names these beside rows speaks of pictures or tables."""


@dataclass(frozen=True)
class Offence:
    """A name that breaks a rule."""

    name: str
    line: int
    rule: Rule


def main(words: list[str]) -> int:
    paths = [Path(word).resolve() for word in words] or [
        path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    count = 0
    for path in paths:
        if path.suffix != ".py" or not path.is_relative_to(ROOT):
            continue
        place, source = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        for line in half_sentences(source):
            count += 1
            print(f"{place}:{line}: a docstring that begins or ends with '...'; write a whole sentence")
        for offence in offences(source, place):
            count += 1
            print(f"{place}:{offence.line}: {offence.name}: {offence.rule.why}; write {offence.rule.instead}")
    if count:
        print(f"{count} to change; the words are in docs/guide/glossary.md")
    return int(count > 0)


def offences(source: str, place: str) -> list[Offence]:
    """Names that a source gives against a rule, each once. place: its path in the repository."""
    rules = [rule for rule in RULES if place.startswith(rule.rooms)]
    # Most files have none of the words at all: only others are parsed.
    rules = [rule for rule in rules if re.search(rf"(?i)(?<![a-z])({'|'.join(rule.words)})(?![a-z])", source)]
    if not rules:
        return []
    out: dict[str, Offence] = {}
    given = list(names(ast.parse(source)))
    has_columns = any(name in WITH_COLUMNS for name, _, _ in given)
    for name, line, constant in given:
        for rule in rules:
            if (Path(place).name, name) in EXCEPTIONS or ("rows" in rule.words and has_columns):
                continue
            if breaks(rule, name, constant):
                out.setdefault(name, Offence(name, line, rule))
    return list(out.values())


def half_sentences(source: str) -> list[int]:
    """Lines of docstrings, those of fields and constants too, that begin or end with "..."."""
    if '"""...' not in source and '..."""' not in source:
        return []
    texts = [
        node.value
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    return sorted(text.lineno for text in texts if HALF.search(str(text.value).strip()))


def breaks(rule: Rule, name: str, constant: bool) -> bool:
    if rule.constants:
        return constant and name.isupper() and name.lower() in rule.words
    if name.startswith("test_"):  # the names of tests are sentences
        return False
    return name.strip("_").lower() in rule.words if rule.alone else bool(words_of(name) & rule.words)


@cache
def words_of(name: str) -> frozenset[str]:
    """The words of snake_case and CamelCase, lower case."""
    return frozenset(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().strip("_").split("_"))


def names(tree: ast.Module) -> Iterator[tuple[str, int, bool]]:
    """(name, line, whether it is a constant of the module) of variables, parameters, attributes, functions, classes."""
    top = {id(target) for node in tree.body for target in targets(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield (node.id if isinstance(node, ast.Name) else node.attr), node.lineno, id(node) in top
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno, False
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno, False


def targets(node: ast.stmt) -> list[ast.expr]:
    given = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [part for target in given for part in (target.elts if isinstance(target, ast.Tuple) else [target])]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
