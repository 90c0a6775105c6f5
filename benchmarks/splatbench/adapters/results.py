"""What comes back from another system, as rows in the asset's frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatbench.adapters.alignment import Frame
from splatbench.adapters.exchange import Cube
from splatpainter.io import files
from splatpainter.splats import SH_C0, Splats

SURFELS = 120_000
"""Rows that stand for a textured mesh."""
MESHES = (".obj", ".gltf")
LARGER = 4.0
"""How much larger or smaller than the asset a result may be, and (in the asset's cube) how far away, before it is taken
for one in another frame."""


def read(path: Path, frame: Frame, seed: int = 0) -> Splats:
    """The rows of a splat file (any of io.FORMATS), or a textured mesh (GLB, glTF, OBJ) as rows, brought back from the
    system's frame to the asset's; numpy float32.

    Raises ValueError: no such file, not readable, no row that can be drawn."""
    from splatpainter import io
    from splatpainter.io.frames import flip

    if not path.is_file():
        raise ValueError(f"{path.name}: the system left no such file ({path})")
    binary = path.suffix.lower() == ".glb"
    mesh = path.suffix.lower() in MESHES or (binary and not _holds_splats(path))
    rows = from_mesh(path, SURFELS, seed) if mesh else io.read(path).numpy()
    if binary and not mesh:  # io.read gives the PLY frame; here the file's own numbers are meant
        rows = flip(rows, (-1, -1, 1))
    rows = frame.rows_back(rows)
    # A result is an asset of its own: what its file held beyond the rows means nothing in another frame.
    rows = Splats(rows.means, rows.quats, rows.scales, rows.opacities, rows.sh, rows.antialiased, rows.color_space)
    if not rows.drawable.any():
        raise ValueError(f"{path}: holds no row that can be drawn ({len(rows)} rows)")
    return rows


def from_mesh(path: Path, count: int, seed: int = 0) -> Splats:
    """A textured mesh in its file's frame as `count` dense flat rows of its base colours (data/surfels.py), unlit: what
    TRELLIS bakes into them is how the object looks."""
    from splatpainter.data.meshes import load_mesh
    from splatpainter.data.surfels import sample_surfels
    from splatpainter.sources.looks import to_display

    mesh = load_mesh(path)  # normalised to its own box; undone below
    low, high = _bounds(path)
    used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
    extent, span = high - low, used.max(0) - used.min(0)
    scale = float(extent.max() / span.max())
    if abs(extent - scale * span).max() > 1e-3 * extent.max():
        raise ValueError(f"{path}: its broken triangles reach beyond the others; the place of the mesh is not known")
    surfels = sample_surfels(mesh, count, seed)
    means = surfels.means.numpy().astype(np.float64) * scale + (low + high) / 2
    colors = to_display(surfels.albedo.numpy().clip(0, 1))
    return Splats(
        means.astype(np.float32),
        surfels.quats.numpy(),
        surfels.scales.numpy() * np.float32(scale),
        surfels.opacities.numpy(),
        ((colors - 0.5) / SH_C0)[:, None].astype(np.float32),
    )


def check_place(splats: Splats, cube: Cube, where: Path) -> None:
    """Raises ValueError where a result is not about where the asset is and not about as large: then the frame is not
    the one that was assumed, and figures would mean nothing."""
    own = Cube.of(splats)
    distance = float(np.linalg.norm(own.lo + own.size / 2 - (cube.lo + cube.size / 2))) / cube.size
    ratio = own.size / cube.size
    if not (1 / LARGER < ratio < LARGER) or distance > LARGER / 2:
        raise ValueError(
            f"{where}: the result is {ratio:.3g} times as large as the asset and {distance:.3g} of its size away; "
            "expected it in the asset's place: does `frame` in the adapters file fit?"
        )


def _holds_splats(path: Path) -> bool:
    return b"KHR_gaussian_splatting" in files.read_all(path)


def _bounds(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(low [3], high [3]) of a mesh file's triangles, its nodes' transforms applied."""
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    low, high = np.asarray(scene.bounds, np.float64)
    return low, high
