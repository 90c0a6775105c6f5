"""Project files: rows and cells bent inside the database (JSON as trees, blobs inside their compression), the schema
changed, pages bent as bytes."""

from __future__ import annotations

import contextlib
import json
import random
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from splatpainter.cameras import Camera, look_at
from splatpainter.painter import Edit, Painter
from splatpainter.session import Session
from splatpainter.splats import Splats
from tests.support import lift_scenes
from tests.support.io_assets import random_splats, written
from tests.support.session_scenes import FlatPainter

from .mutations import FLOATS, INTEGERS, TEXTS, bend_bytes, bend_integer, bend_json, few, json_bytes, maybe
from .target import Fault, Target, Verdict, refusal

PATHS = ("/", "/etc/passwd", "/dev/zero", "/dev/stdin", "/dev/full", ".", "..", "a.splatproj", "\x00", "x" * 5000, "~")
PATHS += ("/proc/self/mem", "C:\\Windows\\win.ini", "nul", "//host/share/a.ply", "/nowhere/a.ply", "a.fifo")
SCHEMA = (
    "DROP TABLE facts",
    "DROP TABLE deltas",
    "DROP TABLE original",
    "DROP TABLE steps",
    "DROP INDEX step_layers_by_layer",
    "CREATE VIEW extra AS SELECT * FROM facts",
    "ALTER TABLE facts RENAME TO old; CREATE VIEW facts AS SELECT * FROM old",
    "ALTER TABLE layers RENAME COLUMN content TO text",
    "ALTER TABLE steps ADD COLUMN more TEXT",
    "CREATE TRIGGER bad AFTER UPDATE ON facts BEGIN DELETE FROM steps; END",
    "CREATE TRIGGER worse BEFORE INSERT ON steps BEGIN SELECT RAISE(ABORT, 'no'); END",
    "CREATE TABLE extra (a, b GENERATED ALWAYS AS (a || a))",
    "PRAGMA user_version=0",
    "PRAGMA user_version=1",
    "PRAGMA user_version=4",
    "PRAGMA user_version=-1",
    "PRAGMA application_id=1",
    "DELETE FROM facts",
    "DELETE FROM steps",
    "DELETE FROM step_layers",
    "DELETE FROM layers",
    "DELETE FROM blobs",
    "DELETE FROM results",
    "DELETE FROM deltas WHERE part = 1",
    "DELETE FROM original WHERE part = 0",
    "INSERT INTO original VALUES ('../../x', 7, x'00')",
    "INSERT INTO original VALUES ('meta.json', 8, x'7b7d')",
)
TABLES = ("facts", "original", "blobs", "layers", "layer_blobs", "steps", "step_layers", "step_results", "results")
TABLES += ("deltas", "bookmarks")


