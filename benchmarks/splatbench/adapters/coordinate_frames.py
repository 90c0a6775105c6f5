"""Frames of other systems, and what comes back from them: Gaussians in the asset's frame.

asset        the asset's: OpenCV cameras, any axes; objects of the tables are y up, as their meshes are
trellis      TRELLIS, VoxHammer, VineDresser3D: z up, the object in the cube from -0.5 to 0.5
gltf         the same cube y up, (x, y, z) = (X, Z, -Y) of the trellis frame, as their GLB files are
nerfstudio   the dataparser's: x -> scale (R x + t), as dataparser_transforms.json beside the config has it
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpainter import io
from splatpainter.color import linear_to_srgb, sh_from_color
from splatpainter.io import axes, files
from splatpainter.splats import Splats

Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""y up -> z up: (x, y, z) -> (x, -z, y)."""


@dataclass(frozen=True)
class Frame:
    """x in the asset's frame -> scale * rotation @ x + shift in the system's."""

    rotation: np.ndarray
    """[3, 3]."""
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def points(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] asset -> system."""
        return self.scale * (points @ self.rotation.T) + np.array(self.shift)

    def splats_back(self, splats: Splats) -> Splats:
        """System -> asset, SH turned too. Gaussians that are in the asset's frame already keep their bits."""
        if self.scale == 1 and not any(self.shift) and np.array_equal(self.rotation, np.eye(3)):
            return splats
        return axes.move_back(splats, self.rotation, self.scale, np.array(self.shift))


ASSET = Frame(np.eye(3))


@dataclass(frozen=True)
class Cube:
    """Where an asset is (voxels.grid.bounding_cube)."""

    min_corner: np.ndarray
    """[3], the asset's frame."""
    extent: float

    @staticmethod
    def of(splats: Splats) -> Cube:
        """Raises ValueError where nothing can be drawn."""
        from splatpainter.voxels.grid import bounding_cube

        return Cube(*bounding_cube(splats))

    @property
    def center(self) -> np.ndarray:
        return np.asarray(self.min_corner, np.float64) + self.extent / 2

    def frame(self, *, upright: bool) -> Frame:
        """The frame in which the cube is -0.5..0.5; upright: z up ("trellis"), else y up ("gltf")."""
        rotation = Y_UP_TO_Z_UP if upright else np.eye(3)
        x, y, z = (float(value) for value in -(rotation @ self.center) / self.extent)
        return Frame(rotation, 1 / self.extent, (x, y, z))


def nerfstudio_frame(path: Path) -> Frame:
    """The frame that a nerfstudio dataparser chose. Raises ValueError for a file that does not hold it."""
    try:
        values = json.loads(files.read_all(path))
        matrix, scale = np.array(values["transform"], np.float64), float(values["scale"])
        rotation = matrix[:3, :3]
        if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all() or not 0 < scale < np.inf:
            raise ValueError(f"shape {list(matrix.shape)}, scale {scale:g}")
        if abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError("no rotation")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path}: expected nerfstudio's transform [3, 4] and scale ({error})") from None
    # Written as float32: the nearest rotation, so that Gaussians are not sheared.
    left, _, right = np.linalg.svd(rotation)
    shift = scale * matrix[:3, 3]
    return Frame(left @ right, scale, (float(shift[0]), float(shift[1]), float(shift[2])))


# ---- results

MESH_SURFELS = 120_000
"""Gaussians that stand for a textured mesh."""
MESH_SUFFIXES = (".obj", ".gltf")
MAX_SCALE_RATIO = 4.0
"""How much larger or smaller than the asset a result may be, and (in the asset's cube) how far away, before it is taken
for one in another frame."""


def read_result(path: Path, frame: Frame, seed: int = 0) -> Splats:
    """The Gaussians of a splat file (any of io.FORMATS), or a textured mesh (GLB, glTF, OBJ) as flat ones, brought back
    from the system's frame to the asset's; numpy float32.

    Raises ValueError: no such file, not readable, nothing that can be drawn."""
    if not path.is_file():
        raise ValueError(f"{path.name}: the system wrote no such file ({path})")
    binary = path.suffix.lower() == ".glb"
    mesh = path.suffix.lower() in MESH_SUFFIXES or (binary and b"KHR_gaussian_splatting" not in files.read_all(path))
    splats = splats_of_mesh(path, MESH_SURFELS, seed) if mesh else io.read(path).numpy()
    if binary and not mesh:  # io.read gives the PLY frame; here the file's own numbers are meant
        splats = axes.flip(splats, (-1, -1, 1))
    s = frame.splats_back(splats)
    # A result is an asset of its own: what its file held besides means nothing in another frame.
    s = Splats(s.means, s.quats, s.scales, s.opacities, s.sh, s.antialiased, s.color_space)
    if not s.drawable.any():
        raise ValueError(f"{path}: holds nothing that can be drawn ({len(s)} Gaussians)")
    return s


def splats_of_mesh(path: Path, count: int, seed: int = 0) -> Splats:
    """A textured mesh in its file's frame as `count` dense flat Gaussians of its base colours (data/surfels.py), unlit:
    what TRELLIS bakes into them is how the object looks."""
    import trimesh

    from splattrain.data.meshes import load_mesh
    from splattrain.data.surfels import sample_surfels

    mesh = load_mesh(path)  # normalised to its own box; undone below
    low, high = np.asarray(trimesh.load_scene(path, process=False).bounds, np.float64)  # its nodes' transforms applied
    used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
    extent, span = high - low, used.max(0) - used.min(0)
    scale = float(extent.max() / span.max())
    if abs(extent - scale * span).max() > 1e-3 * extent.max():
        raise ValueError(f"{path}: its broken triangles reach beyond the others; the position of the mesh is unknown")
    surfels = sample_surfels(mesh, count, seed)
    means = surfels.means.numpy().astype(np.float64) * scale + (low + high) / 2
    colors = linear_to_srgb(surfels.albedo.numpy().clip(0, 1))
    return Splats(
        means.astype(np.float32),
        surfels.quats.numpy(),
        surfels.scales.numpy() * np.float32(scale),
        surfels.opacities.numpy(),
        sh_from_color(colors)[:, None].astype(np.float32),
    )


def check_position(splats: Splats, cube: Cube, path: Path) -> None:
    """Raises ValueError where a result is not about where the asset is and not about as large: then the frame is not
    the one that was assumed, and figures would mean nothing."""
    result = Cube.of(splats)
    distance = float(np.linalg.norm(result.center - cube.center)) / cube.extent
    ratio = result.extent / cube.extent
    if not (1 / MAX_SCALE_RATIO < ratio < MAX_SCALE_RATIO) or distance > MAX_SCALE_RATIO / 2:
        raise ValueError(
            f"{path}: the result is {ratio:.3g} times as large as the asset and {distance:.3g} of its size away; "
            "expected it where the asset is: does `frame` in the adapters file fit?"
        )
