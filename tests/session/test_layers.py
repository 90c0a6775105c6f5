"""Layers without files: the shown asset is a pure function of original and layers, and every command can be undone."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import look_at
from splatpainter.painter import Edit, Painter
from splatpainter.session import Session
from tests.support.lift_scenes import differing, disk, same_bits, sheet
from tests.support.session_scenes import BLUE, CAMERA, GREEN, RED, SIZE, FlatPainter, asset, dab, flat, print_of

SIDE = look_at((1.5, 0, 2.6), (0, 0, 0), width=SIZE, height=SIZE, fov=42)


def three() -> tuple[Session, list[str]]:
    """Three overlapping dabs."""
    session = flat()
    dabs = [dab(RED, 13), dab(BLUE, 18), dab(GREEN, 16, 19)]
    return session, [session.layers.add("paint", [edit], name=name).id for edit, name in zip(dabs, "abc", strict=True)]


def test_layers_are_the_painter_applied_again_and_again():
    session, _ = three()
    with session:
        painter, expected = FlatPainter(), FlatPainter().encode(asset())
        for edit in (dab(RED, 13), dab(BLUE, 18), dab(GREEN, 16, 19)):
            expected = painter.apply(expected, [edit])
        assert same_bits(session.splats, expected.splats)


def test_the_same_with_the_real_painter():
    splats = sheet(16, degree=1, opacity=0.95)
    painter = Painter()
    edits = [dab(RED, 14, radius=7), dab(BLUE, 19, radius=6)]
    one = painter.encode(splats)
    for edit in edits:
        one = painter.apply(one, [edit])
    with Session(splats) as session:
        for edit in edits:
            layer = session.layers.add("picture", [edit])
        facts = session.layers.facts(layer.id)
        assert facts["method"] == "corrected" and facts["seconds"] > 0 and facts["views"][0]["psnr_after"] > 10
        assert same_bits(session.splats, one.splats)
        assert session.verify(repaint=True) == []
        receipt = session.files.receipt()
        np.testing.assert_array_equal(receipt.touched, np.flatnonzero(differing(splats, one.splats)))
        assert receipt.untouched_sha256_before == receipt.untouched_sha256_after


def commands_of(session: Session, a: str, b: str, c: str) -> list[tuple[str, Any]]:
    return [
        ("hide", lambda: session.layers.set(b, visible=False)),
        ("opacity", lambda: session.layers.set(a, opacity=0.3)),
        ("blend", lambda: session.layers.set(c, blend="luminosity")),
        ("show", lambda: session.layers.set(b, visible=True)),
        ("move", lambda: session.layers.move(c, 0)),
        ("rename", lambda: session.layers.set(a, name="first")),
        ("options", lambda: session.layers.set(a, angle_limit=40)),
        ("duplicate", lambda: session.layers.duplicate(b)),
        ("look", lambda: session.layers.add("look", look="gain", settings={"gain": [1.1, 1, 0.9]})),
        ("regrade", lambda: session.layers.add("look", [Edit(np.full((SIZE, SIZE, 3), 0.8, np.float32), CAMERA)])),
        ("merge", lambda: session.layers.merge([c, a])),
        ("resolve", lambda: session.layers.resolve_conflict(a, b, "blend")),
        ("delete", lambda: session.layers.delete(b)),
    ]


def test_undo_and_redo_of_everything_restore_the_bits():
    session, ids = three()
    with session:
        prints, layers = [print_of(session)], [tuple(session.layers)]
        for name, command in commands_of(session, *ids):
            before = session.version
            command()
            assert session.version >= before, name
            prints.append(print_of(session))
            layers.append(tuple(session.layers))
        for k in reversed(range(len(prints) - 1)):
            assert session.undo()
            assert print_of(session) == prints[k] and tuple(session.layers) == layers[k]
        for k in range(1, len(prints)):
            assert session.redo()
            assert print_of(session) == prints[k] and tuple(session.layers) == layers[k]
        assert not session.redo()
        session.history.jump(0)
        assert same_bits(session.splats, session.original) and not session.undo()
        with pytest.raises(ValueError, match=r"^history: expected an index of 0 to \d+, got 99$"):
            session.history.jump(99)


def test_a_new_command_drops_what_was_undone():
    session, (_, b, _) = three()
    with session:
        session.undo()
        session.undo()
        session.layers.set("1", opacity=0.5)
        assert [step.label for step in session.history] == ["open", "add a", "set the opacity of a"]
        new = session.layers.add("paint", [dab(GREEN)])
        assert new.id not in ("1", b, "3")  # ids are not used again
        assert session.verify() == []


def test_only_what_depends_on_a_change_is_painted_again():
    session, (a, b, c) = three()
    with session:
        calls = session.painter.calls  # type: ignore[attr-defined]
        calls.clear()
        session.layers.set(c, opacity=0.5)
        session.layers.set(c, blend="color")
        session.layers.set(a, name="other")
        session.layers.set(c, visible=False)
        session.layers.set(c, visible=True)
        assert calls == []
        session.layers.set(b, visible=False)
        assert calls == ["c"]
        session.layers.set(b, visible=True)
        session.undo()
        session.redo()
        assert calls == ["c"]  # both are known now
        session.layers.move(c, 0)
        assert calls == ["c", "c", "other", "b"]


def test_hidden_and_transparent_layers_do_nothing():
    session, (a, b, c) = three()
    with session:
        session.layers.delete(c)
        alone = print_of(session)
        session.redo()
        session.undo()
        session.layers.set(c, visible=False)
        assert print_of(session) == alone
        session.layers.set(c, visible=True)
        session.layers.set(c, opacity=0.0)
        assert print_of(session) == alone
        for layer in (a, b):
            session.layers.set(layer, visible=False)
        assert same_bits(session.splats, session.original)


def test_a_merged_layer_shows_the_same_and_follows_what_is_below():
    session, (a, b, c) = three()
    with session:
        session.layers.set(b, opacity=0.4)
        before = print_of(session)
        merged = session.layers.merge([b, c], "both")
        assert print_of(session) == before and [layer.name for layer in session.layers] == ["a", "both"]
        assert session.layers.facts(merged.id)["rows_appended"] == 2
        half = session.layers.set(merged.id, opacity=0.5)
        assert half.opacity == 0.5 and print_of(session) != before
        rows = len(session.splats)
        session.layers.set(merged.id, opacity=1.0)
        assert rows == len(session.splats) and print_of(session) == before
        session.layers.delete(a)
        painter, expected = FlatPainter(), FlatPainter().encode(asset())
        expected = painter.apply(expected, [dab(BLUE, 18)])
        session.layers.set(merged.id, visible=False)
        assert same_bits(session.splats, session.original)
        session.history.jump(3)  # before b was made paler
        session.layers.delete(a)
        session.layers.move(c, 0)
        session.layers.set(c, visible=False)
        assert same_bits(session.splats, expected.splats)
        other = session.layers.merge([b, c])
        assert same_bits(session.splats, expected.splats)
        with pytest.raises(ValueError, match="next to each other"):
            session.layers.merge([other.id])


def test_a_dragged_slider_is_one_step():
    session, (a, _, _) = three()
    with session:
        before, steps = print_of(session), len(session.history)
        for k in range(9, 0, -1):
            session.layers.set(a, gesture="drag 1", opacity=k / 10)
        assert len(session.history) == steps + 1
        stored = session._core.project.rows("SELECT count(*) FROM results")[0][0]
        assert stored <= 3 + 2  # those of the positions in between are gone
        session.layers.set(a, gesture="drag 2", opacity=0.9)
        assert len(session.history) == steps + 2
        session.undo()
        assert session.layers.by_id(a).opacity == 0.1
        session.undo()
        assert print_of(session) == before


def test_a_layer_that_lost_its_ground_says_so_and_works_again():
    class Picky(FlatPainter):
        def apply(self, asset, edits, mode="local", method="auto"):
            if edits[0].name == "needs more rows" and len(asset.splats) == 100:
                raise ValueError("edit: nothing here")
            return super().apply(asset, edits, mode, method)

    with flat(painter=Picky()) as session:
        with pytest.raises(ValueError, match="^edit: nothing here$"):
            session.layers.add("paint", [dab()], name="needs more rows")
        assert len(session.history) == 1
        first = session.layers.add("paint", [dab()])
        second = session.layers.add("paint", [dab(BLUE)], name="needs more rows")
        both = print_of(session)
        session.layers.set(first.id, visible=False)
        assert session.layers.facts(second.id)["problem"] == "edit: nothing here"
        assert same_bits(session.splats, session.original)
        session.layers.set(first.id, visible=True)
        assert print_of(session) == both and "problem" not in session.layers.facts(second.id)


# Threads, progress, state


def test_readers_are_never_kept_waiting_and_never_see_halves():
    entered, leave = threading.Event(), threading.Event()

    class Slow(FlatPainter):
        def apply(self, asset, edits, mode="local", method="auto"):
            entered.set()
            assert leave.wait(20)
            return super().apply(asset, edits, mode, method)

    with flat(painter=Slow()) as session:
        before = session.snapshot
        writer = threading.Thread(target=session.layers.add, args=("paint", [dab()]))
        writer.start()
        assert entered.wait(20)
        assert session.snapshot is before and session.delta(1).version == 1 and len(session.history) == 1
        leave.set()
        writer.join(20)
        after = session.delta(1)
        assert (after.since, after.version, len(after.appended)) == (1, 2, 1)
        assert same_bits(before.splats, session.original)


def test_writers_wait_for_each_other():
    with flat() as session:
        threads = [threading.Thread(target=session.layers.add, args=("paint", [dab(RED, 8 + 2 * k)])) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
        assert len({layer.id for layer in session.layers}) == 8 and len(session.history) == 9
        assert session.version == 9 and session.verify() == []


def test_progress_can_cancel():
    session, (a, _, _) = three()
    with session:
        seen: list[tuple[int, int, str]] = []

        def stop(done: int, total: int, name: str) -> None:
            seen.append((done, total, name))
            if done == 2:
                raise KeyboardInterrupt

        before = session.snapshot
        session.progress = stop
        with pytest.raises(KeyboardInterrupt):
            session.layers.set(a, opacity=0.5)
        assert seen == [(0, 3, "a"), (1, 3, "b"), (2, 3, "c")]
        assert session.snapshot is before and len(session.history) == 4
        session.progress = None
        session.layers.set(a, opacity=0.5)
        assert session.verify() == []


def test_what_a_painter_learnt_is_replayed_and_kept(tmp_path):
    import torch

    from splatpainter.models.config import ModelConfig

    class Model(torch.nn.Linear):
        """Something that has a config, parameters and a hash."""

        config = ModelConfig()

    def learner() -> FlatPainter:
        torch.manual_seed(0)
        return FlatPainter(model=Model(2, 2))

    def weights(session: Session) -> Any:
        return session.snapshot.state.painter_state.blocks[0].w0

    path = tmp_path / "a.splatproj"
    with flat(project=path, painter=learner()) as session:
        session.layers.add("paint", [dab(RED)])
        first = weights(session)
        session.layers.add("paint", [dab(BLUE)])
        both = weights(session)
        assert not torch.equal(first, both)
        session.undo()
        assert torch.equal(weights(session), first)
        session.redo()
    painter = learner()
    with flat(path, painter=painter) as session:
        assert torch.equal(weights(session), both) and painter.calls == []
        session.layers.add("paint", [dab(GREEN)])
        straight = weights(session)
        session.layers.set(session.layers[0].id, visible=False)
        assert not torch.equal(weights(session), straight)  # replayed without the first
        session.layers.set(session.layers[0].id, visible=True)
        assert torch.equal(weights(session), straight)
        assert session.verify(repaint=True) == []


# Bad input


def test_what_cannot_be_done_changes_nothing():
    session, (a, _, _) = three()
    with session:
        before, steps = session.snapshot, len(session.history)
        edit = dab()
        wrong: list[tuple[Any, str]] = [
            (lambda: session.layers.add("paint"), "expected at least one edited view"),
            (lambda: session.layers.add([edit]), "expected a kind of paint, picture"),  # type: ignore[arg-type]
            (lambda: session.layers.add("merged", [edit]), "to be merged"),
            (lambda: session.layers.add("paint", [edit] * 17), "expected at most 16 views"),
            (lambda: session.layers.add("paint", [edit], opacity=1.5), "expected an opacity of 0 to 1"),
            (lambda: session.layers.add("paint", [edit], blend="screen"), "expected blend of normal"),  # type: ignore
            (lambda: session.layers.add("paint", [dab(x=-20)]), "no Gaussian contributes"),
            (lambda: session.layers.set(a), "to set, got nothing"),
            (lambda: session.layers.set(a, views=()), "to set, got views"),
            (lambda: session.layers.set("9", opacity=0.5), "expected one of 1, 2, 3, got '9'"),
            (lambda: session.layers.move(a, 3), "expected an index of 0 to 2, got 3"),
            (lambda: session.layers.by_id("none"), "expected one of 1, 2, 3"),
        ]
        for action, message in wrong:
            with pytest.raises(ValueError, match=message):
                action()
        assert session.snapshot is before and len(session.history) == steps
        assert session.verify() == []


def test_a_mask_that_was_not_given_is_found_once():
    splats = sheet(24, degree=1, opacity=0.95)
    image = sp.render(splats, CAMERA).colors[0].copy()
    mask = disk(CAMERA, 16, 16, 5)
    image[mask] = RED
    with flat(splats) as session:
        layer = session.layers.add("picture", [Edit(image, CAMERA)])
        layer_mask = session._core.replay.main.mask(layer.views[0])
        assert (layer_mask & mask).sum() > 0.9 * mask.sum() and (layer_mask & ~mask).sum() < 0.2 * mask.sum()
        with pytest.raises(ValueError, match="does not differ from the render"):
            session.layers.add("picture", [Edit(sp.render(session.splats, CAMERA).colors[0], CAMERA)])


def test_linear_assets_keep_their_darks():
    """8 bits of linear light would round 0.004 and 0.005 to the same level."""
    splats = replace(asset(), color_space="linear")
    image = np.full((SIZE, SIZE, 3), 0.004, np.float32)
    image[:, 16:] = 0.005
    with flat(splats) as session:
        layer = session.layers.add("paint", [Edit(image, CAMERA, np.ones((SIZE, SIZE), bool))])
        again = session._core.replay.main.edit_of(layer.views[0], layer).image
        np.testing.assert_allclose(again, image, atol=2e-4)
        assert session.splats.color_space == "linear"
