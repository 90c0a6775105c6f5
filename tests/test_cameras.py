"""Cameras: geometry worked out by hand, files through Pillow and json themselves."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image, PngImagePlugin
from scipy.spatial.transform import Rotation

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.image_files import find_camera, to_uint8, write_png

KEYS = {"version", "width", "height", "fx", "fy", "cx", "cy", "world_to_camera", "background", "asset_sha256"}
points = arrays(np.float64, 3, elements=st.floats(-100, 100))
UPS = [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, -1, 0), (1, 1, 1), (0.2, 0.2, -5), (3, 3, 3.001)]


def skewed(seed: int = 0) -> Camera:
    """A camera of which no number is round or symmetric."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 2, 3)).as_matrix()
    pose[:3, 3] = rng.normal(0, 3, 3)
    return Camera(64, 48, 71.3, 66.1, 30.7, 25.9, pose, (0.1, 1 / 3, 0.9), "ab" * 32)


def project(camera: Camera, world: np.ndarray) -> np.ndarray:
    """[..., 3] world points -> [..., 3] (u, v, z), the pinhole formula."""
    x, y, z = np.moveaxis(world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3], -1, 0)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z], -1)


def same(a: Camera, b: Camera) -> bool:
    return a == b and np.array_equal(a.world_to_camera, b.world_to_camera)


def one_line(error: pytest.ExceptionInfo) -> str:
    text = str(error.value)
    assert text and "\n" not in text and len(text) < 300
    return text


# Poses


def test_a_front_view_by_hand():
    camera = look_at((0, 0, 5), (0, 0, 0), width=200, height=100, fov=90)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(50), pytest.approx(50), 100, 50)
    # From +z, +x is on the right and +y up; 1 world unit at distance 5 is 10 pixels.
    np.testing.assert_allclose(project(camera, np.array([1.0, 0, 0])), [110, 50, 5], atol=1e-9)
    np.testing.assert_allclose(project(camera, np.array([0.0, 1, 0])), [100, 40, 5], atol=1e-9)
    np.testing.assert_allclose(project(camera, np.array([0.0, 0, 1])), [100, 50, 4], atol=1e-9)
    # Half of a 90 degree view: 45 degrees up is the top edge.
    np.testing.assert_allclose(project(camera, np.array([0.0, 5, 0]))[1], 0, atol=1e-9)
    np.testing.assert_allclose(camera.position, [0, 0, 5], atol=1e-12)
    np.testing.assert_allclose(camera.forward, [0, 0, -1], atol=1e-12)


@given(points, points, points, st.floats(1, 170))
@settings(max_examples=80, deadline=None)
def test_look_at_is_a_rotation_that_puts_the_target_in_the_middle_and_up_upwards(eye, target, up, fov):
    distance, length = np.linalg.norm(target - eye), np.linalg.norm(up)
    assume(distance > 1e-3 and length > 1e-3)
    sine = np.linalg.norm(np.cross((target - eye) / distance, up / length))
    camera = look_at(eye, target, up, width=80, height=60, fov=fov)
    turn = camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1, abs=1e-9)
    np.testing.assert_array_equal(camera.world_to_camera[3], [0, 0, 0, 1])
    local = turn @ np.stack([target, eye], 1) + camera.world_to_camera[:3, 3:]
    np.testing.assert_allclose(local[:, 0], np.array([0, 0, distance]), atol=1e-9 * (1 + 200))
    np.testing.assert_allclose(local[:, 1], 0, atol=1e-9 * (1 + 200))
    np.testing.assert_allclose(camera.position, eye, atol=1e-9)
    np.testing.assert_allclose(camera.forward, (target - eye) / distance, atol=1e-9)
    assert camera.height / 2 / camera.fy == pytest.approx(math.tan(math.radians(fov / 2)))
    if sine > 1e-4:
        right, down, _ = turn @ (up / length)
        assert down < 0 and abs(right) < 1e-9  # up lies in the picture's vertical plane


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("sign", [1, -1])
def test_looking_straight_along_up_still_gives_a_camera(up, sign):
    camera = look_at(np.multiply(up, 4 * sign), (0, 0, 0), up)
    turn = camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(project(camera, np.zeros(3)), np.array([256, 256, 4 * np.linalg.norm(up)]), atol=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        ((1, 2, 3), (1, 2, 3)),
        ((0, 0, 1), (0, 0, 0), (0, 0, 0)),
        ((0, 0, 1), (0, 0, math.nan)),
        ((0, 0, math.inf), (0, 0, 0)),
    ],
    ids=["no distance", "no up", "NaN", "infinite"],
)
def test_look_at_refuses_what_gives_no_direction(arguments):
    with pytest.raises(ValueError) as error:
        look_at(*arguments)
    assert one_line(error).startswith("look_at:")


