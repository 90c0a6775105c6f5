"""Rays through the cube: against slab tests of every occupied voxel, and against marching in tiny steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpainter.cameras import look_at, orbit
from splatpainter.voxels.grid import VoxelGrid, voxelize
from splatpainter.voxels.raycast import (
    MAX_RAY_THICKNESS,
    editable_gaussians,
    first_hits,
    inside,
    is_inside,
    seen_voxels,
)
from tests.support.voxel_scenes import make


def box_grid(volume: np.ndarray, lo=(0.0, 0.0, 0.0), size: float = 1.0) -> VoxelGrid:
    """A grid of a given density, without rows."""
    none = np.empty(0, np.int64)
    return VoxelGrid(
        resolution=len(volume),
        min_corner=np.array(lo, float),
        extent=size,
        index=none.astype(np.int32),
        outside=none.astype(bool),
        order=none,
        keys=none.astype(np.int32),
        starts=np.zeros(1, np.int64),
        density=volume.astype(np.float32),
        occupancy=(volume > 0).astype(np.uint8),
    )


def slabs(grid: VoxelGrid, cells: np.ndarray, origin: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(enter [P], leave [P]) of one ray through the boxes of the given voxels [P, 3], by the slab test."""
    low = grid.min_corner + cells * grid.voxel
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / ray, (low + grid.voxel - origin) / ray
    still = np.broadcast_to(ray == 0, a.shape)
    within = (origin >= low) & (origin < low + grid.voxel)
    near = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(a, b)).max(1)
    far = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(a, b)).min(1)
    return np.maximum(near, 0), far


def random_rays(rng: np.random.Generator, count: int) -> np.ndarray:
    rays = rng.normal(size=(count, 3))
    rays[rng.random((count, 3)) < 0.15] = 0  # along a face or an axis
    rays[(rays == 0).all(1)] = (0, 0, 1)
    return rays.astype(np.float32)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10**6), st.sampled_from([1, 2, 5, 9]), st.floats(0.0, 0.6), st.sampled_from([0.4, 1.5, 40.0]))
def test_the_first_hit_is_the_nearest_box_of_all(seed: int, resolution: int, filled: float, away: float) -> None:
    rng = np.random.default_rng(seed)
    volume = rng.random((resolution,) * 3) < filled
    grid = box_grid(volume, lo=rng.normal(size=3), size=float(rng.uniform(0.5, 3)))
    origin = grid.min_corner + grid.extent * (0.5 + away * rng.normal(size=3))
    rays = random_rays(rng, 30)
    aim = grid.min_corner + grid.extent * rng.random((15, 3)) - origin
    rays[:15] = np.where(rays[:15] == 0, 0, aim)
    rays[(rays == 0).all(1)] = (1, 0, 0)
    check_first_hits(grid, origin, rays)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.sampled_from([31, 64, 90]), st.integers(0, 12), st.sampled_from([0.1, 0.4, 1.5, 40.0]))
def test_rays_cross_empty_space_and_miss_nothing_in_it(seed: int, resolution: int, boxes: int, away: float) -> None:
    rng = np.random.default_rng(seed)
    volume = np.zeros((resolution,) * 3, bool)
    cells = rng.integers(0, resolution, (boxes, 3))
    volume[tuple(cells.T)] = True
    grid = box_grid(volume, lo=rng.normal(size=3), size=float(rng.uniform(0.5, 3)))
    origin = grid.min_corner + grid.extent * (0.5 + away * rng.normal(size=3))
    rays = random_rays(rng, 30)
    if boxes:  # at what is there, so that some hit
        aim = grid.min_corner + (cells[rng.integers(0, boxes, 20)] + rng.random((20, 3))) * grid.voxel - origin
        rays[:20] = np.where(rays[:20] == 0, 0, aim)
        rays[(rays == 0).all(1)] = (1, 0, 0)
    check_first_hits(grid, origin, rays)


