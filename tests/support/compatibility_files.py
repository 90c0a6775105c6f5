"""Files of this version as text, for tests/test_compatibility.py. A release that writes another version of one adds its
files beside those that are there, which stay: `python -m tests.support.compatibility_files FOLDER`."""

from __future__ import annotations

import base64
import shutil
import sqlite3
import sys
import tempfile
import textwrap
from pathlib import Path

import numpy as np

import splatpainter as sp
from splatpainter.cameras import Camera
from splatpainter.painter import Edit
from splatpainter.session import Session
from splatpainter.session.document.layer_mask import LayerMask, by_rule
from splatpainter.session.project import database
from splatpainter.session.selection.selection import in_box
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, SIZE, asset, dab, flat, print_of


def make_project(path: Path, layer: Path) -> str:
    """A project with one layer of most kinds, a mask, a merged layer, strokes, an undone step, a bookmark, a selection;
    one of its layers as a file. Returns the hash of what it shows."""
    with flat(asset(6), path) as session:
        session.layers.add("paint", [dab(RED)], name="red", angle_limit=70)
        stroke = session.strokes.paint_new("strokes", [dab(BLUE, 19)])
        session.strokes.paint(stroke.id, [dab(GREEN, 12)], kind="clone")
        session.layers.merge(["1", stroke.id], "both")
        look = session.layers.add("look", name="warm", look="gain", settings={"gain": [1.2, 1, 0.9]}, opacity=0.5)
        session.masks.set(look.id, LayerMask(parts=(by_rule("height", 0, 0.5, soft=0.1),)))
        hidden = in_box(session.splats, np.array([0.3, -9, -9]), np.array([9, 9, 9]))
        session.layers.hide_selected(hidden, "corner")
        session.selections.save("corner", hidden)
        session.layers.add("paint", [dab(RED, 9)], name="sign", placed={"kind": "text", "text": "tea"})
        session.bookmarks.add("front", CAMERA)
        expected = print_of(session)
        session.layers.set(look.id, opacity=1.0)
        session.undo()
        session.files.export_layer(look.id, layer)
        assert print_of(session) == expected
        return expected


def make_receipt(folder: Path) -> None:
    """before.splat, after.splat and after.splat.receipt.json."""
    sp.write(folder / "before.splat", asset(4))
    with Session(folder / "before.splat", painter=sp.Painter.load("lift")) as session:
        black = Edit(np.zeros((SIZE, SIZE, 3)), CAMERA, half_mask(CAMERA))
        session.layers.add("look", [black], look="gain", settings={"gain": [0.5, 0.5, 0.5]})
        session.files.export(folder / "after.splat")


def half_mask(camera: Camera) -> np.ndarray:
    """[H, W] bool: the right half of a view."""
    return np.broadcast_to(np.arange(camera.width) >= camera.width // 2, (camera.height, camera.width)).copy()


def as_sql(project: Path) -> str:
    """A closed project as statements that make it."""
    connection = sqlite3.connect(project)
    lines = [f"PRAGMA application_id={database.APPLICATION_ID};", f"PRAGMA user_version={database.VERSION};"]
    lines += [line for line in connection.iterdump()]
    connection.close()
    return "\n".join(lines) + "\n"


def as_text(data: bytes) -> str:
    return "\n".join(textwrap.wrap(base64.b64encode(data).decode(), 120)) + "\n"


def main(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        shows = make_project(work / "a.splatproj", work / "warm.splatlayer")
        (folder / "project.sql").write_text(as_sql(work / "a.splatproj"), encoding="utf-8", newline="\n")
        (folder / "project.sha256").write_text(shows + "\n", encoding="utf-8", newline="\n")
        (folder / "layer.base64").write_text(as_text((work / "warm.splatlayer").read_bytes()), encoding="utf-8")
        make_receipt(work)
        for file in ("before.splat", "after.splat"):
            (folder / f"{file}.base64").write_text(as_text((work / file).read_bytes()), encoding="utf-8")
        shutil.copy(work / "after.splat.receipt.json", folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
