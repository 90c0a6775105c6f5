"""Surfels: coverage, evenness, materials and shadows against closed forms; the coarse asset against the dense one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from splatpainter import lighting as visibility
from splatpainter.cameras import orbit
from splatpainter.rendering import render
from splatpainter.splats import SH_C0
from splatpainter.transforms import sh_basis
from splattrain.data import poisson_disk, shapes
from splattrain.data.lights import equirectangular, shade, uniform_light
from splattrain.data.materials import Material, sample_texture
from splattrain.data.meshes import Mesh
from splattrain.data.procedural import random_mesh
from splattrain.data.surfels import Surfels, coarse_asset, sample_surfels, to_splats


def mesh_of(solid: shapes.Solid, *materials: Material, ids: np.ndarray | None = None, name: str = "solid") -> Mesh:
    return Mesh(
        name,
        solid.vertices.astype(np.float32),
        solid.faces,
        solid.normals.astype(np.float32),
        solid.uvs.astype(np.float32),
        np.zeros(len(solid.faces), np.int64) if ids is None else ids,
        materials or (Material(),),
    )


def ball(*materials: Material) -> Mesh:
    return mesh_of(shapes.primitive("ellipsoid", np.random.default_rng(0)), *materials)


def quad(size: float, z: float = 0.0, up: bool = True) -> shapes.Solid:
    points = np.array([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    normals = np.tile([0.0, 0, 1 if up else -1], (4, 1))
    return shapes.Solid(points, faces if up else faces[:, ::-1], uvs, normals)


@pytest.fixture(scope="module")
def dense() -> Surfels:
    return sample_surfels(random_mesh(5), 30000, seed=1)


def test_surfels_are_even_and_lie_on_the_surface_facing_out() -> None:
    surfels = sample_surfels(ball(), 5000)
    points = surfels.means.numpy()
    assert len(surfels) == 5000
    radius = np.linalg.norm(points, axis=1)
    assert (np.abs(radius - 1) < 0.02).all()  # a fine triangle mesh of the unit ball
    np.testing.assert_allclose(surfels.normals.numpy(), points / radius[:, None], atol=0.1)
    step = np.sqrt(4 * np.pi / 5000)
    gap = KDTree(points).query(points, 2)[0][:, 1] / step
    # Random points: mean 0.5, deviation 0.26. A triangular lattice: 1.07 and 0.
    assert gap.mean() > 0.7 and gap.std() < 0.12 and gap.min() > 0.4
    third = Rotation.from_quat(surfels.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()[:, :, 2]
    assert ((third * points).sum(1) > 0.98).all()
    assert (surfels.scales[:, 2] < 0.3 * surfels.scales[:, 0]).all()


def test_sampling_repeats_from_the_seed() -> None:
    first, again, other = (sample_surfels(ball(), 500, seed) for seed in (3, 3, 4))
    assert all(torch.equal(getattr(first, k), getattr(again, k)) for k in vars(first))
    assert not torch.equal(first.means, other.means)


def test_no_holes_at_256_pixels() -> None:
    surfels = sample_surfels(ball(), 60000)
    view = orbit((0, 0, 0), 2.7, 1, width=256, height=256)[0]
    alpha = render(to_splats(surfels, torch.zeros(len(surfels), 1, 3)), view).alphas[0, :, :, 0].numpy()
    away = np.hypot(*(np.mgrid[0:256, 0:256] + 0.5 - 128))
    rim = np.tan(np.arcsin(1 / 2.7)) * view.fx
    assert alpha[away < rim - 2].min() > 0.97
    assert alpha[away > rim + 3].max() < 0.03


def test_albedo_is_the_texture_in_linear_light_times_the_factor() -> None:
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:, :32], pixels[:, 32:] = [255, 0, 128], [0, 188, 0]
    look = Material(pixels, (0.5, 1.0, 1.0), metallic=0.3, roughness=0.4)
    surfels = sample_surfels(mesh_of(quad(0.9), look), 3000)
    x = surfels.means[:, 0].numpy()
    left, right = surfels.albedo.numpy()[x < -0.15], surfels.albedo.numpy()[(x > 0.15) & (x < 0.8)]
    np.testing.assert_allclose(left[left[:, 0] > 0.4].mean(0), [0.5, 0, 0.2159], atol=0.01)  # sRGB 128 is 0.2159
    np.testing.assert_allclose(right.mean(0), [0, 0.5029, 0], atol=0.01)
    np.testing.assert_allclose(surfels.metallic, 0.3, atol=1e-6)
    np.testing.assert_allclose(surfels.roughness, 0.4, atol=1e-6)


def test_textures_are_interpolated_and_repeat() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4, 1)
    actual = (
        sample_texture(pixels, np.array([[0.125, 1 - 1 / 6], [1.125, -1 / 6], [0.25, 0.5], [0.0, 0.5]], np.float32))
        * 255
    )
    np.testing.assert_allclose(actual[:, 0], [0, 0, 4.5, 5.5], atol=1e-4)  # last: between the last and the first column


def test_normal_maps_bend_normals_along_u_and_v() -> None:
    tilted = np.full((4, 4, 3), [218, 128, 218], np.uint8)  # (0.71, 0, 0.71): towards +u
    surfels = sample_surfels(mesh_of(quad(0.9), Material(normal_map=tilted)), 500)
    np.testing.assert_allclose(surfels.normals.numpy(), np.tile([0.707, 0.0, 0.707], (500, 1)), atol=0.02)
    tilted = np.full((4, 4, 3), [128, 218, 218], np.uint8)  # towards +v
    surfels = sample_surfels(mesh_of(quad(0.9), Material(normal_map=tilted)), 500)
    np.testing.assert_allclose(surfels.normals.numpy(), np.tile([0.0, 0.707, 0.707], (500, 1)), atol=0.02)


def test_what_is_closed_in_is_left_out_and_inward_faces_are_turned() -> None:
    outer = shapes.primitive("box", np.random.default_rng(0))
    inner = outer.moved(0.4 * np.eye(3), np.zeros(3))
    surfels = sample_surfels(mesh_of(shapes.joined([outer, inner])), 4000)
    assert (np.abs(surfels.means.numpy()).max(1) < 0.95).mean() < 0.002  # light finds a pinhole now and then
    flipped = shapes.Solid(outer.vertices, outer.faces[:, ::-1], outer.uvs, -outer.normals)
    surfels = sample_surfels(mesh_of(flipped), 2000)
    assert ((surfels.normals * surfels.means).sum(1) > 0).float().mean() > 0.99  # at the edges light leaks in


def test_cut_out_alpha_makes_holes() -> None:
    alpha = np.zeros((8, 8), np.uint8)
    alpha[:, 4:] = 255
    surfels = sample_surfels(mesh_of(quad(0.9), Material(alpha=alpha)), 500)
    assert surfels.means[:, 0].min() > -0.1
    with pytest.raises(ValueError, match="transparent everywhere"):
        sample_surfels(mesh_of(quad(0.9), Material(alpha=0 * alpha)), 500)


def test_open_surfaces_see_everything_and_transfer_is_the_cosine_lobe() -> None:
    surfels = sample_surfels(ball(), 4000)
    assert surfels.occlusion.min() > 0.97
    towards, area = equirectangular(64, 128, dtype=torch.float64)
    normals = surfels.normals[:5].double()
    cosine = torch.einsum("hwc,nc->nhw", towards, normals).clamp_min(0)
    truth = torch.einsum("nhw,hwk->nk", cosine * area, sh_basis(towards, 2))
    torch.testing.assert_close(surfels.transfer[:5].double(), truth, atol=0.02, rtol=0)


def plates(count: int) -> tuple[np.ndarray, visibility.Visibility]:
    """What the middle of a square plate sees below another one, half a side above: (Gaussians of the middle,
    visibility)."""
    points, normals = [], []
    rng = np.random.default_rng(0)
    for solid in (quad(0.9), quad(0.9, z=0.9, up=False)):
        face, weights = poisson_disk.scatter(solid.vertices, solid.faces, count, rng)
        points.append(np.einsum("nk,nkc->nc", weights, solid.vertices[solid.faces[face]]).astype(np.float32))
        normals.append(np.tile(solid.normals[0].astype(np.float32), (count, 1)))
    middle = np.flatnonzero(np.linalg.norm(points[0][:, :2], axis=1) < 0.06)
    return middle, visibility.visibility(np.concatenate(points), np.concatenate(normals), 1.8 / np.sqrt(count), 256)


def test_occlusion_below_a_plate_is_the_view_factor() -> None:
    """The share of light that the plate takes is the view factor of four squares, each with a corner above the point
    (Howell's catalogue, B-4). Shadow maps widen the plate by their pixel: the error falls with the spacing."""
    ratio = 1 / np.sqrt(2)  # side over distance 1: a / sqrt(1 + a^2)
    truth = 1 - 4 * (2 * ratio * np.arctan(ratio)) / (2 * np.pi)
    (rough, some), (middle, more) = plates(5000), plates(20000)
    first, second = some.front[rough].mean(), more.front[middle].mean()
    assert abs(second - truth) < 0.6 * abs(first - truth) + 0.005
    assert second == pytest.approx(truth, abs=0.04)
    assert 2 * second - first == pytest.approx(truth, abs=0.02)  # extrapolated to spacing 0
    assert more.back[middle].mean() > 0.99
    # The transfer of the constant coefficient is the open share, in SH's units.
    lost = more.blocked_front[middle][:, 0] / (np.pi * SH_C0)
    np.testing.assert_allclose(1 - lost, more.front[middle], atol=1e-3)


def test_neighbour_searches_agree_with_a_tree() -> None:
    rng = np.random.default_rng(0)
    points, centers = (rng.random((n, 3)).astype(np.float32) for n in (500, 60))
    up = np.array([[0, 0, 1]], np.float32)
    same = poisson_disk.nearest(points, np.repeat(up, 500, 0), centers, np.repeat(up, 60, 0), 0.3)
    np.testing.assert_array_equal(same, KDTree(centers).query(points)[1])
    gaps = poisson_disk.spacing_around(points, np.repeat(up, 500, 0), 0.3)
    np.testing.assert_allclose(gaps, KDTree(points).query(points, 6)[0][:, 1:].mean(1), rtol=1e-4)


def test_selected_points_keep_their_distance() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((4000, 2)), np.zeros((4000, 1))], 1).astype(np.float32)
    chosen = poisson_disk.select(
        points, np.tile(np.array([0, 0, 1], np.float32), (4000, 1)), 500, 1 / np.sqrt(500), rng
    )
    assert len(np.unique(chosen)) == 500
    assert KDTree(points[chosen]).query(points[chosen], 2)[0][:, 1].min() > 0.5 / np.sqrt(500)


