"""Damage that decoders only meet when a part of a picture is used: one line that names the file, no warning."""

from __future__ import annotations

import contextlib
import logging
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import Camera, look_at
from splatpainter.image_files import find_camera
from splatpainter.pictures import picture_reader
from splatpainter.pictures.edit_files import edit_from_files
from splatpainter.pictures.foreign_pictures import READ_KINDS
from splatpainter.pictures.picture_reader import read_picture


def png(header: bytes, *parts: tuple[bytes, bytes]) -> bytes:
    """A PNG file of the given chunks around one line of pixel data."""
    out = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), *parts, (b"IEND", b"")):
        out += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return out


GREY = struct.pack(">IIBBBBB", 2, 1, 8, 0, 0, 0, 0)
PIXELS = (b"IDAT", zlib.compress(b"\0\x80\x80"))
DAMAGED = {
    "EXIF that is none": png(GREY, (b"eXIf", b"splatpainter"), PIXELS),
    "EXIF cut short": png(GREY, (b"eXIf", b"MM\0*\0\0\0\x08\0\x09\x01\x12"), PIXELS),
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED)
def test_a_picture_is_read_or_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    try:
        assert read_picture(path).size == (2, 1)
    except ValueError as error:
        assert type(error) is ValueError and str(error).startswith(str(path)) and str(error).isprintable()


def test_a_tiff_whose_tags_lie_outside_of_it_has_no_camera_and_warns_of_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tags = [(256, 4, 1, 2), (257, 4, 1000, 9999), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 8)]
    path.write_bytes(tiff_of(tags))
    with pytest.raises(ValueError) as caught:
        find_camera(path)
    assert type(caught.value) is ValueError and str(path) in str(caught.value)


def tiff_of(tags: list[tuple[int, int, int, int]]) -> bytes:
    """A TIFF of one page: (tag, type, count, value) each, and four bytes of pixels."""
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(8)


def test_a_tiff_of_too_many_samples_is_one_line_and_nothing_on_stderr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.tif"
    tags = [
        (256, 4, 1, 2),
        (257, 4, 1, 2),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 8),
        (277, 3, 1, 262),
    ]
    path.write_bytes(tiff_of(tags))
    monkeypatch.setattr(logging.getLogger("PIL"), "propagate", False)  # pytest listens, a user's process does not
    with pytest.raises(ValueError, match="expected a PNG, JPEG, WebP, TIFF|cannot be read"):
        read_picture(path)
    assert capfd.readouterr().err == ""


def test_a_camera_of_an_endless_version_is_refused_in_a_short_line() -> None:
    with pytest.raises(ValueError, match="expected camera version 1") as caught:
        Camera.from_json('{"version": [' + ", ".join(["7"] * 5000) + "]}", "a.json")
    assert len(str(caught.value)) < 200


