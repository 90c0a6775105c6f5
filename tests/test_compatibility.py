"""What docs/compatibility.md promises from 0.1.0 on, held by files of that version as text (tests/compatibility/; how
they were made: tests/support/compatibility_files.py)."""

from __future__ import annotations

import base64
import inspect
import sqlite3
from pathlib import Path

import pytest

import splatpainter as sp
from splatpainter.session import Session
from splatpainter.session.project import database
from splatpainter.session.replay import delta
from tests.support.session_scenes import flat, load, print_of

FOLDER = Path(__file__).with_name("compatibility")
PROMISED_NAMES = """
Asset Camera ColorMatch Decal Edit GradeSettings Painter Placement Receipt Recolor Region Render Session Splats
WriteOptions edit_with_source fill grade look_at merge orbit read refine render studio verify write
"""
PROMISED_PARTS = {
    "layers": "add new set move duplicate delete merge fill fill_from hide_selected replace_views by_id facts",
    "strokes": "paint paint_new erase_more painted_on",
    "masks": "set set_area set_selection paint",
    "selections": "names save load delete",
    "scene": "assets add set remove match_seam set_up set_front",
    "history": "cursor jump",
    "bookmarks": "add delete",
    "files": "export export_view export_layer import_layer receipt save_as save_copy",
}
"""Names of a session's parts."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project that 0.1.0 wrote."""
    path = tmp_path / "of 0.1.0.splatproj"
    connection = sqlite3.connect(path)
    connection.executescript((FOLDER / "project.sql").read_text(encoding="utf-8"))
    connection.close()
    return path


def unpacked(name: str, folder: Path) -> Path:
    """A file of 0.1.0, from its text."""
    path = folder / name
    path.write_bytes(base64.b64decode((FOLDER / f"{name}.base64").read_text(encoding="utf-8")))
    return path


def test_a_project_opens_as_it_was_left(project: Path) -> None:
    expected = (FOLDER / "project.sha256").read_text(encoding="utf-8").strip()
    with load(project) as session:
        assert print_of(session) == expected and session.painter.calls == []  # type: ignore[attr-defined]
        kinds = [(layer.name, layer.kind, layer.opacity) for layer in session.layers]
        assert kinds == [("both", "merged", 1), ("warm", "look", 0.5), ("corner", "hide", 1), ("sign", "paint", 1)]
        assert [len(layer.strokes) for layer in session.layers[0].layers] == [0, 2]
        assert len(session.history) == 10 and session.history.cursor == 8
        assert session.bookmarks[0].name == "front" and session.selections.load("corner").any()
        assert session.redo() and session.undo() and print_of(session) == expected
        while session.undo():
            pass
        assert print_of(session) != expected and not session.layers
    with load(project) as session:
        session.history.jump(8)
        assert print_of(session) == expected and session.verify() == []


def test_a_layer_file_can_be_imported(tmp_path: Path) -> None:
    path = unpacked("layer", tmp_path).rename(tmp_path / "warm.splatlayer")
    with flat() as session:
        layer = session.files.import_layer(path)
        assert (layer.name, layer.kind, layer.opacity) == ("warm", "look", 0.5) and layer.mask is not None
        assert layer.operation.changes()["settings"] == {"gain": [1.2, 1, 0.9]}


def test_a_receipt_is_proved_with_the_same_answer(tmp_path: Path) -> None:
    before, after = (unpacked(name, tmp_path) for name in ("before.splat", "after.splat"))
    receipt = sp.Receipt.from_json((FOLDER / "after.splat.receipt.json").read_text(encoding="utf-8"))
    done = sp.verify(before, after, receipt)
    assert done.ok and done.exact and len(receipt.touched) and len(receipt.touched) < 16
    after.write_bytes(after.read_bytes()[:-1] + b"\0")
    assert not sp.verify(before, after, receipt).ok


def test_what_is_stored_has_the_version_that_the_page_names() -> None:
    assert database.VERSION == delta.VERSION == 1


def test_the_promised_names_are_there() -> None:
    assert set(PROMISED_NAMES.split()) <= set(dir(sp)) | set(sp.__all__)
    with flat() as session:
        for part, names in PROMISED_PARTS.items():
            assert set(names.split()) <= set(dir(getattr(session, part))), part
    words = inspect.signature(Session.__init__).parameters
    assert {"asset", "project", "painter", "adjustments", "embed", "overwrite", "axes"} <= set(words)
