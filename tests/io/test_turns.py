"""Flips and rotations of rows, by what they do to colour and shape."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from splatpainter.io.axes import flip, move, move_back, sh_flip_signs
from splatpainter.transforms import sh_basis
from tests.support.io_assets import random_splats
from tests.support.io_packed import covariances, same_bits


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def random_rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_flip(signs: tuple[int, int, int]) -> None:
    d, splats = directions(50), random_splats(30, 4)
    assert np.abs(sh_basis(d * signs, 4) - sh_basis(d, 4) * sh_flip_signs(25, signs)).max() < 1e-12
    flipped = flip(splats, signs)
    # What is seen of the mirrored object from the mirrored direction is what was seen before.
    assert np.abs(sh_basis(d * signs, 4) @ flipped.sh - sh_basis(d, 4) @ splats.sh).max() < 1e-5
    mirror = np.diag(signs).astype(float)
    assert np.allclose(covariances(flipped), mirror @ covariances(splats) @ mirror, rtol=1e-5, atol=1e-9)
    assert np.array_equal(flipped.means, splats.means * np.array(signs, np.float32))
    assert same_bits(flip(flipped, signs), splats)


@pytest.mark.parametrize("seed", range(4))
def test_move(seed: int) -> None:
    d, splats, turn = directions(50), random_splats(30, 4, seed), random_rotation(seed)
    shift = np.array([1.0, -2.0, 0.5])
    moved = move(splats, turn, 1.7, shift)
    assert np.allclose(moved.means, 1.7 * splats.means @ turn.T + shift, atol=1e-5)
    assert np.allclose(covariances(moved), 1.7**2 * turn @ covariances(splats) @ turn.T, rtol=1e-4, atol=1e-8)
    assert np.abs(sh_basis(d @ turn.T, 4) @ moved.sh - sh_basis(d, 4) @ splats.sh).max() < 1e-5
    back = move_back(moved, turn, 1.7, shift)
    for name in ("means", "quats", "scales", "sh"):
        assert np.allclose(getattr(back, name), getattr(splats, name), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_are_exact(axis: int) -> None:
    splats = random_splats(30, 4)
    turn = np.where(np.arange(3) == axis, 1.0, -1.0)
    moved = move(splats, np.diag(turn))
    assert np.array_equal(moved.means, splats.means * turn.astype(np.float32))
    assert np.array_equal(np.sort(np.abs(moved.quats), 1), np.sort(np.abs(splats.quats), 1))
    assert same_bits(move_back(moved, np.diag(turn)), splats)
