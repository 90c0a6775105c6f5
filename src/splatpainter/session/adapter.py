"""Between the layers and the painter: rows numbered so that splits can be followed, and what a model has learnt put
beside any rows below. The original is encoded once, when a layer first needs it.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from splatpainter.nn.precision import resolve
from splatpainter.painter import Asset, Edit, Method, Mode, Painter
from splatpainter.session.deltas import bare
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState
    from splatpainter.voxels.grid import VoxelGrid

SHAPES = ("means", "quats", "scales", "opacities")
"""What a voxel grid depends on."""
GRIDS = 2
"""Voxel grids that are kept: of the rows that are shown, and of those before."""


class Adapter:
    """A painter for one original."""

    def __init__(self, original: Splats, painter: Painter) -> None:
        self._original, self._painter = original, painter
        self._encoded: Asset | None = None
        self._grids: OrderedDict[tuple[int, ...], tuple[tuple[np.ndarray, ...], VoxelGrid]] = OrderedDict()
        self._gridding = threading.Lock()

    def apply(
        self, below: Splats, state: RefineState | None, edits: Sequence[Edit], mode: Mode, method: Method
    ) -> tuple[Splats, Asset]:
        """(the rows below as the painter got them, what it made of them). below: [N] rows with `origin`; in both
        results `origin` is the row of `below` that each comes from. state: what the edits below have taught the
        painter. Raises ValueError as Painter.apply does."""
        numbered = replace(bare(below), origin=np.arange(len(below)))
        asset = Asset(numbered)
        if self._painter.encodes(method, mode):
            base = self._base()
            assert base.encoding is not None and below.origin is not None
            if state is not None:
                from splatpainter.session.states import on_device

                state = on_device(state, next(base.encoding.model.parameters()).device)
            parents = np.maximum(below.origin, 0)
            asset = replace(asset, encoding=replace(base.encoding, parent_ids=parents, state=state))
        if mode == "local":
            vars(asset)["grid"] = self.grid(below)  # as its cached property would
        return numbered, self._painter.apply(asset, edits, mode, method)

    def grid(self, splats: Splats) -> VoxelGrid:
        """The voxels of some rows, kept for the latest GRIDS geometries (colours do not matter: no layer makes a row
        drawable or the contrary by them). Safe to call from any thread: a second caller waits for the first."""
        arrays = tuple(getattr(splats, name) for name in SHAPES)
        key = tuple(map(id, arrays))
        with self._gridding:
            found = self._grids.pop(key, None)
            if found is None:
                found = (arrays, Asset(bare(splats)).grid)
            self._grids[key] = found  # holds the arrays, so that their ids stay theirs
            while len(self._grids) > GRIDS:
                self._grids.popitem(last=False)
            return found[1]

    def _base(self) -> Asset:
        if self._encoded is None:
            own = bare(self._original)
            found = self._painter.encode(own, "ttt")
            if found.splats.means is not own.means:
                raise ValueError(
                    "session: this painter replaces the asset by a copy of its own (representation 'copy'); "
                    "layers need one that keeps the rows, such as preset 'compact'"
                )
            self._encoded = found
        return self._encoded


def fingerprint(painter: Painter, method: Method) -> str:
    """What of a painter decides the results of a method, as text: its settings, the hash of its weights, and bf16 where
    its networks are rounded to that. method: not "auto"."""
    settings = f"{painter.local_options!r} {painter.global_options!r}"
    if method != "ttt" or painter.model is None:
        return f"{method} {settings}"
    if painter.model not in _DIGESTS:
        from splatpainter.models.cache import digest

        _DIGESTS[painter.model] = digest(painter.model)
    device = next(painter.model.parameters()).device
    rounded = " bfloat16" if resolve(painter.precision, device) == "bfloat16" else ""
    return f"ttt {settings} polish={painter.polish} {_DIGESTS[painter.model]}{rounded}"


_DIGESTS: WeakKeyDictionary[SplatPainterModel, str] = WeakKeyDictionary()
"""Of the models in use, whose weights do not change meanwhile; hashing one takes longer than a small edit."""
