"""Fill a hole: new Gaussians, as far apart as their neighbours are, on a surface that continues the border, in colours
that continue what surrounds it. Only appends. Pure: equal inputs give equal bits.

    filled = fill_hole(splats, removed=weights > 0.5)
    splats.append(filled.appended)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.cameras import Camera
from splatpainter.color import sh_from_color
from splatpainter.holes.air import in_the_air
from splatpainter.holes.border import BORDER, Border, bordering_gaussians, borders_of
from splatpainter.holes.chart import CHART, Chart, chart_of
from splatpainter.holes.smooth_surface import ThinPlate, sphere_heights
from splatpainter.holes.texture import complete
from splatpainter.lift.colors import lift_colors, recolor
from splatpainter.lift.masks import dilated
from splatpainter.lift.sheets.sheet import SHEET, pixel_gaussians
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class HoleFillThresholds:
    """New Gaussians over a hole. Source: taste, tried on bodies removed from captures."""

    max_stretch: float = 2.0
    """Largest stretch of a Gaussian along a slanted surface."""
    max_gaussians_per_cell: int = 3
    """Gaussians that share a cell where it is steeper."""
    band_share: float = 0.35
    """Width of the strip of shell whose heights are continued, in square roots of the hole's area."""
    min_band_px: int = 6
    """The least width of that strip, pixels."""
    max_band_px: int = 28
    """The largest width of that strip, pixels."""
    noise_cells: float = 0.25
    """Deviation of a border's heights from a smooth surface that is expected, in cells."""
    min_reached: float = 0.98
    """Share of a border's points that a sphere must reach over: the rest are of something else."""
    noise_median: float = 0.6745
    """Median deviation of noise over its standard deviation (normal)."""
    min_wall_cells: float = 2.0
    """Distance between two shells, in cells, from which a wall has two sides, each filled by itself."""
    min_painted_wall_cells: float = 0.4
    """The same where both sides show different colours."""
    min_wall_contrast: float = 0.04
    """Difference of colours, 0..1, from which they are different."""
    color_rounds: int = 6
    """Colour rounds in which the new Gaussians take the filled picture's colours."""
    max_compensation: float = 0.08
    """Largest change of a colour channel, by which a Gaussian may differ from the picture where it lies."""
    rim_px: int = 1
    """Pixels by which the new Gaussians reach under the border."""
    soft_rim_px: int = 4
    """The same where the border is soft."""
    perspective_rounds: int = 3
    """Heights are functions of place, and a pixel's place depends on its depth: so often one is set by the other."""
    slope_limit: float = 4.0
    """Steepest slope of the continued surface in its chart."""


FILLING = HoleFillThresholds()


Picture = tuple[Camera, np.ndarray, np.ndarray]
"""(camera, [H, W, 3] in the asset's colour space, [H, W] where it counts, 0..1)."""


@dataclass(frozen=True)
class Filled:
    """What fills the holes of one asset."""

    appended: Splats = field(repr=False)
    """[A] new Gaussians."""
    holes: int
    """Sides of them: a hole through a wall has two."""
    coarse: bool
    """Whether a hole was so large that its Gaussians are coarser than their neighbours."""
    camera: Camera | None = None
    """Camera that faces the largest hole."""
    size_px: float = 0.0
    """Width of that hole in it, pixels."""
    reason: str = ""
    """Why nothing was filled."""

    @property
    def note(self) -> str:
        """One line for receipts."""
        if not self.holes:
            return f"hidden, nothing filled: {self.reason}"
        holes = "1 hole" if self.holes == 1 else f"{self.holes} holes"
        coarse = ", coarser than their neighbours: it is large" if self.coarse else ""
        return f"filled {holes} with {len(self.appended):,} Gaussians{coarse}"


