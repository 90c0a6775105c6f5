"""What composing an asset hands from layer to layer: the Gaussians so far, and where results are stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from splatpainter.session.replay.conflicts import EditedIds
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.models.refine import RefineState


class ResultStore(Protocol):
    """Where pictures and results of layers are stored."""

    def blob(self, sha256: str) -> bytes: ...
    def has(self, key: str) -> bool: ...
    def get(self, key: str) -> LayerResult | None: ...
    def put(self, key: str, result: LayerResult, previous: str | None = None) -> None:
        """previous: key of the result that this one needs to be there too (of the stroke before)."""
        ...


@dataclass(frozen=True)
class LayerState:
    """The asset after some layers."""

    key: str
    """Hash of everything it depends on."""
    splats: Splats
    """`origin`: the original's Gaussian that each comes from."""
    parent_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """For the Gaussians appended to the original: the Gaussian that each was split from, -1: none."""
    edited: tuple[EditedIds, ...] = ()
    facts: tuple[tuple[str, dict[str, Any]], ...] = ()
    """(layer id, LayerResult.facts) of the visible layers."""
    results: tuple[str, ...] = ()
    """Keys of the cached results it was made of."""
    painter_state: Any = field(default=None, repr=False)
    unlit: np.ndarray | None = field(default=None, repr=False)
    """[N, 1, 3] SH of base colours as they would be without its light layers (light_below.py); None: it has none."""


Progress = Callable[[int, int, str], None]
"""(layers done, layers in all, name of the one in work); what it raises ends the work, and nothing has changed."""


def nbytes(splats: Splats) -> int:
    """Bytes of the Gaussians in memory."""
    return sum(getattr(splats, name).nbytes for name in ATTRIBUTES)


def ancestors(state: LayerState, count: int) -> np.ndarray:
    """[A] the Gaussian among the first `count` that each later one was split from, over any number of splits; -1:
    none."""
    first = len(state.splats) - len(state.parent_ids)
    out = state.parent_ids[count - first :].copy()
    # A Gaussian may be split from one that a layer appended, so parents are followed until below.
    while (late := out >= count).any():
        out[late] = state.parent_ids[out[late] - first]
    return out


def lineage(state: LayerState, count: int) -> np.ndarray:
    """[N] the Gaussian among the first `count` that each is, or was split from; -1: none."""
    return np.concatenate([np.arange(count), ancestors(state, count)])


def on_device(state: RefineState, device: object) -> RefineState:
    """The same state on a torch device."""

    def moved(block):
        if block is None:
            return None
        return type(block)(*(part.to(device) for part in block)) if isinstance(block, tuple) else block.to(device)

    blocks = tuple(moved(block) for block in state.blocks)
    return replace(state, blocks=blocks, detail=moved(state.detail))
