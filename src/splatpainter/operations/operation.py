"""An operation is a value: what becomes of an asset, with all of its options, and nothing else.

    edited = Grade(exposure=0.5).apply(Asset(splats))
    receipt, verification = apply_to_file(Path("vase.ply"), [Grade(exposure=0.5)], Path("warm.ply"))   # to_file.py

Each kind is one frozen dataclass in a file of this folder: its fields are the options, each declared and explained
there once. The command line is parsed into it (commands/parts/option_parsing.py), a JOBS.yaml and JSON are built into
it (`operation_of`), nodes of other programs are made from its fields. An operation knows no session and no command
line; what it needs of the place where it runs comes as `Tools`, and what it says besides its receipt goes into a
`Report`.

To add one: a module here with a dataclass of `Operation`, and its name in KINDS. Other distributions add theirs by
entry points of the group `splatpainter.operations`: name = module:Class.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import MISSING, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

from splatpainter.system import jsonio
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import out_of_range

if TYPE_CHECKING:
    import numpy as np

    from splatpainter.painter import Asset, Painter
    from splatpainter.sources.picture_source import CancelFlag, PictureAnswer, PictureSource, Progress
    from splatpainter.splats import Splats

ENTRY_POINTS = "splatpainter.operations"
"""Group by which other distributions add operations."""
KINDS = {
    "paint": "paint:Paint",
    "decal": "decal:LayDecal",
    "grade": "grade:Grade",
    "fill": "fill:Fill",
    "refine": "refine:Refine",
    "generate": "generate:Generate",
    "light": "light:Relight",
    "delight": "light:Delight",
    "pixelate": "pixelate:Pixelate",
    "replay": "splatpainter.session.replay_operation:ReplayLayers",
}
"""Kind -> module of this folder (of a room above its dotted name, as entry points have it) and class, imported when it
is asked for; in the order in which help lists them."""


def parameter(
    default: Any = MISSING,
    *,
    metavar: str = "",
    option: str = "",
    positional: bool = False,
    words: Any = None,
    file: bool = False,
    output: bool = False,
    shared: bool = False,
    holds: str = "",
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
    max_length: int | None = None,
) -> Any:
    """A field of an operation. metavar: its value in help. option: its name on the command line, where that is another
    ("camera" of `cameras`). positional: given there without a name. words: its type there, where that is another (str
    of a pixel "X,Y"); `__post_init__` makes of the words what the field is. file: it names files that are read; output:
    a file that is written. shared: it is declared in a base class, too, and comes after the fields of its own.
    holds: of a file, "picture" or "camera", for hosts that have these at hand; "region" of words that say one. ge, gt,
    le, lt: the range of a number (system/ranges.py). max_length: characters that a page may send."""
    # Everything that other programs build from a field travels in its metadata, so nothing lists options a second time.
    metadata = {"metavar": metavar, "option": option, "positional": positional, "words": words, "holds": holds}
    bounds = {"ge": ge, "gt": gt, "le": le, "lt": lt, "max_length": max_length}
    metadata |= {"file": file, "output": output, **bounds}
    return field(default=default, metadata=metadata, kw_only=shared or MISSING)


@dataclass(frozen=True)
class Wording:
    """How errors name an operation and its options: as a command line or as Python has them."""

    where: str | None = None
    """What a line begins with, such as "splatpainter grade: "; None: the kind."""
    dashes: str = ""
    names: Mapping[str, str] = field(default_factory=dict)
    """Field -> what it is called there, where that is not its name behind the dashes."""

    def option(self, name: str) -> str:
        """A field's name: "angle_limit", or "--angle-limit"."""
        # The same error has to name an option as its reader wrote it: by dashes, by a key, or as Python.
        plain = f"{self.dashes}{name.replace('_', '-')}" if self.dashes else name
        return self.names.get(name, plain)

    def error(self, kind: str, line: str) -> ValueError:
        where = f"{kind}: " if self.where is None else self.where
        return ValueError(where + line)


AS_PYTHON = Wording()


@contextmanager
def _silent() -> Iterator[Progress]:
    yield lambda share, words: None


class _NeverCancelled:
    def is_set(self) -> bool:
        return False


def _open_source(name: str, options: Mapping[str, str]) -> PictureSource:
    from splatpainter.sources.registry import open_source

    return open_source(name, options)


