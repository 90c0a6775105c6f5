"""A closed mesh that stands for an asset's surface: what other programs cast shadows with.

Gaussians fill voxels, gaps of a voxel are closed, what cannot be reached from outside is solid, and the border of that
solid, blurred, is cut out by marching tetrahedra (Doi and Koide 1991; six to a cube, all cubes alike): a mesh without
holes and without edges that more than two triangles share. A sheet becomes a slab of one or two voxels.

Such meshes have as many triangles on a plane as on a curl. Decimated (edges collapsed by quadrics, Garland and Heckbert
1997, by fast-simplification) the same number shows finer detail.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.color import base_color
from splatpainter.extras import require
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix


@dataclass(frozen=True)
class ProxyMeshThresholds:
    """How Gaussians become a mesh that stands for them. Source: taste, tried on captures."""

    min_opacity: float = 0.25
    """Fainter Gaussians are no surface."""
    cut_density: float = 0.35
    """Density of the blurred solid, 0..1, at which it is cut: a sheet of one voxel has 0.5 in its middle."""
    inwards: float = 0.8
    """Voxels by which vertices go back, as half a voxel and the blur lie outside of the surface."""
    inwards_thin: float = 0.2
    """Voxels by which vertices of slabs go back: no more than leaves them a thickness."""
    patch_reach: float = 1.5
    """Standard deviations up to which a Gaussian fills voxels, along its axes."""
    max_patch_voxels: int = 8
    """Steps along each axis of a Gaussian, at most, that fill voxels: longer ones are filled sparsely."""
    thickness_resolution: int = 128
    """Voxels along the longest side of the asset where its thickness is measured."""
    triangles_per_square: float = 14.0
    """Triangles for each square of the resolution, about, that a mesh has: the first guess."""
    decimated_from: float = 5.0
    """Times as many triangles that a mesh has before it is decimated."""
    min_decimated: int = 100
    """Triangles that can be asked for where they are decimated."""
    eagerness: tuple[float, ...] = (5.0, 6.0, 4.0, 7.0, 3.0, 8.0)
    """How fast quadrics' limits grow (fast-simplification's `agg`, 7 by default), in the order tried until the result
    is closed. Of balls, a sheet and a capture at 2,000 to 20,000 triangles all are at 5."""


PROXY = ProxyMeshThresholds()


RESOLUTIONS = (6, 192)
"""Voxels along the longest side."""
MIN_TRIANGLES = 2000
"""That can be asked for: a ball of six voxels has 1,700."""
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
TETRAHEDRA = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Of a cube, all around its diagonal, all of one orientation."""
CASES: dict[int, list[list[tuple[int, int]]]] = {
    0b0001: [[(0, 1), (0, 2), (0, 3)]],
    0b0010: [[(1, 0), (1, 3), (1, 2)]],
    0b0100: [[(2, 0), (2, 1), (2, 3)]],
    0b1000: [[(3, 0), (3, 2), (3, 1)]],
    0b0011: [[(0, 3), (1, 3), (0, 2)], [(1, 3), (1, 2), (0, 2)]],
    0b0101: [[(0, 1), (2, 1), (0, 3)], [(2, 1), (2, 3), (0, 3)]],
    0b1001: [[(0, 2), (3, 2), (0, 1)], [(3, 2), (3, 1), (0, 1)]],
}
"""Corners of a tetrahedron that are inside, as bits -> triangles of the edges that are cut."""


@dataclass(frozen=True)
class ProxyMesh:
    vertices: Floats = field(repr=False)
    """[V, 3] float32, relative to the asset's offset."""
    triangles: Ids = field(repr=False)
    """[T, 3] int64, counter-clockwise seen from outside."""
    normals: Floats = field(repr=False)
    """[V, 3] float32 unit, outwards."""
    colors: Floats = field(repr=False)
    """[V, 3] float32 display colours 0..1 of the Gaussians nearby."""
    voxel: float
    """Edge of a voxel, world units: what is finer is not there."""
    cut_triangles: int
    """Before decimation."""


