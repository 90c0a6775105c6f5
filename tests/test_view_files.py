"""Views as files: AOVs against the reference renderer, transparency against the opaque picture, and pictures that come
back into `edit`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import splatpainter as sp
from splatpainter import image_files
from splatpainter.cameras import Camera, look_at, orbit_cameras
from splatpainter.image_files import encode_png, find_camera, quantized, read_deep
from splatpainter.pictures import edit_from_files
from splatpainter.pictures.edit_files import over_render
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.rendering import reference
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.view_files import PictureOptions, draw_passes, normals_of, view_files
from tests.support.cli_scenes import BOX, Capture, ball, run, saved
from tests.support.render_scenes import cameras, opaque_stack, scene, single, with_odd_gaussians

deep = pytest.mark.skipif(not image_files.can_do_deep(), reason="OpenImageIO is not installed (extra pictures)")
SCENES = {
    "small": (scene(40, 1, 1), cameras(37, 29)),
    "odd Gaussians": (with_odd_gaussians(scene(30, 1, 7)), cameras(35, 31, count=2)),
    "opaque": (opaque_stack(), cameras(32, 32)),
    "no Gaussians": (scene(0, 1), cameras(17, 5)),
}


def weights(splats: Splats, camera: Camera, profile: str) -> tuple[np.ndarray, np.ndarray]:
    """(w_ip [V, P], Gaussians [V]) by the definition of a profile in plain torch, every Gaussian against every
    pixel."""
    alpha, _, _, rows = reference.project(splats.torch(dtype=torch.float64), camera)
    if profile == "inria":
        weight, _ = reference.composite(alpha)
        return weight.numpy(), rows.numpy()
    free = reference_free(splats, camera)
    alpha = (free[0] - free[1] * np.exp(-4.5)).clamp_max(0.99)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    before = torch.ones(alpha.shape[1], dtype=torch.float64)
    out = torch.zeros_like(alpha)
    for k in range(len(alpha)):  # one Gaussian after the other, as the profile is defined
        out[k] = torch.where(before >= 1e-4, alpha[k] * before, 0)
        before = before - out[k]
    return out.numpy(), rows.numpy()


def reference_free(splats: Splats, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """(o e^-s [V, P], o [V, 1]) without cap and threshold."""
    cap, threshold = reference.MAX_ALPHA, reference.MIN_ALPHA
    try:
        reference.MAX_ALPHA, reference.MIN_ALPHA = np.inf, 0.0
        free, *_, rows = reference.project(splats.torch(dtype=torch.float64), camera)
    finally:
        reference.MAX_ALPHA, reference.MIN_ALPHA = cap, threshold
    return free, torch.as_tensor(splats.opacities, dtype=torch.float64)[rows][:, None]


@pytest.mark.parametrize("profile", ["inria", "playcanvas"])
@pytest.mark.parametrize("name", SCENES)
def test_the_row_with_the_largest_weight(name: str, profile: str) -> None:
    splats, views = SCENES[name]
    splats = single(splats)
    for camera in views:
        weight, rows = weights(splats, camera, profile)
        ids = project(splats, camera).heaviest_gaussians(profile)  # type: ignore[arg-type]
        assert ids.shape == (camera.height, camera.width)
        if not len(rows):
            assert (ids == -1).all()
            continue
        top = weight.max(0)
        flat = ids.reshape(-1)
        assert np.array_equal(flat == -1, top == 0)
        position = np.full(len(splats) + 1, -1)
        position[rows] = np.arange(len(rows))
        drawn = np.flatnonzero(flat >= 0)
        assert np.allclose(weight[position[flat[drawn]], drawn], top[drawn], rtol=1e-5, atol=1e-7)


def test_passes_are_weighted_means() -> None:
    """Depth, normals and coverage by their definition, from the reference's weights."""
    splats, (camera, *_) = SCENES["odd Gaussians"]
    splats = single(splats)
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(len(splats), 3))
    kinds = rng.integers(0, 3, len(splats))
    everything = ("alpha", "depth", "normal", "gaussian-ids", "coverage")
    passes = draw_passes(splats, camera, everything, normals=normals, coverage=(kinds == 1, kinds == 2))
    weight, rows = weights(splats, camera, "inria")
    shape = (camera.height, camera.width)
    assert np.allclose(passes.alpha, weight.sum(0).reshape(shape), atol=1e-6)
    summed = (weight.T @ normals[rows]).reshape(*shape, 3)
    length = np.linalg.norm(summed, axis=-1)
    assert passes.normal is not None and passes.coverage is not None
    some = length > 1e-3
    assert np.allclose(passes.normal[some], (summed / length[..., None])[some], atol=1e-5)
    assert np.allclose(np.linalg.norm(passes.normal, axis=-1)[some], 1, atol=1e-5)
    parts = np.stack([weight[kinds[rows] == kind].sum(0).reshape(shape) for kind in (1, 2, 0)], -1)
    assert np.allclose(passes.coverage, parts, atol=1e-6)
    z = splats.means[rows] @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    drawn = passes.alpha > 1e-6
    depth = (weight.T @ z).reshape(shape) / np.maximum(weight.sum(0).reshape(shape), 1e-12)
    assert np.allclose(passes.depth[drawn], depth[drawn], atol=1e-6) and (passes.depth[passes.alpha == 0] == 0).all()
    with pytest.raises(ValueError, match="only a session records"):
        draw_passes(splats, camera, ("coverage",))