@dataclass(frozen=True)
class Tools:
    """What an operation has of the place where it runs."""

    painter: Painter | None = None
    """Who paints; None: one is loaded as the operation says."""
    open_source: Callable[[str, Mapping[str, str]], PictureSource] = _open_source
    """(name, options) -> a picture source."""
    progress: Callable[[], AbstractContextManager[Progress]] = _silent
    """Gives where sources say how far they are, for the time of a `with` block."""
    cancel: CancelFlag = field(default_factory=_NeverCancelled)
    held: Mapping[str, bytes] = field(default_factory=dict)
    """Option -> what a project holds in place of the file that it names (`Operation.packed`)."""
    unlit: np.ndarray | None = None
    """Of `glance`, as Asset.unlit."""
    aside: bool = False
    """Score local edits from the side too, for receipts (painter.Painter.aside)."""
    asset: Path | None = None
    """The file that the asset comes from, where it is one: cameras and pictures are looked for beside it."""
    wording: Wording = AS_PYTHON


@dataclass(frozen=True)
class ReportedView:
    """One view of an operation's receipt, as people know it."""

    name: str
    """The picture's file, or what else it is called."""
    notes: tuple[str, ...] = ()
    against: str = ""
    """What its score compares with, where that is no picture that was given."""


@dataclass
class Report:
    """What operations say besides their receipts."""

    warn: Callable[[str], None] = lambda line: None
    """Takes a line about something that does not stop the operation."""
    views: list[ReportedView] = field(default_factory=list)
    """Of the receipt's views, in their order."""
    answers: list[PictureAnswer] = field(default_factory=list)
    """Of sources, those that were painted."""


ReadyOperation: TypeAlias = "Callable[[Asset, Report], Asset]"
"""An operation with its files read and its source opened."""


@dataclass(frozen=True)
class Operation:
    """What every kind has. Subclasses are frozen dataclasses, all of whose fields have defaults."""

    kind: ClassVar[str]
    """Its name: the word of the command line, the key in a JOBS.yaml."""
    holds: ClassVar[tuple[str, ...]] = ()
    """Options whose files projects can hold (`packed`)."""

    def __post_init__(self) -> None:
        """Names of files become paths, lists tuples."""
        # Values come from YAML, JSON, words and Python; from here on each field has one form alone.
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            is_file = entry.metadata.get("file") or entry.metadata.get("output")
            if isinstance(value, list):
                value = tuple(value)
            if is_file and isinstance(value, tuple):
                value = tuple(map(Path, value))
            elif is_file and isinstance(value, str):
                # An empty name is no file; Path("") would be the working folder.
                value = Path(value) if value else None
            # The dataclass is frozen, and this is still its construction.
            object.__setattr__(self, entry.name, value)

    def check(self, wording: Wording = AS_PYTHON) -> None:
        """Raises ValueError, one line, for options that cannot be or do not go together; no file is read."""
        # Subclasses begin with this: numbers out of their ranges are refused in the same words everywhere.
        if (line := out_of_range(self, wording.option)) is not None:
            raise wording.error(self.kind, line)

    def ready(self, tools: Tools) -> ReadyOperation:
        """The operation with all that it needs but the asset: files are read, sources opened. Raises ValueError and
        SourceError, one line naming what cannot be used."""
        raise NotImplementedError

    def apply(self, asset: Asset, tools: Tools | None = None, report: Report | None = None) -> Asset:
        """The asset afterwards, with the receipt of this operation; `asset` itself does not change. Raises ValueError:
        options, files, or an operation that this asset cannot have."""
        # Checked here too: from Python nobody has called `check` before.
        self.check()
        return self.act(self.ready(tools or Tools()), asset, report or Report())

    def act(self, ready: ReadyOperation, asset: Asset, report: Report) -> Asset:
        """What `ready` makes of an asset; what is known of it without the lights that were put on it stays known."""
        edited = ready(asset, report)
        if asset.unlit is None or self.relights:
            return edited
        from splatpainter.lights.unlit import unlit_after

        return dataclasses.replace(edited, unlit=unlit_after(asset.splats, asset.unlit, edited.splats))

    def files(self) -> tuple[Path, ...]:
        """The files that it reads, also those that terms of its regions name."""
        regions = [entry.name for entry in dataclasses.fields(self) if entry.metadata.get("holds") == "region"]
        words = [word for name in regions for word in getattr(self, name)]
        # Most operations name no region, and what reads terms takes a while to import.
        if not words:
            return tuple(Path(path) for path in self._paths("file"))
        from splatpainter.operations.region import files_of_terms

        return (*(Path(path) for path in self._paths("file")), *files_of_terms(words))

    @property
    def relights(self) -> bool:
        """Whether it changes the light on an asset, and nothing else: then it is mixed as light."""
        return False

    def outputs(self) -> tuple[Path, ...]:
        """Files that it writes besides the asset."""
        return tuple(Path(path) for path in self._paths("output"))

    def apply_selected(self, asset: Asset, weights: np.ndarray) -> Asset | None:
        """The asset after the operation on a selection of its Gaussians ([N] 0..1), where that is something else than a
        mix of before and after; None: it is that."""
        return None

    def packed(self) -> tuple[Operation, dict[str, bytes]]:
        """(the operation, option -> PNG bytes), for projects, which are replayed where the files that its options name
        are not: those become what is held of them (`Tools.held`), or other options; files that can become neither stay
        named. Raises ValueError: a file that cannot be read."""
        return self, {}

    def glance(self, splats: Splats, tools: Tools) -> np.ndarray | None:
        """[N, 1, 3] SH: base colours, nearly those that it will give, in a fraction of the time, for a window in which
        its options are dragged; None: there is no such way. Raises ValueError as `apply`."""
        return None

    def viewpoints(self) -> tuple[Path, ...]:
        """Files that say a camera from which it can be seen, the best first."""
        return ()

    def record(self) -> dict[str, Any]:
        """JSON object: its kind, and the options that are not at their defaults. `operation_of` is the inverse."""
        plain = jsonio.plain(self)
        changed = {name: plain[name] for name in self.changes()}
        return {"kind": self.kind, **changed}

    def changes(self) -> dict[str, Any]:
        """The options that are not at their defaults, by name."""
        fields = {entry.name: entry.default for entry in dataclasses.fields(self)}
        # A default may be given in one form and kept in another, so an instance is compared and not the declaration.
        default = type(self)()  # whose __post_init__ may have made other values of them
        values = {name: getattr(self, name) for name in fields}
        return {name: value for name, value in values.items() if value != getattr(default, name)}

    def python(self) -> str:
        """The expression that makes it, with `import splatpainter as sp` before it."""
        words = [f"{name}={_literal(value)}" for name, value in self.changes().items()]
        return f"sp.{type(self).__name__}({', '.join(words)})"

    def _paths(self, role: str) -> Iterator[Any]:
        for entry in dataclasses.fields(self):
            value = getattr(self, entry.name)
            if entry.metadata.get(role) and value:
                yield from value if isinstance(value, tuple) else (value,)