@pytest.mark.parametrize("fov", [0, -10, 180, math.nan])
def test_look_at_refuses_an_impossible_field_of_view(fov):
    with pytest.raises(ValueError) as error:
        look_at((0, 0, 1), (0, 0, 0), fov=fov)
    assert "fov" in one_line(error)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("elevation", [0.0, 35.0, -20.0, 89.0])
def test_orbit_goes_around_up_in_even_steps(up, elevation):
    center, radius, count = np.array([1.0, -2.0, 0.5]), 3.5, 7
    axis = np.array(up) / np.linalg.norm(up)
    cameras = orbit(center, radius, count, elevation=elevation, start=12, up=up, fov=40)
    assert len(cameras) == count
    arms = np.array([camera.position - center for camera in cameras])
    np.testing.assert_allclose(np.linalg.norm(arms, axis=1), radius)
    np.testing.assert_allclose(arms @ axis, radius * math.sin(math.radians(elevation)), atol=1e-9)
    step = Rotation.from_rotvec(axis * 2 * math.pi / count)  # right-handed around up
    np.testing.assert_allclose(step.apply(arms), np.roll(arms, -1, 0), atol=1e-9)
    for camera in cameras:
        np.testing.assert_allclose(project(camera, center), [camera.cx, camera.cy, radius], atol=1e-9)
        assert project(camera, center + 0.1 * axis)[1] < camera.cy
    # `start` turns the whole orbit around up.
    first = orbit(center, radius, 1, elevation=elevation, up=up)[0].position - center
    np.testing.assert_allclose(Rotation.from_rotvec(axis * math.radians(12)).apply(first), arms[0], atol=1e-9)


def test_a_top_view_of_an_orbit_and_an_empty_one():
    for camera in orbit((0, 0, 0), 2, 3, elevation=90, up=(1, 1, 1)):
        np.testing.assert_allclose(camera.forward, -np.ones(3) / math.sqrt(3), atol=1e-9)
    assert orbit((0, 0, 0), 2, 0) == []


# Pixels


def test_rays_project_back_to_the_pixel_centres():
    camera = skewed()
    origin, directions = camera.rays()
    assert directions.shape == (48, 64, 3) and directions.dtype == origin.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
    homogeneous = camera.world_to_camera @ np.append(origin.astype(np.float64), 1)
    np.testing.assert_allclose(homogeneous, [0, 0, 0, 1], atol=1e-5)
    for length in (0.5, 7.0):
        projected = project(camera, camera.position + length * directions.astype(np.float64))
        v, u = np.mgrid[:48, :64] + 0.5
        np.testing.assert_allclose(projected[..., 0], u, atol=1e-3)
        np.testing.assert_allclose(projected[..., 1], v, atol=1e-3)
        assert (projected[..., 2] > 0).all()


def test_resized_and_cropped_keep_world_points_on_their_pixels():
    camera = skewed()
    world = camera.position + camera.rays()[1][::7, ::7].reshape(-1, 3).astype(np.float64) * 3
    u, v, z = project(camera, world).T
    double = project(camera.resized(192, 144), world)
    np.testing.assert_allclose(double.T, [3 * u, 3 * v, z], atol=1e-9)
    stretched = project(camera.resized(32, 96), world)
    np.testing.assert_allclose(stretched.T, [u / 2, 2 * v, z], atol=1e-9)
    window = camera.cropped(5, 9, 20, 30)
    assert (window.width, window.height) == (20, 30)
    np.testing.assert_allclose(project(window, world).T, [u - 5, v - 9, z], atol=1e-9)
    np.testing.assert_array_equal(window.rays()[1], camera.rays()[1][9:39, 5:25])
    assert (window.background, window.asset_sha256) == (camera.background, camera.asset_sha256)
    with pytest.raises(ValueError, match="camera"):
        camera.cropped(0, 0, 0, 5)


def test_a_camera_does_not_change_with_the_array_it_was_made_from():
    pose = np.eye(4)
    camera = Camera(4, 4, 1, 1, 2, 2, pose)
    pose[0, 3] = 7
    assert camera.world_to_camera[0, 3] == 0


# JSON


