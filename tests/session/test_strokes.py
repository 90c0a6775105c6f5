"""Layers that hold strokes: what is computed, what is stored, and that each stroke can be undone."""

from __future__ import annotations

import contextlib
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.session.document.document import MAX_STROKES, Layer
from splatpainter.session.kinds.painted_layers import PaintLayer
from splatpainter.splats import ATTRIBUTES, Splats, rows_sha256
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, FlatPainter, asset, dab, flat, load, print_of

SIDE = look_at((1.5, 0, -3), (0, 0, 0), (0, -1, 0), width=32, height=32, fov=40)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "one.splatproj"


def painted(session: Session, count: int = 6) -> str:
    """Id of a new layer with so many strokes, from two views."""
    layer = session.layers.new("Paint")
    for k in range(count):
        edit = dab((RED, GREEN, BLUE)[k % 3], 10 + 2 * (k % 6), camera=SIDE if k % 2 else CAMERA)
        session.strokes.paint(layer.id, [edit], name=f"stroke {k}")
    return layer.id


def calls(session: Session) -> int:
    painter = session.painter
    assert isinstance(painter, FlatPainter)
    return len(painter.calls)


def test_strokes_of_several_views_make_what_single_layers_make() -> None:
    with flat() as single, flat() as session:
        for k in range(4):
            single.layers.add("paint", [dab((RED, GREEN)[k % 2], 10 + 3 * k, camera=SIDE if k % 2 else CAMERA)])
        layer = session.layers.new()
        for k in range(4):
            session.strokes.paint(layer.id, [dab((RED, GREEN)[k % 2], 10 + 3 * k, camera=SIDE if k % 2 else CAMERA)])
        assert print_of(session) == print_of(single) and len(session.layers) == 1
        facts = session.layers.facts(layer.id)
        assert facts["rows_appended"] == 4 and facts["stroke"]["rows_appended"] == 1
        assert not session.layers.conflicts() and len(session.layers[0].cameras) == 2


def test_each_stroke_is_one_step_and_only_the_newest_is_computed() -> None:
    with flat() as session:
        layer = painted(session)
        assert calls(session) == 6
        prints = [print_of(session)]
        while session.undo():
            prints.append(print_of(session))
        assert len(prints) == 8 and prints[-1] == prints[-2]  # the empty layer changes nothing
        for expected in reversed(prints[:-1]):
            assert session.redo() and print_of(session) == expected
        assert calls(session) == 6
        assert [step.label for step in session.history][-1] == "stroke 5 in Paint"
        assert [stroke.name for stroke in session.layers.by_id(layer).strokes][0] == "stroke 0"


def test_the_twentieth_stroke_reads_the_file_as_often_as_the_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    with flat() as session:
        read, counts = session._core.project.rows, []
        monkeypatch.setattr(session._core.project, "rows", lambda *a, **k: counts.append(1) or read(*a, **k))
        needed = []
        layer = session.layers.new().id
        for k in range(20):
            session.strokes.paint(layer, [dab((RED, GREEN, BLUE)[k % 3], 10 + 2 * (k % 6))])
            needed.append(len(counts))
        assert needed[19] - needed[18] == needed[9] - needed[8]
        assert [step.label for step in session.history] == [label for _, label in session._core.project.rows(
            "SELECT id, label FROM steps ORDER BY id"
        )]  # fmt: skip
        for _ in range(3):
            session.undo()
        session.strokes.paint(layer, [dab(RED, 9)], name="another")
        assert [step.label for step in session.history][-2:] == ["Stroke in Paint", "another in Paint"]
        assert len(session.history) == 1 + 1 + 17 + 1 and session.history.cursor == 19 and session.verify() == []


def test_a_reopened_layer_paints_nothing_and_takes_more(path: Path) -> None:
    with flat(project=path) as session:
        layer = painted(session, 14)
        session.undo()
        before = print_of(session)
    with load(path) as session:
        assert print_of(session) == before and calls(session) == 0
        session.redo()
        session.undo()
        for _ in range(12):
            session.undo()
        assert len(session.layers.by_id(layer).strokes) == 1 and calls(session) == 0
        for _ in range(12):
            session.redo()
        assert print_of(session) == before and calls(session) == 0
        session.strokes.paint(layer, [dab(BLUE, 8)])
        assert calls(session) == 1 and session.verify() == [] and session.verify(repaint=True) == []


