"""Local lift: an edited region of one view is written onto the rows that make it; those too coarse for it are split.

Works on the tiles and rows that the edit reaches, so a brush dab costs milliseconds. Outside the mask the wanted
picture is the current render: a row that straddles the mask's edge is held by its whole footprint, not painted along
its whole length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import lift_colors, recolor
from splatpainter.lift.split import projected_sizes, split
from splatpainter.render.cpu.frame import Frame, Sums, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats


@dataclass(frozen=True)
class LocalOptions:
    """How a local lift trades detail for rows."""

    rounds: int = 8
    """Colour rounds after splitting; 0: split only."""
    goal: float = 1.0
    """Children are split down to this standard deviation, in pixels of the edited view."""
    tolerance: float = 0.03
    """A row is split if the wanted change varies over its footprint by more than this standard deviation (0..1)."""
    share: float = 0.05
    """Only rows that give some masked pixel at least this share of its colour are split."""
    levels: int = 4
    """Most rounds of splitting (each divides a row's width by up to 3.6 per axis)."""
    budget: int = 100_000
    """About how many rows one edit may append at most."""
    damping: float = 0.3
    """What is left of SH bands >= 1 in a fully repainted row, 0..1."""


@dataclass(frozen=True)
class Lifted:
    """Result of a lift."""

    splats: Splats
    """N rows with the old ones in their old places, then the appended ones."""
    touched: np.ndarray
    """[T] int64 ascending: old rows of which any attribute changed."""
    appended: np.ndarray
    """[A] int64: the old row that each appended row was split from."""


VISIBLE = 0.05
"""Mean share of a row that must reach the camera inside the mask (weight / alpha), or it is behind the surface."""
FAINTEST = 0.004
"""A row whose largest share of any masked pixel is below this is not written (1/255)."""
LARGE = 3.0
"""Rows wider than this many goals drag paint over the mask's edge when they are too faint to be split, ..."""
INSIDE = 0.6
"""... so they are written only if this share of their weight lies inside the mask."""
INSIDE_SMALL = 0.05
"""The same for small rows: those at the mask's edge settle between both sides."""


def lift_local(
    splats: Splats,
    camera: Camera,
    target: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions = LocalOptions(),
    allowed: np.ndarray | None = None,
) -> Lifted:
    """Write the masked pixels of `target` onto the splats.

    target: [H, W, 3] float32 0..1; mask: [H, W] bool; allowed: [N] bool rows that may change (default: all).
    Raises ValueError when no row contributes to the masked pixels."""
    frame = project(splats, camera, tiles=tiles_of_mask(mask))
    reached = reached_rows(splats, camera, mask, allowed, frame)
    editable = reached & ~_hopeless(splats, frame, mask, reached, options)
    area = project(splats, camera, rows=editable).tiles_of(editable)
    rows = np.sort(project(splats, camera, tiles=area).rows)
    patch = _Patch.start(splats.take(rows), camera, area, target, mask, editable[rows])
    for _ in range(options.levels):
        coarse = patch.too_coarse(options)
        if not coarse.any():
            break
        patch = patch.split(coarse, options)
    return _assemble(splats, rows, patch.colored(options), patch)


def reached_rows(
    splats: Splats, camera: Camera, mask: np.ndarray, allowed: np.ndarray | None = None, frame: Frame | None = None
) -> np.ndarray:
    """[N] bool rows that visibly contribute to the masked pixels ([H, W] bool). frame: the splats projected onto the
    mask's tiles, if at hand. Raises ValueError where there is no such row."""
    frame = frame or project(splats, camera, tiles=tiles_of_mask(mask))
    sums = _inside(frame, np.zeros((*mask.shape, 3), np.float32), mask)
    reached = np.zeros(frame.count, bool)
    reached[frame.rows[(sums.peak > FAINTEST) & (sums.weight > VISIBLE * sums.alpha)]] = True
    if allowed is not None:
        reached &= allowed
    if not reached.any():
        raise ValueError(
            "edit: no row of the asset contributes to the masked pixels; paint on the asset, or check the camera"
        )
    return reached


def _inside(frame: Frame, values: np.ndarray, mask: np.ndarray) -> Sums:
    return frame.accumulate(values, mask.astype(np.float32))


def _hopeless(splats: Splats, frame: Frame, mask: np.ndarray, reached: np.ndarray, options: LocalOptions) -> np.ndarray:
    """[N] bool: reached rows that would be held back in the end (LARGE, too faint to split, mostly outside the mask),
    as far as the mask's own tiles can tell. Without them less of the picture is in work."""
    nothing = np.zeros((*mask.shape, 3), np.float32)
    inside = _inside(frame, nothing, mask)
    whole = _inside(frame, nothing, np.ones(mask.shape, bool)).weight
    faint = reached[frame.rows] & (inside.peak <= options.share) & (inside.weight < INSIDE * whole)
    faint[faint] = projected_sizes(splats.take(frame.rows[faint]), frame.camera).max(1) > LARGE * options.goal
    out = np.zeros(len(splats), bool)
    out[frame.rows[faint]] = True
    return out if (reached & ~out).any() else np.zeros(len(splats), bool)


@dataclass(frozen=True)
class _Patch:
    """The rows around an edit while they are being split: S current rows, children of the patch's first rows."""

    splats: Splats
    frame: Frame
    """Of the tiles that editable rows touch; fewer from split to split."""
    wanted: np.ndarray
    """[H, W, 3] the picture to reach: the edit inside the mask, the first render outside."""
    change: np.ndarray
    """[H, W, 3] wanted minus the first render; 0 outside the mask."""
    mask: np.ndarray
    """[H, W] bool: where the edit counts."""
    editable: np.ndarray
    """[S] bool."""
    owner: np.ndarray
    """[S] index of the first row that each came from."""
    slot: np.ndarray
    """[S] bool: rows that take their owner's place in the file; the others are appended."""

    @staticmethod
    def start(
        splats: Splats, camera: Camera, area: np.ndarray, target: np.ndarray, mask: np.ndarray, editable: np.ndarray
    ) -> _Patch:
        frame = project(splats, camera, tiles=area)
        image, alpha, _ = frame.draw()
        inside = mask & (alpha > 0.02)  # tiles that are not drawn have none
        change = np.where(inside[..., None], target - image, 0).astype(np.float32)
        every = np.arange(len(splats))
        return _Patch(splats, frame, image + change, change, inside, editable, every, np.ones(len(splats), bool))

    def too_coarse(self, options: LocalOptions) -> np.ndarray:
        """[S] bool rows over whose footprint the wanted change varies too much, if they are large enough to split."""
        frame = self.frame
        energy = np.repeat((self.change**2).mean(-1, keepdims=True), 3, 2)
        over = _inside(frame, energy, np.ones(self.mask.shape, bool))  # of undrawn tiles nothing is counted
        inside = _inside(frame, self.change, self.mask)
        total = np.maximum(over.weight, 1e-6)
        spread = over.values[:, 0] / total - ((inside.values / total[:, None]) ** 2).mean(1)
        rows = frame.rows
        able = self.editable[rows] & (inside.peak > options.share) & (spread > options.tolerance**2)
        able[able] = projected_sizes(self.splats.take(rows[able]), frame.camera).max(1) > options.goal * 1.15
        room = options.budget - int((~self.slot).sum())
        most = max(room // 8, 0)  # a split adds about eight rows
        if able.sum() > most:  # keep those with most to gain
            gain = np.where(able, spread * total, 0)
            able &= gain >= (np.partition(gain, -most)[-most] if most else np.inf)
        out = np.zeros(len(self.splats), bool)
        out[rows[able]] = True
        return out

    def split(self, coarse: np.ndarray, options: LocalOptions) -> _Patch:
        """Replace the coarse rows by their children; those without paint inside the mask are no longer editable."""
        kept, parents = np.flatnonzero(~coarse), np.flatnonzero(coarse)
        children, index = split(self.splats.take(parents), self.frame.camera, options.goal)
        source = np.concatenate([kept, parents[index]])
        first = np.concatenate([np.ones(len(kept), bool), np.diff(index, prepend=-1) > 0])
        splats = self.splats.take(kept).append(children)
        frame = project(splats, self.frame.camera, tiles=self.frame.tiles)
        painted = np.zeros(len(splats), bool)
        painted[frame.rows] = _inside(frame, self.change, self.mask).peak > FAINTEST
        editable = self.editable[source] & painted
        tiles = frame.tiles_of(editable)
        if tiles.sum() < 0.8 * frame.tiles.sum():
            frame = project(splats, self.frame.camera, tiles=tiles)
        return replace(
            self,
            splats=splats,
            frame=frame,
            editable=editable,
            owner=self.owner[source],
            slot=self.slot[source] & first,
        )

    def movable(self, options: LocalOptions) -> np.ndarray:
        """[M] bool rows of the frame that may take new colours."""
        rows = self.frame.rows
        inside = _inside(self.frame, self.change, self.mask)
        whole = _inside(self.frame, self.change, np.ones(self.mask.shape, bool)).weight
        able = self.editable[rows] & (inside.peak > FAINTEST)
        large = np.zeros(len(rows), bool)
        sizes = projected_sizes(self.splats.take(rows[able]), self.frame.camera).max(1)
        large[able] = sizes > LARGE * options.goal
        return able & (inside.weight > np.where(large, INSIDE, INSIDE_SMALL) * whole)

    def colored(self, options: LocalOptions) -> np.ndarray:
        """[S, K, 3] SH after the colour rounds; rows that did not move keep their bits."""
        frame, rows = self.frame, self.frame.rows
        movable = self.movable(options)
        everywhere = np.ones(self.mask.shape, np.float32)
        colors, _ = lift_colors(frame, self.wanted, everywhere, movable, options.rounds)
        seen = frame.raw_colors
        moved = movable & (np.abs(colors - np.maximum(seen, 0)).max(1) > 1 / 1024)
        sh = self.splats.sh.copy()
        sh[rows[moved]] = recolor(sh[rows[moved]], seen[moved], colors[moved], options.damping)
        return sh


def _assemble(splats: Splats, rows: np.ndarray, sh: np.ndarray, patch: _Patch) -> Lifted:
    """Put the patch's rows back: slots in place, the others appended."""
    new = replace(patch.splats, sh=sh)
    place = rows[patch.owner[patch.slot]]  # rows of the asset that the slots go back to
    inner = new.take(np.flatnonzero(patch.slot))
    changed = np.zeros(len(place), bool)
    for name in ATTRIBUTES:
        differs = getattr(inner, name) != getattr(splats, name)[place]
        changed |= differs.reshape(len(place), -1).any(1)
    written = {}
    for name in ATTRIBUTES:
        values = getattr(inner, name)[changed]
        if np.array_equal(values, getattr(splats, name)[place[changed]]):
            continue
        whole = getattr(splats, name).copy()
        whole[place[changed]] = values
        written[name] = whole
    result = replace(splats, **written)
    appended = np.flatnonzero(~patch.slot)
    if len(appended):
        result = result.append(new.take(appended))
    return Lifted(result, np.sort(place[changed]), rows[patch.owner[appended]])
