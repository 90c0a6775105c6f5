"""An asset as views all around see it, for light: which Gaussians show on which side, the surface that each of them is
a part of, and places of that surface that bear witness of the light.

Colours of single Gaussians of a fitted asset, and their axes, are what the fit happened to leave: several blend into
every pixel. What views show of them together is the surface and its colour.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera, bounding_sphere, spherical_cameras
from splatpainter.color import to_light
from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lights.stand_ins import STAND_INS, StandIns, stand_ins
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm


@dataclass(frozen=True)
class SightThresholds:
    """From where an asset is looked at, and what counts there. Source: measured on 16 tuning meshes where an entry
    gives figures, else taste."""

    view_count: int = 14
    """Cameras around the asset. 26 of 240 px instead: relit fitted assets 0.0 to 0.2 dB better."""
    view_distance: float = 2.8
    """Of the cameras from the middle, in radii of the asset."""
    view_px: int = 160
    """Edge of the views."""
    shimmer: float = 0.1
    """Share of a Gaussian that a view must show: what shimmers through a wall is none."""
    surface_step: int = 2
    """Pixels between the estimates of the surface in a view, and between places that bear witness. With 3 relit fitted
    assets are 0.1 dB worse."""
    surface_patches: int = 150_000
    """Gaussians that the surface is estimated from, at most: so coarse a view tells no more apart."""
    clear: float = 0.5
    """Length of a mean of normals from which it tells the outside: of those that a Gaussian shows, whatever its axes;
    of those of the Gaussians in a pixel."""
    min_footprint_px: float = 0.05
    """Pixels' worth of a Gaussian from which what views show of it is its surface."""
    min_alpha: float = 0.9
    """Of a pixel whose colour bears witness: at silhouettes the background shines through."""


SIGHTS = SightThresholds()


@dataclass(frozen=True)
class SeenPixels:
    """S pixels in which views show the surface."""

    cameras: tuple[Camera, ...]
    views: Ids = field(repr=False)
    """[S] int64 which camera."""
    pixels: Ids = field(repr=False)
    """[S] int64 flat index of the pixel."""
    points: Floats = field(repr=False)
    """[S, 3] float32, relative to the asset's offset."""
    normals: Floats = field(repr=False)
    """[S, 3] float32 unit, towards the camera."""

    def witnesses(self, splats: Splats, facing: np.ndarray | None = None) -> tuple[Floats, Bools, Floats]:
        """([S, 3] linear colours of an asset of this shape as they are seen there, [S] bool where it fills the pixel,
        [S, 3] float64 unit normals). facing: [N, 3] normals of the asset's Gaussians, which are blended as their
        colours are, so that colour and normal belong to each other; where they contradict each other, and everywhere
        without them, the surface's `normals` stand."""
        base = _matte(splats)

        def colors_in(number: int) -> tuple[Ids, Floats, Floats, Floats]:
            """(which of the pixels this view has, their colours, alphas and blended normals)."""
            here = np.flatnonzero(self.views == number)
            if not len(here):
                return here, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3))
            view, pixels = project(base, self.cameras[number]), self.pixels[here]
            drawn, covered, _ = view.rasterize()
            alpha = np.maximum(covered.reshape(-1)[pixels], 1e-6)
            color = drawn.reshape(-1, 3)[pixels] / alpha[:, None]
            if facing is None:
                return here, color, alpha, color
            blended = view.rasterize(facing[view.gaussian_ids])[0].reshape(-1, 3)[pixels].astype(np.float64)
            return here, color, alpha, blended / alpha[:, None]

        light, filled = np.zeros((len(self.views), 3)), np.zeros(len(self.views), bool)
        normals = self.normals.astype(np.float64)
        for here, color, alpha, blended in each(colors_in, range(len(self.cameras))):
            light[here] = to_light(np.maximum(color, 0), splats.color_space)
            filled[here] = alpha > SIGHTS.min_alpha
            if facing is None:
                continue
            length = row_norm(blended)
            clear = length > SIGHTS.clear
            normals[here[clear]] = blended[clear] / length[clear, None]
        return light, filled, normals


@dataclass(frozen=True)
class Sights:
    """What V views show of N Gaussians, and where."""

    seen: Floats = field(repr=False)
    """[N] float32 pixels' worth of each, over all views, where it does not only shimmer through."""
    towards: Floats = field(repr=False)
    """[N, 3] float32 mean direction to those who see it, times `seen`."""
    footprints: tuple[tuple[Ids, Floats, Floats, Bools], ...] = field(repr=False)
    """Of each view: [M] int64 Gaussians, [M, 3] float32 normals of the surface in the pixels that each is a part of,
    [M] float32 pixels' worth, both sums over pixels; [M] bool where it does not only shimmer through."""
    surface_pixels: SeenPixels

    def surface_normals(self, sides: np.ndarray) -> tuple[Floats, Floats, Bools]:
        """([N, 3] float32 unit mean normals of the surface that each Gaussian shows, on the side that it shows more,
        [N] float32 0.5..1 the share of that side, [N] bool where there is such a surface). sides: [N, 3] normals that
        tell both sides apart where views see both about as much."""
        count = len(sides)
        total, weight = np.zeros((count, 3)), np.zeros(count)
        for ids, normals, weights, _ in self.footprints:
            total[ids] += normals
            weight[ids] += weights
        # What is seen from all sides alike has no mean: there its own axis tells above from below.
        length = np.sqrt((total * total).sum(1))
        outside = np.where((length > SIGHTS.clear * weight)[:, None], total, sides)
        total, above, below = np.zeros((count, 3)), np.full(count, 1e-9), np.zeros(count)
        for ids, normals, weights, witness in self.footprints:
            front = (normals * outside[ids]).sum(1) > 0
            total[ids] += np.where(front[:, None], normals, -normals)
            # Normals may come from what shimmers through, as the surface does; that a side is seen may not.
            above[ids] += np.where(front & witness, weights, 0)
            below[ids] += np.where(~front & witness, weights, 0)
        share = above / (above + below)
        length = np.sqrt((total * total).sum(1))
        there = (weight > SIGHTS.min_footprint_px) & (length > 1e-6)
        normals = total / np.maximum(length, 1e-9)[:, None] * np.where(share < 0.5, -1, 1)[:, None]
        return normals.astype(np.float32), np.maximum(share, 1 - share).astype(np.float32), there


