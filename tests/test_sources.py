"""Pictures from files: every depth, palette, alpha, turn and profile that an editor may save; cameras and masks."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, look_at
from splatpainter.color import from_display, to_display
from splatpainter.image_files import write_png
from splatpainter.pictures import edit_from_files
from splatpainter.pictures.edit_files import camera_from
from splatpainter.pictures.picture_reader import read_mask, read_picture, resample
from splatpainter.rendering import render
from tests.support.cli_scenes import ball, paint, without_camera

RNG = np.random.default_rng(7)
COLORS = RNG.integers(0, 256, (12, 16, 3), np.uint8)


def save(path: Path, pixels: np.ndarray, mode: str | None = None, **options: object) -> Path:
    picture = Image.fromarray(pixels)
    (picture.convert(mode) if mode else picture).save(path, **options)  # type: ignore[arg-type]
    return path


def png16(path: Path, values: np.ndarray) -> Path:
    """A 16-bit PNG written by hand (Pillow writes none in colour). values: [H, W] or [H, W, 3] uint16."""
    height, width = values.shape[:2]
    kind = 0 if values.ndim == 2 else 2
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    data = b"\x89PNG\r\n\x1a\n"
    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    for name, part in ((b"IHDR", header), (b"IDAT", zlib.compress(raw)), (b"IEND", b"")):
        data += struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
    path.write_bytes(data)
    return path


# Decoding


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
def test_lossless_pictures_are_read_exactly(name: str, tmp_path: Path) -> None:
    stored = save(tmp_path / name, COLORS, lossless=True) if name.endswith("webp") else save(tmp_path / name, COLORS)
    picture = read_picture(stored)
    assert picture.colors.dtype == np.float32 and picture.alpha is None and picture.notes == ()
    assert np.array_equal(np.round(picture.colors * 255), COLORS)


def test_jpeg_and_grey_and_palette(tmp_path: Path) -> None:
    flat = np.full((16, 16, 3), (200, 90, 40), np.uint8)
    jpeg = read_picture(save(tmp_path / "a.jpg", flat, quality=95))
    assert np.abs(jpeg.colors * 255 - flat).max() <= 3
    grey = read_picture(save(tmp_path / "g.png", COLORS[..., 0]))
    assert np.array_equal(np.round(grey.colors * 255), np.repeat(COLORS[..., :1], 3, -1))
    few = COLORS // 128 * 255
    palette = read_picture(save(tmp_path / "p.png", few, "P"))
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.mode == "P"
    assert np.array_equal(np.round(palette.colors * 255), few)
    bits = read_picture(save(tmp_path / "b.png", few[..., 0], "1"))
    assert set(np.unique(bits.colors)) == {0.0, 1.0}


def test_sixteen_bits(tmp_path: Path) -> None:
    deep = RNG.integers(0, 65536, (6, 5), np.uint16)
    grey = read_picture(png16(tmp_path / "g.png", deep))
    assert np.abs(grey.colors[..., 1] - deep / 65535).max() < 1e-6
    color = RNG.integers(0, 65536, (6, 5, 3), np.uint16)
    assert np.abs(read_picture(png16(tmp_path / "c.png", color)).colors - color / 65535).max() <= 1 / 255
    Image.fromarray(deep).save(tmp_path / "g.tif")
    assert np.abs(read_picture(tmp_path / "g.tif").colors[..., 0] - deep / 65535).max() < 1e-6
    light = RNG.uniform(-0.5, 1.5, (6, 5)).astype(np.float32)
    Image.fromarray(light).save(tmp_path / "f.tif")
    assert np.array_equal(read_picture(tmp_path / "f.tif").colors[..., 2], np.clip(light, 0, 1))


def test_alpha_of_every_kind(tmp_path: Path) -> None:
    alpha = RNG.integers(0, 256, (12, 16, 1), np.uint8)
    full = read_picture(save(tmp_path / "a.png", np.concatenate([COLORS, alpha], -1)))
    assert full.alpha is not None and np.array_equal(np.round(full.alpha * 255), alpha[..., 0])
    assert np.array_equal(np.round(full.colors * 255), COLORS), "colours are straight, not multiplied"
    opaque = read_picture(save(tmp_path / "o.png", np.concatenate([COLORS, np.full_like(alpha, 255)], -1)))
    assert opaque.alpha is None
    key = Image.fromarray(COLORS // 128 * 255).convert("P")
    key.info["transparency"] = key.getpixel((0, 0))
    key.save(tmp_path / "k.png")
    keyed = read_picture(tmp_path / "k.png")
    same = (COLORS // 128 == COLORS[0, 0] // 128).all(-1)
    assert keyed.alpha is not None and np.array_equal(keyed.alpha == 0, same)


def test_a_photograph_turned_by_exif(tmp_path: Path) -> None:
    """EXIF 6: the camera was turned; the picture is to be shown rotated by 90 degrees clockwise."""
    exif = Image.Exif()
    exif[274] = 6
    stored = save(tmp_path / "a.png", COLORS, exif=exif)
    assert np.array_equal(np.round(read_picture(stored).colors * 255), np.rot90(COLORS, -1))


def icc(swapped: bool = False) -> bytes:
    """A small ICC v2 display profile by hand: linear light of sRGB's primaries (D50), red and blue exchanged if
    swapped."""
    red, green, blue = (0.4361, 0.2225, 0.0139), (0.3851, 0.7169, 0.0971), (0.1431, 0.0606, 0.7141)
    if swapped:
        red, blue = blue, red

    def xyz(values: tuple[float, ...]) -> bytes:
        return b"XYZ \0\0\0\0" + b"".join(struct.pack(">i", round(v * 65536)) for v in values)

    curve = b"curv\0\0\0\0" + struct.pack(">I", 0)
    name = b"hand-made"
    desc = b"desc\0\0\0\0" + struct.pack(">I", len(name) + 1) + name + b"\0" + bytes(78)
    tags = {b"desc": desc, b"cprt": b"text\0\0\0\0none\0", b"wtpt": xyz((0.9642, 1.0, 0.8249))}
    tags |= {b"rXYZ": xyz(red), b"gXYZ": xyz(green), b"bXYZ": xyz(blue)}
    tags |= {b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    offset, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for tag, data in tags.items():
        data += bytes(-len(data) % 4)
        table += tag + struct.pack(">II", offset + len(body), len(data))
        body += data
    size = offset + len(body)
    header = struct.pack(">I4sI4s4s4s", size, b"none", 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H4s", 2024, 1, 1, 0, 0, 0, b"acsp") + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)
    return header + bytes(128 - len(header)) + table + body


def srgb_coded(light: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, written out."""
    return np.array([12.92 * v if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055 for v in light.ravel()]).reshape(
        light.shape
    )