def _literal(value: Any) -> str:
    """Python's spelling of a field; paths as text, which fields take too."""
    if isinstance(value, Path):
        return repr(value.as_posix())
    if isinstance(value, tuple):
        inner = ", ".join(_literal(item) for item in value)
        return f"({inner},)" if len(value) == 1 else f"({inner})"
    return repr(value)


def option_texts(kind: type) -> dict[str, str]:
    """Field -> what its docstring says of it, with the line breaks that it has in the source; of base classes, too."""
    import docstring_parser  # which parses the source, and is there for help alone

    texts: dict[str, str] = {}
    # From the base downwards: a class that explains an option anew has the last word.
    for base in reversed(kind.__mro__[:-1]):
        if base.__doc__ is not None and dataclasses.is_dataclass(base):
            options = docstring_parser.parse_from_object(base).params
            texts |= {option.arg_name: option.description for option in options if option.description}
    return texts


def check_operations(operations: Sequence[Operation], wording: Callable[[Operation], Wording]) -> None:
    """Raises ValueError: none, or one whose options cannot be."""
    if not operations:
        raise ValueError("expected at least one operation, got none")
    for operation in operations:
        operation.check(wording(operation))


def kinds() -> list[str]:
    """All kinds: those of this package, then others by their names."""
    return [*KINDS, *sorted({point.name for point in _entry_points()} - {*KINDS})]


def operation_class(kind: str) -> type[Operation]:
    """The dataclass of a kind. Raises ValueError: there is none of that name."""
    # The package's own come first: another distribution cannot take the name of one of them.
    if kind in KINDS:
        module, _, name = KINDS[kind].partition(":")
        dotted = module if "." in module else f"splatpainter.operations.{module}"
        return getattr(importlib.import_module(dotted), name)
    points = [point for point in _entry_points() if point.name == kind]
    # Two distributions with one name: neither is taken, for nobody could tell which one it was.
    if len(points) != 1:
        raise ValueError(f"expected an operation of {', '.join(kinds())}, got {ascii(kind[:60])}")
    return points[0].load()


def operation_of(record: Any, where: str) -> Operation:
    """The operation that `Operation.record` describes. Raises ValueError naming `where` and the key that is wrong."""
    # A record comes from a file that anybody may have written; its kind is looked at before a class is imported.
    if not isinstance(record, Mapping) or not isinstance(record.get("kind"), str):
        raise ValueError(f"{where}: expected an operation with its kind, got {jsonio.brief(record)}")
    values = {name: value for name, value in record.items() if name != "kind"}
    operation = jsonio.build(operation_class(record["kind"]), values, where, defaults=True)
    # Checked with the place it came from, so that an error names the line of the job and not Python.
    operation.check(Wording(f"{where}: "))
    return operation


def _entry_points() -> list[Any]:
    import importlib.metadata  # a twentieth of a second, which few need

    return list(importlib.metadata.entry_points(group=ENTRY_POINTS))
