"""Between layers and the painter: numbers the Gaussians so that splits can be followed, and puts what a model has
encoded of the original, once, beside any Gaussians below."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.painter import Asset, Edit, Method, Mode, Painter
from splatpainter.session.replay.delta import without_source
from splatpainter.session.replay.layer_state import on_device
from splatpainter.splats import Splats
from splatpainter.system.recent import Recent

if TYPE_CHECKING:
    from splatpainter.models.refine import RefineState
    from splatpainter.spread.options import SpreadOptions
    from splatpainter.surface.estimate import Surface
    from splatpainter.voxels.grid import VoxelGrid

NO_OPTIONS: Mapping[str, Any] = {}
"""Options of a layer without local options: those of the painter hold."""
GRID_ATTRIBUTES = ("means", "quats", "scales", "opacities")
"""What a voxel grid depends on."""
MAX_GRIDS = 2
"""Voxel grids that are cached: of the present Gaussians, and of those before."""


class PainterAdapter:
    """A painter for one original."""

    def __init__(self, original: Splats, painter: Painter) -> None:
        # What a layer did is proved when the asset is exported, from the original: no receipt of a layer is.
        unproved = painter.with_settings(proof=False) if type(painter) is Painter else painter
        self._original, self._painter = without_source(original), unproved
        self._bare = Asset(self._original)
        self._encoded: Asset | None = None
        self._grids: Recent[tuple[tuple[np.ndarray, ...], VoxelGrid]] = Recent(MAX_GRIDS)
        self._gridding = threading.Lock()

    def apply(
        self,
        below: Splats,
        state: RefineState | None,
        edits: Sequence[Edit],
        mode: Mode,
        method: Method,
        options: Mapping[str, Any] = NO_OPTIONS,
        spread: SpreadOptions | None = None,
    ) -> tuple[Splats, Asset]:
        """(the Gaussians below as the painter got them, what it made of them). below: [N] with `origin`; in both
        results `origin` is the Gaussian of `below` that each comes from. state: what the painter has learnt of the
        edits below; options: those of the painter's local options that are others for this layer; spread: options of
        mode spread. Raises ValueError as Painter.apply does."""
        # Numbered anew below every layer: `origin` then says the parent in what this layer was given.
        numbered = replace(without_source(below), origin=np.arange(len(below)))
        vars(numbered)["extremes"] = below.extremes  # of the same arrays; found when a stroke began
        asset = Asset(numbered, original=self._original, make_grid=self.grid)
        # The surface of the original, computed once: paint lies on it, whatever was painted before.
        if mode != "global":
            vars(asset)["surface"] = self._bare.surface
        # The original is encoded once; later Gaussians have the latent of the one that they come from.
        if self._painter.encodes(method, mode):
            base = self._base()
            assert base.encoding is not None and below.origin is not None
            if state is not None:
                state = on_device(state, next(base.encoding.model.parameters()).device)
            parent_ids = np.maximum(below.origin, 0)
            asset = replace(asset, encoding=replace(base.encoding, parent_ids=parent_ids, state=state))
        painter = self._painter_with(options)
        if spread is not None:
            painter = painter.with_settings(spread_options=spread)
        return numbered, painter.apply(asset, edits, mode, method)

    @property
    def surface(self) -> Surface:
        """Surface of the original."""
        return self._bare.surface

    def _painter_with(self, options: Mapping[str, Any]) -> Painter:
        """The painter with other local options."""
        if not options:
            return self._painter
        from splatpainter.lift.options import LOCAL_DEFAULTS

        local = self._painter.settings.local_options or LOCAL_DEFAULTS
        return self._painter.with_settings(local_options=replace(local, **options))

    def grid(self, splats: Splats) -> VoxelGrid:
        """The voxels of an asset, cached for the latest MAX_GRIDS geometries (colours do not matter: no layer makes a
        Gaussian drawable or the contrary by them). Safe to call from any thread: a second caller waits."""
        arrays = tuple(getattr(splats, name) for name in GRID_ATTRIBUTES)
        key = tuple(map(id, arrays))
        with self._gridding:
            # It holds the arrays, so that their ids stay theirs.
            return self._grids.get(key, lambda: (arrays, Asset(without_source(splats)).grid))[1]

    def _base(self) -> Asset:
        if self._encoded is None:
            original = without_source(self._original)
            encoded = self._painter.encode(original, "ttt")
            if encoded.splats.means is not original.means:
                raise ValueError(
                    "session: this painter replaces the asset by another one (representation 'copy'); "
                    "layers need one that keeps the Gaussians, such as preset 'compact'"
                )
            self._encoded = encoded
        return self._encoded
