"""Kernels of surface, voxels and lighting: the same bytes on every kind of CPU and for any number of threads."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.lighting import visibility
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.session.measures.curvature import bend_degrees
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import smoothed, thinned, unwrap
from splatpainter.surface.visible import visible_surface
from splatpainter.voxels.grid import voxelize
from splatpainter.voxels.neighbours import components, joined_labels, nearest_within
from splatpainter.voxels.raycast import editable_gaussians, first_hits, seen_voxels
from tests.support.kernel_goldens import CPUS, Numbers, check

F = np.float32
GOLDENS: dict[str, tuple[Callable[[], list[np.ndarray]], str]] = {}


def golden(expected: str):
    """Register a case by its name."""

    def register(case: Callable[[], list[np.ndarray]]):
        GOLDENS[case.__name__] = case, expected
        return case

    return register


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt((vectors * vectors).sum(1, keepdims=True))


def shell(seed: int, count: int = 700) -> tuple[Splats, np.ndarray]:
    """(Gaussians about a sphere of radius 1, of many widths, thick and thin, faint and opaque; their directions)."""
    r = Numbers(seed)
    out = unit(r.normal(count, 3))
    means, scales = out * (1 + r.uniform(-0.05, 0.05, count, 1)), r.uniform(0.02, 0.2, count, 3)
    quats, sh = r.normal(count, 4), r.uniform(-1, 1, count, 1, 3)
    means, quats, scales, opacities, sh = (a.astype(F) for a in (means, quats, scales, r.uniform(0.002, 1, count), sh))
    return Splats(means, quats, scales, opacities, sh), out


def camera() -> Camera:
    w2c = np.eye(4)
    w2c[:3, 3] = [0.125, -0.25, 3]
    return Camera(60, 44, 50.0, 52.0, 30.0, 22.0, w2c)


@golden("e4b3629fd92bf19f")
def estimates() -> list[np.ndarray]:
    splats, out = shell(1)
    r = Numbers(2)
    directions, widths = unit(-out + 0.3 * r.normal(700, 3)), r.uniform(0.02, 0.6, 700)
    result = Surface.of(splats).at(splats.means + 0.05 * r.normal(700, 3), directions, widths)
    assert (result.patches > 0).mean() > 0.9 and (result.residuals > 0.2).sum() > 50
    parts = (result.points, result.normals, result.windows, result.residuals, result.agreement, result.trust)
    return [*parts, result.patches]


@golden("75f4bbb30c65a46c")
def seen_surface() -> list[np.ndarray]:
    splats, _ = shell(3, 1500)
    view = project(splats, camera())
    pixels = Numbers(4).integers(5, 44, 60) > 0
    seen = visible_surface(Surface.of(splats), splats, view, pixels)
    assert seen.trusted.sum() > 50
    at = seen.at(Numbers(5).uniform(-2, 62, 3000, 2))
    parts = (seen.index, seen.points, seen.normals, seen.windows, seen.residuals, seen.trusted)
    return [*parts, at.depth, at.normals, at.windows, at.residuals]


@golden("6cee15c352b34706")
def unwrapped() -> list[np.ndarray]:
    r = Numbers(6)
    normals = unit(r.normal(2500, 3))
    points = normals + r.uniform(-0.01, 0.01, 2500, 3)
    # A box's edge beside it: hinges.
    points[:800, 0] += 1.5 * (points[:800, 0] > 0)
    chosen = thinned(points, normals, 0.1)
    better = smoothed((points, normals), (points[chosen], normals[chosen]), 0.25)
    fold = np.where(better[0][:, :1] > 0, [[0.6, 0.8, 0.0]], [[0.0, 0.0, 1.0]])
    maps = [
        unwrap(better[0], n, np.array([0.25, 1, 0.5]), 0.1, (1.5, 1.25), 2.5)
        for n in (better[1], unit(better[1] + fold))
    ]
    at = maps[0].at(points, normals)
    assert all(m.reached.sum() > 100 for m in maps) and np.isfinite(at[0]).sum() > 500
    return [chosen, *better, *at, *(a for m in maps for a in (m.uv, m.right, m.distances, m.rims))]


@golden("99fdcd8d18d106a2")
def voxels() -> list[np.ndarray]:
    splats, _ = shell(7)
    out = []
    for resolution in (32, 45):
        grid = voxelize(splats, resolution)
        out += [grid.density, grid.occupancy]
    return out


@golden("0bb385bbc5c62ef8")
def rays() -> list[np.ndarray]:
    splats, _ = shell(8, 1000)
    grid, r = voxelize(splats, 45), Numbers(9)
    around = r.normal(4001, 3)
    around[:200, 0], around[200] = 0, 0
    out = []
    for origin in (np.array([0.25, -0.125, -5]), np.array([0.25, 0.125, 0.0])):
        aimed = around - origin * (origin[2] != 0)
        out += [*first_hits(grid.occupancy, grid, origin, aimed), *seen_voxels(grid, origin, aimed)]
    assert (out[0] >= 0).sum() > 1000
    mask = np.zeros((44, 60), bool)
    mask[15:25, 20:33] = True
    return [*out, editable_gaussians(grid, splats, camera(), mask)]


@golden("6a449d68e1f07f70")
def neighbours() -> list[np.ndarray]:
    r = Numbers(10)
    points, queries = r.uniform(-1, 1, 900, 3), r.uniform(-1.2, 1.2, 1200, 3)
    one, two = r.integers(500, 300), r.integers(500, 300)
    return [*nearest_within(points, queries, 0.2), components(points, 0.1), joined_labels(500, one, two)]


@golden("9a95d09a888b15b5")
def bends() -> list[np.ndarray]:
    return [bend_degrees(shell(11, 900)[0])]


@golden("b5304292e0b0da6b")
def shadows() -> list[np.ndarray]:
    splats, out = shell(12, 1200)
    points = np.concatenate([splats.means, splats.means * F(0.75)])  # one ball in another
    seen = visibility(points, np.concatenate([out, out]).astype(F), 0.08, 19)
    assert (seen.front < 0.5).sum() > 500
    return [seen.front, seen.back, seen.blocked_front, seen.blocked_back]


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("name", GOLDENS)
def test_bytes_are_those_of_every_machine(name: str, cpu: str, monkeypatch: pytest.MonkeyPatch) -> None:
    check(*GOLDENS[name], cpu, monkeypatch)
