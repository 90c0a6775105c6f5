"""torch's view of the CPU kernels: one autograd.Function, first derivatives only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.rendering.cpu.views import render_views, render_views_backward
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ATTRIBUTES, Splats


class RenderViews(torch.autograd.Function):
    """(means, quats, scales, opacities, sh, background [C, 3]) -> (colors, alphas, depths, contributions or empty)."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        *tensors, background, antialiased, cameras, contributions, differentiable, profile = inputs
        arrays = {name: t.detach().contiguous().numpy() for name, t in zip(ATTRIBUTES, tensors, strict=True)}
        splats = Splats(**arrays, antialiased=antialiased)
        colors = background.detach().tolist()
        cameras = [replace(camera, background=tuple(b)) for camera, b in zip(cameras, colors, strict=True)]
        rendered = render_views(splats, cameras, contributions, keep_views=differentiable, profile=profile)
        outputs = [torch.from_numpy(a) for a in (rendered.colors, rendered.alphas, rendered.depths)]
        weights = torch.empty(0) if rendered.contributions is None else torch.from_numpy(rendered.contributions)
        ctx.mark_non_differentiable(weights)
        if differentiable:
            ctx.splats, ctx.rendered = splats, rendered
            # These share memory with the arrays above: saved so that torch complains if one is changed before backward.
            ctx.save_for_backward(*tensors, *outputs)
        return *outputs, weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        _ = ctx.saved_tensors  # raises if they were changed
        v_colors, v_alphas, v_depths = (g.contiguous().numpy() for g in grad_outputs[:3])
        grads: list[Any] = [None] * 11
        if any(ctx.needs_input_grad[:5]):
            grads[:5] = map(
                torch.from_numpy, render_views_backward(ctx.splats, ctx.rendered, v_colors, v_alphas, v_depths)
            )
        if ctx.needs_input_grad[5]:  # colour = composited + (1 - alpha) background
            grads[5] = torch.from_numpy((v_colors * (1 - ctx.rendered.alphas)).sum((1, 2)))
        return tuple(grads)


def draw(
    splats: Splats[Tensor],
    cameras: Sequence[Camera],
    background: Tensor,
    contributions: bool,
    profile: Profile = "inria",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """splats: CPU tensors of one dtype. background: [C, 3], same dtype. Shapes as in `render.Render`."""
    tensors = [*(getattr(splats, name) for name in ATTRIBUTES), background]
    differentiable = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if differentiable and profile != "inria":
        raise ValueError(f"render: expected profile 'inria' or backend 'reference' for gradients, got {profile!r}")
    settings = (splats.antialiased, list(cameras), contributions, differentiable, profile)
    colors, alphas, depths, weights = RenderViews.apply(*tensors, *settings)
    return colors, alphas, depths, weights if contributions else None