@given(arrays(np.float64, (2, 3), elements=st.floats(-1e6, 1e6)), st.integers(0, 2**31), st.integers(1, 1 << 14))
@settings(max_examples=50, deadline=None)
def test_json_gives_back_every_bit(numbers, seed, width):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 2, 3)).as_matrix()
    pose[:3, 3] = numbers[0]
    fx, cx, cy = numbers[1]
    camera = Camera(width, 31, abs(fx) + 0.1, 1 / 3, cx, cy, pose, (0.1, 0.2, 1.0))
    text = camera.to_json()
    assert "\n" not in text and text.isascii()
    data = json.loads(text)
    assert set(data) == KEYS and data["version"] == 1
    assert np.array(data["world_to_camera"]).tobytes() == camera.world_to_camera.tobytes()
    assert same(Camera.from_json(text), camera)
    assert list(camera.record()) == list(data) and camera.record() == data and same(Camera.from_record(data), camera)


def changed(**fields) -> str:
    return json.dumps(json.loads(skewed().to_json()) | fields)


def posed(change) -> str:
    pose = skewed().world_to_camera.copy()
    change(pose)
    return changed(world_to_camera=pose.tolist())


BROKEN = {
    "not JSON": "{ nope\n\n",
    "a list": "[1, 2]",
    "deep": "[" * 100_000,
    "no version": json.dumps({k: v for k, v in json.loads(skewed().to_json()).items() if k != "version"}),
    "version 2": changed(version=2),
    "a huge number": '{"version": ' + "9" * 5000 + "}",
    "zero width": changed(width=0),
    "half a pixel": changed(width=64.5),
    "infinite width": changed().replace('"width": 64', '"width": 1e999'),
    "width as text": changed(width="wide"),
    "no focal length": changed(fx=0),
    "infinite focal length": changed(fx=math.inf),
    "NaN centre": changed(cx=math.nan),
    "3x3 pose": changed(world_to_camera=np.eye(3).tolist()),
    "ragged pose": changed(world_to_camera=[[1, 2], [3]]),
    "NaN pose": posed(lambda m: m.__setitem__((0, 0), math.nan)),
    "scaled pose": posed(lambda m: m.__setitem__(np.s_[:3, :3], 2 * m[:3, :3])),
    "mirrored pose": posed(lambda m: m.__setitem__(0, -m[0])),
    "sheared pose": posed(lambda m: m.__setitem__((0, slice(0, 3)), m[0, :3] + 0.2 * m[1, :3])),
    "projective pose": posed(lambda m: m.__setitem__((3, 0), 0.5)),
    "transposed pose": changed(world_to_camera=skewed().world_to_camera.T.tolist()),
    "two-colour background": changed(background=[0, 1]),
    "background as text": changed(background="red"),
    "NaN background": changed(background=[0, math.nan, 1]),
}


@pytest.mark.parametrize("text", BROKEN.values(), ids=BROKEN)
def test_broken_json_is_one_line_that_says_where(text):
    with pytest.raises(ValueError) as error:
        Camera.from_json(text, "chair.json")
    assert one_line(error).startswith("chair.json: ")


@pytest.mark.parametrize("value", [True, None, [64], "wide"])
@pytest.mark.parametrize("key", ["width", "fx", "cy"])
def test_a_value_that_is_no_number_is_named_with_its_key(key, value):
    with pytest.raises(ValueError) as error:
        Camera.from_json(changed(**{key: value}), "chair.json")
    assert one_line(error) == f"chair.json: camera: expected a number as {key}, got {value!r}"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": math.nan}, "expected whole pixels as width, got nan"),
        ({"background": [0, 1]}, "expected three numbers as background, got [0, 1]"),
        ({"background": [0, None, 1]}, "expected a number as background, got None"),
        ({"offset": 5}, "expected three numbers as offset, got 5"),
        ({"world_to_camera": [[1, 2], [3]]}, "expected 4 rows of 4 numbers as world_to_camera, got [[1, 2], [3]]"),
        ({"world_to_camera": [[math.nan] * 4] * 4}, "expected a finite 4x4 world_to_camera, got NaN or infinity in it"),
    ],
)
def test_other_values_say_what_was_expected(change, words):
    with pytest.raises(ValueError) as error:
        Camera.from_json(changed(**change), "chair.json")
    assert one_line(error) == f"chair.json: camera: {words}"


def test_an_asset_that_is_no_text_and_a_file_of_another_program_are_refused():
    with pytest.raises(ValueError, match="chair.json: expected a text as asset_sha256, got 5"):
        Camera.from_json(changed(asset_sha256=5), "chair.json")
    with pytest.raises(ValueError, match="expected camera version 1, got None; no camera that splatpainter wrote"):
        Camera.from_json('{"title": "chair"}', "chair.json")


