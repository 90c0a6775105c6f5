"""Rendering, its gradients and its adjoint, what a fit needs, and elementary functions: the same bytes on every kind of
CPU and for any number of threads. Inputs are whole numbers over powers of two, so that nothing but the kernels decides.

After a change of results that is meant: `python -m tests.kernels.test_rendering_goldens` prints the table.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.fit.image_loss import picture_loss
from splatpainter.fit.start import mean_neighbour_squares
from splatpainter.kernels.library import kernels
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.cpu.sirt import CachedWeights
from splatpainter.rendering.cpu.views import render_views, render_views_backward
from splatpainter.splats import Splats
from tests.support.kernel_goldens import CPUS, Numbers, check, digest

WIDTH, HEIGHT = 70, 52


def fractions(seed: int, *shape: int) -> np.ndarray:
    """Multiples of 2^-20 in [-1, 1)."""
    return Numbers(seed).integers(1 << 21, *shape) / 2**20 - 1


def scene(dtype: type, antialiased: bool = False) -> Splats:
    count = 250
    values = {
        "means": fractions(1, count, 3),
        "quats": fractions(2, count, 4) * 3,
        "scales": (fractions(3, count, 3) + 1.0625) ** 4 / 16,
        "opacities": (fractions(4, count) + 1) / 2,
        "sh": fractions(5, count, 16, 3) / 2,
    }
    return Splats(**{name: value.astype(dtype) for name, value in values.items()}, antialiased=antialiased)


def camera(turn: int) -> Camera:
    """At distance 3 in front of the scene, or beside it."""
    w2c = np.eye(4)
    w2c[:3, :3] = np.roll(np.eye(3), turn, 1)
    w2c[:3, 3] = [0.125, -0.25, 3]
    return Camera(WIDTH, HEIGHT, 60.0, 62.0, 35.0, 26.0, w2c, background=(0.25, 0.5, 0.125))


def drawn(dtype: type, profile: str = "inria", antialiased: bool = False) -> list[np.ndarray]:
    rendered = render_views(scene(dtype, antialiased), [camera(0), camera(1)], True, False, profile)  # type: ignore[arg-type]
    assert rendered.contributions is not None
    return [rendered.colors, rendered.alphas, rendered.depths, rendered.contributions]


def gradients(dtype: type, antialiased: bool) -> list[np.ndarray]:
    splats = scene(dtype, antialiased)
    rendered = render_views(splats, [camera(0), camera(2)], False, True)
    slopes = [
        fractions(k, *p.shape).astype(dtype) for k, p in enumerate((rendered.colors, rendered.alphas, rendered.depths))
    ]
    return list(render_views_backward(splats, rendered, *slopes))


def lifted(dtype: type) -> list[np.ndarray]:
    view = project(scene(dtype), camera(1))
    target = (fractions(6, HEIGHT, WIDTH, 3).astype(dtype) + 1) / 2
    mask = np.maximum(fractions(7, HEIGHT, WIDTH), 0).astype(dtype)
    back = view.backproject(target, mask)
    two = view.mask_sums(mask, mask[::-1])
    residual, error = view.sirt_step(target, mask)
    cached = CachedWeights.of(view, target, mask, np.arange(len(view)) % 3 == 0)
    assert cached is not None
    step = cached.residual(view.colors[np.arange(len(view)) % 3 == 0] * dtype(0.75))
    sums = [a for m in (back, *two) for a in (m.weight, m.alpha, m.peak)]
    return [back.values, *sums, residual, np.array(error), cached.weight, step, view.heaviest_gaussians()]


def fitted() -> list[np.ndarray]:
    a, b = (((fractions(k, 33, 41, 3) + 1) / 2).astype(np.float32) for k in (8, 9))
    loss, gradient = picture_loss(a, b, np.maximum(fractions(10, 33, 41), 0).astype(np.float32), 0.25)
    value, slope, mean, square = (fractions(k, 40, 3).astype(np.float32) for k in (11, 12, 13, 14))
    rates, numbers = np.array([0.5, 0.25, 0.125], np.float32), (0.75, 0.25, 0.875, 0.125, 2.0**-30, 1.5)
    kernels.adam_step(value, slope, mean, square**2, rates, *numbers, 0, 1)
    return [np.array(loss), gradient, value, mean, mean_neighbour_squares(fractions(15, 90, 3).astype(np.float32))]


def elementary() -> list[np.ndarray]:
    out = []
    for dtype in (np.float32, np.float64):
        x, y = (fractions(k, 4000).astype(dtype) for k in (16, 17))
        for name, values in (
            ("exp", 30 * x), ("log", 4 * abs(x)), ("sin", 40 * x), ("cos", 40 * x), ("acos", x), ("atan", 1 / y)
        ):  # fmt: skip
            out.append(np.empty_like(values))
            getattr(kernels, f"{name}_each")(values, out[-1], 0, 1)
        out.append(np.empty_like(x))
        kernels.atan2_each(y, x, out[-1], 0, 1)
        out.append(np.empty_like(x))
        kernels.fused_each(x / 3, y, -x / 3 * y, out[-1], 0, 1)
        out.append(np.empty_like(x))
        kernels.exp_of_negative_each(-20 * abs(x), out[-1], 0, 1)
    return out


CASES: dict[str, Callable[[], list[np.ndarray]]] = {
    "drawn": lambda: drawn(np.float32),
    "drawn in float64": lambda: drawn(np.float64),
    "drawn as PlayCanvas": lambda: drawn(np.float32, "playcanvas", antialiased=True),
    "gradients": lambda: gradients(np.float32, antialiased=False),
    "gradients, antialiased": lambda: gradients(np.float64, antialiased=True),
    "lifted": lambda: lifted(np.float32),
    "lifted in float64": lambda: lifted(np.float64),
    "fitted": fitted,
    "elementary functions": elementary,
}
GOLDENS = {
    "drawn": "1c144bb3d5a2e33c",
    "drawn in float64": "3557e39ad047db57",
    "drawn as PlayCanvas": "7f5d94237afeaa4c",
    "gradients": "8b34a62b6feb1dc1",
    "gradients, antialiased": "a9d1704353a7c120",
    "lifted": "dd61df295a2874cb",
    "lifted in float64": "63dc895e7c3fd7a6",
    "fitted": "73113d1aad8ae5c8",
    "elementary functions": "086ca96cf866fa06",
}


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("case", CASES)
def test_bytes_are_the_same_everywhere(case: str, cpu: str, monkeypatch: pytest.MonkeyPatch):
    check(CASES[case], GOLDENS[case], cpu, monkeypatch)


def test_cases_show_something():
    """Hashes of nothing would be equal everywhere, too."""
    for case in CASES.values():
        assert all(array.size and not np.isnan(array).all() and array.any() for array in case())


if __name__ == "__main__":
    for name, make in CASES.items():
        print(f'    "{name}": "{digest(*make())}",')