def fill_hole(splats: Splats, *, removed: Bools | None = None, around: Bools | None = None) -> Filled:
    """What continues the surroundings where Gaussians are missing. splats: numpy.

    removed: [N] bool, Gaussians that are gone (whatever their opacity is now): where the surface behind is closed, or
    nothing around can be continued, nothing is appended and `reason` says why. Or around: [N] bool, Gaussians around a
    hole, as they are selected by circling it. Raises ValueError in one line: nothing is named, nothing
    is left; or, around, there is no border, no hole in it, or a border that is no surface."""
    visible = splats.drawable & (splats.opacities > 0)
    if removed is not None:
        if not removed.any():
            raise ValueError("fill: nothing was removed; select something first")
        removed = removed & splats.drawable
        remaining = visible & ~removed
        candidates = bordering_gaussians(splats, remaining, removed)
    else:
        # Either something was removed, and its neighbours are the border; or the border itself was circled.
        remaining, candidates = visible, np.zeros(len(splats), bool) if around is None else around & visible
        if not candidates.any():
            raise ValueError("fill: nothing is selected; circle the hole, with some of the asset around it")
    # What was removed may be empty by now: it still says where no air was.
    before = splats if removed is None else replace(splats, opacities=np.where(removed, 1, splats.opacities))
    borders = borders_of(splats, remaining, candidates)
    if not borders and removed is not None and remaining.sum() >= BORDER.min_gaussians:
        return _unfilled(splats, "what was removed touched nothing")
    if not borders:
        raise ValueError("fill: expected a border of at least 12 Gaussians around the hole; nothing is left there")
    pieces: list[Splats] = []
    cameras: list[Camera] = []
    seen, coarse, all_float = False, False, False
    # Every border has up to two sides, and each side with a hole gets its own Gaussians.
    for border in borders:
        charts = _charts(splats, remaining, removed, border)
        seen |= bool(charts)
        for chart in charts:
            piece = _filled(splats, chart, border)
            if len(piece) and removed is not None:
                floating = in_the_air(before, piece.means, border)
                all_float |= bool(floating.all())
                piece = piece.take(np.flatnonzero(~floating))
            if len(piece):
                pieces.append(piece)
                cameras.append(chart.camera)
                coarse |= chart.pixel * CHART.cell_px > 1.5 * border.cell
    if not pieces:
        # Nothing was filled: say why, as an error where a hole was named, as a note where something was removed.
        loose = "what surrounds the hole is not a surface that can be continued (fog, or loose Gaussians)"
        closed = "the surface is closed behind it"
        if removed is not None and all_float:
            return _unfilled(splats, "what goes on from there would stand in the air")
        if removed is not None:
            return _unfilled(splats, closed if seen else loose)
        raise ValueError(f"fill: there is no hole; {closed}" if seen else f"fill: {loose}")
    appended = pieces[0]
    for piece in pieces[1:]:
        appended = appended.append(piece)
    # The camera of the largest hole is what a source or a person gets to see.
    largest = int(np.argmax([len(piece) for piece in pieces]))
    camera = cameras[largest]
    pixels, _ = camera.project(pieces[largest].means)
    return Filled(appended, len(pieces), coarse, camera, float(np.ptp(pixels, axis=0).max()))


def _unfilled(splats: Splats, reason: str) -> Filled:
    none = replace(splats.take(np.zeros(0, np.int64)), source=None, origin=None)
    return Filled(none, 0, False, reason=reason)


def _charts(splats: Splats, remaining: np.ndarray, removed: np.ndarray | None, border: Border) -> list[Chart]:
    """The sides of a border that have a shell of their own, with its hole."""
    sides = [chart_of(splats, remaining, removed, border, sign * border.normal) for sign in (1, -1)]
    charts = [chart for chart in sides if chart is not None]
    if len(charts) < 2:
        return charts
    front, back = sorted(charts, key=lambda chart: -chart.seeds)
    return [front, back] if _is_other(front, back, border) else [front]


