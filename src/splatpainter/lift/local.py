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
from splatpainter.render.cpu.frame import Frame, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats


@dataclass(frozen=True)
class LocalOptions:
    """How a local lift trades detail for rows."""

    rounds: int = 8
    """Colour rounds after splitting."""
    goal: float = 1.0
    """Children are split down to this standard deviation, in pixels of the edited view."""
    tolerance: float = 0.03
    """A row is split if the wanted change varies over its footprint by more than this standard deviation (0..1)."""
    share: float = 0.05
    """Only rows that give some masked pixel at least this share of its colour are split."""
    levels: int = 4
    """Most rounds of splitting (each divides a row's width by up to 3.6 per axis)."""
    budget: int = 100_000
    """Most rows that one edit may append."""
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
    reached = reached_rows(splats, camera, mask, allowed)
    area = project(splats, camera, rows=reached).tiles_of(reached)
    rows = np.sort(project(splats, camera, tiles=area).rows)
    work = _Patch.start(splats.take(rows), camera, area, target, mask, reached[rows])
    for _ in range(options.levels):
        coarse = work.too_coarse(options)
        if not coarse.any():
            break
        work = work.split(coarse, options)
    return _assemble(splats, rows, work.colored(options), work)


def reached_rows(splats: Splats, camera: Camera, mask: np.ndarray, allowed: np.ndarray | None = None) -> np.ndarray:
    """[N] bool rows that visibly contribute to the masked pixels ([H, W] bool). Raises ValueError where none do."""
    frame = project(splats, camera, tiles=tiles_of_mask(mask))
    sums = frame.accumulate(np.zeros((*mask.shape, 3), np.float32), mask.astype(np.float32))
    good = (sums.peak > FAINTEST) & (sums.weight > VISIBLE * sums.alpha)
    reached = np.zeros(frame.count, bool)
    reached[frame.rows[good]] = True
    if allowed is not None:
        reached &= allowed
    if not reached.any():
        raise ValueError(
            "edit: no row of the asset contributes to the masked pixels; paint on the asset, or check the camera"
        )
    return reached


@dataclass(frozen=True)
class _Patch:
    """The rows around an edit while they are being split: S current rows, children of the patch's first rows."""

    splats: Splats
    frame: Frame
    wanted: np.ndarray
    """[H, W, 3] the picture to reach: the edit inside the mask, the first render outside."""
    change: np.ndarray
    """[H, W, 3] wanted minus the first render; 0 outside the mask."""
    mask: np.ndarray
    """[H, W] float32 0 or 1: where the edit counts."""
    drawn: np.ndarray
    """[H, W] float32 0 or 1: pixels of the tiles in work."""
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
        drawn = np.repeat(np.repeat(area, 16, 0), 16, 1)[: camera.height, : camera.width]
        inside = mask & drawn & (alpha > 0.02)
        change = np.where(inside[..., None], target - image, 0).astype(np.float32)
        every = np.arange(len(splats))
        return _Patch(
            splats,
            frame,
            image + change,
            change,
            inside.astype(np.float32),
            drawn.astype(np.float32),
            editable,
            every,
            np.ones(len(splats), bool),
        )

    def too_coarse(self, options: LocalOptions) -> np.ndarray:
        """[S] bool rows over whose footprint the wanted change varies too much, if they are large enough to split."""
        frame = self.frame
        energy = (self.change**2).mean(-1)
        over = frame.accumulate(np.stack([energy, self.mask, self.mask], -1), self.drawn)
        inside = frame.accumulate(self.change, self.mask)
        total = np.maximum(over.weight, 1e-6)
        spread = over.values[:, 0] / total - ((inside.values / total[:, None]) ** 2).mean(1)
        rows = frame.rows
        able = self.editable[rows] & (inside.peak > options.share) & (spread > options.tolerance**2)
        able[able] = projected_sizes(self.splats.take(rows[able]), frame.camera).max(1) > options.goal * 1.15
        room = options.budget - int((~self.slot).sum())
        if 8 * able.sum() > room:  # keep the rows with most to gain (a split adds about eight rows)
            gain = np.where(able, spread * total, 0)
            able &= gain >= np.partition(gain, -max(room // 8, 1))[-max(room // 8, 1)]
        out = np.zeros(len(self.splats), bool)
        out[rows[able]] = room > 0
        return out

    def split(self, coarse: np.ndarray, options: LocalOptions) -> _Patch:
        """Replace the coarse rows by their children."""
        kept, parents = np.flatnonzero(~coarse), np.flatnonzero(coarse)
        children, index = split(self.splats.take(parents), self.frame.camera, options.goal)
        source = np.concatenate([kept, parents[index]])
        first = np.concatenate([np.ones(len(kept), bool), np.diff(index, prepend=-1) > 0])
        splats = self.splats.take(kept).append(children)
        return replace(
            self,
            splats=splats,
            frame=project(splats, self.frame.camera, tiles=self.frame.tiles),
            editable=self.editable[source],
            owner=self.owner[source],
            slot=self.slot[source] & first,
        )

    def colored(self, options: LocalOptions) -> np.ndarray:
        """[S, K, 3] SH after the colour rounds; rows that did not move keep their bits."""
        frame, rows = self.frame, self.frame.rows
        inside = frame.accumulate(self.change, self.mask)
        whole = frame.accumulate(self.change, self.drawn).weight
        # A large row left whole (too faint to split) would drag paint over the mask's edge.
        large = projected_sizes(self.splats.take(rows), frame.camera).max(1) > 3 * options.goal
        least = np.where(large, 0.6, 0.05)
        movable = self.editable[rows] & (inside.peak > FAINTEST) & (inside.weight > least * whole)
        seen = frame.raw_colors
        colors, _ = lift_colors(frame, self.wanted, self.drawn, movable, options.rounds)
        moved = movable & (np.abs(colors - np.maximum(seen, 0)).max(1) > 1 / 1024)
        sh = self.splats.sh.copy()
        sh[rows[moved]] = recolor(sh[rows[moved]], seen[moved], colors[moved], options.damping)
        return sh


def _assemble(splats: Splats, rows: np.ndarray, sh: np.ndarray, work: _Patch) -> Lifted:
    """Put the patch's rows back: slots in place, the others appended."""
    new = replace(work.splats, sh=sh)
    place = rows[work.owner[work.slot]]  # [S'] rows of the asset that the slots go back to
    inner = new.take(np.flatnonzero(work.slot))
    changed = np.zeros(len(place), bool)
    for name in ATTRIBUTES:
        differs = getattr(inner, name) != getattr(splats, name)[place]
        changed |= differs.reshape(len(place), -1).any(1)
    touched = np.sort(place[changed])
    written = {}
    for name in ATTRIBUTES:
        values = getattr(inner, name)[changed]
        if np.array_equal(values, getattr(splats, name)[place[changed]]):
            continue
        whole = getattr(splats, name).copy()
        whole[place[changed]] = values
        written[name] = whole
    result = replace(splats, **written)
    appended = np.flatnonzero(~work.slot)
    if len(appended):
        result = result.append(new.take(appended))
    return Lifted(result, touched, rows[work.owner[appended]])