def proxy_mesh(splats: Splats, max_triangles: int = 20_000, *, decimate: bool = False) -> ProxyMesh:
    """At most about max_triangles, and as fine as that allows. decimate: by the extra `mesh`, finer for as many. Raises
    ValueError: nothing that could be drawn, fewer triangles asked for than MIN_TRIANGLES (PROXY.min_decimated), the
    extra is missing."""
    least = PROXY.min_decimated if decimate else MIN_TRIANGLES
    if max_triangles < least:
        raise ValueError(f"mesh: expected at least {least} triangles, got {max_triangles}")
    if decimate:
        require("fast_simplification", "mesh: decimation")
    splats = splats.numpy()
    solid = splats.drawable & (splats.opacities >= PROXY.min_opacity)
    if not solid.any():
        raise ValueError("mesh: expected Gaussians that hide something (an opacity of 0.25), got none")
    splats = splats.take(solid)
    low, high = RESOLUTIONS
    limit = max(int(max_triangles * PROXY.decimated_from), MIN_TRIANGLES) if decimate else max_triangles
    resolution = int(np.clip(np.sqrt(limit / PROXY.triangles_per_square) * 2, low, high))
    while True:
        mesh = _mesh(splats, resolution, max_triangles if decimate else None)
        if mesh.cut_triangles <= limit or resolution <= low:
            return mesh
        shrink = np.sqrt(limit / mesh.cut_triangles)
        resolution = max(low, min(resolution - 1, int(resolution * shrink)))


def thickness(splats: Splats, normals: np.ndarray, resolution: int = PROXY.thickness_resolution) -> Floats:
    """[N] float32 world units from each Gaussian through the solid to its other side, against its normal [N, 3] (unit,
    outwards); no finer than a voxel, and 0 where it cannot be drawn."""
    splats = splats.numpy()
    out, drawable = np.zeros(len(splats), np.float32), splats.drawable
    hiding = drawable & (splats.opacities >= PROXY.min_opacity)
    if not hiding.any():
        return out
    points, _ = _samples(splats.take(hiding), resolution)
    solid, origin, voxel, _ = _voxels(points, resolution)
    position = (splats.means[drawable] - origin) / voxel
    inwards = -normals[drawable].astype(np.float64)
    alive, depth = np.ones(len(position), bool), np.zeros(len(position))
    for step in range(1, 4 * resolution):  # half a voxel each
        cells = np.floor(position[alive] + 0.5 * step * inwards[alive]).astype(np.int64)
        inside = np.all((cells >= 0) & (cells < np.array(solid.shape)), axis=1)
        inside[inside] = solid[tuple(cells[inside].T)]
        alive[np.flatnonzero(alive)[~inside]] = False
        depth[alive] = 0.5 * step
        if not alive.any():
            break
    out[drawable] = (depth + 0.5) * voxel
    return out