class ProjectTarget(Target):
    """A .splatproj file."""

    name = "project"
    memory_limit = 512 << 20
    fraction_used = 0.35
    """Part of the opened projects on which commands are tried."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.painter: Any = FlatPainter()
        self.seeds = [self._seed("asset.ply"), self._seed(""), self._seed("asset.spz"), self._seed_with_sheets()]
        for old in folder.iterdir():
            old.unlink()

    def _seed(self, asset: str) -> bytes:
        """A project with a few layers, undone steps and a bookmark; over rows where there is no file."""
        source: Any = sheet()
        if asset:
            path = self.folder / asset
            path.write_bytes(written(self.folder, f"x{asset}", sheet()))
            source = path
        path = self.folder / "seed.splatproj"
        with Session(source, path, painter=self.painter, overwrite=True) as session:
            first = session.layers.add("paint", [dab(0.9)])
            session.layers.set(first.id, opacity=0.5)
            session.layers.add("look", look="gain", settings={"gain": [1.1, 1, 0.9]})
            session.layers.add("paint", [dab(0.2)], blend="color")
            if not asset:
                session.layers.add("erase", [dab(0.5)])
            session.layers.duplicate(first.id)
            session.bookmarks.add("front", camera())
            session.undo()
        return path.read_bytes()

    def _seed_with_sheets(self) -> bytes:
        """A project of the lift's own: deltas with a base, emptied Gaussians, one place painted twice."""
        path = self.folder / "sheets.splatproj"
        with Session(lift_scenes.sheet(12, degree=1, opacity=0.95), path, painter=Painter.load("lift")) as session:
            first = session.layers.add("paint", [stripes(0.0)])
            session.layers.add("paint", [stripes(0.5)], blend="luminosity", opacity=0.5)
            session.layers.add("erase", [stripes(0.3)])
            session.layers.set(first.id, opacity=0.7)
        return path.read_bytes()

    def make(self, rng: random.Random) -> dict[str, bytes]:
        data = rng.choice(self.seeds)
        if maybe(rng, 0.9):
            with contextlib.closing(sqlite3.connect(":memory:")) as database:
                database.deserialize(data)
                for _ in range(few(rng, 4)):
                    with contextlib.suppress(sqlite3.Error, OverflowError, UnicodeError):
                        self._bend(rng, database)
                database.commit()
                data = database.serialize()
        if maybe(rng, 0.12):
            data = bend_bytes(rng, data, 0, 200 if maybe(rng, 0.5) else None, moves=maybe(rng, 0.2))
        return {"a.splatproj": data}

    def _bend(self, rng: random.Random, database: sqlite3.Connection) -> None:
        kind = rng.randrange(12)
        if kind == 0:
            database.executescript(rng.choice(SCHEMA))
            return
        table = rng.choice(TABLES)
        if kind == 1:
            database.execute(f"DELETE FROM {table} WHERE rowid = (SELECT min(rowid) FROM {table})")
            return
        if kind in (2, 3):  # the facts decide most
            names = [name for (name,) in database.execute("SELECT name FROM facts")] or ["path"]
            value = rng.choice((*PATHS, *TEXTS, "rows", "ply", "1", "spz", "linear", "99", None, b"\x00", 7))
            name = "path" if maybe(rng, 0.3) else rng.choice(names)
            database.execute("UPDATE OR REPLACE facts SET value = ? WHERE name = ?", (value, name))
            return
        columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
        records = database.execute(f"SELECT * FROM {table}").fetchall()
        if not records or not columns:
            return
        row, k = list(rng.choice(records)), rng.randrange(len(columns))
        where = " AND ".join(f"{column} IS ?" for column in columns)
        fresh = bend_cell(rng, row[k])
        database.execute("PRAGMA ignore_check_constraints=ON")
        if kind == 4:
            more = [*row]
            more[k] = fresh
            database.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(more))})", more)
            return
        database.execute(f"UPDATE OR REPLACE {table} SET {columns[k]} = ? WHERE {where}", (fresh, *row))
        if table == "layers" and columns[k] == "content" and isinstance(fresh, str):  # so that it is believed
            from splatpainter.session.document.document import digest

            database.execute("UPDATE OR REPLACE layers SET sha256 = ? WHERE content = ?", (digest(fresh), fresh))

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        path = self.folder / "a.splatproj"
        path.write_bytes(files[path.name])
        readonly = rng.choice((None, None, False, True))
        try:
            session = Session.load(path, painter=self.painter, readonly=readonly)
        except ValueError as error:
            refusal(error, str(self.folder))
            self._nothing_left()
            return Verdict(refused=1)
        try:
            if rng.random() < self.fraction_used:
                self._use(session, rng)
        finally:
            session.close()
        self._nothing_left()
        return Verdict(opened=1)

    def _use(self, session: Session, rng: random.Random) -> None:
        layers = [layer.id for layer in session.layers] or ["none"]
        actions: list[Callable[[], Any]] = [
            session.undo,
            session.redo,
            lambda: list(session.bookmarks),
            session.layers.conflicts,
            session.files.receipt,
            session.layers.coverage,
            session.verify,
            session.refresh,
            lambda: session.layers.set(rng.choice(layers), opacity=0.25),
            lambda: session.layers.set(rng.choice(layers), visible=False),
            lambda: session.layers.delete(rng.choice(layers)),
            lambda: session.layers.duplicate(rng.choice(layers)),
            lambda: session.layers.move(rng.choice(layers), 0),
            lambda: session.layers.merge(layers[:2]),
            lambda: session.history.jump(rng.randrange(8)),
            lambda: session.layers.facts(rng.choice(layers)),
            lambda: session.layers.add("paint", [dab(0.7)]),
            lambda: session.files.export(self.folder / "out.ply", overwrite=True),
            lambda: session.files.save_copy(self.folder / "copy.splatproj", overwrite=True),
            lambda: session.files.export_layer(rng.choice(layers), self.folder / "a.splatlayer", overwrite=True),
        ]
        for _ in range(4):
            try:
                rng.choice(actions)()
            except ValueError as error:
                refusal(error)
        np.asarray(session.splats.means)

    def _nothing_left(self) -> None:
        """Of a closed project nothing but the file is left (and what was exported)."""
        for path in list(self.folder.iterdir()):
            ours = path.name in ("a.splatproj", "out.ply", "copy.splatproj", "a.splatlayer", "out.ply.receipt.json")
            if not ours:
                with contextlib.suppress(OSError):
                    path.unlink()
                raise Fault(f"left behind: {path.name}")


