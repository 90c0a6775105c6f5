"""Which objects no training sees: a share of them by a hash of their names, or a list of names from a file.

Runs note theirs in their checkpoints. What was trained on one split and measured or trained further on another would
show objects to a model that it is then judged on, so whoever reads a checkpoint asks `leak` first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatpainter.io.files import read_all
from splattrain.data.object_sources import HELD_OUT_SHARE, split

NOTE = "held_out"
"""Key of a checkpoint's notes, and of the records of the stages before it."""
MAX_LIST_BYTES = 16 << 20
"""Of a file of names."""


@dataclass(frozen=True)
class HeldOut:
    """A rule that splits objects by name."""

    share: float = HELD_OUT_SHARE
    """Share of the objects; counts where no names are given."""
    names: tuple[str, ...] = ()
    """The objects, by name."""

    @staticmethod
    def of_file(path: Path, option: str = "--names") -> HeldOut:
        """Names of a text file, one a line; empty lines and lines that begin with # do not count. Raises ValueError for
        a file without names, and for a name that stands there twice."""
        if not path.is_file():
            raise ValueError(f"{option} {path}: no such file; expected names of objects, one a line")
        if path.stat().st_size > MAX_LIST_BYTES:
            raise ValueError(f"{option} {path}: expected at most {MAX_LIST_BYTES} bytes")
        lines = [line.strip() for line in read_all(path).decode(errors="replace").splitlines()]
        names = [line for line in lines if line and not line.startswith("#")]
        if not names:
            raise ValueError(f"{option} {path}: holds no name; expected names of objects, one a line")
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"{option} {path}: {twice!r} stands there twice")
        return HeldOut(names=tuple(names))

    def split(self, names: Sequence[str], where: str = "data") -> tuple[list[str], list[str]]:
        """(objects to train on, objects held out), each in the given order. Raises ValueError where a name of the list
        is none of `names`: then the list is of other data, and nothing would be held out."""
        if not self.names:
            return split(names, share=self.share)
        listed, there = set(self.names), set(names)
        missing = [name for name in self.names if name not in there]
        if missing:
            raise ValueError(
                f"{where}: {len(missing)} of the {len(self.names)} objects of --names are not there, such as "
                f"{missing[0]!r}; expected names as `data list` prints them"
            )
        return [name for name in names if name not in listed], [name for name in names if name in listed]

    def note(self) -> dict[str, Any]:
        """JSON values for a checkpoint."""
        if not self.names:
            return {"share": self.share}
        return {"names": len(self.names), "sha256": self._digest()}

    def _digest(self) -> str:
        return hashlib.sha256("\n".join(sorted(self.names)).encode()).hexdigest()

    def leak(self, notes: Mapping[str, Any]) -> str:
        """Why weights with these notes may have been trained on objects that this rule holds out, in one clause; "" if
        they were not. Asks every stage that the notes tell of."""
        for record in (*notes.get("history", []), notes):
            if problem := self._leak_of(record):
                return f"stage {record.get('stage', '?')} {problem}"
        return ""

    def _leak_of(self, record: Mapping[str, Any]) -> str:
        noted = record.get(NOTE)
        if not isinstance(noted, dict):  # of an earlier version: the recipe alone says it
            noted = {"share": record.get("recipe", {}).get("validation_share", HELD_OUT_SHARE)}
        if "sha256" in noted:
            if self.names and noted["sha256"] == self._digest():
                return ""
            rule = f"{len(self.names)} others" if self.names else f"a share of {self.share:g}"
            return f"held out a list of {noted.get('names')} objects, here {rule} are held out; give its --names"
        share = float(noted.get("share", 0.0))
        if not self.names:  # shares are nested: a name below the smaller one is below the larger
            return "" if self.share <= share else f"held out a share of {share:g}, here {self.share:g} is held out"
        seen = len(split(self.names, share=share)[0]) if share > 0 else len(self.names)
        return f"held out a share of {share:g}: {seen} of the {len(self.names)} names were trained on" if seen else ""
