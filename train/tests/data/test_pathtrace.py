"""Path traced truth against closed forms, and against this package's own cameras, renderer and shading."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.rendering import Render, render
from splattrain.data.environments import decode_exr, encode_exr
from splattrain.data.lights import make_light, shade, tone_map
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh
from splattrain.data.mitsuba_backend import available, find_llvm, use_mitsuba
from splattrain.data.pathtrace import PathOptions, PathTraced, display, path_trace
from tests.support.cli_scenes import ball
from tests.support.data_meshes import MATT, quad, sphere

pytest.importorskip("mitsuba")
WHITE = np.ones((8, 16, 3), np.float32)
QUICK = PathOptions(samples=64, variant="scalar_rgb", model="diffuse")


def view(size: int = 24, distance: float = 4.0) -> Camera:
    return look_at([0, 0, distance], [0, 0, 0], width=size, height=size, fov=40)


def traced(mesh: Mesh, environment: np.ndarray = WHITE, options: PathOptions = QUICK, size: int = 24) -> PathTraced:
    return path_trace(mesh, environment, [view(size)], options)


def texels(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(directions [h, w, 3], solid angles [h, w]) by the layout that lights.Light states: u = atan2(x, -z)."""
    v, u = (np.arange(height) + 0.5) / height * np.pi, (np.arange(width) + 0.5) / width * 2 * np.pi
    v, u = np.meshgrid(v, u, indexing="ij")
    towards = np.stack([np.sin(v) * np.sin(u), np.cos(v), -np.sin(v) * np.cos(u)], -1)
    return towards, np.sin(v) * 2 * np.pi**2 / (height * width)


def lamp(direction: list[float], radius: float = 0.2) -> np.ndarray:
    """[64, 128, 3] radiance 10 within `radius` radians of a direction."""
    towards, _ = texels(64, 128)
    axis = np.array(direction) / np.linalg.norm(direction)
    return np.repeat(10.0 * (towards @ axis > np.cos(radius))[..., None], 3, 2).astype(np.float32)


