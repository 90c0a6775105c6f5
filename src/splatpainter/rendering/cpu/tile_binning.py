"""Depth order, and which rows each tile draws, front to back. Stable, so equal for any number of threads."""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.simd import TILE, kernel, prefetch
from splatpainter.rendering.cpu import geometry as geo
from splatpainter.rendering.cpu.projection import BLOCK

AHEAD = 8
"""Records are asked for this many entries before they are used."""


@kernel
def sort_depths(keys, counts, order, spare, value, value2):
    """Slots of all records by increasing z (float32, positive, so their bits sort alike), ties by slot: a stable radix
    sort of 11 + 11 + 10 bits. Returns True when the result lies in `spare` rather than in `order`."""
    bits = keys.view(np.uint32)
    m = 0
    for block in range(counts.shape[0]):
        for slot in range(block * BLOCK, block * BLOCK + counts[block]):
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
    """[M] int32 slots of the records that blocks wrote, front to back, ties in row order."""
    total = int(counts.sum())
    if keys.dtype == np.float32:
        order, spare = np.empty((2, total), np.int32)
        value, value2 = np.empty((2, total), np.uint32)
        return spare if sort_depths(keys, counts, order, spare, value, value2) else order
    slots = np.concatenate([np.arange(c) + b * BLOCK for b, c in enumerate(counts)] or [np.empty(0, np.int64)])
    return slots[np.argsort(keys[slots], kind="stable")].astype(np.int32)


@kernel
def gather_records(order, records, rows, room, records_out, rows_out, room_out, thread, threads):
    """Everything in depth order, so that all that follows walks memory forwards."""
    m = order.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        prefetch(records, order[min(i + AHEAD, m - 1)])
        slot = order[i]
        for c in range(16):
            records_out[i, c] = records[slot, c]
        rows_out[i] = rows[slot]
        room_out[i] = room[slot]


@kernel
def list_pairs(records, begins, room, grid, slots, ends, spots, histogram, thread, threads):
    """spots[begins[i] : ends[i]] = tiles (indices among those in use) of record i, and how many records of each share
    [shares, T] of the list touch each tile. room[i] >= ends[i] - begins[i], by project_rows."""
    F = records.dtype.type
    m = records.shape[0]
    shares = histogram.shape[0]
    width = grid[1] - grid[0]
    for share in range(thread, shares, threads):
        for i in range(m * share // shares, m * (share + 1) // shares):
            mx = records[i, 0]
            my = records[i, 1]
            a = records[i, 2]
            b = records[i, 3]
            ye = records[i, 10]
            xe = records[i, 11]
            q = records[i, 12]
            at = begins[i]
            full = at + room[i]
            ty0, ty1 = geo.tile_span(my, ye, grid[2], grid[3])
            tx0, tx1 = geo.tile_span(mx, xe, grid[0], grid[1])
            for ty in range(ty0, ty1):
                begin, end = geo.tile_columns(mx, my, a, b, q, xe, ye, F(ty) * F(TILE), tx0, tx1)
                for tx in range(begin, end):
                    tile = ty * width + tx if slots.shape[0] == 0 else slots[ty, tx]
                    if tile >= 0 and at < full:  # a slip in the count may cost a tile, but never memory
                        spots[at] = tile
                        at += 1
                        histogram[share, tile] += 1
            ends[i] = at


@kernel
def place_pairs(begins, ends, spots, offsets, first, members, homes, thread, threads):
    """Counting sort of the pairs by tile: members[p] = record, homes[p] = the pair's place in record order.
    first [shares, T]: where each share of each tile begins."""
    m = begins.shape[0]
    shares = first.shape[0]
    for share in range(thread, shares, threads):
        for i in range(m * share // shares, m * (share + 1) // shares):
            for k in range(ends[i] - begins[i]):
                tile = spots[begins[i] + k]
                p = first[share, tile]
                first[share, tile] = p + 1
                members[p] = i
                homes[p] = offsets[i] + k
