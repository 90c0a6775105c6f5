"""What light is like before an asset is looked at: it comes from above more than from below, and from one side more
than from all. A Gaussian over SH coefficients that knows no azimuth, and what an estimate from colours leaves of it
(Bayes; one variance for all coefficients, as the errors of such estimates are).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, UpAxis
from splatpainter.kernels import portable
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import sh_rotations


@dataclass(frozen=True)
class SkyStatistics:
    """Coefficients of bands 1 and 2 of luminance over that of band 0, z up: 40 photographed environments, all turns
    about the vertical. By |m|, as nothing else is left without an azimuth."""

    mean: tuple[float, float] = (0.42, -0.08)
    """Of z (band 1) and of 2 zz - xx - yy (band 2)."""
    band_1: tuple[float, float] = (0.25, 0.39)
    """Standard deviations for |m| = 0 and 1."""
    band_2: tuple[float, float, float] = (0.41, 0.27, 0.33)
    """Standard deviations for |m| = 0, 1 and 2."""
    correlation: float = 0.65
    """Between the bands, of equal m: a lamp is in both."""
    auto_ups: tuple[tuple[UpAxis, float], ...] = ((AUTO_UP, 0.6), ("+y", 0.2), ("+z", 0.2))
    """Chances of ways up where nobody says which: that of captures, of meshes, of scans."""


SKIES_SEEN = SkyStatistics()


def likely_light(estimate: np.ndarray, variance: float, up: UpAxis) -> tuple[np.ndarray, np.ndarray, float]:
    """([8] coefficients of bands 1 and 2 of luminance over that of band 0 in the mean of what is likely, [8, 8] their
    covariance, 0..1 how much of the estimate is left in them). estimate: [8] from an asset's colours alone; variance:
    of each of its coefficients. "auto": the ways up that are usual, each as far as the estimate speaks for it."""
    means, spreads, belief = [], [], 0.0
    ways = likely_ways(estimate, variance, up)
    for way, _ in ways:
        mean, spread, weighed = _weighed(estimate, variance, way)
        means.append(mean + portable.matmul(spread, weighed[:, :1])[:, 0])
        spreads.append(spread - portable.matmul(spread, weighed[:, 1:]))
        belief = float(np.diag(weighed[:, 1:]).mean())
    shares = np.array([share for _, share in ways])
    mean = (shares[:, None] * np.stack(means)).sum(0)
    covariance = np.zeros((8, 8))
    for share, center, spread in zip(shares, means, spreads, strict=True):
        covariance += share * (spread + np.outer(center - mean, center - mean))
    return mean, covariance, belief


def likely_ways(estimate: np.ndarray, variance: float, up: UpAxis) -> list[tuple[np.ndarray, float]]:
    """([3] unit way up, its chance) for each that is possible; arguments as of `likely_light`."""
    ways: Sequence[tuple[UpAxis, float]] = SKIES_SEEN.auto_ups if up == "auto" else ((up, 1.0),)
    axes, chances = [np.array(UPS[way], np.float64) for way, _ in ways], []
    for (_, chance), axis in zip(ways, axes, strict=True):
        mean, _, weighed = _weighed(estimate, variance, axis)
        # Turns change no determinant, so that distances alone tell how likely a way is.
        distance = float(((estimate - mean) * weighed[:, 0]).sum())
        chances.append(chance * float(portable.exp(-0.5 * distance)) + 1e-12)
    total = sum(chances)
    return [(axis, chance / total) for axis, chance in zip(axes, chances, strict=True)]


def _weighed(estimate: np.ndarray, variance: float, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """([8] mean and [8, 8] covariance of usual light, [8, 9] the inverse of all doubt times what the estimate is off
    the mean, and times the covariance: Kalman's gain, as both covariances are known)."""
    mean, spread = _from_above(up)
    off = (estimate - mean)[:, None]
    return mean, spread, portable.solved(spread + variance * np.eye(8), np.concatenate([off, spread], 1))


def _from_above(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([8] mean, [8, 8] covariance) in axes in which unit `up` [3] is the way up."""
    mean, covariance = usual_light(SKIES_SEEN)
    _, turn = upright(up)
    return portable.matmul(turn, mean[:, None])[:, 0], portable.matmul(portable.matmul(turn, covariance), turn.T)


def usual_light(table: SkyStatistics) -> tuple[np.ndarray, np.ndarray]:
    """([8] mean, [8, 8] covariance) with z up."""
    mean, deviation = np.zeros(8), np.empty(8)
    mean[[1, 5]] = table.mean
    orders = np.array([1, 0, 1, 2, 1, 0, 1, 2])  # |m| of coefficients
    deviation[:3], deviation[3:] = np.array(table.band_1)[orders[:3]], np.array(table.band_2)[orders[3:]]
    alike = np.eye(8)
    for low, high in ((0, 4), (1, 5), (2, 6)):
        alike[low, high] = alike[high, low] = table.correlation
    return mean, alike * deviation * deviation[:, None]


def upright(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([3, 3] axes whose last column is unit `up` [3], [8, 8] that turns coefficients of bands 1 and 2 from them)."""
    # Any frame with its z along up will do: what is told in it knows no azimuth.
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side = side / portable.length(side)
    axes = np.stack([side, np.cross(up, side), up], 1)
    turn = np.zeros((8, 8))
    turn[:3, :3], turn[3:, 3:] = sh_rotations(axes, 2)[1:]
    return axes, turn