def _is_other(front: Chart, back: Chart, border: Border) -> bool:
    """Whether two sides of a border show two shells, the sides of a wall, and not one from both sides."""
    # Compare both shells around the hole: how far apart, and how different in colour.
    near = dilated(front.hole, 4) & front.shell
    if not near.any() or not back.shell.any():
        return False
    ys, xs = np.nonzero(near)
    points = front.camera.unproject(front.depth[ys, xs], np.stack([xs, ys], 1) + 0.5)
    pixels, z = back.camera.project(points)
    index = np.floor(pixels).astype(int)
    inside = np.flatnonzero(((index >= 0) & (index < back.camera.width)).all(1))
    v, u = index[inside, 1], index[inside, 0]
    seen_behind = back.depth[v, u] > 0
    if not seen_behind.any():
        return False
    gap = float(np.median((z[inside] - back.depth[v, u])[seen_behind])) / border.cell
    colors = np.abs(front.picture[ys[inside], xs[inside]] - back.picture[v, u])[seen_behind]
    contrast = float(np.median(colors.mean(1)))
    return gap > FILLING.min_wall_cells or (
        gap > FILLING.min_painted_wall_cells and contrast > FILLING.min_wall_contrast
    )


def _filled(splats: Splats, chart: Chart, border: Border) -> Splats:
    """New Gaussians in a chart's hole."""
    none = replace(splats.take(np.zeros(0, np.int64)), source=None, origin=None)
    # Under the rim too, farther where the border is soft: no gap between old and new.
    hole = dilated(chart.hole, FILLING.rim_px) | (dilated(chart.hole, FILLING.soft_rim_px) & ~chart.clean & chart.shell)
    ys, xs = np.nonzero(_cells(hole, CHART.cell_px))
    pixels = (np.stack([xs, ys], 1) + 0.5) * CHART.cell_px
    if not len(pixels):
        return none
    # Geometry first: a smooth continuation of the border, as dense as its neighbours.
    depth, normals = _continued(chart, border, pixels)
    camera = chart.camera
    rays = camera.sight_lines(pixels)
    facing = -(rays * normals).sum(1) / np.linalg.norm(rays, axis=1)
    stretch = np.clip(1 / np.maximum(facing, 1e-3), 1, FILLING.max_stretch * FILLING.max_gaussians_per_cell)
    count = np.clip(np.ceil(stretch / FILLING.max_stretch), 1, FILLING.max_gaussians_per_cell).astype(np.int64)
    source = np.repeat(np.arange(len(pixels)), count)
    turn = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    shift = (turn + 0.5) / count[source] - 0.5
    sizes = np.full(len(source), float(CHART.cell_px))
    geometry = pixel_gaussians(
        camera,
        pixels[source],
        depth[source],
        normals[source],
        SHEET.cell_width * sizes,
        sizes,
        stretch[source],
        count[source],
        shift,
    )
    # Colours second: texture continued in the chart, then the Gaussians fitted to that picture.
    target = complete(chart.picture, chart.shell, chart.clean, hole)
    colors = _means(target, CHART.cell_px)[ys, xs][source]
    sh = np.zeros((len(source), *splats.sh.shape[1:]), np.float32)
    sh[:, 0] = sh_from_color(colors)
    fresh = Splats(
        geometry.means.astype(np.float32),
        geometry.quats.astype(np.float32),
        geometry.scales.astype(np.float32),
        np.full(len(source), SHEET.opacity, np.float32),
        sh,
    )
    # `append` brings the asset's SH degree, colour space and flags along.
    fresh = none.append(fresh)
    return painted(chart.splats, fresh, [(camera, target, hole)])


def painted(splats: Splats, appended: Splats, pictures: Sequence[Picture]) -> Splats:
    """The appended Gaussians in the colours that pictures show of them among `splats`; of pictures that disagree the
    later ones win."""
    joined = replace(splats, source=None, origin=None).append(appended)
    editable = np.arange(len(joined)) >= len(splats)
    for camera, picture, mask in pictures:
        view = project(joined, camera)
        chosen = editable[view.gaussian_ids]
        before = view.unclamped_colors
        target, weights = (np.ascontiguousarray(a, np.float32) for a in (picture, mask))
        colors = lift_colors(view, target, weights, chosen, FILLING.color_rounds)
        # What hangs before them, fog or the soft edge of the border, is not made up for by ever stronger colours.
        index = np.clip(np.floor(view.means2d).astype(int), 0, (camera.width - 1, camera.height - 1))
        target_colors = target[index[:, 1], index[:, 0]]
        bounded = (weights[index[:, 1], index[:, 0]] > 0)[:, None]
        limited = np.clip(colors, target_colors - FILLING.max_compensation, target_colors + FILLING.max_compensation)
        colors = np.where(bounded, limited, colors)
        ids, sh = view.gaussian_ids[chosen], joined.sh.copy()
        sh[ids] = recolor(sh[ids], before[chosen], colors[chosen], 1.0)
        joined = replace(joined, sh=sh)
    return replace(appended, sh=joined.sh[len(splats) :])


