"""What a layer makes of the Gaussians below it."""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any

import numpy as np

from splatpainter.session.replay.delta import Delta
from splatpainter.session.replay.recent_changes import note_changes
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class LayerResult:
    """What a layer makes of the Gaussians below it, before opacity and blend."""

    delta: Delta = field(repr=False)
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON for people: rows_touched, rows_appended, seconds, method, note, views [{psnr_...}], problem."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N + A] uint8, of a global edit."""
    painter_state: Any = field(default=None, repr=False)
    """What the painter has learnt so far (fast weights), where it learns."""
    computed: tuple[Splats, Splats] | None = field(default=None, repr=False, compare=False)
    """(Gaussians below, what the delta makes of them), where the painter has just made these. Never stored."""

    def with_computed(self, below: Splats, after: Splats) -> LayerResult:
        """The result, where `after` has the values of what the delta makes of `below`."""
        if not len(self.delta.appended) or after.means.dtype != np.float32:  # arrays that did not change are shared
            return self
        note_changes(below, after, self.delta.gaussian_ids)
        return replace(self, computed=(below, self.delta.numbered(after, below)))

    def apply(self, below: Splats) -> Splats:
        """What the delta makes of the Gaussians below."""
        if self.computed is not None and self.computed[0] is below:
            return self.computed[1]
        return self.delta.apply(below)

    @property
    def problem(self) -> str:
        """Why the layer changes nothing; "" where it works."""
        return self.facts.get("problem", "")
