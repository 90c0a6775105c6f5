"""Masks of layers: what shows where, exact at both ends, on layers of every kind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.session.document.layer_mask import LayerMask, MaskPart, by_rule, over
from splatpainter.session.measures.curvature import bend_degrees
from splatpainter.splats import Splats
from tests.support import surface_shapes
from tests.support.session_scenes import BLUE, CAMERA, RED, SIZE, dab, flat, load, print_of

LEFT = np.zeros((SIZE, SIZE), np.float32)
LEFT[:, : SIZE // 2] = 1


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "one.splatproj"


def test_hidden_is_not_there_and_revealed_is_all_of_it(path: Path) -> None:
    with flat(project=path) as session:
        before = print_of(session)
        layer = session.layers.new()
        session.strokes.paint(layer.id, [dab(RED, radius=9)])
        full, splats = print_of(session), session.splats
        session.masks.set(layer.id, LayerMask(shows=False))
        assert print_of(session) == before
        session.masks.paint(layer.id, CAMERA, np.ones_like(LEFT), np.ones_like(LEFT))
        np.testing.assert_array_equal(session.splats.sh, splats.sh)
        session.masks.paint(layer.id, CAMERA, np.zeros_like(LEFT), LEFT)
        half, original = session.splats, session.original
        n = len(original)
        same = (half.scales[:n] == original.scales).all(1)
        left = np.flatnonzero(same & (original.means[:, 0] < -0.7))
        right = np.flatnonzero(same & (original.means[:, 0] > 0.7))
        np.testing.assert_allclose(half.sh[left], original.sh[left], atol=0.01)
        np.testing.assert_allclose(half.sh[right], splats.sh[right], atol=0.01)
        mask = session.layers.by_id(layer.id).mask
        assert mask is not None and len(mask.parts) == 1  # of one view
        session.masks.set(layer.id, replace(mask, enabled=False), what="mask off")
        assert print_of(session) == full
        session.undo()
        painted = print_of(session)
    with load(path) as session:
        assert print_of(session) == painted and session.verify(repaint=True) == []
        session.masks.set(layer.id, None)
        assert print_of(session) == full
        with pytest.raises(ValueError, match="nothing was painted"):
            session.masks.paint(layer.id, CAMERA, LEFT, np.zeros_like(LEFT))
        with pytest.raises(ValueError, match="expected pictures of shape"):
            session.masks.paint(layer.id, CAMERA, LEFT[1:], LEFT[1:])


@pytest.mark.parametrize("kind", ["picture", "look", "merged", "erase"])
def test_layers_of_every_kind_have_masks(kind: str) -> None:
    with flat() as session:
        if kind == "erase":
            session.layers.add("paint", [dab(BLUE, radius=9)])
        below = session.splats
        if kind == "look":
            layer = session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]})
        elif kind == "merged":
            layers = [session.layers.add("picture", [dab(RED, x)]) for x in (12, 20)]
            layer = session.layers.merge([one.id for one in layers])
        else:
            layer = session.layers.add(kind, [dab(RED, radius=9)])  # type: ignore[arg-type]
        full = session.splats
        session.masks.paint(layer.id, CAMERA, np.zeros_like(LEFT), LEFT)
        masked, n = session.splats, len(below)
        geometry = (full.scales[:n] == below.scales).all(1) & (full.opacities[:n] == below.opacities)
        left, right = geometry & (below.means[:, 0] < -0.7), geometry & (below.means[:, 0] > 0.7)
        np.testing.assert_allclose(masked.sh[:n][left], below.sh[left], atol=0.01)
        np.testing.assert_allclose(masked.sh[:n][right], full.sh[:n][right], atol=0.01)
        assert np.abs(full.sh[:n] - masked.sh[:n]).max() > 0.01


def test_rules_show_by_height_slope_and_coverage() -> None:
    with flat() as session:
        session.layers.add("paint", [dab(BLUE, 12, radius=4)])
        below = session.splats
        layer = session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]})

        def changed(mask: LayerMask) -> np.ndarray:
            session.masks.set(layer.id, mask)
            return (session.splats.sh != below.sh).any((1, 2))

        heights = -below.means[:, 1]
        share = (heights - heights.min()) / np.ptp(heights)
        upper = changed(LayerMask(parts=(by_rule("height", 0.6, 1),)))
        np.testing.assert_array_equal(upper, share >= 0.6)
        assert upper.sum() < changed(LayerMask(parts=(by_rule("height", 0.6, 1, 0.3),))).sum()
        facing, away = (changed(LayerMask(parts=(by_rule("slope", 0, 90, axis=(0, 0, z)),))) for z in (-1, 1))
        assert facing.any() and not (facing & away).any() and (facing | away).all()
        tilted = by_rule("slope", 59, 61, axis=(0, 3**0.5 / 2, -0.5))
        np.testing.assert_array_equal(changed(LayerMask(parts=(tilted,))), facing)
        seen = changed(LayerMask(parts=(by_rule("coverage", 1, 1),)))
        assert 0 < seen.sum() < len(below) and not (seen & changed(LayerMask(parts=(by_rule("coverage", 0, 0),)))).any()


def test_edges_bend_outwards_and_crevices_inwards() -> None:
    sphere, box = surface_shapes.sphere(3000), surface_shapes.box(4000)
    bend = bend_degrees(sphere)
    assert np.quantile(bend, 0.05) > 15 and np.quantile(bend, 0.95) < 16  # 3 widths each way, in degrees
    from_edge = np.sort(0.5 - np.abs(box.means), 1)[:, 1]  # distance of a face's point from its next edge
    bend = bend_degrees(box)
    assert abs(np.median(bend[from_edge > 0.2])) < 1 and np.median(bend[from_edge < 0.02]) > 15
    # what stands on a floor meets it in a crevice
    walls = box.take(np.flatnonzero(box.means[:, 1] < 0.499))
    floor = surface_shapes.box(9000, half=(1.5, 0.02, 1.5))
    means = np.concatenate([walls.means, floor.means + np.array([0, 0.52, 0], np.float32)])
    quats, scales, opacities, sh = (
        np.concatenate([getattr(walls, name), getattr(floor, name)]) for name in ("quats", "scales", "opacities", "sh")
    )
    bend = bend_degrees(Splats(means, quats, scales, opacities, sh))
    beside = (np.abs(means[:, 1] - 0.5) < 1e-3) & (np.abs(means[:, 0]) > 0.5) & (np.abs(means[:, 2]) < 0.35)
    assert np.median(bend[beside & (np.abs(means[:, 0]) < 0.54)]) < -20
    assert abs(np.median(bend[beside & (np.abs(means[:, 0]) > 0.7)])) < 1
    assert not bend_degrees(sphere.take(np.arange(3))).any()


def test_records_go_there_and_back_and_others_are_refused() -> None:
    mask = LayerMask(False, (MaskPart(CAMERA, "a" * 64), by_rule("height", 0, 0.5, 0.1)), enabled=False)
    again = LayerMask.parse(mask.record(), "x")
    assert again is not None and again.record() == mask.record() and again.pictures() == {"a" * 64}
    record = mask.record()
    for part in ({"rule": "mood"}, {"low": 2.0}, {"soft": -1.0}, {"axis": [0, 0, 0]}, {"axis": [0, 1]}, {"low": 1e9}):
        wrong = {**record, "parts": [{**record["parts"][1], **part}]}
        with pytest.raises(ValueError, match="expected"):
            LayerMask.parse(wrong, "x")
    with pytest.raises(ValueError, match="SHA-256"):
        LayerMask.parse({**record, "parts": [{**record["parts"][0], "picture": "../x"}]}, "x")
    with pytest.raises(ValueError, match="at most"):
        LayerMask.parse({**record, "parts": record["parts"] * 200}, "x")


def test_one_part_over_another_is_both_in_turn() -> None:
    weight, first, second = 0.3, (1.0, 0.5), (0.0, 0.25)
    after = weight * 0.5 + 0.5
    after = after * 0.75 + 0.0
    shows, share = over(*(np.array([value]) for value in (*first, *second)))
    np.testing.assert_allclose(weight * (1 - share) + shows * share, after)


def test_a_selection_is_a_mask_from_every_side(path: Path) -> None:
    with flat(project=path) as session:
        original = session.splats
        layer = session.layers.add("look", look="gain", settings={"gain": [0.5, 1, 1]})
        painted = session.layers.new()
        session.strokes.paint(painted.id, [dab(RED, radius=9)])
        full = print_of(session)
        with pytest.raises(ValueError, match="nothing of its asset is selected"):
            session.masks.set_selection(layer.id, np.zeros(len(session.splats), np.float32))
        assert print_of(session) == full
        session.masks.set_selection(painted.id, (session.splats.means[:, 0] < 0).astype(np.float32))
        session.masks.set_selection(layer.id, (session.splats.means[:, 0] > 0).astype(np.float32))
        session.layers.set(painted.id, visible=False)
        n = len(original)
        changed = (session.splats.sh[:n] != original.sh).any((1, 2))
        np.testing.assert_array_equal(changed, original.means[:, 0] > 0)
        session.layers.set(painted.id, visible=True)
        painted_now = (session.splats.sh[:n, 0, 0] > original.sh[:, 0, 0] + 0.1) & (original.means[:, 0] > 0.1)
        assert not painted_now.any()
        masked = print_of(session)
    with load(path) as session:
        assert print_of(session) == masked and session.verify(repaint=True) == []
        mask = session.layers.by_id(layer.id).mask
        assert mask is not None and mask.pictures() == {mask.parts[0].selection}
        session.masks.set(layer.id, None)
        session.masks.set(painted.id, None)
        assert print_of(session) == full
    with pytest.raises(ValueError, match="expected the SHA-256 of a selection"):
        LayerMask.parse({"shows": True, "enabled": True, "parts": [{"selection": "no"}]}, "a layer")