def test_a_coarse_asset_looks_like_the_dense_truth_and_less_so_when_rough(dense: Surfels) -> None:
    views = orbit((0, 0, 0), 2.7, 3, width=64, height=64)
    light = uniform_light()

    def pictures(surfels: Surfels) -> torch.Tensor:
        return render(to_splats(surfels, shade(surfels, light)), views).colors

    truth = pictures(dense)
    errors = []
    for roughness in (0.0, 1.0):
        coarse = coarse_asset(dense, 4000, seed=2, roughness=roughness)
        assert len(coarse) == 4000 and all(torch.isfinite(v).all() for v in vars(coarse).values())
        assert coarse.scales[:, 0].median() > 1.5 * dense.scales[:, 0].median()
        errors.append(float((pictures(coarse) - truth).square().mean()))
    assert -10 * np.log10(errors[0]) > 24 and errors[1] > errors[0]
    assert coarse.opacities.min() < 0.6
    torch.testing.assert_close(coarse.albedo.mean(0), dense.albedo.mean(0), atol=0.05, rtol=0)
    again = coarse_asset(dense, 4000, seed=2, roughness=1.0)
    assert torch.equal(again.means, coarse.means) and torch.equal(again.opacities, coarse.opacities)


def test_the_dark_side_of_a_thin_wall_gets_no_coarse_gaussians() -> None:
    ball_shape = shapes.primitive("ellipsoid", np.random.default_rng(0))
    cup = shapes.cut(ball_shape, lambda p: 0.7 - p[:, 1], 0.02)  # a bowl with a narrow opening above
    surfels = sample_surfels(mesh_of(cup), 6000)
    coarse = coarse_asset(surfels, 600, roughness=0.0)
    inward = [float(((s.normals * s.means).sum(1) < -0.5).float().mean()) for s in (surfels, coarse)]
    assert inward[0] > 0.3 and inward[1] < 0.1


def test_taking_gaussians_takes_every_field(dense: Surfels) -> None:
    ids = torch.tensor([5, 3])
    some = dense.take(ids)
    assert len(some) == 2
    assert all(torch.equal(getattr(some, k), getattr(dense, k)[ids]) for k in vars(dense))


def test_bad_arguments_are_refused(dense: Surfels) -> None:
    with pytest.raises(ValueError, match="at least one surfel"):
        sample_surfels(ball(), 0)
    with pytest.raises(ValueError, match="1 to"):
        coarse_asset(dense, len(dense) + 1)
    with pytest.raises(ValueError, match="roughness"):
        coarse_asset(dense, 10, roughness=2)