def test_normals_of_a_ball_point_at_the_viewer_in_world_axes() -> None:
    asset = ball()
    camera = orbit_cameras(asset, 3, size=64)[1]
    passes = draw_passes(asset, camera, ("normal",))
    solid = passes.alpha > 0.99
    origin, rays = camera.rays()
    points = origin + rays * (passes.depth / (rays @ camera.forward.astype(np.float32)))[..., None]
    outward = points / np.linalg.norm(points, axis=-1, keepdims=True)
    assert passes.normal is not None and solid.sum() > 500
    assert (passes.normal * outward).sum(-1)[solid].min() > 0.9
    assert not passes.normal[passes.alpha == 0].any()
    empty = asset.take(np.zeros(0, int))
    assert normals_of(empty).shape == (0, 3)
    blank = draw_passes(empty, camera, ("normal", "gaussian-ids"))
    assert blank.normal is not None and not blank.normal.any() and (blank.gaussian_ids == -1).all()  # type: ignore[union-attr]


def soft() -> Splats:
    """Half-transparent Gaussians with colours well inside 0..1."""
    asset = ball(400)
    return replace(asset, opacities=np.full(400, 0.4, np.float32), scales=asset.scales * 1.5)


@pytest.fixture(params=["srgb", "linear"])
def asset(request: pytest.FixtureRequest) -> Splats:
    return replace(soft(), color_space=request.param)


def pixels_of(data: bytes, path: Path) -> np.ndarray:
    """[H, W, C] 0..1 as they are stored."""
    path.write_bytes(data)
    if path.suffix == ".png":
        with Image.open(path) as image:
            if image.mode in ("RGB", "RGBA") and data[24] == 8:
                return np.asarray(image) / 255
    return read_deep(path, 10**6).values


@deep
@pytest.mark.parametrize("kind", ["straight", "premultiplied"])
@pytest.mark.parametrize("bits", [8, 16])
def test_transparent_pictures_over_a_background_are_the_opaque_render(
    kind: str, bits: int, asset: Splats, tmp_path: Path
) -> None:
    """In the space in which the asset's colours are blended."""
    from splatpainter.color import from_display

    camera = replace(orbit_cameras(asset, 1, size=48)[0], background=(0.9, 0.3, 0.1))
    made = view_files(asset, camera, "v", PictureOptions(bits=bits, transparent=kind))  # type: ignore[arg-type]
    stored = pixels_of(made["v.png"], tmp_path / "v.png")
    alpha = stored[..., 3:]
    assert 0 < ((alpha > 0.05) & (alpha < 0.95)).mean(), "there are half-transparent pixels"
    straight = stored[..., :3] if kind == "straight" else stored[..., :3] / np.maximum(alpha, 1e-9)
    colors = from_display(np.clip(straight, 0, 1), asset.color_space)
    over = alpha * colors + (1 - alpha) * np.array(camera.background)
    opaque = np.asarray(sp.render(asset, camera).colors[0])
    steps = np.abs(over - opaque) * (2**bits - 1)
    limit = (0.52 if asset.color_space == "srgb" else 1.6) * (3 if kind == "straight" else 3)
    assert steps[alpha[..., 0] > 0.1].max() < limit
    assert not stored[alpha[..., 0] == 0].any(), "nothing is hidden under transparent pixels"


