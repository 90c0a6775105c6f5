"""session.surface: the surface that edits are laid on, as views show it. Changes nothing."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.replay.delta import without_source

if TYPE_CHECKING:
    from splatpainter.decals.decals import Decal, LaidDecal
    from splatpainter.decals.recent_surveys import RecentSurveys
    from splatpainter.painter import Asset
    from splatpainter.surface.estimate import Surface

MODULES_OF_EDITS = (
    "splatpainter.io.zstd",
    "splatpainter.lift.edits",
    "splatpainter.lift.shared_paint",
    "splatpainter.rendering.partial",
)
"""Modules that the first local edit of a session would import, with Pillow's formats: 70 ms of its 0.5 s."""


def _import_for_edits() -> None:
    from PIL import Image

    for name in MODULES_OF_EDITS:
        importlib.import_module(name)
    Image.preinit()


class SessionSurface:
    """The surface of the original: paint lies on it, whatever the paint is made of."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core

    @property
    def estimate(self) -> Surface:
        """The surface itself: height, normal and trust at any point."""
        return self._core.replay.surfaces(self._core.document).surface

    def prepare(self, camera: Camera | None = None) -> None:
        """Make now what the next local edit would make first (its modules; samples of the surface; where this camera,
        or any, needs them the voxels of the asset), in another thread than commands, while the edit is being drawn."""
        core = self._core
        _import_for_edits()
        camera = None if camera is None else camera.relative_to(core.original.offset)
        core.replay.prepare(core.document, core.snapshot.state, camera)

    def left_out(self, camera: Camera, **limits: float) -> np.ndarray:
        """[H, W] bool: pixels of a view that a local edit would not paint (by more than half), to about a block of
        1/128 of its longer side. limits: angle_limit, depth_edge_limit, as options of a layer."""
        core = self._core
        camera = camera.relative_to(core.original.offset)
        return core.replay.surfaces(core.document).left_out(core.snapshot.state, camera, limits)

    def blocks(self, camera: Camera) -> tuple[np.ndarray, int]:
        """([rows, columns, 4] float32 z-depth and unit normal towards the camera (camera space) of the surface in the
        middle of each block of a view, depth 0 where it is not trusted or there is none; pixels along a block). Of the
        original, less what is hidden."""
        from splatpainter.lift.sheets.view_limits import blocks_px

        core = self._core
        camera = camera.relative_to(core.original.offset)
        document, state = core.document, core.replay.base_state
        # Only what reshapes the surface counts: paint lies on it and leaves it as it is.
        hiding = tuple(layer for layer in document.layers if layer.operation.reshapes and layer.visible)
        if hiding or document.assets:
            with core.lock:
                state = core.replay.compose(replace(document, layers=hiding))
        coarse = core.replay.surfaces(document).coarse_surface(state, camera)
        rows, columns = coarse.index.shape
        middles = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) + 0.5
        at = coarse.at(middles.astype(np.float64))
        table = np.concatenate([at.depth[:, None], at.normals], 1).astype(np.float32)
        return table.reshape(rows, columns, 4), blocks_px(camera)

    def laid(self, decal: Decal, *, replaces: str | None = None) -> LaidDecal:
        """A decal on the asset as it is now, or on what is below a layer: its edits, for `layers.add("paint",
        laid.edits)` or `layers.replace_views(replaces, laid.edits)`. Raises ValueError as Decal.laid does."""
        asset, surface = self._under_decal(replaces)
        return decal.laid(asset, surface, self._surveys.placement(decal, asset, surface))

    def decal_map(self, decal: Decal, camera: Camera, *, replaces: str | None = None) -> np.ndarray:
        """[H, W, 2] where `laid` would put it, as a view shows it: places of the decal, world units right and up of its
        middle, NaN beside it. Raises ValueError as Decal.laid does."""
        asset, surface = self._under_decal(replaces)
        return self._surveys.placement(decal, asset, surface).map_on(asset, surface, camera.within(asset.splats.offset))

    def _under_decal(self, replaces: str | None) -> tuple[Asset, Surface]:
        """What a decal is laid on; replaces: the layer that it takes the place of, which is not there then."""
        core = self._core
        # A decal that takes the place of another one must not lie on that one.
        splats = core.splats
        if replaces is not None:
            with core.lock:
                splats = core.replay.compose(core.document.below(replaces)).splats
        surfaces = core.replay.surfaces(core.document)
        splats = replace(without_source(splats), origin=np.arange(len(splats)))
        asset = self._surveys.asset(splats, without_source(surfaces.original), surfaces.surface)
        return asset, surfaces.surface

    @cached_property
    def _surveys(self) -> RecentSurveys:
        from splatpainter.decals.recent_surveys import RecentSurveys  # which loads what only decals need

        return RecentSurveys()
