"""Settings of a spread, apart from its classifier: whoever only checks them need not load that."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SpreadOptions:
    """How far a material reaches."""

    threshold: float = 0.5
    """Confidence 0..1 from which a Gaussian belongs to the painted material: lower reaches more."""

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise ValueError(f"spread threshold: expected 0 (reaches more) to 1 (reaches less), got {self.threshold:g}")


SPREAD_DEFAULTS = SpreadOptions()
