"""What a JOBS.yaml says: one tree of dataclasses, the only definition of the format; the keys of edits are the options
of operations (operations/). Paths are relative to the file.

Texts and file names of edits may hold `{asset}` (the asset's name) and `{variant}`.
"""

from __future__ import annotations

import re
from dataclasses import asdict, field, fields, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_type_hints

from splatpainter.operations.operation import Operation, Wording, kinds, operation_class
from splatpainter.splats import Axes
from splatpainter.system.quick_dataclass import dataclass

FILE = {"file": True}
"""Metadata of fields that name files."""
NAME = re.compile(r"[\w][\w .+-]{0,99}")
"""Names of variants: they become parts of file names."""
IN_FILES = Wording("")
"""Errors of options: the line of the file stands before them."""
MIN_PREVIEW_PX, MAX_PREVIEW_PX = 32, 2048


@dataclass(frozen=True)
class OperationStep:
    """An operation as a JOBS.yaml has it: its options by their names, which may hold {asset} and {variant}."""

    kind: ClassVar[type[Operation]]
    renamed: ClassVar[dict[str, str]]
    """Option -> what it is called here, where that is not its name."""

    def __post_init__(self) -> None:
        if not has_placeholder(asdict(self)):
            self.operation().check(IN_FILES)

    def operation(self) -> Operation:
        """The operation. Raises ValueError."""
        names = {entry.name: self.renamed.get(entry.name, entry.name) for entry in fields(self.kind)}
        return self.kind(**{name: getattr(self, spelled) for name, spelled in names.items()})


def step_class(kind: type[Operation], **renamed: str) -> type[OperationStep]:
    """The keys of a kind, from its options. renamed: those that are called otherwise."""
    hints, entries = get_type_hints(kind), []
    for entry in fields(kind):
        name = renamed.get(entry.name, entry.name)
        entries.append((name, hints[entry.name], field(default=entry.default, metadata=entry.metadata)))
    namespace = {"kind": kind, "renamed": renamed, "__doc__": kind.__doc__}
    return make_dataclass(f"{kind.__name__}Step", entries, bases=(OperationStep,), namespace=namespace, frozen=True)


STEPS: dict[str, type[OperationStep]] = {
    "pictures": step_class(operation_class("paint"), pictures="files"),
    "decal": step_class(operation_class("decal")),
    "grade": step_class(operation_class("grade")),
    "source": step_class(operation_class("generate"), source="name"),
    "refine": step_class(operation_class("refine"), source="name"),
    "layers": step_class(operation_class("replay")),
}
"""Key of an edit -> its own keys. Operations have the names of their kinds, too."""
STEPS |= {kind: step_class(operation_class(kind)) for kind in kinds() if kind not in STEPS}


class _OneStep:
    """One step of a job: exactly one of STEPS."""

    def __post_init__(self) -> None:
        given = [name for name in STEPS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of {', '.join(STEPS)}, got {' and '.join(given) or 'none'}")

    @property
    def kind(self) -> str:
        return next(name for name in STEPS if getattr(self, name) is not None)

    @property
    def step(self) -> Any:
        return getattr(self, self.kind)


if TYPE_CHECKING:

    class JobEdit(_OneStep): ...
else:
    JobEdit = make_dataclass(
        "JobEdit", [(name, kind | None, None) for name, kind in STEPS.items()], bases=(_OneStep,), frozen=True
    )


@dataclass(frozen=True)
class Variant:
    """One of several results of each asset."""

    name: str
    """Part of the file's name: OUT/ASSET-NAME.ply."""
    edits: tuple[JobEdit, ...] = ()
    """Edits of this variant, after those of all variants."""

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"expected a name of letters, digits, space and .+-_, got {self.name!r:.60}")


@dataclass(frozen=True)
class Preview:
    """The pictures before and after on the summary page."""

    camera: str = field(default="", metadata=FILE)
    """Where from; without it from where the first edit was seen, or from the front."""
    size: int = 320
    """Pixels of the longer side."""

    def __post_init__(self) -> None:
        if not MIN_PREVIEW_PX <= self.size <= MAX_PREVIEW_PX:
            raise ValueError(f"expected size from {MIN_PREVIEW_PX} to {MAX_PREVIEW_PX}, got {self.size}")


OLD_KEYS = {"frame": "axes"}
"""Keys of a JOBS.yaml as files may still spell them -> their names."""


@dataclass(frozen=True)
class Batch:
    """A JOBS.yaml: assets times variants, each a job of one or more edits."""

    assets: tuple[str, ...]
    """Splat files, or patterns like shoes/*.ply."""
    out: str = "out"
    """Folder of the results; made if missing."""
    edits: tuple[JobEdit, ...] = ()
    """Edits of every variant, in this order."""
    variants: tuple[Variant, ...] = ()
    """None: one result per asset."""
    format: Literal["", "ply", "compressed.ply", "splat", "spz", "sog", "glb"] = ""
    """Format of the results; "": that of each asset."""
    axes: Axes = "auto"
    """Axes of the assets' numbers, as `--in-axes`."""
    preview: Preview = Preview()

    def __post_init__(self) -> None:
        if not self.assets:
            raise ValueError("expected at least one of assets")
        if not self.edits and not all(variant.edits for variant in self.variants or [Variant("x")]):
            raise ValueError("expected edits")
        names = [variant.name.lower() for variant in self.variants]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"variants: {twice[0]!r} was given twice")


def file_paths(step: Any) -> dict[str, tuple[str, ...]]:
    """Field -> the file names in it, of a step."""
    out = {}
    for entry in fields(step):
        if entry.metadata.get("file"):
            value = getattr(step, entry.name)
            names = value if isinstance(value, tuple) else (value,)
            out[entry.name] = tuple(str(name) for name in names if name)
    return out


def with_values(value: Any, asset: str, variant: str) -> Any:
    """A step's texts with `{asset}` and `{variant}` written out."""
    if isinstance(value, str):
        return value.replace("{asset}", asset).replace("{variant}", variant)
    if isinstance(value, Path):
        return Path(with_values(str(value), asset, variant))
    if isinstance(value, tuple):
        return tuple(with_values(item, asset, variant) for item in value)
    if isinstance(value, dict):
        return {key: with_values(item, asset, variant) for key, item in value.items()}
    return value


def has_placeholder(value: Any) -> bool:
    """Whether some text of a step's values holds `{`: what it says is known for a job alone."""
    if isinstance(value, dict):
        return any(map(has_placeholder, value.values()))
    if isinstance(value, tuple | list):
        return any(map(has_placeholder, value))
    return "{" in str(value) if isinstance(value, str | Path) else False
