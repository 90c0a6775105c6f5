"""Codebooks: few values that stand for many. 256-entry ones for numbers, palettes for vectors. Knows no format.

Both are fitted to values, or adapted: entries in use keep their values, and room is made for new ones.
"""

from __future__ import annotations

import heapq

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.order_statistics import distinct, groups

CODEBOOK_SIZE = 256


def fit(values: np.ndarray, size: int = CODEBOOK_SIZE) -> np.ndarray:
    """[size] sorted values with a small squared error over `values` ([M], finite).

    The group with the largest squared error is split in the best place until there are `size` groups (so that a few far
    values get their own), then Lloyd's iteration. Exact where there are at most `size` values.
    """
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    few = distinct(ordered)
    if len(few) <= size:
        return np.concatenate([few, np.full(size - len(few), few[-1] if len(few) else 0.0)])
    middle = ordered.mean()  # prefix sums of centred values keep their digits
    sums = np.concatenate([[0], np.cumsum(ordered - middle)])
    squares = np.concatenate([[0], np.cumsum((ordered - middle) ** 2)])

    def group(start: int, end: int) -> tuple[float, int, int]:
        """(minus the squared error, start, end): the heap's smallest is the worst group."""
        return ((sums[end] - sums[start]) ** 2 / (end - start) - (squares[end] - squares[start]), start, end)

    heap = [group(0, len(ordered))]
    while len(heap) < size:
        _, start, end = heapq.heappop(heap)
        cuts = np.arange(start + 1, end)
        left, right = sums[cuts] - sums[start], sums[end] - sums[cuts]
        cut = int(cuts[np.argmax(left**2 / (cuts - start) + right**2 / (end - cuts))]) if len(cuts) else end
        if cut == end:
            heapq.heappush(heap, (0.0, start, end))
            break
        heapq.heappush(heap, group(start, cut))
        heapq.heappush(heap, group(cut, end))
    starts, ends = np.array(sorted((start, end) for _, start, end in heap)).T
    centres = middle + (sums[ends] - sums[starts]) / (ends - starts)
    for _ in range(10):
        ends = np.searchsorted(ordered, np.concatenate([(centres[1:] + centres[:-1]) / 2, [np.inf]]))
        starts = np.concatenate([[0], ends[:-1]])
        filled = ends > starts
        centres[filled] = middle + (sums[ends] - sums[starts])[filled] / (ends - starts)[filled]
    # float32 is what other readers keep; rounding here makes our own error figures true for them.
    return np.sort(centres).astype(np.float32).astype(np.float64)


