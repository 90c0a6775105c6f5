"""What came out of one method on one case: a JSON file each, so that an interrupted run goes on where it was.

OUT/PROTOCOL/cases/LABEL/            case.json, case.npz (cases.py), input.png, truth.png
OUT/PROTOCOL/records/METHOD/LABEL.json, LABEL.png
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from splatpainter.io import files


@dataclass(frozen=True)
class Record:
    """One method on one case."""

    protocol: str
    method: str
    label: str
    """Of the case."""
    name: str
    """Of the object."""
    fingerprint: str
    """Of case, method and budget: a record with another one is out of date."""
    error: str = ""
    """Why there are no figures: what the method raised, or how its process ended. "": it worked."""
    missing: str = ""
    """Why the method cannot run on this machine ("not installed: ..."); then there are no figures either."""
    figures: dict[str, float | None] = field(default_factory=dict)
    """Column key -> figure."""
    setup_seconds: float | None = None
    edit_seconds: float | None = None
    peak_mib: float | None = None
    """Largest resident memory of the method's process in this case; where the system cannot forget peaks, so far."""
    rows: int | None = None
    """Of the edited asset."""
    rows_equal: float | None = None
    """Share of the asset's rows that kept their bits, 0..1; None for methods that make a new asset."""
    appended: int | None = None
    numbers: dict[str, float] = field(default_factory=dict)
    note: str = ""
    curve: list[dict[str, float | None]] = field(default_factory=list)
    """Points of quality against time: {"seconds", "steps", column keys ...}."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Of the case."""
    machine: str = ""

    @property
    def whole(self) -> bool:
        """Whether it has figures."""
        return not self.error and not self.missing

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.writing(path) as file:
            file.write(json.dumps(asdict(self), indent=1).encode())

    @staticmethod
    def read(path: Path) -> Record:
        """Raises ValueError for a file that is no record."""
        try:
            told = json.loads(files.read_all(path))
            return Record(**{f.name: told[f.name] for f in fields(Record)})
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a record as `splatpainter bench` writes it ({error})") from None


def records(folder: Path) -> Iterator[Record]:
    """All records below OUT/PROTOCOL, by method and label."""
    for path in sorted((folder / "records").glob("*/*.json")):
        yield Record.read(path)