@pytest.mark.parametrize("key", ["width", "height", "fx", "fy", "cx", "cy", "world_to_camera"])
def test_a_missing_field_is_named(key):
    data = json.loads(skewed().to_json())
    del data[key]
    with pytest.raises(ValueError, match=key) as error:
        Camera.from_json(json.dumps(data), "chair.json")
    assert one_line(error).startswith("chair.json: ")


def test_background_and_asset_may_be_absent_and_a_rounded_pose_is_a_pose():
    data = json.loads(skewed().to_json())
    del data["background"], data["asset_sha256"]
    data["world_to_camera"] = np.round(data["world_to_camera"], 5).tolist()  # as people type them
    camera = Camera.from_json(json.dumps(data))
    assert camera.background == (0, 0, 0) and camera.asset_sha256 is None


# Pictures


def picture() -> np.ndarray:
    return np.random.default_rng(3).uniform(-0.2, 1.2, (48, 64, 3))


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """(type, content) of every chunk, by the PNG specification."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    out, offset = [], 8
    while offset < len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        out.append((kind, data[offset + 8 : offset + 8 + length]))
        offset += 12 + length
    return out


def test_a_written_picture_carries_its_camera_in_a_text_chunk(tmp_path):
    camera, path = skewed(), tmp_path / "view.png"
    write_png(path, picture(), camera)
    texts = [content for kind, content in png_chunks(path.read_bytes()) if kind == b"tEXt"]
    keyword, content = texts[0].split(b"\0", 1)
    assert len(texts) == 1 and keyword == b"splatpainter"
    assert set(json.loads(content.decode("utf-8"))) == KEYS
    with Image.open(path) as image:
        assert image.mode == "RGB" and image.size == (64, 48)
        pixels = np.asarray(image)
    expected = np.floor(np.clip(picture(), 0, 1) * 255 + 0.5).astype(np.uint8)
    np.testing.assert_array_equal(pixels, expected)
    assert same(find_camera(path), camera)
    assert [file.name for file in tmp_path.iterdir()] == ["view.png"]


def test_bytes_pass_through_and_odd_values_become_pixels(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    write_png(tmp_path / "plain.png", pixels)
    with Image.open(tmp_path / "plain.png") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)
        assert "splatpainter" not in image.info
    odd = np.array([[[math.nan, math.inf, -math.inf]]], np.float32)
    np.testing.assert_array_equal(to_uint8(odd), [[[0, 255, 0]]])


@pytest.mark.parametrize("how", ["tEXt", "iTXt", "zTXt", "behind the pixels"])
def test_chunks_as_other_programs_write_them(tmp_path, how):
    camera, chunk = skewed(1), PngImagePlugin.PngInfo()
    if how == "iTXt":
        chunk.add_itxt("splatpainter", camera.to_json())
    elif how == "behind the pixels":
        chunk.add(b"tEXt", b"splatpainter\0" + camera.to_json().encode(), after_idat=True)
    else:
        chunk.add_text("splatpainter", camera.to_json(), zip=how == "zTXt")
    Image.fromarray(to_uint8(picture())).save(tmp_path / "edited.png", pnginfo=chunk)
    assert same(find_camera(tmp_path / "edited.png"), camera)


def test_where_a_camera_is_looked_for(tmp_path):
    chunk, sidecar, explicit = skewed(1), skewed(2), skewed(3)
    path, other = tmp_path / "view.png", tmp_path / "other.json"
    write_png(path, picture(), chunk)
    path.with_suffix(".json").write_text(sidecar.to_json())
    other.write_text(explicit.to_json())
    assert same(find_camera(path, other), explicit)
    assert same(find_camera(path), chunk)
    write_png(path, picture())  # an editor that drops text chunks
    assert same(find_camera(path), sidecar)
    assert same(find_camera(path, other), explicit)
    path.with_suffix(".json").unlink()
    with pytest.raises(ValueError) as error:
        find_camera(path)
    text = one_line(error)
    assert str(path) in text and "view.json" in text and "--camera" in text


def test_a_camera_beside_a_jpeg(tmp_path):
    Image.fromarray(to_uint8(picture())).save(tmp_path / "edited.jpg")
    (tmp_path / "edited.json").write_text(skewed().to_json())
    assert same(find_camera(tmp_path / "edited.jpg"), skewed())


def broken_files(folder: Path) -> dict[str, tuple[Path, Path | None, Path]]:
    """(picture, explicit camera, the file that an error has to name)."""
    write_png(folder / "good.png", picture(), skewed())
    info = PngImagePlugin.PngInfo()
    info.add_text("splatpainter", '{"version": 1}')
    Image.fromarray(to_uint8(picture())).save(folder / "chunk.png", pnginfo=info)
    write_png(folder / "side.png", picture())
    (folder / "side.json").write_text("[]")
    (folder / "binary.json").write_bytes(b"\xff\xfe\x00{")
    (folder / "words.png").write_text("not a picture")
    cut = (folder / "good.png").read_bytes()
    (folder / "cut.png").write_bytes(cut[:60])
    names = ("chunk.png", "side.json", "binary.json", "absent.json", "absent.png", "words.png", "cut.png")
    wrong = {name: folder / name for name in names}
    return {
        "broken chunk": (wrong["chunk.png"], None, wrong["chunk.png"]),
        "broken sidecar": (folder / "side.png", None, wrong["side.json"]),
        "explicit is not text": (folder / "good.png", wrong["binary.json"], wrong["binary.json"]),
        "explicit is missing": (folder / "good.png", wrong["absent.json"], wrong["absent.json"]),
        "explicit is a folder": (folder / "good.png", folder, folder),
        "picture is missing": (wrong["absent.png"], None, wrong["absent.png"]),
        "picture is a folder": (folder, None, folder),
        "picture is not one": (wrong["words.png"], None, wrong["words.png"]),
        "picture is cut short": (wrong["cut.png"], None, wrong["cut.png"]),
    }


@pytest.mark.parametrize(
    "case",
    [
        "broken chunk",
        "broken sidecar",
        "explicit is not text",
        "explicit is missing",
        "explicit is a folder",
        "picture is missing",
        "picture is a folder",
        "picture is not one",
        "picture is cut short",
    ],
)
def test_errors_name_the_file(tmp_path, case):
    png, explicit, named = broken_files(tmp_path)[case]
    with pytest.raises(ValueError) as error:
        find_camera(png, explicit)
    assert one_line(error).startswith(str(named))


def test_a_failed_write_leaves_the_old_picture(tmp_path):
    path = tmp_path / "view.png"
    write_png(path, picture(), skewed())
    before = path.read_bytes()
    with pytest.raises((TypeError, ValueError)):
        write_png(path, np.zeros((4, 4, 7)))
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["view.png"]


def test_replace_keeps_the_checks():
    with pytest.raises(ValueError, match="camera"):
        replace(skewed(), fx=-1.0)


@pytest.mark.parametrize("seed", range(5))
def test_points_are_projected_and_come_back(seed: int) -> None:
    camera = skewed(seed)
    points = np.random.default_rng(seed).normal(0, 2, (4, 6, 3))
    pixels, depths = camera.project(points)
    expected = project(camera, points)
    np.testing.assert_allclose(pixels, expected[..., :2], rtol=1e-12, atol=1e-11)
    np.testing.assert_allclose(depths, expected[..., 2], rtol=1e-12)
    np.testing.assert_allclose(camera.unproject(depths, pixels), points, atol=1e-12)
    local = camera.to_camera(points)
    np.testing.assert_allclose(camera.to_world(local), points, atol=1e-12)
    np.testing.assert_allclose(camera.slopes(pixels) * depths[..., None], local[..., :2], atol=1e-12)
    np.testing.assert_allclose(camera.sight_lines(pixels) * depths[..., None], local, atol=1e-12)
    tensor = torch.from_numpy(points.astype(np.float32))
    for actual, values in zip(camera.project(tensor), (pixels, depths), strict=True):
        assert actual.dtype == torch.float32
        np.testing.assert_allclose(actual.numpy(), values, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(camera.camera_to_world @ camera.world_to_camera, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(camera.camera_to_world[:3, 3], camera.position, atol=1e-14)


def test_the_longest_side_has_the_pixels_and_the_other_one_at_least() -> None:
    wide = look_at((0, 0, 3), (0, 0, 0), width=1000, height=300)
    assert wide.with_longest_side(500) == wide.resized(500, 150)
    assert wide.cropped(0, 0, 300, 1000).with_longest_side(100).height == 100
    assert wide.with_longest_side(1).height == 1


def test_depth_maps_are_points_on_the_rays_of_their_pixels() -> None:
    camera = skewed()
    depth = np.random.default_rng(0).uniform(1, 3, (camera.height, camera.width))
    points = camera.unproject(depth)
    origin, directions = camera.rays()
    away = points - origin
    np.testing.assert_allclose(away / np.linalg.norm(away, axis=-1, keepdims=True), directions, atol=1e-6)
    np.testing.assert_allclose(camera.project(points)[1], depth, atol=1e-12)
    with np.errstate(all="raise"):
        camera.project(np.zeros((2, 3)) + camera.position)  # at the eye: no pixel, no warning
