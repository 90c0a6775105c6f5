"""Layers that fill holes: one step with what they remove, undone and replayed bit for bit, coloured anew, exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.color import base_color
from splatpainter.painter import Edit
from splatpainter.receipts import verify
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.session.project.asset_files import read_layer
from splatpainter.splats import ATTRIBUTES, Splats
from tests.holes.test_body import ground, sphere
from tests.support.cli_scenes import ball, saved


def same_bits(a: Splats, b: Splats) -> bool:
    return len(a) == len(b) and all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in ATTRIBUTES)


def test_the_whole_body_goes_and_a_closed_surface_is_no_refusal(tmp_path: Path) -> None:
    floor, small = ground((0.5, 0.35, 0.2)), sphere(0.5, (0.9, 0.8, 0.1))
    is_ball = np.arange(len(floor) + len(small)) >= len(floor)
    asset = saved(tmp_path / "scene.ply", floor.append(small))
    with Session(asset, tmp_path / "a.splatproj") as session:
        before = session.splats
        front = (is_ball & (before.means[:, 2] > 0)).astype(np.float32)
        layer = session.layers.fill(front, remove=True, body=True)
        gone = (before.opacities > 0) & (session.splats.opacities[: len(before)] == 0)
        np.testing.assert_array_equal(gone, is_ball)
        note = session.layers.facts(layer.id)["note"]
        assert f"{len(small):,} Gaussians removed; hidden, nothing filled: the surface is closed" in note
        assert len(session.splats) == len(before) and session.verify(repaint=True) == []
        assert session.undo() and same_bits(session.splats, before)
        session.layers.fill(front, remove=True)  # only what is selected
        assert (session.splats.opacities[: len(before)] == 0).sum() == front.sum()


def cap(splats: Splats) -> np.ndarray:
    return (((splats.means - np.array([0, 0, -1])) ** 2).sum(1) < 0.45**2).astype(np.float32)


def test_a_fill_is_a_layer_over_what_it_removed(tmp_path: Path) -> None:
    asset = saved(tmp_path / "ball.ply", ball(1500))
    project = tmp_path / "a.splatproj"
    with Session(asset, project) as session:
        original = session.splats
        with pytest.raises(ValueError, match="nothing is selected"):
            session.layers.fill(np.zeros(len(original), np.float32))
        weights = cap(original)
        layer = session.layers.fill(weights, remove=True, name="Chip")
        assert [entry.kind for entry in session.layers] == ["hide", "fill"] and layer.kind == "fill"
        assert session.layers[0].name == "Chip: removed" and session.history[-1].label == "remove and fill"
        filled = session.splats
        count = len(filled) - len(original)
        assert count > 20 and (filled.opacities[: len(original)][weights > 0] == 0).all()
        assert f"{count:,} Gaussians" in session.layers.facts(layer.id)["note"]
        assert session.undo() and same_bits(session.splats, original) and not session.layers
        assert session.redo() and same_bits(session.splats, filled)

        session.layers.set(layer.id, opacity=0.5)
        np.testing.assert_allclose(session.splats.opacities[len(original) :], 0.5 * filled.opacities[len(original) :])
        assert np.array_equal(session.splats.sh, filled.sh)
        session.undo()
        session.layers.set(
            session.layers[0].id, visible=False
        )  # what was removed is back: the fill still knows what is gone
        assert (session.splats.opacities[: len(original)] == original.opacities).all()
        session.undo()
        assert same_bits(session.splats, filled)
        assert session.verify(repaint=True) == []
    with Session(project) as session:
        assert same_bits(session.splats, filled)
        session.files.export_layer(layer.id, tmp_path / "chip.splatlayer")
        assert read_layer(tmp_path / "chip.splatlayer")[0].operation.fill == "removed"  # pyright: ignore[reportAttributeAccessIssue]
        receipt, _ = session.files.export(tmp_path / "filled.ply")
        assert receipt.appended_rows == count and "Chip" in receipt.note
        assert verify(asset, tmp_path / "filled.ply").ok


def test_a_fill_takes_the_colours_of_a_picture_and_gives_them_back(tmp_path: Path) -> None:
    splats = ball(1500)
    full = splats.take(np.flatnonzero(cap(splats) == 0))
    around = ((full.means - np.array([0, 0, -1])) ** 2).sum(1) < 0.7**2
    camera = look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), width=64, height=64, fov=45)
    with Session(full, tmp_path / "a.splatproj") as session:
        layer = session.layers.fill(around.astype(np.float32))
        assert [entry.kind for entry in session.layers] == ["fill"]
        before, count = session.splats, len(session.original)
        image = render(before, camera).colors[0].copy()
        mask = np.zeros((64, 64), bool)
        mask[22:42, 22:42] = True
        image[mask] = (0.1, 0.7, 0.2)
        with pytest.raises(ValueError, match="expected a mask"):
            session.layers.fill_from(layer.id, [Edit(image, camera)])
        session.layers.fill_from(
            layer.id, [Edit(image, camera, mask, "green")], source={"name": "test", "prompt": "moss"}
        )
        after = session.splats
        assert same_bits(after.take(np.arange(count)), before.take(np.arange(count)))
        assert np.array_equal(after.means, before.means)
        colors = base_color(after.sh[count:])
        assert (colors[:, 1] - colors[:, 0]).max() > 0.4
        assert session.files.receipt().source == {"layers": [{"layer": "Fill", "name": "test", "prompt": "moss"}]}
        assert session.verify(repaint=True) == []
        session.layers.fill_from(layer.id, [])
        assert same_bits(session.splats, before) and session.files.receipt().source is None
        session.undo()
        assert same_bits(session.splats, after)
        paint = session.layers.new()
        with pytest.raises(ValueError, match="expected a layer that fills"):
            session.layers.fill_from(paint.id, [])
