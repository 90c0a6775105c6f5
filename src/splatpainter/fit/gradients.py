"""One view of the Gaussians: the loss, the gradients of all attributes, and the pull on each Gaussian's centre on the
screen.

On the CPU the kernels of rendering/cpu are called directly: their sums hold the screen-space gradients exactly, and
nothing goes through autograd but a loss of the caller's own. Elsewhere (CUDA) torch differentiates the renderer, and
the screen-space gradient is that of the centre in camera axes times z / f: what reaches the centre by its depth and
through the shape of its projection is counted too, which hardly matters (correlation 0.99, see the tests).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.fit.devices import DeviceArray
from splatpainter.fit.image_loss import picture_loss
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import ProjectedView, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from torch import Tensor

CustomLoss = Callable[["Tensor"], "Tensor"]
"""[H, W, 3] render, a torch tensor -> scalar."""


@dataclass(frozen=True)
class Target:
    """What a view is to show."""

    camera: Camera
    color: np.ndarray
    """[H, W, 3] float32."""
    weights: np.ndarray | None
    """[H, W] float32 >= 0; None: 1 everywhere."""
    tiles: np.ndarray | None
    """[TH, TW] bool: where weights are above 0; None: everywhere."""
    share: float
    """Share of SSIM in the loss, 0..1."""
    weight: float = 1.0
    """Weight of the view."""

    @staticmethod
    def of(camera: Camera, color: np.ndarray, mask: np.ndarray | None, share: float, weight: float) -> Target:
        """mask: [H, W] bool or weights."""
        weights = None if mask is None else np.ascontiguousarray(mask, np.float32)
        tiles = None if weights is None else tiles_of_mask(weights)
        return Target(camera, np.ascontiguousarray(color, np.float32), weights, tiles, share, weight)


@dataclass(frozen=True)
class Pull:
    """How the drawn Gaussians' centres are pulled on the screen."""

    gaussian_ids: np.ndarray
    """[M] int64 Gaussians that are drawn."""
    pixels: np.ndarray
    """[M, 2] gradient of the loss with respect to the centres, per pixel."""
    radii: np.ndarray
    """[M] half the longer side of the drawn ellipse's box, pixels."""


@dataclass(frozen=True)
class Pass:
    """One view, forward and backward."""

    loss: float
    gradients: dict[str, DeviceArray]
    """Attribute -> gradient, shaped as the attribute. Valid until the next pass."""
    pull: Pull | None


class CpuPasses:
    """Passes by the CPU kernels. Keeps the gradients' memory from pass to pass: fresh pages cost more than maths."""

    def __init__(self, colors: bool = True) -> None:
        """colors: whether gradients have "sh", which is most of their memory."""
        self._colors, self._out = colors, ()

    def __call__(
        self, splats: Splats, target: Target, custom_loss: CustomLoss | None, pull: bool, absolute: bool = False
    ) -> Pass:
        """splats: numpy, float32. pull: find it. absolute: see `_pull`."""
        # A custom loss may look at any pixel, so all tiles are drawn for it.
        frame = project(splats, target.camera, tiles=target.tiles if custom_loss is None else None)
        shape = (target.camera.height, target.camera.width)
        image, alpha, depth = (np.empty((*shape, *rest), np.float32) for rest in ((3,), (), ()))
        ends = frame.rasterize_into(image, alpha, depth)
        # Loss and its slope by the picture; from there on kernels go back by themselves.
        loss, slope = _image_loss(image, target, custom_loss)
        nothing = np.zeros(shape, np.float32)
        sums = frame.rasterize_backward(ends, image, alpha, depth, slope, nothing, nothing)
        # Gradients are written into the same arrays again: density control is rare, allocation of 100 MB is not cheap.
        if not self._out or self._out[0].shape != splats.means.shape or self._out[4].shape[1:] != splats.sh.shape[1:]:
            values = [getattr(splats, name) for name in ATTRIBUTES]
            self._out = tuple(np.empty_like(v if self._colors or v is not splats.sh else v[:0]) for v in values)
        frame.project_backward(splats, sums, self._out)
        gradients: dict[str, Any] = dict(zip(ATTRIBUTES, self._out, strict=True))
        if not self._colors:
            del gradients["sh"]
        return Pass(loss, gradients, _pull(frame, sums, absolute) if pull else None)


