"""The light that is baked into an asset, estimated from its colours.

Gaussians that lie near each other and are of like chromaticity are taken for one material: in each such patch the
logarithm of linear colour is that of an unknown albedo plus that of the irradiance, which is linear in the light's SH
of degree 2 (Ramamoorthi and Hanrahan 2001). A robust fit (iteratively reweighted Gauss-Newton, an albedo for every
patch eliminated) with a prior from real environments gives the light; the fit without each part of the asset says how
far to believe it, and what is not believed is uniform. The light's colour in the mean is a guess by what hues materials
have (`light_cast`); its level cannot be told from the albedo and counts as 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from splatpainter.color import luminance
from splatpainter.kernels import portable
from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights.light_cast import cast
from splatpainter.splats import SH_C0
from splatpainter.transforms import fibonacci_sphere

PATCH_EXTENTS = 0.25
"""Edge of a patch of one material, in rms distances of the asset from its middle."""
PATCH_CHROMA = 0.3
"""... and in natural logarithms of red and blue over green."""
NORMAL_BINS = 64
"""Directions by which Gaussians of a patch are gathered into one observation each."""
MIN_MEMBERS = 3
"""Gaussians of an observation, at least."""
FULL_MEMBERS = 50
"""Gaussians from which an observation weighs no more."""
PRIOR_STD = np.array([0.5] * 3 + [0.25] * 5)
"""[8] of the coefficients of bands 1 and 2 over that of band 0: 40 environments, whatever way is up."""
CHROMA_PRIOR = 0.3
"""Standard deviation of a channel's coefficients about those of luminance, in those of the prior."""
MIN_NOISE = 0.1
"""Of an observation, natural logarithms: texture, gloss and neighbours' light."""
DARKEST, BRIGHTEST = 0.003, 0.97
"""Linear colours between which Gaussians bear witness: beyond, pictures clip."""
MIN_SHADING = 0.06
"""Smallest irradiance over the mean that is believed."""
PARTS = 8
"""Of the asset, each of which is left out once."""
FIT_ROUNDS = 30
DOUBT = 4.0
"""Real error over the jackknife's: where materials go with directions, every part of an asset misleads alike. Of 15
clean meshes under photographed environments, real errors were 0.31 in the mean, the jackknife's 0.077."""
MIN_OBSERVATIONS = 60
MAX_UNCERTAINTY = 0.6
"""Root mean square error of irradiance over its mean from which the estimate is worth nothing."""


@dataclass(frozen=True)
class SourceLight:
    """Light that an asset's colours were made in."""

    coefficients: np.ndarray = field(repr=False)
    """[9, 3] float64 SH in the asset's axes; the mean radiance is 1, over all channels."""
    uncertainty: float
    """Expected rms error of irradiance over its mean; 0 where the light is given."""
    note: str
    """Where it comes from."""


def uniform_source(note: str) -> SourceLight:
    """White light of radiance 1 from all around."""
    return SourceLight(uniform_coefficients(), 0.0, note)


def uniform_coefficients() -> np.ndarray:
    """[9, 3] SH of radiance 1 from all around."""
    out = np.zeros((9, 3))
    out[0] = 1 / SH_C0
    return out


def estimate_source(light: np.ndarray, transfer: np.ndarray, points: np.ndarray, trusted: np.ndarray) -> SourceLight:
    """light: [N, 3] linear base colours; transfer: [N, 9] over pi (`LitSurface.transfer`); points: [N, 3]; trusted: [N]
    bool Gaussians whose side is certain."""
    # Clipped and nearly black colours have lost their ratio to the light.
    usable = trusted & (light.max(1) < BRIGHTEST) & (light.min(1) > DARKEST)
    patches = _observations(light[usable], transfer[usable] / SH_C0, points[usable])
    if patches is None or len(patches.colors) < MIN_OBSERVATIONS:
        return uniform_source("source light: uniform grey, for want of surface that could show another")
    brightness = luminance(patches.colors)
    start = np.zeros(8)
    # Luminance first: the fit of each channel then starts from it, and is held near it.
    everything = _fit(patches, brightness, start, PRIOR_STD)
    # Light that holds for the whole asset is found without any part of it; paint that looks like light is not.
    left_out = []
    for part in range(PARTS):
        rest = patches.parts != part
        left_out.append(_fit(patches.take(rest), brightness[rest], start, PRIOR_STD))
    # The jackknife's variance of an estimate (Tukey 1958), per coefficient; what it doubts shrinks towards uniform.
    spread = np.stack(left_out) - everything
    variance = (spread * spread).sum(0) * ((PARTS - 1) / PARTS)
    belief = PRIOR_STD**2 / (PRIOR_STD**2 + variance)
    # In irradiance, as that is what a wrong light would do to colours.
    directions = fibonacci_sphere(96)
    basis = unoccluded_transfer(directions)[:, 1:].astype(np.float64) / (math.pi * SH_C0)
    doubted = np.minimum(variance * DOUBT**2, PRIOR_STD**2)
    uncertainty = float(np.sqrt(portable.matmul(basis * basis, doubted[:, None]).mean()))
    if uncertainty > MAX_UNCERTAINTY:
        return uniform_source(f"source light: uniform grey; the estimate is off by about {uncertainty:.0%}")
    coefficients = uniform_coefficients()
    for channel in range(3):
        fitted = _fit(patches, patches.colors[:, channel], everything, PRIOR_STD * CHROMA_PRIOR)
        coefficients[1:, channel] = belief * fitted / SH_C0
    # Its mean colour: from what is left of the patches' hues where the shading is divided out.
    shading = np.maximum(portable.matmul(patches.transfer * SH_C0, coefficients), MIN_SHADING)
    coefficients = coefficients * cast(patches.colors / shading, patches.weights)
    return SourceLight(coefficients, uncertainty, f"source light: estimated, irradiance within {uncertainty:.0%}")


