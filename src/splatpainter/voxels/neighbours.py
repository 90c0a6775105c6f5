"""Points near to points: the nearest one within a radius, and what hangs together. no tree.

Points are sorted by the cube that they lie in; a query looks into the 27 cubes around it. What lies farther than
MAX_CELLS cubes from the middle of the points counts as lying at that distance: a few strays must not cost anything.
"""

from __future__ import annotations

import itertools

import numpy as np

from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import each, run

CELL_BITS = 20
"""Bits of a cube's index along each axis."""
MAX_CELLS = 1 << (CELL_BITS - 2)
"""Cubes to either side of the median point."""
PAIRS_AT_ONCE = 1 << 17
"""Pairs of points that are judged in one piece: some arrays of 1 MiB."""


def nearest_within(points: np.ndarray, queries: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """([Q] int64 index of the point nearest to each query, -1 where none is within `radius`; [Q] float64 distance, inf
    there). points: [P, 3]; queries: [Q, 3]; of equally near ones the first in memory order of its cube."""
    nearest = np.full(len(queries), -1, np.int64)
    distance = np.full(len(queries), np.inf)
    if len(points) and len(queries) and radius > 0:
        # Cubes are counted from the median: strays share the outermost ones.
        middle = np.median(points, axis=0)
        keys, order = _sorted(_cells(points, middle, radius))
        cells = _cells(queries, middle, radius)
        arrays = (np.ascontiguousarray(points, np.float64), np.ascontiguousarray(queries, np.float64))
        run(kernels.find_nearest, *arrays, keys, order, cells, float(radius), nearest, distance)
    return nearest, distance


def components(points: np.ndarray, size: float) -> np.ndarray:
    """[P] int64: which connected part each point is in, numbered from 0 by their first points. Two points hang together
    where a chain of cubes of `size` that hold points, side by side or corner to corner, leads from one to the other."""
    if not len(points):
        return np.zeros(0, np.int64)
    cells = _cells(points, np.median(points, axis=0), size)
    keys, inverse = np.unique(_keys(cells), return_inverse=True)
    parents = np.arange(len(keys))
    # Half of the neighbours: each pair of cubes is joined once.
    for x in (0, 1):
        for y in (-1, 0, 1) if x else (0, 1):
            for z in (-1, 0, 1) if x or y else (1,):
                step = (x << 2 * CELL_BITS) + (y << CELL_BITS) + z
                at = np.searchsorted(keys, keys + step)
                exists = at < len(keys)
                exists[exists] = keys[at[exists]] == keys[exists] + step
                kernels.join_labels(np.flatnonzero(exists), at[exists], parents, 0, 1)
    kernels.flatten_labels(parents, 0, 1)
    roots = parents[inverse]
    # Numbered by first appearance, so that equal input gives equal labels.
    _, first, labels = np.unique(roots, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[labels]


def near_pairs(points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """([K] int64, [K] int64) all pairs of points ([P, 3]) that are at most `radius` apart, each once."""
    if not len(points):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    keys, order = _sorted(_cells(points, np.median(points, axis=0), radius))
    columns = [np.ascontiguousarray(column) for column in points[order].T]
    # The cubes that hold points, and where each one's begin among the sorted points.
    begins = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    cubes, ends = keys[begins], np.append(begins[1:], len(keys))
    cube = np.repeat(np.arange(len(cubes)), ends - begins)

    def of_step(step: int) -> list[tuple[np.ndarray, np.ndarray]]:
        # Of each point, where the cube one step on begins and ends.
        at = np.searchsorted(cubes, cubes + step)
        there = at < len(cubes)
        there[there] = cubes[at[there]] == cubes[there] + step
        at[~there] = 0
        # In its own cube a point is a pair with those after it.
        first = begins.take(at).take(cube) if step else np.arange(1, len(keys) + 1)
        count = np.where(there.take(cube), ends.take(at).take(cube) - first, 0)
        total = np.append(0, np.cumsum(count))
        # In blocks that stay in the processor's cache: most pairs of cubes' points are too far apart.
        edges = np.unique(np.append(np.searchsorted(total, np.arange(0, total[-1], PAIRS_AT_ONCE)), len(keys)))
        close = []
        for begin, end in itertools.pairwise(edges.tolist()):
            counts = count[begin:end]
            one = np.repeat(np.arange(begin, end), counts)
            two = np.arange(int(total[begin]), int(total[end])) - np.repeat(total[begin:end] - first[begin:end], counts)
            x, y, z = (np.square(column.take(one) - column.take(two)) for column in columns)
            near = np.flatnonzero(x + y + z <= radius**2)
            close.append((order[one.take(near)], order[two.take(near)]))
        return close

    # Half of the neighbours: from a cube with a smaller number the pair was seen before.
    steps = [((x - 1) << 2 * CELL_BITS) + ((y - 1) << CELL_BITS) + z - 1 for x, y, z in np.ndindex(3, 3, 3)]
    close = [pair for of in each(of_step, [step for step in steps if step >= 0]) for pair in of]
    one, two = zip(*close, strict=True) if close else ((), ())
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *one]), np.concatenate([none, *two])


def _cells(points: np.ndarray, middle: np.ndarray, size: float) -> np.ndarray:
    """[P, 3] int64 cubes, the outermost ones left free."""
    with np.errstate(invalid="ignore", over="ignore"):
        cells = np.floor((np.asarray(points, np.float64) - middle) / size)
    return (np.nan_to_num(np.clip(cells, -MAX_CELLS, MAX_CELLS)) + 2 * MAX_CELLS).astype(np.int64)


def _keys(cells: np.ndarray) -> np.ndarray:
    return (cells[:, 0] << 2 * CELL_BITS) | (cells[:, 1] << CELL_BITS) | cells[:, 2]


def _sorted(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    keys = _keys(cells)
    order = np.argsort(keys, kind="stable")
    return keys[order], order


def joined_labels(count: int, one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """[count] int64: labels after one[i] and two[i] were made the same for every i; the smallest of each stays."""
    parents = np.arange(count)
    kernels.join_labels(*(np.ascontiguousarray(a, np.int64) for a in (one, two)), parents, 0, 1)
    kernels.flatten_labels(parents, 0, 1)
    return parents