def check_first_hits(grid: VoxelGrid, origin: np.ndarray, rays: np.ndarray) -> None:
    volume = grid.occupancy
    keys, distances = first_hits(grid.occupancy, grid, origin, rays)
    cells = np.argwhere(volume)
    # Rounding moves walls: a box that is only grazed may be hit or not.
    slack = 1e-5 * (grid.extent + np.linalg.norm(origin - grid.min_corner)) / np.linalg.norm(rays, axis=1)
    for ray, key, distance, loose in zip(rays.astype(float), keys, distances, slack, strict=True):
        near, far = slabs(grid, cells, origin, ray)
        sure = far - near > loose
        if key < 0:
            assert distance == -1 and not sure.any()
            continue
        cell = np.array(np.unravel_index(key, volume.shape))
        assert volume[tuple(cell)]
        enter, leave = slabs(grid, cell[None], origin, ray)
        assert leave[0] - enter[0] > -loose
        assert abs(distance - enter[0]) < loose
        assert not sure.any() or distance < near[sure].min() + loose


def test_results_have_the_shape_of_the_rays_and_distances_are_in_their_lengths() -> None:
    volume = np.zeros((4, 4, 4))
    volume[2, 1, 3] = 1
    grid = box_grid(volume, lo=(-1, -1, -1), size=2.0)
    rays = np.zeros((2, 3, 3))
    rays[..., 2] = [[1.0, 0.5, 4.0], [-1.0, 1e-3, 2.0]]
    keys, distances = first_hits(grid.occupancy, grid, np.array([0.2, -0.3, -5.0]), rays)
    assert keys.shape == distances.shape == (2, 3)
    assert keys.tolist() == [[39, 39, 39], [-1, 39, 39]]  # (2 * 4 + 1) * 4 + 3
    assert distances[0] == pytest.approx([5.5, 11.0, 1.375]) and distances[1, 0] == -1


def test_a_ray_that_starts_in_an_occupied_voxel_hits_it_at_once() -> None:
    volume = np.ones((3, 3, 3))
    grid = box_grid(volume)
    keys, distances = first_hits(grid.occupancy, grid, np.array([0.5, 0.5, 0.9]), np.array([[1.0, 2.0, 3.0]]))
    assert keys[0] == 1 * 9 + 1 * 3 + 2 and distances[0] == 0
    assert inside(grid, grid.occupancy, np.array([0.5, 0.5, 0.9]))
    assert not inside(grid, grid.occupancy, np.array([0.5, 0.5, 1.1]))
    assert not inside(grid, np.zeros((3, 3, 3), np.uint8), np.array([0.5, 0.5, 0.9]))


def test_whether_a_point_is_inside_needs_no_voxels_far_away() -> None:
    rng = np.random.default_rng(4)
    splats = make(rng.normal(0, [0.5, 0.2, 0.3], (800, 3)), 0.05, opacities=0.9)
    outliers = np.array([[9, 0, 0], [0, -7, 1], [0.3, 0.2, 0.1]], np.float32)
    for means in (splats.means, np.vstack([splats.means[:-3], outliers])):
        asset = replace(splats, means=means)
        grid, made = voxelize(asset), []
        points = np.vstack([rng.normal(0, away, (60, 3)) for away in (0.2, 0.8, 5.0, 40.0)])
        answers = [is_inside(asset, lambda: made.append(1) or grid, point) for point in points]  # noqa: B023
        assert answers == [inside(grid, grid.occupancy, point) for point in points]
        assert any(answers) and len(made) < len(points) / 2


