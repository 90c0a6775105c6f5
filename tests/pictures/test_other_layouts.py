"""Layouts of pictures that other programs write: layers and parts of OpenEXR, TIFFs with selections, thumbnails or grey
that counts from white, a PNG's transparent level. TIFF and PNG are written here, by their specifications."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from splatpainter.color import to_light
from splatpainter.image_files import can_do_deep, encode_exr
from splatpainter.pictures.picture_reader import read_picture

RNG = np.random.default_rng(5)
deep = pytest.mark.skipif(not can_do_deep(), reason="needs OpenImageIO")
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB = 0, 1, 2
FULL, REDUCED, PAGE = 0, 1, 2


def tiff(path: Path, *pages: tuple[np.ndarray, int, int, tuple[int, ...]]) -> Path:
    """Uncompressed pages: ([H, W, C] integers, photometric interpretation, kind of page, kinds of extra samples)."""
    out = bytearray(b"II*\0" + bytes(4))
    link = 4
    for values, photometric, kind, extra in pages:
        height, width, channels = values.shape
        bits = values.dtype.itemsize * 8
        struct.pack_into("<I", out, link, len(out) + len(out) % 2)
        out += bytes(len(out) % 2)
        tags = [(254, 4, [kind]), (256, 4, [width]), (257, 4, [height]), (258, 3, [bits] * channels), (259, 3, [1])]
        tags += [(262, 3, [photometric]), (273, 4, [0]), (277, 3, [channels]), (278, 4, [height])]
        tags += [(279, 4, [values.nbytes]), (284, 3, [1])] + ([(338, 3, list(extra))] if extra else [])
        behind = len(out) + 2 + 12 * len(tags) + 4
        body, tail = b"", b""
        for tag, code, numbers in tags:
            data = struct.pack(f"<{len(numbers)}{'H' if code == 3 else 'I'}", *numbers)
            if len(data) > 4:
                data, tail = struct.pack("<I", behind + len(tail)), tail + data + bytes(len(data) % 2)
            body += struct.pack("<HHI", tag, code, len(numbers)) + data.ljust(4, b"\0")
        at = len(out) + 2 + 12 * [tag for tag, _, _ in tags].index(273) + 8
        out += struct.pack("<H", len(tags)) + body
        link = len(out)
        out += bytes(4) + tail
        struct.pack_into("<I", out, at, len(out))
        out += values.astype(values.dtype.newbyteorder("<")).tobytes()
    path.write_bytes(out)
    return path


def levels(*shape: int, kind: type = np.uint16) -> np.ndarray:
    return RNG.integers(0, np.iinfo(kind).max + 1, shape).astype(kind)


@deep
def test_sixteen_bits_with_a_saved_selection_are_read(tmp_path: Path) -> None:
    """Photoshop saves selections as channels behind the transparency."""
    values = levels(6, 5, 5)
    picture = read_picture(tiff(tmp_path / "a.tif", (values, RGB, FULL, (2, 0))))
    assert np.abs(picture.colors - values[..., :3] / 65535).max() < 1e-6
    assert picture.alpha is not None and np.abs(picture.alpha - values[..., 3] / 65535).max() < 1e-6


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_grey_that_counts_from_white(kind: type, tmp_path: Path) -> None:
    values = levels(6, 5, 1, kind=kind)
    most = np.iinfo(kind).max
    for photometric, expected in ((WHITE_IS_ZERO, 1 - values / most), (BLACK_IS_ZERO, values / most)):
        picture = read_picture(tiff(tmp_path / f"{photometric}.tif", (values, photometric, FULL, ())))
        assert np.abs(picture.colors - expected).max() < 1e-6


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_thumbnail_is_no_page(kind: type, tmp_path: Path) -> None:
    if kind is np.uint16 and not can_do_deep():
        pytest.skip("needs OpenImageIO")
    values, small = levels(8, 12, 3, kind=kind), levels(2, 3, 3, kind=kind)
    path = tiff(tmp_path / "a.tif", (values, RGB, FULL, ()), (small, RGB, REDUCED, ()), (small, RGB, REDUCED, ()))
    assert np.abs(read_picture(path).colors - values / np.iinfo(kind).max).max() < 1e-6
    for second in (PAGE, FULL):
        several = tiff(tmp_path / "b.tif", (values, RGB, FULL, ()), (values, RGB, second, ()))
        with pytest.raises(ValueError, match="expected one picture, got a TIFF of several pages"):
            read_picture(several)


def test_the_transparent_level_of_a_grey_png(tmp_path: Path) -> None:
    values = levels(4, 6)
    values[1, 2] = values[3, 5] = 777

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 6, 4, 16, 0, 0, 0, 0)) + chunk(b"tRNS", struct.pack(">H", 777))
    data = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(data)
    picture = read_picture(tmp_path / "a.png")
    assert picture.alpha is not None and np.array_equal(picture.alpha, (values != 777).astype(np.float32))


@deep
def test_the_layer_of_an_exr_that_is_the_picture(tmp_path: Path) -> None:
    """Blender's MultiLayer and renderers put the name of a layer before each channel's."""
    colors = RNG.uniform(0, 1, (6, 5, 3)).astype(np.float32)
    light, path = to_light(colors, "srgb"), tmp_path / "a.exr"
    two = np.concatenate([light, 1 - light], -1)

    def names(*layers: str) -> tuple[str, ...]:
        return tuple(f"{layer}.{channel}" for layer in layers for channel in "RGB")

    path.write_bytes(encode_exr(light, names("beauty pass")))
    picture = read_picture(path)
    assert np.abs(picture.colors - colors).max() < 1e-5
    assert picture.notes == ("its layer beauty pass was read",)
    path.write_bytes(encode_exr(two, names("ViewLayer.Combined", "ViewLayer.DiffCol")))
    assert np.abs(read_picture(path).colors - colors).max() < 1e-5
    path.write_bytes(encode_exr(two, names("left", "right")))
    with pytest.raises(ValueError, match=r"got several layers \(left, right\); save one of them"):
        read_picture(path)
    path.write_bytes(encode_exr(two[..., :4], ("R", "G", "B", "other.R")))
    assert read_picture(path).notes == ()


@deep
def test_the_picture_may_be_the_second_part_of_an_exr(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    colors = RNG.uniform(0, 1, (6, 5, 3)).astype(np.float32)
    specs = [oiio.ImageSpec(5, 6, count, "float") for count in (1, 3)]
    specs[0].channelnames = ("Z",)
    for spec, name in zip(specs, ("depth", "rgb"), strict=True):
        spec.attribute("oiio:subimagename", name)
    out = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert out is not None and out.open(str(tmp_path / "a.exr"), specs)
    assert out.write_image(np.ones((6, 5, 1), np.float32))
    assert out.open(str(tmp_path / "a.exr"), specs[1], "AppendSubimage")
    assert out.write_image(to_light(colors, "srgb")) and out.close()
    assert np.abs(read_picture(tmp_path / "a.exr").colors - colors).max() < 1e-5


def test_tiles_of_doubles_are_refused(tmp_path: Path) -> None:
    """They came back as whatever was in the memory."""
    oiio = pytest.importorskip("OpenImageIO")
    colors = np.random.default_rng(0).uniform(size=(40, 56, 3))
    path = tmp_path / "a.tif"
    spec = oiio.ImageSpec(56, 40, 3, "double")
    spec.tile_width = spec.tile_height = 16
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec) and out.write_image(colors)
    out.close()
    with pytest.raises(ValueError, match=r"a\.tif: expected floats of 16 or 32 bits, got tiles of 64 bits"):
        read_picture(path)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_a_big_endian_bigtiff_is_read(kind: type, tmp_path: Path) -> None:
    pytest.importorskip("OpenImageIO")
    most = np.iinfo(kind).max
    colors = np.random.default_rng(1).integers(0, most + 1, (9, 7, 3)).astype(kind)
    data = colors.astype(colors.dtype.newbyteorder(">")).tobytes()
    bits = 8 * colors.dtype.itemsize
    entries = [(256, 7), (257, 9), (258, None), (259, 1), (262, 2), (273, 16), (277, 3), (278, 9), (279, len(data))]
    directory = struct.pack(">Q", len(entries))
    for tag, value in entries:
        if value is None:
            directory += struct.pack(">HHQHHHH", tag, 3, 3, bits, bits, bits, 0)
        else:
            directory += struct.pack(">HHQQ", tag, 16, 1, value)
    padded = data + bytes(-len(data) % 8)
    head = b"MM" + struct.pack(">HHHQ", 43, 8, 0, 16 + len(padded))
    path = tmp_path / "a.tif"
    path.write_bytes(head + padded + directory + bytes(8))
    assert np.abs(read_picture(path).colors - colors / most).max() < 1e-6
