"""Checking a project: structure, hashes, the original, and that replaying gives what is shown."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from splatpainter.receipts import changed_rows
from splatpainter.session.original import OriginalRule, restore
from splatpainter.session.replay import Painted, Replay
from splatpainter.splats import rows_sha256

if TYPE_CHECKING:
    from splatpainter.session.project import Project
    from splatpainter.session.reader import Shown


class _Stored:
    """Results as the file holds them, as far as they can be read; new ones are not kept. repaint: none are there."""

    def __init__(self, project: Project, repaint: bool) -> None:
        self._project, self._repaint = project, repaint

    def blob(self, sha256: str) -> bytes:
        return self._project.blob(sha256)

    def get(self, key: str) -> Painted | None:
        with contextlib.suppress(ValueError):
            return None if self._repaint else self._project.result(key)

    def put(self, key: str, painted: Painted) -> None:
        pass


def problems(project: Project, shown: Shown, replay: Replay, repaint: bool, rule: OriginalRule) -> list[str]:
    """What is wrong with a project, one line each; see Session.verify. rule: what may be opened as its original."""
    out = []
    try:
        found = [line for (line,) in project.rows("PRAGMA integrity_check")]
        out += [f"{project.path}: {line}" for line in found if line != "ok"]
    except ValueError as error:
        return [str(error)]
    names = project.rows("SELECT blob FROM layer_blobs UNION SELECT sha256 FROM blobs")
    keys = project.rows("SELECT key FROM results")
    for check, name in [*((project.blob, name) for (name,) in names), *((project.result, key) for (key,) in keys)]:
        try:
            check(name)
        except ValueError as error:
            out.append(str(error))
    try:
        original = restore(project, rule)
        fresh = Replay(original, replay.painter, _Stored(project, repaint), replay.looks)
        again = fresh.compose(shown.document).splats
        differs = changed_rows(again, shown.splats)
        if len(differs) or len(again) != len(shown.splats) or rows_sha256(again) != rows_sha256(shown.splats):
            out.append(
                f"replaying the layers gives {len(differs)} other rows, and {len(again)} instead of {len(shown.splats)}"
            )
    except ValueError as error:
        out.append(str(error))
    return out