def test_threads_share_the_rays_without_a_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    grid = box_grid(rng.random((16, 16, 16)) * (rng.random((16, 16, 16)) < 0.1))
    rays = random_rays(rng, 5000)
    results = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        origin = np.array([0.5, -1.0, 0.5])
        results.append([*first_hits(grid.occupancy, grid, origin, rays), *seen_voxels(grid, origin, rays)])
    for other in results[1:]:
        assert all((a == b).all() for a, b in zip(results[0], other, strict=True))


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.floats(0.5, 12.0))
def test_seen_voxels_are_those_before_the_thickness_is_spent(seed: int, dense: float) -> None:
    """One ray at a time, marched in steps of a five-hundredth of a voxel."""
    rng = np.random.default_rng(seed)
    volume = rng.random((6, 6, 6)) * dense * (rng.random((6, 6, 6)) < 0.7)
    grid = box_grid(volume, lo=(-3, -3, -3), size=6.0)
    origin = rng.normal(size=3) * 6
    ray = (rng.uniform(-2, 2, 3) - origin).astype(np.float32)
    ray /= np.linalg.norm(ray)
    seen, through = seen_voxels(grid, origin, ray[None] * np.float32(rng.uniform(0.1, 10)))
    step = 0.002
    step_cells = np.floor(origin + 3 + np.arange(0, 30, step)[:, None] * ray.astype(float)).astype(int)
    held = ((step_cells >= 0) & (step_cells < 6)).all(1)
    path = step_cells[held]
    thickness = volume[tuple(path.T)]
    before = np.concatenate([[0], np.cumsum(thickness * step)])
    for cell in np.unique(path, axis=0):
        at = np.flatnonzero((path == cell).all(1))
        if volume[tuple(cell)] == 0:
            assert not seen[tuple(cell)]
        elif len(at) > 5 and before[at[0]] < MAX_RAY_THICKNESS - 0.1:
            assert seen[tuple(cell)]
        elif before[at[0]] > MAX_RAY_THICKNESS + 0.1:
            assert not seen[tuple(cell)]
    assert seen.sum() <= len(np.unique(path, axis=0)) + 3  # no voxel off the path, but for grazed corners
    if abs(before[-1] - MAX_RAY_THICKNESS) > 0.1:
        assert through[0] == (before[-1] < MAX_RAY_THICKNESS)


def plate(z: float, half: float = 1.0, count: int = 60) -> np.ndarray:
    x, y = np.meshgrid(*[np.linspace(-half, half, count)] * 2)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1)


FLAT = (0.03, 0.03, 1e-3)
CAMERA = look_at((0, 0, -4), (0, 0, 0), up=(0, -1, 0), width=64, height=64, fov=45)


def disk(cx: float, cy: float, radius: float) -> np.ndarray:
    y, x = np.mgrid[:64, :64] + 0.5
    return (x - cx) ** 2 + (y - cy) ** 2 < radius**2


def projected(means: np.ndarray) -> np.ndarray:
    local = means @ CAMERA.world_to_camera[:3, :3].T + CAMERA.world_to_camera[:3, 3]
    return local[:, :2] / local[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]


def test_rows_under_the_brush_may_change_and_those_behind_or_beside_may_not() -> None:
    means = np.concatenate([plate(-0.5), plate(0.5)])
    splats = make(means, FLAT, 0.95)
    rows = editable_gaussians(voxelize(splats, 64), splats, CAMERA, disk(32, 32, 8))
    front = np.arange(len(means)) < 3600
    away = np.linalg.norm(projected(means) - 32, axis=1)
    assert rows[front & (away < 8)].all()
    assert not rows[~front].any()
    assert not rows[front & (away > 8 + 8)].any()


def test_through_a_hole_the_rows_behind_may_change() -> None:
    near = plate(-0.5)
    near = near[np.abs(near[:, :2]).max(1) > 0.35]
    means = np.concatenate([near, plate(0.5)])
    splats = make(means, FLAT, 0.95)
    rows = editable_gaussians(voxelize(splats, 64), splats, CAMERA, disk(32, 32, 3))
    behind = np.arange(len(means)) >= len(near)
    assert rows[behind & (np.linalg.norm(projected(means) - 32, axis=1) < 3)].all()
    assert not rows[~behind].any()


