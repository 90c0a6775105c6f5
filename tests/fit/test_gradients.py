"""What the optimiser knows about one view: gradients, and the pull on the centres on the screen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpainter.fit.gradients import CpuPasses, Pass, Target, screen_pull, torch_pass
from splatpainter.fit.torch_loss import torch_loss
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.render_scenes import cameras, scene, with_odd_gaussians


def target_picture(camera, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random((camera.height, camera.width, 3)).astype(np.float32)


def squared(target: np.ndarray):
    """Smooth, so that differences are honest."""
    goal = torch.from_numpy(target).double()
    return lambda image: (image.double() - goal).square().mean()


def waves(camera) -> np.ndarray:
    y, x = np.mgrid[: camera.height, : camera.width]
    return np.repeat((0.5 + 0.4 * np.sin(x / 9) * np.cos(y / 7 + 1))[..., None], 3, 2).astype(np.float32)


def slope(splats: Splats, camera, custom_loss, name: str, step: float = 0.1) -> float:
    """Of the loss over cx or cy: it moves every centre on the screen and nothing else."""
    low, high = (replace(camera, **{name: getattr(camera, name) + s * step}) for s in (-1, 1))
    return (passed(splats, high, custom_loss).loss - passed(splats, low, custom_loss).loss) / (2 * step)


def passed(splats: Splats, camera, custom_loss=None, mask=None, absolute: bool = False, weight: float = 1.0) -> Pass:
    target = Target.of(camera, target_picture(camera), mask, 0.2, weight)
    return CpuPasses()(splats, target, custom_loss, True, absolute)


@pytest.mark.parametrize("masked", [False, True])
def test_kernels_and_autograd_agree(masked: bool) -> None:
    splats, camera = with_odd_gaussians(scene(30, 2, 2, dtype=np.float32)), cameras(48, 40)[0]
    mask = None
    if masked:
        mask = np.zeros((40, 48), bool)
        mask[3:9, 30:44] = True  # some tiles only
    target = Target.of(camera, target_picture(camera), mask, 0.2, 1.5)
    exact, loss = differentiated(splats, target)
    for passed_by in (CpuPasses()(splats, target, None, True), torch_pass(splats.torch(), target, None, True)):
        assert passed_by.loss == pytest.approx(loss, rel=1e-5)
        for name in ATTRIBUTES:
            scale = np.abs(exact[name]).max()
            assert scale > 0, name
            np.testing.assert_allclose(passed_by.gradients[name], exact[name], atol=2e-5 * scale, err_msg=name)


def differentiated(splats: Splats, target: Target) -> tuple[dict[str, np.ndarray], float]:
    """(gradients, loss) by the plain-torch reference renderer and torch's own loss, all in float64."""
    wide = replace(splats.torch(dtype=torch.float64), source=None, origin=None)
    leaves = {name: getattr(wide, name).detach().requires_grad_() for name in ATTRIBUTES}
    image = render(replace(wide, **leaves), target.camera, backend="reference").colors[0]
    weights = None if target.weights is None else torch.from_numpy(target.weights).double()
    loss = target.weight * torch_loss(image, torch.from_numpy(target.color).double(), weights, target.share)
    loss.backward()
    gradients = {name: leaf.grad.numpy() for name, leaf in leaves.items() if leaf.grad is not None}
    return gradients, float(loss.detach())


@pytest.mark.parametrize("count", [1, 5])
def test_the_pull_is_the_slope_over_the_principal_point(count: int) -> None:
    """Of one Gaussian alone; of several in sum. Gaussians are so wide that none is cut off at 1/255 within the picture:
    the renderer is not smooth there."""
    rng = np.random.default_rng(count)
    splats = scene(count, 1, 4, dtype=np.float32)
    splats = replace(
        splats,
        means=rng.uniform(-0.2, 0.2, (count, 3)).astype(np.float32),
        scales=rng.uniform(0.9, 1.4, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.3, 0.6, count).astype(np.float32),
    )
    camera = cameras(40, 32)[0]
    custom_loss = squared(waves(camera))
    pull = passed(splats, camera, custom_loss).pull
    assert pull is not None and sorted(pull.gaussian_ids.tolist()) == list(range(count))
    for axis, name in enumerate(("cx", "cy")):
        assert pull.pixels[:, axis].sum() == pytest.approx(slope(splats, camera, custom_loss, name), rel=0.01)


def test_the_gradient_of_the_means_tells_nearly_the_same_pull() -> None:
    """What CUDA uses. Measured here: correlation above 0.99 for Gaussians of a few pixels."""
    rng = np.random.default_rng(0)
    splats = scene(400, 1, 7, dtype=np.float32)
    splats = replace(splats, scales=rng.uniform(0.01, 0.06, splats.scales.shape).astype(np.float32))
    camera = cameras(96, 80)[0]
    done = passed(splats, camera)
    tensors = {name: torch.from_numpy(gradient) for name, gradient in done.gradients.items()}
    estimate = screen_pull(splats.torch(), tensors, camera)
    exact, near = np.zeros((2, 400, 2))
    assert done.pull is not None
    exact[done.pull.gaussian_ids], near[estimate.gaussian_ids] = done.pull.pixels, estimate.pixels
    both = np.stack([np.linalg.norm(exact, axis=1), np.linalg.norm(near, axis=1)])
    assert np.corrcoef(both)[0, 1] > 0.99
    assert np.corrcoef(exact.ravel(), near.ravel())[0, 1] > 0.99


def test_the_absolute_pull_does_not_cancel() -> None:
    """A wide Gaussian whose left and right halves are pulled apart: the sum is small, the sum over tiles is not."""
    camera = cameras(96, 32)[0]
    one = scene(1, 0, dtype=np.float32)
    one = replace(
        one,
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.array([[1.0, 0.2, 0.2]], np.float32),
        opacities=np.array([0.9], np.float32),
    )
    target = np.zeros((32, 96, 3), np.float32)
    target[:, :20] = target[:, 76:] = 1.0
    custom_loss = squared(target)
    plain, absolute = (passed(one, camera, custom_loss, absolute=flag).pull for flag in (False, True))
    assert plain is not None and absolute is not None
    assert absolute.pixels[0, 0] >= 5 * abs(plain.pixels[0, 0])
    assert absolute.pixels[0, 1] >= abs(plain.pixels[0, 1]) * (1 - 1e-5)


def test_nothing_in_view_is_no_pull() -> None:
    camera = cameras(32, 32)[0]
    behind = replace(scene(3, 0, dtype=np.float32), means=np.full((3, 3), 50, np.float32))
    done = passed(behind, camera)
    assert done.pull is not None and len(done.pull.gaussian_ids) == 0
    assert not any(gradient.any() for gradient in done.gradients.values())