@dataclass(frozen=True)
class _Observations:
    """Means over Gaussians of one patch that face one way."""

    colors: np.ndarray
    """[B, 3] linear."""
    transfer: np.ndarray
    """[B, 9] over that of an open surface under uniform light."""
    weights: np.ndarray
    """[B] 0..1."""
    patches: np.ndarray
    """[B] int64."""
    parts: np.ndarray
    """[B] int64 0..PARTS - 1."""

    def take(self, chosen: np.ndarray) -> _Observations:
        """Those of a mask [B] bool."""
        columns = (self.colors, self.transfer, self.weights, self.patches, self.parts)
        return _Observations(*(column[chosen] for column in columns))


def _observations(light: np.ndarray, transfer: np.ndarray, points: np.ndarray) -> _Observations | None:
    if len(light) < MIN_OBSERVATIONS:
        return None
    moved = points.astype(np.float64) - points.astype(np.float64).mean(0)
    extent = max(float(np.sqrt((moved * moved).sum(1).mean())), 1e-30)
    # Cells scale with the asset, and hues are logarithms: neither its size nor its exposure changes the patches.
    cells = np.floor(moved / (PATCH_EXTENTS * extent))
    logs = portable.log(light.astype(np.float64) + 0.01)
    hues = np.floor(np.stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1) / PATCH_CHROMA)
    patches = np.unique(np.concatenate([cells, hues], 1), axis=0, return_inverse=True)[1].reshape(-1)
    vectors = np.stack([-transfer[:, 3], -transfer[:, 1], transfer[:, 2]], 1)  # band 1 is the direction light is seen
    bins = portable.matmul(vectors, fibonacci_sphere(NORMAL_BINS).T).argmax(1)
    # Gaussians that face one way in a patch are one observation: dense places do not outvote the rest.
    keys, members, counts = np.unique(patches * NORMAL_BINS + bins, return_inverse=True, return_counts=True)
    enough = counts >= MIN_MEMBERS
    members = members.reshape(-1)

    def means(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(members, column, len(keys)) / counts for column in values.T]
        return np.stack(columns, 1)[enough]

    # Parts are octants, as what misleads (a painted side, a clipped one) lies together.
    octants = (means(moved) >= 0) * np.array([1, 2, 4])
    return _Observations(
        colors=means(light.astype(np.float64)),
        transfer=means(transfer),
        weights=np.sqrt(np.minimum(counts[enough], FULL_MEMBERS) / FULL_MEMBERS),
        patches=np.unique(keys[enough] // NORMAL_BINS, return_inverse=True)[1].reshape(-1),
        parts=octants.sum(1),
    )


def _fit(seen: _Observations, values: np.ndarray, center: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """[8] coefficients of bands 1 and 2 over that of band 0 that explain values [B]; prior: center and deviation."""
    if len(values) < MIN_OBSERVATIONS // 2:
        return np.zeros(8)
    # In logarithms albedo and irradiance add up, so that each patch's albedo is a mean to subtract.
    logs = portable.log(values + 0.005)
    count = int(seen.patches.max()) + 1
    limits = _basis_all_around()
    estimate, weights = center.copy(), seen.weights.copy()
    constant, slopes = seen.transfer[:, 0], seen.transfer[:, 1:]

    def patch_means(column: np.ndarray, total: np.ndarray) -> np.ndarray:
        return (np.bincount(seen.patches, weights * column, count) / total)[seen.patches]

    for _ in range(FIT_ROUNDS):
        received = constant + portable.matmul(slopes, estimate[:, None])[:, 0]
        lit = np.maximum(received, MIN_SHADING)
        rest = logs - portable.log(lit)
        total = np.maximum(np.bincount(seen.patches, weights, count), 1e-9)
        error = rest - patch_means(rest, total)
        noise = max(1.4826 * float(np.median(np.abs(error))), MIN_NOISE)
        # A patch with an edge of two materials would else pull the light towards it.
        weights = seen.weights * np.minimum(1, 1.2 * noise / np.maximum(np.abs(error), 1e-9))  # Huber's
        total = np.maximum(np.bincount(seen.patches, weights, count), 1e-9)
        jacobian = slopes / lit[:, None] * (received > MIN_SHADING)[:, None]
        jacobian = jacobian - np.stack([patch_means(column, total) for column in jacobian.T], 1)
        error = rest - patch_means(rest, total)
        matrix = portable.gram(jacobian, weights) / noise**2
        matrix[np.arange(8), np.arange(8)] += 1 / deviation**2
        right = portable.transposed_product(jacobian, (weights * error)[:, None])[:, 0] / noise**2
        step = portable.solved(matrix, (right - (estimate - center) / deviation**2)[:, None])[:, 0]
        # Damped: far from the solution a full step on logarithms overshoots.
        estimate = estimate + 0.6 * step
        darkest = float((1 + portable.matmul(limits, estimate[:, None])).min())
        if darkest < MIN_SHADING:  # light is not negative
            estimate = estimate * ((1 - MIN_SHADING) / (1 - darkest))
    return estimate


def _basis_all_around() -> np.ndarray:
    """[96, 8] what bands 1 and 2 add to the irradiance of normals all around."""
    return unoccluded_transfer(fibonacci_sphere(96))[:, 1:].astype(np.float64) / (math.pi * SH_C0)
