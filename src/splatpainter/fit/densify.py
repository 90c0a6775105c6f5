"""Adaptive density control (Kerbl et al. 2023, Section 5.2, with the constants of its reference implementation).

Gaussians whose centres are pulled hard on the screen, on average over the views that draw them, stand for more than
they can show: small ones are cloned, large ones split in two. Gaussians that became transparent or huge are removed.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.fit.devices import DeviceArray, as_numpy, exp, indices, joined, on_device, sigmoid, zeros_like
from splatpainter.fit.gradients import Pull
from splatpainter.fit.parameters import RawGaussians
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix

ORIGINAL_STEPS = 30_000
"""Steps of the run that the constants are made for."""


@dataclass(frozen=True)
class DensityOptions:
    """Constants of the original. Lengths are parts of the scene's extent."""

    threshold: float = 2e-4
    """Mean screen-space gradient above which a Gaussian is cloned or split (per half picture, as in the original)."""
    absolute: bool = False
    """Sum magnitudes over tiles instead (gradients._pull); wants a threshold of about twice as much."""
    dense: float = 0.01
    """Gaussians up to this large are cloned, larger ones split."""
    children: int = 2
    shrink: float = 1.6
    """Children of a split are smaller than their parent by this factor (phi)."""
    faintest: float = 0.005
    """Gaussians below this opacity are removed."""
    largest: float = 0.1
    """Gaussians larger than this are removed, once opacities were reset."""
    reset: float = 0.01
    """Opacities are brought down to this."""


@dataclass(frozen=True)
class Schedule:
    """Steps, counted from 1, at which density is controlled."""

    start: int = 500
    every: int = 100
    stop: int = 15_000
    reset: int = 3000
    """Steps between resets of opacity; 0: none."""

    @staticmethod
    def scaled(steps: int, views: int) -> Schedule:
        """The original schedule in proportion for a run of `steps`. Between two rounds every view is seen about once,
        or means would be of one side of the object, and Gaussians have MIN_ROUND_STEPS to use the room that they were
        given; resets closer than RESET_RECOVERY_STEPS are left out, for Gaussians would not get over them."""
        # In proportion, but with room for Gaussians to use what they were given.
        part = steps / ORIGINAL_STEPS
        every = max(round(100 * part), min(views, steps // 10, 100), MIN_ROUND_STEPS)
        reset = round(3000 * part)
        return Schedule(
            max(round(500 * part), every), every, round(15_000 * part), reset if reset >= RESET_RECOVERY_STEPS else 0
        )

    def due(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and removed after this step."""
        return self.start <= step <= self.stop and (step - self.start) % self.every == 0

    def resets(self, step: int) -> bool:
        """Whether opacities are reset after this step."""
        return self.reset > 0 and step % self.reset == 0 and step <= self.stop


MIN_ROUND_STEPS = 25
"""Steps between rounds, at least: clones are on top of each other at first, and pulled as hard as before."""
RESET_RECOVERY_STEPS = 300
"""Steps that opacities need after a reset: 150 to come back at 0.05 of a logit each, as many again to settle."""


class Pulls:
    """Mean magnitude of the screen-space gradient per Gaussian, since the last round."""

    def __init__(self, gaussians: int) -> None:
        self.total, self.count = np.zeros(gaussians, np.float32), np.zeros(gaussians, np.float32)

    def add(self, pull: Pull, camera: Camera) -> None:
        # In units of the picture, as the threshold of 3DGS is meant.
        half = np.array([camera.width / 2, camera.height / 2], np.float32)
        self.total[pull.gaussian_ids] += np.linalg.norm(pull.pixels * half, axis=1)
        self.count[pull.gaussian_ids] += 1

    def mean(self) -> np.ndarray:
        """[N], 0 for Gaussians that no view drew."""
        return self.total / np.maximum(self.count, 1)


@dataclass(frozen=True)
class Round:
    """Result of one round of density control on N Gaussians."""

    parameters: RawGaussians
    """Kept Gaussians in their order, then clones, then children."""
    survivors: DeviceArray
    """[M] int64 Gaussians that stay."""
    source: DeviceArray
    """[N'] int64 the old Gaussian that each new one is, or comes from."""


def densify(
    parameters: RawGaussians,
    pulls: np.ndarray,
    extent: float,
    options: DensityOptions,
    most_gaussians: int,
    prune_large: bool,
    rng: np.random.Generator,
    device: str = "cpu",
) -> Round:
    """One round. pulls: [N]; extent: world units; most_gaussians: after the round, as far as removing allows; where
    more want to be cloned or split, those pulled hardest are. device: where the parameters are."""
    scales = exp(parameters.scales)
    size = scales.max(1) if device == "cpu" else scales.amax(1)
    opacity = sigmoid(parameters.opacities)
    # Pulled hard: there is more to show than the Gaussians there can.
    chosen = (on_device(pulls, device) >= options.threshold) & (opacity >= options.faintest)
    chosen &= abs(size) < math.inf
    # Near the bound the hardest pulled go first.
    free = max(most_gaussians - len(parameters), 0)
    if int(chosen.sum()) > free:
        hardest = np.argsort(-np.where(as_numpy(chosen), pulls, -1), kind="stable")[:free]
        chosen = zeros_like(chosen)
        chosen[on_device(hardest, device)] = True
    # Small ones leave a gap beside them: cloned. Large ones cover too much: split.
    large = size > options.dense * extent
    cloned = indices(chosen & ~large)
    split = joined([indices(chosen & large)] * options.children)
    # Split parents go, and with them what became transparent.
    removed = (chosen & large) | (opacity < options.faintest)
    if prune_large:
        removed |= size > options.largest * extent
    survivors = indices(~removed)
    children = _children(parameters.take(split), options.shrink, rng, device)
    densified = parameters.take(survivors).append(parameters.take(cloned), children)
    return Round(densified, survivors, joined([survivors, cloned, split]))


def reset_opacities(parameters: RawGaussians, value: float) -> None:
    """Bring all opacities down to `value`, in place."""
    most = math.log(value / (1 - value))
    parameters.opacities[parameters.opacities > most] = most


def _children(parents: RawGaussians, shrink: float, rng: np.random.Generator, device: str) -> RawGaussians:
    """One smaller Gaussian per parent, with its centre drawn from the parent's own density."""
    # Children are drawn from the parent's own distribution, smaller than it.
    drawn = on_device(rng.standard_normal(tuple(parents.means.shape), np.float32), device)
    offset = drawn * exp(parents.scales)
    parents.means = parents.means + (quat_to_matrix(parents.quats) @ offset[..., None])[..., 0]
    parents.scales = parents.scales - math.log(shrink)
    return parents
