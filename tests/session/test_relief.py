"""Copies of Gaussians with their relief: where they lie, how they look, what fades, and that all of it goes back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.rendering import render
from splatpainter.session import Session
from splatpainter.session.document.layer_operation import operation_of_layer
from splatpainter.session.kinds.relief_layers import CopyAnchor, ReliefLayer
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix


def board() -> Splats:
    """A grey plate in the plane z = 0 (normal -z), dense flat Gaussians, with a red rivet standing on it at (-1, 0)."""
    x, y = np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-1, 1, 21))
    plate = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    rng = np.random.default_rng(0)
    rivet = rng.uniform(-0.12, 0.12, (60, 3)) * (1, 1, 0.5) + (-1, 0, -0.25)
    means = np.concatenate([plate, rivet]).astype(np.float32)
    count = len(means)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    quats[: len(plate)] = (1, 0, 0, 0)
    scales = np.full((count, 3), 0.05, np.float32)
    scales[: len(plate), 2] = 0.01
    sh = np.zeros((count, 4, 3), np.float32)
    sh[len(plate) :, 0] = (1.4, -1.2, -1.2)
    sh[len(plate) :, 1:] = rng.normal(0, 0.1, (60, 3, 3))
    return Splats(means, quats, scales, np.full(count, 0.98, np.float32), sh)


FRONT = np.array([0.0, 0, -1])
RIVET = slice(861, 921)


def relief(
    to: tuple[float, float, float] = (1.0, 0.0, 0.0), normal: np.ndarray = FRONT, radius: float = 0.4
) -> ReliefLayer:
    source = CopyAnchor.of(np.array([-1.0, 0, 0]), FRONT, np.array([1.0, 0, 0]))
    return ReliefLayer(source, CopyAnchor.of(np.array(to), normal, np.array([1.0, 0, 0])), radius)


def test_a_copy_is_the_rivet_elsewhere_and_can_be_taken_back(tmp_path: Path) -> None:
    splats = board()
    camera = look_at((0, 0, -4), (0, 0, 0), (0, -1, 0), width=200, height=100, fov=35)
    side = look_at((0.3, -1.6, -0.8), (1, 0, 0), (0, 0, -1), width=60, height=60, fov=40)
    with Session(splats, tmp_path / "a.splatproj") as session:
        layer = session.layers.copy_relief(relief())
        after = session.splats
        assert np.array_equal(after.means[: len(splats)], splats.means)
        picture = render(after, camera).colors[0]
        before = render(splats, camera).colors[0]
        at = lambda x: slice(int(x) - 6, int(x) + 7)  # noqa: E731
        left, right = camera.project(np.array([[-1.0, 0, -0.25], [1, 0, -0.25]]))[0]
        there, here = picture[at(right[1]), at(right[0])], before[at(left[1]), at(left[0])]
        assert here[6, 6, 0] > 0.7 and here[6, 6, 1] < 0.3, "the rivet is red"
        assert np.abs(there[6, 6] - here[6, 6]).max() < 0.12 and there[6, 6, 0] - there[6, 6, 1] > 0.4
        assert np.abs(picture[:, :90] - before[:, :90]).max() < 1e-6, "elsewhere nothing changes"
        assert render(after, side).colors[0][..., 0].max() > 0.6, "it stands off the plate"
        session.layers.set(layer.id, visible=False)
        assert all(np.array_equal(getattr(session.splats, name), getattr(splats, name)) for name in ("means", "sh"))
        assert np.array_equal(session.splats.opacities, splats.opacities)
        session.layers.set(layer.id, visible=True)
        bits = session.splats
    with Session(tmp_path / "a.splatproj") as session:
        assert np.array_equal(session.splats.means, bits.means) and session.verify(repaint=True) == []
        session.undo()
        assert len(session.layers) == 1


def test_the_copy_turns_with_the_surface() -> None:
    """Onto a plane at a right angle: heights along its normal, rotations and view dependence turned along."""
    splats = board()
    turned = relief((0.0, 0.5, 2.0), np.array([0.0, -1, 0]))
    made = turned.delta(splats)
    copies, parents = made.appended, made.parent_ids
    assert set(range(861, 921)) <= set(parents.tolist())
    local = turned.source.local(splats.means[parents])
    assert np.allclose(turned.target.local(copies.means), local, atol=1e-5)
    rivet = np.flatnonzero(parents >= 861)
    assert (copies.means[rivet, 1] < 0.5).all(), "above the plane, whose normal is -y"
    turn = turned.target.axes @ turned.source.axes.T
    expected = turn @ quat_to_matrix(splats.quats[parents].astype(float))
    assert np.allclose(quat_to_matrix(copies.quats.astype(float)), expected, atol=1e-5)
    direction = np.array([0.36, 0.48, -0.8])
    seen = splats.sh[parents][:, 1:].transpose(0, 2, 1) @ (direction[[1, 2, 0]] * (-1, 1, -1))
    after = copies.sh[:, 1:].transpose(0, 2, 1) @ ((turn @ direction)[[1, 2, 0]] * (-1, 1, -1))
    assert np.allclose(seen, after, atol=1e-5)


def test_both_edges_are_soft_and_fade_alike() -> None:
    splats, one = board(), relief()
    made = one.delta(splats)
    weights = one.weights(one.source, splats)[made.parent_ids]
    assert np.allclose(made.appended.opacities, splats.opacities[made.parent_ids] * weights)
    assert ((weights > 0) & (weights < 1)).sum() > 10
    under = one.weights(one.target, splats)[made.gaussian_ids]
    assert np.allclose(made.values.opacities, splats.opacities[made.gaussian_ids] * (1 - under), atol=1e-6)


def test_what_cannot_be_copied_is_one_line(tmp_path: Path) -> None:
    with Session(board(), tmp_path / "a.splatproj") as session:
        far = replace(relief(), source=CopyAnchor.of(np.array([50.0, 0, 0]), FRONT, np.array([1.0, 0, 0])))
        with pytest.raises(ValueError, match="nothing within the brush"):
            session.layers.copy_relief(far)
        assert not session.layers
    record = relief().record()
    for damaged in (
        {"kind": "relief"},
        {"kind": "relief", "radius": True},
        {**record, "radius": -1},
        {**record, "source": {"point": [0, 0], "axes": []}},
        {**record, "target": {"point": [0, 0, "x"], "axes": [[1]]}},
        {**record, "target": {"point": [0, 0, 0], "axes": np.zeros((3, 3)).tolist()}},
    ):
        with pytest.raises(ValueError, match="^layer: copy: expected") as error:
            operation_of_layer(damaged, "layer")
        assert "\n" not in str(error.value)
    assert operation_of_layer(record, "layer").record() == record
