"""What the speed bench times: each operation prepares a scene and returns the work to repeat.

Runs in fresh processes: `run_operation`, `edit_file` and `small_scene` are called by name and speak JSON.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.scenes import SavedScene
from splatbench.timing import measure
from splatpainter.io import read, write
from splatpainter.painter import Edit, Painter
from splatpainter.pictures import edit_from_files
from splatpainter.splats import ATTRIBUTES, Splats

DISC_RADIUS = 0.131
"""Radius, over the picture's size, of the painted disc that the networks are timed with, about 3,000 of 100,000
Gaussians."""
Work = Callable[[], Any]


@dataclass(frozen=True)
class TimedOperation:
    """One line of the table."""

    prepare: Callable[[SavedScene], Work]
    views: bool = True
    """Whether the picture's size matters."""
    large: bool = True
    """Whether it is also timed on the largest scene."""
    min_px: int = 0
    """Least picture size that it makes sense for, pixels."""
    throughput: bool = True
    """Whether it works on all Gaussians, so that Gaussians per second mean something."""
    min_gaussians: int = 0
    """Scenes with fewer are left out."""
    max_px: int = 1 << 20
    """Largest picture that it is timed with, pixels."""


def render_forward(scene: SavedScene) -> Work:
    """One view, numpy in and out."""
    from splatpainter.rendering import render

    splats, camera = scene.splats, scene.camera
    return lambda: render(splats, camera)


def render_backward(scene: SavedScene) -> Work:
    """Forward and torch's backward to every attribute."""
    return _backward(scene.splats, scene.camera, "cpu")


def _backward(splats: Splats, camera: Any, backend: Any) -> Work:
    import torch

    from splatpainter.rendering import render

    tensors = splats.torch()
    leaves = {name: getattr(tensors, name).clone().requires_grad_(True) for name in ATTRIBUTES}
    tensors = replace(tensors, **leaves)
    seed = torch.Generator().manual_seed(0)
    cotangent = torch.rand((1, camera.height, camera.width, 3), generator=seed)

    def work() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        (render(tensors, camera, backend=backend).colors * cotangent).sum().backward()

    return work


def rays(scene: SavedScene) -> Work:
    """First occupied voxel of every pixel's ray, in a ready grid."""
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import first_hits

    grid = voxelize(scene.splats)
    origin, directions = scene.camera.rays()
    return lambda: first_hits(grid.occupancy, grid, origin, directions)


def voxels(scene: SavedScene) -> Work:
    """The 128^3 grid, as `Painter.encode` and the first edit make it once per asset."""
    from splatpainter.voxels.grid import voxelize

    splats = scene.splats
    return lambda: voxelize(replace(splats))  # a new object: `finite` is cached on the old one


def edit_lift(scene: SavedScene, kind: str, mode: Any) -> Work:
    """A whole edit: its mask found, lifted, receipt with its hashes and scores. kind: of Scene.edited."""
    painter = Painter.load("lift")
    asset = painter.encode(scene.splats)
    assert asset.grid is not None  # once per asset; timed as "voxels"
    edit = Edit(scene.edited(kind)[0], scene.camera)
    return lambda: painter.apply(asset, [edit], mode=mode)


def encode(scene: SavedScene) -> Work:
    """Canonical views, LRM and Stage I of the preset `compact`; nothing from the cache. Times do not depend on the
    weights, so untrained ones will do."""
    painter, splats = _networks(), scene.splats
    return lambda: painter.encode(replace(splats))


def edit_networks(scene: SavedScene, mode: Any) -> Work:
    """A whole edit by the networks: a disc on the pot's belly, or one regraded view."""
    painter = _networks()
    asset = painter.encode(scene.splats)
    assert asset.grid is not None
    picture, mask = _disc(scene) if mode == "local" else (scene.edited("grade")[0], None)
    edit = Edit(picture, scene.camera, mask)
    return lambda: painter.apply(asset, [edit], mode=mode)


