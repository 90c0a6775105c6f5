"""Attention strictly inside groups of packed tokens: which token belongs to which group is planned once per forward
pass, and every layer reuses the plan.

Knows no weights. B groups, T packed tokens (group after group), H heads, d head width, L padded length of a bucket.

On CUDA in half precision the groups go to a variable-length flash kernel. Elsewhere groups of equal or similar length
are batched through torch's own attention: keys padded by at most 12 %, the padding masked.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import field
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from splatpainter.system.quick_dataclass import dataclass

MAX_PADDING_RATIO = 1.12
"""A group is padded to at most this multiple of its length."""
BATCH = 1 << 15
"""Query or key tokens per batch on the bucketed path: bounds the copies, and keeps them near the cache."""


@dataclass(frozen=True)
class Packing:
    """How T tokens are split into B groups, one after the other."""

    lengths: Tensor
    """[B] int64 tokens per group, on the host."""
    cu_seqlens: Tensor
    """[B + 1] int32 first token of each group, then T; on the device of the tokens."""
    longest: int
    """Tokens of the longest group."""
    total: int
    """T."""

    @staticmethod
    def of(lengths: Tensor | np.ndarray | Iterable[int], device: torch.device | str = "cpu") -> Packing:
        """Raises ValueError where lengths are not whole numbers >= 0 in one dimension, or are 2^31 tokens or more."""
        host = torch.as_tensor(lengths if isinstance(lengths, Tensor | np.ndarray) else list(lengths)).cpu()
        if host.numel() == 0:
            host = host.to(torch.int64)
        if host.ndim != 1 or host.is_floating_point() or (host.numel() and int(host.min()) < 0):
            raise ValueError(f"groups: expected lengths >= 0 as [B] integers, got {list(host.shape)} {host.dtype}")
        starts = functional.pad(host.to(torch.int64).cumsum(0), (1, 0))
        total = int(starts[-1])
        if total >= 1 << 31:
            raise ValueError(f"groups: expected fewer than 2^31 packed tokens, got {total}; process them in parts")
        longest = int(host.max()) if host.numel() else 0
        return Packing(host.to(torch.int64), starts.to(torch.int32).to(device), longest, total)


@dataclass(frozen=True)
class Bucket:
    """Groups that go through attention as one batch of G."""

    size: tuple[int, int, int]
    """G, padded query length, padded key length."""
    queries: Tensor | slice = field(repr=False)
    """[G * Lq] query tokens (padding repeats a group's last token), or the slice that they are."""
    keys: Tensor | slice = field(repr=False)
    """[G * Lk] likewise."""
    mask: Tensor | None = field(repr=False)
    """[G, 1, 1, Lk] bool, False for padding; None where no key is padding."""


@dataclass(frozen=True)
class _Plan:
    queries: Packing
    keys: Packing
    buckets: tuple[Bucket, ...]
    """Every group that has queries and keys, in exactly one of them."""
    result_index: Tensor | None = field(repr=False)
    """[Tq] int64 where each query's result lies in the buckets' results, one bucket after the other and after all of
    them one row of zeros; None where that is the order of the queries already."""
    blind: Tensor | None = field(repr=False)
    """[Tq] bool: queries whose group has no keys; None where there are none."""


@dataclass(frozen=True)
class Groups(_Plan):
    """Self-attention: the queries and the keys of a group are the same tokens. Made once per forward pass."""

    @staticmethod
    def of(lengths: Tensor | np.ndarray | Iterable[int], device: torch.device | str = "cpu") -> Groups:
        """lengths: [B] tokens per group, 0 allowed. device: where the tokens will be. Raises ValueError as Packing."""
        packing = Packing.of(lengths, device)
        return Groups(packing, packing, *_buckets(packing, packing, torch.device(device)))

    @property
    def lengths(self) -> Tensor:
        """[B] int64, on the host."""
        return self.queries.lengths


@dataclass(frozen=True)
class CrossGroups(_Plan):
    """Cross-attention: group b has query_lengths[b] queries and key_lengths[b] keys. Made once per forward pass."""

    @staticmethod
    def of(
        query_lengths: Tensor | np.ndarray | Iterable[int],
        key_lengths: Tensor | np.ndarray | Iterable[int],
        device: torch.device | str = "cpu",
    ) -> CrossGroups:
        """Both [B], 0 allowed. device: where the tokens will be. Raises ValueError as Packing, or where B differs."""
        queries, keys = Packing.of(query_lengths, device), Packing.of(key_lengths, device)
        if len(queries.lengths) != len(keys.lengths):
            raise ValueError(
                f"groups: expected as many query as key lengths, got {len(queries.lengths)} and {len(keys.lengths)}"
            )
        return CrossGroups(queries, keys, *_buckets(queries, keys, torch.device(device)))


def packed_attention(q: Tensor, k: Tensor, v: Tensor, groups: Groups | CrossGroups) -> Tensor:
    """softmax(q k^T / sqrt(d)) v inside each group and nowhere else.

    q: [Tq, H, d]; k, v: [Tk, H, d]; all float32, or half precision. Returns [Tq, H, d] in q's dtype; zeros for queries
    whose group has no keys. No host synchronisation.
    """
    assert q.shape[0] == groups.queries.total and k.shape == v.shape and k.shape[0] == groups.keys.total, (
        f"packed_attention: {tuple(q.shape)}, {tuple(k.shape)}, {tuple(v.shape)} do not fit the groups"
    )
    if q.shape[0] == 0 or k.shape[0] == 0:
        return torch.zeros_like(q)
    # Chosen at every call: the type of the queries, which decides, is not known when groups are planned.
    kernel = _varlen_kernel() if _fits_varlen(q) else None
    if kernel is None:
        return _bucketed(q, k, v, groups)
    a, b = groups.queries, groups.keys
    mixed = kernel(q.contiguous(), k.contiguous(), v.contiguous(), a.cu_seqlens, b.cu_seqlens, a.longest, b.longest)
    # What a kernel leaves for a group without keys is not specified.
    return mixed if groups.blind is None else mixed.masked_fill(groups.blind[:, None, None], 0)


def _bucketed(q: Tensor, k: Tensor, v: Tensor, groups: Groups | CrossGroups) -> Tensor:
    results = []
    for bucket in groups.buckets:
        count, lq, lk = bucket.size
        if lk == 1:  # the softmax over one key is 1
            alone = v[bucket.keys][:, None].expand(-1, lq, -1, -1)
            results.append(alone.reshape(count * lq, *v.shape[1:]))
            continue
        wide = q[bucket.queries].unflatten(0, (count, lq)).transpose(1, 2)  # [G, H, Lq, d]
        rows = (x[bucket.keys].unflatten(0, (count, lk)).transpose(1, 2) for x in (k, v))
        mixed = functional.scaled_dot_product_attention(wide, *rows, attn_mask=bucket.mask)
        results.append(mixed.transpose(1, 2).flatten(0, 1))
    if groups.blind is not None:
        results.append(torch.zeros_like(q[:1]))
    joined = results[0] if len(results) == 1 else torch.cat(results)
    return joined if groups.result_index is None else joined[groups.result_index]


def _fits_varlen(q: Tensor) -> bool:
    """Whether flash kernels take it: half precision, an Ampere card or newer, heads of 8, 16, ... 256."""
    if not q.is_cuda or q.dtype not in (torch.float16, torch.bfloat16) or q.shape[-1] % 8 or q.shape[-1] > 256:
        return False
    return torch.cuda.get_device_capability(q.device) >= (8, 0)


@cache
def _varlen_kernel() -> Any:
    """(q, k, v, cu_q, cu_k, longest_q, longest_k) -> [Tq, H, d] by flash-attn or torch, or None where neither is."""
    try:
        from flash_attn import flash_attn_varlen_func  # pyright: ignore[reportMissingImports]

        return flash_attn_varlen_func
    except ImportError:
        pass
    try:
        from torch.nn.attention.varlen import varlen_attn

        return varlen_attn
    except ImportError:
        return None


def _buckets(queries: Packing, keys: Packing, device: torch.device) -> tuple[Any, Any, Any]:
    """The buckets, `result_index` and `blind` of a plan."""
    lq, lk = queries.lengths.numpy(), keys.lengths.numpy()
    starts_q, starts_k = np.cumsum(lq) - lq, np.cumsum(lk) - lk
    alive = np.flatnonzero((lq > 0) & (lk > 0))
    # Classes do not depend on which other groups there are. Stable: groups of one class keep their order.
    class_q, class_k = _length_class(lq[alive]), _length_class(lk[alive])
    order = np.lexsort((class_q, class_k))
    alive, class_q, class_k = alive[order], class_q[order], class_k[order]
    change = np.flatnonzero((np.diff(class_q) != 0) | (np.diff(class_k) != 0)) + 1
    index = np.full(queries.total, -1, np.int64)
    done, buckets = 0, []
    for first, last in pairwise([0, *change.tolist(), len(alive)]) if len(alive) else ():
        # As wide as the longest of these groups, not as its class: padding is work for nothing.
        widest_q, widest_k = int(lq[alive[first:last]].max()), int(lk[alive[first:last]].max())
        batch = max(BATCH // max(widest_q, widest_k), 1)
        for at in range(first, last, batch):
            members = alive[at : min(at + batch, last)]
            rows_q, valid_q = _padded(starts_q[members], lq[members], widest_q)
            rows_k, valid_k = (
                (rows_q, valid_q) if keys is queries else _padded(starts_k[members], lk[members], widest_k)
            )
            # Padding has no query to give its result to, so only valid places are noted.
            index[rows_q[valid_q]] = done + np.flatnonzero(valid_q)
            mask = None if valid_k.all() else torch.from_numpy(valid_k).view(len(members), 1, 1, -1).to(device)
            size = (len(members), widest_q, widest_k)
            buckets.append(Bucket(size, _index(rows_q, device), _index(rows_k, device), mask))
            done += len(rows_q)
    blind = index < 0
    index[blind] = done
    # Gathering copies every result; where they come out in order already, it is left out.
    straight = not blind.any() and done == queries.total and (np.diff(index) == 1).all()
    return (
        tuple(buckets),
        None if straight else torch.from_numpy(index).to(device),
        torch.from_numpy(blind).to(device) if blind.any() else None,
    )


def _length_class(lengths: np.ndarray) -> np.ndarray:
    """A class per length >= 1; the longest of a class is at most MAX_PADDING_RATIO times the shortest."""
    edges = [1]  # shortest length of each class
    while edges[-1] <= lengths.max(initial=0):
        edges.append(int(edges[-1] * MAX_PADDING_RATIO + 1e-9) + 1)
    return np.searchsorted(edges, lengths, side="right")


def _padded(starts: np.ndarray, lengths: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """([G * width] int64 tokens, [G * width] bool: not padding). Padding repeats the last token, so that it is finite
    wherever the group is."""
    column = np.arange(width)
    rows = starts[:, None] + np.minimum(column, lengths[:, None] - 1)
    return rows.astype(np.int64).ravel(), (column < lengths[:, None]).ravel()


def _index(rows: np.ndarray, device: torch.device) -> Tensor | slice:
    """`rows` as a slice where they follow each other: a view costs nothing, a gather a pass over memory."""
    if (np.diff(rows) == 1).all():
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return torch.from_numpy(rows).to(device)
