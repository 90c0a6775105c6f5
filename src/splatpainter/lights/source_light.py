"""The light that is baked into an asset, estimated from its colours.

Gaussians that lie near each other and are of like chromaticity are taken for one material: in each such patch the
logarithm of linear colour is that of an unknown albedo plus that of the irradiance, which is linear in the light's SH
of degree 2 (Ramamoorthi and Hanrahan 2001). A robust fit (iteratively reweighted Gauss-Newton, an albedo for every
patch eliminated) gives the light; the fit without each part of the asset says how far to believe it, and what is not
believed is as lights usually are (`light_prior`). A second reading, by what albedo is like all over an asset, corrects
that (`albedo_field`). The light's colour in the mean is a guess by what hues materials have (`light_cast`); its level
cannot be told from the albedo and counts as 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.color import luminance
from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights.albedo_field import FieldWitnesses, both_readings, field_witnesses
from splatpainter.lights.highlight_color import HighlightColor
from splatpainter.lights.light_cast import cast
from splatpainter.lights.light_prior import likely_light, likely_ways
from splatpainter.order_statistics import groups, row_keys
from splatpainter.splats import SH_C0
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere

PRIOR_STD = np.array([0.5] * 3 + [0.25] * 5)
"""[8] of the coefficients of bands 1 and 2 over that of band 0: 40 environments, whatever way is up."""


@dataclass(frozen=True)
class EstimateThresholds:
    """Of the fit. Lengths of the asset are in rms distances from its middle."""

    patch_extents: float = 0.25
    """Edge of a patch of one material. 16 path traced tuning meshes, fitted: with 0.4 the rms error of irradiance is
    0.43 in place of 0.47, and relit pictures and albedos are no better; clean ones lose 0.2 dB."""
    patch_chroma: float = 0.3
    """The same edge in natural logarithms of red and blue over green."""
    patch_brightness: float = 0.7
    """The same edge, where a light is known, in natural logarithms of luminance without its shading."""
    normal_bins: int = 64
    """Directions by which Gaussians of a patch are gathered into one observation each."""
    min_members: int = 3
    """Gaussians of an observation, at least."""
    full_members: int = 50
    """Gaussians from which an observation weighs no more."""
    loose: float = 2.0
    """Deviations in the fit over PRIOR_STD: what is usual is weighed afterwards, against all of the fit's doubt."""
    chroma_prior: float = 0.3
    """Standard deviation of a channel's coefficients about those of luminance, in those of the prior."""
    min_noise: float = 0.1
    """Of an observation, natural logarithms: texture, gloss and neighbours' light."""
    darkest: float = 0.003
    """Linear colour from which Gaussians bear witness: below, pictures clip."""
    brightest: float = 0.97
    """Linear colour up to which Gaussians bear witness: beyond, pictures clip."""
    min_shading: float = 0.06
    """Smallest irradiance over the mean that is believed."""
    parts: int = 8
    """Of the asset, each of which is left out once."""
    rounds: int = 30
    settled: float = 1e-3
    """Largest change of a coefficient, over band 0, with which the fit ends: irradiance is the same to 0.1 %."""
    min_observations: int = 60
    common_error: float = 0.3
    """Of irradiance over its mean, that no part of the asset shows: gloss, neighbours' light, a sun finer than SH."""
    understated: float = 3.0
    """Real square error over that of the fit, beyond the common one. With both 16 path traced tuning meshes lie within
    what is reported in 69 % (fitted by 3DGS; coarse 62 %) and within twice as much in 100 % (94 %); rms 0.51 for 0.48
    (0.37 for 0.44). With 0.1 and 1 it was 0.26 and 0.16."""
    telling: float = 0.85
    """Rms change of the logarithm of irradiance, over the uncertainty, below which a new light is hardly another. 16
    fitted tuning meshes, two lights each: such ones gain 0.2 dB by being lit, others 2.4; no weaker light is better in
    either by more than 0.1 dB, so that it is said and nothing else."""
    variance: tuple[float, float, float] = (0.001, 0.5, 20.0)
    """Of the fit's coefficients as a polynomial in the jackknife's variance: 44 training meshes under 132 lights. Where
    materials go with directions, every part of an asset misleads alike, and more than the parts differ. Three times as
    much has the same error on path traced meshes and loses 0.2 dB of relit pictures."""

    sure: float = 2e-4
    """Jackknife's variance of the fit at which a second reading has half of its say. Balls of exact shading have 1e-5;
    of 75 fitted tuning assets nine tenths have more than 2e-3, of 44 coarse ones more than 5e-4."""


