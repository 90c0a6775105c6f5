"""Fits TRUST_WEIGHTS of native/surface/estimate.h: how likely a height is right, by what an estimate says of itself.

Every mesh becomes three assets: surfels of it (clean), and two that 3DGS fitted to pictures of it, from points off the
surface (fitted) and from points on it (started at depth). Cameras around ask for the surface where they see it; the
mesh's own depth says whether the height along the normal was right to 0.3 widths of the Gaussians that are seen.
Logistic regression on the kernel's own terms, each kind of asset weighing a third. Printed: the weights as C++ has
them, and for those and for the stored ones the area under the ROC curve and the worst tenth of the calibration, on
objects that the fit did not see.

What it prints with its defaults is what is stored. Without PRIOR, weights 27 away came out that told right from
wrong as well on unseen objects (areas of 0.90, 0.64, 0.71) and lost 0.5 dB of paint on fitted assets.

Run: python scripts/calibrate/trust.py MESHES [--objects 8] [--held-out 5] [--gaussians 20000] [--steps 700]

MESHES: a folder of GLB, glTF or OBJ files. Eight minutes of one core with these defaults; needs `pip install ./train`.
"""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial import KDTree

from splatpainter.cameras import Camera
from splatpainter.color import linear_to_srgb, sh_from_color
from splatpainter.fit.optimize import FitOptions, TrainingView, optimize
from splatpainter.fit.start import from_depths, from_points
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import VISIBLE, visible_surface
from splatpainter.transforms import quat_to_matrix
from splattrain.data.object_sources import MeshFolder, split
from splattrain.data.surfels import coarse_asset, sample_surfels
from splattrain.data.viewpoints import Optics, ring

HEADER = Path(__file__).resolve().parents[2] / "native" / "surface" / "estimate.h"
KINDS = ("clean", "fitted", "started at depth")
RIGHT_WIDTHS = 0.3
"""Error of a height, in widths of the Gaussians seen there, up to which it is right (SurfacePoints.trust)."""
OTHER_SURFACE_WIDTHS = 3.0
"""A height that is farther than this from the mesh's depth is on another surface, and wrong however near that is."""
MAX_MOVE, RESIDUAL_KNEE = 2.5, 0.15
"""As in trust_of: windows at which the step is capped, and residual up to which it counts twice."""
NEAREST = 8
"""Surfels around a height that are looked at for one that faces the camera."""
PRIOR = np.array([3.37, -9.01, 15.02, -5.28, -3.81, -2.40, 2.58, -1.89, -0.49, -0.42])
"""Weights of a first fit, on objects that nobody wrote down."""
PRIOR_STRENGTH = 0.1
"""Of the square of the distance to PRIOR, where all samples together weigh 1: the terms of the residual stand for each
other, so that without it they go anywhere. On objects that the fit did not see it loses at most 0.001 of the log
likelihood on any kind (0.01: 0.011 on fitted assets)."""
TRUTH_SURFELS_PER_GAUSSIAN = 6


@dataclass(frozen=True)
class Config:
    """What the weights are fitted on."""

    meshes: Annotated[Path, tyro.conf.Positional]
    objects: int = 8
    held_out: int = 5
    gaussians: int = 20_000
    steps: int = 700
    """Of each 3DGS fit."""
    size: int = 256
    """Pixels of the edges of all views."""
    views: int = 9
    """Of each fit; as many others ask for the surface."""
    seed: int = 0