def irradiance(environment: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[..., 3] float64: the cosine integral over all texels."""
    towards, area = texels(*environment.shape[:2])
    cosines = np.clip(normals @ towards.reshape(-1, 3).T, 0, None)
    return (cosines * area.reshape(-1)) @ environment.reshape(-1, 3).astype(np.float64)


# Energy and light


def test_a_white_convex_object_in_uniform_light_of_one_is_one() -> None:
    done = traced(sphere())
    inside = done.alphas[0] == 1
    assert inside.sum() > 100 and done.repaired == 0
    assert np.abs(done.radiance[0][inside].mean(0) - 1).max() < 0.01
    assert (done.radiance[0][done.alphas[0] == 0] == 0).all()  # the light itself is not seen


def test_the_principled_surface_is_nearly_as_white() -> None:
    done = traced(sphere(), options=replace(QUICK, model="principled"))
    mean = done.radiance[0][done.alphas[0] == 1].mean()
    assert 0.9 < mean < 1.1  # Burley's diffuse is brighter at the rim than Lambert's, and 4 % are reflected


@pytest.mark.parametrize("direction", [[1, 0.3, 0.5], [-0.6, 0.8, 0.2], [0.2, -0.7, 0.9]])
def test_a_lamp_lights_what_faces_it_as_the_cosine_integral_says(direction: list[float]) -> None:
    environment = lamp(direction)
    done = traced(sphere(level=5), environment, replace(QUICK, samples=128, depth=2), size=20)
    origin, rays = view(20).rays()
    along = (rays.astype(np.float64) * -origin).sum(-1)
    inside = (done.alphas[0] == 1) & (along**2 - origin @ origin + 1 > 0.2)  # off the rim: one normal per pixel
    t = along - np.sqrt(np.clip(along**2 - origin @ origin + 1, 0, None))
    normals = (origin + t[..., None] * rays)[inside]
    expected = irradiance(environment, normals) / np.pi
    assert np.abs(done.radiance[0][inside] - expected).mean() < 0.03 * expected.max()
    assert expected.max() > 0.2


def test_surfels_and_paths_agree_on_a_matt_object_in_a_soft_light() -> None:
    from splattrain.data.surfels import sample_surfels, to_splats

    colors = np.random.default_rng(0).integers(60, 220, (4, 4, 3)).astype(np.uint8)
    mesh = quad(replace(MATT, base_color=np.kron(colors, np.ones((8, 8, 1), np.uint8))))
    towards, _ = texels(32, 64)
    light = make_light(0.4 + 0.6 * np.clip(towards[..., 1:2], 0, None) * np.array([1.0, 0.9, 0.7]))
    camera = look_at([0.6, 0.5, 3], [0, 0, 0], width=40, height=40, fov=40, background=(0.2, 0.4, 0.6))
    done = path_trace(mesh, light.environment.numpy(), [camera], replace(QUICK, samples=128))
    ours = display(done, float(light.exposure), [camera])[0]
    surfels = sample_surfels(mesh, 6000)
    theirs = np.clip(render(to_splats(surfels, shade(surfels, light)), camera).colors[0].numpy(), 0, 1)
    inside = done.alphas[0] == 1
    assert np.abs(ours[inside].mean(0) - theirs[inside].mean(0)).max() < 0.04
    assert 10 * np.log10(1 / np.mean((ours - theirs)[inside] ** 2)) > 22  # texel edges differ by the splats' blur
    assert np.allclose(ours[done.alphas[0] == 0], (0.2, 0.4, 0.6))


# Cameras


@pytest.mark.parametrize("shift", [(0.0, 0.0), (7.0, -5.0)])
def test_silhouette_and_depth_are_those_of_the_camera(shift: tuple[float, float]) -> None:
    camera = orbit([0.3, 0.1, 0.0], 4, 1, width=48, height=40, fov=40)[0]
    camera = replace(camera, cx=camera.cx + shift[0], cy=camera.cy + shift[1])
    done = path_trace(sphere(level=5), WHITE, [camera], replace(QUICK, samples=32))
    origin, rays = camera.rays()
    along = -(rays * origin).sum(-1)
    room = along**2 - origin @ origin + 1
    fine = -(camera.resized(48 * 8, 40 * 8).rays()[1] * origin).sum(-1)
    covered = (fine**2 - origin @ origin + 1 > 0).reshape(40, 8, 48, 8).mean((1, 3))
    assert np.abs(done.alphas[0] - covered).max() < 0.35  # 32 samples of a pixel's area
    assert abs(done.alphas[0].sum() - covered.sum()) < 2
    inner = room > 0.1
    depth = (along - np.sqrt(np.clip(room, 0, None))) * (rays @ camera.forward.astype(np.float32))
    assert (done.alphas[0][inner] == 1).all()
    assert np.abs(done.depths[0] - depth)[inner].max() < 0.05  # the mean over a pixel that is seen aslant
    assert np.abs(np.mean((done.depths[0] - depth)[inner])) < 0.002
    ours = render(ball(20_000), camera)
    assert (ours.alphas[0, ..., 0][inner] > 0.95).all()
    centroids = [
        np.array([np.average(grid, weights=alpha) for grid in np.mgrid[:40, :48]]) for alpha in both(done, ours)
    ]
    assert np.abs(centroids[0] - centroids[1]).max() < 0.1  # pixels, between the two silhouettes' centres
    assert np.abs(done.depths[0] - ours.depths[0, ..., 0])[inner].mean() < 0.05
    assert (done.depths[0][done.alphas[0] == 0] == 0).all()


def both(done: PathTraced, ours: Render) -> tuple[np.ndarray, np.ndarray]:
    return done.alphas[0], ours.alphas[0, ..., 0]


def test_more_views_are_the_same_views_with_other_noise() -> None:
    cameras = [view(), view()]
    done = path_trace(sphere(level=2), lamp([0, 1, 1], 1.0), cameras, replace(QUICK, samples=4))
    again = path_trace(sphere(level=2), lamp([0, 1, 1], 1.0), cameras, replace(QUICK, samples=4))
    assert (done.radiance == again.radiance).all()
    assert (done.radiance[0] != done.radiance[1]).any()


# Materials


def test_a_texture_lies_as_the_mesh_says() -> None:
    corners = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)  # first row: v near 1
    texture = np.kron(corners, np.ones((8, 8, 1), np.uint8))
    done = traced(quad(Material(base_color=texture, base_factor=(0.5, 0.5, 0.5))), size=16)
    quarter = [done.radiance[0][y, x] for y, x in ((5, 5), (5, 10), (10, 5), (10, 10))]  # top left, top right, ...
    assert np.allclose(quarter, 0.5 * corners.reshape(4, 3) / 255, atol=0.03)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_normal_map_tilts_the_surface_along_its_texture(mirrored: bool) -> None:
    tilt = np.array([0.4, 0.3, np.sqrt(1 - 0.25)])
    picture = np.tile(np.round(tilt * 127 + 128).astype(np.uint8), (4, 4, 1))
    uvs = [[1.0, 0], [0, 0], [0, 1], [1, 1]] if mirrored else None
    environment = lamp([0.5, 0.2, 1], 0.3)
    done = traced(quad(Material(normal_map=picture), uvs), environment, replace(QUICK, samples=512, depth=2), size=8)
    normal = tilt * ([-1, 1, 1] if mirrored else [1, 1, 1])  # u runs the other way, v does not
    expected = irradiance(environment, normal) / np.pi
    assert np.allclose(done.radiance[0][3:5, 3:5].mean((0, 1)), expected, rtol=0.05)


def test_a_flat_normal_map_changes_nothing_and_cutouts_are_holes() -> None:
    plain = traced(quad(MATT))
    flat = traced(quad(replace(MATT, normal_map=np.full((4, 4, 3), (128, 128, 255), np.uint8))))
    assert abs(plain.radiance[0].mean() - flat.radiance[0].mean()) < 0.01
    alpha = np.zeros((16, 16), np.uint8)
    alpha[:8] = 255  # only v > 1/2
    cut = traced(quad(replace(MATT, alpha=alpha)), size=16)
    assert cut.alphas[0][5, 8] == 1 and cut.alphas[0][10, 8] == 0


def test_vertex_colours_and_both_sides() -> None:
    mesh = replace(quad(MATT), colors=np.tile(np.array([0.5, 0.2, 0.1], np.float32), (4, 1)))
    back = look_at([0, 0, -4], [0, 0, 0], width=16, height=16, fov=40)
    for camera in (view(16), back):
        done = path_trace(mesh, WHITE, [camera], QUICK)
        assert np.allclose(done.radiance[0][6:10, 6:10].mean((0, 1)), [0.5, 0.2, 0.1], atol=0.01)


def test_metal_reflects_its_colour_and_the_map_multiplies_the_factor() -> None:
    metal = Material(base_factor=(0.9, 0.5, 0.1), metallic=1.0, roughness=0.3)
    mapped = replace(metal, metallic_roughness=np.full((4, 4, 2), 255, np.uint8))
    options = replace(QUICK, model="principled")
    done = [traced(quad(m), options=options).radiance[0][12, 12] for m in (metal, mapped)]
    assert np.allclose(done[0], [0.9, 0.5, 0.1], atol=0.06)
    assert np.allclose(done[0], done[1], atol=0.02)


# Display, storage, refusals


def test_display_is_the_shared_tone_map_over_the_background() -> None:
    radiance = np.array([[[[0.2, 0.1, 0.05], [4.0, 1.0, 0.5]]]], np.float32)
    done = PathTraced(radiance, np.array([[[0.5, 1.0]]], np.float32), np.zeros((1, 1, 2), np.float32))
    camera = look_at([0, 0, 4], [0, 0, 0], width=2, height=1, background=(1, 0, 0))
    displayed = display(done, 0.5, [camera])[0, 0]
    assert np.allclose(
        displayed[0], 0.5 * tone_map(radiance[0, 0, 0] / 0.5, 0.5) + 0.5 * np.array([1, 0, 0]), atol=1e-6
    )
    assert np.allclose(displayed[1], tone_map(radiance[0, 0, 1], 0.5), atol=1e-6)


def test_exr_keeps_eleven_bits_of_any_light() -> None:
    picture = (10.0 ** np.random.default_rng(1).uniform(-3, 4, (5, 7, 3))).astype(np.float32)
    back = decode_exr(encode_exr(picture))
    assert back.shape == picture.shape and np.abs(back / picture - 1).max() < 2**-11 + 1e-6
    assert decode_exr(encode_exr(np.full((2, 2, 3), 1e6, np.float32))).max() == 65504
    with pytest.raises(ValueError, match="^EXR: 1 values are NaN"):
        encode_exr(np.where(np.arange(12).reshape(2, 2, 3) == 5, np.nan, picture[:2, :2]))
    with pytest.raises(ValueError, match=r"^EXR: expected an image"):
        encode_exr(picture[..., 0])
    for part in (b"", b"no picture", encode_exr(picture)[:-40]):
        with pytest.raises(ValueError, match="^light.exr: (is not an OpenEXR|damaged) picture"):
            decode_exr(part, "light.exr")


def test_refusals() -> None:
    broken = WHITE.copy()
    broken[0, 0, 0] = np.nan
    for cameras, environment, words in (
        ([], WHITE, "at least one camera"),
        ([view(8), view(9)], WHITE, "all of one size"),
        ([replace(view(8), fy=20.0)], WHITE, "square pixels"),
        ([view(8)], broken, "not finite"),
        ([view(8)], WHITE[..., 0], r"expected an environment \[h, w, 3\]"),
    ):
        with pytest.raises(ValueError, match=words):
            path_trace(quad(MATT), environment, cameras, QUICK)
    with pytest.raises(ValueError, match="samples from 1"):
        PathOptions(samples=0)
    with pytest.raises(ValueError, match="expected a Mitsuba variant"):
        use_mitsuba("fast")  # pyright: ignore[reportArgumentType]


@pytest.mark.skipif(os.name == "nt", reason="needs links, and LLVM as Linux and macOS lay it")
def test_the_newest_usable_llvm_is_found(tmp_path: Path) -> None:
    for name in ("a/libLLVM-15.so.1", "b/libLLVM.so.18.1", "b/libLLVM-19.so.1", "b/libLLVM-C.txt", "b/other.so.20"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / "b" / "libLLVM.so").symlink_to("libLLVM.so.18.1")
    assert find_llvm([f"{tmp_path}/a"]) is None  # too old: Dr.Jit would abort
    assert find_llvm([f"{tmp_path}/*"]) == tmp_path / "b" / "libLLVM-19.so.1"


def test_every_variant_here_gives_the_same_picture() -> None:
    reference = traced(sphere(level=3), lamp([0, 1, 1], 1.0), replace(QUICK, samples=256), size=8)
    for variant in available()[:-1]:
        other = traced(sphere(level=3), lamp([0, 1, 1], 1.0), replace(QUICK, samples=256, variant=variant), size=8)
        assert np.abs(reference.radiance - other.radiance).mean() < 0.02 * reference.radiance.max()