LIMITS = EstimateThresholds()

Highlights = Callable[[np.ndarray], HighlightColor | None]
"""What mirror images in an asset say of the colour of a light whose luminance has these SH [9]."""


def no_highlights(light: np.ndarray) -> HighlightColor | None:
    """Of an asset that looks the same from all sides."""


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


def estimate_source(
    light: np.ndarray,
    transfer: np.ndarray,
    points: np.ndarray,
    trusted: np.ndarray,
    up: UpAxis = "auto",
    both: bool = True,
    highlights: Highlights = no_highlights,
) -> SourceLight:
    """light: [N, 3] linear base colours; transfer: [N, 9] over pi (`LitSurface.transfer`); points: [N, 3]; trusted: [N]
    bool Gaussians whose side is certain; up: where light usually comes from; both: with the second reading; highlights:
    of the asset."""
    usable = trusted & unclipped(light)
    light, transfer, points = light[usable].astype(np.float64), transfer[usable] / SH_C0, points[usable]
    first = by_patches(light, transfer, points, up)
    if first is None:
        return uniform_source("source light: uniform grey, for want of surface that could show another")
    coefficients = first.grey
    seen = field_witnesses(light, transfer, points) if both else None
    if seen is not None:
        coefficients = _by_both(coefficients, seen, first.ways, first.doubted)
    # Its mean colour last, as mirror images are looked for where this light would have them.
    return replace(first.light, coefficients=_tinted(coefficients, first.patches, highlights))


def unclipped(light: np.ndarray) -> np.ndarray:
    """[N] bool of linear colours [N, 3]: clipped and nearly black ones have lost their ratio to the light."""
    return (light.max(1) < LIMITS.brightest) & (light.min(1) > LIMITS.darkest)


def by_patches(light: np.ndarray, transfer: np.ndarray, points: np.ndarray, up: UpAxis) -> PatchReading | None:
    """The first reading; None where too little surface bears witness. light: [M, 3] float64 linear; transfer: [M, 9]
    over that of an open surface under uniform light; points: [M, 3]."""
    shading, reading = np.ones_like(light), None
    for number in range(2):
        # Once a light is known materials show: by hue the first time, then by what is left of hue and brightness.
        patches = _observations(light, transfer, points, light / shading, number > 0)
        if patches is None or len(patches.colors) < LIMITS.min_observations:
            break
        grey, uncertainty, ways, doubted = _from_patches(patches, up)
        # Materials that were told apart by a light agree with it: what the first look doubted stays in doubt.
        uncertainty = max(uncertainty, reading.light.uncertainty) if reading else uncertainty
        note = f"source light: estimated, irradiance within {uncertainty:.0%}"
        coefficients = _tinted(grey, patches, no_highlights)
        reading = PatchReading(SourceLight(coefficients, uncertainty, note), grey, ways, doubted, patches)
        shading = np.maximum(portable.matmul(transfer * SH_C0, coefficients), LIMITS.min_shading)
    return reading


def _by_both(
    coefficients: np.ndarray, seen: FieldWitnesses, ways: list[tuple[np.ndarray, float]], doubted: float
) -> np.ndarray:
    """[9, 3] with the bands of luminance that both readings give, as far as the first one is in doubt (0..1); those of
    the channels keep their differences."""
    total = luminance(coefficients)
    first = total[1:] / total[0]
    both = np.zeros(8)
    for way, share in ways:
        both += share * both_readings(first, seen, way)
    out = coefficients.copy()
    change = doubted * (_not_negative(both, _basis_all_around()) - first)
    out[1:] += change[:, None] * coefficients[0]
    return out