def main(config: Config) -> None:
    names, _ = split([MeshFolder(config.meshes).name(i) for i in range(len(MeshFolder(config.meshes)))])
    wanted = config.objects + config.held_out
    source = MeshFolder(config.meshes, names[:: max(len(names) // wanted, 1)][:wanted])
    samples = []
    for i in range(len(source)):
        print(f"{source.name(i)} ...", file=sys.stderr, flush=True)
        try:
            samples.append(
                [queries_of(asset, truth, seen, config) for asset, truth, seen in assets_of(source, i, config)]
            )
        except ValueError as error:
            print(f"left out: {error}", file=sys.stderr)
    training, judged = samples[: config.objects], samples[config.objects :] or samples
    weights = fitted([together(kind) for kind in zip(*training, strict=True)])
    stored = stored_weights()
    print("constexpr double TRUST_WEIGHTS[] = {" + ", ".join(f"{weight:.2f}" for weight in weights) + "};")
    print(f"largest difference from the stored ones: {np.abs(weights - stored).max():.2f}")
    for kind, parts in zip(KINDS, zip(*judged, strict=True), strict=True):
        terms, right = together(parts)
        for name, chosen in (("fitted here", weights), ("stored", stored)):
            chance = 1 / (1 + np.exp(-terms @ chosen))
            area, worst = area_under_curve(chance, right), worst_tenth(chance, right)
            print(f"{kind}, {name}: AUC {area:.2f}, worst tenth {worst:.2f}")


def assets_of(source: MeshFolder, i: int, config: Config) -> list[tuple[Splats, Splats, list[Camera]]]:
    """(asset, truth, cameras that ask) of each kind."""
    rng = np.random.default_rng([config.seed, i])
    dense = sample_surfels(source.mesh(i), TRUTH_SURFELS_PER_GAUSSIAN * config.gaussians, config.seed)
    truth, clean = as_splats(dense), as_splats(coarse_asset(dense, config.gaussians, config.seed, roughness=0.0))
    radius = float(np.linalg.norm(truth.means, axis=1).max())
    cameras, asking = (ring(radius, Optics(config.size), config.views, rng) for _ in range(2))
    shots = [project(truth, camera).rasterize() for camera in cameras]
    colors, alphas, depths = (np.stack(parts) for parts in zip(*shots, strict=True))
    views = [TrainingView(camera, color) for camera, color in zip(cameras, colors, strict=True)]
    count = config.gaussians // 2
    on_surface = from_depths(cameras, colors, depths, alphas, count, config.seed, 0)
    noisy = on_surface.means + rng.normal(0, 0.02 * radius, on_surface.means.shape).astype(np.float32)
    off_surface = from_points(noisy, np.clip(0.5 + 0.28209479 * on_surface.sh[:, 0], 0, 1), 0)
    fits = [
        optimize(start, views, FitOptions(steps=config.steps, densify=densify, seed=config.seed)).splats
        for start, densify in ((off_surface, True), (on_surface, False))
    ]
    return [(asset, truth, asking) for asset in (clean, *(fit.take(np.flatnonzero(fit.drawable)) for fit in fits))]


def as_splats(surfels) -> Splats:
    means, quats, scales, opacities = (
        np.asarray(getattr(surfels, name), np.float32) for name in ("means", "quats", "scales", "opacities")
    )
    sh = sh_from_color(linear_to_srgb(np.asarray(surfels.albedo, np.float32)))[:, None].astype(np.float32)
    return Splats(means, quats, scales, opacities, sh)


def queries_of(asset: Splats, truth: Splats, cameras: list[Camera], config: Config) -> tuple[np.ndarray, np.ndarray]:
    """([Q, 10] terms of the regression, [Q] bool whether the height was right)."""
    surface, tree, terms, right = Surface.of(asset), KDTree(truth.means), [], []
    lists = [getattr(surface.samples, name) for name in ("keys", "level_starts", "cell_sizes", "reaches", "min_corner")]
    for camera in cameras:
        view = project(asset, camera)
        solid = view.rasterize()[1] > 0.6
        _, alpha, depth = project(truth, camera).rasterize()
        sight = visible_surface(surface, asset, view, solid).estimates
        y, x = np.divmod(sight.pixels, camera.width)
        known = alpha[y, x] > 0.99
        queries, points = sight.queries[known], camera.unproject(depth[y, x], np.stack([x, y], 1) + 0.5)[known]
        # The kernel's own row: one of its columns, thickness, has no other use than trust.
        out = np.zeros((len(queries), 12))
        starts, directions, windows = (np.ascontiguousarray(part) for part in np.split(queries, (3, 6), 1))
        run(kernels.estimate_surface, *lists, surface.samples.patches, starts, directions, windows[:, 0].copy(), out)
        there = out[:, 9] >= 3  # with fewer patches trust falls in proportion, whatever the weights
        width = windows[:, 0] / VISIBLE.window_widths
        # A picture's depth is of centres of Gaussians, so it tells which surface is seen, and the mesh how well.
        near = np.abs(((out[:, :3] - points) * directions).sum(1)) < OTHER_SURFACE_WIDTHS * width
        error = distances(out[:, :3], directions, truth, tree) / width
        terms.append(regression_terms(starts, directions, out)[there])
        right.append((near & (error < RIGHT_WIDTHS))[there])
    return np.concatenate(terms), np.concatenate(right)


def distances(points: np.ndarray, directions: np.ndarray, truth: Splats, tree: KDTree) -> np.ndarray:
    """[Q] how far points are from the planes of the surfels that face along `directions` and are nearest to them."""
    near = np.asarray(tree.query(np.nan_to_num(points), k=NEAREST)[1])
    normals = quat_to_matrix(truth.quats)[:, :, 2][near]
    # A thin wall has a surfel of its other side as near; of those that face the camera the nearest counts.
    chosen = np.argmax((normals * directions[:, None]).sum(2) < 0, 1)  # none: a single sheet, seen from behind
    nearest = np.arange(len(points)), chosen
    return np.abs(((points - truth.means[near[nearest]]) * normals[nearest]).sum(1))


def regression_terms(starts: np.ndarray, directions: np.ndarray, out: np.ndarray) -> np.ndarray:
    """[Q, 10], as trust_of in native/surface/estimate.h has them."""
    move = np.minimum(np.abs(((out[:, :3] - starts) * directions).sum(1)) / np.maximum(out[:, 6], 1e-30), MAX_MOVE)
    slant = np.clip(-(out[:, 3:6] * directions).sum(1), 0, 1)
    residual, thickness = np.minimum(out[:, 7], 1), np.minimum(out[:, 8], 1)
    columns = (
        np.ones(len(out)), residual, residual**2, np.minimum(residual, RESIDUAL_KNEE), thickness, 1 - out[:, 10],
        slant, slant**2, np.minimum(move, 1), np.maximum(move - 1, 0),
    )  # fmt: skip
    return np.stack(columns, 1)


def together(parts) -> tuple[np.ndarray, np.ndarray]:
    terms, right = zip(*parts, strict=True)
    return np.concatenate(terms), np.concatenate(right)


def fitted(kinds: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """[10] most likely weights by Newton's method, given PRIOR; each kind weighs the same."""
    terms, right = together(kinds)
    share = np.concatenate([np.full(len(labels), 1 / (len(kinds) * len(labels))) for _, labels in kinds])
    weights = PRIOR.copy()
    for _ in range(50):
        chance = 1 / (1 + np.exp(-terms @ weights))
        pull = PRIOR_STRENGTH * (weights - PRIOR)
        gradient = terms.T @ (share * (right - chance)) - pull
        hessian = (terms * (share * chance * (1 - chance))[:, None]).T @ terms + PRIOR_STRENGTH * np.eye(len(weights))
        step = np.linalg.solve(hessian, gradient)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return weights


def stored_weights() -> np.ndarray:
    (numbers,) = re.findall(r"TRUST_WEIGHTS\[\] = \{([^}]*)\}", HEADER.read_text(encoding="utf-8"))
    return np.array([float(number) for number in numbers.split(",")])


def area_under_curve(chance: np.ndarray, right: np.ndarray) -> float:
    """By the ranks of the right ones (Mann and Whitney)."""
    rank = np.empty(len(chance))
    rank[np.argsort(chance, kind="stable")] = np.arange(1, len(chance) + 1)
    count = right.sum()
    return float((rank[right].sum() - count * (count + 1) / 2) / max(count * (len(right) - count), 1))


def worst_tenth(chance: np.ndarray, right: np.ndarray) -> float:
    """Largest difference of mean chance and share that is right, over tenths of the chance with some samples."""
    tenth = np.minimum((10 * chance).astype(int), 9)
    sizes = np.bincount(tenth, minlength=10)
    gaps = np.abs(np.bincount(tenth, chance - right, 10)) / np.maximum(sizes, 1)
    return float(gaps[sizes >= 20].max(initial=0))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