def nearest(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Index (uint8, shape of `values`) of the nearest entry of `codebook` ([<= 256], any order)."""
    order = np.argsort(codebook, kind="stable")
    ordered = codebook[order]
    return order[np.searchsorted((ordered[1:] + ordered[:-1]) / 2, values)].astype(np.uint8)


def extend(codebook: np.ndarray, used: Bools, values: np.ndarray, tolerance: float) -> np.ndarray | None:
    """`codebook` with unused entries moved until every value has one within `tolerance`; None if too few are free.

    used: [256] bool, entries that must keep their value. The entries added are the fewest possible: intervals of width
    2 * tolerance laid over the uncovered values from the left.
    """
    added = _cover(codebook[used], values, tolerance)
    free = np.flatnonzero(~used)
    if len(added) > len(free):
        return None
    out = codebook.copy()
    out[free[: len(added)]] = added
    return out


def make_room(codebook: np.ndarray, counts: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray | None:
    """Where `extend` fails: the least harmful merging of used entries that frees enough of them.

    counts: [256] values that use each entry. Returns [256] the entry that each entry's users move to (itself for most),
    None where more than half of the entries would have to go.
    """
    moved = np.arange(len(codebook))
    counts = counts.astype(np.float64)
    alive = counts > 0
    missing = len(_cover(codebook[alive], values, tolerance)) - int((~alive).sum())
    if missing > len(codebook) // 2:
        return None
    for _ in range(missing):
        order = np.flatnonzero(alive)[np.argsort(codebook[alive], kind="stable")]
        left, right = order[:-1], order[1:]
        cost = np.minimum(counts[left], counts[right]) * (codebook[right] - codebook[left]) ** 2
        pair = int(np.argmin(cost))
        loser, keeper = int(left[pair]), int(right[pair])
        if counts[loser] > counts[keeper]:
            loser, keeper = keeper, loser
        moved[moved == loser] = keeper
        counts[keeper] += counts[loser]
        alive[loser] = False
    return moved


def adapt(
    codebook: np.ndarray, codes: np.ndarray, values: np.ndarray, tolerances: tuple[float, ...]
) -> tuple[np.ndarray | None, np.ndarray]:
    """[256] a codebook with room for `values` within the first of `tolerances` (rising) that unused entries allow, else
    within the last, by merging; and [256] where the users of each entry go. None where it has to be fitted anew.

    codebook: [<= 256]; codes: the entries that unchanged values use.
    """
    codebook = np.concatenate([codebook, np.full(CODEBOOK_SIZE - len(codebook), codebook[-1])])
    counts = np.bincount(codes.reshape(-1), minlength=CODEBOOK_SIZE)
    unmoved = np.arange(CODEBOOK_SIZE)
    for tolerance in tolerances:
        extended = extend(codebook, counts > 0, values, tolerance)
        if extended is not None:
            return extended, unmoved
    moved = make_room(codebook, counts, values, tolerances[-1])
    if moved is None:
        return None, unmoved
    used = (counts > 0) & (moved == unmoved)
    return extend(codebook, used, values, tolerances[-1]), moved


def adapt_palette(
    codes: np.ndarray, codebook: np.ndarray, in_use: Bools, vectors: np.ndarray, tolerances: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """A palette that grew by what `vectors` [M, D] need: its codes, its codebook [256], the entry of each vector [M].

    codes: [P, ...] entries of `codebook` [<= 256] (D in all); in_use: [most entries of a palette] bool, those that keep
    their values. None where too few are free, or where the codebook would have to change for those in use.
    """
    free = np.flatnonzero(~in_use)
    new, labels = palette(vectors, max(len(free), 1))
    if len(free) < min(len(distinct(labels)), 1024):
        return None
    used = np.zeros(CODEBOOK_SIZE, bool)
    used[distinct(codes[in_use[: len(codes)]].reshape(-1))] = True
    padded = np.concatenate([codebook, np.zeros(CODEBOOK_SIZE - len(codebook))])
    extended = next((book for t in tolerances if (book := extend(padded, used, new, t)) is not None), None)
    if extended is None:
        return None
    # Entries beyond the old palette come after free ones within it, so that the palette grows as little as it can.
    entries = free[: len(new)]
    grown = np.zeros((max(len(codes), int(entries.max()) + 1), *codes.shape[1:]), np.uint8)
    grown[: len(codes)] = codes
    grown[entries] = nearest(extended, new).reshape(-1, *codes.shape[1:])
    return grown, extended, entries[labels]


def _cover(entries: np.ndarray, values: np.ndarray, tolerance: float) -> np.ndarray:
    """Fewest new entries so that every value lies within `tolerance` of an old or a new one."""
    uncovered = distinct(values.reshape(-1))
    if len(entries):
        ordered = np.sort(entries)
        at = np.searchsorted((ordered[1:] + ordered[:-1]) / 2, uncovered)
        uncovered = uncovered[np.abs(ordered[at] - uncovered) > tolerance]
    added = []
    while len(uncovered):
        stop = int(np.searchsorted(uncovered, uncovered[0] + 2 * tolerance, side="right"))
        added.append((uncovered[0] + uncovered[stop - 1]) / 2)
        uncovered = uncovered[stop:]
    return np.array(added)


def palette(vectors: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` vectors that stand for `vectors` [M, D] (float32): the palette [P, D], each one's entry [M] int64.

    Exact where there are at most `size` different vectors. Otherwise k-means in two levels (about sqrt(size) groups,
    then within each group its share): M sqrt(size) D operations instead of M size D, and errors a few per cent below
    (real SH vectors) or above (noise) plain k-means. The same input gives the same palette.
    """
    distinct, inverse, counts = _distinct(vectors)
    if len(distinct) <= size:
        return distinct, inverse
    random = np.random.default_rng(0)
    groups = max(int(np.sqrt(size)), 1)
    sample = distinct[np.sort(random.permutation(len(distinct))[: 64 * groups])]
    coarse = _kmeans(sample, sample[np.sort(random.permutation(len(sample))[:groups])], None, 10)
    member = _assign(distinct, coarse)
    shares = np.bincount(member, minlength=groups)
    spread = np.bincount(member, counts * ((distinct - coarse[member]) ** 2).sum(1), groups)
    quota = _quota(shares, spread, size)
    centres, labels = [], np.empty(len(distinct), np.int64)
    order = np.argsort(member, kind="stable")
    start = base = 0
    for share, count in zip(shares, quota, strict=True):
        rows = order[start : start + share]
        start += share
        if not share:
            continue
        group = distinct[rows]
        if count < share:
            fine = _kmeans(
                group, group[:: share // count][:count] if share >= 2 * count else group[:count], counts[rows], 5
            )
            labels[rows] = base + _assign(group, fine)
        else:
            fine = group
            labels[rows] = base + np.arange(share)
        centres.append(fine)
        base += len(fine)
    return np.concatenate(centres), labels[inverse]


def _quota(shares: np.ndarray, spread: np.ndarray, size: int) -> np.ndarray:
    """[G] entries for groups with `shares` members each: in proportion to their squared error, which is about where all
    entries end with equal errors (Zador 1982, many dimensions); at least 1, at most one for each member."""
    quota = np.minimum(shares, 1)
    for _ in range(8):
        capacity, remaining = shares - quota, size - int(quota.sum())
        share = np.where(capacity > 0, spread + spread.mean() * 1e-3, 0)
        if remaining <= 0 or not share.any():
            break
        quota = quota + np.minimum(capacity, np.floor(share / share.sum() * remaining).astype(int))
    return quota


def _distinct(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows = np.ascontiguousarray(vectors, np.float32) + np.float32(0)  # -0.0 and 0.0 are one value
    keys = rows.view(np.dtype((np.void, rows.shape[1] * 4)))[:, 0]
    first, numbers, counts = groups(keys)
    return rows[first], numbers, counts


def _kmeans(points: np.ndarray, centres: np.ndarray, weights: np.ndarray | None, rounds: int) -> np.ndarray:
    """Lloyd's iteration from `centres`; a centre that loses all its points stays where it was."""
    weights = np.ones(len(points)) if weights is None else weights.astype(np.float64)
    for _ in range(rounds):
        labels = _assign(points, centres)
        mass = np.bincount(labels, weights, len(centres))
        order = np.argsort(labels, kind="stable")
        starts = np.searchsorted(labels[order], np.flatnonzero(mass))
        sums = np.add.reduceat(points[order] * weights[order, None], starts, axis=0)
        centres = centres.copy()
        centres[mass > 0] = sums / mass[mass > 0, None]
    return centres


def _assign(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """[M] index of the nearest of `centres` [C, D] (int64), in blocks that keep the distance table below 32 MB."""
    norms = (centres.astype(np.float64) ** 2).sum(1).astype(np.float32)
    block = max((8 << 20) // max(len(centres), 1), 1)
    out = np.empty(len(points), np.int64)
    for at in range(0, len(points), block):
        piece = points[at : at + block]
        out[at : at + block] = (norms - 2 * (piece @ centres.T)).argmin(1)
    return out
