"""Small made-up runs of `splatpainter bench` on disk, for the tests of the report: no figure here was measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from splatbench.cases import Record
from splatbench.tables import Column

from splatpainter.image_files import write_png

COLUMNS = (
    Column("psnr", "PSNR", "", "higher"),
    Column("ssim", "SSIM", "", "higher", 4),
    Column("lpips", "LPIPS", "", "lower", 4),
)


@dataclass(frozen=True)
class FakeTable:
    title: str = "Made up (Tab. 1)"
    columns: tuple[Column, ...] = COLUMNS
    split_by: str = ""


@dataclass(frozen=True)
class FakeMethod:
    label: str
    sees_truth: bool = False


METHODS = {
    "nothing": FakeMethod("Asset as it is"),
    "lift": FakeMethod("Ours (lift)"),
    "ttt": FakeMethod("Ours (TTT)"),
    "3dgs": FakeMethod("3DGS"),
    "oracle": FakeMethod("Oracle", sees_truth=True),
    "voxhammer": FakeMethod("VoxHammer"),
}


def record(method: str, name: str, psnr: float | None = None, **more: Any) -> Record:
    """Of one case of an object; figures from psnr where there is one."""
    figures = {} if psnr is None else {"psnr": psnr, "ssim": psnr / 50, "lpips": 1 - psnr / 50}
    values: dict[str, Any] = {"protocol": "refine", "method": method, "label": name, "name": name, "fingerprint": "f"}
    if psnr is not None:
        values |= {"setup_seconds": 0.0, "edit_seconds": 1.0, "rows": 100, "peak_mib": 64.0}
    return Record(**values | {"figures": figures, "machine": "two cores; load 0.5 at the start"} | more)


def write(folder: Path, records: Iterable[Record], size: int = 16, folders: dict[str, str] | None = None) -> Path:
    """Records with pictures of noise, cases with input, before and truth. folders: method -> folder, where not its
    name."""
    rng = np.random.default_rng(0)
    for r in records:
        case = folder / "cases" / r.label
        if not case.is_dir():
            case.mkdir(parents=True)
            for stem in ("input", "before", "truth"):
                write_png(case / f"{stem}.png", rng.random((size, size, 3)).astype(np.float32))
        home = folder / "records" / (folders or {}).get(r.method, r.method)
        r.write(home / f"{r.label}.json")
        if r.has_figures:
            write_png(home / f"{r.label}.png", rng.random((size, size, 3)).astype(np.float32))
    return folder


def plain_run(folder: Path) -> Path:
    """Three objects; every kind of row: instant, edited, with a curve, seeing the truth, failed once, not
    installed."""
    made = []
    for k, name in enumerate(("ant", "bee", "cat")):
        made.append(record("nothing", name, 15.0 + k, edit_seconds=0.0, rows_equal=1.0))
        made.append(record("lift", name, 18.0 + k, edit_seconds=0.3, rows_equal=0.75))
        made.append(record("ttt", name, 22.0 + k, setup_seconds=1.5, rows_equal=0.99999, note="eight views"))
        curve: list[dict[str, float | None]] = [
            {"seconds": 0.1 * steps, "steps": steps, "psnr": 15.0 + k + np.log10(steps), "ssim": 0.5, "lpips": None}
            for steps in (10, 30, 100)
        ]
        failed = {"psnr": None, "error": "ValueError: no splats left"} if name == "bee" else {"psnr": 19.0 + k}
        made.append(record("3dgs", name, **failed, **({} if name == "bee" else {"curve": curve, "edit_seconds": 30.0})))
        made.append(record("oracle", name, 30.0 + k, edit_seconds=60.0))
        made.append(record("voxhammer", name, missing="not installed: no path in the adapters' file"))
    return write(folder, made)
