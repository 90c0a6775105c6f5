"""YAML files that people write, read into dataclasses: whatever is wrong is said with its line. Knows no schema.

    jobs, lines = read(Jobs, Path("JOBS.yaml"))
    raise ValueError(f"{lines.at('edits[0].decal.camera')}: no such file")          # JOBS.yaml:12: no such file

Read with PyYAML's composer, which makes nodes and no Python objects. Of YAML 1.1 that leaves mappings, lists, text,
numbers, truth values, null and anchors; `1e-3` is a number, `1:30` is text, and dates and tags are refused.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, TypeVar

from splatpainter.system import jsonio
from splatpainter.system.quick_dataclass import dataclass

MAX_YAML_BYTES = 1 << 20
"""Most bytes of a file."""
MAX_NODES = 50_000
"""Values of a file, anchors written out."""
MAX_DEPTH = 40
_Dataclass = TypeVar("_Dataclass")
_NUMBER = re.compile(r"[-+]?(\d[\d_]*\.?\d*|\.\d+)([eE][-+]?\d+)?")
BARE_COLOR = re.compile(r"^[^#\"']*[:\[,]\s+#[0-9a-fA-F]{6}\b")
_TAG = "tag:yaml.org,2002:"


@dataclass
class Lines:
    """Where the values of a document stand."""

    file: Path
    of: dict[str, int] = field(default_factory=dict)
    """Dotted path as jsonio has it ("edits[0].grade.where[1]") -> line, from 1."""

    def at(self, path: str) -> str:
        """`FILE:LINE` of a value, or of the nearest one that it belongs to."""
        while path and path not in self.of:
            path = re.sub(r"(\.[^.\[\]]*|\[\d+\]|^[^.\[\]]*)$", "", path)
        return f"{self.file}:{self.of[path]}" if path in self.of else str(self.file)


def read(kind: type[_Dataclass], path: Path, aliases: Mapping[str, str] | None = None) -> tuple[_Dataclass, Lines]:
    """The dataclass `kind` from a YAML file, defaults for what it leaves out, and its lines. aliases: as of
    `jsonio.build`.

    Raises ValueError naming file and line: unreadable, no YAML, unknown or missing keys, values of another kind; and
    without PyYAML what to install."""
    lines = Lines(path)
    try:
        values = _load(path, lines)
    except ValueError as error:
        raise ValueError(f"{error}{_comment_hint(path)}") from None
    try:
        return jsonio.build(
            kind, values, path, what="a mapping of keys and values", defaults=True, aliases=aliases
        ), lines
    except jsonio.FieldError as error:
        raise ValueError(f"{lines.at(error.path)}: {error.reason}{_comment_hint(path)}") from None


def _comment_hint(path: Path) -> str:
    """ "; ..." where a colour of a file that is wrong was written without quotes, or ""."""
    try:
        with open(path, "rb") as file:
            text = file.read(MAX_YAML_BYTES).decode("utf-8", "replace")
    except OSError:
        return ""
    bare = next((number for number, line in enumerate(text.splitlines(), 1) if BARE_COLOR.search(line)), None)
    return "" if bare is None else f'; line {bare}: # begins a comment, put the colour in quotes: "#..."'


def _load(path: Path, lines: Lines) -> Any:
    # PyYAML is not among what every installation has.
    try:
        import yaml
    except ImportError:
        raise ValueError(f"{path}: reading YAML needs PyYAML; pip install 'splatpainter[batch]'") from None
    try:
        # One byte more than is allowed tells a file that is too long without reading it whole.
        with open(path, "rb") as file:
            data = file.read(MAX_YAML_BYTES + 1)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(data) > MAX_YAML_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_YAML_BYTES >> 20} MiB of YAML, got more")
    try:
        # Nodes, not objects: they know their lines, and no tag can make anything of Python's.
        root = yaml.compose(data.decode("utf-8-sig"), Loader=yaml.SafeLoader)
    except UnicodeDecodeError:
        raise ValueError(f"{path}: expected YAML (UTF-8 text), got other bytes") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = path if mark is None else f"{path}:{mark.line + 1}"
        raise ValueError(f"{where}: is not YAML ({error.problem or error.context})") from None
    except (yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise ValueError(f"{path}: is not YAML ({reason})") from None
    if root is None:
        raise ValueError(f"{path}: is empty")
    return _Reader(path, lines).value(root, "", 0)


class _Reader:
    """Nodes to the values that JSON has."""

    def __init__(self, path: Path, lines: Lines) -> None:
        self._path, self._lines, self._count = path, lines, 0

    def value(self, node: Any, path: str, depth: int) -> Any:
        import yaml

        # Anchors can make a short file mean billions of values: what is counted is what they stand for.
        self._count += 1
        line = node.start_mark.line + 1
        self._lines.of.setdefault(path, line)
        if self._count > MAX_NODES or depth > MAX_DEPTH:
            limit = f"{MAX_NODES} values" if depth <= MAX_DEPTH else f"{MAX_DEPTH} mappings and lists inside each other"
            raise ValueError(f"{self._path}:{line}: expected at most {limit}")
        if isinstance(node, yaml.MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, path, depth)
        if isinstance(node, yaml.SequenceNode) and node.tag == _TAG + "seq":
            return [self.value(item, f"{path}[{k}]", depth + 1) for k, item in enumerate(node.value)]
        if isinstance(node, yaml.ScalarNode):
            return self._scalar(node)
        raise ValueError(f"{self._path}:{line}: expected plain YAML, got the tag {ascii(node.tag)[:40]}")

    def _mapping(self, node: Any, path: str, depth: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = key_node.value if isinstance(key_node.value, str) else None
            # Merge keys hide which line a value comes from, and errors name lines.
            if key is None or key_node.tag == _TAG + "merge":
                expected = "the keys themselves in place of <<" if key == "<<" else "text as a key"
                raise ValueError(f"{self._path}:{line}: expected {expected}")
            if key in out:
                raise ValueError(f"{self._path}:{line}: {ascii(key)[:60]} was given twice")
            inner = f"{path}.{key}" if path else key
            self._lines.of[inner] = line
            out[key] = self.value(value_node, inner, depth + 1)
        return out

    def _scalar(self, node: Any) -> Any:
        text, kind = node.value, node.tag.removeprefix(_TAG)
        # Quotes make a text of anything; bare words mean what people expect, not all that YAML 1.1 sees in them.
        if node.style is not None or kind == "str" and not _NUMBER.fullmatch(text):
            return text
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() in ("yes", "true", "on")
        if kind in ("int", "float", "str"):
            if not _NUMBER.fullmatch(text):  # 1:30 of YAML 1.1 is no number to people; .inf is none to us
                return text
            number = float(text.replace("_", ""))
            return (
                int(text.replace("_", "")) if number.is_integer() and re.fullmatch(r"[-+]?\d[\d_]*", text) else number
            )
        at = f"{self._path}:{node.start_mark.line + 1}"
        raise ValueError(f"{at}: expected text, a number or true or false, got {ascii(text)[:40]}; put it in quotes")