def torch_pass(
    splats: Splats[Tensor], target: Target, custom_loss: CustomLoss | None, pull: bool, absolute: bool = False
) -> Pass:
    """A pass as of CpuPasses, by torch, on the splats' device. absolute: not known here, and left out."""
    import torch

    from splatpainter.fit.torch_loss import torch_loss

    # New leaves each step: the optimiser works on raw values, outside of autograd.
    leaves = {name: getattr(splats, name).detach().requires_grad_() for name in ATTRIBUTES}
    image = render(replace(splats, **leaves), target.camera).colors[0]
    if custom_loss is None:
        color = torch.as_tensor(target.color, device=image.device)
        weights = None if target.weights is None else torch.as_tensor(target.weights, device=image.device)
        loss = torch_loss(image, color, weights, target.share)
    else:
        loss = custom_loss(image)
    loss = loss * target.weight
    loss.backward()
    gradients = {name: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for name, leaf in leaves.items()}
    return Pass(float(loss.detach()), gradients, screen_pull(splats, gradients, target.camera) if pull else None)


def screen_pull(splats: Splats[Tensor], gradients: dict[str, Tensor], camera: Camera) -> Pull:
    """The pull as far as the gradients of the attributes (torch) tell. Radii are three standard deviations."""
    import torch

    turn = torch.as_tensor(camera.world_to_camera[:3, :3], dtype=torch.float32, device=splats.means.device)
    shift = torch.as_tensor(camera.world_to_camera[:3, 3], dtype=torch.float32, device=splats.means.device)
    # The centre's gradient in camera axes, times z / f: pixels on the screen.
    z = splats.means @ turn[2] + shift[2]
    focal = turn.new_tensor([camera.fx, camera.fy])
    pixels = (gradients["means"] @ turn.T)[:, :2] * z[:, None] / focal
    drawn = torch.nonzero(gradients["opacities"] != 0)[:, 0]
    radii = 3 * splats.scales.amax(1) * focal.max() / z.clamp_min(1e-6)
    return Pull(drawn.cpu().numpy(), pixels[drawn].cpu().numpy(), radii[drawn].cpu().numpy())


def _image_loss(image: np.ndarray, target: Target, custom_loss: CustomLoss | None) -> tuple[float, np.ndarray]:
    if custom_loss is None:
        loss, slope = picture_loss(image, target.color, target.weights, target.share)
        return loss * target.weight, slope if target.weight == 1 else slope * np.float32(target.weight)
    import torch

    leaf = torch.from_numpy(image).requires_grad_()
    value = custom_loss(leaf) * target.weight
    value.backward()
    assert leaf.grad is not None, "loss: expected one that depends on the render"
    return float(value.detach()), np.ascontiguousarray(leaf.grad.numpy(), np.float32)


def _pull(frame: ProjectedView, sums: np.ndarray, absolute: bool) -> Pull:
    """The pull, from the sums of backward.py. absolute: magnitudes are summed over 16 x 16 tiles, so that pulls in
    opposite directions at the two ends of a large Gaussian do not cancel (Ye et al. 2024, "AbsGS", sum them over
    pixels)."""
    extent = frame.extents.max(1)
    if not len(frame):
        return Pull(frame.gaussian_ids, np.zeros((0, 2), np.float32), extent)
    a, b, c = frame.conics.T
    # Sums per pair of Gaussian and tile; absolute values are taken per tile before they are summed.
    pairs = sums[:, 1:3]
    counts = np.diff(frame.pair_offsets)
    if absolute:
        owner = np.repeat(np.arange(len(frame)), counts)
        pairs = np.abs(_towards(pairs, a[owner], b[owner], c[owner]))
    total = np.zeros((len(frame), 2), np.float32)
    some = counts > 0
    total[some] = np.add.reduceat(pairs, frame.pair_offsets[:-1][some], axis=0)
    pixels = total if absolute else -_towards(total, a, b, c)
    return Pull(frame.gaussian_ids, frame.opacities[:, None] * pixels, extent)


def _towards(sums: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Conic times the sums of u d, see backward.FIELDS."""
    return np.stack([a * sums[:, 0] + b * sums[:, 1], b * sums[:, 0] + c * sums[:, 1]], 1)
