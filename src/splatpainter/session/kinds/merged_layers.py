"""Layers that other layers were merged into: they stay inside it, and do what they did."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from splatpainter.session.document.layer_operation import LayerOperation


@dataclass(frozen=True)
class MergedLayer(LayerOperation):
    """What the layers inside do, with one opacity, blend and mask over all of it."""

    kind: ClassVar[str] = "merged"
    merges: ClassVar[bool] = True
