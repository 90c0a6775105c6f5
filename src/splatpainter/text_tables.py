"""Tables as CSV and Markdown; a row is a dataclass or a mapping. Knows nothing of what they mean."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from splatpainter.system.atomic import write_text


def columns(row: Any) -> list[str]:
    """Names of the columns, in order. row: a mapping, or a dataclass or its instance."""
    return list(row) if isinstance(row, Mapping) else [field.name for field in fields(row)]


def write_csv(path: Path, rows: Sequence[Any], heading: str) -> None:
    """Numbers in full; None and infinities as nothing and inf; `heading` as a comment in the first line."""
    text = io.StringIO()
    text.write(f"# {heading}\n")
    table = csv.writer(text, lineterminator="\n")
    if rows:
        table.writerow(columns(rows[0]))
    for row in rows:
        table.writerow(["" if value is None else value for value in _values(row)])
    write_text(path, text.getvalue())


def write_markdown(path: Path, rows: Sequence[Any], heading: str, notes: Sequence[str] = ()) -> None:
    """A table for people, `heading` above it and `notes` below."""
    write_text(path, "\n\n".join([heading, markdown(rows), *notes]) + "\n")


def markdown(rows: Sequence[Any]) -> str:
    """Numbers to three significant digits, None as a dash."""
    if not rows:
        return "(nothing was measured)"
    names = columns(rows[0])
    cells = [_values(row) for row in rows]
    numeric = [any(isinstance(value, (int, float)) for value in column) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(name.replace("_", " ") for name in names) + " |",
        "|" + "|".join("---:" if right else "---" for right in numeric) + "|",
    ]
    lines += ["| " + " | ".join(cell_text(value) for value in row) + " |" for row in cells]
    return "\n".join(lines)


def cell_text(value: Any) -> str:
    """A cell for people."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "–" if math.isnan(value) else "inf"
        digits = 2 - math.floor(math.log10(abs(value))) if value else 0
        return f"{value:,.{min(max(digits, 0), 5)}f}"
    return str(value).replace("|", "/")


def _values(row: Any) -> list[Any]:
    return list(row.values()) if isinstance(row, Mapping) else [getattr(row, name) for name in columns(row)]
