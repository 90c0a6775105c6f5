"""What a JOBS.yaml says: one tree of dataclasses, the only definition of the format. Paths are relative to the file.

Texts and file names of edits may hold `{asset}` (the asset's name) and `{variant}`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from splatpainter.gatekeeper.gatekeeper import Strictness
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.operations.grade import hex_color, one_look
from splatpainter.operations.region import check_terms
from splatpainter.painter import Method, Mode
from splatpainter.splats import Frame

FILE = {"file": True}
"""Metadata of fields that name files."""
NAME = re.compile(r"[\w][\w .+-]{0,99}")
"""Names of variants: they become parts of file names."""
MIN_PREVIEW_PX, MAX_PREVIEW_PX = 32, 2048


@dataclass(frozen=True)
class PicturesEdit:
    """Edited pictures, as `splatpainter edit ASSET VIEW.png ...`."""

    files: tuple[str, ...] = field(metadata=FILE)
    """1 to 16 pictures."""
    cameras: tuple[str, ...] = field(default=(), metadata=FILE)
    """Theirs, where they lost them."""
    masks: tuple[str, ...] = field(default=(), metadata=FILE)
    mode: Mode = "local"
    method: Method = "auto"
    preset: str = "auto"
    angle_limit: float = LOCAL_DEFAULTS.angle_limit
    depth_edge_limit: float = LOCAL_DEFAULTS.depth_edge_limit


@dataclass(frozen=True)
class DecalEdit:
    """A picture or words laid on the surface, as `splatpainter edit ASSET --decal ...`."""

    camera: str = field(metadata=FILE)
    at: tuple[float, float]
    """Pixel of the camera's picture."""
    width: Any
    """World units, or like 20%."""
    picture: str = field(default="", metadata=FILE)
    text: str = ""
    font: str = field(default="", metadata=FILE)
    color: str = "#202020"
    angle: float = 0.0
    wrap: float = 180.0
    method: Method = "auto"

    def __post_init__(self) -> None:
        if bool(self.picture) == bool(self.text):
            raise ValueError("expected picture or text")
        if isinstance(self.width, bool) or not isinstance(self.width, str | int | float):
            raise ValueError(f"expected width as a number or like 20%, got {self.width!r:.40}")


@dataclass(frozen=True)
class GradeEdit:
    """New colours, as `splatpainter grade`."""

    exposure: float = 0.0
    temperature: float = 0.0
    tint: float = 0.0
    contrast: float = 0.0
    saturation: float = 0.0
    hue: float = 0.0
    look: str = field(default="", metadata=FILE)
    lut: str = field(default="", metadata=FILE)
    match: str = field(default="", metadata=FILE)
    recolor: str = ""
    strength: float = 1.0
    where: tuple[str, ...] = ()
    """Terms of `--where`; masks and projects by paths relative to the file."""

    def __post_init__(self) -> None:
        one_look(vars(self))
        if self.recolor and "{" not in self.recolor:
            hex_color(self.recolor)
        if not 0 < self.strength <= 1:
            raise ValueError(f"expected strength above 0, up to 1, got {self.strength:g}")
        check_terms(self.where)


@dataclass(frozen=True)
class SourceStep:
    """Pictures that a source makes, as `splatpainter edit --source`."""

    name: str
    prompt: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    """Options as of `--source-option`. A value that names a file beside the jobs file is that file."""
    view: str = field(default="", metadata=FILE)
    """Camera of the view that is sent; without it azimuth and elevation."""
    azimuth: float | None = None
    elevation: float | None = None
    size: int | None = None
    views: Literal["", "auto"] = ""
    max_views: int | None = None
    mask: str = field(default="", metadata=FILE)
    references: tuple[str, ...] = field(default=(), metadata=FILE)
    seed: int | None = None
    enlarge: int = 1
    strictness: Strictness = "normal"
    mode: Mode = "local"
    method: Method = "auto"

    def __post_init__(self) -> None:
        for key, value in self.options.items():
            if not isinstance(value, str | int | float):
                raise ValueError(f"expected text or a number as the option {key!r:.40}")


@dataclass(frozen=True)
class RefineEdit:
    """Views enlarged and their detail put onto the asset, as `splatpainter refine`."""

    views: tuple[str, ...] = field(metadata=FILE)
    """1 to 16 cameras."""
    upscale: str = field(default="", metadata=FILE)
    """A super-resolution model."""
    scale: Literal[1, 2, 4] | None = None
    """None: 2, or 1 of sources that do not enlarge."""
    name: str = "upscale"
    """Another source."""
    options: dict[str, Any] = field(default_factory=dict)
    prompt: str = ""
    size: int | None = None
    method: Literal["lift", "fit"] = "lift"


@dataclass(frozen=True)
class LayersEdit:
    """The visible layers of a project, painted anew on the asset from the same cameras."""

    project: str = field(metadata=FILE)
    only: tuple[str, ...] = ()
    """Names of layers; none: all."""
    asset: str = ""
    """Asset of a project with several: the name of the one whose layers are meant, or its number ("1": the first)."""


@dataclass(frozen=True)
class JobEdit:
    """One step of a job: exactly one of these."""

    pictures: PicturesEdit | None = None
    decal: DecalEdit | None = None
    grade: GradeEdit | None = None
    source: SourceStep | None = None
    refine: RefineEdit | None = None
    layers: LayersEdit | None = None

    def __post_init__(self) -> None:
        given = [entry.name for entry in fields(self) if getattr(self, entry.name) is not None]
        if len(given) != 1:
            names = ", ".join(entry.name for entry in fields(self))
            raise ValueError(f"expected one of {names}, got {' and '.join(given) or 'none'}")

    @property
    def kind(self) -> str:
        return next(entry.name for entry in fields(self) if getattr(self, entry.name) is not None)

    @property
    def step(self) -> Any:
        return getattr(self, self.kind)


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
    frame: Frame = "auto"
    """Axes of the assets' numbers, as `--frame`."""
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
            names = (value,) if isinstance(value, str) else value
            out[entry.name] = tuple(name for name in names if name)
    return out


def with_values(value: Any, asset: str, variant: str) -> Any:
    """A step's texts with `{asset}` and `{variant}` written out."""
    if isinstance(value, str):
        return value.replace("{asset}", asset).replace("{variant}", variant)
    if isinstance(value, tuple):
        return tuple(with_values(item, asset, variant) for item in value)
    if isinstance(value, dict):
        return {key: with_values(item, asset, variant) for key, item in value.items()}
    return value