@deep
def test_exr_is_light_times_alpha(tmp_path: Path) -> None:
    asset = soft()
    camera = orbit_cameras(asset, 1, size=48)[0]
    options = PictureOptions("exr", 32, "premultiplied", ("alpha", "depth", "normal", "gaussian-ids"))
    made = view_files(asset, camera, "v", options)
    assert list(made) == options.file_names("v")
    values = pixels_of(made["v.exr"], tmp_path / "v.exr")
    drawn = sp.render(asset, replace(camera, background=(0, 0, 0)))
    alpha = drawn.alphas[0]
    coded = drawn.colors[0] / np.maximum(alpha, 1e-9)
    light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    some = alpha[..., 0] > 0.01
    assert np.abs(values[..., 3:] - alpha).max() < 1e-6
    assert np.abs(values[..., :3] - light * alpha)[some].max() < 1e-5
    passes = draw_passes(asset, camera, ("normal",))
    assert passes.normal is not None
    assert np.array_equal(pixels_of(made["v.depth.exr"], tmp_path / "d.exr")[..., 0], passes.depth)
    assert np.array_equal(pixels_of(made["v.normal.exr"], tmp_path / "n.exr"), passes.normal)
    assert np.array_equal(pixels_of(made["v.alpha.exr"], tmp_path / "a.exr")[..., 0], passes.alpha)
    import OpenImageIO as oiio

    (tmp_path / "i.exr").write_bytes(made["v.gaussian-ids.exr"])
    source = oiio.ImageInput.open(str(tmp_path / "i.exr"))
    assert source is not None
    ids = np.asarray(source.read_image("uint")).astype(int).reshape(48, 48) - 1
    assert np.array_equal(ids, project(asset, camera).heaviest_gaussians())


def test_png_aovs_read_as_the_sidecar_says(tmp_path: Path) -> None:
    """Depth and ids need no extra."""
    asset = ball(3000)
    camera = orbit_cameras(asset, 1, size=64)[0]
    kinds = np.arange(3000) % 3
    options = PictureOptions(aovs=("alpha", "depth", "normal", "gaussian-ids", "coverage"))
    made = view_files(asset, camera, "v", options, coverage=(kinds == 1, kinds == 2))
    note = json.loads(made["v.json"])["aov"]
    passes = draw_passes(asset, camera, options.aovs, coverage=(kinds == 1, kinds == 2))

    def stored(name: str) -> np.ndarray:
        path = tmp_path / note[name]["file"]
        path.write_bytes(made[path.name])
        with Image.open(path) as image:
            return np.asarray(image).astype(np.int64)

    assert np.abs(stored("alpha") / 255 - passes.alpha).max() <= 0.5 / 255 + 1e-6
    depth, near, far = stored("depth"), note["depth"]["near"], note["depth"]["far"]
    assert depth.max() == 65535 and np.array_equal(depth == 0, passes.alpha == 0)
    back = near + (depth - 1) / 65534 * (far - near)
    assert np.abs(back - passes.depth)[depth > 0].max() < 1e-5 * far
    assert passes.normal is not None and passes.coverage is not None
    assert np.abs(stored("normal") / 255 * 2 - 1 - passes.normal).max() < 1.01 / 255
    packed = stored("gaussian-ids")
    assert packed.max() > 8  # the second byte is in use
    ids = packed[..., 0] + 256 * packed[..., 1] + 65536 * packed[..., 2] - 1
    assert np.array_equal(ids, project(asset, camera).heaviest_gaussians()) and ids.max() > 255
    assert np.abs(stored("coverage") / 255 - passes.coverage).max() <= 0.51 / 255
    assert Camera.from_json(made["v.json"].decode()) == camera
    assert encode_png(quantized(np.zeros((2, 2)))) not in made.values()


