"""`render(splats, cameras) -> Render`: colours, alpha, expected depth and contributions of one or more views.

One contract, three backends: native CPU kernels (cpu/), gsplat on CUDA (cuda.py), plain torch (reference.py, which is
the specification). numpy in, numpy out, without importing torch; torch in, torch out, differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Generic, Literal, cast

import numpy as np

from splatpainter.array_types import ArrayT, Floats, FloatsOrTensor
from splatpainter.cameras import Camera
from splatpainter.rendering.profiles import PROFILES, Profile
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Splats
from splatpainter.system.quick_dataclass import dataclass

Backend = Literal["auto", "cpu", "cuda", "reference"]
BACKENDS = ("auto", "cpu", "cuda", "reference")
MAX_SIDE_PX = 8192
"""Pixels of a view's longer side."""
MAX_PIXELS = 4 * MAX_SIDE_PX**2
"""Width x height x views of one call: 5 GiB of float32 pictures."""


@dataclass(frozen=True)
class Render(Generic[ArrayT]):
    """C views of N Gaussians, of the kind (numpy or torch), dtype and device of the splats."""

    colors: ArrayT
    """[C, H, W, 3] composited over the background, in the splats' colour space; not clamped above."""
    alphas: ArrayT
    """[C, H, W, 1] 1 - transmittance, 0..1."""
    depths: ArrayT
    """[C, H, W, 1] expected z-depth sum_i w_i z_i / alpha, world units; 0 where alpha is 0."""
    contributions: ArrayT | None = None
    """[C, N] sum over pixels of w_ip = alpha_ip T_ip, pixels; not differentiable. None unless asked for."""

    def numpy(self) -> Render[Floats]:
        """The same as numpy arrays, of tensors on the CPU without gradients."""
        weights = None if self.contributions is None else np.asarray(self.contributions)
        return Render(np.asarray(self.colors), np.asarray(self.alphas), np.asarray(self.depths), weights)


def render(
    splats: Splats[ArrayT],
    cameras: Camera | Sequence[Camera],
    *,
    background: Any = None,
    backend: Backend = "auto",
    contributions: bool = False,
    profile: Profile = "inria",
) -> Render[ArrayT]:
    """Draw splats as 3D Gaussian Splatting does (Kerbl et al. 2023, in gsplat's conventions; exactly: reference.py).

    cameras: one, or several of one size, of at most MAX_SIDE_PX a side and MAX_PIXELS in all; those in world
    coordinates are moved to the splats' `offset` in float64. background: [3] or [C, 3] colours behind the splats, by
    default each camera's own. backend: "auto" is "cuda" for CUDA tensors, else "cpu".
    contributions: also return each Gaussian's weight per view. profile: whose formula for alpha is used, see
    profiles.py; "playcanvas" shows an asset as that family of tools does.

    Gaussians with values out of their range (`Splats.drawable`: NaN, opacities beyond 0..1, ...) are not drawn, nor is
    anything by a camera beyond MAX_MAGNITUDE. In one view, those are left out whose centre is projected farther than
    1e9 pixels away or whose footprint's squared area exceeds the dtype.

    With torch tensors the result is differentiable in means, quats, scales, opacities, sh, and background if that is a
    tensor; those that are not drawn get zero gradients. Equal inputs give equal bits, whatever the number of threads
    (CPU). Profiles other than "inria" are differentiable in the backend "reference" only; CUDA has none of them.

    Raises ValueError for shapes, kinds or sizes that do not fit, and for a backend or profile that is not there.
    """
    # All that can be refused before any backend is loaded.
    views = [cameras] if isinstance(cameras, Camera) else list(cameras)
    check_views(views)
    _check_splats(splats)
    views = [view.within(splats.offset) for view in views]
    if backend not in BACKENDS:
        raise ValueError(f"render: expected a backend of {', '.join(BACKENDS)}, got {backend!r}")
    if profile not in PROFILES:
        raise ValueError(f"render: expected a profile of {', '.join(PROFILES)}, got {profile!r}")
    # numpy on the CPU needs no torch at all; everything else goes through it and comes back as it was given.
    means: Any = splats.means
    is_numpy = isinstance(means, np.ndarray)
    if backend == "auto":
        backend = "cpu" if is_numpy or means.device.type != "cuda" else "cuda"
    if is_numpy and backend == "cpu":
        return _render_numpy(splats, views, background, contributions, profile)
    result = _render_torch(splats, views, background, backend, contributions, profile)
    return cast("Render[Any]", result.numpy()) if is_numpy else result