def _from_patches(
    patches: PatchWitnesses, up: UpAxis
) -> tuple[np.ndarray, float, list[tuple[np.ndarray, float]], float]:
    """([9, 3] SH, expected rms error of irradiance over its mean, `likely_ways`, 0..1 how far
    they are in doubt)."""
    brightness = luminance(patches.colors)
    start, deviation = np.zeros(8), LIMITS.loose * PRIOR_STD
    # Luminance first: the fit of each channel then starts from it, and is held near it.
    everything = _fit(patches, brightness, start, deviation)

    # Light that holds for the whole asset is seen without any part of it; paint that looks like light is not.
    def without(part: int) -> np.ndarray:
        rest = patches.parts != part
        return _fit(patches.take(rest), brightness[rest], start, deviation)

    left_out = each(without, range(LIMITS.parts))
    # The jackknife's variance of an estimate (Tukey 1958), one for all coefficients: what is doubted is as is usual.
    spread = np.stack(left_out) - everything
    jackknife = float((spread * spread).sum(0).mean()) * ((LIMITS.parts - 1) / LIMITS.parts)
    steady, linear, square = LIMITS.variance
    variance = steady + jackknife * (linear + jackknife * square)
    likely, covariance, belief = likely_light(everything, variance, up)
    # In irradiance, as that is what a wrong light would do to colours.
    basis = _basis_all_around()
    square_error = float(portable.mean((portable.matmul(basis, covariance) * basis).sum(1)))
    uncertainty = math.sqrt(LIMITS.understated * square_error + LIMITS.common_error**2)
    likely = _not_negative(likely, basis)
    coefficients = uniform_coefficients()
    chroma = PRIOR_STD * LIMITS.chroma_prior
    channels = each(lambda channel: _fit(patches, patches.colors[:, channel], everything, chroma), range(3))
    for channel, fitted in enumerate(channels):
        coefficients[1:, channel] = (likely + belief * (fitted - everything)) / SH_C0
    return coefficients, uncertainty, likely_ways(everything, variance, up), jackknife / (jackknife + LIMITS.sure)


def _tinted(grey: np.ndarray, patches: PatchWitnesses, highlights: Highlights) -> np.ndarray:
    """[9, 3] SH in the mean colour that is likely: by what is left of the patches' hues where the shading is divided
    out, and by mirror images."""
    shading = np.maximum(portable.matmul(patches.transfer * SH_C0, grey), LIMITS.min_shading)
    return grey * cast(patches.colors / shading, patches.weights, highlights(luminance(grey)))


@dataclass(frozen=True)
class PatchWitnesses:
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
    """[B] int64 0..LIMITS.parts - 1."""

    def take(self, chosen: np.ndarray) -> PatchWitnesses:
        """Those of a mask [B] bool."""
        columns = (self.colors, self.transfer, self.weights, self.patches, self.parts)
        return PatchWitnesses(*(column[chosen] for column in columns))


@dataclass(frozen=True)
class PatchReading:
    """A light by patches of one material each."""

    light: SourceLight
    grey: np.ndarray
    """[9, 3] its SH before it has a colour in the mean."""
    ways: list[tuple[np.ndarray, float]]
    """`likely_ways`."""
    doubted: float
    """0..1."""
    patches: PatchWitnesses = field(repr=False)


