"""How sure a mean is: the percentile bootstrap (Efron 1979). Knows no pictures."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np

BOOTSTRAP_ROUNDS, CONFIDENCE_LEVEL = 2000, 0.95


def interval(
    values: Sequence[float] | np.ndarray, clusters: Sequence[Hashable] | np.ndarray | None = None, seed: int = 0
) -> tuple[float, float] | None:
    """(low, high) of the mean of values [n], which may be infinite: the middle CONFIDENCE_LEVEL of BOOTSTRAP_ROUNDS
    bootstrap means.

    clusters: n names; whole clusters are drawn with replacement, since values of one cluster depend on each other
    (None: every value is its own). Too narrow for a handful of clusters. None with fewer than two. Equal input, equal
    answer.
    """
    values = np.asarray(values, np.float64)
    # Sums and counts by cluster are all that a draw needs, so that a round costs one look-up for each cluster.
    groups = np.arange(len(values)) if clusters is None else np.unique(np.asarray(clusters), return_inverse=True)[1]
    count = int(groups.max()) + 1 if len(values) else 0
    if count < 2:
        return None
    sums, counts = np.bincount(groups, values), np.bincount(groups)
    drawn = np.random.default_rng(seed).integers(count, size=(BOOTSTRAP_ROUNDS, count))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    # no interpolation between order statistics: infinite values would give NaN
    low, high = np.quantile(means, [(1 - CONFIDENCE_LEVEL) / 2, (1 + CONFIDENCE_LEVEL) / 2], method="inverted_cdf")
    return float(low), float(high)