def _around(splats: Splats) -> tuple[Camera, ...]:
    """The cameras from which an asset is looked at."""
    center, radius = bounding_sphere(splats)
    around = spherical_cameras(center, SIGHTS.view_distance * max(radius, 1e-9), SIGHTS.view_count, size=SIGHTS.view_px)
    return tuple(camera.local for camera in around)


def dense_places(splats: Splats, axes: np.ndarray) -> StandIns | None:
    """What stands for the Gaussians of a dense asset where it is looked at (`stand_ins`); None where each stands for
    itself. splats: all drawable; axes: [N, 3] float32 their shortest ones."""
    if len(splats) <= STAND_INS.few:
        return None
    # Every so manieth tells how large the asset is.
    sample = splats.take(np.arange(0, len(splats), len(splats) // STAND_INS.few))
    center, radius = bounding_sphere(sample)
    camera = _around(sample)[0]
    return stand_ins(splats, axes, center, STAND_INS.cells * SIGHTS.view_distance * radius / camera.fx)


def look_around(splats: Splats) -> Sights:
    """splats: at least one Gaussian, all drawable."""
    cameras = _around(splats)
    count = len(splats)
    # Evenly by their order, which in most files goes along the surface.
    patches = np.linspace(0, count - 1, min(count, SIGHTS.surface_patches)).astype(np.int64)
    surface = Surface.of(splats.take(patches) if len(patches) < count else splats)
    base = _matte(splats)
    # A thread for each view: what numpy does between the kernels is as long as they are.
    looks = each(lambda camera: _Look.of(base, surface, camera), cameras)
    towards, seen = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
    for look in looks:
        ids, _, weights, witness = look.footprints
        towards[ids[witness]] += look.towards
        seen[ids[witness]] += weights[witness]
    surface_pixels = SeenPixels(
        cameras,
        np.repeat(np.arange(len(looks)), [len(look.pixels) for look in looks]),
        np.concatenate([look.pixels for look in looks]),
        np.concatenate([look.points for look in looks]).astype(np.float32),
        np.concatenate([look.normals for look in looks]).astype(np.float32),
    )
    return Sights(seen, towards, tuple(look.footprints for look in looks), surface_pixels)


def _matte(splats: Splats) -> Splats:
    """With base colours alone: gloss is of no use here."""
    return replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))


@dataclass(frozen=True)
class _Look:
    """What one view shows."""

    footprints: tuple[Ids, Floats, Floats, Bools]
    """As of `Sights`."""
    towards: Floats
    """[.., 3] float32 directions to the camera of those that do not only shimmer through, times their pixels' worth."""
    pixels: Ids
    """[P] int64 flat indices of pixels of the surface."""
    points: Floats
    """[P, 3] float64."""
    normals: Floats
    """[P, 3] float64."""

    @staticmethod
    def of(splats: Splats, surface: Surface, camera: Camera) -> _Look:
        px = SIGHTS.view_px
        ys, xs = (grid.ravel() for grid in np.indices((px, px)))
        projected = project(splats, camera)
        there = visible_surface(surface, splats, projected, np.ones((px, px), bool), step=SIGHTS.surface_step)
        at = there.at(np.stack([xs, ys], 1) + 0.5)
        turned = portable.matmul(at.normals, camera.world_to_camera[:3, :3]) * (at.depth > 0)[:, None]
        sums = projected.backproject(
            np.ascontiguousarray(turned.reshape(px, px, 3), np.float32), np.ones((px, px), np.float32)
        )
        part = np.flatnonzero(sums.weight > 0)
        ids, weights = projected.gaussian_ids[part], sums.weight[part]
        witness = weights > SIGHTS.shimmer * sums.alpha[part]
        away = camera.position.astype(np.float32) - splats.means[ids[witness]]
        towards = (weights[witness] / np.linalg.norm(away, axis=1))[:, None] * away
        # Neighbouring pixels tell the same.
        sparse = (ys % SIGHTS.surface_step == 0) & (xs % SIGHTS.surface_step == 0) & (at.depth > 0)
        spots = np.stack([xs[sparse], ys[sparse]], 1) + 0.5
        points = camera.to_world(camera.sight_lines(spots) * at.depth[sparse][:, None])
        footprints = (ids, sums.values[part], weights, witness)
        return _Look(footprints, towards, np.flatnonzero(sparse), points, turned[sparse])