def test_options_that_do_not_go_together() -> None:
    for fields, pattern in (
        ({"format": "jpg"}, "expected the format png or exr, got 'jpg'"),
        ({"bits": 32}, "expected 8 or 16 bits of PNG, got 32"),
        ({"format": "exr", "bits": 8}, "expected 16 or 32 bits of EXR, got 8"),
        ({"transparent": "yes"}, "straight or premultiplied, got 'yes'"),
        ({"format": "exr", "transparent": "straight"}, "OpenEXR colours are multiplied by alpha"),
        ({"aovs": ("albedo",)}, "got 'albedo'"),
        ({"aovs": ("depth", "depth")}, "every AOV once"),
    ):
        with pytest.raises(ValueError, match="^picture: ") as error:
            PictureOptions(**fields)  # type: ignore[arg-type]
        assert pattern in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(ValueError, match="expected views of 1 to"):
        view_files(ball(8), look_at([0, 0, 3], [0, 0, 0], width=9000, height=2), "v")


# Pictures that come back


@deep
@pytest.mark.parametrize(
    ("options", "name"),
    [
        (["--bits", 16], "view_000.png"),
        (["--transparent", "straight"], "view_000.png"),
        (["--transparent", "premultiplied", "--bits", 16], "view_000.png"),
        (["--format", "exr", "--transparent", "premultiplied", "--bits", 32], "view_000.exr"),
        (["--format", "exr"], "view_000.exr"),
    ],
)
def test_rendered_pictures_find_their_camera_and_change_nothing_untouched(
    options: list, name: str, tmp_path: Path, capfd: Capture
) -> None:
    asset = saved(tmp_path / "soft.ply", soft())
    words = ["render", asset, "--out", tmp_path, "--views", 1, "--size", 96, "--background", "0.1,0.5,0.9"]
    assert run(capfd, *words, *options).code == 0
    splats, path = sp.read(asset), tmp_path / name
    camera = find_camera(path)
    assert camera == find_camera(path, tmp_path / "view_000.json") and camera.asset_sha256 == splats.sha256
    edit = edit_from_files(path).edit(splats)
    render = sp.render(splats, camera).colors[0]
    finest = 2.2 / (255 if "16" not in map(str, options) and name.endswith("png") else 2000)
    assert np.abs(np.asarray(edit.image) - np.clip(render, 0, 1)).max() < finest


