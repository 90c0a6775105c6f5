"""How far an environment that is given beside relit pictures is believed.

It may be cut off at what its file holds, turned, or another one than the pictures are lit by. Pictures of one side are
explained best by a light of their own, which says nothing of the other sides, so that they are no judge between that
and an environment. What they can tell is whether they would rather have it turned. If not, it is held, nearly or
roughly, whichever shows best what of the pictures was held back; if so, it has to show that better than they do alone.
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


HELD, NEARLY, ROUGHLY = Trust("held", 0.02, True), Trust("nearly", 0.1), Trust("roughly", 0.3)
"""The readings."""


@dataclass(frozen=True)
class GivenLightThresholds:
    """Of the choice."""

    turns: int = 8
    """Directions about the way up that the environment is compared in with itself."""
    slack: float = 1.0
    """Log odds by which it may be less likely than the best of its turns. 14 path traced tuning meshes, coarse and
    fitted, one picture each, dB over nothing in other views: pictures alone 1.23; with true environments 2.23 (1.66
    where the evidence of both had to agree), of half their contrast 1.94 (1.71), with turned and others 1.09 (1.14). 14
    held-out ones: alone -0.11 (coarse) and -0.66 (fitted), true ones 0.92 (0.65) and 0.77 (0.20), turned by 120 degrees
    0.42 (0.12) and -0.40 (-0.69)."""
    slack_share: float = 0.2
    """The same, of the odds between the best and the middle one of its turns."""
    held_back_loss: float = 2.0
    """dB on what was held back, by which the pictures alone may be better, unless they would have it turned."""
    roughly_gain: float = 1.0
    """dB on what was held back, by which `ROUGHLY` has to be better than the others: what it leaves to pictures of one
    side is wrong on the others."""
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


def better_turn(evidence: float, turned: Sequence[float]) -> str:
    """That the pictures would rather have the environment turned, in words; empty: they would not. evidence: of the
    environment; turned: of it at equal steps about the way up, without the first."""
    around = np.array([evidence, *turned])
    best = float(around.max())
    if evidence >= best - max(LIMITS.slack, LIMITS.slack_share * (best - float(np.median(around)))):
        return ""
    degrees = 360 * int(around.argmax()) / len(around)
    return f"the pictures are likelier with it turned by {degrees:g} degrees (log odds {best - evidence:.1f})"


def chosen_trust(scores: Mapping[Trust | None, float], objection: str = "") -> EnvironmentUse:
    """What to make of an environment. scores: dB on what was held back, of the pictures alone (None) and of the
    readings; empty: too little is pictured to hold back any; objection: `better_turn`."""
    if not scores:
        return EnvironmentUse(None if objection else NEARLY, objection or "the pictures are less likely with it turned")
    best = max((NEARLY,) if objection else (HELD, NEARLY), key=lambda trust: scores[trust])
    best = ROUGHLY if scores[ROUGHLY] > scores[best] + LIMITS.roughly_gain else best
    used = scores[best] > scores[None] - (0 if objection else LIMITS.held_back_loss)
    listed = ", ".join(f"{trust.text if trust else 'alone'} {score:.1f}" for trust, score in scores.items())
    held_back = f"held back, dB: {listed}"
    return (
        EnvironmentUse(best, held_back)
        if used
        else EnvironmentUse(None, "; ".join(filter(None, (objection, held_back))))
    )
