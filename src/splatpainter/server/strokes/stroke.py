"""A stroke while it is drawn: what was painted so far on one view, and quick previews of it on the Gaussians.

The view is projected once per stroke; a dab costs a few colour rounds of the lift over the tiles around it, cut out of
that view. Previews change colours of Gaussians that are there; when the pen goes up, the chosen method does the real
edit from `picture()`.
"""

from __future__ import annotations

import weakref
from dataclasses import field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import from_display, to_display
from splatpainter.kernels.spare_copies import SpareCopy, spare_copies
from splatpainter.lift.colors import MAX_COLOR, recolor
from splatpainter.lift.local.local_edit import MIN_VISIBLE_SHARE
from splatpainter.lift.local.patch import MIN_INSIDE_SMALL, MIN_PIXEL_SHARE
from splatpainter.lift.sheets.paint import sight_under
from splatpainter.rendering.cpu.geometry import TILE
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.recent_views import DrawnView, drawn_view
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.session import Session
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.recent_sights import note_sight
from splatpainter.surface.visible import SightEstimates
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

SIRT_STEPS = 3
"""Per dab; the next dab beside it continues them."""
DAB_MARGIN_PX = 24
"""Pixels around a dab, for the Gaussians which straddle its edge."""
MIN_COLOR_CHANGE = 1 / 512
"""Smaller changes of a Gaussian's colour are not sent."""


@dataclass(frozen=True)
class LookLimits:
    """When the surface under a stroke is looked at while it is drawn."""

    patches: int = 4
    """New patches from which it is looked at again. A look costs some 8 ms besides what is new; of twelve patches the
    edit is left three at most. A text or a picture comes as one and is left to the edit, which would wait for it."""


LOOKS = LookLimits()
Box = tuple[int, int, int, int]
"""Pixels of a view: left, top, right, bottom."""


@dataclass
class _Canvas:
    """The stroke on one version of the asset. M Gaussians are in the view."""

    version: int
    drawn: DrawnView
    """The render without the stroke."""
    splats: Splats
    """Those of this version."""
    erased: np.ndarray
    """[H, W, 3] the original's render (of an erasing stroke; else the base)."""
    target: np.ndarray
    """[H, W, 3] the base with the stroke on it."""
    weights: np.ndarray
    """[M] of each Gaussian, summed over the view's pixels."""
    colors: np.ndarray
    """[M, 3] as previewed."""
    sent: np.ndarray
    """[M, 3] as last sent."""
    movable: np.ndarray = field(repr=False)
    """[M] bool."""
    entries: np.ndarray = field(repr=False)
    """[N] int32 the view's entry of each Gaussian that is in it."""

    @property
    def view(self) -> ProjectedView:
        return self.drawn.view


