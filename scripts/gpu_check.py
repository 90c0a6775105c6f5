"""python scripts/gpu_check.py [--out out/gpu-check]: the CUDA path on a machine with a GPU, in under ten minutes.

1. gsplat's pictures, contributions and gradients beside our kernels' and the reference's, on small scenes of every
   camera and profile that CUDA draws; 2. the seconds of both on 100,000 and 1,000,000 Gaussians, and of an edit. Writes
   gpu_check.md and exits with 1 where pictures or gradients differ. Without a CUDA device it says so in one line, runs
   the same comparison of the CPU's kernels with the reference, and exits with 3.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.rendering import Render, render
from splatpainter.splats import ATTRIBUTES, Splats

MAX_PICTURE, MAX_GRADIENT = 2e-3, 5e-3
"""Largest difference of a pixel, 0..1 (a Gaussian more or less at the stop), and of a gradient, of the largest."""
MAX_STRAY = 2e-4
"""Share of the pixels that may differ by more."""
SCENES = ((400, 0, False), (400, 3, False), (1500, 1, True))
"""Gaussians, SH degree, whether antialiased."""
SIZES = (100_000, 1_000_000)
SIZE_PX, REPEATS = 512, 20
NO_DEVICE = 3


def scene(count: int, degree: int, antialiased: bool, seed: int = 0) -> Splats:
    """A shell of small Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    where = rng.normal(size=(count, 3))
    where /= np.linalg.norm(where, axis=1, keepdims=True)
    size = 0.6 / np.sqrt(count) * np.exp(rng.normal(0, 0.4, (count, 3)))
    sh = rng.normal(0, 0.2, (count, (degree + 1) ** 2, 3))
    values = (where, rng.normal(size=(count, 4)), size, rng.uniform(0.2, 1, count), sh)
    return Splats(*(value.astype(np.float32) for value in values), antialiased=antialiased)


def cameras(size: int) -> list[Camera]:
    near = look_at([0.2, 0.1, -1.3], [0, 0, 0], width=size, height=size, fov=60, background=(0.1, 0.2, 0.3))
    far = look_at([2.0, 1.0, 2.5], [0, 0, 0], width=size, height=size, fov=35)
    return [near, far]


def drawn(splats: Splats, camera: Camera, backend: Any, device: str) -> tuple[Render, list[np.ndarray]]:
    """The picture, and the gradients of a weighted sum of colours, alpha and depth."""
    import torch

    leaves = {name: torch.from_numpy(getattr(splats, name)).to(device).requires_grad_(True) for name in ATTRIBUTES}
    result = render(replace(splats, **leaves), camera, backend=backend, contributions=True)
    weight = torch.linspace(0.5, 1.5, camera.width, device=device)[None, None, :, None]
    total = (result.colors * weight).sum() + 0.3 * result.alphas.sum() + 0.01 * (result.depths * weight).sum()
    total.backward()
    return result, [leaf.grad.cpu().numpy() for leaf in leaves.values()]


def compared(device: str) -> list[str]:
    """One line per scene and camera; those that differ begin with "DIFFERS"."""
    lines = []
    backend = "cuda" if device == "cuda" else "cpu"
    for count, degree, antialiased in SCENES:
        splats = scene(count, degree, antialiased)
        for view, camera in enumerate(cameras(96)):
            ours, slopes = drawn(splats, camera, backend, device)
            other, expected = drawn(splats, camera, "cpu" if device == "cuda" else "reference", "cpu")
            error = (ours.colors.detach().cpu() - other.colors.detach()).abs().amax(-1)
            stray = float((error > MAX_PICTURE).float().mean())
            slope = max(
                float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-12)) for a, b in zip(slopes, expected, strict=True)
            )
            mark = "agrees" if stray <= MAX_STRAY and slope <= MAX_GRADIENT else "DIFFERS"
            what = f"{count} Gaussians, SH {degree}{', antialiased' if antialiased else ''}, view {view}"
            lines.append(
                f"{mark}: {what}: picture by up to {float(error.max()):.1e} ({100 * stray:.3f} % of the pixels beyond "
                f"{MAX_PICTURE}), gradients by up to {slope:.1e} of the largest"
            )
            print(lines[-1], flush=True)
    return lines


def timed(work: Any, device: str, repeats: int) -> float:
    """Milliseconds, median, after one untimed call."""
    import torch

    times = []
    for repeat in range(repeats + 1):
        start = time.perf_counter()
        work()
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(1000 * (time.perf_counter() - start) if repeat else np.nan)
    return float(np.nanmedian(times))


def speeds(device: str) -> list[str]:
    """A table as Markdown."""
    import torch

    lines = [
        f"| {SIZE_PX} x {SIZE_PX} pixels, ms | Gaussians | {device} | CPU kernels |",
        "| --- | ---: | ---: | ---: |",
    ]
    for count in SIZES:
        splats, camera = scene(count, 1, False), cameras(SIZE_PX)[1]

        def forward(where: str, splats: Splats = splats, camera: Camera = camera) -> Any:
            moved = replace(splats, **{n: torch.from_numpy(getattr(splats, n)).to(where) for n in ATTRIBUTES})
            return lambda: render(moved, camera, backend="cuda" if where == "cuda" else "cpu")

        def backward(where: str, splats: Splats = splats, camera: Camera = camera) -> Any:
            return lambda: drawn(splats, camera, "cuda" if where == "cuda" else "cpu", where)

        for name, work in (("render", forward), ("render and gradients of every attribute", backward)):
            fast = timed(work(device), device, REPEATS) if device == "cuda" else np.nan
            slow = timed(work("cpu"), "cpu", 3)
            lines.append(f"| {name} | {count:,} | {fast:.2f} | {slow:.1f} |")
            print(lines[-1], flush=True)
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/gpu-check"))
    out = parser.parse_args().out
    try:
        import torch
    except ModuleNotFoundError:
        print("gpu_check: needs torch: pip install 'splatpainter[cuda]'", file=sys.stderr)
        return 2
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        print("gpu_check: no CUDA device; the CPU's kernels are compared with the reference instead", flush=True)
    start = time.monotonic()
    lines = compared(device)
    table = speeds(device) if device == "cuda" else []
    name = torch.cuda.get_device_name() if device == "cuda" else "no CUDA device"
    took = f"{name}, torch {torch.__version__}: {time.monotonic() - start:.0f} s"
    out.mkdir(parents=True, exist_ok=True)
    text = [took, "", *(f"- {line}" for line in lines), "", *table]
    (out / "gpu_check.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    print(f"{took} -> {out / 'gpu_check.md'}")
    if any(line.startswith("DIFFERS") for line in lines):
        return 1
    return 0 if device == "cuda" else NO_DEVICE


if __name__ == "__main__":
    sys.exit(main())
