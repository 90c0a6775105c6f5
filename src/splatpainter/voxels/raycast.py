"""Rays through the voxel cube: the first voxel that each one hits, and the Gaussians that an edit of pixels may touch.

The walk is Amanatides & Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing" (Eurographics 1987), over empty space
in long steps (native/voxels/rays.h). Knows no renderer and no network: what a pixel really owes to a Gaussian is the
lift's business, this keeps its candidates few.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels import footprints
from splatpainter.voxels.grid import RESOLUTION, VoxelGrid, bounding_cube

MAX_RAY_THICKNESS = 3.0
"""Optical thickness after which a ray is spent and sees nothing more (exp(-3) = 5 % would get through)."""
BRICK_EDGE = 4
"""Voxels along an edge of a brick, whose 64 bits are one number."""


@dataclass(frozen=True)
class Bricks:
    """A volume of R^3 voxels, packed for rays, and the rays' common origin."""

    words: np.ndarray
    """[B^3] uint64 the set voxels of each brick."""
    clearances: np.ndarray
    """[B^3] uint8 distance to the nearest brick in which something is set, in bricks along the longest axis: 0 in such
    a one, 15 at most."""
    resolution: int
    """R."""
    box: np.ndarray
    """[3, 2] int64 (first, last + 1) voxel along each axis of the bricks in which something is set."""

    @staticmethod
    def of(volume: np.ndarray) -> Bricks:
        """volume: [R, R, R] uint8, set where not 0, or float32, set where above 0."""
        resolution = len(volume)
        count = (-(-resolution // BRICK_EDGE)) ** 3
        # Bricks of 64 bits with the distance to the next full one: rays cross empty space in long steps.
        words, clearances = np.empty(count, np.uint64), np.empty(count, np.uint8)
        pack = kernels.pack_dense if volume.dtype == np.float32 else kernels.pack_marked
        run(pack, volume.ravel(), resolution, words)
        scratch = (np.empty(count, np.uint8), np.empty(count, np.uint8))
        kernels.measure_clearances(words, resolution, clearances, *scratch, 0, 1)
        edge = -(-resolution // BRICK_EDGE)
        box = BRICK_EDGE * footprints.index_bounds((clearances == 0).reshape((edge,) * 3))
        return Bricks(words, clearances, resolution, box)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, int, np.ndarray]:
        return self.words, self.clearances, self.resolution, self.box


def first_hits(
    occupancy: np.ndarray, grid: VoxelGrid, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The first occupied voxel along each ray.

    occupancy: [R, R, R] uint8 or bool (grid.occupancy, or any volume on the same cube); origin: [3] world units;
    directions: [..., 3], any non-zero length. Returns (keys [...] int64, distances [...] float32 to where the ray
    enters that voxel, in lengths of its direction: world units for unit directions, 0 if it starts inside it); -1 and
    -1 where no voxel is hit."""
    volume = np.ascontiguousarray(occupancy).view(np.uint8)
    assert volume.shape == (grid.resolution,) * 3, f"first_hits: occupancy has shape {volume.shape}"
    rays = np.ascontiguousarray(directions, np.float32).reshape(-1, 3)
    keys, distances = np.empty(len(rays), np.int64), np.empty(len(rays), np.float32)
    args = (_in_voxels(grid, origin), float(grid.voxel), rays, keys, distances)
    run(kernels.find_first_voxels, *Bricks.of(volume).arrays, *args)
    shape = np.shape(directions)[:-1]
    return keys.reshape(shape), distances.reshape(shape)


def seen_voxels(grid: VoxelGrid, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([R, R, R] bool voxels of any density that rays cross before they are spent, [...] bool rays that leave the cube
    unspent, so that something behind it shows). origin: [3]; directions: [..., 3], any non-zero length."""
    rays = np.ascontiguousarray(directions, np.float32).reshape(-1, 3)
    density = np.ascontiguousarray(grid.density, np.float32)
    seen, through = np.zeros(density.shape, bool), np.empty(len(rays), bool)
    args = (_in_voxels(grid, origin), density.ravel(), rays, MAX_RAY_THICKNESS, seen.ravel(), through)
    run(kernels.mark_seen_voxels, *Bricks.of(density).arrays, *args)
    return seen, through.reshape(np.shape(directions)[:-1])


def editable_gaussians(grid: VoxelGrid, splats: Splats, camera: Camera, mask: np.ndarray, reach: int = 1) -> np.ndarray:
    """[N] bool: Gaussians that an edit of the masked pixels may touch.

    mask: [H, W] bool of the camera's picture. One may be touched if its footprint meets a voxel that a masked pixel's
    ray crosses before it is spent (`seen_voxels`), or one of the `reach` voxels around it. Outliers beyond the cube may
    be touched under any masked pixel if nearer than the cube's middle, else where a ray gets through the cube. Raises
    ValueError for a mask of another size.

    Why not the first occupied voxel and its neighbours: a capture's surface is a fog some voxels thick. Measured on the
    captures of grid.py, 76 brush dabs, 512 px: the share of the masked pixels' weights that editable Gaussians hold
    (mean, worst dab), and the share of these that nothing in the view shows (harmless: they get no weight):

                                                     statue               robot on grass
        first voxel, by their centres, reach 1       0.85, 0.41;  5 %     0.65, 0.31; 0.4 %
        first voxel, by footprint, reach 2           0.99, 0.96; 10 %     0.97, 0.85;  3 %
        until spent, by footprint, reach 1           1.00, 0.96;  8 %     1.00, 0.91;  3 %
    """
    if mask.shape != (camera.height, camera.width):
        expected, actual = f"{camera.width}x{camera.height}", "x".join(map(str, mask.shape[::-1]))
        raise ValueError(f"mask: expected the size of its view, {expected}, got {actual}")
    assert len(splats) == len(grid.index), "editable_gaussians: the grid is of another asset"
    out = np.zeros(len(splats), bool)
    ys, xs = np.nonzero(mask)
    if not len(ys):
        return out
    # Rays of the mask's window alone.
    x, y, width, height = xs.min(), ys.min(), np.ptp(xs) + 1, np.ptp(ys) + 1
    window = mask[y : y + height, x : x + width].astype(bool)
    view = camera.cropped(int(x), int(y), int(width), int(height))
    origin, rays = view.rays()
    seen, through = seen_voxels(grid, origin, rays[window])
    # One voxel around what was seen: a footprint may lie half in the next.
    marked = _dilated(seen, reach)
    ids = np.flatnonzero(grid.index >= 0)
    # The voxel of the centre counts too: those too faint to be drawn have no footprint, but a centre.
    out[ids] = marked.ravel()[grid.index[ids]] & ~grid.outside[ids]
    rest = ids[~out[ids]]
    out[rest] = footprints.touching(splats, rest, grid.min_corner, grid.voxel, marked)

    strays = np.flatnonzero(grid.outside & ~out)
    if len(strays):
        beyond = np.zeros(window.shape, bool)
        beyond[window] = through
        out[strays] = _visible_strays(grid, splats, view, strays, window, beyond)
    return out


def inside(grid: VoxelGrid, occupancy: np.ndarray, point: np.ndarray) -> bool:
    """Whether a point ([3], world units: a camera's position) lies in an occupied voxel: there every ray hits at once,
    and a picture from there says nothing about the surface."""
    cell = np.floor(_in_voxels(grid, point))
    if not ((cell >= 0) & (cell < grid.resolution)).all():
        return False
    return bool(occupancy[tuple(cell.astype(int))])


def is_inside(splats: Splats, grid: Callable[[], VoxelGrid], point: np.ndarray) -> bool:
    """Whether a point lies in an occupied voxel of an asset (`inside`). grid: makes or has its voxels; it is not called
    where the point lies beyond the cube that they divide, as that of most cameras does."""
    if _is_far(splats, point):
        return False
    min_corner, extent = bounding_cube(splats)
    cell = np.floor((np.asarray(point, np.float64) - min_corner) / (extent / RESOLUTION))
    if not ((cell >= 0) & (cell < RESOLUTION)).all():
        return False
    voxels = grid()
    return inside(voxels, voxels.occupancy, point)


def _is_far(splats: Splats, point: np.ndarray) -> bool:
    """Whether a point lies beyond any cube that `bounding_cube` may find: quick, and False where in doubt."""
    if not len(splats):
        return False
    low, high, longest = splats.extremes
    span, size = float((high - low).max()), float(max(np.abs(low).max(), np.abs(high).max()))
    margin = span + 2 * longest + 1e-5 * size
    return bool((point < low - margin).any() or (point > high + margin).any())


def _in_voxels(grid: VoxelGrid, point: np.ndarray) -> np.ndarray:
    """[3] float64 a world point in voxels from the cube's corner."""
    return (np.asarray(point, np.float64) - grid.min_corner) / grid.voxel


def _dilated(volume: np.ndarray, reach: int) -> np.ndarray:
    """[R, R, R] bool: voxels within `reach` of a set one along every axis (a cube of 2 reach + 1)."""
    out = volume.copy()
    box = footprints.index_bounds(volume)
    # Only around what is set: a brush dab marks a thousandth of the cube.
    part = tuple(slice(max(int(low) - reach, 0), int(high) + reach) for low, high in box)
    for axis in range(3):
        target = np.moveaxis(out[part], axis, 0)
        source = target.copy()
        for step in range(1, min(reach, len(source) - 1) + 1):
            target[step:] |= source[:-step]
            target[:-step] |= source[step:]
    return out


def _visible_strays(
    grid: VoxelGrid, splats: Splats, view: Camera, ids: np.ndarray, window: np.ndarray, beyond: np.ndarray
) -> np.ndarray:
    """[M] bool: outliers whose box in the picture holds a masked pixel (nearer than the cube's middle) or one
    whose ray gets through the cube (farther)."""
    arrays = splats.numpy()
    local = view.to_camera(arrays.means[ids])
    z = local[:, 2]
    radius = footprints.SIGMAS * arrays.scales[ids].max(1)
    # From the near side of its ball: a box that is too large only makes a candidate.
    near = np.maximum(z - radius, 1e-3 * np.abs(z) + 1e-12)
    center_z = view.to_camera(grid.min_corner + grid.extent / 2)[2]
    front = z < center_z

    def edges(offset: np.ndarray, focal: float, center: float, pixels: int) -> tuple[np.ndarray, np.ndarray]:
        ends = np.stack([(offset + sign * radius) / depth for sign in (-1, 1) for depth in (near, np.maximum(z, near))])
        with np.errstate(over="ignore"):  # beyond the range of float64 is beyond the picture
            ends = np.clip(ends * focal + center, 0, pixels)
        return np.floor(ends.min(0)).astype(int), np.ceil(ends.max(0)).astype(int)

    left, right = edges(local[:, 0], view.fx, view.cx, view.width)
    top, bottom = edges(local[:, 1], view.fy, view.cy, view.height)

    def holds(pixels: np.ndarray) -> np.ndarray:
        sums = np.pad(pixels.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0

    return (z + radius > 0) & np.where(front, holds(window), holds(beyond))
