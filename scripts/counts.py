"""Counts that say how the house is kept: python scripts/counts.py [COMMIT ...]

One column for the working tree and one for each commit, as a Markdown table. Everything is read from the syntax of the
sources, so that commits need not be installed. The counts are signs, not aims: docs/ARCHITECTURE.md says what for.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tarfile
import tokenize
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src", "web/src")
PACKAGE = "src/splatpainter/"
KIND_ROOMS = ("session", "server", "commands")
"""Rooms where comparing an operation's kind or mode with a word says that it is no value yet."""
OPTION_ROOMS = ("commands", "batch", "operations", "server", "session", "source_edits", "grading")
"""Rooms that used to write a capability's options down, each in its manner."""
CAPABILITIES = {
    "paint": ("angle_limit", "depth_edge_limit", "spread_threshold", "spread_confidence", "polish"),
    "decal": ("at", "width", "angle", "wrap", "font"),
    "grade": (
        "exposure",
        "temperature",
        "tint",
        "contrast",
        "saturation",
        "hue",
        "lut",
        "match",
        "recolor",
        "strength",
    ),
    "source": ("prompt", "max_views", "seed", "enlarge", "strictness", "references", "azimuth", "elevation"),
}
"""Options that belong to one capability each. Some of their names say other things, too (a picture has a width, a fit
a seed): these count where a class or function declares two of the capability's options at least (AMBIGUOUS)."""
AMBIGUOUS = {"at", "width", "angle", "match", "strength", "seed", "elevation", "exposure", "hue", "saturation"}
"""Options whose names say other things elsewhere: one of them alone is no declaration."""
NUMERIC_CALLS = {"float32", "float64", "int64", "uint32", "uint64", "array", "log", "sqrt", "radians", "cos"}
LONG_FUNCTION, LONGEST_FUNCTION = 40, 80
"""Lines above which a function wants a comment for each phase, and above which it wants to be two."""

Sources = Mapping[str, str]
"""Text of each source by its path in the repository."""


def main(commits: list[str]) -> None:
    columns = {"now": working_tree(), **{commit: of_commit(commit) for commit in commits}}
    print("| | " + " | ".join(columns) + " |")
    print("| --- |" + " ---: |" * len(columns))
    for label, count in COUNTS.items():
        print(f"| {label} | " + " | ".join(count(sources) for sources in columns.values()) + " |")


def working_tree() -> Sources:
    paths = (path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if is_source(path.as_posix()))
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(paths)}


def of_commit(commit: str) -> Sources:
    archive = subprocess.run(["git", "archive", commit, *FOLDERS], cwd=ROOT, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        members = [member for member in tar if member.isfile() and is_source(member.name)]
        return {member.name: tar.extractfile(member).read().decode() for member in members}  # type: ignore[union-attr]


def is_source(path: str) -> bool:
    return path.endswith((".py", ".ts", ".tsx")) and "/static/" not in path and "/node_modules/" not in path


parsed = cache(ast.parse)


def modules(sources: Sources) -> Iterator[tuple[str, str, ast.Module]]:
    """(path within the package, text, tree) of each Python file of the package."""
    for path, text in sources.items():
        if path.startswith(PACKAGE) and path.endswith(".py"):
            yield path.removeprefix(PACKAGE), text, parsed(text)


def lines(sources: Sources) -> str:
    return f"{sum(text.count(chr(10)) for _, text, _ in modules(sources)):,}"


def numeric_constants(sources: Sources) -> str:
    """Names that a module gives a number, or several numbers; fields of a table of thresholds are none."""
    count = 0
    for _, _, tree in modules(sources):
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and is_numeric(node.value):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                count += sum(len(target.elts) if isinstance(target, ast.Tuple) else 1 for target in targets)
    return f"{count:,}"


def is_numeric(value: ast.expr) -> bool:
    match value:
        case ast.Constant(value=bool()):
            return False
        case ast.Constant(value=int() | float() | complex()):
            return True
        case ast.UnaryOp(operand=operand):
            return is_numeric(operand)
        case ast.BinOp(left=left, right=right):
            return is_numeric(left) and is_numeric(right)
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Call(args=parts, keywords=[]):
            name = getattr(value, "func", None)
            plain = name is None or getattr(name, "attr", getattr(name, "id", "")) in NUMERIC_CALLS
            return plain and bool(parts) and all(map(is_numeric, parts))
    return False


def code_and_comments(text: str, tree: ast.Module) -> tuple[int, int]:
    """(lines of code, comments on lines of their own or behind code). Docstrings are neither."""
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    code, comments = set(), 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comments += not re.match(r"# (type:|noqa|fmt:|pyright:)", token.string)
        elif token.type not in skipped:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            code.difference_update(range(node.lineno, (node.end_lineno or 0) + 1))
    return len(code), comments


def comment_density(sources: Sources) -> str:
    pairs = [code_and_comments(text, tree) for _, text, tree in modules(sources)]
    return f"{100 * sum(comments for _, comments in pairs) / sum(code for code, _ in pairs):.1f}"


def comment_density_by_room(sources: Sources) -> str:
    """Lowest first."""
    code, comments = Counter[str](), Counter[str]()
    for path, text, tree in modules(sources):
        room = path.partition("/")[0] if "/" in path else "top"
        pair = code_and_comments(text, tree)
        code[room] += pair[0]
        comments[room] += pair[1]
    density = {room: 100 * comments[room] / max(code[room], 1) for room in code}
    return ", ".join(f"{room} {density[room]:.1f}" for room in sorted(density, key=lambda room: density[room]))


def functions(sources: Sources) -> Iterator[tuple[str, int]]:
    """(path:name, lines) of each function, without its docstring."""
    for path, _, tree in modules(sources):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
                yield f"{path}:{node.name}", (node.end_lineno or 0) - body[0].lineno + 1


def long_functions(sources: Sources) -> str:
    sizes = [size for _, size in functions(sources)]
    return f"{sum(size > LONG_FUNCTION for size in sizes)}, {sum(size > LONGEST_FUNCTION for size in sizes)}"


def ellipsis_docstrings(sources: Sources) -> str:
    """Docstrings that are the second half of a sentence, or the first."""
    texts = (
        node.value.value.strip()
        for _, _, tree in modules(sources)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    )
    return str(sum(text.startswith("...") or text.endswith("...") for text in texts))


def flat_files(sources: Sources) -> str:
    """The largest folders: files that lie in them, not in folders within."""
    counts = Counter(str(PurePosixPath(path).parent) for path, _, _ in modules(sources))
    return ", ".join(f"{folder if folder != '.' else 'top'} {count}" for folder, count in counts.most_common(4))


def kind_comparisons(sources: Sources) -> str:
    """Comparisons with `.kind` or `.mode` in the rooms that hold operations."""
    trees = [tree for path, _, tree in modules(sources) if path.startswith(KIND_ROOMS)]
    compared = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Compare))
    sides = ([node.left, *node.comparators] for node in compared)
    return str(sum(any(getattr(side, "attr", "") in ("kind", "mode") for side in pair) for pair in sides))


