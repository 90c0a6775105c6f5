"""How far an environment that is given beside relit pictures is believed.

It may be cut off at what its file holds, turned, or another one than the pictures are lit by. Three readings of it
(held, nearly, roughly) are weighed against the pictures alone twice: by the evidence of the fit, which sees all
witnesses, and by pixels that were held back, which see what the fit does not explain. Either alone is misled now and
then. Where both prefer the pictures alone, as they do where normals are noise, the question is whether the pictures
would rather have the environment turned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    turns: int = 8
    """Directions about the way up that the environment is compared in with itself."""
    judged_by: int = 1
    """Of `trusts`, the one that is compared so."""
    slack: float = 0.5
    """Log odds by which it may be less likely than the best of its turns."""
    slack_share: float = 0.2
    """The same, of the odds between the best and the middle one of its turns."""
    telling: float = 0.6
    """Log odds by which it has to be likelier than the middle one of its turns: else the pictures do not tell from
    where they are lit. 17 fitted tuning meshes, one picture each, dB in other views against the picture alone, without
    this question and with it: true environments +0.68 -> +0.81, limited as files are read +0.52 -> +0.62, cut off at 1
    +0.26 -> +0.39; turned by 90 to 270 degrees and others +0.07 and -0.08, as before. 15 coarse ones +1.79 -> +1.81,
    +1.51 -> +1.56, +1.39 -> +1.36; +0.52 -> +0.54, +0.40 -> +0.37. With 1, 0.35 and no least of this true ones gain
    +1.19, and eight held-out ones turned by 180 degrees lose 1 dB more, at worst 6."""
    least: float = -8.0
    """Log odds against the pictures alone, from which it may be true: their light fits errors of normals, too."""
    held_back_loss: float = 2.0
    """dB on what was held back, by which the pictures alone may be better. With 1 true ones gain 0.2 dB less."""
    huber: float = 1.5
    """Errors beyond so many deviations are outliers, in the fit and in the evidence."""

    @property
    def judge(self) -> Trust:
        """The reading that is compared with itself turned."""
        return self.trusts[self.judged_by]


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


def uncontradicted(evidence: float, turned: Sequence[float], alone: float) -> bool:
    """Whether pictures that are likelier without an environment might still be lit by it. Alone, they are free to fit
    what no light explains; the same environment from elsewhere is as little free as it is. evidence: of the
    environment; turned: of it in other directions; alone: of the pictures."""
    best, middle = max(evidence, *turned), float(np.median([evidence, *turned]))
    least = max(best - max(LIMITS.slack, LIMITS.slack_share * (best - middle)), alone + LIMITS.least)
    return evidence >= least and evidence >= middle + LIMITS.telling


def believed_unless_held_back(
    trust: Trust, scores: Mapping[Trust | None, float], refused: EnvironmentUse
) -> EnvironmentUse:
    """Of an environment that nothing contradicts. scores: as of `chosen_trust`; refused: what was to be made of it."""
    if scores and scores[trust] < scores[None] - LIMITS.held_back_loss:
        return refused
    return EnvironmentUse(trust, "the pictures are less likely with it turned")
