"""Objects, lights and truth of the tables: the split of training, hand-made geometry, closed-form light."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatbench.cases import PosedImages, Setup, safe
from splatbench.edit_design import textured_points
from splatbench.ground_truth import BACKGROUND, GroundTruth, GroundTruthViews, blocked, optics
from splatbench.objects import drawn_lights, environments, objects

from splatpainter.cameras import look_at
from splattrain.data.lights import WHITE_RADIANCE, make_light, uniform_light
from splattrain.data.viewpoints import object_camera
from tests.support.data_meshes import MATT, quad, sphere, write_box

SMALL = Setup(size=32, detail=2, samples=4, truth="surfels", rows=200, base_views=3)


def fake_meshes(folder: Path, count: int, start: int = 0) -> Path:
    """Files that have a GLB's head and the length that it says: all that choosing looks at."""
    folder.mkdir(exist_ok=True)
    for k in range(start, start + count):
        (folder / f"thing_{k:03}.glb").write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12).to_bytes(4, "little"))
    return folder


# Objects


def test_held_out_objects_are_those_that_training_holds_out(tmp_path: Path) -> None:
    from splattrain.data.samples import SampleRecipe
    from splattrain.recipes import Recipe
    from splattrain.training_data import DataSettings, ResourceFolders

    folder = fake_meshes(tmp_path / "meshes", 60)
    chosen = objects(Setup(data=folder, objects=60)).names
    settings = DataSettings(str(folder), SampleRecipe({"plain": 1.0}), 5, Recipe.validation_share, ResourceFolders())
    held, seen = settings.stream(validation=True).source, settings.stream().source
    assert 0 < len(chosen) < 30
    assert list(chosen) == [held.name(i) for i in range(len(held))]
    assert not set(chosen) & {seen.name(i) for i in range(len(seen))}
    assert len(objects(Setup(data=folder, objects=60, held_out=False)).names) == 60


def test_choosing_is_seeded_and_notes_say_when_there_are_fewer(tmp_path: Path) -> None:
    folder = fake_meshes(tmp_path / "meshes", 60)
    some = Setup(data=folder, objects=5, held_out=False)
    assert objects(some).names == objects(some).names != objects(replace(some, seed=1)).names
    few = objects(replace(some, objects=99))
    assert len(few.names) == 60 and any("99 objects were asked for; there are 60" in note for note in few.notes)


def test_richly_textured_objects_come_first_where_a_manifest_tells(tmp_path: Path) -> None:
    folder = fake_meshes(tmp_path / "meshes", 20)
    lines = [f"meshes/thing_{k:03}.glb,mesh,flat; texture detail {k}.5" for k in range(20)]
    (tmp_path / "MANIFEST.csv").write_text("\n".join(["path,kind,notes", *lines, "splats/x.ply,splat,"]))
    chosen = objects(Setup(data=folder, objects=4, held_out=False))
    assert all(int(name[-3:]) >= 10 for name in chosen.names) and "texture detail" in chosen.notes[-1]


def test_files_that_are_cut_short_give_way_with_a_note(tmp_path: Path) -> None:
    folder = fake_meshes(tmp_path / "meshes", 3)
    (folder / "thing_000.glb").write_bytes(b"glTF\2\0\0\0\xff\0\0\0")
    (folder / "thing_001.glb").write_bytes(b"")
    chosen = objects(Setup(data=folder, objects=2, held_out=False))
    assert chosen.names == ("thing_002",)
    assert any("thing_000: left out, 12 bytes of 255" in note for note in chosen.notes)
    assert any("thing_001: left out, an empty file" in note for note in chosen.notes)


def test_a_mesh_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    chosen = objects(Setup(data=fake_meshes(tmp_path / "meshes", 1), objects=1, held_out=False))
    with pytest.raises(ValueError, match="thing_000.glb: cannot be read as a mesh"):
        chosen.load("thing_000")


def test_folders_that_give_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        objects(Setup(data=tmp_path / "no"))
    (tmp_path / "one").mkdir()
    write_box(tmp_path / "one" / "box.glb", (200, 0, 0))
    with pytest.raises(ValueError, match="none of its 1 meshes is held out"):
        objects(Setup(data=tmp_path / "one"))
    with pytest.raises(ValueError, match="holds no environments"):
        environments(Setup(environments=tmp_path / "one"))
    with pytest.raises(ValueError, match="no such folder"):
        environments(Setup(environments=tmp_path / "no"))


