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
from splatpainter.lift.detail import detail_rows, grown
from splatpainter.lift.evidence import Evidence
from splatpainter.lift.split import Lattice, projected_sizes
from splatpainter.rendering.cpu.projected_view import TILE, Backprojection, ProjectedView, project, tiles_of_mask
from splatpainter.splats import ATTRIBUTES, Splats


@dataclass(frozen=True)
class LocalOptions:
    """How a local lift trades detail for rows."""

    rounds: int = 8
    """Colour rounds after splitting; 0: split only, no colours and no detail layer."""
    goal: float = 2.0
    """Rows are halved until they are about this wide (standard deviation, pixels of the edited view)."""
    tolerance: float = 0.1
    """A row is halved if the wanted change varies over its footprint by more than this standard deviation (0..1)."""
    share: float = 0.05
    """Only rows that give some masked pixel at least this share of its colour are halved."""
    levels: int = 7
    """Most halvings of a row."""
    budget: int = 40_000
    """About how many rows splitting may append at most."""
    detail: float = 0.03
    """Pixels that are further than this from the picture afterwards get a row of their own; 1: none do."""
    rim: int = 24
    """Pixels around the mask that the detail layer may mend."""
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
SOLID = 0.9
"""Detail rows are nearly opaque: less covered pixels, such as a silhouette's, would gain alpha from one."""
RIM = 3
"""Pixels from what lies beside the asset within which there are no detail rows: what is wrong there is mostly the
outline, and rows that mend it stand off the surface, in the background's colour, for views from other sides. On 29
painted training meshes, near them: 24.3 dB with such rows, 26.2 without; in the edited views 32.4 and 32.6."""
FINER = 0.8
"""Above this doubt (Evidence.doubt) about an edit of most of a picture (WIDE), split or not, rows are neither split nor
given a detail layer: detail that is everywhere finer than the asset, as in close-ups, would be right in this view
alone. What is painted on a part is wanted as it is, however fine."""
WIDE = 0.4
"""An edit of a larger share of the picture's pixels than this is one of what it shows as a whole."""
SLACK = 1.4
"""Rows up to this many goals wide are not halved any more: they end between 0.7 and 1.4 goals."""
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
    area = project(splats, camera, gaussian_mask=editable).tiles_of(editable)
    rows = np.sort(project(splats, camera, tiles=area).gaussian_ids)
    patch = _Patch.start(splats.take(rows), camera, area, target, mask, editable[rows])
    whole = patch
    for _ in range(options.levels):
        coarse = patch.too_coarse(options)
        if not coarse.any():
            break
        patch = patch.split(coarse, options)
    wide = mask.mean() > WIDE
    if wide and patch.evidence.doubt > FINER:
        patch = whole
    painted = replace(patch.splats, sh=patch.colored(options))
    detail = None if wide and patch.evidence.doubt > FINER else patch.detail(painted, options)
    return _assemble(splats, rows, painted, patch, detail)


def reached_rows(
    splats: Splats,
    camera: Camera,
    mask: np.ndarray,
    allowed: np.ndarray | None = None,
    frame: ProjectedView | None = None,
) -> np.ndarray:
    """[N] bool rows that visibly contribute to the masked pixels ([H, W] bool). frame: the splats projected onto the
    mask's tiles, if at hand. Raises ValueError where there is no such row."""
    frame = frame or project(splats, camera, tiles=tiles_of_mask(mask))
    sums = _inside(frame, np.zeros((*mask.shape, 3), np.float32), mask)
    reached = np.zeros(frame.num_gaussians, bool)
    reached[frame.gaussian_ids[(sums.peak > FAINTEST) & (sums.weight > VISIBLE * sums.alpha)]] = True
    if allowed is not None:
        reached &= allowed
    if not reached.any():
        raise ValueError(
            "edit: no row of the asset contributes to the masked pixels; paint on the asset, or check the camera"
        )
    return reached


