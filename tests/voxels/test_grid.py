"""The voxel grid: grouping against plain sorting, density against closed forms, bounds against floaters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpainter.splats import Splats
from splatpainter.voxels.footprints import SIGMAS, index_bounds, touching
from splatpainter.voxels.grid import MIN_OCCUPIED_DENSITY, bounding_cube, voxelize
from tests.support.voxel_scenes import IDENTITY, make


def random_splats(seed: int, n: int, nan_rows: bool = True) -> Splats:
    rng = np.random.default_rng(seed)
    # Few distinct places and opacities, so that voxels are shared and ties are common.
    splats = make(
        rng.integers(0, 6, (n, 3)) * 0.1 + rng.normal(0, 1e-3, (n, 3)),
        np.exp(rng.normal(-4, 1, (n, 3))),
        rng.integers(0, 5, n) / 4,
        rng.normal(size=(n, 4)),
    )
    if nan_rows:
        splats.means[rng.random(n) < 0.1, 1] = np.nan
        splats.scales[rng.random(n) < 0.05, 0] = np.inf
    return splats


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 200), st.sampled_from([1, 3, 16, 128]))
def test_rows_are_grouped_as_plain_sorting_groups_them(seed: int, n: int, resolution: int) -> None:
    splats = random_splats(seed, n)
    drawable = [i for i in range(n) if np.isfinite(splats.means[i]).all() and np.isfinite(splats.scales[i]).all()]
    if not drawable:
        return
    grid = voxelize(splats, resolution)
    for row in range(n):
        if row not in drawable:
            assert grid.index[row] == -1
            continue
        position = (splats.means[row].astype(float) - grid.min_corner) * resolution / grid.extent
        cell = np.array([grid.index[row] // resolution**2, grid.index[row] // resolution % resolution, 0])
        cell[2] = grid.index[row] - (cell[0] * resolution + cell[1]) * resolution
        beyond = ((position < cell - 1e-6) & (cell > 0)) | ((position > cell + 1 + 1e-6) & (cell < resolution - 1))
        assert not beyond.any() and ((cell >= 0) & (cell < resolution)).all()
    expected = sorted(drawable, key=lambda i: (grid.index[i], -float(splats.opacities[i]), i))
    assert grid.order.tolist() == expected
    keys, counts = np.unique(grid.index[drawable], return_counts=True)
    assert grid.keys.tolist() == keys.tolist()
    assert np.diff(grid.starts).tolist() == counts.tolist() and grid.starts[0] == 0


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.integers(2, 150))
def test_permuting_rows_permutes_the_grouping_and_changes_no_bit_of_the_volumes(seed: int, n: int) -> None:
    splats = random_splats(seed, n, nan_rows=False)
    shuffle = np.random.default_rng(seed + 1).permutation(n)
    one, other = voxelize(splats, 32), voxelize(splats.take(shuffle), 32)
    assert (one.min_corner == other.min_corner).all() and one.extent == other.extent
    assert (one.index[shuffle] == other.index).all() and (one.outside[shuffle] == other.outside).all()
    assert (one.keys == other.keys).all() and (one.starts == other.starts).all()
    for a, b in zip(one.starts[:-1], one.starts[1:], strict=True):
        assert sorted(one.order[a:b]) == sorted(shuffle[other.order[a:b]])
        assert (splats.opacities[one.order[a:b]] == splats.opacities[shuffle[other.order[a:b]]]).all()
    assert (one.density == other.density).all() and (one.occupancy == other.occupancy).all()


def test_the_number_of_threads_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    splats = random_splats(3, 5000)
    grids = []
    for threads in ("1", "2", "7"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        grids.append(voxelize(splats, 64))
        touched = touching(splats, grids[0].order, grids[0].min_corner, grids[0].voxel, grids[0].density > 1)
        assert (
            touched == touching(splats, grids[0].order, grids[0].min_corner, grids[0].voxel, grids[-1].density > 1)
        ).all()
    assert (grids[0].density == grids[1].density).all() and (grids[0].density == grids[2].density).all()


def corners(half: float) -> np.ndarray:
    """Two faint rows that pin the cube's place, so that what is between them has known voxels."""
    return np.array([[-half] * 3, [half] * 3])


