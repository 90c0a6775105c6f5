"""A second reading of the light in an asset's colours, and what both readings together say.

`source_light` asks each patch of one material by itself, and throws away what tells patches apart. Here the logarithm
of albedo is a random field instead (Gaussian, Rasmussen and Williams 2006): alike where places are near, alike all
around at one height and distance from the middle, darker or lighter towards below, and with noise of its own; what
light of degree 2 cannot explain (a small sun, gloss, neighbours) is a field over normals. The light's posterior in
closed form then weighs all differences of colour by what they are worth.

The numbers of the field, and of how much each reading counts, are learnt: `scripts/calibrate/source_light.py` prints
them. They are of 519 assets, some of which were drawn too dark, as grey pictures were taken for normal maps. Fitted
anew to 138 fitted and 140 coarse assets without that fault, they relight 27 held-out pairs, made in lights that were
not learnt from, by 0.00 +- 0.04 dB better (fitted) and 0.03 +- 0.09 dB worse (coarse), so that they stay.

All is told in axes with z up. Turning an asset about the vertical turns the answer, but for what the cells and the box
are in which it is looked at.
"""

from __future__ import annotations

import numpy as np

from splatpainter.color import luminance
from splatpainter.kernels import portable
from splatpainter.lights.light_prior import SkyStatistics, upright, usual_light
from splatpainter.order_statistics import groups, row_keys
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, row_norm

BANDS_BY_ORDER = ((1, 5), ((2, 6), (0, 4)), ((7,), (3,)))
"""Where coefficients of |m| = 0, 1 and 2 stand among the eight of bands 1 and 2; of 1 and 2 there are two sets, which
turns about the vertical mix with each other and with nothing else."""


@dataclass(frozen=True)
class FieldNumbers:
    """Standard deviations are of natural logarithms of albedo, lengths in rms distances of the asset from its
    middle. Learnt by the script named above, but for what says otherwise."""

    level: float = 5.31
    """Of the albedo of all."""
    near: float = 0.304
    """Of what near places share."""
    near_length: float = 0.536
    """Up to where places are near."""
    around: float = 0.538
    """Of what lies at one height and distance from the middle."""
    around_length: float = 0.218
    """How far apart such heights and distances are still one."""
    below: float = 0.312
    """Of a slope with the normal's height: undersides are dark for other reasons than light, too."""
    unexplained: float = 0.256
    """Of what normals near each other share beyond light of degree 2."""
    unexplained_narrowness: float = 8.57
    """They share the exponential of this times their cosine less 1."""
    noise: float = 0.726
    """Of each observation by itself."""
    noise_within: float = 3.53
    """Times the deviation within an observation, over the fourth root of its members."""
    skies: SkyStatistics = SkyStatistics((0.347, -0.121), (0.264, 1.18), (0.68, 0.636, 0.54), 0.815)
    """The light before an asset is looked at: what makes the answer best, which is no statistics of skies."""
    count: int = 128
    """Observations, those of most members. 256 have the same error within 0.002 of 0.37 (rms over irradiance)."""
    least: int = 40
    """Observations below which there is no second reading."""
    cell: float = 0.3
    """Edge of the cells in which places of one look are one observation. Taste, as the next three."""
    hue: float = 0.25
    """The same in logarithms of red and blue over green."""
    brightness: float = 0.7
    """The same in logarithms of luminance."""
    directions: int = 64
    """Parts of the sphere of normals."""
    rounds: int = 4
    """Of Gauss and Newton, after which coefficients are within 0.03 of where more of them end."""
    step: float = 0.7
    """Of them, but for the last: a full step overshoots on logarithms."""
    darkest: float = 0.06
    """Irradiance over its mean that is believed, as in `source_light`."""
    farthest: float = 0.5
    """Length of the coefficients by which the second reading may differ from the first: farther off it is most often
    wrong. Of 103 tuning objects the one that loses most loses 2.5 dB in place of 3.3. Chosen on these."""


FIELD = FieldNumbers()


@dataclass(frozen=True)
class Blend:
    """Coefficients of the light by those of both readings: for each |m| a row for each band, of the first reading's
    bands, the second's, and for m = 0 of 1."""

    zero: tuple[tuple[float, ...], ...] = ((0.404, 0.075, 0.523, 0.101, 0.126), (0.208, 0.46, 0.038, 0.703, -0.195))
    one: tuple[tuple[float, ...], ...] = ((0.527, -0.073, 0.631, 0.058), (-0.004, 0.576, 0.192, 0.697))
    two: tuple[tuple[float, ...], ...] = ((0.58, 0.543),)


BLEND = Blend()


@dataclass(frozen=True)
class FieldWitnesses:
    """O observations: means over places of one look, near each other, that face one way."""

    logs: np.ndarray
    """[O] float64 logarithms of luminance."""
    spread: np.ndarray
    """[O] float64 their variances within."""
    transfer: np.ndarray
    """[O, 9] over that of an open surface under uniform light."""
    positions: np.ndarray
    """[O, 3] in rms distances from the middle."""
    members: np.ndarray
    """[O] int64."""

    @property
    def normals(self) -> np.ndarray:
        """[O, 3] float64 unit: where most of the light of each comes from."""
        vectors = _towards(self.transfer)
        return vectors / np.maximum(row_norm(vectors), 1e-9)[:, None]


