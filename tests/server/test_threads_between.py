"""What another thread does between two lines of this one: the shared lists and caches of a studio and its session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatpainter.pictures.view_search import NamedView
from splatpainter.server.uploads import watched_folder
from splatpainter.server.uploads.storage import MAX_DOWNLOADS, Downloads
from splatpainter.session.document.layer_mask import LayerMask
from splatpainter.system.recent import Recent
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, SIZE, dab, flat, print_of
from tests.support.studio_scenes import make_studio, view
from tests.support.threads import at_once


def test_a_view_is_exported_while_a_saved_picture_is_compared_with_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio = make_studio(tmp_path, shared=tmp_path)
    one = NamedView("one", view(), np.zeros((4, 4, 3), np.float32))
    studio.exports.note(one)
    studio.exports.note(one)

    def compare(size: tuple[int, int], target: tuple[int, int]) -> bool:
        studio.exports.note(one)
        return False

    monkeypatch.setattr(watched_folder, "same_shape", compare)
    try:
        assert not watched_folder._has_a_views_shape(studio, "picture.png", (4, 3))
        assert len(studio.exports.items) == 4
    finally:
        studio.close()


@pytest.fixture
def thrown_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever asks whether something is held is told so, and then another thread needs its room."""

    def there(self: Recent, key: object) -> bool:
        return self.items.pop(key, None) is not None

    monkeypatch.setattr(Recent, "__contains__", there)


@pytest.mark.usefixtures("thrown_out")
def test_strokes_whose_state_is_thrown_out_while_they_are_replayed() -> None:
    with flat() as session:
        layer = session.layers.new()
        for k, color in enumerate((RED, GREEN, BLUE)):
            session.strokes.paint(layer.id, [dab(color, 10 + 3 * k)])
        painted = print_of(session)
        session.undo()
        session.redo()
        assert print_of(session) == painted


@pytest.mark.usefixtures("thrown_out")
def test_a_mask_whose_weights_are_thrown_out_while_it_is_replayed() -> None:
    with flat() as session:
        layer = session.layers.new()
        session.strokes.paint(layer.id, [dab(RED, radius=9)])
        session.masks.set(layer.id, LayerMask(shows=False))
        for left in (SIZE // 3, SIZE // 2):
            picture = np.zeros((SIZE, SIZE), np.float32)
            picture[:, :left] = 1
            session.masks.paint(layer.id, CAMERA, np.ones_like(picture), picture)
        masked = print_of(session)
        session.undo()
        session.redo()
        assert print_of(session) == masked


def test_downloads_that_are_made_at_once(tmp_path: Path) -> None:
    downloads = Downloads(tmp_path)

    def add(thread: int) -> None:
        for k in range(40):
            path = downloads.folder() / f"{thread}-{k}.ply"
            path.touch()
            downloads.add(path)

    at_once(add, 4)
    assert len([*tmp_path.rglob("*.ply")]) == MAX_DOWNLOADS
