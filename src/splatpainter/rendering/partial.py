"""A view drawn in some of its 16 x 16 tiles only: around an edit, and again where the edit changed it. Knows no edit.

Tiles are independent of each other, so a tile has the same bits whichever fresh are drawn with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.cameras import Camera
from splatpainter.rendering import check_views
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.rendering.cpu.projected_view import ProjectedView


@dataclass(frozen=True)
class PartialRender:
    """One view of some Gaussians; tiles that are not drawn show the background, with no alpha."""

    splats: Splats = field(repr=False)
    """Numpy."""
    camera: Camera
    tiles: Bools = field(repr=False)
    """[TH, TW] bool: tiles that are drawn."""
    colors: Floats = field(repr=False)
    """[H, W, 3] float32."""
    alphas: Floats = field(repr=False)
    """[H, W] float32."""
    depths: Floats = field(repr=False)
    """[H, W] float32 expected z-depth."""
    view: ProjectedView | None = field(default=None, repr=False)
    """The Gaussians in these tiles, and in those that were asked for beside them; None where nobody asked to keep
    it."""
    full_view: Callable[[], ProjectedView] | None = field(default=None, repr=False)
    """Puts the view of all tiles together, where `after` had one to begin with; holds none of the Gaussians."""

    @staticmethod
    def of(
        splats: Splats,
        camera: Camera,
        tiles: Bools | None = None,
        beside: np.ndarray | None = None,
        view: ProjectedView | None = None,
        *,
        keep: bool = False,
    ) -> PartialRender:
        """tiles: [TH, TW] bool; None: all of them; beside: more that the `view` is to have; view: one of the splats
        that has these, if at hand; keep: whether a view of all tiles is kept, about 150 bytes per Gaussian. Raises
        ValueError for sizes that `render` does not draw."""
        from splatpainter.rendering.cpu.projected_view import project, tile_shape
        from splatpainter.rendering.cpu.recent_views import drawn_view, recent_drawing, recent_view

        everywhere = np.ones(tile_shape(camera), bool)
        if tiles is None or tiles.all():
            at_hand = recent_view(splats, camera)  # held by another
            drawn = drawn_view(splats, camera)
            pictures = (drawn.colors, drawn.alphas, drawn.depths)
            return PartialRender(splats, camera, everywhere, *pictures, drawn.view if keep else at_hand)
        check_views([camera])
        if view is None:
            view = project(splats, camera, tiles=tiles if beside is None else tiles | beside)
        drawn = recent_drawing(splats, camera)
        pictures = view.rasterize(tiles=tiles) if drawn is None else drawn.within(tiles)
        return PartialRender(splats, camera, tiles, *pictures, None if beside is None else view)

    def with_tiles(self, tiles: np.ndarray) -> PartialRender:
        """These tiles ([TH, TW] bool) drawn too."""
        missing = tiles & ~self.tiles
        return self._redrawn(self.splats, missing, self.view) if missing.any() else self

    def after(self, splats: Splats, changed: np.ndarray) -> tuple[PartialRender, PartialRender]:
        """(this with all tiles that differ, what `splats` show, drawn in the same tiles). splats: the same Gaussians at
        the same indices, of which `changed` ([T] int) have other values, and any number of further ones."""
        from splatpainter.rendering.cpu.projected_view import project

        count, tiles = len(self.splats), np.zeros(self.tiles.shape, bool)
        old, new = changed, np.concatenate([changed, np.arange(count, len(splats))])
        if self.view is not None:
            entries = self.view.entries.take(changed)
            tiles |= self.view.touched_tiles(entries[entries >= 0])
            old = changed[entries < 0]
        view = self._recolored(splats, old)
        if view is not None:
            before, recolored = self.with_tiles(tiles), view
            return before, replace(before._redrawn(splats, tiles, view), full_view=lambda: recolored)
        new = new[splats.opacities[new] > 0]
        if len(old):
            tiles |= project(self.splats.take(old), self.camera).tiles_of(np.ones(len(old), bool))
        fresh = project(splats.take(new), self.camera)
        tiles |= fresh.tiles_of(np.ones(len(new), bool))
        before = self.with_tiles(tiles)
        if not tiles.any():
            return before, replace(before, splats=splats)
        full_view = None
        if self.view is not None and self._has(self.view, tiles):
            fresh = replace(fresh, gaussian_ids=new[fresh.gaussian_ids], num_gaussians=len(splats))
            # Only what changed is put together now; whoever draws all of it again may ask for the rest.
            # Of a twin: nobody finds it by the arrays of the Gaussians, which may be written to by then.
            full_view = partial(self.view.twin().merged, fresh, without=changed) if self.view.tiles.all() else None
            view = self.view.merged(fresh.part(tiles=tiles), tiles=tiles, without=changed)
        return before, replace(before._redrawn(splats, tiles, view), full_view=full_view)

    def _recolored(self, splats: Splats, unseen: np.ndarray) -> ProjectedView | None:
        """The view where nothing but colours changed. unseen: [U] int Gaussians that changed and are not in it."""
        from splatpainter.rendering.cpu.projected_view import project

        geometry = [name for name in ATTRIBUTES if name != "sh"]
        same = all(getattr(splats, name) is getattr(self.splats, name) for name in geometry)
        if self.view is None or not self.view.tiles.all() or not same or splats.antialiased != self.splats.antialiased:
            return None
        # One whose coefficients were out of range may be drawn now.
        if len(unseen) and len(project(splats.take(unseen), self.camera, tiles=self.view.tiles)):
            return None
        return self.view.recolored(splats)

    @staticmethod
    def _has(view: ProjectedView, tiles: np.ndarray) -> bool:
        """Whether a view can show these tiles."""
        return not (tiles & ~view.tiles).any()

    def _redrawn(self, splats: Splats, tiles: np.ndarray, view: ProjectedView | None = None) -> PartialRender:
        """What it shows is of `splats` in these tiles, and as it was in all others. view: of `splats`, if at hand."""
        from splatpainter.kernels.arrays import copied
        from splatpainter.rendering.cpu.projected_view import project

        if view is None or not self._has(view, tiles):
            if tiles.all():
                return PartialRender.of(splats, self.camera, tiles)
            view = project(splats, self.camera, tiles=tiles)
        pictures = {name: copied(getattr(self, name)) for name in ("colors", "alphas", "depths")}
        view.redraw(tiles, *(pictures[name] for name in ("colors", "alphas", "depths")))
        return replace(self, splats=splats, tiles=self.tiles | tiles, **pictures, view=None)
