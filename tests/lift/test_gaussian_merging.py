"""Joining split Gaussians: moments stay, colours and old indices are kept apart, what is never drawn goes."""

from __future__ import annotations

import numpy as np

from splatpainter.lift.local.gaussian_merging import MERGING, Merged, merge
from splatpainter.lift.local.split import Lattice, projected_sizes
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from tests.support.lift_scenes import base_colors, bits, db, front, row, same_bits, sheet

CAMERA = front(128)
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9)


def covariances(splats: Splats) -> np.ndarray:
    axes = quat_to_matrix(splats.quats.astype(np.float64)) * splats.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def joined(splats: Splats, slots: np.ndarray | None = None, pixels: float = 10.0) -> Merged:
    """All may be joined; they want the colours that they have."""
    count = len(splats)
    slots = np.zeros(count, bool) if slots is None else slots
    return merge(splats, CAMERA, np.ones(count, bool), slots, base_colors(splats), np.full(count, pixels))


def pair(apart: float = 0.03, second: tuple[float, float, float] = RED, opacity: float = 0.4) -> Splats:
    one = row((0.2, -0.1, 0), (0.03, 0.02, 0.004), RED, opacity=opacity, degree=1)
    return one.append(row((0.2 + apart, -0.1, 0.01), (0.03, 0.02, 0.004), second, opacity=opacity, degree=1))


def test_a_pair_becomes_one_of_the_same_moments():
    splats = pair()
    splats.sh[:, 1:] = np.random.default_rng(0).normal(0, 0.1, splats.sh[:, 1:].shape)
    result = joined(splats)
    assert len(result.splats) == 1 and result.group.tolist() == [0, 0]
    share = np.array([0.5, 0.5])  # equal peaks, sizes and nearly equal depths
    mean = share @ splats.means
    np.testing.assert_allclose(result.splats.means[0], mean, atol=1e-3)
    offsets = splats.means - mean
    expected = np.einsum("k,kij->ij", share, covariances(splats) + offsets[:, :, None] * offsets[:, None, :])
    np.testing.assert_allclose(covariances(result.splats)[0], expected, atol=0.03 * np.abs(expected).max())
    np.testing.assert_allclose(result.splats.sh[0], splats.sh.mean(0), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(result.splats.quats, axis=1), 1, atol=1e-5)
    assert db(render(result.splats, CAMERA).colors[0], render(splats, CAMERA).colors[0]) > 40


def test_those_that_want_other_colours_or_lie_apart_stay_two():
    for splats in (pair(second=BLUE), pair(apart=0.4)):
        result = joined(splats)
        assert same_bits(result.splats, splats) and result.source.tolist() == [0, 1]
    faint = joined(pair(second=BLUE), pixels=MERGING.max_cost)  # hardly a pixel shows them
    assert len(faint.splats) == 1


def test_old_indices_stay_and_take_what_joins_them():
    splats = pair()
    assert same_bits(joined(splats, np.array([True, True])).splats, splats)
    result = joined(splats, np.array([False, True]))
    assert result.source.tolist() == [1] and result.group.tolist() == [0, 0]


def test_what_may_not_be_joined_and_what_lies_behind_the_camera_keep_their_bits():
    behind = pair()
    behind.means[:, 2] += 2 * (CAMERA.position[2] - behind.means[:, 2])
    splats = pair().append(pair()).append(behind)
    may = np.array([True, True, False, False, True, True])
    colors, none = base_colors(splats), np.zeros(6, bool)
    result = merge(splats, CAMERA, may, none, colors, np.ones(6))
    assert result.group.tolist() == [0, 0, 1, 2, 3, 4] and result.source[1:].tolist() == [2, 3, 4, 5]
    assert same_bits(result.splats.take(np.arange(1, 5)), splats.take(np.arange(2, 6)))
    for name in ("means", "scales", "opacities", "sh"):
        assert np.isfinite(getattr(result.splats, name)).all()


def test_what_is_never_drawn_goes_unless_its_index_is_an_old_one():
    splats = pair(apart=0.4, opacity=0.003)
    assert joined(splats).group.tolist() == [-1, -1]
    assert joined(splats, np.array([True, False])).group.tolist() == [0, -1]


def test_a_sheet_that_was_split_for_nothing_looks_the_same_with_far_fewer():
    splats = sheet(6)
    lattice = Lattice.of(splats, CAMERA)
    for _ in range(2):
        lattice, _ = lattice.halved(np.ones(len(lattice), bool), 1.0)
    children = lattice.splats()
    colors = np.full((len(children), 3), 0.5)
    arguments = (CAMERA, np.asarray(lattice.level.any(1)), lattice.slot, colors, np.ones(len(children)))
    result = merge(children, *arguments)
    assert len(result.splats) < len(children) / 3
    assert lattice.slot[result.source].sum() == len(splats)  # every old index is there once
    assert len(np.unique(lattice.parent[result.source[lattice.slot[result.source]]])) == len(splats)
    again = merge(children, *arguments)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(bits(getattr(result.splats, name)), bits(getattr(again.splats, name)))
    alphas = [render(each, CAMERA).alphas[0] for each in (result.splats, children)]
    assert np.abs(alphas[0] - alphas[1]).mean() < 0.05
    # Nothing has grown beyond what it was split from by much.
    largest = projected_sizes(splats, CAMERA).max()
    assert projected_sizes(result.splats, CAMERA).max() < 2 * largest