def framed(means, scales, opacities, quats=IDENTITY) -> Splats:
    return make(corners(1.0), 1e-4, 0.06).append(make(means, scales, opacities, quats))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ray_across_a_flat_row_picks_up_its_opacity(axis: int) -> None:
    centre, sigma = np.array([0.013, 0.011, 0.017]), np.full(3, 0.12)
    sigma[axis] = 1e-5
    grid = voxelize(framed([centre], sigma, 0.6), 64)
    through = grid.density.sum(axis).astype(float)
    # The integral of o exp(-r^2 / 2) over the disc r <= k is 2 pi o (1 - exp(-k^2 / 2)), in squares of sigma.
    total = 2 * math.pi * 0.6 * (1 - math.exp(-(SIGMAS**2) / 2)) * (0.12 / grid.voxel) ** 2
    assert through.sum() == pytest.approx(total, rel=0.05)
    # The same integral weighted by exp(-r^2 / 2), to see that the thickness is in the middle: pi o (1 - exp(-k^2)).
    positions = np.delete(grid.centers(np.arange(64**3)).reshape(64, 64, 64, 3).take(0, axis), axis, -1)
    squared = (((positions - np.delete(centre, axis)) / 0.12) ** 2).sum(-1)
    weighted = math.pi * 0.6 * (1 - math.exp(-(SIGMAS**2))) * (0.12 / grid.voxel) ** 2
    assert (through * np.exp(-0.5 * squared)).sum() == pytest.approx(weighted, rel=0.1)


def test_a_row_within_a_voxel_covers_its_share_of_the_face() -> None:
    grid = voxelize(framed([[0.3, 0.2, 0.1]], (1e-3, 2e-3, 1e-4), 0.5), 32)
    cell = tuple(((np.array([0.3, 0.2, 0.1]) - grid.min_corner) / grid.voxel).astype(int))
    expected = 0.5 * 2 * math.pi * 1e-3 * 2e-3 / grid.voxel**2
    assert grid.density[cell] == pytest.approx(expected, abs=2 / 2**20)


def test_a_ball_spreads_its_opacity_along_the_ray() -> None:
    grid = voxelize(framed([[0.003, 0.004, 0.005]], 0.12, 0.7), 64)
    through = grid.density.sum(2).astype(float)
    # A 3D Gaussian scaled so that its line through the middle is o, cut off at k sigma, within which the chi
    # distribution with three degrees of freedom has erf(k / sqrt 2) - sqrt(2 / pi) k exp(-k^2 / 2) of it.
    held = math.erf(SIGMAS / math.sqrt(2)) - math.sqrt(2 / math.pi) * SIGMAS * math.exp(-(SIGMAS**2) / 2)
    assert through.sum() == pytest.approx(2 * math.pi * 0.7 * held * (0.12 / grid.voxel) ** 2, rel=0.08)


def test_a_needle_fills_the_voxels_along_its_rotated_length_and_no_others() -> None:
    # A quarter turn of pi / 4 about z: the long x axis points along (1, 1, 0).
    quat = (3 * math.cos(math.pi / 8), 0, 0, 3 * math.sin(math.pi / 8))
    grid = voxelize(framed([[0.0, 0.0, 0.0]], (0.2, 1e-3, 1e-3), 0.9, quat), 64)
    cells = np.argwhere(grid.density > 0.001)
    points = grid.min_corner + (cells + 0.5) * grid.voxel
    away = np.abs(points[:, 0] - points[:, 1]) / math.sqrt(2)
    assert away.max() < grid.voxel and np.abs(points[:, 2]).max() < grid.voxel
    along = (points[:, 0] + points[:, 1]) / math.sqrt(2)
    reach = SIGMAS * 0.2
    assert along.max() == pytest.approx(reach, abs=grid.voxel) and along.min() == pytest.approx(-reach, abs=grid.voxel)
    steps = np.sort(along)
    assert np.diff(steps).max() < 2 * grid.voxel, "no gaps along the needle"


def test_rows_below_the_renderers_cut_have_no_density() -> None:
    grid = voxelize(framed([[0, 0, 0]] * 50, 0.2, 0.0039), 32)
    pins = (grid.density > 0).sum()
    assert pins <= 2
    assert len(grid.order) == 52


def test_one_faint_row_stops_no_ray_but_many_do() -> None:
    one = voxelize(framed([[0, 0, 0]], (0.3, 0.3, 1e-3), 0.05), 32)
    many = voxelize(framed([[0, 0, 0]] * 12, (0.3, 0.3, 1e-3), 0.05), 32)
    assert one.density[16, 16].max() > 0 and not one.occupancy.any()
    assert many.occupancy[16, 16].any()
    assert ((many.density > MIN_OCCUPIED_DENSITY) == many.occupancy).all()


