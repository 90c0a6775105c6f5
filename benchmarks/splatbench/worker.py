"""The process of one method, and the one that makes cases: a job on stdin, cases one after the other, a line for each.

`make`: {"task", "protocol", "setup", "out", "items": [{"label", "name", "settings", "stamp"}]}
`edit`: {"task", "protocol", "method", "version", "budget", "out", "perceptual", "machine", "items": [{"label",
        "name", "fingerprint", "facts"}]}

Answers as process.py says. What fails is said in the record (edit) or in the answer (make), and the next case begins.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatbench import case_store as stock
from splatbench import methods
from splatbench import tables as protocols
from splatbench.cases import Case
from splatbench.methods import Budget, Done, Method, Work
from splatbench.process import answer_jobs, forget_peak, one_line, peak_mib
from splatbench.records import Record
from splatbench.tables import Key, Setup, Table
from splatpainter.cameras import write_png
from splatpainter.splats import Splats, rows_sha256

SETUP_PATHS = ("data", "environments", "decals", "fonts", "textures")
BUDGET_PATHS = ("adapters", "scratch")


def main(ready: Callable[[], None] | None = None) -> None:
    """Do the job on stdin. ready: called before the first edit, so that no method pays for loading what all share."""

    def begin(job: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
        if job["task"] == "make":
            return _maker(job)
        (load_kernels if ready is None else ready)()
        return _editor(job)

    answer_jobs(begin)


def load_kernels() -> None:
    """Load the compiled kernels of the renderer and the lift."""
    from splatpainter.kernels.compile import run_group

    run_group(0, 1)


def to_json(value: Setup | Budget) -> dict[str, Any]:
    """A setup or a budget as JSON values; paths become absolute."""
    told = dataclasses.asdict(value)
    return {k: str(v.absolute()) if isinstance(v, Path) else v for k, v in told.items()}


def setup_from(told: dict[str, Any]) -> Setup:
    return Setup(**_with_paths(told, SETUP_PATHS))


def budget_from(told: dict[str, Any]) -> Budget:
    return Budget(**_with_paths(told, BUDGET_PATHS))


def _with_paths(told: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    return {k: Path(v) if k in names and v is not None else v for k, v in told.items()}


def _maker(job: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
    table, setup, out = protocols.table(job["protocol"]), setup_from(job["setup"]), Path(job["out"])

    def make(item: dict[str, Any]) -> str:
        try:
            case = table.make(Key(item["label"], item["name"], item["settings"]), setup)
            unedited = [Done(case.asset, 0.0, 0.0)] * len(case.steps)
            stock.keep(case, out, item["stamp"], table.pictures(case, unedited))
        except Exception as error:
            _log(item["label"])
            return one_line(error)
        return ""

    return make


def _editor(job: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
    table, budget, out = protocols.table(job["protocol"]), budget_from(job["budget"]), Path(job["out"])
    method = methods.all_methods()[job["method"]]
    perceptual = None
    if job["perceptual"] is not None:
        from splatpainter.metrics import Lpips

        perceptual = Lpips.load("alex", job["perceptual"])
    machine = job["machine"] + _gpu(budget)

    def edit(item: dict[str, Any]) -> str:
        record = Record(
            protocol=job["protocol"],
            method=method.name,
            label=item["label"],
            name=item["name"],
            fingerprint=item["fingerprint"],
            facts=item["facts"],
            machine=machine,
        )
        folder = out / job["protocol"] / "records" / method.name
        folder.mkdir(parents=True, exist_ok=True)
        try:
            if method.version(budget) != job["version"]:
                raise ValueError(f"{method.name}: its weights or settings changed since the run began; start it again")
            case = Case.load(stock.case_folder(out, job["protocol"], item["label"]))
            done, peak = edited(case, method, budget)
            record = measured(record, table, case, done, perceptual, peak)
            write_png(folder / f"{item['label']}.png", np.asarray(table.pictures(case, done)["result"]))
        except Exception as error:
            _log(item["label"])
            record = dataclasses.replace(record, error=one_line(error), figures={}, curve=[])
        record.write(folder / f"{item['label']}.json")
        return record.error

    return edit


def edited(case: Case, method: Method, budget: Budget) -> tuple[list[Done], float]:
    """(what the method made of each step, each begun from the one before, peak memory in MiB meanwhile or NaN).

    Raises what the method raises, and ValueError where it wrote into the asset that it was given."""
    forget_peak()  # scoring the case before is not the method's
    done: list[Done] = []
    asset, memory = case.asset, None
    for step in case.steps:
        before = rows_sha256(asset)
        work = Work(case.protocol, asset, case.base, step, case.oracle if method.oracle else None, memory)
        made = method.edit(work, budget)
        if rows_sha256(asset) != before:
            raise ValueError(f"{method.name}: wrote into the asset that it was given; its answer cannot be compared")
        made = dataclasses.replace(made, splats=made.splats.numpy())
        done.append(made)
        asset, memory = made.splats, made.memory
    return done, peak_mib()


def measured(
    record: Record, table: Table, case: Case, done: Sequence[Done], perceptual: Any | None, peak: float
) -> Record:
    """The record with all its figures. Seconds of set-up and of edits are sums over the steps."""
    keeps = all(one.keeps_rows for one in done)
    last = done[-1]
    numbers = {key: value for one in done for key, value in one.numbers.items()}
    points = []
    for seconds, steps, splats in last.curve:
        then = [*done[:-1], dataclasses.replace(last, splats=splats.numpy(), curve=())]
        points.append({"seconds": seconds, "steps": steps, **_figures(table.score(case, then, perceptual))})
    return dataclasses.replace(
        record,
        figures=_figures(table.score(case, done, perceptual)),
        setup_seconds=sum(one.setup_seconds for one in done),
        edit_seconds=sum(one.edit_seconds for one in done),
        peak_mib=None if math.isnan(peak) else peak,
        rows=len(last.splats),
        rows_equal=equal_rows(case.asset, last.splats) if keeps else None,
        appended=len(last.splats) - len(case.asset) if keeps else None,
        numbers={key: float(value) for key, value in numbers.items()},
        note="; ".join(dict.fromkeys(one.note for one in done if one.note)),
        curve=points,
    )


def equal_rows(before: Splats, after: Splats) -> float:
    """Share of the rows of `before` whose every attribute kept its bits in the same row of `after`, which has at least
    as many. Raises ValueError where it has fewer."""
    if len(after) < len(before):
        raise ValueError(f"rows equal: an answer that keeps rows has {len(after)} of the asset's {len(before)}")
    return 1.0 - float(methods.changed(before, after).mean()) if len(before) else 1.0


def _figures(told: dict[str, float | None]) -> dict[str, float | None]:
    """NaN becomes None: there is no number."""
    return {k: None if v is None or math.isnan(v) else float(v) for k, v in told.items()}


def _gpu(budget: Budget) -> str:
    if budget.device != "cuda":
        return ""
    import torch

    return f"; {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""


def _log(label: str) -> None:
    print(f"{label}:", file=sys.stderr)
    traceback.print_exc()


if __name__ == "__main__":
    main()