def test_what_an_undone_stroke_stored_goes_when_another_is_painted(path: Path) -> None:
    with flat(project=path) as session:
        layer = painted(session, 4)
        session.undo()
        session.undo()
        session.strokes.paint(layer, [dab(BLUE, 8)])
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        counts = [database.execute(f"SELECT count(*) FROM {name}").fetchone()[0] for name in ("results", "layers")]
        assert counts == [3, 3 + 4]  # the strokes, and the layer with none to three of them
    with load(path) as session:
        assert calls(session) == 0 and len(session.layers.by_id(layer).strokes) == 3


def test_a_project_grows_by_the_stroke_not_by_the_layer(path: Path) -> None:
    """Rows that name strokes: one per stroke, whatever the layer holds already."""
    with flat(project=path) as session:
        painted(session, 12)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        sizes = [len(text) for (text,) in database.execute("SELECT content FROM layers ORDER BY id")]
        rows = database.execute("SELECT count(*) FROM step_results").fetchone()[0]
    assert max(sizes) < 2 * min(sizes) + 1500 and rows == 12


def test_a_layer_of_one_picture_takes_strokes_and_stays_as_it_was() -> None:
    with flat() as session:
        old = session.layers.add("paint", [dab(RED)], opacity=0.5, name="old")
        half = print_of(session)
        session.strokes.paint(old.id, [dab(BLUE, 22)])
        layer = session.layers.by_id(old.id)
        assert (layer.opacity, layer.name, len(layer.strokes), layer.views) == (0.5, "old", 2, ())
        assert calls(session) == 2
        session.undo()
        assert print_of(session) == half and session.layers.by_id(old.id).views


def test_opacity_eye_and_order_are_the_layers(path: Path) -> None:
    with flat(project=path) as session:
        before = print_of(session)
        layer = painted(session, 3)
        full, count = print_of(session), calls(session)
        session.layers.set(layer, visible=False)
        assert print_of(session) == before
        with pytest.raises(ValueError, match="hidden"):
            session.strokes.paint(layer, [dab()])
        session.layers.set(layer, visible=True)
        assert print_of(session) == full
        session.layers.set(layer, opacity=0.5)
        half = session.splats
        assert calls(session) == count and print_of(session) != full
        session.layers.set(layer, opacity=1)
        mixed = (session.original.sh + session.splats.sh[: len(session.original)]) / 2
        same = (half.scales[: len(mixed)] == session.original.scales).all(1)
        np.testing.assert_allclose(half.sh[: len(mixed)][same], mixed[same], atol=1e-5)
        copy = session.layers.duplicate(layer)
        assert len(copy.strokes) == 3 and {s.id for s in copy.strokes}.isdisjoint(
            s.id for s in session.layers.by_id(layer).strokes
        )
        session.layers.merge([layer, copy.id])
        merged = print_of(session)
    with load(path) as session:
        assert print_of(session) == merged


def test_another_opacity_is_previewed_while_it_is_computed() -> None:
    with flat() as session:
        layer = painted(session, 3)
        full, last = session.splats, print_of(session)
        assert session.layers.blend_preview(layer, opacity=1.0) is None  # nothing is mixed
        preview = session.layers.blend_preview(layer, opacity=0.5)
        assert preview is not None and print_of(session) == last
        ids, preview_splats = preview
        assert (np.diff(ids) > 0).all() and len(preview_splats) == len(ids)
        session.layers.set(layer, opacity=0.5)
        exact, unchanged = session.splats.take(ids), np.setdiff1d(np.arange(len(full)), ids)
        for name in ("means", "quats", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(preview_splats, name), getattr(exact, name))
        assert np.abs(preview_splats.sh - exact.sh).mean() < 0.25 * np.abs(full.sh[ids] - exact.sh).mean()
        assert rows_sha256(session.splats, unchanged) == rows_sha256(full, unchanged)
        assert session.layers.blend_preview(layer, opacity=0.25) is None  # what it needs is there now
        session.undo()
        session.layers.set(layer, visible=False)
        assert session.layers.blend_preview(layer, opacity=0.5) is None
        session.layers.set(layer, visible=True)
        session.strokes.paint(layer, [dab(GREEN, 16)])
        assert session.layers.blend_preview(layer, blend="darken") is not None
        session.layers.add("paint", [dab(BLUE, 22)], name="above")
        (views,) = (one.id for one in session.layers if one.name == "above")
        assert session.layers.blend_preview(views, opacity=0.5) is not None