def test_sparse_opaque_dots_are_occupied_though_they_cover_little() -> None:
    rng = np.random.default_rng(0)
    dots = make(rng.uniform(-1, 1, (300, 3)), 2e-4, 0.95)
    grid = voxelize(dots)
    assert grid.density.max() < MIN_OCCUPIED_DENSITY
    assert grid.occupancy.ravel()[grid.index].all()


def test_floaters_keep_a_voxel_and_cost_no_resolution() -> None:
    rng = np.random.default_rng(1)
    body = rng.uniform(-1, 1, (5000, 3))
    far = rng.choice([-1, 1], (60, 3)) * rng.uniform(50, 1e6, (60, 3))
    clean, dirty = voxelize(make(body)), voxelize(make(np.concatenate([body, far])))
    assert dirty.extent == pytest.approx(clean.extent, rel=0.02)
    assert not clean.outside.any()
    assert dirty.outside.nonzero()[0].tolist() == list(range(5000, 5060))
    assert (dirty.index >= 0).all() and (dirty.index < 128**3).all()
    assert dirty.occupancy.sum() == pytest.approx(clean.occupancy.sum(), rel=0.1)


def test_faint_rows_do_not_stretch_the_cube_and_a_sparse_end_stays_inside() -> None:
    rng = np.random.default_rng(2)
    head = np.concatenate([rng.uniform(-1, 1, (4000, 3)), rng.uniform([-0.2, 1, -0.2], [0.2, 1.9, 0.2], (40, 3))])
    haze = rng.uniform(-9, 9, (4000, 3))
    splats = make(np.concatenate([head, haze]), 0.01, np.repeat([0.9, 0.01], [4040, 4000]))
    grid = voxelize(splats)
    assert not grid.outside[:4040].any()
    assert grid.extent < 3.2


@pytest.mark.parametrize(
    "means",
    [[[5.0, -3.0, 2.0]], [[1, 1, 1]] * 7, [[1e7, 1e7, -1e7], [1e7 + 3, 1e7, -1e7]], [[0, 0, 0]], [[9e14, 0, 0]]],
)
def test_degenerate_assets_fit_their_cube(means) -> None:
    splats = make(means, 1e-3)
    grid = voxelize(splats)
    assert np.isfinite(grid.min_corner).all() and grid.extent > 0
    assert not grid.outside.any() and (grid.index >= 0).all()
    centres = grid.centers(grid.index)
    assert (np.abs(centres - splats.means) <= grid.voxel * 0.51 + 1e-12).all()


def test_the_cube_holds_every_centre_of_a_clean_asset() -> None:
    splats = make(np.random.default_rng(4).normal(size=(50, 3)), 0.02)
    lo, size = bounding_cube(splats)
    assert (splats.means >= lo).all() and (splats.means <= lo + size).all()
    assert size < np.ptp(splats.means, axis=0).max() + 4 * 0.02 + 1e-3


def test_an_asset_without_drawable_rows_is_refused_in_one_line() -> None:
    splats = make([[np.nan, 0, 0], [0, np.inf, 0]])
    with pytest.raises(
        ValueError, match=r"^voxels: expected at least one Gaussian that can be drawn, got none among 2$"
    ):
        voxelize(splats)


def test_extent_is_the_box_of_what_is_set() -> None:
    volume = np.zeros((5, 6, 7), np.uint8)
    assert index_bounds(volume).tolist() == [[0, 0]] * 3
    volume[1, 2, 3] = volume[3, 2, 6] = 1
    assert index_bounds(volume).tolist() == [[1, 4], [2, 3], [3, 7]]


@pytest.mark.shared
@pytest.mark.parametrize("name", ["massa.ply", "playbot_lod3.ply"])
def test_real_captures_fill_the_cube_and_lose_no_row(shared, name: str) -> None:
    from splatpainter.io import read

    splats = read(shared / "data" / "splats" / name)
    grid = voxelize(splats)
    assert not grid.outside.any() and len(grid.order) == len(splats)
    assert np.ptp(splats.means, axis=0).max() > 0.9 * grid.extent
    # Opaque rows lie in occupied voxels, nearly all of them.
    opaque = splats.opacities > 0.9
    assert grid.occupancy.ravel()[grid.index[opaque]].mean() > 0.9
