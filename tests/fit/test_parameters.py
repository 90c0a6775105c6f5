"""Adam over Gaussians is torch's Adam, Gaussians may come and go."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatpainter.fit.devices import as_numpy, copied
from splatpainter.fit.parameters import BETAS, EPSILON, Adam

SHAPES = {"means": (3000, 3), "opacities": (3000,), "sh": (3000, 4, 3)}


def values(seed: int, scale: float = 1.0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {name: scale * torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}


def rates() -> dict[str, np.ndarray]:
    bands = np.array([0.02] * 3 + [0.001] * 9, np.float32)
    return {"means": np.array([0.01], np.float32), "opacities": np.array([0.05], np.float32), "sh": bands}


def arrays(tensors: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
    return {name: tensor.numpy().copy() for name, tensor in tensors.items()}


@pytest.mark.parametrize("kind", ["arrays", "tensors"])  # the CPU's, and what other devices run
def test_five_steps_are_those_of_torch(kind: str) -> None:
    convert = arrays if kind == "arrays" else dict
    ours = values(0)
    leaves = {name: value.clone().requires_grad_() for name, value in ours.items() if name != "sh"}
    first, rest = (part.clone().requires_grad_() for part in (ours["sh"][:, :1], ours["sh"][:, 1:]))
    groups = [
        {"params": [leaves["means"]], "lr": 0.01},
        {"params": [leaves["opacities"]], "lr": 0.05},
        {"params": [first], "lr": 0.02},
        {"params": [rest], "lr": 0.001},
    ]
    theirs = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON)
    moved = convert(ours)
    adam = Adam(moved)
    for step in range(5):
        gradients = values(10 + step, 1e-6)
        gradients["means"][7] = 0  # a Gaussian that no view sees
        for name, leaf in leaves.items():
            leaf.grad = gradients[name].clone()
        first.grad, rest.grad = gradients["sh"][:, :1].clone(), gradients["sh"][:, 1:].clone()
        adam.step(moved, convert(gradients), rates())
        theirs.step()
    expected = {**leaves, "sh": torch.cat([first, rest], 1)}
    for name, value in moved.items():
        np.testing.assert_allclose(
            np.asarray(value), expected[name].detach().numpy(), rtol=1e-6, atol=1e-6, err_msg=name
        )
    np.testing.assert_array_equal(moved["means"][7], values(0)["means"][7])


@pytest.mark.parametrize("convert", [arrays, dict])
def test_gaussians_keep_their_past_and_new_ones_have_none(convert) -> None:  # noqa: ANN001
    ours = convert(values(0))
    adam = Adam(ours)
    adam.step(ours, convert(values(1)), rates())
    before = {name: tuple(as_numpy(copied(m)) for m in pair) for name, pair in adam.moments.items()}
    survivors = [5, 2, 9]
    adam.select(survivors, 2)
    for name, pair in adam.moments.items():
        for old, new in zip(before[name], pair, strict=True):
            np.testing.assert_array_equal(new[:3], old[survivors])
            assert new.shape[0] == 5 and not new[3:].any()
    adam.forget("sh")
    assert not any(moment.any() for moment in adam.moments["sh"]) and adam.moments["means"][0].any()
