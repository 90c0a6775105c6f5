"""How a painter paints, apart from its weights."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatpainter.nn.precision import Precision, setting
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.lift.options import GlobalOptions, LocalOptions
    from splatpainter.spread.options import SpreadOptions


@dataclass(frozen=True)
class EditSettings:
    """Settings of edits; None: the defaults of that room."""

    local_options: LocalOptions | None = None
    """Of local lifts."""
    global_options: GlobalOptions | None = None
    """Of global lifts."""
    spread_options: SpreadOptions | None = None
    """How far edits of mode spread reach."""
    polish: bool = False
    """Two rounds of the lift's colours after the networks, on the Gaussians that the edit may change."""
    cache: bool = False
    """Keep encoded assets on disk (models/cache.py); for models whose weights stay as they are."""
    aside: bool = False
    """Score local edits from the side too (lift/side_views.py), for the receipt: 0.3 s of one core a view."""
    proof: bool = True
    """Hash the asset and what an edit left alone for the receipt; False: it has empty hashes."""
    precision: Precision = "auto"
    """Arithmetic of the networks (nn.precision); as made, "auto" means that SPLATPAINTER_PRECISION does not say either
    and the model's device decides."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "precision", setting(self.precision))