def _voxels(points: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """([X, Y, Z] bool solid, [3] its corner, edge of a voxel, [S] the voxel of each point)."""
    least, most = points.min(0), points.max(0)
    voxel = max(float((most - least).max()) / resolution, 1e-12)
    origin = least - 3.5 * voxel  # room for closing and for the blur
    shape = np.ceil((most - origin) / voxel).astype(np.int64) + 4
    cells = np.floor((points - origin) / voxel).astype(np.int64)
    flat = np.ravel_multi_index(cells.T, shape)
    filled = np.zeros(shape, bool)
    filled.reshape(-1)[flat] = True
    return _solid(filled), origin, voxel, flat


def _mesh(splats: Splats, resolution: int, decimated: int | None) -> ProxyMesh:
    """decimated: triangles, at most, that are left; None: all."""
    points, owners = _samples(splats, resolution)
    solid, origin, voxel, flat = _voxels(points, resolution)
    shape = np.array(solid.shape)
    density = _blurred(solid.astype(np.float32))
    vertices, triangles = _marching_tetrahedra(density, PROXY.cut_density)
    cut = len(triangles)
    if decimated is not None and cut > decimated:
        vertices, triangles = _decimated(vertices, triangles, decimated)
    # Colours: means of voxels, spread over their neighbours where none is.
    colors = base_color(splats.sh).clip(0, 1)[owners]
    total = np.bincount(flat, minlength=solid.size).reshape(shape).astype(np.float32)
    sums = [np.bincount(flat, column, solid.size).reshape(shape).astype(np.float32) for column in colors.T]
    for _ in range(2):
        total, sums = _blurred(total), [_blurred(channel) for channel in sums]
    at = tuple(np.clip(np.rint(vertices).astype(np.int64), 0, shape - 1).T)
    shade = np.stack([channel[at] / np.maximum(total[at], 1e-9) for channel in sums], 1)
    shade = np.where(total[at][:, None] > 1e-9, shade, 0.5)
    normals = _vertex_normals(vertices, triangles)
    behind = tuple(np.clip(np.rint(vertices - 2 * normals).astype(np.int64), 0, shape - 1).T)
    back = np.where(density[behind] > PROXY.cut_density, PROXY.inwards, PROXY.inwards_thin)[:, None]
    world = (origin + (vertices + 0.5 - back * normals) * voxel).astype(np.float32)
    return ProxyMesh(world, triangles, normals.astype(np.float32), shade.clip(0, 1).astype(np.float32), voxel, cut)


def _decimated(vertices: np.ndarray, triangles: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """([V, 3] float64 vertices, [T, 3] int64 triangles, about `count` of them) of the same closed surface; as they were
    where no try ends closed."""
    from fast_simplification import simplify

    for eagerness in PROXY.eagerness:
        fewer = simplify(vertices, triangles.astype(np.int32), target_count=count, agg=eagerness)
        points, faces = np.asarray(fewer[0], np.float64), np.asarray(fewer[1], np.int64)
        # A collapse may lay two triangles on each other, back to back: both go, and what is around stays closed.
        _, which, copies = np.unique(np.sort(faces, 1), axis=0, return_inverse=True, return_counts=True)
        used, index = np.unique(faces[copies[which.reshape(-1)] == 1], return_inverse=True)
        faces = index.reshape(-1, 3)
        if is_closed(faces) and len(faces) <= count:
            return points[used], faces
    return vertices, triangles


def is_closed(triangles: np.ndarray) -> bool:
    """Whether each edge of triangles [T, 3] belongs to two of them, once each way."""
    if not len(triangles):
        return False
    edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    forth, back = (np.unique(pairs, axis=0, return_counts=True) for pairs in (edges, edges[:, ::-1]))
    return bool((forth[1] == 1).all()) and forth[0].shape == back[0].shape and bool((forth[0] == back[0]).all())


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> Floats:
    """[V, 3] float64 unit: means of the triangles around, by their areas."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    corners = triangles.T.ravel()
    sums = [np.bincount(corners, np.tile(column, 3), len(vertices)) for column in areas.T]
    total = np.stack(sums, 1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def _samples(splats: Splats, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """([S, 3] float64 points all over the Gaussians, [S] whose each is)."""
    means = splats.means.astype(np.float64)
    step = max(float(np.ptp(means, axis=0).max()) / resolution, 1e-12)
    axes = quat_to_matrix(splats.quats).astype(np.float64)
    order = np.argsort(splats.scales, 1, kind="stable")[:, ::-1]
    # In the plane of its two longer axes; the grid is as fine as the voxels.
    counts = np.clip(
        np.ceil(PROXY.patch_reach * np.take_along_axis(splats.scales, order[:, :2], 1) / step),
        0,
        PROXY.max_patch_voxels,
    )
    points, owners = [means], [np.arange(len(means))]
    for a, b in np.unique(counts.astype(np.int64), axis=0):
        if a == b == 0:
            continue
        some = np.flatnonzero((counts == (a, b)).all(1))
        u, v = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 2 * a + 1), np.linspace(-1, 1, 2 * b + 1)))
        inside = u * u + v * v <= 1
        for s, t in zip(u[inside], v[inside], strict=True):
            moved = means[some]
            for share, column in ((s, 0), (t, 1)):
                axis = order[some, column]
                reach = PROXY.patch_reach * splats.scales[some, axis].astype(np.float64)
                moved = moved + share * reach[:, None] * axes[some, :, axis]
            points.append(moved)
            owners.append(some)
    return np.concatenate(points), np.concatenate(owners)


def _solid(filled: np.ndarray) -> np.ndarray:
    """What is filled or cannot be reached from outside, gaps of a voxel closed."""
    wide = filled.copy()
    for axis in range(3):
        wide |= np.roll(filled, 1, axis) | np.roll(filled, -1, axis)
    outside = np.zeros_like(filled)
    outside[0] = outside[-1] = outside[:, 0] = outside[:, -1] = outside[:, :, 0] = outside[:, :, -1] = True
    free = ~wide
    outside &= free
    before = -1
    while (now := int(outside.sum())) != before:
        before = now
        for axis in range(3):  # sweeps forth and back along each axis
            ahead, open_ahead = np.moveaxis(outside, axis, 0), np.moveaxis(free, axis, 0)
            for k in range(1, len(ahead)):
                ahead[k] |= ahead[k - 1] & open_ahead[k]
            for k in range(len(ahead) - 2, -1, -1):
                ahead[k] |= ahead[k + 1] & open_ahead[k]
    grown = outside.copy()  # back by the voxel that closed the gaps
    for axis in range(3):
        grown |= np.roll(outside, 1, axis) | np.roll(outside, -1, axis)
    return ~grown | filled


def _blurred(values: np.ndarray) -> np.ndarray:
    """1 2 1 along each axis; the borders are empty."""
    for axis in range(3):
        values = 0.5 * values + 0.25 * (np.roll(values, 1, axis) + np.roll(values, -1, axis))
    return values


def _marching_tetrahedra(density: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """([V, 3] float64 vertices in units of voxels, [T, 3] int64 triangles), counter-clockwise seen from where density
    is less."""
    shape = np.array(density.shape)
    inside = density > level
    corners = [inside[tuple(slice(c, n - 1 + c) for c, n in zip(corner, shape, strict=True))] for corner in CORNERS]
    some, every = np.logical_or.reduce(corners), np.logical_and.reduce(corners)
    cubes = np.argwhere(some & ~every)
    nodes = np.asarray(np.ravel_multi_index((cubes[:, None] + CORNERS).transpose(2, 0, 1), shape))  # [Q, 8]
    values = density.reshape(-1)
    first, second = [], []
    for tetrahedron in TETRAHEDRA:
        corner = nodes[:, tetrahedron]
        bits = (inside.reshape(-1)[corner] * np.array([1, 2, 4, 8])).sum(1)
        for case, triangles in CASES.items():
            for pattern, flip in ((case, False), (15 - case, True)):
                rows = corner[bits == pattern]
                for triangle in triangles:
                    edges = triangle[::-1] if flip else triangle
                    first.append(np.stack([rows[:, a] for a, _ in edges], 1))
                    second.append(np.stack([rows[:, b] for _, b in edges], 1))
    one, other = np.concatenate(first), np.concatenate(second)
    low, high = np.minimum(one, other).ravel(), np.maximum(one, other).ravel()
    keys, triangles = np.unique(low * values.size + high, return_inverse=True)
    low, high = keys // values.size, keys % values.size
    share = ((level - values[low]) / (values[high] - values[low]))[:, None]
    share = np.clip(share, 0.02, 0.98)  # no two vertices at one corner
    start, end = (np.stack(np.unravel_index(ids, shape), 1).astype(np.float64) for ids in (low, high))
    return start + share * (end - start), triangles.reshape(-1, 3).astype(np.int64)
