"""SRGS (Feng et al., arXiv 2404.10318): 3DGS optimised in high resolution under a super-resolution prior.

As the supplement of the paper runs it: from the given asset, on its base views, the edited ones, and 48 more views of
the asset itself. Base views and those 48 are low-resolution pictures, which a prior makes four times as large; edited
close-ups are true pictures of that resolution and are used as they are. The published method draws each view four times
as large as its picture; here a step draws one patch of that (srgs_patches.py), or a step on a CPU would cost many
times one of 3DGS.

Both weightings of its loss w L_tex + (1 - w) L_sub: w = 0.4, the line that the released code has commented out, and
w = 1, which it runs. SwinIR's weights are not bundled. The prior is Lanczos followed by back-projection (Irani & Peleg
1991): of all pictures whose pixels, averaged over blocks, give the low-resolution one, one near the Lanczos picture; it
adds no detail that was not there. Or, in rows of their own, a program of the user's adapters file:

    [super-resolution]
    command = ["python", "upscale.py", "--scale", "4"]   # called with IN.png OUT.png appended, once per picture
    device = "cpu"
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatbench.adapters import config
from splatbench.cases import Budget
from splatbench.methods import Curve, EditResult, EditTask, Method
from splatbench.methods.gs3d import (
    ASSET_VIEWS,
    EDITED_SHARE,
    fit_views,
    mixed,
    reached,
    views_of_asset,
    weights_beside,
)
from splatbench.process import run_command

if TYPE_CHECKING:
    from splatpainter.fit.optimize import View

FACTOR = 4
MAX_PATCHES = 2
"""Of each low-resolution picture."""
PATCH_EDGE = 2
"""Of a patch, in edges of the low-resolution picture: a step draws a quarter of the large picture. Measured (one
object, 128 px, 300 steps, dB on novel views near the edit and far from it): a sixteenth 24.9 and 27.2, a quarter 25.5
and 28.4, all of it 24.9 and 28.6 at 2.7 times the time per step."""
PAPER, RELEASED = 0.4, 1.0
"""Weights of L_tex."""
SSIM_SHARE = 0.2
"""Of 1 - SSIM in both parts of the loss; the rest is L1."""
PROGRAM = "super-resolution"
"""Table of the user's program in the adapters file."""
EXACT = 1e-6
"""Pooled pixels that are nearer than this to the given ones are left as they are."""
Prior = Callable[[np.ndarray], np.ndarray]
"""[H, W, 3] float32 0..1 -> [f H, f W, 3] float32 0..1, for a factor f."""


def edit(
    texture: float,
    external: bool,
    task: EditTask,
    budget: Budget,
    *,
    factor: int = FACTOR,
    asset_views: int = ASSET_VIEWS,
) -> EditResult:
    """Optimise all attributes of the asset, with density control. texture: w above; external: the user's program makes
    the high-resolution pictures; factor: of their size; asset_views: views of the asset. Raises ValueError for a global
    edit (base views show the old look everywhere), and where the program is missing or fails."""
    from splatbench.methods.srgs_patches import srgs_loss
    from splatpainter.fit.optimize import FitOptions, optimize

    if task.step.mode == "global":
        raise ValueError(f"srgs: is for local edits, got a global one ({task.step.kind})")
    begin = time.perf_counter()
    if external:
        if budget.scratch is not None:
            budget.scratch.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="super-resolution-", dir=budget.scratch))
        unedited = low_views(task, program(budget.adapters, factor, folder), budget, factor, asset_views)
        shutil.rmtree(folder, ignore_errors=True)  # after a failure it stays: its log is named in the error
    else:
        unedited = low_views(task, partial(lanczos, factor=factor), budget, factor, asset_views)
    setup = time.perf_counter() - begin
    curve = Curve(budget.curve)
    views = mixed(fit_views(task.step.edited), unedited, EDITED_SHARE)
    options = FitOptions(steps=budget.steps, ssim=SSIM_SHARE, seed=budget.seed, device=budget.device)
    fitted = optimize(task.asset, views, options, loss=partial(srgs_loss, texture, factor), watch=curve.watch)
    prior = "the adapters file's program" if external else "Lanczos and back-projection, no network"
    return EditResult(
        fitted.splats,
        setup,
        curve.seconds,
        keeps_rows=False,
        numbers={"steps": float(fitted.steps), "patches": float(len(unedited)), "rows": float(len(fitted.splats))},
        note=f"{fitted.steps} steps, each of a window of a large picture ({min(PATCH_EDGE / factor, 1):.0%} of its "
        f"edge) or ({EDITED_SHARE:.0%}) an edited view; {len(task.base)} base views and {asset_views} of the asset, "
        f"x{factor} by {prior}; {texture:g} L_tex + {1 - texture:g} L_sub; densification",
        curve=tuple(curve.points),
    )


