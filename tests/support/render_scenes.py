"""Small scenes for the renderer's tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.splats import ATTRIBUTES, Splats


def scene(
    count: int = 40, degree: int = 1, seed: int = 0, *, antialiased: bool = False, dtype: type = np.float64
) -> Splats:
    """Random ellipsoids within about 1 of the origin: needles, plates and dots, sub-pixel to half a picture wide."""
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.normal(0, 0.6, (count, 3)),
        "quats": rng.normal(0, 1, (count, 4)) * rng.choice([0.1, 1, 10], (count, 1)),
        "scales": np.exp(rng.normal(-3, 1, (count, 3))),
        "opacities": rng.uniform(0.02, 1, count),
        "sh": rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
    }
    return Splats(**{name: value.astype(dtype) for name, value in values.items()}, antialiased=antialiased)


def with_odd_gaussians(splats: Splats) -> Splats:
    """The same, between Gaussians of every kind that must be skipped and of some kinds that are hard to draw."""
    dtype = splats.means.dtype
    odd = scene(20, splats.sh_degree, seed=99, dtype=dtype.type)
    m, q, s, o, c = odd.means, odd.quats, odd.scales, odd.opacities, odd.sh
    m[0] = np.nan
    m[1] = [np.inf, 0, 0]
    q[2] = 0
    q[3, 1] = np.nan
    s[4, 2] = np.nan
    s[5, 0] = -0.1
    s[6] = 0
    s[7, 1] = np.inf
    o[8] = np.nan
    o[9] = 0.001  # below 1/255 everywhere
    o[10] = np.inf
    c[11, 0, 0] = np.nan
    c[12, -1, 2] = -np.inf
    m[13] = [0, 0, 30]  # behind every camera of `cameras`
    m[14] = [40, 0, 0]  # far off the picture
    m[15], s[15] = [0, 0, 2.99], 0.02  # at the eye of the first camera
    m[16], s[16], o[16] = [4.9, 0.5, 0.5], [3.0, 0.01, 0.01], 0.9  # a long needle that begins far outside the picture
    q[16] = [1, 0, 0.1, 0]
    m[17], s[17] = [0, 0, -1], 3.0  # larger than the picture
    q[18] *= 1e-12  # any norm will do, within its range
    s[19] = 1e-6  # much smaller than a pixel
    return odd.append(splats).append(odd)


def opaque_stack(count: int = 60, dtype: type = np.float64) -> Splats:
    """Nearly opaque plates behind each other: pixels stop early, and the Gaussians behind must not be seen."""
    base = scene(count, 0, seed=5, dtype=dtype)
    base.means[:] = np.stack([np.zeros(count), np.zeros(count), np.linspace(1, -1, count)], 1)
    base.scales[:] = [1.5, 1.2, 0.01]
    base.scales[0] = [20, 20, 0.01]
    base.quats[:] = [1, 0, 0, 0]
    base.opacities[:] = np.tile([1.0, 0.3], count)[:count]  # the first is at the cap of 0.999 everywhere
    return base


def cameras(width: int, height: int, count: int = 1, fov: float = 50) -> list[Camera]:
    """Views from around the origin, 3 away, with an off-centre principal point in all but the first."""
    out = []
    for i in range(count):
        angle = 0.9 * i
        eye = [3 * np.sin(angle), 0.4 * i, 3 * np.cos(angle)]
        view = look_at(eye, [0, 0, 0], width=width, height=height, fov=fov, background=(0.1 * i, 0.2, 0.3))
        out.append(view if i == 0 else replace(view, cx=view.cx + 2.3, fy=view.fy * 1.1))
    return out


def single(splats: Splats) -> Splats:
    """The same in float32, as files are."""
    values: dict[str, Any] = {name: getattr(splats, name).astype(np.float32) for name in ATTRIBUTES}
    return replace(splats, **values)