def _render_numpy(
    splats: Splats[Any], views: list[Camera], background: Any, contributions: bool, profile: Profile
) -> Render[Any]:
    from splatpainter.rendering.cpu.views import render_views

    if background is not None:
        colors = _background_shape(np.asarray(background, np.float64), len(views))
        views = [replace(view, background=tuple(color)) for view, color in zip(views, colors.tolist(), strict=True)]
    rendered = render_views(splats, views, contributions, keep_views=False, profile=profile)
    return Render(rendered.colors, rendered.alphas, rendered.depths, rendered.contributions)


def _render_torch(
    splats: Splats[Any], views: list[Camera], background: Any, backend: str, contributions: bool, profile: Profile
) -> Render[Any]:
    import torch

    if backend == "reference":
        from splatpainter.rendering import reference as renderer
    elif backend == "cuda":
        from splatpainter.rendering import cuda as renderer
    else:
        from splatpainter.rendering import autograd as renderer

    origin = "cpu" if isinstance(splats.means, np.ndarray) else splats.means.device
    device = {"cpu": "cpu", "cuda": "cuda", "reference": origin}[backend]
    if device == "cuda":
        from splatpainter.rendering.cuda import require

        require()
    moved = {name: torch.as_tensor(getattr(splats, name)).to(device) for name in ATTRIBUTES}
    splats = replace(splats, **moved, source=None, origin=None)
    colors = [view.background for view in views] if background is None else background
    background = _background_shape(torch.as_tensor(colors, dtype=splats.means.dtype, device=device), len(views))
    with torch.autocast(torch.device(device).type, enabled=False):  # a caller's bf16 would round positions to 8 bits
        outputs = renderer.draw(splats, views, background, contributions, profile)
    back: list[Any] = [None if output is None else output.to(origin) for output in outputs]
    return Render(*back)


def _background_shape(background: FloatsOrTensor, count: int) -> FloatsOrTensor:
    """[3] or [C, 3] -> [C, 3]."""
    shape = tuple(background.shape)
    if shape not in ((3,), (count, 3)):
        raise ValueError(f"render: expected a background of shape [3] or [{count}, 3], got {list(shape)}")
    return background[None][[0] * count] if shape == (3,) else background


def check_views(views: list[Camera]) -> None:
    """Raises ValueError for views that `render` does not draw in one call."""
    if not views:
        raise ValueError("render: expected at least one camera, got none")
    sizes = sorted({(view.width, view.height) for view in views})
    if len(sizes) > 1:
        listed = ", ".join(f"{w}x{h}" for w, h in sizes)
        raise ValueError(f"render: expected cameras of one size, got {listed}; render each size in a call of its own")
    width, height = sizes[0]
    if not 1 <= min(width, height) <= max(width, height) <= MAX_SIDE_PX or width * height * len(views) > MAX_PIXELS:
        limit = f"views of 1 to {MAX_SIDE_PX} pixels a side and {MAX_PIXELS:,} pixels in all"
        raise ValueError(f"render: expected {limit}, got {len(views)} of {width} x {height}")


def _check_splats(splats: Splats[Any]) -> None:
    n = int(splats.means.shape[0])
    k = int(splats.sh.shape[1]) if len(splats.sh.shape) == 3 else -1
    if k not in SH_COUNTS:
        raise ValueError(f"render: expected sh [N, 1, 4, 9, 16 or 25, 3], got {list(splats.sh.shape)}")
    expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "sh": (n, k, 3)}
    for name, shape in expected.items():
        values = getattr(splats, name)
        if tuple(values.shape) != shape:
            raise ValueError(f"render: expected {name} {list(shape)}, got {list(values.shape)}")
        if isinstance(values, np.ndarray) != isinstance(splats.means, np.ndarray):
            raise ValueError(f"render: expected all attributes of one kind, got {name} as {type(values).__name__}")
        dtype = str(values.dtype).removeprefix("torch.")
        if dtype not in ("float32", "float64") or values.dtype != splats.means.dtype:
            raise ValueError(f"render: expected float32 (or all float64) attributes, got {name} as {dtype}")
