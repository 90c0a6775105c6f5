"""Checking a project: structure, hashes, the original, and that replaying the layers gives the asset."""

from __future__ import annotations

import contextlib
from functools import partial

from splatpainter.session.document.document import Document
from splatpainter.session.project.asset_files import OriginalRule, restore, restore_added
from splatpainter.session.project.project_file import Project
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.session.replay.scene_replay import SceneReplay
from splatpainter.splats import Splats, changed_rows, rows_sha256


class _StoredResults:
    """Results as the file holds them, as far as they can be read; new ones are not kept. repaint: none are there."""

    def __init__(self, project: Project, repaint: bool) -> None:
        self._project, self._repaint = project, repaint

    def blob(self, sha256: str) -> bytes:
        return self._project.blob(sha256)

    def has(self, key: str) -> bool:
        return not self._repaint and self._project.has_result(key)

    def get(self, key: str) -> LayerResult | None:
        with contextlib.suppress(ValueError):
            return None if self._repaint else self._project.result(key)

    def put(self, key: str, result: LayerResult, previous: str | None = None) -> None:
        pass


def find_problems(
    project: Project, document: Document, splats: Splats, replay: SceneReplay, repaint: bool, rule: OriginalRule
) -> list[str]:
    """What is wrong with a project, one line each; see Session.verify. document, splats: what its session shows; rule:
    what may be opened as its original."""
    out = []
    try:
        # Structure first: what follows reads rows, which a broken file may not give.
        lines = [line for (line,) in project.rows("PRAGMA integrity_check")]
        out += [f"{project.path}: {line}" for line in lines if line != "ok"]
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
        # With a Replay of its own: the session's caches would only prove themselves.
        original = restore(project, rule)
        stored = _StoredResults(project, repaint)
        load = partial(restore_added, project)
        fresh = SceneReplay(original, replay.painter, stored, replay.adjustments, load)
        again = fresh.compose(document).splats
        differs = changed_rows(again, splats)
        if len(differs) or len(again) != len(splats) or rows_sha256(again) != rows_sha256(splats):
            counts = f"{len(again)} instead of {len(splats)}"
            out.append(f"replaying the layers gives {len(differs)} other Gaussians, and {counts}")
    except ValueError as error:
        out.append(str(error))
    return out
