"""Tables: which cases each asks, how an answer is scored, and how the table is laid out.

keys(setup)            the cases by name, cheap: nothing is rendered yet
make(key, setup)       one case, with its ground truth; slow, and kept on disk by the runner
score(case, done, ..)  figures of one method's answers
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from splatbench.cases import Case
from splatbench.methods import Done

MODULES = {
    "refine": "local_refinement",
    "relight": "relighting",
    "creative": "creative_editing",
    "compress": "compression",
    "sequence": "sequential_edits",
    "ablate": "ablation",
}
"""Name of a table, as the command line, its folder and its records have it -> file of this folder, which has a function
`protocol() -> Table`."""
NAMES = tuple(MODULES)


@dataclass(frozen=True)
class Setup:
    """What all protocols are told: data, sizes, seed. Equal setups give equal cases."""

    data: Path | None = None
    """Folder of meshes (or, where a protocol takes them, of splat assets); None: procedural objects."""
    environments: Path | None = None
    """Folder of .hdr/.exr pictures; None: procedural light."""
    decals: Path | None = None
    fonts: Path | None = None
    textures: Path | None = None
    objects: int = 8
    """How many objects."""
    held_out: bool = True
    """Only objects that training never sees (data.scenes.split with its defaults); False: any."""
    size: int = 256
    """Pixels of every picture's edge; the paper: 512."""
    detail: int = 4
    """Zoom of close-ups: they are crops of pictures `detail` times larger (2K for the paper's 512)."""
    samples: int = 64
    """Paths per pixel of path traced truth."""
    truth: str = "traced"
    """"traced" (Mitsuba) or "surfels" (dense Gaussians, seconds instead of minutes; approximate light)."""
    base_views: int = 9
    rows: int = 30_000
    """Of assets that are built here."""
    asset_steps: int = 500
    """Optimisation steps in building an asset from its base views."""
    novel_views: int = 6
    lights: int = 3
    """Target environments per object in relighting; the paper: 24."""
    seed: int = 0


@dataclass(frozen=True)
class Key:
    """A case before it is made."""

    label: str
    """File-name safe, unique in its protocol."""
    name: str
    """Of the object."""
    settings: dict[str, Any]
    """JSON values that, with the setup, say everything about it."""


@dataclass(frozen=True)
class Column:
    """One figure of a table."""

    key: str
    """In `score`'s answer."""
    label: str
    """Above the column, e.g. "PSNR"."""
    group: str = ""
    """Above several columns, e.g. "Edited region"."""
    better: str = ""
    """"higher", "lower" or "" (neither)."""
    digits: int = 2


def measures(group: str = "", ending: str = "") -> tuple[Column, Column, Column]:
    """Columns of PSNR, SSIM and LPIPS; `ending`: of their keys."""
    return (
        Column(f"psnr{ending}", "PSNR", group, "higher"),
        Column(f"ssim{ending}", "SSIM", group, "higher", 4),
        Column(f"lpips{ending}", "LPIPS", group, "lower", 4),
    )


def view(case: Case, done: Sequence[Done], place: int) -> dict[str, Any]:
    """Table.pictures of one novel view: the last answer beside its truth."""
    from splatbench.scoring import drawn

    told = case.after.take([place])
    return {"result": drawn(done[-1].splats, told.cameras)[0], "truth": told.colors[0]}


class Table(Protocol):
    """A protocol."""

    name: str
    title: str
    """One line, with the table's number in the paper."""
    columns: tuple[Column, ...]
    """Without seconds, memory and rows, which every table has."""
    split_by: str
    """Name of a fact of cases (Case.facts) by which the table has a block of rows or columns each, e.g. "views"; "":
    all cases together."""

    def keys(self, setup: Setup) -> list[Key]:
        """The cases, in order. Raises ValueError for data that gives none; fewer than asked is said in notes."""
        ...

    def make(self, key: Key, setup: Setup) -> Case:
        """Raises ValueError where this object cannot be used (a line that names it)."""
        ...

    def score(self, case: Case, done: Sequence[Done], perceptual: Any | None) -> dict[str, float | None]:
        """Column key -> figure, also further keys for plots; None: does not apply. done: one per step of the case.
        perceptual: an LPIPS-Alex (metrics.lpips), or None: those figures are None."""
        ...

    def pictures(self, case: Case, done: Sequence[Done]) -> dict[str, Any]:
        """Label -> [H, W, 3] float picture: what the sheet shows of this answer, "result" first; the runner adds the
        input, the truth and the error map (label "truth" -> what to compare "result" with)."""
        ...


def table(name: str) -> Table:
    """The protocol of a name of NAMES."""
    return import_module(f"{__name__}.{MODULES[name]}").protocol()