def test_a_long_row_may_change_where_it_is_touched_far_from_its_centre() -> None:
    needle = [[-0.9, 0.0, -0.6]]
    splats = make(np.concatenate([plate(0.0), needle]), FLAT, 0.95)
    splats.scales[-1] = (0.45, 0.01, 0.01)
    grid = voxelize(splats, 64)
    tip = projected(np.array([[-0.9 + 0.7, 0.0, -0.6]]))[0]
    assert editable_gaussians(grid, splats, CAMERA, disk(tip[0], tip[1], 2))[-1]
    assert not editable_gaussians(grid, splats, CAMERA, disk(tip[0], tip[1] + 12, 2))[-1]


def test_a_veil_does_not_hide_the_surface() -> None:
    splats = make(np.concatenate([plate(-0.6, count=30), plate(0.2)]), FLAT, 0.95)
    splats.opacities[:900] = 0.06
    rows = editable_gaussians(voxelize(splats, 64), splats, CAMERA, disk(32, 32, 8))
    near = np.linalg.norm(projected(splats.means) - 32, axis=1) < 8
    assert rows[900:][near[900:]].all()
    assert rows[:900][near[:900]].all(), "a veil is seen too"


def test_outliers_may_change_only_where_they_show() -> None:
    body = plate(0.0)
    strays = [[0, 0, 40.0], [30.0, 0, 60.0], [0.15, 0, -3.5], [0, 0, -9.0]]
    splats = make(np.concatenate([body, strays]), FLAT, 0.95)
    grid = voxelize(splats, 64)
    assert grid.outside.nonzero()[0].tolist() == [3600, 3601, 3602, 3603]
    full_mask = np.ones((64, 64), bool)
    hidden, beside, before, back = editable_gaussians(grid, splats, CAMERA, full_mask)[-4:]
    assert (hidden, beside, before, back) == (False, False, True, False)
    hole = make(np.concatenate([body[np.abs(body[:, :2]).max(1) > 0.4], strays]), FLAT, 0.95)
    rows = editable_gaussians(voxelize(hole, 64), hole, CAMERA, disk(32, 32, 2))
    assert rows[-4:].tolist() == [True, False, False, False]


def test_no_pixels_no_rows_and_undrawable_rows_never() -> None:
    splats = make(plate(0.0), FLAT, 0.95)
    splats.means[17, 0] = np.nan
    grid = voxelize(splats, 64)
    assert not editable_gaussians(grid, splats, CAMERA, np.zeros((64, 64), bool)).any()
    rows = editable_gaussians(grid, splats, CAMERA, np.ones((64, 64), bool))
    assert not rows[17] and rows.sum() == 3599


