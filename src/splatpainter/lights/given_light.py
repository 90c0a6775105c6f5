"""How far an environment that is given beside relit pictures is believed.

It may be cut off at what its file holds, turned, or another one than the pictures are lit by. Three readings of it
(held, nearly, roughly) are weighed against the pictures alone twice: by the evidence of the fit, which sees all
witnesses, and by pixels that were held back, which see what the fit does not explain. Either alone is misled now and
then.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field

import numpy as np

from splatpainter.kernels import portable
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Trust:
    """One reading of a given environment."""

    text: str
    deviation: float
    """Of its bands, over the mean of the new light."""
    holds_before: bool = False
    """The light before is as it was estimated; else the pictures correct it."""


@dataclass(frozen=True)
class GivenLightThresholds:
    """Of the choice."""

    trusts: tuple[Trust, ...] = (Trust("held", 0.02, True), Trust("nearly", 0.1), Trust("roughly", 0.3))
    """One picture of each of 14 clean, path traced tuning meshes and its true environment, dB in other views against
    the picture alone: +0.63, two lose, at worst 1.2; with the environment cut off at radiance 1 +0.63, three lose, at
    worst 0.3. Where bands are expected at the environment's own level, which few files share with the pictures: +0.70
    and +0.19. Before, of 10 others, always nearly: at worst -1.3 and -7.4; by the held back part alone -0.5, -0.7."""
    huber: float = 1.5
    """Errors beyond so many deviations are outliers, in the fit and in the evidence."""


LIMITS = GivenLightThresholds()


@dataclass(frozen=True)
class LightFit:
    """Of both lights, to the ratios of one channel or of luminance."""

    error: np.ndarray = field(repr=False)
    """[M] natural logarithms."""
    weights: np.ndarray = field(repr=False)
    """[M]."""
    surprise: float
    """Sum of squares of what was found against what was expected, in deviations."""
    deviation: np.ndarray = field(repr=False)
    """[17] of what is expected."""
    precision: np.ndarray = field(repr=False)
    """[17, 17] of what was found."""

    def noise(self, least: float) -> float:
        """Of the ratios, natural logarithms."""
        return max(1.4826 * float(np.median(np.abs(self.error))), least)

    def evidence(self, noise: float) -> float:
        """Laplace's approximation to the logarithm of how likely the ratios are if the expectation is right (MacKay
        2003, ch. 27), but for a constant. noise: one for all that are compared, or a bad fit would excuse itself."""
        size = np.abs(self.error) / noise
        loss = np.where(size < LIMITS.huber, size * size / 2, LIMITS.huber * (size - LIMITS.huber / 2))
        fidelity = -float((self.weights * loss).sum()) - self.surprise / 2
        return fidelity - float(portable.log(self.deviation).sum()) - portable.log_determinant(self.precision) / 2


@dataclass(frozen=True)
class EnvironmentUse:
    """What was made of a given environment."""

    trust: Trust | None
    """None: the pictures alone."""
    reason: str

    @property
    def text(self) -> str:
        return f"environment {self.trust.text if self.trust else 'not used'}: {self.reason}"


def likely_trusts(evidence: Mapping[Trust | None, float]) -> list[Trust]:
    """Those that are likelier than the pictures alone (None)."""
    return [trust for trust, value in evidence.items() if trust is not None and value > evidence[None]]


def chosen_trust(evidence: Mapping[Trust | None, float], scores: Mapping[Trust | None, float]) -> EnvironmentUse:
    """What both judges prefer. evidence: of each reading and of the pictures alone (None); scores: dB on what was held
    back, of the pictures alone and of the likely readings; empty: too little is pictured to hold back any."""
    likely = likely_trusts(evidence)
    if not likely:
        best = max(value for trust, value in evidence.items() if trust)
        return EnvironmentUse(None, f"the pictures are likelier without it (log odds {evidence[None] - best:.1f})")
    if not scores:
        trust = max(likely, key=lambda one: evidence[one])
        return EnvironmentUse(trust, f"likelier with it (log odds {evidence[trust] - evidence[None]:.1f})")
    trust = max((None, *likely), key=lambda one: scores[one])
    listed = ", ".join(f"{one.text if one else 'alone'} {scores[one]:.1f}" for one in (None, *likely))
    return EnvironmentUse(trust, f"held back, dB: {listed}")
