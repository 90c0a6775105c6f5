"""What a run left in OUT/PROTOCOL: the records that its table stands on, and the notes below it. Changes nothing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from splatbench.cases import Case
from splatbench.records import Record, records

ABOUT = "run.json"
"""Written by the runner at the end of a run."""


@dataclass(frozen=True)
class Run:
    """One protocol's results."""

    records: tuple[Record, ...]
    notes: tuple[str, ...] | None
    """Of the runner; None: it has not finished a run there."""


def read(folder: Path) -> Run:
    """Records of cases that the run asked for and that are still those on disk; all records before a first run has
    finished. Raises ValueError for files that are not the runner's."""
    found = tuple(records(folder))
    if not (folder / ABOUT).is_file():
        return Run(found, None)
    try:
        told = json.loads((folder / ABOUT).read_bytes())
        asked, notes = set(told["labels"]), tuple(str(note) for note in told["notes"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / ABOUT}: expected what `splatpainter bench` writes ({error!r})") from None
    digests = {label: _digest(folder / "cases" / label) for label in {r.label for r in found} & asked}
    kept = [r for r in found if r.label in asked and r.fingerprint.startswith(digests[r.label])]
    return Run(tuple(kept), notes)


def _digest(case: Path) -> str:
    """What fingerprints of answers to this case begin with; "" where the case itself is not here."""
    return Case.digest(case) if (case / "case.json").is_file() and (case / "case.npz").is_file() else ""