def _inside(frame: ProjectedView, values: np.ndarray, mask: np.ndarray) -> Backprojection:
    return frame.backproject(values, mask.astype(np.float32))


def _hopeless(
    splats: Splats, frame: ProjectedView, mask: np.ndarray, reached: np.ndarray, options: LocalOptions
) -> np.ndarray:
    """[N] bool: reached rows that would be held back in the end (LARGE, too faint to split, mostly outside the mask),
    as far as the mask's own tiles can tell. Without them less of the picture is in work."""
    nothing = np.zeros((*mask.shape, 3), np.float32)
    inside = _inside(frame, nothing, mask)
    whole = _inside(frame, nothing, np.ones(mask.shape, bool)).weight
    faint = reached[frame.gaussian_ids] & (inside.peak <= options.share) & (inside.weight < INSIDE * whole)
    faint[faint] = projected_sizes(splats.take(frame.gaussian_ids[faint]), frame.camera).max(1) > LARGE * options.goal
    out = np.zeros(len(splats), bool)
    out[frame.gaussian_ids[faint]] = True
    return out if (reached & ~out).any() else np.zeros(len(splats), bool)


@dataclass(frozen=True)
class _Patch:
    """The rows around an edit while they are being split."""

    lattice: Lattice
    """Of S rows."""
    splats: Splats
    """The same, as rows."""
    frame: ProjectedView
    """Of the tiles that editable rows touch; fewer from split to split."""
    wanted: np.ndarray
    """[H, W, 3] the picture to reach: the edit inside the mask, the first render outside."""
    change: np.ndarray
    """[H, W, 3] wanted minus the first render; 0 outside the mask."""
    mask: np.ndarray
    """[H, W] bool: where the edit counts."""
    editable: np.ndarray
    """[S] bool."""
    share: np.ndarray
    """[S] largest share of a masked pixel that the row's owner gave at the start."""
    evidence: Evidence
    """Of the frame's rows."""

    @staticmethod
    def start(
        splats: Splats, camera: Camera, area: np.ndarray, target: np.ndarray, mask: np.ndarray, editable: np.ndarray
    ) -> _Patch:
        frame = project(splats, camera, tiles=area)
        image, alpha, _ = frame.rasterize()
        inside = mask & (alpha > 0.02)  # tiles that are not drawn have none
        change = np.where(inside[..., None], target - image, 0).astype(np.float32)
        evidence = Evidence.of(frame, change, inside)
        share = np.zeros(len(splats), np.float32)
        share[frame.gaussian_ids] = evidence.peak
        lattice = Lattice.of(splats, camera)
        return _Patch(lattice, splats, frame, image + change, change, inside, editable, share, evidence)

    def too_coarse(self, options: LocalOptions) -> np.ndarray:
        """[S] bool rows over whose footprint the wanted change varies too much, if they are large enough to split."""
        rows, told = self.frame.gaussian_ids, self.evidence
        able = self.editable[rows] & (told.peak > FAINTEST) & (told.spread > options.tolerance**2)
        able &= self.share[rows] > options.share
        able &= self.lattice.widths.max(1)[rows] > SLACK * options.goal
        room = options.budget - int((~self.lattice.slot).sum())
        most = max(room // 6, 0)  # a split adds about six rows
        if able.sum() > most:  # keep those with most to gain
            gain = np.where(able, told.spread * told.shown, 0)
            able &= gain >= (np.partition(gain, -most)[-most] if most else np.inf)
        out = np.zeros(len(self.splats), bool)
        out[rows[able]] = True
        return out

    def split(self, coarse: np.ndarray, options: LocalOptions) -> _Patch:
        """Halve the coarse rows; children without a share of the mask are no longer editable."""
        lattice, source = self.lattice.halved(coarse, SLACK * options.goal)
        splats = lattice.splats()
        frame = project(splats, self.frame.camera, tiles=self.frame.tiles)
        evidence = Evidence.of(frame, self.change, self.mask)
        painted = np.zeros(len(splats), bool)
        painted[frame.gaussian_ids] = evidence.peak > FAINTEST
        editable = self.editable[source] & painted
        tiles = frame.tiles_of(editable)
        if tiles.sum() < 0.8 * frame.tiles.sum():
            frame = project(splats, self.frame.camera, tiles=tiles)
            evidence = Evidence.of(frame, self.change, self.mask)
        return replace(
            self,
            lattice=lattice,
            splats=splats,
            frame=frame,
            editable=editable,
            share=self.share[source],
            evidence=evidence,
        )

    def movable(self, options: LocalOptions) -> np.ndarray:
        """[M] bool rows of the frame that may take new colours."""
        rows, told = self.frame.gaussian_ids, self.evidence
        able = self.editable[rows] & (told.peak > FAINTEST)
        large = np.zeros(len(rows), bool)
        large[able] = self.lattice.widths.max(1)[rows[able]] > LARGE * options.goal
        return able & (told.inside > np.where(large, INSIDE, INSIDE_SMALL) * told.shown)

    def colored(self, options: LocalOptions) -> np.ndarray:
        """[S, K, 3] SH after the colour rounds; rows that did not move keep their bits."""
        frame, rows = self.frame, self.frame.gaussian_ids
        movable = self.movable(options)
        everywhere = np.ones(self.mask.shape, np.float32)
        hold = self.evidence.hold(frame)
        colors = lift_colors(frame, self.wanted, everywhere, movable, options.rounds, hold)
        seen = frame.unclamped_colors
        moved = movable & (np.abs(colors - np.maximum(seen, 0)).max(1) > 1 / 1024)
        sh = self.splats.sh.copy()
        sh[rows[moved]] = recolor(sh[rows[moved]], seen[moved], colors[moved], options.damping)
        return sh

    def detail(self, painted: Splats, options: LocalOptions) -> tuple[Splats, np.ndarray] | None:
        """(rows, [A] the patch's row that each lies on) of the detail layer over the painted patch, if it needs one."""
        if options.detail >= 1 or options.rounds == 0:
            return None
        camera = self.frame.camera
        frame = project(painted, camera, tiles=self.frame.tiles)
        image, alpha, _ = frame.rasterize()
        wrong = np.abs(self.wanted - np.clip(image, 0, 1)).max(-1) > options.detail
        beside = (alpha < 0.5) & np.kron(frame.tiles, np.ones((TILE, TILE), bool))[: alpha.shape[0], : alpha.shape[1]]
        pixels = wrong & grown(self.mask, options.rim) & (alpha > SOLID) & ~grown(beside, RIM)
        layer = detail_rows(painted, frame, pixels, self.wanted)
        if layer is None:
            return None
        host = frame.gaussian_ids[layer.host]
        both = painted.append(layer.splats)
        frame, count = project(both, camera, tiles=self.frame.tiles), len(painted)
        added = frame.gaussian_ids >= count
        colors = lift_colors(frame, self.wanted, np.ones(self.mask.shape, np.float32), added, options.rounds)
        sh, rows = layer.splats.sh.copy(), frame.gaussian_ids[added] - count
        sh[rows] = recolor(sh[rows], frame.unclamped_colors[added], colors[added], 1.0)
        return replace(layer.splats, sh=sh), host


def _assemble(
    splats: Splats, rows: np.ndarray, new: Splats, patch: _Patch, detail: tuple[Splats, np.ndarray] | None
) -> Lifted:
    """Put the patch's rows back: slots in place, the others appended, then the detail layer."""
    slot, owner = patch.lattice.slot, patch.lattice.owner
    place = rows[owner[slot]]  # rows of the asset that the slots go back to
    inner = new.take(np.flatnonzero(slot))
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
    appended = np.flatnonzero(~slot)
    parents = rows[owner[appended]]
    if len(appended):
        result = result.append(new.take(appended))
    if detail is not None:
        result = result.append(detail[0])
        parents = np.concatenate([parents, rows[owner[detail[1]]]])
    return Lifted(result, np.sort(place[changed]), parents)
