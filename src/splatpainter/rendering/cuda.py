"""gsplat's CUDA rasteriser behind the same contract (extra "cuda").

What differs from the CPU kernels and the reference: sums run in no fixed order, so results are not the same bits twice;
exp and sqrt are approximate (about 1e-5 in colour); float32 only. Written for gsplat 1.5.3. Other releases may
cap alpha elsewhere than at 0.999 or stop gradients at the view directions of SH: compare before changing the version.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatpainter.cameras import Camera
from splatpainter.rendering import reference
from splatpainter.rendering.profiles import EPS2D, NEAR_PLANE, Profile
from splatpainter.splats import ATTRIBUTES, Splats


def require() -> Any:
    """gsplat's `rasterization`; the first call on a machine compiles its kernels, for some minutes. Raises ValueError,
    in one line, where there is no CUDA device or no working gsplat."""
    if not torch.cuda.is_available():
        raise ValueError("render: backend 'cuda' needs an NVIDIA GPU and a CUDA build of torch; use backend='cpu'")
    try:
        rasterization = importlib.import_module("gsplat").rasterization
        kernels = importlib.import_module("gsplat.cuda._backend")._C
    except Exception as error:  # gsplat compiles its kernels here: any failure means that it is not there
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"render: backend 'cuda' needs gsplat (pip install 'splatpainter[cuda]'): {reason}") from None
    if kernels is None:  # gsplat says so on the terminal only, and fails when it is called
        raise ValueError("render: backend 'cuda' needs the CUDA toolkit (nvcc), with which gsplat compiles its kernels")
    return rasterization


def draw(
    splats: Splats[Tensor],
    cameras: Sequence[Camera],
    background: Tensor,
    contributions: bool,
    profile: Profile = "inria",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """splats: CUDA tensors. background: [C, 3]. Shapes as in `render.Render`; computed in float32."""
    if profile != "inria":
        raise ValueError(f"render: expected profile 'inria' for backend 'cuda', got {profile!r}")
    rasterization = require()
    dtype, device = splats.means.dtype, splats.means.device
    ids = torch.nonzero(reference.drawable(splats))[:, 0]  # [V]: gsplat does not skip NaN
    if len(ids) == 0:  # nor does it draw nothing
        return reference.draw(splats, cameras, background, contributions)
    drawn = {name: getattr(splats, name)[ids].float() for name in ATTRIBUTES}
    view = {
        "viewmats": stacked([camera.world_to_camera for camera in cameras], device),  # [C, 4, 4]
        "Ks": stacked([camera.intrinsics for camera in cameras], device),  # [C, 3, 3]
        "width": cameras[0].width,
        "height": cameras[0].height,
        "near_plane": NEAR_PLANE,
        "eps2d": EPS2D,
        "rasterize_mode": "antialiased" if splats.antialiased else "classic",
        "packed": False,
    }
    geometry = [drawn[name] for name in ("means", "quats", "scales", "opacities")]
    picture, alphas, _ = rasterization(
        *geometry, drawn["sh"], sh_degree=splats.sh_degree, render_mode="RGB+ED", **view
    )  # [C, H, W, 4], [C, H, W, 1]
    colors = picture[..., :3] + (1 - alphas) * background.float()[:, None, None, :]  # [C, H, W, 3]
    depths = torch.where(alphas > 0, picture[..., 3:], 0)  # [C, H, W, 1]
    weights = None
    if contributions:  # sum_p w_ip is the gradient of the picture's sum with respect to its colour
        weights = torch.zeros(len(cameras), len(splats), device=device)  # [C, N]
        with torch.enable_grad():
            fixed = [values.detach() for values in geometry]
            flat = torch.ones(len(cameras), len(ids), 3, device=device, requires_grad=True)  # [C, V, 3]
            total = rasterization(*fixed, flat, sh_degree=None, render_mode="RGB", **view)[0][..., 0].sum()
            weights[:, ids] = torch.autograd.grad(total, flat)[0][..., 0]
    return colors.to(dtype), alphas.to(dtype), depths.to(dtype), None if weights is None else weights.to(dtype)


def stacked(matrices: Sequence[Any], device: Any) -> Tensor:
    return torch.stack([torch.as_tensor(matrix, dtype=torch.float32) for matrix in matrices]).to(device)