def test_embedded_profiles_become_srgb(tmp_path: Path) -> None:
    linear = read_picture(save(tmp_path / "l.png", COLORS, icc_profile=icc()))
    assert np.abs(linear.colors - srgb_coded(COLORS / 255)).max() < 0.012
    assert len(linear.notes) == 1 and "hand-made" in linear.notes[0]
    turned = read_picture(save(tmp_path / "t.png", COLORS, icc_profile=icc(swapped=True)))
    assert np.abs(turned.colors - srgb_coded(COLORS[..., ::-1] / 255)).max() < 0.012
    with_alpha = np.concatenate([COLORS, np.full((12, 16, 1), 9, np.uint8)], -1)
    clear = read_picture(save(tmp_path / "c.png", with_alpha, icc_profile=icc()))
    assert clear.alpha is not None and np.allclose(clear.alpha, 9 / 255)
    assert np.abs(clear.colors - srgb_coded(COLORS / 255)).max() < 0.012


def test_srgb_profiles_and_broken_ones_leave_colours_alone(tmp_path: Path) -> None:
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    plain = read_picture(save(tmp_path / "s.png", COLORS, icc_profile=profile))
    assert np.array_equal(np.round(plain.colors * 255), COLORS) and plain.notes == ()
    broken = read_picture(save(tmp_path / "x.png", COLORS, icc_profile=b"no profile at all"))
    assert np.array_equal(np.round(broken.colors * 255), COLORS) and "cannot be used" in broken.notes[0]


