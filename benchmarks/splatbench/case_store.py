"""Cases on disk: whether one is there as the setup wants it, and keeping one that was made. Makes none.

OUT/PROTOCOL/cases/LABEL/      case.json, case.npz, input.png, before.png, truth.png, and stamp.json, written last
OUT/PROTOCOL/failed/LABEL.json what could not be made, and why; tried again by the next run
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from splatbench import cases
from splatbench.cases import Case
from splatbench.objects import safe
from splatbench.tables import Key, Setup
from splatpainter.cameras import write_png
from splatpainter.io import files

STAMP = "stamp.json"


def case_folder(out: Path, protocol: str, label: str) -> Path:
    return out / protocol / "cases" / label


def stamp(protocol: str, key: Key, setup: Setup) -> str:
    """16 hex digits that change whenever the case may: protocol, key, setup, and the files that it is made from.

    Folders count by what is in them, not by where they are, so that machines that share a stock may keep their data
    in different places; of the objects only the case's own files count, so that a grown folder, or asking for more
    objects, makes no case anew."""
    own: dict[str, Any] = asdict(setup)
    own.pop("objects")
    for folder in ("environments", "decals", "fonts", "textures"):
        own[folder] = _digest(_listing(own[folder]))
    everything = _listing(own["data"])
    mine = [line for line in everything if key.name in _names(line[0])]
    own["data"] = _digest(mine or everything)
    told = {"version": cases.VERSION, "protocol": protocol, "setup": own, "key": asdict(key)}
    return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:16]


def is_made(folder: Path, wanted: str) -> bool:
    """Whether the folder holds the whole case of this stamp."""
    try:
        told = json.loads((folder / STAMP).read_bytes())
        return told["stamp"] == wanted and (folder / "case.json").is_file() and (folder / "case.npz").is_file()
    except (OSError, ValueError, KeyError, TypeError):
        return False


def keep(case: Case, out: Path, wanted: str, shown: dict[str, Any]) -> None:
    """Write a case and its pictures; the stamp comes last, so that what was interrupted counts as not made.

    shown: Table.pictures of the unedited asset: "result", and "truth" where the protocol says what to compare it with;
    otherwise the truth is the `telling_view`."""
    folder = case_folder(out, case.protocol, case.label)
    (folder / STAMP).unlink(missing_ok=True)
    case.save(folder)
    write_png(folder / "input.png", case.steps[-1].edited.colors[0])
    write_png(folder / "before.png", np.asarray(shown["result"]))
    place = telling_view(case)
    if "truth" in shown:
        write_png(folder / "truth.png", np.asarray(shown["truth"]))
    elif place is not None:
        write_png(folder / "truth.png", case.after.colors[place])
    _failure(out, case.protocol, case.label).unlink(missing_ok=True)
    with files.writing(folder / STAMP) as file:
        file.write(json.dumps({"stamp": wanted, "name": case.name, "facts": case.facts}, indent=1).encode())


def telling_view(case: Case) -> int | None:
    """The novel view that shows most of the edit: largest change of its truth, among those near the edit where there
    are any; None without novel views."""
    if not len(case.after):
        return None
    change = np.abs(case.after.colors - case.before.colors).sum((1, 2, 3))
    return int(np.argmax(np.where(case.near, change, -1.0) if case.near.any() else change))


def about(out: Path, protocol: str, label: str) -> tuple[str, dict[str, Any]]:
    """(name of the object, facts) of a case that `is_made`, without reading its pictures."""
    told = json.loads((case_folder(out, protocol, label) / STAMP).read_bytes())
    return told["name"], told["facts"]


def digest(out: Path, protocol: str, label: str) -> str:
    """Of a case that `is_made`: 16 hex digits, as Case.digest."""
    return Case.digest(case_folder(out, protocol, label))


def fail(out: Path, protocol: str, label: str, name: str, reason: str) -> None:
    """Note that a case could not be made."""
    path = _failure(out, protocol, label)
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.writing(path) as file:
        file.write(json.dumps({"name": name, "reason": reason}, indent=1).encode())


def failures(out: Path, protocol: str, labels: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Label -> (name of the object, reason) of those that could not be made."""
    found = {}
    for label in labels:
        try:
            told = json.loads(_failure(out, protocol, label).read_bytes())
            found[label] = (str(told["name"]), str(told["reason"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return found


def _failure(out: Path, protocol: str, label: str) -> Path:
    return out / protocol / "failed" / f"{label}.json"


@lru_cache(maxsize=16)
def _listing(folder: Path | None) -> tuple[tuple[str, int], ...]:
    """(relative name, bytes) of every file below a folder; once per process."""
    if folder is None:
        return ()
    listed = [file for file in Path(folder).rglob("*") if file.is_file()]
    return tuple(sorted((file.relative_to(folder).as_posix(), file.stat().st_size) for file in listed))


def _names(file: str) -> tuple[str, ...]:
    """What an object in this file (relative) may be called."""
    path = Path(file)
    whole = path.with_suffix("").as_posix()
    return whole, safe(whole), path.name, safe(path.name)


def _digest(listing: Iterable[tuple[str, int]]) -> str:
    return hashlib.sha256("\n".join(f"{size} {name}" for name, size in listing).encode()).hexdigest()[:16]
