"""What the speed bench times: each operation prepares a scene and returns the work to repeat.

Runs in fresh processes: `run_operation`, `edit_file` and `small_scene` are called by name and speak JSON.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.speed_scenes import Scene
from splatbench.timing import measure
from splatpainter.splats import ATTRIBUTES, Splats

DISC = 0.131
"""Radius of the painted disc that the networks are timed with: about 3,000 of 100,000 rows."""
Work = Callable[[], Any]
NETWORKS = 100_000
"""Rows from which the networks are timed: on fewer, what an edit costs whatever its size hides the rest."""


@dataclass(frozen=True)
class Operation:
    """One line of the table."""

    prepare: Callable[[Scene], Work]
    views: bool = True
    """Whether the picture's size matters."""
    large: bool = True
    """Whether it is also timed on the largest scene."""
    smallest: int = 0
    """Least picture size that it makes sense for, pixels."""
    throughput: bool = True
    """Whether it works on all rows, so that rows per second mean something."""
    least_rows: int = 0
    """Scenes with fewer rows are left out."""
    largest: int = 1 << 20
    """Largest picture that it is timed with, pixels."""


def render_forward(scene: Scene) -> Work:
    """One view, numpy in and out."""
    from splatpainter.rendering import render

    splats, camera = scene.splats, scene.camera
    return lambda: render(splats, camera)


def render_backward(scene: Scene) -> Work:
    """Forward and torch's backward to every attribute."""
    return _backward(scene.splats, scene.camera, "cpu")


def _backward(splats: Splats, camera: Any, backend: Any) -> Work:
    import torch

    from splatpainter.rendering import render

    own = splats.torch()
    leaves = {name: getattr(own, name).clone().requires_grad_(True) for name in ATTRIBUTES}
    ready = replace(own, **leaves)
    seed = torch.Generator().manual_seed(0)
    cotangent = torch.rand((1, camera.height, camera.width, 3), generator=seed)

    def work() -> None:
        for leaf in leaves.values():
            leaf.grad = None
        (render(ready, camera, backend=backend).colors * cotangent).sum().backward()

    return work


def rays(scene: Scene) -> Work:
    """First occupied voxel of every pixel's ray, in a ready grid."""
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import first_hits

    grid = voxelize(scene.splats)
    origin, directions = scene.camera.rays()
    return lambda: first_hits(grid.occupancy, grid, origin, directions)


def voxels(scene: Scene) -> Work:
    """The 128^3 grid, as `Painter.encode` and the first edit make it once per asset."""
    from splatpainter.voxels.grid import voxelize

    splats = scene.splats
    return lambda: voxelize(replace(splats))  # a new object: `finite` is cached on the old one


def edit_dab(scene: Scene) -> Work:
    """A whole edit with a brush dab: mask found, lifted, receipt with its hashes and scores."""
    return _edit(scene, "dab", "local")


def edit_text(scene: Scene) -> Work:
    """A whole edit with text and a stroke."""
    return _edit(scene, "text", "local")


def edit_global(scene: Scene) -> Work:
    """A whole global edit from one regraded view."""
    return _edit(scene, "grade", "global")


def _edit(scene: Scene, kind: str, mode: Any) -> Work:
    from splatpainter.painter import Edit, Painter

    painter = Painter.load("lift")
    asset = painter.encode(scene.splats)
    assert asset.grid is not None  # once per asset; timed as "voxels"
    edit = Edit(scene.edited(kind)[0], scene.camera)
    return lambda: painter.apply(asset, [edit], mode=mode)


def encode(scene: Scene) -> Work:
    """Canonical views, LRM and Stage I of the preset `compact`; nothing from the cache. Times do not depend on the
    weights, so untrained ones will do."""
    painter, splats = _networks(), scene.splats
    return lambda: painter.encode(replace(splats))


def edit_networks_local(scene: Scene) -> Work:
    """A whole edit by the networks: a disc on the pot's belly that about 3,000 rows of a hundred thousand make."""
    return _edit_networks(scene, "local")


def edit_networks_global(scene: Scene) -> Work:
    """A whole global edit by the networks from one regraded view."""
    return _edit_networks(scene, "global")


def _edit_networks(scene: Scene, mode: Any) -> Work:
    from splatpainter.painter import Edit

    painter = _networks()
    asset = painter.encode(scene.splats)
    assert asset.grid is not None
    picture, mask = _disc(scene) if mode == "local" else (scene.edited("grade")[0], None)
    edit = Edit(picture, scene.camera, mask)
    return lambda: painter.apply(asset, [edit], mode=mode)