def test_procedural_objects_load_and_differ_by_seed() -> None:
    first, second = objects(Setup(objects=2)), objects(Setup(objects=2, seed=1))
    assert len({*first.names, *second.names}) == 4
    one, other = (first.load(name) for name in first.names)
    assert one.vertices.shape != other.vertices.shape or not np.array_equal(one.vertices, other.vertices)
    assert np.array_equal(first.load(first.names[0]).vertices, one.vertices)


def test_names_become_file_names_that_stay_apart() -> None:
    assert safe("gso_dino_3") == "gso_dino_3"
    odd = [safe(name) for name in ("a/b", "a_b", "a b", "../up", "x" * 300)]
    assert len(set(odd)) == len(odd)
    assert all(os.sep not in name and not name.startswith(".") and len(name) <= 80 for name in odd)


# Lights


def test_environment_files_are_lights_as_they_are(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = {f"light_{k}": rng.integers(0, 256, (4, 7, 3), np.uint8) for k in range(4)}
    for name, picture in pictures.items():
        exponent = np.full((4, 7, 1), 136, np.uint8)  # RGBE: times 2^(136 - 136)
        pixels = np.concatenate([picture, exponent], 2).tobytes()
        (tmp_path / f"{name}.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 7\n" + pixels)
    lights = environments(Setup(environments=tmp_path))
    assert set(lights.names) == set(pictures)
    light = lights.load("light_2")
    assert light.name == "light_2"
    np.testing.assert_array_equal(light.environment.numpy(), pictures["light_2"])
    chosen = drawn_lights(lights.names, "thing", 3, 0)
    assert len(set(chosen)) == 3 and chosen == drawn_lights(lights.names, "thing", 3, 0)
    assert chosen[:2] == drawn_lights(lights.names, "thing", 2, 0)


def test_skies_are_their_names() -> None:
    lights = environments(Setup(lights=2))
    assert len(lights.names) == 3
    one, again, other = (lights.load(lights.names[k]).environment for k in (0, 0, 1))
    assert bool((one == again).all()) and not bool((one == other).all())


# Geometry


def test_a_triangle_between_two_points_blocks() -> None:
    wall, eye = quad(MATT), np.array([0.2, 0.1, 2.0])
    assert blocked(wall, eye, np.array([0.2, 0.1, -1.0]))
    assert not blocked(wall, eye, np.array([0.3, -0.4, 0.0]))  # on it
    assert not blocked(wall, eye, np.array([0.3, -0.4, 1.0]))  # before it
    assert not blocked(wall, eye, np.array([4.0, 0.1, -1.0]))  # past its edge: crosses z = 0 at x = 2.7
    assert not blocked(wall, np.array([-3.0, 0, 0.5]), np.array([3.0, 0, 0.5]))  # along it


def test_unprojected_pixels_are_along_the_rays_at_their_depth() -> None:
    camera = look_at([1, 2, 3], [0.1, 0, 0], width=7, height=5, fov=40)
    depths = np.random.default_rng(0).uniform(1, 4, (5, 7))
    origin, rays = camera.rays()
    along = depths[..., None] / (rays @ camera.forward)[..., None]
    np.testing.assert_allclose(camera.unproject(depths), origin + along * rays, atol=1e-5)


def test_a_truth_says_how_large_it_is_and_refuses_unknown_truth() -> None:
    light = uniform_light()
    traced = GroundTruth.of("wall", quad(MATT), light, replace(SMALL, truth="traced"))
    assert traced.radius == pytest.approx(2**0.5) and traced.surfels is None
    with pytest.raises(ValueError, match="expected traced or surfels, got 'photo'"):
        GroundTruth.of("wall", quad(MATT), light, replace(SMALL, truth="photo"))


# Truth


@pytest.mark.parametrize("source", ["surfels", "traced"])
def test_a_white_ball_in_even_light_has_the_tone_and_depth_of_the_formulas(source: str) -> None:
    if source == "traced":
        pytest.importorskip("mitsuba")
    setup = replace(SMALL, truth=source)
    truth = GroundTruth.of("ball", sphere(), make_light(np.ones((8, 16, 3), np.float32)), setup)
    camera = object_camera(truth.radius, truth.optics, 30, 20)
    views = truth.render([camera], "test")
    over = WHITE_RADIANCE - 0.8  # lights.tone_map: straight up to 0.8, then s + o / (1 + o / (1 - s)); then sRGB
    linear = 0.8 + over / (1 + over / 0.2)
    middle = views.images.colors[0, 12:20, 12:20]
    np.testing.assert_allclose(middle.mean((0, 1)), 1.055 * linear ** (1 / 2.4) - 0.055, atol=0.03)
    np.testing.assert_array_equal(views.images.colors[0, 0, 0], BACKGROUND)
    assert views.alphas[0, 0, 0] == 0 and views.depths[0, 0, 0] == 0
    distance = float(np.linalg.norm(camera.position))
    assert views.depths[0, 15:17, 15:17].mean() == pytest.approx(distance - 1, abs=0.02)
    inside = camera.unproject(views.depths[0])[views.masks[0]]
    assert np.median(np.linalg.norm(inside, axis=1)) == pytest.approx(1, abs=0.05)


def test_noise_of_paths_is_other_for_another_purpose_and_the_same_again() -> None:
    pytest.importorskip("mitsuba")
    setup = replace(SMALL, truth="traced", samples=2)
    truth = GroundTruth.of("ball", sphere(), make_light(np.ones((8, 16, 3), np.float32)), setup)
    cameras = [object_camera(truth.radius, truth.optics, 30, 20)]
    first, again, other = (truth.render(cameras, k).alphas for k in ("base", "base", "novel"))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


# Spots


def wall_visible(colors: np.ndarray, depths: np.ndarray | None = None, **camera: Any) -> GroundTruthViews:
    size = colors.shape[0]
    view = look_at([0, 0, 2], [0, 0, 0], width=size, height=size, fov=40, **camera)
    depth = np.full((1, size, size), 2, np.float32) if depths is None else depths[None]
    alphas = (depth > 0).astype(np.float32)
    return GroundTruthViews(PosedImages((view,), colors[None].astype(np.float32)), alphas, depth)


def test_spots_lie_on_texture_and_apart() -> None:
    rng = np.random.default_rng(0)
    colors = np.full((64, 64, 3), 0.5)
    colors[:32, :32] += rng.uniform(-0.2, 0.2, (32, 32, 1))
    views = wall_visible(colors)
    for seed in range(5):
        spots = textured_points(views, 8, 2, np.random.default_rng(seed))
        for spot in spots:
            x, y = 32 + views.images.cameras[0].fx * spot.position[:2] * [1, -1] / 2
            assert x < 33 and y < 33 and spot.contrast > 0.05
        assert np.linalg.norm(spots[0].position - spots[1].position) > 8 * 2 / views.images.cameras[0].fx * 0.99


def test_edges_of_the_object_are_no_texture() -> None:
    colors, depths = np.full((64, 64, 3), 0.5), np.zeros((64, 64), np.float32)
    depths[8:56, 8:56] = 2
    depths[8:56, 30:40] = 1.5  # a bright strip in front: steps of colour where depth steps too
    colors[8:56, 30:40] = 1.0
    colors[40:50, 12:24] += np.random.default_rng(1).uniform(-0.1, 0.1, (10, 12, 1))
    spots = textured_points(wall_visible(colors, depths), 6, 1, np.random.default_rng(0))
    camera = wall_visible(colors, depths).images.cameras[0]
    x, y = 32 + camera.fx * spots[0].position[:2] * [1, -1] / 2
    assert 8 <= x <= 28 and 36 <= y <= 54


def test_nothing_to_see_is_an_error() -> None:
    empty = wall_visible(np.zeros((16, 16, 3)), np.zeros((16, 16), np.float32))
    with pytest.raises(ValueError, match="no part of its surface"):
        textured_points(empty, 4, 1, np.random.default_rng(0))


def test_uniform_light_is_the_same_from_everywhere_for_surfels() -> None:
    truth = GroundTruth.of("ball", sphere(level=3), uniform_light(), SMALL)
    cameras = [object_camera(1, optics(SMALL), turn, 0) for turn in (0, 90, 200)]
    views = truth.render(cameras, "test")
    means = [views.images.colors[k][views.alphas[k] > 0.99].mean() for k in range(3)]
    assert np.ptp(means) < 0.01