def test_a_mask_of_another_size_is_refused_in_one_line() -> None:
    splats = make(plate(0.0), FLAT)
    with pytest.raises(ValueError, match=r"^mask: expected the size of its view, 64x64, got 32x64$"):
        editable_gaussians(voxelize(splats, 16), splats, CAMERA, np.ones((64, 32), bool))


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 251, 1024])
def test_rows_that_contribute_to_masked_pixels_are_editable(seed: int) -> None:
    """Weights w_ip by compositing every row at every pixel, sorted by depth: a shell of thick, faint, long rows."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(1500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    scales = np.exp(rng.normal(-3, 0.6, (1500, 3)))
    splats = make(points, scales, rng.uniform(0.1, 0.99, 1500), rng.normal(size=(1500, 4)))
    mask = disk(rng.uniform(20, 44), rng.uniform(20, 44), rng.uniform(2, 8))
    weights = composited_weights(splats, mask)
    rows = editable_gaussians(voxelize(splats, 128), splats, CAMERA, mask)
    assert weights[rows].sum() > 0.97 * weights.sum()
    assert rows[weights > 0.02 * mask.sum()].all(), "2 % of the colour under the brush"
    assert rows.sum() < 450, "most of the shell is behind or beside"


def composited_weights(splats, mask: np.ndarray) -> np.ndarray:
    """[N] sum over the masked pixels of alpha_ip prod_{j before i} (1 - alpha_jp), by the EWA projection (Zwicker et
    al. 2001) in float64."""
    w2c, f = CAMERA.world_to_camera, CAMERA.fx
    q = splats.quats.astype(float) / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    axes = np.stack([rotated(q, unit) for unit in np.eye(3)], 2) * splats.scales[:, None, :]
    local = splats.means @ w2c[:3, :3].T + w2c[:3, 3]
    x, y, z = local.T
    jacobian = np.zeros((len(splats), 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = f / z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -f * x / z**2, -f * y / z**2
    half = jacobian @ w2c[:3, :3] @ axes
    inverse = np.linalg.inv(half @ half.transpose(0, 2, 1) + 0.3 * np.eye(2))
    centre = projected(splats.means)
    ys, xs = np.nonzero(mask)
    delta = np.stack([xs + 0.5, ys + 0.5], 1)[:, None] - centre
    alpha = splats.opacities * np.exp(-0.5 * np.einsum("pni,nij,pnj->pn", delta, inverse, delta))
    alpha = np.where(alpha < 1 / 255, 0, np.minimum(alpha, 0.999))
    order = np.argsort(z)
    alpha = alpha[:, order]
    before = np.cumprod(np.concatenate([np.ones((len(alpha), 1)), 1 - alpha[:, :-1]], 1), 1)
    weights = np.zeros(len(splats))
    weights[order] = (alpha * before).sum(0)
    return weights


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """v turned by unit quaternions w, x, y, z: v + 2 w (u x v) + 2 u x (u x v)."""
    u, w = q[:, 1:], q[:, :1]
    once = np.cross(u, v)
    return v + 2 * (w * once + np.cross(u, once))


@pytest.mark.shared
@pytest.mark.parametrize("start", [0.0, 90.0, 180.0, 270.0])
def test_on_a_real_capture_the_near_side_is_editable_and_the_far_side_is_not(shared, start: float) -> None:
    from splatpainter.io import read

    splats = read(shared / "data" / "splats" / "playbot_lod3.ply")
    grid = voxelize(splats)
    # The robot's head is some 0.6 wide, its shell about 0.1 thick, and nothing stands in front of it.
    (camera,) = orbit((0, -0.7, 0), 1.6, 1, elevation=10, start=start, up=(0, -1, 0), width=128, height=128)
    y, x = np.mgrid[:128, :128] + 0.5
    mask = (x - 64) ** 2 + (y - 64) ** 2 < 8**2
    assert not inside(grid, grid.occupancy, camera.position)
    origin, rays = camera.rays()
    keys, distances = first_hits(grid.occupancy, grid, origin, rays[mask])
    assert (keys >= 0).all()
    surface = np.median(distances)
    local = splats.means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    picture = local[:, :2] / local[:, 2:] * camera.fx + 64
    under = (np.linalg.norm(picture - 64, axis=1) < 7) & (splats.opacities > 0.3)
    near, far = under & (local[:, 2] < surface + 0.05), under & (local[:, 2] > surface + 0.35)
    rows = editable_gaussians(grid, splats, camera, mask)
    assert near.sum() > 10 and rows[near].mean() > 0.95
    assert far.sum() > 30 and rows[far].mean() < 0.05


def test_a_camera_of_absurd_focal_length_gives_no_warning() -> None:
    splats = make(np.concatenate([plate(0.0), [[30.0, 1.0, 60.0], [9.0, 0, -3.0]]]), FLAT, 0.95)
    camera = replace(CAMERA, fx=1e308, fy=1e308)
    assert not editable_gaussians(voxelize(splats, 64), splats, camera, np.ones((64, 64), bool))[-2:].any()