def test_a_kilobyte_that_claims_megapixels_of_another_shape_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """24 x 2,000,000 pixels for a camera of 24 x 16: decoding took 1.9 GB before the refusal."""
    camera = look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), width=24, height=16).to_json().encode()
    header = struct.pack(">IIBBBBB", 24, 2_000_000, 8, 2, 0, 0, 0)
    path = tmp_path / "a.png"
    path.write_bytes(png(header, (b"tEXt", b"splatpainter\0" + camera), PIXELS))
    monkeypatch.setattr(picture_reader, "_srgb", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(ValueError, match="aspect ratio of its camera .24x16., got 24x2000000"):
        edit_from_files(path)


def test_a_tiff_packed_by_webp_is_one_line_and_nothing_on_stderr(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """libtiff, where it lacks a compression, prints so past Python."""
    path = tmp_path / "a.tif"
    tags = [
        (256, 4, 1, 2),
        (257, 4, 1, 2),
        (258, 3, 1, 8),
        (259, 3, 1, 50001),
        (262, 3, 1, 1),
        (273, 4, 1, 8),
        (277, 3, 1, 1),
        (278, 4, 1, 2),
        (279, 4, 1, 4),
    ]
    path.write_bytes(tiff_of(tags))
    with pytest.raises(
        ValueError,
        match=rf"a.tif: expected a {READ_KINDS} picture, got a TIFF packed by WebP",
    ):
        read_picture(path)
    assert capfd.readouterr().err == ""


def test_pixels_that_are_no_numbers_are_counted_where_they_show(tmp_path: Path) -> None:
    """As black specks they would be paint; where nothing is drawn, 0 / 0 of an undone alpha is usual."""
    pytest.importorskip("OpenImageIO")
    for name, at, alpha in (("a", 3, 1), ("b", 3, 0)):
        pixels = np.full((4, 4, 4), 0.5, np.float32)
        pixels[0, at, :3], pixels[0, at, 3] = np.nan, alpha
        write_exr_of(tmp_path / f"{name}.exr", pixels)
    with pytest.raises(ValueError, match=r"a.exr: 1 of 16 pixels are NaN \(no number\); expected colours: repair them"):
        read_picture(tmp_path / "a.exr")
    assert read_picture(tmp_path / "b.exr").size == (4, 4)


def write_exr_of(path: Path, pixels: np.ndarray) -> None:
    """An OpenEXR file of R, G, B, A as they are, NaN too, which the project's writer refuses."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 4, "float")
    out = oiio.ImageOutput.create(str(path))
    assert out is not None and out.open(str(path), spec) and out.write_image(pixels)
    out.close()


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate"])
def test_a_damaged_tiff_is_one_line_and_nothing_on_stderr(
    compression: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.tif"
    noise = np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)
    Image.fromarray(noise).save(path, compression=compression)
    data = bytearray(path.read_bytes())
    data[200:1200] = bytes(byte ^ 0x55 for byte in data[200:1200])
    path.write_bytes(data)
    with pytest.raises(ValueError, match="a.tif: damaged picture"):
        read_picture(path)
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "after\n", "and what comes later is printed"


def packed_tiff(path: Path, *, tiled: bool = False, bits: str = "uint8") -> bytes:
    """A TIFF of PackBits, half of it flat, by libtiff; 16 bits are read by OpenImageIO."""
    oiio = pytest.importorskip("OpenImageIO")
    pixels = np.full((48, 64, 3), 0.75, np.float32)
    pixels[16:32, 8:40] = np.random.default_rng(0).uniform(size=(16, 32, 3))
    spec = oiio.ImageSpec(64, 48, 3, bits)
    spec.attribute("compression", "packbits")
    if tiled:
        spec.tile_width = spec.tile_height = 16
    out = oiio.ImageOutput.create(str(path))
    assert out is not None and out.open(str(path), spec) and out.write_image(pixels)
    out.close()
    return path.read_bytes()


def first_part(tiff: bytes) -> int:
    """Where the first strip or tile of a little-endian TIFF begins."""
    (at,) = struct.unpack_from("<I", tiff, 4)
    (count,) = struct.unpack_from("<H", tiff, at)
    tags = {tag: rest for tag, _, *rest in struct.iter_unpack("<HHII", tiff[at + 2 : at + 2 + 12 * count])}
    number, value = tags.get(324) or tags[273]
    return value if number == 1 else struct.unpack_from("<I", tiff, value)[0]


@pytest.mark.parametrize(("tiled", "bits"), [(False, "uint8"), (True, "uint8"), (False, "uint16")])
def test_packbits_that_unpack_to_another_size_are_no_paint(tmp_path: Path, tiled: bool, bits: str) -> None:
    """libtiff fills a row up, or cuts it, and says nothing: everything behind the damaged byte lies elsewhere."""
    path = tmp_path / "a.tif"
    data = packed_tiff(path, tiled=tiled, bits=bits)
    assert read_picture(path).size == (64, 48)
    at = first_part(data)
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \((strip|tile) 0 unpacks to [\d,]+ bytes, expected"):
        read_picture(path)


@pytest.mark.parametrize("ending", ["jpg", "webp", "tif"])
@pytest.mark.parametrize("zeros", [False, True])
def test_a_download_that_was_not_finished_is_one_line(ending: str, zeros: bool, tmp_path: Path) -> None:
    """A lossy WebP whose second half was never written is decoded all the same."""
    path = tmp_path / f"a.{ending}"
    noise = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    Image.fromarray(noise).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2 if zeros and ending != "tif" else 0))
    with pytest.raises(ValueError, match=f"a.{ending}: (damaged picture|cannot be read)"):
        read_picture(path)


def test_a_tiff_whose_page_list_is_missing_is_called_cut_off(tmp_path: Path) -> None:
    """It was called a TIFF that is packed in a way that is not read."""
    path = tmp_path / "a.tif"
    Image.fromarray(np.zeros((64, 64, 3), np.uint8)).save(path, compression="tiff_lzw")
    data = path.read_bytes()
    path.write_bytes(data[:8] + data[8 : len(data) // 4])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \(cut off: .*get it again"):
        read_picture(path)


@pytest.mark.parametrize("ending", ["jpg", "webp"])
def test_zeros_behind_the_end_of_a_picture_are_no_damage(ending: str, tmp_path: Path) -> None:
    """Some cameras and disks pad files."""
    path = tmp_path / f"a.{ending}"
    Image.fromarray(np.full((32, 32, 3), 90, np.uint8)).save(path)
    path.write_bytes(path.read_bytes() + bytes(70_000))
    assert read_picture(path).size == (32, 32)


def test_a_picture_that_is_transparent_everywhere_says_so(tmp_path: Path) -> None:
    """Its layers were hidden when it was saved: it was said not to differ from the render."""
    path = tmp_path / "a.png"
    Image.fromarray(np.full((16, 24, 4), (200, 30, 30, 0), np.uint8)).save(path)
    path.with_suffix(".json").write_text(look_at((0, 0, -3), (0, 0, 0), width=24, height=16).to_json())
    with pytest.raises(ValueError, match=r"a.png: is transparent everywhere: there is no paint in it"):
        edit_from_files(path)


def noisy(width: int = 96, height: int = 80) -> Image.Image:
    """Flat above, noise below: what lacks of it is the part with detail."""
    pixels = np.full((height, width, 3), 200, np.uint8)
    pixels[16:] = np.random.default_rng(0).integers(0, 256, (height - 16, width, 3))
    return Image.fromarray(pixels)


JPEGS: dict[str, dict[str, Any]] = {
    "sequential": {"quality": 90},
    "progressive": {"quality": 90, "progressive": True},
    "with restarts": {"quality": 90, "restart_marker_rows": 1},
    "fine colours": {"quality": 75, "subsampling": 0, "optimize": True},
}


@pytest.mark.parametrize("options", JPEGS.values(), ids=JPEGS)
def test_a_jpeg_with_a_part_lost_is_no_paint(tmp_path: Path, options: dict[str, Any]) -> None:
    """Decoders fill up with grey and say nothing: a cut one that a program closed again, and lost or foreign bytes."""
    path = tmp_path / "a.jpg"
    noisy().save(path, **options)
    data, rng = path.read_bytes(), np.random.default_rng(1)
    assert read_picture(path).size == (96, 80)
    half, most = len(data) // 2, len(data) * 3 // 4
    damaged = [
        data[:half] + b"\xff\xd9",
        data[:most] + b"\xff\xd9",
        data[:half] + data[half + 90 :],
        data[:most] + rng.bytes(40) + data[most + 40 :],
        data[:half] + bytes(300) + data[half + 300 :],
    ]
    for part in damaged:
        path.write_bytes(part)
        with pytest.raises(ValueError, match=r"a.jpg: damaged picture .*\d+ % of the way down.*: get it again"):
            read_picture(path)


def test_sound_jpegs_of_all_kinds_are_read(tmp_path: Path) -> None:
    """Odd sizes, thinned colours, grey, inks, blocks between restarts, zeros in place of ones behind the last bit."""
    path, rng = tmp_path / "a.jpg", np.random.default_rng(2)
    for number in range(60):
        width, height = ((1, 1), (17, 33), (64, 40), (129, 65), (255, 3))[number % 5]
        pixels = rng.normal(128, (0, 5, 60)[number % 3], (height, width, 3)).clip(0, 255).astype(np.uint8)
        image = Image.fromarray(pixels).convert(("RGB", "L", "RGB", "CMYK")[number % 4])
        options: dict[str, Any] = {"quality": (1, 40, 75, 100)[number // 5 % 4], "progressive": number % 2 == 0}
        thinned: dict[str, Any] = {"subsampling": (0, 1, 2, "4:1:1")[number // 3 % 4]} if image.mode == "RGB" else {}
        restarts: dict[str, Any] = {"restart_marker_blocks": 1 + number % 4} if number % 3 == 0 else {}
        image.save(path, **options, **thinned, **restarts)
        assert read_picture(path).size == (width, height)


@pytest.mark.parametrize("tags", [{}, {317: 2}])
def test_lzw_that_unpacks_to_another_size_is_no_paint(tmp_path: Path, tags: dict[int, int]) -> None:
    """libtiff stops where it has as much as it wants: everything behind the damaged byte lies elsewhere."""
    path = tmp_path / "a.tif"
    y, x = np.mgrid[:80, :96]
    pixels = np.stack([2 * x, 3 * y, x + y], -1).astype(np.uint8)
    pixels[16:40, 30:60] = np.random.default_rng(0).integers(0, 256, (24, 30, 3))
    Image.fromarray(pixels).save(path, compression="tiff_lzw", tiffinfo=tags)
    data = path.read_bytes()
    assert read_picture(path).size == (96, 80)
    for at in (522, 707, 892, 1262, 1299):
        path.write_bytes(data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :])
        with pytest.raises(
            ValueError, match=r"a.tif: damaged picture \(strip \d does not unpack|unpacks to [\d,]+ bytes"
        ):
            read_picture(path)


def test_a_jpeg_in_a_tiff_with_a_part_lost_is_no_paint(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    noisy().save(path, compression="jpeg")
    data = path.read_bytes()
    at = first_part(data) + 1_500
    path.write_bytes(data[:at] + data[at + 10 : at + 600] + data[at : at + 10] + data[at + 600 :])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \(strip 0: its packed pixels make no sense"):
        read_picture(path)


def test_a_deflated_tiff_or_psd_with_another_sum_is_no_paint(tmp_path: Path) -> None:
    """Both were read up to their last pixel, and not to the sum behind it."""
    path = tmp_path / "a.tif"
    noisy().save(path, compression="tiff_adobe_deflate")
    data = path.read_bytes()
    stream = zlib.decompressobj()
    stream.decompress(data[first_part(data) :])
    last = len(data) - len(stream.unused_data) - 1
    path.write_bytes(data[:last] + bytes([data[last] ^ 1]) + data[last + 1 :])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \(strip 0 does not unpack"):
        read_picture(path)
    # All pixels are there, and the sum behind them is cut off.
    (at,) = struct.unpack_from("<I", data, 4)
    tags = [tag for tag, *_ in struct.iter_unpack("<HHII", data[at + 2 : at + 2 + 12 * data[at]])]
    position = at + 2 + 12 * tags.index(279) + 8
    (packed,) = struct.unpack_from("<I", data, position)
    path.write_bytes(data[:position] + struct.pack("<I", packed - 2) + data[position + 4 :])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \(strip 0 does not unpack"):
        read_picture(path)
    planes = zlib.compress(np.asarray(noisy(32, 24)).transpose(2, 0, 1).tobytes(), 0)
    head = b"8BPS\0\1" + bytes(6) + struct.pack(">HIIHH", 3, 24, 32, 8, 3) + bytes(12) + b"\0\2"
    path = tmp_path / "a.psd"
    path.write_bytes(head + planes)
    assert read_picture(path).size == (32, 24)
    path.write_bytes(head + planes[:1_500] + bytes(9) + planes[1_509:-4])
    with pytest.raises(ValueError, match=r"a.psd: damaged PSD"):
        read_picture(path)


def test_a_tiff_cut_off_within_its_tags_is_called_damaged(tmp_path: Path) -> None:
    """It was called a TIFF that is packed in a way that is not read."""
    path = tmp_path / "a.tif"
    noisy().save(path, compression="tiff_lzw")
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    with pytest.raises(ValueError, match=r"a.tif: damaged picture \(cut off within.*: get it again"):
        read_picture(path)


def test_a_png_whose_pixels_have_another_sum_is_no_paint(tmp_path: Path) -> None:
    """Pillow does not ask: a picture whose second half was never written came out half black."""
    path = tmp_path / "a.png"
    noisy().save(path)
    data = bytearray(path.read_bytes())
    data[60] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"a.png: damaged picture \(its IDAT chunk has another checksum than it says"):
        read_picture(path)
    # A damaged text is not a damaged picture.
    note = b"tEXt" + b"Comment\0painted"
    chunk = struct.pack(">I", len(note) - 4) + note + bytes(4)
    noisy().save(path)
    data = path.read_bytes()
    path.write_bytes(data[:33] + chunk + data[33:])
    with contextlib.suppress(ValueError):  # Pillow may refuse it in its own words
        assert read_picture(path).size == (96, 80)