class Stroke:
    """One stroke of one page; used by one thread at a time."""

    def __init__(
        self,
        camera: Camera,
        erase: bool = False,
        session: Session | None = None,
        beneath: Splats | None = None,
        selected: np.ndarray | None = None,
    ) -> None:
        """session: what it is drawn on (`belongs_to`). Versions are numbers of one session: of another one, `version`
        may be the same and every Gaussian different. beneath: of an eraser of one layer, what comes out; None: the
        original. selected: [H, W] float32 0..1, what of the view may be painted; None: all of it."""
        self.camera, self.erase, self._beneath, self._selected = camera, erase, beneath, selected
        self.masks = False
        """Whether it paints the mask of a layer."""
        self._session = None if session is None else weakref.ref(session)
        self.rgba = np.zeros((camera.height, camera.width, 4), np.uint8)
        self._canvas: _Canvas | None = None
        self._sight: SightEstimates | None = None
        self._copies: tuple[SpareCopy, ...] = ()
        self._patches = self._looked = 0
        """Patches so far, and when the surface was looked at last."""
        self._grows = True
        """Whether all that was painted still is: not of a text that is moved about."""

    def belongs_to(self, session: Session) -> bool:
        """Whether it was begun on this session, and not on one that was replaced since."""
        return self._session is not None and self._session() is session

    def prepare(self, splats: Splats, original: Splats, version: int) -> None:
        """Project the asset (numpy) as it now is, unless that was done for this version."""
        # Projecting is the expensive part, so it is done once for each version of the asset.
        if self._canvas is not None and self._canvas.version == version:
            return
        # The edit at the end of the stroke takes the same view, and need neither project nor draw it again.
        drawn = drawn_view(splats, self.camera)
        view, base = drawn.view, drawn.colors
        erased = project(self._beneath or original, self.camera).rasterize()[0] if self.erase else base
        # The weights of the whole view say later how much of a Gaussian lies under the stroke.
        everywhere = np.ones(base.shape[:2], np.float32)
        weights = view.backproject(np.zeros_like(base), everywhere).weight
        colors = np.maximum(view.unclamped_colors, 0)
        movable = np.zeros(len(view), bool)
        self._canvas = _Canvas(
            version,
            drawn,
            splats,
            erased,
            base.copy(),
            weights,
            colors.copy(),
            colors.copy(),
            movable,
            view.entries,
        )

    def patch(self, x: int, y: int, width: int, height: int, rgba: bytes) -> Box:
        """Put pixels (straight alpha, 8 bits) in their rectangle; returns it. Raises
        ValueError where it is not inside the view, or the bytes are not that many."""
        # Checked against the view before anything is written: the numbers come from a page.
        if x + width > self.camera.width or y + height > self.camera.height:
            size = f"{self.camera.width}x{self.camera.height}"
            corner = f"{brief(x)}, {brief(y)}"
            raise ValueError(f"dab: expected a rectangle inside the view of {size}, got {width}x{height} at {corner}")
        if len(rgba) != width * height * 4:
            raise ValueError(f"dab: expected {width * height * 4} bytes of RGBA, got {len(rgba)}")
        patch = np.frombuffer(rgba, np.uint8).reshape(height, width, 4)
        # Outside of what is selected nothing is painted, however the page drew it.
        if self._selected is not None:
            patch, part = patch.copy(), self._selected[y : y + height, x : x + width]
            patch[..., 3] = np.round(patch[..., 3] * part)
        window = self.rgba[y : y + height, x : x + width]
        self._grows = self._grows and not ((window[..., 3] > 0) & (patch[..., 3] == 0)).any()
        window[...] = patch
        self._patches += 1
        return x, y, x + width, y + height

    def preview(self, splats: Splats, original: Splats, version: int, box: Box) -> tuple[np.ndarray, np.ndarray]:
        """([C] int64 ascending Gaussians whose colours changed since the last preview, [C, K, 3] their SH), after new
        pixels in `box`. A changed asset (another version) is projected again, and all of the stroke shown on it."""
        # Another version has other Gaussians: all of the stroke is shown anew on them.
        if self._canvas is None or self._canvas.version != version:
            self.prepare(splats, original, version)
            box = (0, 0, self.camera.width, self.camera.height)
        canvas = self._canvas
        assert canvas is not None
        view = canvas.view
        inside = _slices(box)
        alpha = self.rgba[inside][..., 3:].astype(np.float32) / 255
        painted = canvas.erased[inside]
        # Erasing shows the original there; paint shows its own colour.
        if not self.erase:
            painted = from_display(self.rgba[inside][..., :3].astype(np.float32) / 255, splats.color_space)
        canvas.target[inside] = (1 - alpha) * canvas.drawn.colors[inside] + alpha * painted
        moved = self._lift(canvas, _grown(box, self.camera))
        # Only what changed visibly is sent: previews go out with every dab. The others have the colours of before, and
        # were judged then.
        change = np.abs(canvas.colors.take(moved, 0) - canvas.sent.take(moved, 0))
        changed = moved[row_max(change) > MIN_COLOR_CHANGE]
        canvas.sent[changed] = canvas.colors.take(changed, 0)
        # Frames want their Gaussians in ascending order.
        changed = changed[np.argsort(view.gaussian_ids[changed], kind="stable")]
        ids = view.gaussian_ids[changed]
        return ids, recolor(splats.sh.take(ids, 0), view.unclamped_of(changed), canvas.colors.take(changed, 0))

    def _lift(self, canvas: _Canvas, box: Box) -> np.ndarray:
        """SIRT steps on the colours within a window of the view. Returns [E] the view's entries that they moved."""
        view, window = canvas.view, _slices(box)
        everywhere, painted = np.zeros((2, *self.rgba.shape[:2]), np.float32)
        # The window limits the work, the painted pixels what is to change.
        everywhere[window], painted[window] = 1, self.rgba[window][..., 3] > 0
        tiles = np.zeros(view.tiles.shape, bool)
        tiles[box[1] // TILE : -(-box[3] // TILE), box[0] // TILE : -(-box[2] // TILE)] = True
        # Only the tiles around the dab: the rest of the view has not changed.
        small = view.part(tiles=tiles)
        entries, target = canvas.entries.take(small.gaussian_ids), canvas.target
        sums = small.backproject(target, painted)
        # A Gaussian moves if the paint reaches it visibly and enough of it lies inside; else colour would leak.
        reached = np.flatnonzero((sums.peak > MIN_PIXEL_SHARE) & (sums.weight > MIN_VISIBLE_SHARE * sums.alpha))
        weights = canvas.weights.take(entries.take(reached))
        reached = reached[sums.weight.take(reached) > MIN_INSIDE_SMALL * weights]
        canvas.movable[entries.take(reached)] = True
        movable = canvas.movable.take(entries)
        moved = entries[movable]
        colors, ceiling = canvas.colors.take(moved, 0), np.maximum(view.unclamped_of(moved), MAX_COLOR)
        sirt = sirt_steps(small, target, everywhere, movable, colors)
        step = 1 / np.maximum(sirt.weight, 1e-6)[:, None]
        # A few steps are enough for a preview; the next dab goes on from there.
        for _ in range(SIRT_STEPS):
            colors = np.clip(colors + step * sirt.residual(colors), 0, ceiling).astype(np.float32)
        canvas.colors[moved] = colors
        return moved

    @property
    def has_grown(self) -> bool:
        """Whether enough was painted to look at the surface under it (again)."""
        enough = self._patches >= self._looked + LOOKS.patches
        return enough and self._grows and not (self.erase or self.masks)

    def look(self, surface: Surface) -> bool:
        """Ask the surface what the edit at the end will ask, under what was painted so far, beside the thread that
        draws; whether there was enough new. The edit finds it as long as this stroke is there."""
        # Taken once: the other thread may draw on, or project another version.
        canvas, patches = self._canvas, self._patches
        if canvas is None or not self.has_grown:
            return False
        alphas = canvas.drawn.alphas
        sight = sight_under(canvas.splats, surface, canvas.view, alphas, self.mask, self._sight)
        self._looked = patches
        if sight is not None:
            self._sight = sight
            note_sight(surface, canvas.view.camera, sight)
        return True

    def copy_ahead(self) -> None:
        """Copy the large arrays that the edit at the end will write into, beside the thread that draws. The edit finds
        the copies as long as this stroke is there."""
        canvas = self._canvas
        if canvas is not None and not (self.erase or self.masks):
            self._copies = spare_copies(canvas.splats)

    @property
    def base(self) -> np.ndarray:
        """[H, W, 3] the render without the stroke, in the asset's colour space; `prepare` first."""
        assert self._canvas is not None
        return self._canvas.drawn.colors

    @property
    def mask(self) -> np.ndarray:
        """[H, W] bool: painted pixels."""
        return self.rgba[..., 3] > 0

    @property
    def cover(self) -> np.ndarray:
        """[H, W] float32 0..1 how thick the paint is, over the thickest: less along soft edges, not for all of a
        glaze."""
        alpha = self.rgba[..., 3].astype(np.float32)
        return alpha / max(float(alpha.max()), 1.0)

    def picture(self, splats: Splats, original: Splats, version: int) -> np.ndarray:
        """[H, W, 3] display colours 0..1: the stroke over the asset's own render."""
        self.prepare(splats, original, version)
        assert self._canvas is not None
        return self.over(to_display(self._canvas.drawn.colors, splats.color_space))

    def over(self, render: np.ndarray) -> np.ndarray:
        """[H, W, 3] display colours 0..1: the stroke over a picture of the view ([H, W, 3] display colours)."""
        out = np.ascontiguousarray(np.clip(render, 0, 1))
        # A stroke covers little of the view; the rest is the picture as it is.
        at = np.flatnonzero(self.rgba[..., 3])
        rgba = self.rgba.reshape(-1, 4).take(at, 0).astype(np.float32) / 255
        alpha, below = rgba[:, 3:], render.reshape(-1, 3).take(at, 0)
        out.reshape(-1, 3)[at] = np.clip(below * (1 - alpha) + rgba[:, :3] * alpha, 0, 1)
        return out


def _slices(box: Box) -> tuple[slice, slice]:
    left, top, right, bottom = box
    return slice(top, bottom), slice(left, right)


def _grown(box: Box, camera: Camera) -> Box:
    left, top, right, bottom = box
    return (
        max(left - DAB_MARGIN_PX, 0),
        max(top - DAB_MARGIN_PX, 0),
        min(right + DAB_MARGIN_PX, camera.width),
        min(bottom + DAB_MARGIN_PX, camera.height),
    )