def _disc(scene: SavedScene) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] float32 picture, [H, W] bool) a red disc around the dab, DISC_RADIUS of the picture."""
    v, u = np.nonzero(scene.edited("dab")[1])
    across = np.hypot(*(np.indices((scene.size, scene.size)) - np.array([v.mean(), u.mean()])[:, None, None]))
    mask = across < DISC_RADIUS * scene.size
    return np.where(mask[..., None], np.array([0.8, 0.2, 0.15], np.float32), scene.render), mask


def _networks() -> Any:
    """Untrained, but with a decoder with weights, so that every Gaussian is written and children are appended."""
    import torch

    from splatpainter.models.config import COMPACT
    from splatpainter.models.model import SplatPainterModel

    torch.manual_seed(0)
    model = SplatPainterModel(COMPACT)
    torch.nn.init.normal_(model.head.linear.weight, std=1e-3)
    return Painter(model=model)


def lift_dab(scene: SavedScene) -> Work:
    """The lift alone, mask and allowed Gaussians given."""
    from splatpainter.lift.local.local_edit import lift_local

    picture, mask = scene.edited("dab")
    splats, camera, target = scene.splats, scene.camera, picture.astype(np.float32) / 255
    return lambda: lift_local(splats, camera, target, mask)


def preview_round(scene: SavedScene, projected: bool) -> Work:
    """One round of the lift's colours over the dab's tiles; with its projection, as after a camera move, or with the
    one of the round before."""
    from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask

    splats, camera = scene.splats, scene.camera
    picture, mask = scene.edited("dab")
    target, weights, tiles = picture.astype(np.float32) / 255, mask.astype(np.float32), tiles_of_mask(mask)
    first = project(splats, camera, tiles=tiles)
    total = np.maximum(first.backproject(target, weights).weight, 1e-6)[:, None]

    def work() -> np.ndarray:
        view = first if projected else project(splats, camera, tiles=tiles)
        gain, _ = view.sirt_step(target, weights)
        return np.clip(view.unclamped_colors + gain / total, 0, 1)

    return work


def open_file(scene: SavedScene) -> Work:
    """Read a PLY."""
    return lambda: read(scene.ply)


def save_file(scene: SavedScene) -> Work:
    """Write a PLY that was read, with every hundredth Gaussian recoloured."""
    splats = read(scene.ply)
    sh = splats.sh.copy()
    sh[::100, 0] += 0.1
    edited = replace(splats, sh=sh)
    target = scene.folder / "saved.ply"
    return lambda: write(target, edited, overwrite=True)


LOCAL: dict[str, Any] = {"min_px": 512, "throughput": False}
NETWORKS: dict[str, Any] = {"min_gaussians": 100_000, "large": False}
"""On fewer Gaussians, what an edit costs whatever its size hides the rest."""
OPERATIONS: dict[str, TimedOperation] = {
    "render": TimedOperation(render_forward),
    "render and gradients": TimedOperation(render_backward),
    "rays to voxels": TimedOperation(rays, throughput=False),
    "voxels": TimedOperation(voxels, views=False),
    "local edit, dab": TimedOperation(partial(edit_lift, kind="dab", mode="local"), **LOCAL),
    "local edit, text and stroke": TimedOperation(partial(edit_lift, kind="text", mode="local"), large=False, **LOCAL),
    "lift alone, dab": TimedOperation(lift_dab, large=False, **LOCAL),
    "preview round, dab": TimedOperation(partial(preview_round, projected=True), **LOCAL),
    "preview round and projection": TimedOperation(partial(preview_round, projected=False), **LOCAL),
    "global edit, one view": TimedOperation(partial(edit_lift, kind="grade", mode="global"), min_px=512),
    "encode, compact": TimedOperation(encode, views=False, **NETWORKS),
    "local edit ttt, compact": TimedOperation(
        partial(edit_networks, mode="local"), max_px=256, throughput=False, **NETWORKS
    ),
    "global edit ttt, compact": TimedOperation(partial(edit_networks, mode="global"), max_px=256, **NETWORKS),
    "open PLY": TimedOperation(open_file, views=False),
    "save PLY": TimedOperation(save_file, views=False),
}


def run_operation(name: str, folder: str, size: int, repeats: int, budget: float) -> dict[str, Any]:
    """Time one of OPERATIONS on a saved scene."""
    work = OPERATIONS[name].prepare(SavedScene(Path(folder), size))
    return asdict(measure(work, repeats=repeats, budget=budget))


def small_scene(folder: str, size: int, repeats: int) -> dict[str, dict[str, dict[str, Any]]]:
    """Our kernels and the torch reference on one small scene, in turn."""
    import torch

    from splatpainter.rendering import render

    scene = SavedScene(Path(folder), size)
    splats, camera = scene.splats.torch(), scene.camera

    def forward(backend: Any) -> Work:
        def work() -> None:
            with torch.no_grad():
                render(splats, camera, backend=backend)

        return work

    def timed(work: Callable[[Any], Work]) -> dict[str, dict[str, Any]]:
        timings = {
            "ours": measure(work("cpu"), repeats=9 * repeats),
            "reference": measure(work("reference"), repeats=repeats),
        }
        return {name: asdict(timing) for name, timing in timings.items()}

    return {
        "render": timed(forward),
        "render and gradients": timed(lambda backend: _backward(scene.splats, camera, backend)),
    }


def edit_file(ply: str, picture: str) -> dict[str, float]:
    """Open a PLY, apply one edited picture (a PNG that carries its camera) and save, as a user's script would: seconds
    of each step, imports and loading of kernels included in the first one that needs them."""
    start = time.perf_counter()

    seconds = {}

    def record_time(name: str) -> None:
        nonlocal start
        now = time.perf_counter()
        seconds[name], start = now - start, now

    record_time("imports")
    splats = read(ply)
    record_time("open PLY")
    painter = Painter.load("lift")
    asset = painter.encode(splats)
    edited = painter.apply(asset, [edit_from_files(Path(picture)).edit(splats)])
    record_time("edit")
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "edited.ply", edited.splats)
    record_time("save PLY")
    return seconds
