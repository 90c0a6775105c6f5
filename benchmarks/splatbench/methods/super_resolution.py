"""Priors of SRGS: what makes a low-resolution picture several times as large. Knows no Gaussians.

SwinIR's weights are not bundled. The prior is Lanczos followed by back-projection (Irani & Peleg
1991): of all pictures whose pixels, averaged over blocks, give the low-resolution one, one near the Lanczos picture; it
adds no detail that was not there. Or, in rows of their own, a program of the user's adapters file:

    [super-resolution]
    command = ["python", "upscale.py", "--scale", "4"]   # called with IN.png OUT.png appended, once per picture
    device = "cpu"
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from splatbench.adapters import adapters_file
from splatbench.process import run_command
from splatpainter.image_files import to_uint8

PROGRAM = "super-resolution"
"""Table of the user's program in the adapters file."""
EXACT = 1e-6
"""Pooled pixels that are nearer than this to the given ones are left as they are."""
Prior = Callable[[np.ndarray], np.ndarray]
"""[H, W, 3] float32 0..1 -> [f H, f W, 3] float32 0..1, for a factor f."""


def pooled(picture: np.ndarray, factor: int) -> np.ndarray:
    """[f H, f W, 3] -> [H, W, 3]: means of f x f blocks."""
    height, width = picture.shape[0] // factor, picture.shape[1] // factor
    lines = picture.reshape(height, factor, -1).sum(1)
    return lines.reshape(height, width, factor, 3).sum(2) / np.float32(factor * factor)


def blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """[H, W, ...] -> [f H, f W, ...]: every pixel becomes f x f alike."""
    return values.repeat(factor, 0).repeat(factor, 1)


def lanczos(picture: np.ndarray, factor: int) -> np.ndarray:
    """The picture `factor` times as large; its pooled form is the picture, to float32 rounding. Nothing leaves 0..1.

    x = U y, with Lanczos' enlargement U and pooling P, satisfies P x = picture for y = (P U)^-1 picture: where the
    rounds x += U (picture - P x) of back-projection end. Both are separable, so two small matrices are inverted. What
    clipping takes from a block of sub-pixels is given to its other ones."""
    picture = np.clip(picture, 0, 1).astype(np.float32)
    down, across = (_unpooled(size, factor) for size in picture.shape[:2])
    inner = np.einsum("yv,vuc,xu->yxc", down, picture, across, optimize=True)
    return _balanced(np.clip(_enlarged(inner, factor), 0, 1), picture, factor)


def _balanced(out: np.ndarray, picture: np.ndarray, factor: int) -> np.ndarray:
    """`out` [f H, f W, 3] in 0..1 with blocks moved until their means are the picture; only sub-pixels that can move
    that way (not at 0 or 1 already) take part."""
    rest = picture - pooled(out, factor)
    ys, xs = np.nonzero(np.abs(rest).max(2) > EXACT)
    tiles = out.reshape(picture.shape[0], factor, picture.shape[1], factor, 3)
    sub_pixels = tiles[ys, :, xs]  # [n, f, f, 3]
    target = picture[ys, xs][:, None, None]
    for _ in range(factor * factor):
        rest = target - sub_pixels.mean((1, 2), keepdims=True)
        if np.abs(rest).max(initial=0) < EXACT:
            break
        free = np.where(rest > 0, sub_pixels < 1, sub_pixels > 0)
        sub_pixels = np.clip(sub_pixels + rest * free / np.maximum(free.mean((1, 2), keepdims=True), EXACT), 0, 1)
    tiles[ys, :, xs] = sub_pixels
    return out


@cache
def _unpooled(size: int, factor: int) -> np.ndarray:
    """[size, size] float32 inverse of enlarging a line of pixels and pooling it again (singular values 0.64 to 1)."""
    from PIL import Image

    unit = Image.fromarray(np.eye(size, dtype=np.float32), "F")
    enlarged = np.asarray(unit.resize((size, size * factor), Image.Resampling.LANCZOS), np.float64)
    return np.linalg.inv(enlarged.reshape(size, factor, size).mean(1)).astype(np.float32)


def _enlarged(picture: np.ndarray, factor: int) -> np.ndarray:
    """The picture enlarged by Lanczos; values of any sign."""
    from PIL import Image

    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    planes = np.ascontiguousarray(np.moveaxis(picture, -1, 0), np.float32)
    resize = Image.Resampling.LANCZOS
    return np.stack([np.asarray(Image.fromarray(plane, "F").resize(size, resize)) for plane in planes], -1)


def missing_program(adapters: Path | None) -> str:
    """Why there is no program to call, or ""."""
    try:
        section = adapters_file.section(adapters, PROGRAM)
    except ValueError as error:
        return str(error)
    if section is None:
        return f"not installed: add [{PROGRAM}] with a `command` to the adapters file ({adapters_file.GUIDE})"
    if not section.command:
        example = 'a list of words, e.g. ["python", "upscale.py"]'
        return f"[{PROGRAM}] has no `command`: expected {example} ({adapters_file.GUIDE})"
    return adapters_file.problem(section, (), adapters_file.has_cuda_gpu)


def program(adapters: Path | None, factor: int, folder: Path) -> Prior:
    """The user's program as a prior. folder: for its pictures and its log. Raises ValueError where it is not there
    (`missing_program`); the prior raises where it fails or leaves no picture of the right size."""
    problem = missing_program(adapters)
    section = None if problem else adapters_file.section(adapters, PROGRAM)
    if section is None:
        raise ValueError(problem)
    words = [section.python if word == "{python}" else word for word in section.command]

    def enlarged(picture: np.ndarray) -> np.ndarray:
        from PIL import Image

        from splatpainter.pictures.picture_reader import read_picture

        pixels = to_uint8(picture)
        name = hashlib.sha256(pixels.tobytes()).hexdigest()[:16]
        small, large = (folder / f"{name}-{end}.png" for end in ("in", "out"))
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(small)
        large.unlink(missing_ok=True)
        log = folder / "log.txt"
        limits = {"timeout": section.timeout_seconds, "environment": section.environment, "python": section.python}
        run_command([*words, *section.arguments, str(small), str(large)], section.repository or folder, log, **limits)
        if not large.is_file():
            raise ValueError(f"[{PROGRAM}] {words[0]}: ended without an error but wrote no {large.name} (log: {log})")
        colors = read_picture(large).colors
        expected = (picture.shape[0] * factor, picture.shape[1] * factor)
        if colors.shape[:2] != expected:
            size = "x".join(map(str, colors.shape[1::-1]))
            raise ValueError(
                f"[{PROGRAM}] {words[0]}: expected a picture of {expected[1]}x{expected[0]} pixels, got {size}"
            )
        for path in (small, large):
            path.unlink(missing_ok=True)
        return np.ascontiguousarray(colors, np.float32)

    return enlarged