def field_witnesses(light: np.ndarray, transfer: np.ndarray, points: np.ndarray) -> FieldWitnesses | None:
    """Of linear colours [N, 3], transfer [N, 9] as `FieldWitnesses.transfer` and places [N, 3]; None: too few."""
    if len(light) < FIELD.least:
        return None
    moved = points.astype(np.float64) - points.astype(np.float64).mean(0)
    moved = moved / max(float(np.sqrt(portable.mean((moved * moved).sum(1)))), 1e-30)
    logs = portable.log(light + 0.01)
    hues = np.stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1)
    bright = luminance(light)
    ways = portable.matmul(_towards(transfer), fibonacci_sphere(FIELD.directions).T).argmax(1)
    # Cells lie off the round values, near which many materials and places lie.
    kinds = [
        np.floor(moved / FIELD.cell + 0.3),
        np.floor(hues / FIELD.hue + 0.3),
        np.floor(portable.log(bright + 0.01) / FIELD.brightness + 0.3)[:, None],
        ways[:, None],
    ]
    _, member, counts = groups(row_keys(np.concatenate(kinds, 1)))
    chosen = np.argsort(-counts, kind="stable")[: FIELD.count]
    chosen = chosen[counts[chosen] >= 3]
    if len(chosen) < FIELD.least:
        return None

    def means(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(member, column, len(counts)) / counts for column in values.T], 1)[chosen]

    level = portable.log(bright + 0.005)[:, None]
    mean = means(level)
    return FieldWitnesses(
        portable.log(luminance(means(light)) + 0.005),
        np.maximum(means(level * level) - mean * mean, 0)[:, 0],
        means(transfer),
        means(moved),
        counts[chosen],
    )


def both_readings(first: np.ndarray, seen: FieldWitnesses, up: np.ndarray) -> np.ndarray:
    """[8] coefficients of bands 1 and 2 of luminance over that of band 0 by both readings. first: [8] the first one;
    up: [3] unit."""
    axes, turn = upright(up)
    before = portable.matmul(turn.T, first[:, None])[:, 0]
    away = _field_light(seen, axes, turn) - before
    distance = portable.length(away)
    second = before + away * min(1.0, FIELD.farthest / max(distance, 1e-9))
    out = np.empty(8)
    for rows, sets in zip((BLEND.zero, BLEND.one, BLEND.two), ((BANDS_BY_ORDER[0],), *BANDS_BY_ORDER[1:]), strict=True):
        for of in sets:
            inputs = np.array([*before[list(of)], *second[list(of)], 1.0])
            for target, row in zip(of, rows, strict=True):
                out[target] = portable.dot(np.array(row), inputs[: len(row)])
    return portable.matmul(turn, out[:, None])[:, 0]


def _field_light(seen: FieldWitnesses, axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """[8] the light's posterior mean by the field alone, z up. axes, turn: `upright`."""
    constant, slopes = seen.transfer[:, 0], portable.matmul(seen.transfer[:, 1:], turn)
    inverse = portable.solved(_covariance(seen, axes), np.eye(len(constant)))
    mean, covariance = usual_light(FIELD.skies)
    precision = portable.solved(covariance, np.eye(8))
    prior = portable.matmul(precision, mean[:, None])[:, 0]
    estimate = mean
    for number in range(FIELD.rounds):
        received = constant + portable.matmul(slopes, estimate[:, None])[:, 0]
        lit = np.maximum(received, FIELD.darkest)
        jacobian = slopes / lit[:, None] * (received > FIELD.darkest)[:, None]
        explained = seen.logs - portable.log(lit) + portable.matmul(jacobian, estimate[:, None])[:, 0]
        weighed = portable.matmul(inverse, np.concatenate([jacobian, explained[:, None]], 1))
        normal = portable.transposed_product(jacobian, weighed)
        best = portable.solved(normal[:, :8] + precision, (normal[:, 8] + prior)[:, None])[:, 0]
        estimate = best if number == FIELD.rounds - 1 else estimate + FIELD.step * (best - estimate)
    return estimate


def _covariance(seen: FieldWitnesses, axes: np.ndarray) -> np.ndarray:
    """[O, O] of logarithms of albedo, and of what the light does not explain."""
    points, normals = portable.matmul(seen.positions, axes), portable.matmul(seen.normals, axes)
    flat = points[:, :2] - (points[:, :2].max(0) + points[:, :2].min(0)) / 2
    rings = np.stack([row_norm(flat), points[:, 2]], 1)

    def alike(values: np.ndarray, length: float) -> np.ndarray:
        apart = values[:, None] - values[None]
        return portable.exp(-(apart * apart).sum(2) / (2 * length * length))

    cosines = portable.matmul(normals, normals.T)
    out = FIELD.level**2 + FIELD.near**2 * alike(points, FIELD.near_length)
    out += FIELD.around**2 * alike(rings, FIELD.around_length)
    out += FIELD.unexplained**2 * portable.exp(FIELD.unexplained_narrowness * (cosines - 1))
    out += FIELD.below**2 * normals[:, 2] * normals[:, 2:]
    noise = FIELD.noise**2 + FIELD.noise_within**2 * seen.spread / np.sqrt(seen.members) + 1e-4
    out[np.diag_indices(len(out))] += noise
    return out


def _towards(transfer: np.ndarray) -> np.ndarray:
    """[N, 3] the direction of band 1 of transfer [N, 9]."""
    return np.stack([-transfer[:, 3], -transfer[:, 1], transfer[:, 2]], 1)