@deep
def test_paint_on_a_sixteen_bit_transparent_picture_is_written_onto_the_asset(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    words = ["render", asset, "--out", tmp_path, "--views", 1, "--size", 96, "--bits", 16, "--transparent", "straight"]
    assert run(capfd, *words).code == 0
    path = tmp_path / "view_000.png"
    picture = read_picture(path)
    assert picture.alpha is not None
    left, top, right, bottom = BOX
    levels = quantized(np.concatenate([picture.colors, picture.alpha[..., None]], -1), 16)
    levels[top : bottom + 1, left : right + 1, :3] = (5243, 41943, 10486)
    path.write_bytes(encode_png(levels))  # as a program that drops text chunks saves it; the sidecar is still there
    done = run(capfd, "edit", asset, path, "--out", tmp_path / "out.ply", "--json")
    assert done.code == 0
    after = sp.read(tmp_path / "out.ply")
    camera = find_camera(path)
    rendered = sp.render(after, camera).colors[0]
    inside = rendered[top + 2 : bottom - 1, left + 2 : right - 1]
    assert np.abs(inside - np.array([0.08, 0.64, 0.16])).mean() < 0.05
    before = sp.render(sp.read(asset), camera).colors[0]
    outside = np.ones((96, 96), bool)
    outside[top - 4 : bottom + 5, left - 4 : right + 5] = False
    assert np.abs(rendered - before)[outside].max() < 0.02, "the soft rim of the asset stayed as it was"


def test_what_lies_behind_a_cut_out() -> None:
    """An untouched edge stays; what was erased is the asset again; paint beyond the edge lies over the background."""
    render, cover = np.full((1, 4, 3), 0.5), np.array([[0.5, 0.5, 0.0, 1.0]])
    background = (0.2, 0.2, 0.2)
    drawn = (render - (1 - cover[..., None]) * 0.2) / np.maximum(cover[..., None], 1e-9)  # its own colour
    render[0, 2] = 0.2
    colors = np.where(cover[..., None] > 0, drawn, 0.9)
    alpha = np.array([[0.5, 0.0, 1.0, 0.5]])
    over = over_render(colors, alpha, render, cover, background)
    assert np.allclose(over[0, 0], render[0, 0]) and np.allclose(over[0, 1], render[0, 1])
    assert np.allclose(over[0, 2], 0.9) and np.allclose(over[0, 3], render[0, 3])
    plain = over_render(colors, alpha, render, cover)
    assert np.allclose(plain, alpha[..., None] * colors + (1 - alpha[..., None]) * render)


# The command


@deep
def test_render_gives_what_its_options_say(tmp_path: Path, capfd: Capture) -> None:
    asset = saved(tmp_path / "ball.ply")
    words = ["render", asset, "--out", tmp_path / "v", "--views", 1, "--width", 80, "--height", 50]
    done = run(capfd, *words, "--aov", "depth, gaussian-ids", "--profile", "playcanvas", "--bits", 16, "--json")
    (view,) = done.json["views"]
    assert (view["width"], view["height"]) == (80, 50)
    assert [Path(name).name for name in view["aov"].values()] == ["view_000.depth.png", "view_000.gaussian-ids.png"]
    camera = find_camera(Path(view["file"]))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (80, 50, 40, 25)
    stored = read_picture(Path(view["file"])).colors
    splats = sp.read(asset)
    theirs = np.clip(sp.render(splats, camera, profile="playcanvas").colors[0], 0, 1)
    assert np.abs(stored - theirs).max() < 0.51 / 65535 + 1e-6
    assert np.abs(stored - np.clip(sp.render(splats, camera).colors[0], 0, 1)).max() > 1 / 255
    assert theirs[:, 15:65].std() > 0.05 and np.ptp(theirs[:, :8]) == 0, "the ball fills the height"


@pytest.mark.parametrize(
    ("words", "pattern"),
    [
        (["--aov", "depths"], "got 'depths'"),
        (["--aov", "coverage"], "only a session records"),
        (["--bits", "32"], "8 or 16 bits of PNG"),
        (["--bits", "12"], "--bits"),
        (["--format", "exr", "--transparent", "straight"], "multiplied by alpha"),
        (["--transparent", "maybe"], "maybe"),
        (["--width", "80"], "--width and --height together"),
        (["--width", "80", "--height", "9000"], "--height from 1 to 8192"),
        (["--width", "80", "--height", "50", "--size", "80"], "without --size"),
        (["--profile", "unreal"], "unreal"),
    ],
)
def test_wrong_options_of_render(words: list[str], pattern: str, tmp_path: Path, capfd: Capture) -> None:
    line = run(capfd, "render", saved(tmp_path / "ball.ply"), "--out", tmp_path / "v", *words).error
    assert pattern in line and not (tmp_path / "v").exists()


def test_without_the_extra_nothing_is_rendered(tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "OpenImageIO", None)
    asset = saved(tmp_path / "ball.ply")
    for words in (["--bits", 16], ["--format", "exr"]):
        line = run(capfd, "render", asset, "--out", tmp_path / "v", *words).error
        assert "needs OpenImageIO; pip install 'splatpainter[pictures]'" in line and not (tmp_path / "v").exists()
