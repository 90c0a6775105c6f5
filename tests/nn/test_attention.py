"""Packed attention is what masked attention over all tokens gives, for any lengths and any layout of the batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from splatpainter.nn import attention
from splatpainter.nn.attention import CrossGroups, Groups, packed_attention

HEADS, WIDTH = 3, 8
LENGTHS = [3, 1, 12, 0, 2, 9, 10, 70, 11, 2, 9, 1, 64, 10]
"""Single tokens, an empty group, equal lengths, and lengths that share a bucket with padding (9 and 10, 64 and 70)."""
KEYS = [9, 1, 40, 5, 38, 0, 10, 3, 9, 36, 2, 1, 1, 64]


def tokens(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, HEADS, WIDTH, generator=torch.Generator().manual_seed(seed))


def masked(q: Tensor, k: Tensor, v: Tensor, query_lengths: list[int], key_lengths: list[int]) -> Tensor:
    """All queries against all keys under a block-diagonal mask, written out in float64; zeros where it hides all."""
    group_q = torch.repeat_interleave(torch.arange(len(query_lengths)), torch.tensor(query_lengths, dtype=torch.int64))
    group_k = torch.repeat_interleave(torch.arange(len(key_lengths)), torch.tensor(key_lengths, dtype=torch.int64))
    mask = group_q[:, None] == group_k[None]
    scores = torch.einsum("qhd,khd->hqk", q.double(), k.double()) / WIDTH**0.5
    weights = torch.softmax(scores.masked_fill(~mask, -1e30), -1) * mask
    return torch.einsum("hqk,khd->qhd", weights, v.double())


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 70), max_size=12), st.integers(0, 5))
def test_self_attention_equals_masked_attention(lengths: list[int], seed: int) -> None:
    q, k, v = (tokens(sum(lengths), seed + i) for i in range(3))
    expected = masked(q, k, v, lengths, lengths).float()
    torch.testing.assert_close(packed_attention(q, k, v, Groups.of(lengths)), expected, atol=1e-5, rtol=0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=12), st.integers(0, 5))
def test_cross_attention_equals_masked_attention(pairs: list[tuple[int, int]], seed: int) -> None:
    lq, lk = [a for a, _ in pairs], [b for _, b in pairs]
    q, k, v = tokens(sum(lq), seed), tokens(sum(lk), seed + 1), tokens(sum(lk), seed + 2)
    expected = masked(q, k, v, lq, lk).float()
    torch.testing.assert_close(packed_attention(q, k, v, CrossGroups.of(lq, lk)), expected, atol=1e-5, rtol=0)


def test_gradients_equal_those_of_masked_attention() -> None:
    q, k, v = (tokens(sum(lengths), i).requires_grad_() for i, lengths in enumerate((LENGTHS, KEYS, KEYS)))
    cotangent = tokens(sum(LENGTHS), 7)
    ours = torch.autograd.grad(packed_attention(q, k, v, CrossGroups.of(LENGTHS, KEYS)), (q, k, v), cotangent)
    theirs = torch.autograd.grad(masked(q, k, v, LENGTHS, KEYS), (q, k, v), cotangent.double())
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=0)


def test_a_group_without_keys_gives_zeros() -> None:
    q, k = tokens(5), tokens(3, 1)
    out = packed_attention(q, k, k, CrossGroups.of([2, 2, 0, 1], [0, 2, 1, 0]))
    assert torch.equal(out[[0, 1, 4]], torch.zeros(3, HEADS, WIDTH)) and (out[2:4] != 0).all()
    assert torch.equal(packed_attention(q, k[:0], k[:0], CrossGroups.of([5], [0])), torch.zeros_like(q))
    assert packed_attention(q[:0], k, k, CrossGroups.of([0], [3])).shape == (0, HEADS, WIDTH)


def test_nothing_leaks_out_of_a_group() -> None:
    """Not even NaN, which a mask alone would not stop (0 * NaN)."""
    q = tokens(sum(LENGTHS))
    groups = Groups.of(LENGTHS)
    clean = packed_attention(q, q, q, groups)
    start = sum(LENGTHS[:5])
    ill = slice(start, start + LENGTHS[5])
    q[ill] = torch.nan
    out = packed_attention(q, q, q, groups)
    assert out[ill].isnan().all()
    out[ill] = clean[ill]
    assert torch.equal(out, clean)


def test_permuting_groups_permutes_the_result() -> None:
    parts = tokens(sum(LENGTHS)).split(LENGTHS)
    joined = torch.cat(parts)
    straight = packed_attention(joined, joined, joined, Groups.of(LENGTHS)).split(LENGTHS)
    order = np.random.default_rng(0).permutation(len(LENGTHS))
    mixed = torch.cat([parts[i] for i in order])
    out = packed_attention(mixed, mixed, mixed, Groups.of([LENGTHS[i] for i in order]))
    torch.testing.assert_close(out, torch.cat([straight[i] for i in order]), atol=1e-6, rtol=0)


def test_the_size_of_a_batch_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    q, k = tokens(sum(LENGTHS)), tokens(sum(KEYS), 1)
    complete = packed_attention(q, k, k, CrossGroups.of(LENGTHS, KEYS))
    monkeypatch.setattr(attention, "BATCH", 10)
    small = CrossGroups.of(LENGTHS, KEYS)
    assert max(bucket.size[0] for bucket in small.buckets) <= 10
    torch.testing.assert_close(packed_attention(q, k, k, small), complete, atol=1e-6, rtol=0)


def test_padding_stays_within_its_promise() -> None:
    lengths = np.random.default_rng(1).permutation(np.repeat(np.arange(400), 2))
    groups = Groups.of(lengths)
    seen = torch.zeros(groups.queries.total, dtype=torch.int64)
    for bucket in groups.buckets:
        count, width, _ = bucket.size
        shortest = width if bucket.mask is None else int(bucket.mask.sum(-1).min())
        assert width <= attention.MAX_PADDING_RATIO * shortest
        assert isinstance(bucket.queries, Tensor) and len(bucket.queries) == count * width
        rows = bucket.queries if bucket.mask is None else bucket.queries[bucket.mask.flatten()]
        seen[rows] += 1
    assert (seen == 1).all()
    assert len(groups.buckets) < 60


def test_queries_are_padded_no_more_than_keys() -> None:
    rng = np.random.default_rng(2)
    lq, lk = rng.integers(1, 60, 300), rng.integers(1, 60, 300)
    groups = CrossGroups.of(lq, lk)
    owner = torch.repeat_interleave(torch.arange(300), torch.from_numpy(lq))
    seen = []
    for bucket in groups.buckets:
        count, wide_q, wide_k = bucket.size
        first = torch.arange(groups.queries.total)[bucket.queries].view(count, wide_q)[:, 0]
        members = owner[first].numpy()
        assert (
            wide_q <= attention.MAX_PADDING_RATIO * lq[members].min()
            and wide_k <= attention.MAX_PADDING_RATIO * lk[members].min()
        )
        seen += members.tolist()
    assert sorted(seen) == list(range(300))


def test_groups_in_order_of_length_are_views_not_copies() -> None:
    groups = Groups.of([1, 1, 2, 2, 2, 7, 7])
    assert groups.result_index is None and all(isinstance(bucket.queries, slice) for bucket in groups.buckets)


def test_half_precision_follows_single_precision() -> None:
    q, k = tokens(sum(LENGTHS)), tokens(sum(KEYS), 1)
    groups = CrossGroups.of(LENGTHS, KEYS)
    half = packed_attention(q.bfloat16(), k.bfloat16(), k.bfloat16(), groups)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), packed_attention(q, k, k, groups), atol=0.05, rtol=0)


@pytest.mark.parametrize(
    "lengths", [[1, -1], [0.5], [[1, 2]], [1 << 31]], ids=["negative", "fraction", "two dimensions", "too many"]
)
def test_impossible_lengths_are_refused_in_one_line(lengths: list[int]) -> None:
    with pytest.raises(ValueError, match=r"^groups: expected [^\n]*$"):
        Groups.of(lengths)


def test_as_many_key_as_query_groups_are_wanted() -> None:
    with pytest.raises(ValueError, match="got 2 and 1"):
        CrossGroups.of([1, 2], [3])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_cuda_follows_the_cpu(dtype: torch.dtype) -> None:
    wide = 64  # a head width that the flash kernels take
    q, k, v = (torch.randn(sum(n), HEADS, wide, dtype=dtype) for n in (LENGTHS, KEYS, KEYS))
    expected = packed_attention(q, k, v, CrossGroups.of(LENGTHS, KEYS))
    out = packed_attention(q.cuda(), k.cuda(), v.cuda(), CrossGroups.of(LENGTHS, KEYS, "cuda")).cpu()
    torch.testing.assert_close(out, expected, atol=0.02 if dtype == torch.bfloat16 else 1e-5, rtol=0)
