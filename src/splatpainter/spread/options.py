"""Settings of a spread, apart from its classifier: whoever only checks them need not load that."""

from __future__ import annotations

from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import out_of_range, ranged


@dataclass(frozen=True)
class SpreadOptions:
    """How far a material reaches."""

    threshold: float = ranged(0.5, ge=0, le=1)
    """Confidence 0..1 from which a Gaussian belongs to the painted material: lower reaches more."""

    def __post_init__(self) -> None:
        if (line := out_of_range(self, lambda name: f"spread_{name}")) is not None:
            raise ValueError(line)


SPREAD_DEFAULTS = SpreadOptions()