def _continued(chart: Chart, border: Border, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([P] z-depths, [P, 3] unit normals towards the camera, camera space) of the border's surface, continued."""
    camera = chart.camera
    area = int(chart.hole.sum())
    # Only a strip around the hole says how it goes on: what is far away has other curves.
    band = int(np.clip(FILLING.band_share * np.sqrt(area), FILLING.min_band_px, FILLING.max_band_px))
    ys, xs = np.nonzero(dilated(chart.hole, band) & chart.shell)
    z = chart.depth[ys, xs]
    rays = camera.sight_lines(np.stack([xs, ys], 1) + 0.5)
    points = rays * np.stack([z, z, -z], 1)  # heights grow towards the camera
    up = chart.normals[ys, xs] * (1, 1, -1)
    noise = FILLING.noise_cells * border.cell
    slopes = camera.slopes(pixels)
    middle = float(np.median(z))
    queries = slopes * middle
    # A sphere where it reaches over the hole and nearly all of the border (a ball, a bottle), else a plane; the plate
    # takes the rest.
    over = sphere_heights(points, up, np.concatenate([points[:, :2], queries]))
    reached = np.ones(len(points), bool) if over is None else ~np.isnan(over[: len(points)])
    is_sphere = over is not None and reached.mean() > FILLING.min_reached and not np.isnan(over[len(points) :]).any()

    def base(at: np.ndarray) -> np.ndarray:
        heights = sphere_heights(points, up, at) if is_sphere else None
        return np.full(len(at), -middle) if heights is None else np.where(np.isnan(heights), -middle, heights)

    border_points = points[reached] if is_sphere else points
    left = border_points[:, 2] - base(border_points[:, :2])
    # Of a border that lies on the sphere within its noise a plate would carry the noise into the hole.
    if is_sphere and float(np.median(np.abs(left - np.median(left)))) < FILLING.noise_median * noise:
        left = np.zeros(len(left))
    plate = ThinPlate.fit(border_points[:, :2], left, noise)
    low, high = z.min() - border.radius, z.max() + border.radius

    def depth_at(at: np.ndarray) -> np.ndarray:
        return np.clip(-(base(at) + plate.at(at)), low, high)

    # Pixel to place needs the depth, depth needs the place: a few rounds settle it.
    at = slopes * middle
    for _ in range(FILLING.perspective_rounds):
        depth = depth_at(at)
        at = slopes * depth[:, None]
    depth = depth_at(at)
    h = border.cell
    # Normals from the continued surface itself, by differences of one cell.
    dx = np.clip((depth_at(at + (h, 0)) - depth) / h, -FILLING.slope_limit, FILLING.slope_limit)
    dy = np.clip((depth_at(at + (0, h)) - depth) / h, -FILLING.slope_limit, FILLING.slope_limit)
    normals = np.stack([dx, dy, -np.ones(len(dx))], 1)
    return depth, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _cells(hole: np.ndarray, step: int) -> Bools:
    """[H / step, W / step] bool: cells of which at least half is hole."""
    height, width = (n // step * step for n in hole.shape)
    blocks = hole[:height, :width].reshape(height // step, step, width // step, step)
    return blocks.mean((1, 3)) >= 0.5


def _means(picture: np.ndarray, step: int) -> np.ndarray:
    height, width = (n // step * step for n in picture.shape[:2])
    return picture[:height, :width].reshape(height // step, step, width // step, step, -1).mean((1, 3))
