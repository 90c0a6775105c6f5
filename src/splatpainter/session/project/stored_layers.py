"""Layers in a project's database: each form of one is a row, which the steps that have it share; and what no step needs
any more.
"""

from __future__ import annotations

import json
import sqlite3

from splatpainter.session.document.document import Layer, digest
from splatpainter.session.document.scene_asset import parse_assets

UNUSED_RESULTS = """
WITH RECURSIVE used(key) AS (
    SELECT result FROM step_results
    UNION SELECT previous FROM results JOIN used USING (key) WHERE previous IS NOT NULL
)
SELECT key FROM results WHERE key NOT IN (SELECT key FROM used)
"""
UNUSED_LAYERS = """
WITH RECURSIVE used(id) AS (
    SELECT layer FROM step_layers
    UNION SELECT previous FROM layers JOIN used USING (id) WHERE previous IS NOT NULL
)
DELETE FROM layers WHERE id NOT IN (SELECT id FROM used)
"""


def store_layer(db: sqlite3.Connection, layer: Layer) -> int:
    """Row of a layer in this very form, made if there is none; strokes are rows of their own, each of which names the
    one before it, so that one more stroke is one more row."""
    names, name = [], ""
    for stroke in layer.strokes:
        name = digest(f"{stroke.text} {name}")
        names.append(name)
    row, stored = None, len(names)
    while stored and (row := _row_of(db, names[stored - 1])) is None:
        stored -= 1
    for stroke, name in zip(layer.strokes[stored:], names[stored:], strict=True):
        row = _insert_layer(db, name, stroke.text, row, stroke.direct_blobs())
    blobs = layer.direct_blobs().union(*(inner.blobs() for inner in layer.layers))
    name = digest(f"{layer.text} {names[-1]}" if names else layer.text)
    return _insert_layer(db, name, layer.text, row, blobs)


def _row_of(db: sqlite3.Connection, sha256: str) -> int | None:
    row = db.execute("SELECT id FROM layers WHERE sha256 = ?", (sha256,)).fetchone()
    return None if row is None else row[0]


def _insert_layer(db: sqlite3.Connection, sha256: str, text: str, previous: int | None, blobs: set[str]) -> int:
    query = "INSERT OR IGNORE INTO layers (sha256, content, previous) VALUES (?, ?, ?)"
    db.execute(query, (sha256, text, previous))
    row = _row_of(db, sha256)
    assert row is not None
    db.executemany("INSERT OR IGNORE INTO layer_blobs VALUES (?, ?)", [(row, blob) for blob in blobs])
    return row


def sweep(db: sqlite3.Connection) -> set[str]:
    """Delete what no step needs any more; the keys of deleted results."""
    unused_keys = {key for (key,) in db.execute(UNUSED_RESULTS)}
    db.executemany("DELETE FROM results WHERE key = ?", [(key,) for key in unused_keys])
    db.execute(UNUSED_LAYERS)
    db.execute("DELETE FROM blobs WHERE sha256 NOT IN (SELECT blob FROM layer_blobs)")
    _sweep_assets(db)
    return unused_keys


def _sweep_assets(db: sqlite3.Connection) -> None:
    """Delete files of assets that no step has any more."""
    stored = {name.split("/")[0] for (name,) in db.execute("SELECT DISTINCT file FROM original") if "/" in name}
    if stored:
        for (text,) in db.execute("SELECT DISTINCT assets FROM steps WHERE assets IS NOT NULL").fetchall():
            stored -= {asset.sha256 for asset in parse_assets(json.loads(text))}
    for sha in stored:
        db.execute("DELETE FROM original WHERE substr(file, 1, 65) = ?", (f"{sha}/",))