@pytest.mark.parametrize("change", [{"visible": False}, {"opacity": 0.5}])
def test_a_layer_below_others_is_previewed_where_they_leave_it(change: dict[str, Any]) -> None:
    with flat() as session:
        layer = painted(session, 3)
        alone = session.splats
        session.layers.add("paint", [dab(BLUE, 18)], name="above")
        before, last = session.splats, print_of(session)
        preview = session.layers.blend_preview(layer, **change)
        assert preview is not None and print_of(session) == last
        ids, splats = preview
        assert len(ids) == len(splats) > 10 and (np.diff(ids) > 0).all() and ids[-1] < len(before)
        assert rows_sha256(before, ids) == rows_sha256(alone, ids), "what lies above is left as it is"
        seen = before.opacities[ids] > 0
        assert not np.array_equal(before.sh[ids][seen], splats.sh[seen])
        first, now = (render(one, CAMERA).colors[0] for one in (before, put(before, ids, splats)))
        session.layers.set(layer, **change)
        exact = render(session.splats, CAMERA).colors[0]
        assert np.abs(now - exact).mean() < 0.75 * np.abs(first - exact).mean()


def put(splats: Splats, ids: np.ndarray, rows: Splats) -> Splats:
    """With other Gaussians in some places."""
    changed = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
    for name, values in changed.items():
        values[ids] = getattr(rows, name)
    return replace(splats, **changed)


def test_strokes_go_into_a_layer_below_others() -> None:
    with flat() as session:
        layer = painted(session, 2)
        session.layers.add("paint", [dab(GREEN, 22)], name="above")
        below = session.strokes.painted_on(layer)
        session.strokes.paint(layer, [dab(BLUE, 10)])
        assert len(below) + 2 == len(session.splats)
        assert [one.name for one in session.layers] == ["Paint", "above"]
        session.layers.set(layer, opacity=0.25)
        assert len(session.strokes.painted_on(layer)) == len(below) + 1


def test_pictures_are_kept_inside_their_masks_only(path: Path) -> None:
    from PIL import Image

    with flat(project=path) as session:
        layer = session.layers.new()
        (stroke,) = session.strokes.paint(layer.id, [dab(RED)]).strokes
        assert stroke.views[0].picture is not None
        data = session.files.blob(stroke.views[0].picture)
    import io

    pixels = np.asarray(Image.open(io.BytesIO(data)))
    assert pixels.shape[2] == 4 and set(np.unique(pixels[..., 3])) == {0, 255} and not pixels[pixels[..., 3] == 0].any()


def test_what_takes_no_strokes_says_so() -> None:
    with flat() as session:
        look = session.layers.add("look", look="gain", settings={"gain": [1, 1, 1]})
        words = session.layers.add("paint", [dab()], placed={"kind": "text", "text": "TEA"})
        layer = session.layers.new()
        with pytest.raises(ValueError, match="takes no strokes"):
            session.strokes.paint(look.id, [dab()])
        with pytest.raises(ValueError, match="can be changed"):
            session.strokes.paint(words.id, [dab()])
        with pytest.raises(ValueError, match="expected a kind of"):
            session.strokes.paint(layer.id, [dab()], kind="look")
        with pytest.raises(ValueError, match="no Gaussian contributes"):
            session.strokes.paint(layer.id, [dab(x=0, y=0, radius=1)])
        assert session.layers.by_id(layer.id).strokes == ()
        record = Layer("1", "a", PaintLayer(), views=session.layers.by_id(words.id).views).record()
        with pytest.raises(ValueError, match="expected a list of at most"):
            Layer.parse({**record, "strokes": [record] * (MAX_STROKES + 1)})
        with pytest.raises(ValueError, match="without views"):
            Layer.parse({**record, "strokes": [record]})
        with pytest.raises(ValueError, match="expected a stroke"):
            Layer.parse({**record, "views": [], "strokes": [{**record, "operation": {"kind": "look"}}]})


def test_words_are_changed_in_place() -> None:
    with flat() as session:
        words = session.layers.add("paint", [dab(RED)], name="Text: tea", placed={"text": "tea"}, opacity=0.5)
        session.layers.add("paint", [dab(GREEN, 24)])
        before = print_of(session)
        session.layers.set(words.id, visible=False, gesture="words")
        changed = session.layers.replace_views(
            words.id, [dab(BLUE)], name="Text: milk", placed={"text": "milk"}, gesture="words"
        )
        assert (changed.id, changed.opacity, changed.name, changed.visible) == (words.id, 0.5, "Text: milk", True)
        assert [one.name for one in session.layers] == ["Text: milk", "Paint"]
        assert len(session.history) == 4  # hidden and changed are one step
        session.undo()
        assert print_of(session) == before and session.layers.by_id(words.id).operation.placed["text"] == "tea"  # pyright: ignore[reportAttributeAccessIssue]
        with pytest.raises(ValueError, match="expected a layer of edited pictures"):
            session.layers.replace_views(session.layers.new().id, [dab(BLUE)])


