"""Selections: tools on specimens, kept over layers, as layers that hide, by name in the project."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import bounding_sphere
from splatpainter.io import read
from splatpainter.painter import Edit
from splatpainter.rendering import render
from splatpainter.rendering.pixel_shares import beside_mask
from splatpainter.session import Session
from splatpainter.session.selection.selection import (
    Selection,
    by_attribute,
    by_color,
    combined,
    in_box,
    in_mask,
    inverted,
    spacing,
    view_and_points,
    view_of,
)
from splatpainter.session.selection.selection_space import connected, feathered, floaters, grown, parts, shrunk
from splatpainter.splats import Splats
from splatpainter.voxels.neighbours import components, nearest_within
from tests.support.studio_scenes import ball, view

UP = np.array([0.0, -1.0, 0.0])


def moved(splats: Splats, by: tuple[float, float, float]) -> Splats:
    return replace(splats, means=(splats.means + np.array(by)).astype(np.float32))


def two_balls() -> Splats:
    return ball(1200).append(moved(ball(1200, 1), (3, 0, 0)))


def left_half(size: int = 96) -> np.ndarray:
    mask = np.zeros((size, size), np.float32)
    mask[:, : size // 2] = 1
    return mask


def test_the_nearest_point_is_that_of_all_pairs() -> None:
    rng = np.random.default_rng(3)
    points, queries = rng.normal(size=(400, 3)), rng.normal(size=(300, 3))
    queries[0] = 1e12  # far outside of every cube
    distance = np.linalg.norm(points[None] - queries[:, None], axis=2)
    near, nearest_distance = nearest_within(points, queries, 0.4)
    within = distance.min(1) <= 0.4
    assert 50 < within.sum() < 300
    assert np.array_equal(near[within], distance.argmin(1)[within]) and (near[~within] == -1).all()
    assert np.allclose(nearest_distance[within], distance.min(1)[within]) and np.isinf(nearest_distance[~within]).all()


def test_components_hang_together_over_neighbouring_cubes() -> None:
    chain = np.arange(50)[:, None] * np.array([[0.9, 0.9, 0.9]])
    far = chain + np.array([[10, 0, 0]])
    labels = components(np.concatenate([far, chain[::-1]]), 1.0)
    assert labels.tolist() == [0] * 50 + [1] * 50
    assert components(np.zeros((0, 3)), 1.0).tolist() == []


def test_a_mask_selects_the_surface_that_is_seen_or_all_behind_it() -> None:
    solid = replace(ball(3000), scales=2 * ball(3000).scales)
    front, right = solid.means[:, 2] < -0.55, solid.means[:, 0]
    surface = in_mask(solid, view(), left_half())
    through = in_mask(solid, view(), left_half(), through=True)
    left = right < -0.2
    assert surface[front & left].mean() > 0.98 and surface[right > 0.2].max() == 0
    assert surface[(solid.means[:, 2] > 0.4) & left].max() == 0
    assert through[(solid.means[:, 2] > 0.4) & left].mean() > 0.98
    hidden = replace(solid, opacities=np.where(left, 0, solid.opacities).astype(np.float32))
    assert in_mask(hidden, view(), left_half(), through=True)[left].max() == 0
    soft = in_mask(solid, view(), 0.5 * left_half())
    assert soft[front & left].mean() == pytest.approx(0.5, abs=0.02)


def test_what_a_view_draws_beside_a_mask() -> None:
    solid = ball(3000)
    beside = beside_mask(solid, view(), left_half())
    right = solid.means[:, 0]
    assert beside[right > 0.01].all() and not beside[right < -0.01].any(), "front and back alike"
    everywhere = np.ones((96, 96), np.float32)
    assert not beside_mask(solid, view(), everywhere).any()
    away = moved(solid, (50, 0, 0)).append(moved(solid, (0, 0, -50)))  # off the picture, and behind the eye
    assert beside_mask(away, view(), everywhere).all()


def test_a_selection_is_seen_from_every_side() -> None:
    solid = replace(ball(3000), scales=2 * ball(3000).scales)
    weights = in_mask(solid, view(), left_half())
    same = view_of(solid, weights, view())
    assert same[40:56, 22:36].min() > 0.9 and same[40:56, 60:74].max() < 0.1 and same[0].max() == 0
    side = view_of(solid, weights, view(angle=-90))  # from -x: what was on the left is on the right half
    assert side[44:52, 76:82].mean() > 0.8 and side[44:52, 24:36].mean() < 0.1
    assert view_of(solid, weights, view(angle=90)).mean() < 0.02


def test_what_is_selected_and_too_faint_to_be_seen_is_a_point_of_the_view() -> None:
    solid = ball(3000)
    more = solid.take([0, 0, 0, 0])
    positions = np.array([[0, 1.24, 0], [0.2, 0, -1.4], [0, 0, 1.6], [0, 0, -9]], np.float32)
    opacities = np.array([0.004, 0.02, 0.02, 0.9], np.float32)
    splats = solid.append(replace(more, means=positions, opacities=opacities, scales=np.full((4, 3), 0.02, np.float32)))
    weights = np.zeros(len(splats), np.float32)
    weights[-4:] = 1
    shares, points = view_and_points(splats, weights, view())
    assert shares.max() < 0.5
    expected = view().project(positions.astype(float))[0][:2]  # one lies behind the ball, one behind the camera
    assert points.shape == (2, 2) and np.allclose(np.sort(points, 0), np.sort(expected, 0), atol=1e-3)
    weights[:] = 1
    assert len(view_and_points(splats, weights, view())[1]) < 30, "what is tinted needs no points"
    assert np.array_equal(view_and_points(splats, weights, view())[0], view_of(splats, weights, view()))


def test_colours_as_seen_and_attributes() -> None:
    splats = ball(1500)
    red = splats.means[:, 1] > 0
    sh = np.zeros_like(splats.sh)
    sh[:, 0] = np.where(red[:, None], (1.2, -1.2, -1.2), (-1.2, -1.2, 1.2))
    splats = replace(splats, sh=sh.astype(np.float32), scales=2 * splats.scales)
    like = by_color(splats, view(), np.array([0.84, 0.16, 0.16]), 0.2)
    assert like[red & (np.abs(splats.means[:, 1]) > 0.15)].mean() > 0.98 and like[~red].mean() < 0.02
    seen = by_color(splats, view(), np.array([0.84, 0.16, 0.16]), 0.2, everywhere=False)
    assert 0 < seen.sum() < 0.8 * like.sum()
    big = np.arange(1500) % 10 == 0
    sized = replace(splats, scales=np.where(big[:, None], 3, 1).astype(np.float32) * splats.scales)
    largest = by_attribute(sized, "size", 0.901, 1, view(), UP) > 0
    assert largest.sum() == 149 and not largest[~big].any()
    top = by_attribute(splats, "height", 0.9, 1, view(), UP) > 0
    assert splats.means[top, 1].max() < -0.7
    front = by_attribute(splats, "depth", 0, 0.1, view(), UP) > 0
    assert splats.means[front, 2].max() < -0.6
    faint = replace(splats, opacities=np.where(big, 0.2, 0.9).astype(np.float32))
    assert np.array_equal(by_attribute(faint, "opacity", 0, 0.5, view(), UP) > 0, big)
    with pytest.raises(ValueError, match="expected size, opacity, depth, height, got 'x'"):
        by_attribute(splats, "x", 0, 1, view(), UP)  # type: ignore[arg-type]


def test_grow_shrink_feather_and_connected() -> None:
    splats = two_balls()
    weights = in_box(splats, np.array([-2, -2, -2]), np.array([2, 0, 2]))  # the upper half of the first ball
    more, less = grown(splats, weights, 0.3), shrunk(splats, weights, 0.3)
    y, first = splats.means[:, 1], np.arange(2400) < 1200
    assert y[more > 0].max() == pytest.approx(0.3, abs=0.05) and (more[first & (y < 0.2)] == 1).all()
    assert y[less > 0].max() == pytest.approx(-0.25, abs=0.08) and less.sum() < weights.sum()
    assert more[~first].max() == 0
    soft = feathered(splats, weights, 0.4)
    assert (soft[first & (y < -0.45)] == 1).all() and soft[y > 0.45].max() == 0
    edge = soft[first & (np.abs(y) < 0.02)]
    assert 0.3 < edge.mean() < 0.7
    seed = np.zeros(2400, np.float32)
    seed[5] = 1
    assert np.array_equal(connected(splats, seed) > 0, first)
    assert len(np.unique(parts(splats))) == 2
    assert connected(splats, np.zeros(2400)).max() == 0


def test_combining() -> None:
    a, b = np.array([0, 0.5, 1, 1], np.float32), np.array([1, 0.5, 0.5, 0.995], np.float32)
    assert combined(a, b, "add").tolist() == [1, 0.5, 1, 1]
    assert combined(a, b, "subtract").tolist() == [0, 0.25, 0.5, 0]
    assert combined(a, b, "intersect").tolist() == [0, 0.25, 0.5, 1]
    assert combined(a, b, "replace").tolist() == [1, 0.5, 0.5, 1]
    assert combined(None, b, "subtract").tolist() == [0, 0, 0, 0]
    hidden = replace(ball(4), opacities=np.array([0, 1, 1, 1], np.float32))
    assert inverted(hidden, a).tolist() == [0, 0.5, 0, 0]
    with pytest.raises(ValueError, match="expected replace, add"):
        combined(a, b, "xor")  # type: ignore[arg-type]


def planted(splats: Splats, seed: int = 0) -> tuple[Splats, int]:
    """(an asset with clusters of up to 30 Gaussians in the air around it, how many Gaussians those are)."""
    rng, gap = np.random.default_rng(seed), spacing(splats)
    center, radius = bounding_sphere(splats)
    clusters: list[np.ndarray] = []
    while len(clusters) < 25:
        at = center + rng.normal(size=3) * radius
        if np.linalg.norm(splats.means - at, axis=1).min() > 4 * gap:
            clusters.append(at + rng.normal(size=(rng.integers(1, 31), 3)) * 0.5 * gap)
    means = np.concatenate(clusters).astype(np.float32)
    more = splats.take(rng.integers(0, len(splats), len(means)))
    opacities = rng.uniform(0.1, 0.95, len(means)).astype(np.float32)
    more = replace(more, means=means, opacities=opacities, scales=np.full((len(means), 3), gap / 2, np.float32))
    return splats.append(more), len(means)


def test_planted_floaters_are_found() -> None:
    splats, count = planted(ball(3000))
    chosen = floaters(splats)
    assert chosen[-count:].mean() > 0.9 and chosen[:-count].max() == 0
    assert floaters(ball(3000)).max() == 0


def test_planted_floaters_are_found_around_a_capture(shared: Path) -> None:
    capture = read(shared / "data/splats/massa.ply").numpy()
    capture = replace(capture, source=None)
    splats, count = planted(capture)
    chosen = floaters(splats)
    assert chosen[-count:].mean() > 0.95
    assert chosen[:-count].mean() < 0.005  # haze in the air, which no part touches


def test_a_selection_outlives_layers_and_travels_as_a_picture(tmp_path: Path) -> None:
    with Session(ball(2000), tmp_path / "a.splatproj") as session:
        before = session.splats
        weights = in_mask(before, view(), left_half())
        selection = Selection.of(weights, before, session.original)
        assert np.abs(selection.on(before, session.original) - weights).max() <= 0.5 / 255
        image = render(before, view()).colors[0].copy()
        mask = np.zeros((96, 96), bool)
        mask[40:56, 24:72] = True
        image[mask] = (0.9, 0.1, 0.1)
        session.layers.add("paint", [Edit(image, view(), mask)])
        after = session.splats
        assert len(after) > len(before)
        now = selection.on(after, session.original)
        seen = view_of(after, now, view())
        assert seen[44:52, 28:40].mean() > 0.9 and seen[44:52, 58:68].mean() < 0.1  # the paint takes part
        session.undo()
        assert np.array_equal(selection.on(session.splats, session.original), selection.on(before, session.original))
        painted = Selection.of(now, after, session.original)
        again = Selection.from_png(painted.to_png(), 2000)
        assert all(np.array_equal(getattr(painted, k), getattr(again, k)) for k in vars(painted))
        assert np.abs(again.on(after, session.original) - now).max() <= 1 / 255
        for data in (b"", painted.to_png()[:-40], selection.to_png().replace(b"IDAT", b"IDAX")):
            with pytest.raises(ValueError, match="expected the selection of 2000"):
                Selection.from_png(data, 2000)
        with pytest.raises(ValueError, match="expected the selection of 1999"):
            Selection.from_png(painted.to_png(), 1999)


def test_hiding_is_a_layer_and_brings_everything_back(tmp_path: Path) -> None:
    path = tmp_path / "a.splatproj"
    with Session(ball(1500), path) as session:
        before = session.splats
        weights = np.zeros(1500, np.float32)
        weights[:300], weights[300:400] = 1, 0.5
        layer = session.layers.hide_selected(weights, "Junk")
        hidden = session.splats
        assert len(hidden) == 1500 and (hidden.opacities[:300] == 0).all()
        assert np.allclose(hidden.opacities[300:400], 0.5 * before.opacities[300:400], atol=1e-2)
        assert np.array_equal(hidden.opacities[400:], before.opacities[400:])
        receipt = session.files.receipt()
        assert receipt.removed.tolist() == list(range(300)) and len(receipt.touched) == 400
        session.layers.set(layer.id, opacity=0.5)
        assert np.allclose(session.splats.opacities[:300], 0.5 * before.opacities[:300])
        session.layers.set(layer.id, opacity=1.0)
        session.layers.set(layer.id, visible=False)
        assert np.array_equal(session.splats.opacities, before.opacities)
        session.layers.set(layer.id, visible=True)
        with pytest.raises(ValueError, match="nothing is selected"):
            session.layers.hide_selected(np.zeros(1500))
        with pytest.raises(ValueError, match="finite weights"):
            session.layers.hide_selected(np.zeros(7))
    with Session.load(path) as session:
        assert (session.splats.opacities[:300] == 0).all() and session.verify(repaint=True) == []
        while session.undo():
            pass
        assert np.array_equal(session.splats.opacities, before.opacities)


def test_hidden_gaussians_are_removed_for_good_only_at_export_and_the_receipt_says_so(tmp_path: Path) -> None:
    with Session(ball(1000), tmp_path / "a.splatproj") as session:
        weights = np.zeros(1000, np.float32)
        weights[200:300] = 1
        session.layers.hide_selected(weights)
        image = render(session.splats, view()).colors[0].copy()
        mask = np.zeros((96, 96), bool)
        mask[40:56, 40:56] = True
        image[mask] = (0.9, 0.1, 0.1)
        session.layers.add("paint", [Edit(image, view(), mask)])
        now = session.splats
        full, _ = session.files.export(tmp_path / "all.ply")
        assert full.asset_rows == 1000 and len(read(tmp_path / "all.ply")) == len(now) and full.dropped is None
        receipt, proof = session.files.export(tmp_path / "visible.ply", remove_hidden=True)
        visible = now.opacities > 0
        assert proof.ok and receipt.dropped is not None
        assert receipt.dropped["rows"] == 1000 and receipt.dropped["left_out"] == int((~visible[:1000]).sum()) >= 100
        assert "removed for good" in receipt.note and len(session.splats) == len(now)
        written = read(tmp_path / "visible.ply")
        assert len(written) == visible.sum() and np.allclose(written.means, now.means[visible])
        again = type(receipt).from_json((tmp_path / "visible.ply.receipt.json").read_text())
        assert again.dropped == receipt.dropped
        session.layers.hide_selected(np.ones(len(now)))
        with pytest.raises(ValueError, match="everything is hidden"):
            session.files.export(tmp_path / "none.ply", remove_hidden=True)


def test_a_look_keeps_to_a_selection_and_selections_have_names(tmp_path: Path) -> None:
    from splatpainter.io.files import sha256

    path = tmp_path / "a.splatproj"
    with Session(ball(1000), path) as session:
        weights = np.zeros(1000, np.float32)
        weights[:100], weights[100:200] = 1, 0.5
        session.selections.save("Upper part", weights)
        data = Selection.of(weights, session.splats, session.original).to_png()
        before = session.splats.sh
        gain = {"look": "gain", "settings": {"gain": [0, 0, 0]}}
        session.layers.add("look", name="Dark", **gain, selection=sha256(data), attached=[data])
        after = session.splats.sh
        full = -0.5 / 0.28209479177387814
        assert np.allclose(after[:100, 0], full) and np.array_equal(after[200:], before[200:])
        assert np.allclose(after[100:200, 0], (before[100:200, 0] + full) / 2, atol=0.02)
        with pytest.raises(ValueError, match="a name of at most 80"):
            session.selections.save("", weights)
    with Session.load(path) as session:
        assert session.selections.names() == ["Upper part"]
        assert np.abs(session.selections.load("Upper part") - weights).max() < 0.01
        assert session.verify(repaint=True) == []
        with pytest.raises(ValueError, match="expected one of Upper part, got 'x'"):
            session.selections.load("x")
        session.selections.delete("Upper part")
        assert session.selections.names() == []