def sheet() -> Splats:
    """Rows in a plane that a camera at z = 3 sees."""
    made = random_splats(49, 1, log_scale=-2)
    steps = np.linspace(-1, 1, 7)
    x, y = (part.ravel() for part in np.meshgrid(steps, steps))
    made.means[:] = np.stack([x, y, 0 * x], 1)
    made.scales[:] = 0.15
    made.opacities[:] = 0.9
    return made


def camera(size: int = 16) -> Camera:
    return look_at((0, 0, 3), (0, 0, 0), width=size, height=size, fov=45)


def dab(shade: float) -> Edit:
    """A square of one grey in the middle of the view."""
    mask = np.zeros((16, 16), bool)
    mask[5:11, 5:11] = True
    return Edit(np.full((16, 16, 3), round(shade * 255), np.uint8), camera(), mask)


def stripes(shade: float) -> Edit:
    """Stripes on a disk, finer than the Gaussians below."""
    view = lift_scenes.front(48)
    lines = np.where(np.arange(48)[:, None, None] // 3 % 2 > 0, 0.9, 0.1) * np.ones((48, 48, 3)) * [1, shade, 0.5]
    return Edit(np.round(lines * 255).astype(np.uint8), view, lift_scenes.disk(view, 24, 24, 9))


def bend_cell(rng: random.Random, value: Any) -> Any:
    """Another value for a database cell; JSON as a tree, packed bytes inside their packing."""
    if maybe(rng, 0.2):
        return rng.choice((None, 0, -1, 2**63 - 1, *FLOATS[:3], b"", b"\x00" * 9, *TEXTS[:8], *INTEGERS[:20]))
    if isinstance(value, int):
        return max(-(2**63), min(2**63 - 1, bend_integer(rng, value)))
    if isinstance(value, str):
        with contextlib.suppress(ValueError, RecursionError):  # it was bent before, and may be a hundred thousand "["
            return json_bytes(rng, bend_json(rng, json.loads(value))).decode()
        return value[: rng.randrange(len(value) + 1)] + rng.choice(TEXTS)
    if isinstance(value, bytes):
        with contextlib.suppress(zstandard.ZstdError):
            content = zstandard.ZstdDecompressor().decompress(value, max_output_size=1 << 20)
            with contextlib.suppress(ValueError, RecursionError):
                content = json_bytes(rng, bend_json(rng, json.loads(content)))
                return zstandard.ZstdCompressor(level=1).compress(content)
            content = bend_bytes(rng, content, moves=maybe(rng, 0.3))
            return zstandard.ZstdCompressor(level=1).compress(content)
        return bend_bytes(rng, value)
    return value


TARGETS = {"project": ProjectTarget}
