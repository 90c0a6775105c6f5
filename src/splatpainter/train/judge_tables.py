"""What `train judge` found, as files and as words: tables for people, a contact sheet, and the goals with what was
reached of them. The figures are made in train/judge.py."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from splatpainter.contact_sheet import Strip, sheet, write_sheet
from splatpainter.text_tables import markdown, write_csv, write_markdown
from splatpainter.train.judge import COPY, CopyRow, EditRow, Finding, sheet_strips
from splatpainter.train.report import SHEET_CELL_PX
from splatpainter.train.trials import MANY_VIEWS

Rows: TypeAlias = Sequence[EditRow] | Sequence[CopyRow]
LOCAL_GOAL, RELIGHT_GOAL, COPY_GOAL = 0.5, 1.0, 0.3
"""dB: gain over the lift near local edits; in relighting at each number of views; loss by Stage I."""


@dataclass(frozen=True)
class _Edits:
    """EditRow for people."""

    edit: str
    views: str
    samples: int
    objects: int
    nothing_dB: str
    lift_dB: str
    ours_dB: str
    gain_dB: str
    interval: str
    SSIM: str
    LPIPS: str


@dataclass(frozen=True)
class _Copies:
    """CopyRow for people."""

    what: str
    samples: int
    objects: int
    dB: str
    compared_with: str
    its_dB: str
    difference_dB: str
    interval: str


def table(rows: Rows) -> str:
    """Markdown: PSNR to 0.01 dB, SSIM and LPIPS as nothing / lift / ours."""
    return markdown([_edits(row) if isinstance(row, EditRow) else _copies(row) for row in rows])


def write(folder: Path, rows: Rows, findings: Sequence[Finding], heading: str, notes: Sequence[str]) -> list[Path]:
    """judged.csv (numbers in full), judged.md and judged.png in the folder; the paths. Raises ValueError where it
    cannot be written."""
    paths = [folder / f"judged.{ending}" for ending in ("csv", "md", "png")]
    write_csv(paths[0], rows, heading)
    shown = [_edits(row) if isinstance(row, EditRow) else _copies(row) for row in rows]
    write_markdown(paths[1], shown, heading, notes)
    strips = [strip for strip in sheet_strips(findings) if strip]
    if not strips:
        return paths[:2]
    write_sheet(paths[2], sheet([Strip("", tuple(strip)) for strip in strips], SHEET_CELL_PX))
    return paths


def goals(rows: Rows) -> list[str]:
    """One line per goal that the rows say something about: what was wanted, what came, reached or missed."""
    lines = []
    edits = [row for row in rows if isinstance(row, EditRow)]
    for row in edits:
        if row.kind == "local":
            lines.append(_line("local edits, novel views near the edit", LOCAL_GOAL, row.gain))
    relit = [row for row in edits if row.kind == MANY_VIEWS]
    lines += [_line(f"relighting from {_views(row.views)}", RELIGHT_GOAL, row.gain) for row in relit]
    if len(relit) > 1:
        ours = [row.ours for row in relit]
        rising = all(a < b for a, b in zip(ours, ours[1:], strict=False))
        shown = ", ".join(f"{value:.2f}" for value in ours)
        lines.append(f"relighting rises with the views: {shown} dB: {'reached' if rising else 'missed'}")
    for row in rows:
        if isinstance(row, CopyRow) and row.what == COPY:
            met = "reached" if row.difference >= -COPY_GOAL else "missed"
            lines.append(f"Stage I within {COPY_GOAL} dB of the LRM: {row.difference:+.2f} dB: {met}")
    return lines


def weak_kinds(rows: Rows) -> tuple[list[str], list[str]]:
    """(kinds on which ours is below the lift, kinds whose interval holds 0 with ours above it)."""
    kinds = [row for row in rows if isinstance(row, EditRow) and row.kind not in ("local", "global")]
    below = [row for row in kinds if row.gain <= 0]
    unsure = [row for row in kinds if row.gain > 0 and (row.gain_low is None or row.gain_low <= 0)]
    return [_name(row) for row in below], [_name(row) for row in unsure]


def plain(rows: Rows) -> list[dict[str, object]]:
    """JSON values, as checkpoints keep them in their notes."""
    return [dataclasses.asdict(row) for row in rows]


def rows_of(records: Sequence[dict[str, object]]) -> Rows:
    """The rows that `plain` made values of. Raises ValueError for other values."""
    try:
        if records and "what" in records[0]:
            return [CopyRow(**record) for record in records]  # type: ignore[arg-type]
        return [EditRow(**record) for record in records]  # type: ignore[arg-type]
    except TypeError as error:
        raise ValueError(f"notes: expected rows as train judge writes them ({error}); judge the model again") from None


def _edits(row: EditRow) -> _Edits:
    return _Edits(
        edit=row.kind if row.kind not in ("local", "global") else f"all {row.kind}",
        views="all" if row.views is None else str(row.views),
        samples=row.samples,
        objects=row.objects,
        nothing_dB=f"{row.nothing:.2f}",
        lift_dB=f"{row.lift:.2f}",
        ours_dB=f"{row.ours:.2f}",
        gain_dB=f"{row.gain:+.2f}",
        interval=_range(row.gain_low, row.gain_high),
        SSIM=_trio(row.nothing_ssim, row.lift_ssim, row.ours_ssim),
        LPIPS=_trio(row.nothing_lpips, row.lift_lpips, row.ours_lpips),
    )


def _copies(row: CopyRow) -> _Copies:
    difference = f"{row.difference:+.2f}", _range(row.difference_low, row.difference_high)
    psnr = f"{row.ours:.2f}", row.reference, f"{row.reference_psnr:.2f}"
    return _Copies(row.what, row.samples, row.objects, *psnr, *difference)


def _range(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{low:+.2f} to {high:+.2f}"


def _trio(*values: float | None) -> str:
    return "–" if any(v is None for v in values) else " / ".join(f"{v:.3f}" for v in values)


def _line(what: str, goal: float, gain: float) -> str:
    return f"{what}: wanted lift {goal:+.1f} dB, got {gain:+.2f} dB: {'reached' if gain >= goal else 'missed'}"


def _views(count: int | None) -> str:
    return "its views" if count is None else "1 view" if count == 1 else f"{count} views"


def _name(row: EditRow) -> str:
    return row.kind if row.views is None else f"{row.kind} from {_views(row.views)}"