def _disc(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] float32 picture, [H, W] bool) a red disc around the dab, DISC of the picture in radius."""
    v, u = np.nonzero(scene.edited("dab")[1])
    across = np.hypot(*(np.indices((scene.size, scene.size)) - np.array([v.mean(), u.mean()])[:, None, None]))
    mask = across < DISC * scene.size
    return np.where(mask[..., None], np.array([0.8, 0.2, 0.15], np.float32), scene.render), mask


def _networks() -> Any:
    """Untrained, but with a decoder that says something, so that every row is written and children are appended."""
    import torch

    from splatpainter.models.config import COMPACT
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.painter import Painter

    torch.manual_seed(0)
    model = SplatPainterModel(COMPACT)
    torch.nn.init.normal_(model.head.linear.weight, std=1e-3)
    return Painter(model=model)


def lift_dab(scene: Scene) -> Work:
    """The lift alone, mask and allowed rows given."""
    from splatpainter.lift.local_edit import lift_local

    picture, mask = scene.edited("dab")
    splats, camera, target = scene.splats, scene.camera, picture.astype(np.float32) / 255
    return lambda: lift_local(splats, camera, target, mask)


def preview_round(scene: Scene) -> Work:
    """One round of the lift's colours over the dab's tiles, the frame kept from the round before."""
    frame, advance = _preview(scene)
    return lambda: advance(frame())


def preview_project(scene: Scene) -> Work:
    """The same with its projection: what the first round after a camera move costs."""
    _, advance = _preview(scene)
    project = _projection(scene)
    return lambda: advance(project())


def _projection(scene: Scene) -> Callable[[], Any]:
    from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask

    splats, camera = scene.splats, scene.camera
    tiles = tiles_of_mask(scene.edited("dab")[1])
    return lambda: project(splats, camera, tiles=tiles)


def _preview(scene: Scene) -> tuple[Callable[[], Any], Callable[[Any], np.ndarray]]:
    frame = _projection(scene)()
    picture, mask = scene.edited("dab")
    target, weights = picture.astype(np.float32) / 255, mask.astype(np.float32)
    total = np.maximum(frame.backproject(target, weights).weight, 1e-6)[:, None]

    def advance(frame: Any) -> np.ndarray:
        gain, _ = frame.sirt_step(target, weights)
        return np.clip(frame.unclamped_colors + gain / total, 0, 1)

    return lambda: frame, advance


def open_file(scene: Scene) -> Work:
    """Read a PLY."""
    from splatpainter.io import read

    return lambda: read(scene.ply)


def save_file(scene: Scene) -> Work:
    """Write a PLY that was read, with every hundredth row recoloured."""
    from splatpainter.io import read, write

    splats = read(scene.ply)
    sh = splats.sh.copy()
    sh[::100, 0] += 0.1
    edited = replace(splats, sh=sh)
    target = scene.folder / "saved.ply"
    return lambda: write(target, edited, overwrite=True)


OPERATIONS: dict[str, Operation] = {
    "render": Operation(render_forward),
    "render and gradients": Operation(render_backward),
    "rays to voxels": Operation(rays, throughput=False),
    "voxels": Operation(voxels, views=False),
    "local edit, dab": Operation(edit_dab, smallest=512, throughput=False),
    "local edit, text and stroke": Operation(edit_text, smallest=512, large=False, throughput=False),
    "lift alone, dab": Operation(lift_dab, smallest=512, large=False, throughput=False),
    "preview round, dab": Operation(preview_round, smallest=512, throughput=False),
    "preview round and projection": Operation(preview_project, smallest=512, throughput=False),
    "global edit, one view": Operation(edit_global, smallest=512),
    "encode, compact": Operation(encode, views=False, least_rows=NETWORKS, large=False),
    "local edit ttt, compact": Operation(
        edit_networks_local, least_rows=NETWORKS, large=False, largest=256, throughput=False
    ),
    "global edit ttt, compact": Operation(edit_networks_global, least_rows=NETWORKS, large=False, largest=256),
    "open PLY": Operation(open_file, views=False),
    "save PLY": Operation(save_file, views=False),
}


def run_operation(name: str, folder: str, size: int, repeats: int, budget: float) -> dict[str, Any]:
    """Time one of OPERATIONS on a saved scene."""
    work = OPERATIONS[name].prepare(Scene(Path(folder), size))
    return asdict(measure(work, repeats=repeats, budget=budget))


def small_scene(folder: str, size: int, repeats: int) -> dict[str, dict[str, dict[str, Any]]]:
    """Our kernels and the torch reference on one small scene, in turn."""
    import torch

    from splatpainter.rendering import render

    scene = Scene(Path(folder), size)
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
    from splatpainter.io import read, write
    from splatpainter.painter import Painter
    from splatpainter.sources import edit_from_files

    laps = {}

    def lap(name: str) -> None:
        nonlocal start
        now = time.perf_counter()
        laps[name], start = now - start, now

    lap("imports")
    splats = read(ply)
    lap("open PLY")
    painter = Painter.load("lift")
    asset = painter.encode(splats)
    edited = painter.apply(asset, [edit_from_files(Path(picture)).edit(splats)])
    lap("edit")
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "edited.ply", edited.splats)
    lap("save PLY")
    return laps