def test_cmyk_is_shown_in_rgb(tmp_path: Path) -> None:
    flat = np.zeros((8, 8, 3), np.uint8)
    flat[:] = (10, 200, 30)
    picture = read_picture(save(tmp_path / "a.tif", flat, "CMYK"))
    assert np.abs(picture.colors[0, 0] * 255 - flat[0, 0]).max() <= 2
    with pytest.raises(ValueError, match=r"a\.tif: expected RGB colours, got CMYK; save it as RGB$"):
        read_picture(tmp_path / "a.tif", inks=False)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("a.png", "expected a still picture, got PNG with 2 frames; save one of them as PNG"),
        ("a.webp", "expected a still picture, got WEBP with 2 frames; save one of them as PNG"),
        ("a.tif", "expected one picture, got a TIFF of several pages or layers; flatten it, or save a PNG"),
    ],
)
def test_of_several_pictures_in_a_file_none_is_guessed(tmp_path: Path, name: str, line: str) -> None:
    frames = [Image.new("RGB", (8, 8), (shade, 0, 0)) for shade in (20, 200)]
    frames[0].save(tmp_path / name, save_all=True, append_images=frames[1:])
    for read in (read_picture, read_mask):
        with pytest.raises(ValueError) as refusal:
            read(tmp_path / name)
        assert str(refusal.value) == f"{tmp_path / name}: {line}"


def test_the_preview_in_a_phones_jpeg_is_no_second_frame(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (8, 8), (shade, 0, 0)) for shade in (200, 20)]
    frames[0].save(tmp_path / "a.jpg", format="MPO", save_all=True, append_images=frames[1:])
    assert read_picture(tmp_path / "a.jpg").colors[0, 0, 0] > 0.7


def test_masks(tmp_path: Path) -> None:
    expected = np.zeros((12, 16), bool)
    expected[3:7, 4:9] = True
    faint = np.where(expected, 1, 0).astype(np.uint8)
    assert np.array_equal(read_mask(save(tmp_path / "l.png", faint)), expected), "any pixel that is not black"
    color = np.zeros((12, 16, 3), np.uint8)
    color[expected] = (0, 0, 255)
    assert np.array_equal(read_mask(save(tmp_path / "c.png", color)), expected)
    layer = np.zeros((12, 16, 4), np.uint8)
    layer[expected] = (0, 0, 0, 255)
    assert np.array_equal(read_mask(save(tmp_path / "a.png", layer)), expected), "a black stroke on a clear layer"
    noisy = np.kron(np.where(expected, 255, 0), np.ones((8, 8))).astype(np.uint8)
    read = read_mask(save(tmp_path / "n.jpg", noisy, quality=60))
    assert (read[np.kron(~expected, np.ones((8, 8), bool))]).mean() < 0.02, "what JPEG leaves on black is no mask"


def test_resampling_keeps_flat_colours_and_means() -> None:
    flat = np.full((20, 30, 3), 0.25, np.float32)
    assert np.allclose(resample(flat, 13, 7), 0.25, atol=1e-6)
    noise = RNG.uniform(0, 1, (64, 64)).astype(np.float32)
    small = resample(noise, 16, 16)
    assert small.shape == (16, 16) and abs(small.mean() - noise.mean()) < 0.01


def test_display_and_linear_colours() -> None:
    """0.5 of light is 0.735357 of sRGB (IEC 61966-2-1)."""
    values = np.array([0.0, 0.002, 0.5, 1.0])
    assert np.allclose(to_display(values, "linear"), [0, 0.02584, 0.735357, 1], atol=1e-6)
    assert np.allclose(from_display(to_display(values, "linear"), "linear"), values, atol=1e-12)
    assert to_display(values, "srgb") is values and from_display(values, "srgb") is values


# Edits


@pytest.fixture()
def camera() -> Camera:
    return look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), width=64, height=48, fov=45, background=(0.2, 0.2, 0.2))


@pytest.fixture()
def view(tmp_path: Path, camera: Camera) -> Path:
    """A render of the ball, 64x48, with its camera inside."""
    write_png(tmp_path / "view.png", render(ball(), camera).colors[0], camera)
    return tmp_path / "view.png"


def test_a_plain_picture_leaves_the_mask_to_the_painter(view: Path) -> None:
    source = edit_from_files(view)
    edit = source.edit(ball())
    with Image.open(view) as picture:
        assert np.array_equal(np.round(edit.image * 255), np.asarray(picture))
    assert edit.mask is None and edit.name == str(view) and source.notes == ()