def test_a_layer_of_strokes_goes_through_a_file(tmp_path: Path) -> None:
    with flat() as session:
        layer = painted(session, 3)
        full = print_of(session)
        session.files.export_layer(layer, tmp_path / "paint.splatlayer")
    with flat() as other:
        added = other.files.import_layer(tmp_path / "paint.splatlayer")
        assert print_of(other) == full and len(added.strokes) == 3
    with flat(replace(asset(), means=asset().means + 50)) as elsewhere:
        with pytest.raises(ValueError, match="3 of 3 strokes cannot be painted here"):
            elsewhere.files.import_layer(tmp_path / "paint.splatlayer")
        assert not elsewhere.layers


def test_a_project_whose_strokes_are_gone_is_damaged_in_one_line(path: Path) -> None:
    with flat(project=path) as session:
        painted(session, 3)
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE layers SET previous = id WHERE previous IS NOT NULL")  # a circle
    with pytest.raises(ValueError, match="damaged"):
        load(path)


def test_only_the_placed_picture_of_a_sticker_is_kept_with_it(path: Path) -> None:
    """A blob that options name stays in the project as long as the layer."""
    assert Layer("1", "a", PaintLayer(placed={"image": "a" * 64})).blobs() == {"a" * 64}
    assert Layer("1", "a", PaintLayer(placed={"image": "../x"})).blobs() == set()


def test_the_eraser_takes_away_what_its_layer_painted(path: Path) -> None:
    """Where everything of the layer is erased, what is below it is there bit for bit; the rest is hidden."""
    with flat(project=path) as session:
        lower = session.layers.new("lower")
        session.strokes.paint(lower.id, [dab(RED, radius=6)])
        below = session.splats
        upper = session.layers.new("upper")
        session.strokes.paint(upper.id, [dab(BLUE, 14, radius=4)])
        painted_over = session.splats
        session.strokes.paint(upper.id, [dab(RED, 14, radius=9)], kind="erase", name="Erase")
        erased = session.splats
        assert rows_sha256(erased.take(np.arange(len(below)))) == rows_sha256(below)
        assert not erased.opacities[len(below) :].any() and len(erased) >= len(painted_over)
        session.strokes.paint(upper.id, [dab(GREEN, 14, radius=3)])
        assert calls(session) == 3 and session.layers.facts(upper.id)["stroke"]["rows_touched"]
        again = print_of(session)
        session.undo()
        assert print_of(session) == rows_sha256(erased)
        session.redo()
        session.layers.set(lower.id, visible=False)
        session.layers.set(lower.id, visible=True)
        assert print_of(session) == again and session.verify(repaint=True) == []
    with load(path) as session:
        assert print_of(session) == again and calls(session) == 0


