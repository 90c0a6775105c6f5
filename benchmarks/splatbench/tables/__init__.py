"""Tables: which cases each asks, how an answer is scored, and how the table is laid out.

keys(setup)               the cases by name, cheap: nothing is rendered yet
make(key, setup)          one case, with its ground truth; slow, and kept on disk by the runner
score(case, results, ..)  figures of one method's answers
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from splatbench.cases import Case, CaseKey, Setup
from splatbench.methods import EditResult

MODULES = {
    "refine": "local_refinement",
    "relight": "relighting",
    "creative": "creative_editing",
    "compress": "compression",
    "sequence": "sequential_edits",
    "ablate": "ablation",
}
"""Name of a table, as the command line, its folder and its records have it -> file of this folder, which has it as
TABLE."""
NAMES = tuple(MODULES)


@dataclass(frozen=True)
class Column:
    """One figure of a table."""

    key: str
    """Key in `score`'s answer."""
    label: str
    """Heading above the column, e.g. "PSNR"."""
    group: str = ""
    """Heading above several columns, e.g. "Edited region"."""
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


def beside_truth(case: Case, results: Sequence[EditResult], view: int) -> dict[str, Any]:
    """BenchTable.pictures of one novel view: the last answer beside its truth."""
    from splatbench.scoring import rendered

    truth = case.after.take([view])
    return {"result": rendered(results[-1].splats, truth.cameras)[0], "truth": truth.colors[0]}


class BenchTable(Protocol):
    """What the files of this folder have."""

    name: str
    title: str
    """One line, with the table's number in the paper."""
    columns: tuple[Column, ...]
    """Without seconds, memory and rows, which every table has."""
    split_by: str
    """Name of a fact of cases (Case.facts) by which the table has a block of rows or columns each, e.g. "views"; "":
    all cases together."""

    def keys(self, setup: Setup) -> list[CaseKey]:
        """The cases, in order. Raises ValueError for data that gives none; fewer than asked is said in notes."""
        ...

    def make(self, key: CaseKey, setup: Setup) -> Case:
        """Raises ValueError where this object cannot be used (a line that names it)."""
        ...

    def score(self, case: Case, results: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        """Column key -> figure, also further keys for plots; None: does not apply. results: one per step of the case.
        perceptual: an LPIPS-Alex (metrics.lpips), or None: those figures are None."""
        ...

    def pictures(self, case: Case, results: Sequence[EditResult]) -> dict[str, Any]:
        """Label -> [H, W, 3] float picture: what the sheet shows of this answer, "result" first; the runner adds the
        input, the truth and the error map (label "truth" -> what to compare "result" with)."""
        ...


def table(name: str) -> BenchTable:
    """The table of a name of NAMES."""
    return import_module(f"{__name__}.{MODULES[name]}").TABLE