def test_the_order_of_cameras(view: Path, tmp_path: Path, camera: Camera) -> None:
    (tmp_path / "elsewhere").mkdir()
    bare = without_camera(view, tmp_path / "elsewhere" / "bare.png")
    with pytest.raises(ValueError, match="no camera in it, in bare.json, or given with --camera, and no view beside"):
        edit_from_files(bare)
    bare = without_camera(view, tmp_path / "bare.png")
    assert edit_from_files(bare).camera.width == 64, "that of the view beside it that it matches"
    (tmp_path / "bare.json").write_text(camera.resized(32, 24).to_json())
    assert edit_from_files(bare).at_view().camera.width == 32, "the sidecar"
    (tmp_path / "view.json").write_text(camera.resized(32, 24).to_json())
    assert edit_from_files(view).camera.width == 64, "the chunk before the sidecar"
    assert edit_from_files(view, tmp_path / "bare.json").at_view().camera.width == 32, "a given one before both"
    assert np.array_equal(camera_from(view).world_to_camera, camera.world_to_camera)
    assert edit_from_files(bare, view).camera.width == 64, "a rendered PNG stands for its camera"


def test_transparent_pixels_mean_unchanged(view: Path, tmp_path: Path, camera: Camera) -> None:
    splats = ball()
    before = np.clip(render(splats, camera).colors[0], 0, 1)
    layer = np.zeros((48, 64, 4), np.uint8)
    layer[20:28, 28:36] = (250, 0, 0, 255)
    layer[20:28, 36:40] = (250, 0, 0, 128)
    Image.fromarray(layer).save(tmp_path / "layer.png")
    edit = edit_from_files(tmp_path / "layer.png", view).edit(splats)
    assert np.array_equal(edit.image[:20], before[:20].astype(np.float32)), "not even rounded"
    assert np.allclose(edit.image[20:28, 28:36], (250 / 255, 0, 0))
    half = 128 / 255
    assert np.allclose(edit.image[20:28, 36:40], half * np.array([250 / 255, 0, 0]) + (1 - half) * before[20:28, 36:40])
    complete = edit_from_files(tmp_path / "layer.png", view).edit(splats, "global")
    assert complete.mask is not None and np.array_equal(complete.mask, layer[..., 3] > 0)
    Image.fromarray(layer).resize((128, 96), Image.Resampling.NEAREST).save(tmp_path / "large.png")
    mask = edit_from_files(tmp_path / "large.png", view).edit(splats).mask
    assert mask is not None and mask.shape == (96, 128) and mask[42:54, 58:78].all()
    mask = mask.copy()
    mask[36:60, 52:84] = False
    assert not mask.any(), "resampling does not turn edges under the clear part into paint"


@pytest.mark.parametrize("factor", [0.5, 1.5, 3.0])
def test_a_resized_picture_is_masked_where_it_was_painted(factor: float, view: Path, tmp_path: Path) -> None:
    painted = paint(view, tmp_path / "painted.png", (26, 18, 37, 29))
    with Image.open(painted) as picture:
        size = (round(64 * factor), round(48 * factor))
        picture.resize(size, Image.Resampling.BICUBIC).save(tmp_path / "resized.png")
    source = edit_from_files(tmp_path / "resized.png", view)
    times = max(factor, 1)
    assert source.picture.size == (64 * times, 48 * times)
    assert ("resampled" if factor < 1 else "a larger render") in source.notes[0]
    mask = source.edit(ball()).mask
    assert mask is not None and mask[int(19 * times) : int(29 * times), int(27 * times) : int(37 * times)].all()
    mask = mask.copy()
    mask[int(14 * times) : int(34 * times), int(22 * times) : int(42 * times)] = False
    assert mask.mean() < 0.01, "edges that resampling softened are not paint"


def test_a_mask_of_another_size(view: Path, tmp_path: Path) -> None:
    big = np.zeros((480, 640), np.uint8)
    big[200:280, 300:304] = 255  # a stroke 0.4 pixels wide in the view
    save(tmp_path / "m.png", big)
    mask = edit_from_files(view, None, tmp_path / "m.png").mask
    assert mask is not None and mask.shape == (48, 64)
    assert mask[20:28, 30].all() and mask.sum() <= 20


def test_rounding_of_a_side_is_not_another_aspect_ratio(tmp_path: Path, camera: Camera) -> None:
    """A 1000x667 view halved to 500x334 or 500x333 is the same view; 500x320 is not."""
    wide = Camera(1000, 667, 900, 900, 500, 333.5, camera.world_to_camera)
    for size, good in (((500, 334), True), ((500, 333), True), ((500, 320), False)):
        path = tmp_path / f"{size[1]}.png"
        Image.new("RGB", size).save(path)
        path.with_suffix(".json").write_text(wide.to_json())
        if good:
            assert edit_from_files(path).picture.size == (1000, 667)
        else:
            with pytest.raises(ValueError, match="aspect ratio"):
                edit_from_files(path)
