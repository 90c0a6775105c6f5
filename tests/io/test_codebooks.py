"""Codebooks and palettes: exact where they can be, near the best that scipy finds where they cannot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2

from splatpainter.io.formats import codebooks


def error(values: np.ndarray, book: np.ndarray) -> float:
    return float(((values - book[codebooks.nearest(book, values)]) ** 2).mean())


def test_few_values_are_exact() -> None:
    values = np.random.default_rng(0).choice(np.random.default_rng(1).normal(size=250), 5000)
    book = codebooks.fit(values)
    assert book.shape == (256,) and error(values, book) == 0
    assert np.array_equal(codebooks.fit(np.full(7, 3.5)), np.full(256, 3.5))


@pytest.mark.parametrize("kind", ["normal", "log-normal", "two far values"])
def test_fit(kind: str) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=6000) if kind != "log-normal" else rng.lognormal(0, 1.5, 6000)
    if kind == "two far values":
        values[:2] = 80, -90
    book = codebooks.fit(values)
    assert (np.diff(book) >= 0).all()
    reference, _ = kmeans2(
        values[:, None], np.quantile(values, (np.arange(256) + 0.5) / 256)[:, None], 60, minit="matrix"
    )
    assert error(values, book) < 1.02 * error(values, reference[:, 0])
    if kind == "two far values":
        assert np.abs(book - 80).min() < 1e-5 and np.abs(book + 90).min() < 1e-5


def test_nearest() -> None:
    rng = np.random.default_rng(0)
    book, values = rng.normal(size=256), rng.normal(size=(500, 3)) * 2
    nearest_ids = codebooks.nearest(book, values)
    assert nearest_ids.dtype == np.uint8
    assert np.array_equal(np.abs(book[nearest_ids] - values), np.abs(book - values[..., None]).min(-1))


def test_extend() -> None:
    """Used entries stay; every value gets an entry near enough; with too few free entries there is no answer."""
    rng = np.random.default_rng(0)
    book, used = np.sort(rng.normal(size=256)), np.ones(256, bool)
    values = np.array([9.0, 9.01, 9.05, -7.0, book[20] + 0.001])
    used[[3, 4]] = False
    wider = codebooks.extend(book, used, values, 0.03)
    assert wider is not None and np.array_equal(wider[used], book[used])
    assert np.abs(wider[codebooks.nearest(wider, values)] - values).max() <= 0.03
    used[4] = True
    assert codebooks.extend(book, used, values, 0.03) is None
    assert codebooks.extend(book, np.ones(256, bool), book[:9] + 1e-3, 0.03) is not None


def test_make_room() -> None:
    """Merging takes rarely used entries close to another one, and as many as are missing."""
    book, counts = np.arange(256) / 10, np.full(256, 1000)
    book[50] = book[51] - 0.001
    counts[[50, 200]] = 3
    values = np.array([40.0, 50.0])
    moved = codebooks.make_room(book, counts, values, 0.01)
    assert moved is not None
    gone = np.flatnonzero(moved != np.arange(256))
    assert list(gone) == [50, 200] and moved[50] == 51 and moved[200] in (199, 201)
    wider = codebooks.extend(book, moved == np.arange(256), values, 0.01)
    assert wider is not None and np.abs(wider[:, None] - values).min(0).max() <= 0.01
    assert codebooks.make_room(book, counts, np.arange(200.0) * 5, 0.01) is None


def test_palette() -> None:
    rng = np.random.default_rng(0)
    few = rng.normal(size=(40, 9)).astype(np.float32)
    vectors = few[rng.integers(0, 40, 1000)]
    entries, labels = codebooks.palette(vectors, 40)
    assert len(entries) <= 40 and np.array_equal(entries[labels], vectors)
    vectors = (rng.normal(size=(4000, 24)) * rng.lognormal(-2, 0.7, (4000, 1))).astype(np.float32)
    entries, labels = codebooks.palette(vectors, 1024)
    assert len(entries) <= 1024 and labels.shape == (4000,)
    again = codebooks.palette(vectors, 1024)
    assert np.array_equal(again[0], entries) and np.array_equal(again[1], labels)
    reference, reference_labels = kmeans2(vectors, vectors[rng.permutation(4000)[:1024]], 10, minit="matrix")
    ours, theirs = (((vectors - e[i]) ** 2).mean() for e, i in ((entries, labels), (reference, reference_labels)))
    assert ours < 1.15 * theirs
