"""The edit that is solved exactly: against numpy's least squares, and its gradients against differences."""

from __future__ import annotations

import numpy as np
import torch

from splatpainter.nn.fast_weights import solve_ridge

RNG = np.random.default_rng(0)
FEATURES, TARGETS = RNG.normal(size=(40, 6)), RNG.normal(size=(40, 3))
WEIGHTS = RNG.uniform(0, 3, 40)


def solved(features: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return solve_ridge(*(torch.from_numpy(x) for x in (features, targets, weights))).numpy()


def test_it_is_least_squares_with_the_penalty_as_further_rows() -> None:
    root = np.sqrt(WEIGHTS)[:, None]
    rows, aims = np.concatenate([FEATURES * root, np.eye(6)]), np.concatenate([TARGETS * root, np.zeros((6, 3))])
    expected = np.linalg.lstsq(rows, aims, rcond=None)[0]
    np.testing.assert_allclose(solved(FEATURES, TARGETS, WEIGHTS), expected, atol=1e-12)


def test_a_row_of_weight_two_is_two_rows_and_one_of_weight_zero_is_none() -> None:
    twice = solved(FEATURES, TARGETS, np.full(40, 2.0))
    doubled = solved(np.tile(FEATURES, (2, 1)), np.tile(TARGETS, (2, 1)), np.ones(80))
    np.testing.assert_allclose(twice, doubled, atol=1e-12)
    some = np.where(np.arange(40) < 25, 1.0, 0.0)
    np.testing.assert_allclose(
        solved(FEATURES, TARGETS, some), solved(FEATURES[:25], TARGETS[:25], np.ones(25)), atol=1e-12
    )
    assert not solved(FEATURES, TARGETS, np.zeros(40)).any()


def test_much_evidence_is_believed() -> None:
    truth = RNG.normal(size=(6, 3))
    np.testing.assert_allclose(solved(FEATURES, FEATURES @ truth, np.full(40, 1e9)), truth, atol=1e-6)


def test_gradients() -> None:
    inputs = [torch.from_numpy(x[:9].copy()).requires_grad_() for x in (FEATURES, TARGETS, WEIGHTS + 0.1)]
    assert torch.autograd.gradcheck(solve_ridge, inputs)
