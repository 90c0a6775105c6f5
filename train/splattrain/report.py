"""What a run leaves for people: figures of pictures, a table of its steps, TensorBoard events, and sheets of pictures.

The table survives restarts: rows after the step that a run goes on from are dropped first. Knows no model.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatpainter.io.files import writing
from splatpainter.metrics import ssim
from splatpainter.metrics.lpips import MIN_SIDE_PX as LPIPS_MIN_PX
from splatpainter.metrics.lpips import Lpips, LpipsUnavailable
from splattrain.loss import PictureTarget, masked_psnr

SHEET_CELL_PX = 160
"""Edge of a picture of a sheet."""
SSIM_WINDOW_PX = 11


class StepTable:
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


def alex_or_none(folder: str | Path | None, device: torch.device | str = "cpu") -> Lpips | None:
    """The network of reports, or None where its weights are not there."""
    try:
        return Lpips.load("alex", folder).to(device)
    except LpipsUnavailable:
        return None


@torch.no_grad()
def figures(name: str, rendered: Tensor, target: PictureTarget, alex: Lpips | None) -> dict[str, float]:
    """{name: PSNR in dB, "name SSIM": , "name LPIPS-Alex": } of rendered [C, H, W, 3] over wanted.focus: PSNR over all
    of its pixels together, the others as means of the views that have some. Those that do not apply are left out."""
    value = masked_psnr(rendered, target)
    if value is None:
        return {}
    values = {name: value}
    pictures, truth = rendered.clamp(0, 1).float(), target.colors.float()
    some = [i for i in range(len(pictures)) if bool(target.focus[i].any())]
    if min(pictures.shape[1:3]) >= SSIM_WINDOW_PX:
        trios = ((x[i].cpu().numpy() for x in (pictures, truth, target.focus)) for i in some)
        values[f"{name} SSIM"] = float(np.mean([ssim(*trio) for trio in trios]))
    if alex is not None and min(pictures.shape[1:3]) >= LPIPS_MIN_PX:
        a, b = (x[some].permute(0, 3, 1, 2) for x in (pictures, truth))
        mask = target.focus[some][:, None].float()
        # A small edit may lie between the pixels of the last taps.
        values[f"{name} LPIPS-Alex"] = float(alex(a, b, mask + 1e-6).mean())
    return values