def test_results_of_old_strokes_become_one_where_they_take_much_room(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flat(project=path) as session:
        layer = painted(session, 12)
        expected = [print_of(session)]
        for _ in range(11):
            session.undo()
            expected.append(print_of(session))
    expected.reverse()
    path.unlink()
    with flat(project=path) as session:
        sizes = session._core.project.result_bytes
        one = 2500  # bytes of one result or less
        monkeypatch.setattr("splatpainter.session.replay.strokes.MAX_RESULT_BYTES", 6 * one)
        monkeypatch.setattr("splatpainter.session.replay.strokes.LATEST_BYTES", 3 * one)
        monkeypatch.setattr(session._core.project, "result_bytes", lambda key: one if sizes(key) else 0)
        layer = session.layers.new("Paint").id
        for k in range(12):
            edit = dab((RED, GREEN, BLUE)[k % 3], 10 + 2 * (k % 6), camera=SIDE if k % 2 else CAMERA)
            session.strokes.paint(layer, [edit], name=f"stroke {k}")
            assert print_of(session) == expected[k]
        assert calls(session) == 12
        stored = session._core.project.rows("SELECT count(*) FROM results")[0][0]
        assert 5 <= stored <= 8
    with load(path) as session:
        assert print_of(session) == expected[11] and calls(session) == 0
        for k in range(10, 6, -1):
            session.undo()
            assert print_of(session) == expected[k]
        assert calls(session) == 0
        for k in range(6, -1, -1):
            session.undo()
            assert print_of(session) == expected[k]
        assert calls(session) > 0  # from the pictures
        session.history.jump(13)
        assert print_of(session) == expected[11] and session.verify() == [] and session.verify(repaint=True) == []
        session.strokes.paint(layer, [dab(BLUE, 8)])
        again = print_of(session)
    with load(path) as session:
        assert print_of(session) == again and calls(session) == 0


def test_folding_gives_room_back(path: Path) -> None:
    with flat(project=path) as session:
        painted(session, 3)
        project = session._core.project
        project.set_fact("large", "x" * (1 << 20))
        project.delete_fact("large")
        assert project.rows("PRAGMA freelist_count")[0][0] > 100
        first, second, _ = [key for (key,) in project.rows("SELECT key FROM results ORDER BY rowid")]
        result = project.result(first)
        assert result is not None
        project.fold([], first, result, second)
        assert project.rows("PRAGMA freelist_count")[0][0] == 0


def test_erasing_back_to_the_original_goes_on_in_one_layer_and_thumbnails_stay_those_of_paint() -> None:
    with flat() as session:
        paint = painted(session, 2)
        thumbnail = session.layers.by_id(paint).thumbnail
        session.strokes.paint(paint, [dab(RED, 10)], kind="erase")
        assert session.layers.by_id(paint).thumbnail == thumbnail
        left, right = dab(RED, 11, radius=4), dab(RED, 20, radius=4)
        assert left.mask is not None and right.mask is not None
        both = replace(left, mask=left.mask | right.mask)
        eraser = session.layers.add("erase", [left]).id
        session.strokes.erase_more(eraser, [right])
        grown = print_of(session)
        assert len(session.layers) == 2 and len(session.layers.by_id(eraser).views) == 1
        assert session.verify(repaint=True) == []
        session.undo()
        session.layers.delete(eraser)
        session.layers.add("erase", [both])
        assert print_of(session) == grown
        with pytest.raises(ValueError, match="of the same views"):
            session.strokes.erase_more(session.layers[1].id, [replace(right, camera=SIDE)])
        with pytest.raises(ValueError, match="of the same views"):
            session.strokes.erase_more(paint, [right])


def test_a_merged_layer_takes_strokes_on_top_of_what_it_is_made_of(path: Path) -> None:
    with flat(project=path) as session, flat() as single:
        lower, upper = painted(session, 2), painted(session, 3)
        merged = session.layers.merge([lower, upper], "both").id
        before = print_of(session)
        session.strokes.paint(merged, [dab(GREEN, 20)], name="more")
        session.strokes.paint(merged, [dab(RED, 14, camera=SIDE)], name="and more")
        assert [layer.name for layer in session.layers] == ["both"]
        assert [len(leaf.strokes) for leaf in session.layers[0].leaves()] == [2, 5]
        for strokes in (2, 3):
            painted(single, strokes)
        layer = single.layers[-1].id
        single.strokes.paint(layer, [dab(GREEN, 20)])
        single.strokes.paint(layer, [dab(RED, 14, camera=SIDE)])
        assert print_of(session) == print_of(single), "as if they had not been merged"
        after = print_of(session)
        session.undo()
        session.undo()
        assert print_of(session) == before
        session.redo()
        session.redo()
        session.layers.set(merged, opacity=0.5)
        paler = print_of(session)
        session.strokes.paint(merged, [dab(BLUE, 25)], name="at half opacity")
        session.undo()
        assert print_of(session) == paler != after
    with load(path) as session:
        assert print_of(session) == paler and not session.verify()


def test_a_merged_layer_whose_uppermost_mixes_gets_a_new_one_inside() -> None:
    with flat() as session:
        lower, upper = painted(session, 1), painted(session, 1)
        session.layers.set(upper, opacity=0.5)
        merged = session.layers.merge([lower, upper]).id
        session.strokes.paint(merged, [dab(GREEN, 20)], name="more")
        leaves = list(session.layers[0].leaves())
        assert [len(leaf.strokes) for leaf in leaves] == [1, 1, 1] and leaves[1].opacity == 0.5
        assert len({leaf.id for leaf in leaves} | {merged}) == 4
        with pytest.raises(ValueError, match="is merged, and nothing can be erased in it"):
            session.strokes.paint(merged, [dab(GREEN, 20)], kind="erase")
        with pytest.raises(ValueError, match="is hidden"):
            session.layers.set(merged, visible=False)
            session.strokes.paint(merged, [dab(GREEN, 20)])
