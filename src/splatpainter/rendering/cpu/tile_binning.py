"""Depth order, and which Gaussians each tile draws, front to back. Stable, so equal for any number of threads.

Also of views that are there: some of their tiles and entries, and two of them as one.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.simd import kernel, prefetch
from splatpainter.rendering.cpu import geometry as geo
from splatpainter.rendering.cpu.geometry import (
    COLUMNS,
    CONIC_A,
    CONIC_B,
    EXTENT_X,
    EXTENT_Y,
    MEAN_X,
    MEAN_Y,
    SQUARED_RADIUS,
    TILE,
)
from splatpainter.rendering.cpu.projection import GAUSSIANS_PER_BLOCK

PREFETCH_ENTRIES = 8
"""What is read is asked for this many entries before it is used."""


@kernel
def sort_depths(keys, counts, order, spare, value, value2):
    """Slots of all Gaussians by increasing z (float32, positive, so their bits sort alike), ties by slot: a stable
    radix sort of 11 + 11 + 10 bits. Returns True when the result lies in `spare` rather than in `order`."""
    bits = keys.view(np.uint32)
    m = 0
    for block in range(counts.shape[0]):
        for slot in range(block * GAUSSIANS_PER_BLOCK, block * GAUSSIANS_PER_BLOCK + counts[block]):
            order[m] = slot
            value[m] = bits[slot]
            m += 1
    mask = np.uint32(2047)
    histogram = np.zeros((3, 2048), np.int64)
    for i in range(m):
        v = value[i]
        histogram[0, v & mask] += 1
        histogram[1, (v >> np.uint32(11)) & mask] += 1
        histogram[2, v >> np.uint32(22)] += 1
    swapped = False
    for digit in range(3):
        start = 0
        constant = False
        for b in range(2048):
            count = histogram[digit, b]
            constant |= count == m
            histogram[digit, b] = start
            start += count
        if constant:
            continue
        shift = np.uint32(11 * digit)
        for i in range(m):
            v = value[i]
            d = (v >> shift) & mask
            to = histogram[digit, d]
            histogram[digit, d] = to + 1
            value2[to] = v
            spare[to] = order[i]
        value, value2 = value2, value
        order, spare = spare, order
        swapped = not swapped
    return swapped


def depth_order(keys: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """[M] int32 slots of what the blocks wrote, front to back, ties in the order of the Gaussians."""
    total = int(counts.sum())
    if keys.dtype == np.float32:
        order, spare = np.empty((2, total), np.int32)
        value, value2 = np.empty((2, total), np.uint32)
        return spare if sort_depths(keys, counts, order, spare, value, value2) else order
    slots = np.concatenate(
        [np.arange(c) + b * GAUSSIANS_PER_BLOCK for b, c in enumerate(counts)] or [np.empty(0, np.int64)]
    )
    return slots[np.argsort(keys[slots], kind="stable")].astype(np.int32)


@kernel
def gather_sorted(order, unsorted, ids, tile_counts, projected, gaussian_ids, max_tiles, thread, threads):
    """Everything in depth order, so that all that follows walks memory forwards."""
    m = order.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        prefetch(unsorted, order[min(i + PREFETCH_ENTRIES, m - 1)])
        slot = order[i]
        for c in range(COLUMNS):
            projected[i, c] = unsorted[slot, c]
        gaussian_ids[i] = ids[slot]
        max_tiles[i] = tile_counts[slot]


@kernel
def list_pairs(projected, begins, max_tiles, grid, tile_slots, ends, pair_tiles, histogram, thread, threads):
    """pair_tiles[begins[i] : ends[i]] = tiles (indices among those in use) of entry i, and how many entries of each
    share [shares, T] of the list touch each tile. max_tiles[i] >= ends[i] - begins[i], by project_gaussians."""
    F = projected.dtype.type
    m = projected.shape[0]
    shares = histogram.shape[0]
    width = grid[1] - grid[0]
    for share in range(thread, shares, threads):
        for i in range(m * share // shares, m * (share + 1) // shares):
            mx = projected[i, MEAN_X]
            my = projected[i, MEAN_Y]
            a = projected[i, CONIC_A]
            b = projected[i, CONIC_B]
            ey = projected[i, EXTENT_Y]
            ex = projected[i, EXTENT_X]
            q = projected[i, SQUARED_RADIUS]
            at = begins[i]
            full = at + max_tiles[i]
            ty0, ty1 = geo.tile_span(my, ey, grid[2], grid[3])
            tx0, tx1 = geo.tile_span(mx, ex, grid[0], grid[1])
            for ty in range(ty0, ty1):
                begin, end = geo.tile_columns(mx, my, a, b, q, ex, ey, F(ty) * F(TILE), tx0, tx1)
                for tx in range(begin, end):
                    tile = ty * width + tx if tile_slots.shape[0] == 0 else tile_slots[ty, tx]
                    if tile >= 0 and at < full:  # a slip in the count may cost a tile, but never memory
                        pair_tiles[at] = tile
                        at += 1
                        histogram[share, tile] += 1
            ends[i] = at


@kernel
def mark_tiles(projected, selected, grid, hit, thread, threads):
    """Set hit [shares, T] where a tile of the grid (all that it spans) is touched by an entry that is selected
    ([M] bool)."""
    F = projected.dtype.type
    m = projected.shape[0]
    shares = hit.shape[0]
    width = grid[1] - grid[0]
    for share in range(thread, shares, threads):
        for i in range(m * share // shares, m * (share + 1) // shares):
            if not selected[i]:
                continue
            mx = projected[i, MEAN_X]
            my = projected[i, MEAN_Y]
            ey = projected[i, EXTENT_Y]
            ex = projected[i, EXTENT_X]
            ty0, ty1 = geo.tile_span(my, ey, grid[2], grid[3])
            tx0, tx1 = geo.tile_span(mx, ex, grid[0], grid[1])
            for ty in range(ty0, ty1):
                begin, end = geo.tile_columns(
                    mx,
                    my,
                    projected[i, CONIC_A],
                    projected[i, CONIC_B],
                    projected[i, SQUARED_RADIUS],
                    ex,
                    ey,
                    F(ty) * F(TILE),
                    tx0,
                    tx1,
                )
                for tx in range(begin, end):
                    hit[share, ty * width + tx] = True


@kernel
def place_pairs(begins, ends, pair_tiles, pair_offsets, first, flatten_ids, pair_ids, thread, threads):
    """Counting sort of the pairs by tile: flatten_ids[p] = entry, pair_ids[p] = the pair's number in order of entries.
    first [shares, T]: where each share of each tile begins."""
    m = begins.shape[0]
    shares = first.shape[0]
    for share in range(thread, shares, threads):
        for i in range(m * share // shares, m * (share + 1) // shares):
            for k in range(ends[i] - begins[i]):
                tile = pair_tiles[begins[i] + k]
                p = first[share, tile]
                first[share, tile] = p + 1
                flatten_ids[p] = i
                pair_ids[p] = pair_offsets[i] + k


@kernel
def count_pairs(flatten_ids, isect_offsets, used, selected, per_entry, per_tile):
    """Pairs in the tiles in use ([T] bool) of selected entries ([M] bool, or [0]: all): added to per_entry [M], which
    begins as zeros, and per_tile [T]."""
    for k in range(used.shape[0]):
        per_tile[k] = 0
        if used[k]:
            for p in range(isect_offsets[k], isect_offsets[k + 1]):
                i = flatten_ids[p]
                if selected.shape[0] == 0 or selected[i]:
                    per_entry[i] += 1
                    per_tile[k] += 1


@kernel
def take_pairs(flatten_ids, isect_offsets, used, selected, new_entry, at, to, pairs):
    """These pairs, tile after tile: their entries' new numbers [M] into `to`, their own into `pairs`. at [M]: where the
    pairs of each entry begin; pairs of one entry are in the order of their tiles."""
    q = 0
    for k in range(used.shape[0]):
        if used[k]:
            for p in range(isect_offsets[k], isect_offsets[k + 1]):
                i = flatten_ids[p]
                if selected.shape[0] == 0 or selected[i]:
                    to[q] = new_entry[i]
                    pairs[q] = at[i]
                    at[i] += 1
                    q += 1


@kernel
def take_entries(at, projected, gaussian_ids, new_projected, new_ids, thread, threads):
    """Entries `at` [M']."""
    m = at.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        for c in range(COLUMNS):
            new_projected[i, c] = projected[at[i], c]
        new_ids[i] = gaussian_ids[at[i]]


@kernel
def merge_entries(depths, ids, offsets, depths2, ids2, offsets2, entry, entry2, new_offsets):
    """Numbers of the entries of two views in the depth order of both, ties by id, and where their pairs begin."""
    m, m2 = ids.shape[0], ids2.shape[0]
    a = 0
    b = 0
    pairs = 0
    for k in range(m + m2):
        new_offsets[k] = pairs
        first = b == m2
        if a < m and b < m2:
            first = depths[a] < depths2[b] or (depths[a] == depths2[b] and ids[a] < ids2[b])
        if first:
            entry[a] = k
            pairs += offsets[a + 1] - offsets[a]
            a += 1
        else:
            entry2[b] = k
            pairs += offsets2[b + 1] - offsets2[b]
            b += 1
    new_offsets[m + m2] = pairs


@kernel
def put_entries(at, entry, projected, gaussian_ids, new_projected, new_ids, thread, threads):
    """Entries `at` [M'] of a view at their new numbers."""
    m = at.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        for c in range(COLUMNS):
            new_projected[entry[i], c] = projected[at[i], c]
        new_ids[entry[i]] = gaussian_ids[at[i]]


@kernel
def merge_pairs(
    flatten_ids, pair_ids, isect_offsets, pair_offsets, entry,
    flatten_ids2, pair_ids2, isect_offsets2, pair_offsets2, entry2,
    new_offsets, to, pairs, thread, threads,
):  # fmt: skip
    """The pairs of each tile of two views with the same tiles, front to back."""
    for k in range(thread, isect_offsets.shape[0] - 1, threads):
        p, end = isect_offsets[k], isect_offsets[k + 1]
        p2, end2 = isect_offsets2[k], isect_offsets2[k + 1]
        for q in range(p + p2, end + end2):
            if p2 == end2 or (p < end and entry[flatten_ids[p]] < entry2[flatten_ids2[p2]]):
                i = flatten_ids[p]
                to[q] = entry[i]
                pairs[q] = new_offsets[entry[i]] + (pair_ids[p] - pair_offsets[i])
                p += 1
            else:
                i = flatten_ids2[p2]
                to[q] = entry2[i]
                pairs[q] = new_offsets[entry2[i]] + (pair_ids2[p2] - pair_offsets2[i])
                p2 += 1