def _observations(
    light: np.ndarray, transfer: np.ndarray, points: np.ndarray, albedo: np.ndarray, by_brightness: bool
) -> PatchWitnesses | None:
    """albedo: [N, 3] what light may be without its shading; its hue, and brightness if asked, tells materials apart."""
    if len(light) < LIMITS.min_observations:
        return None
    moved = points.astype(np.float64) - points.astype(np.float64).mean(0)
    extent = max(float(np.sqrt(portable.mean((moved * moved).sum(1)))), 1e-30)
    # Cells scale with the asset, and hues are logarithms: neither its size nor its exposure changes the patches.
    cells = np.floor(moved / (LIMITS.patch_extents * extent))
    logs = portable.log(albedo + 0.01)
    hues = np.floor(np.stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1) / LIMITS.patch_chroma)
    kinds = [cells, hues]
    if by_brightness:
        level = portable.log(luminance(albedo) + 0.01) / LIMITS.patch_brightness
        kinds.append(np.floor(level + 0.37)[:, None])  # off the round values, near which many materials lie
    _, patches, _ = groups(row_keys(np.concatenate(kinds, 1)))
    vectors = np.stack([-transfer[:, 3], -transfer[:, 1], transfer[:, 2]], 1)  # band 1 is the direction light is seen
    bins = portable.matmul(vectors, fibonacci_sphere(LIMITS.normal_bins).T).argmax(1)
    # Gaussians that face one way in a patch are one observation: dense places do not outvote the rest.
    keys, members, counts = np.unique(patches * LIMITS.normal_bins + bins, return_inverse=True, return_counts=True)
    enough = counts >= LIMITS.min_members
    members = members.reshape(-1)

    def means(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(members, column, len(keys)) / counts for column in values.T]
        return np.stack(columns, 1)[enough]

    # Parts are octants, as what misleads (a painted side, a clipped one) lies together.
    octants = (means(moved) >= 0) * np.array([1, 2, 4])
    return PatchWitnesses(
        colors=means(light),
        transfer=means(transfer),
        weights=np.sqrt(np.minimum(counts[enough], LIMITS.full_members) / LIMITS.full_members),
        patches=np.unique(keys[enough] // LIMITS.normal_bins, return_inverse=True)[1].reshape(-1),
        parts=octants.sum(1),
    )


def _fit(seen: PatchWitnesses, values: np.ndarray, center: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """[8] coefficients of bands 1 and 2 over that of band 0 that explain values [B]; prior: center and deviation."""
    if len(values) < LIMITS.min_observations // 2:
        return np.zeros(8)
    # In logarithms albedo and irradiance add up, so that each patch's albedo is a mean to subtract.
    logs = portable.log(values + 0.005)
    count = int(seen.patches.max()) + 1
    limits = _basis_all_around()
    estimate, weights = center.copy(), seen.weights.copy()
    constant, slopes = seen.transfer[:, 0], seen.transfer[:, 1:]

    def patch_means(column: np.ndarray, total: np.ndarray) -> np.ndarray:
        return (np.bincount(seen.patches, weights * column, count) / total)[seen.patches]

    for _ in range(LIMITS.rounds):
        received = constant + portable.matmul(slopes, estimate[:, None])[:, 0]
        lit = np.maximum(received, LIMITS.min_shading)
        rest = logs - portable.log(lit)
        total = np.maximum(np.bincount(seen.patches, weights, count), 1e-9)
        error = rest - patch_means(rest, total)
        noise = max(1.4826 * float(np.median(np.abs(error))), LIMITS.min_noise)
        # A patch with an edge of two materials would else pull the light towards it.
        weights = seen.weights * np.minimum(1, 1.2 * noise / np.maximum(np.abs(error), 1e-9))  # Huber's
        total = np.maximum(np.bincount(seen.patches, weights, count), 1e-9)
        jacobian = slopes / lit[:, None] * (received > LIMITS.min_shading)[:, None]
        jacobian = jacobian - np.stack([patch_means(column, total) for column in jacobian.T], 1)
        error = rest - patch_means(rest, total)
        matrix = portable.gram(jacobian, weights) / noise**2
        matrix[np.arange(8), np.arange(8)] += 1 / deviation**2
        right = portable.transposed_product(jacobian, (weights * error)[:, None])[:, 0] / noise**2
        step = portable.solved(matrix, (right - (estimate - center) / deviation**2)[:, None])[:, 0]
        # Damped: far from the solution a full step on logarithms overshoots.
        moved = _not_negative(estimate + 0.6 * step, limits)
        change, estimate = np.abs(moved - estimate).max(), moved
        if change < LIMITS.settled:
            break
    return estimate


def _not_negative(estimate: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """[8] nearer to uniform light where irradiance would be too dark for any light. basis: `_basis_all_around`."""
    darkest = float((1 + portable.matmul(basis, estimate[:, None])).min())
    if darkest >= LIMITS.min_shading:
        return estimate
    return estimate * ((1 - LIMITS.min_shading) / (1 - darkest))


def _basis_all_around() -> np.ndarray:
    """[96, 8] what bands 1 and 2 add to the irradiance of normals all around."""
    return unoccluded_transfer(fibonacci_sphere(96))[:, 1:].astype(np.float64) / (math.pi * SH_C0)
