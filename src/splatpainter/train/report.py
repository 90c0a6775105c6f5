"""What a run leaves for people: a table of its steps, TensorBoard events, and sheets of pictures.

The table survives restarts: rows after the step that a run goes on from are dropped first. Knows no model.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io.files import writing

SHEET_CELL_PX = 160
"""Edge of a picture of a sheet."""


class Table:
    """A CSV file with a first column `step`, appended row by row. New columns go to the right."""

    def __init__(self, path: Path, step: int) -> None:
        """step: rows beyond it are of a run that was cut off, and are dropped."""
        self.path = path
        self.columns: list[str] = ["step"]
        rows: list[dict[str, str]] = []
        if path.is_file():
            with open(path, newline="", encoding="utf-8") as file:
                reader = csv.DictReader(file)
                self.columns = list(reader.fieldnames or ["step"])
                rows = [row for row in reader if (row.get("step") or "").isdigit() and int(row["step"]) <= step]
        self._write(rows)

    def add(self, step: int, values: dict[str, Any]) -> None:
        """One row. None becomes an empty cell."""
        if any(name not in self.columns for name in values):
            with open(self.path, newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
            self.columns += [name for name in values if name not in self.columns]
            self._write(rows)
        row = {"step": step, **{name: _cell(value) for name, value in values.items()}}
        with open(self.path, "a", newline="", encoding="utf-8") as file:
            csv.DictWriter(file, self.columns, restval="", lineterminator="\n").writerow(row)

    def _write(self, rows: Sequence[dict[str, Any]]) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, self.columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with writing(self.path) as file:
            file.write(text.getvalue().encode())


def _cell(value: Any) -> Any:
    # repr: the shortest text that gives the same float again, so that logs can be compared exactly.
    return "" if value is None else repr(value) if isinstance(value, float) else value


class Board:
    """TensorBoard events, or nothing where the package is not there."""

    def __init__(self, folder: Path, step: int) -> None:
        self._writer: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    def add(self, step: int, values: dict[str, Any], group: str) -> None:
        if self._writer is not None:
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    self._writer.add_scalar(f"{group}/{name}", value, step)

    def picture(self, step: int, name: str, picture: np.ndarray) -> None:
        """picture: [H, W, 3] uint8."""
        if self._writer is not None:
            self._writer.add_image(name, picture, step, dataformats="HWC")

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