def low_views(task: EditTask, prior: Prior, budget: Budget, factor: int, asset_views: int) -> list[View]:
    """Patches of base views and of views of the asset, without what the edit contradicts (gs3d.py): of the asset's
    views, and, where it is no close-up, of base views too."""
    from splatbench.methods.srgs_patches import patches

    gaussians = reached(task.asset, [task.step])
    count = min(MAX_PATCHES, max(1, round(budget.steps / (len(task.base) + asset_views))))
    edge = PATCH_EDGE * max(max(camera.width, camera.height) for camera in task.base.cameras)
    settings = (task.asset, prior, factor, edge, count, np.random.default_rng(budget.seed))
    weights = None if task.step.kind == "zoom" else weights_beside(task.asset, task.base, gaussians)
    out: list[View] = [*patches(task.base, *settings, weights)]
    renders = views_of_asset(task, asset_views)
    if renders is not None:
        out += patches(renders, *settings, weights_beside(task.asset, renders, gaussians))
    return out


# Priors.


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
    """By Lanczos; values of any sign."""
    from PIL import Image

    size = (picture.shape[1] * factor, picture.shape[0] * factor)
    planes = np.ascontiguousarray(np.moveaxis(picture, -1, 0), np.float32)
    resize = Image.Resampling.LANCZOS
    return np.stack([np.asarray(Image.fromarray(plane, "F").resize(size, resize)) for plane in planes], -1)


def _section(adapters: Path | None) -> config.Section | None:
    return None if adapters is None else config.section(adapters, PROGRAM)


def missing(external: bool, budget: Budget) -> str:
    """Why there is no program to call, or ""."""
    if not external:
        return ""
    try:
        section = _section(budget.adapters)
    except ValueError as error:
        return str(error)
    if section is None:
        return f"not installed: add [{PROGRAM}] with a `command` to the adapters file ({config.GUIDE})"
    if not section.command:
        example = 'a list of words, e.g. ["python", "upscale.py"]'
        return f"[{PROGRAM}] has no `command`: expected {example} ({config.GUIDE})"
    return config.problem(section, (), config.has_cuda_gpu)


def version(external: bool, budget: Budget) -> str:
    """Changes with the settings and, with a program, with its table of the adapters file."""
    settings = f"2-{FACTOR}-{ASSET_VIEWS}-{MAX_PATCHES}-{PATCH_EDGE}-{EDITED_SHARE:g}"
    if not external:
        return settings
    try:
        section = _section(budget.adapters)
    except ValueError:
        section = None
    return f"{settings}-{'none' if section is None else section.digest()}"


def program(adapters: Path | None, factor: int, folder: Path) -> Prior:
    """The user's program as a prior. folder: for its pictures and its log. Raises ValueError where it is not there
    (`missing`); the prior raises where it fails or leaves no picture of the right size."""
    problem = missing(True, Budget(adapters=adapters))
    section = None if problem else _section(adapters)
    if section is None:
        raise ValueError(problem)
    words = [section.python if word == "{python}" else word for word in section.command]

    def enlarged(picture: np.ndarray) -> np.ndarray:
        from PIL import Image

        from splatpainter.image_files import to_uint8
        from splatpainter.sources.picture_reader import read_picture

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
            raise ValueError(f"[{PROGRAM}] {words[0]}: ended well but wrote no {large.name} (log: {log})")
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


def _method(name: str, label: str, texture: float, external: bool) -> Method:
    return Method(
        name=name,
        label=f"SRGS ({label})",
        edit=partial(edit, texture, external),
        protocols=("refine",),
        missing=partial(missing, external),
        version=partial(version, external),
    )


METHODS = (
    _method("srgs", "0.4 texture + 0.6 sub-pixel; Lanczos prior", PAPER, False),
    _method("srgs-released", "texture alone, as released; Lanczos prior", RELEASED, False),
    _method("srgs-program", "0.4 texture + 0.6 sub-pixel; own super-resolution program", PAPER, True),
    _method("srgs-program-released", "texture alone; own super-resolution program", RELEASED, True),
)