def session_members(sources: Sources) -> str:
    """Public names of `Session` and of the classes that it is made of, as dir(Session) has them."""
    classes = {
        node.name: node
        for path, _, tree in modules(sources)
        if path.startswith("session/")
        for node in tree.body
        if isinstance(node, ast.ClassDef)
    }
    members, names = set[str](), ["Session"]
    for name in names:
        if (node := classes.get(name)) is not None:
            names += [base.id for base in node.bases if isinstance(base, ast.Name)]
            defined = [part.name for part in node.body if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef)]
            valued = [part for part in node.body if isinstance(part, ast.AnnAssign) and part.value is not None]
            defined += [part.target.id for part in valued if isinstance(part.target, ast.Name)]
            members.update(name for name in defined if not name.startswith("_"))
    return str(len(members))


def declarations_per_option(sources: Sources) -> str:
    """How often an option of each capability is declared: as a field, a property of a protocol, or a keyword argument
    with a default."""
    declared = Counter[str]()
    for path, _, tree in modules(sources):
        if path.partition("/")[0] not in OPTION_ROOMS:
            continue
        for node in ast.walk(tree):
            names = set(names_declared(node))
            for options in CAPABILITIES.values():
                found = names.intersection(options)
                # One alone is a declaration where its name says nothing else (an option that several classes share).
                declared.update(found if len(found) > 1 else found - AMBIGUOUS)
    means = {
        capability: sum(declared[option] for option in options) / len(options)
        for capability, options in CAPABILITIES.items()
    }
    return ", ".join(f"{capability} {mean:.1f}" for capability, mean in means.items())


def names_declared(node: ast.AST) -> Iterator[str]:
    """Fields and properties of a class, arguments with defaults of a function."""
    if isinstance(node, ast.ClassDef):
        yield from (part.target.id for part in node.body if is_field(part))  # type: ignore[attr-defined]
        yield from (part.name for part in node.body if is_property(part))  # type: ignore[attr-defined]
    elif isinstance(node, ast.FunctionDef):
        defaulted = node.args.args[len(node.args.args) - len(node.args.defaults) :]
        yield from (part.arg for part in [*defaulted, *node.args.kwonlyargs])


def is_field(node: ast.stmt) -> bool:
    return isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)


def is_property(node: ast.stmt) -> bool:
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(decorator, ast.Name) and decorator.id == "property" for decorator in node.decorator_list
    )


def module_lets(sources: Sources) -> str:
    """Variables that a module of the page changes: state that belongs to nothing."""
    texts = (text for path, text in sources.items() if path.startswith("web/src/"))
    return str(sum(len(re.findall(r"^(?:export )?let ", text, re.MULTILINE)) for text in texts))


COUNTS: dict[str, Callable[[Sources], str]] = {
    "lines of src/splatpainter (Python)": lines,
    "numeric constants of modules": numeric_constants,
    "comments per 100 lines of code": comment_density,
    "the same by room": comment_density_by_room,
    f"functions over {LONG_FUNCTION} lines, over {LONGEST_FUNCTION}": long_functions,
    "docstrings that begin or end with ...": ellipsis_docstrings,
    "flat files of the largest folders": flat_files,
    "comparisons of .kind and .mode in session, server, commands": kind_comparisons,
    "public names of Session": session_members,
    "declarations of an option": declarations_per_option,
    "module-level let in web/src": module_lets,
}

if __name__ == "__main__":
    main(sys.argv[1:])
