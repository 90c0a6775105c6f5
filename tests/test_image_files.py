"""Picture files of 8, 16 and 32 bits: what goes in comes out, text travels, claims are judged before decoding."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter import image_files
from splatpainter.cameras import look_at
from splatpainter.color import to_display, to_light
from splatpainter.image_files import (
    encode_exr,
    encode_png,
    exr_text,
    find_alpha,
    find_camera,
    quantized,
    quick_png,
    read_deep,
)
from splatpainter.pictures.picture_reader import read_mask, read_picture

RNG = np.random.default_rng(5)
deep = pytest.mark.skipif(not image_files.can_do_deep(), reason="OpenImageIO is not installed (extra pictures)")


def png_by_hand(levels: np.ndarray) -> bytes:
    """A 16-bit PNG of [H, W, 2, 3 or 4] levels by the specification, rows unfiltered; independent of any library."""
    height, width, count = levels.shape
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in levels)
    data = b"\x89PNG\r\n\x1a\n"
    head = struct.pack(">IIBBBBB", width, height, 16, {2: 4, 3: 2, 4: 6}[count], 0, 0, 0)
    for name, part in ((b"IHDR", head), (b"IDAT", zlib.compress(raw)), (b"IEND", b"")):
        data += struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
    return data


def levels_by_hand(data: bytes) -> np.ndarray:
    """[H, W, C] levels of a 16-bit PNG, its filters undone byte by byte (PNG specification, section 9)."""
    offset, packed, header = 8, b"", (0, 0, 0, 0)
    while offset < len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        part = data[offset + 8 : offset + 8 + length]
        header = struct.unpack(">IIBB", part[:10]) if kind == b"IHDR" else header
        packed += part if kind == b"IDAT" else b""
        offset += 12 + length
    width, height, bits, color = header
    assert bits == 16
    channels = {0: 1, 4: 2, 2: 3, 6: 4}[color]
    step, stride = 2 * channels, 2 * channels * width
    raw, above, rows = zlib.decompress(packed), [0] * stride, []
    for y in range(height):
        kind, line = raw[y * (stride + 1)], list(raw[y * (stride + 1) + 1 : (y + 1) * (stride + 1)])
        for k in range(stride):
            left, up = line[k - step] if k >= step else 0, above[k]
            corner = above[k - step] if k >= step else 0
            guess = left + up - corner
            nearest = min((abs(guess - v), order, v) for order, v in enumerate((left, up, corner)))[2]
            line[k] = (line[k] + (0, left, up, (left + up) // 2, nearest)[kind]) % 256
        above = line
        rows.append(line)
    return np.array(rows, np.uint8).reshape(height, width, channels, 2) @ np.array([256, 1])


def test_levels_are_rounded_and_odd_values_are_black_or_white() -> None:
    values = np.array([-1, 0, 0.5 / 65535, 0.499 / 65535, 1, 2, np.nan, np.inf])
    assert quantized(values, 16).tolist() == [0, 0, 1, 0, 65535, 65535, 0, 65535]
    assert quantized(np.array([0.5, 1.0])).dtype == np.uint8


@deep
@pytest.mark.parametrize("channels", [2, 3, 4])
def test_sixteen_bit_png_is_written_as_the_specification_says(channels: int, tmp_path: Path) -> None:
    levels = RNG.integers(0, 65536, (9, 11, channels)).astype(np.uint16)
    levels[:4] = np.linspace(0, 65535, 11)[:, None]  # a ramp, which encoders filter
    data = encode_png(levels, {"splatpainter": "words"})
    assert np.array_equal(levels_by_hand(data), levels)
    (tmp_path / "a.png").write_bytes(data)
    with Image.open(tmp_path / "a.png") as image:
        assert image.info["splatpainter"] == "words" and image.size == (11, 9)


def chunks_of(data: bytes) -> list[tuple[bytes, bytes]]:
    """(kind, contents) of a PNG's chunks, without a library."""
    out, at = [], 8
    while at < len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        out.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return out


def png_of_chunks(chunks: list[tuple[bytes, bytes]]) -> bytes:
    parts = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_a_camera_behind_the_pixels_is_found_and_none_is_looked_for_in_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = look_at([0, 0, 3], [0, 0, 0], width=9, height=8)
    text = {"splatpainter": camera.to_json()}
    ahead = chunks_of(encode_png(RNG.integers(0, 255, (8, 9, 3), np.uint8), text))
    statement = next(chunk for chunk in ahead if chunk[0] == b"tEXt")
    bare = [chunk for chunk in ahead if chunk != statement]
    (tmp_path / "behind.png").write_bytes(png_of_chunks([*bare[:-1], statement, bare[-1]]))
    assert find_camera(tmp_path / "behind.png") == camera
    (tmp_path / "other.png").write_bytes(png_of_chunks([*bare[:-1], (b"tEXt", b"Author\0me"), bare[-1]]))
    assert not image_files.has_camera(tmp_path / "other.png")
    # Cut off behind its pixels: nobody knows what it said, and Pillow does not mind.
    (tmp_path / "cut.png").write_bytes(png_of_chunks(bare)[:-12])
    assert not image_files.has_camera(tmp_path / "cut.png")

    def decode(*_: object) -> None:
        raise AssertionError("decoded")

    (tmp_path / "bare.png").write_bytes(png_of_chunks(bare))
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", decode)
    assert not image_files.has_camera(tmp_path / "bare.png")
    with pytest.raises(ValueError, match="no camera"):
        find_camera(tmp_path / "bare.png")
    with pytest.raises(ValueError, match="decoded"):
        find_camera(tmp_path / "behind.png")


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 2), (5, 7, 3), (5, 7, 4)])
def test_eight_bit_png_says_that_it_is_srgb(shape: tuple[int, ...]) -> None:
    """One sRGB chunk ahead of the pixels, which stay as they are; data (depth, masks, ids) are no colours."""
    levels = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    display, data = (encode_png(levels, {"splatpainter": "words"}, data=data) for data in (False, True))
    kinds = [kind for kind, _ in chunks_of(display)]
    assert kinds.count(b"sRGB") == 1 and kinds.index(b"sRGB") < min(kinds.index(b"IDAT"), kinds.index(b"tEXt"))
    assert dict(chunks_of(display))[b"sRGB"] in (b"\0", b"\1", b"\2", b"\3")
    assert [chunk for chunk in chunks_of(display) if chunk[0] != b"sRGB"] == chunks_of(data)
    for png in (display, data):
        with Image.open(io.BytesIO(png)) as image:
            assert np.array_equal(np.asarray(image), levels)


@pytest.mark.parametrize("shape", [(1, 1), (5, 1), (7, 19), (3, 4, 2), (1, 1, 3), (33, 18, 3), (6, 1, 4), (40, 51, 4)])
def test_a_quick_png_holds_its_levels(shape: tuple[int, ...]) -> None:
    levels = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    for pixels in (levels, np.zeros_like(levels), levels[::-1, ::-1]):
        with Image.open(io.BytesIO(quick_png(pixels))) as image:
            assert image.mode == ("L" if levels.ndim == 2 else ("LA", "RGB", "RGBA")[levels.shape[2] - 2])
            assert np.array_equal(np.asarray(image), pixels)


def test_a_quick_png_is_about_as_small_as_pillows_at_its_fastest() -> None:
    rows, columns = np.mgrid[:200, :300].astype(np.float32)
    waves = np.stack([rows / 200, columns / 300, 0.5 + 0.5 * np.sin(rows / 9) * np.cos(columns / 7)], -1)
    pixels = quantized(waves + np.random.default_rng(4).normal(0, 0.01, waves.shape))
    assert len(quick_png(pixels)) < 1.1 * len(encode_png(pixels, level=1))


def test_every_picture_of_colours_says_so(tmp_path: Path) -> None:
    from splatpainter.contact_sheet import write_sheet
    from splatpainter.image_files import bytes_to_png, write_png

    write_png(tmp_path / "a.png", np.zeros((4, 5, 3)))
    write_sheet(tmp_path / "b.png", np.zeros((4, 5, 3), np.uint8))
    for name in ("a.png", "b.png"):
        assert b"sRGB" in dict(chunks_of((tmp_path / name).read_bytes()))
    assert b"sRGB" not in dict(chunks_of(bytes_to_png(b"no colours")))


def test_grey_of_sixteen_bits_needs_no_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "OpenImageIO", None)
    levels = RNG.integers(0, 65536, (5, 6)).astype(np.uint16)
    assert np.array_equal(levels_by_hand(encode_png(levels))[..., 0], levels)
    with pytest.raises(
        ValueError, match=r"16-bit colour PNG needs OpenImageIO; pip install 'splatpainter\[pictures\]'"
    ):
        encode_png(np.zeros((2, 2, 3), np.uint16))
    with pytest.raises(ValueError, match="OpenEXR needs OpenImageIO"):
        encode_exr(np.zeros((2, 2, 3), np.float32), ("R", "G", "B"))


@deep
@pytest.mark.parametrize("channels", [2, 3, 4])
def test_sixteen_bit_png_is_read_with_sixteen_bits(channels: int, tmp_path: Path) -> None:
    levels = RNG.integers(0, 65536, (6, 5, channels)).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(png_by_hand(levels))
    picture = read_picture(tmp_path / "a.png")
    colors = levels[..., :3] if channels > 2 else np.repeat(levels[..., :1], 3, -1)
    assert np.abs(picture.colors * 65535 - colors).max() < 0.01 and picture.notes == ()
    if channels in (2, 4):
        assert picture.alpha is not None and np.abs(picture.alpha * 65535 - levels[..., -1]).max() < 0.01
    else:
        assert picture.alpha is None


def test_without_the_library_eight_bits_are_read_and_a_note_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from splatpainter.pictures import picture_reader

    monkeypatch.setattr(picture_reader, "can_do_deep", lambda: False)
    levels = RNG.integers(0, 65536, (6, 5, 3)).astype(np.uint16)
    (tmp_path / "a.png").write_bytes(png_by_hand(levels))
    picture = read_picture(tmp_path / "a.png")
    assert np.abs(picture.colors - levels / 65535).max() <= 1 / 255
    assert picture.notes == ("read with 8 of its 16 bits; pip install 'splatpainter[pictures]' to read all",)


@deep
def test_sixteen_bit_tiff_and_its_turns(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    levels = RNG.integers(0, 65536, (4, 7, 3)).astype(np.uint16)
    for turn in range(1, 9):
        path = tmp_path / f"{turn}.tif"
        spec = oiio.ImageSpec(7, 4, 3, "uint16")
        spec.attribute("Orientation", turn)
        out = oiio.ImageOutput.create(str(path))
        assert out is not None and out.open(str(path), spec) and out.write_image(levels) and out.close()
        upper = Image.fromarray((levels >> 8).astype(np.uint8))
        names = dict(enumerate("FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE".split(), 2))
        names[8] = "ROTATE_90"
        upright = upper if turn == 1 else upper.transpose(Image.Transpose[names[turn]])
        picture = read_picture(path)
        assert np.array_equal((picture.colors * 65535 + 0.5).astype(np.uint16) >> 8, np.asarray(upright)), turn
        assert len(np.unique(picture.colors)) > 80, "all bits, not the upper eight"


@deep
def test_exr_comes_back_as_display_colours(tmp_path: Path) -> None:
    colors, alpha = RNG.uniform(0, 1, (6, 5, 3)).astype(np.float32), RNG.uniform(0.1, 1, (6, 5, 1)).astype(np.float32)
    light = to_light(colors, "srgb")
    data = encode_exr(np.concatenate([light * alpha, alpha], -1), ("R", "G", "B", "A"), {"splatpainter": "words"})
    (tmp_path / "a.exr").write_bytes(data)
    picture = read_picture(tmp_path / "a.exr")
    assert picture.alpha is not None and np.abs(picture.alpha - alpha[..., 0]).max() < 1e-6
    assert np.abs(picture.colors - colors).max() < 1e-5
    assert exr_text(tmp_path / "a.exr", "splatpainter", 100) == "words"
    assert exr_text(tmp_path / "a.exr", "other", 100) is None
    (tmp_path / "mask.exr").write_bytes(encode_exr((light > 0.5).astype(np.float16)[..., :1], ("Y",)))
    assert np.array_equal(read_mask(tmp_path / "mask.exr"), light[..., 0] > 0.5)


@deep
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.uint32])
def test_exr_is_lossless(kind: type, tmp_path: Path) -> None:
    import OpenImageIO as oiio

    samples = RNG.integers(0, 60000, (5, 4, 1)).astype(kind)
    (tmp_path / "a.exr").write_bytes(encode_exr(samples, ("id",), linear=False))
    source = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert source is not None and source.spec().channelnames == ("id",)
    assert str(source.spec().format) == {"float16": "half", "float32": "float", "uint32": "uint"}[kind.__name__]
    stored = source.read_image("uint" if kind is np.uint32 else "float")
    assert stored is not None and np.array_equal(stored.reshape(5, 4, 1), samples)
    with pytest.raises(ValueError, match="expected channels R, G, B or Y, got id"):
        read_deep(tmp_path / "a.exr", 100)


@deep
def test_the_data_window_of_an_exr_is_put_in_its_place(tmp_path: Path) -> None:
    """Compositors crop pictures to what they hold."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(3, 2, 3, "float")
    spec.x, spec.y = 4, -1  # one line above, six columns of eight in
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 2, 0, 8, 5
    samples = RNG.uniform(0.1, 1, (2, 3, 3)).astype(np.float32)
    out = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert out is not None and out.open(str(tmp_path / "a.exr"), spec) and out.write_image(samples) and out.close()
    values = read_deep(tmp_path / "a.exr", 100).values
    expected = np.zeros((5, 8, 3), np.float32)
    expected[0, 2:5] = samples[1]
    assert np.array_equal(values, expected)


@deep
def test_hostile_files_are_one_line_and_decoded_only_within_bounds(tmp_path: Path) -> None:
    good = encode_exr(RNG.uniform(0, 1, (40, 30, 3)).astype(np.float16), ("R", "G", "B"))
    for k in range(60):
        data = bytearray(good)
        if k % 3 == 0:
            data = data[: RNG.integers(4, len(data))]
        for at in RNG.integers(4, len(data), 1 + k % 5):
            data[at] = RNG.integers(0, 256)
        path = tmp_path / "bad.exr"
        path.write_bytes(bytes(data))
        try:
            assert read_picture(path).colors.size < 3 << 26
        except ValueError as error:
            assert "\n" not in str(error) and str(error).startswith(str(path)) and len(str(error)) < 400
    with pytest.raises(ValueError, match="expected at most 0 megapixels, got 30x40"):
        (tmp_path / "good.exr").write_bytes(good)
        read_deep(tmp_path / "good.exr", 1199)
    wide = bytearray(png_by_hand(np.zeros((2, 2, 3), np.uint16)))
    wide[16:24] = struct.pack(">II", 60_000, 60_000)
    wide[29:33] = struct.pack(">I", zlib.crc32(bytes(wide[12:29])))
    (tmp_path / "wide.png").write_bytes(bytes(wide))
    with pytest.raises(ValueError, match="megapixels"):
        read_picture(tmp_path / "wide.png")
    (tmp_path / "cut.png").write_bytes(png_by_hand(RNG.integers(0, 65536, (9, 9, 3)))[:200])
    with pytest.raises(ValueError, match="cut.png: damaged picture"):
        read_picture(tmp_path / "cut.png")


def test_errors_that_quote_bytes_of_damaged_files_are_text() -> None:
    """OpenImageIO's Python face fails on such errors: they came once in some thousand damaged files."""

    class Damaged:
        def geterror(self) -> str:
            return b"no such channel '\xd9'".decode("utf-8")

    assert image_files.problem_of(Damaged()) == "no such channel '\ufffd'"


@deep
def test_the_camera_travels_in_every_kind_of_file(tmp_path: Path) -> None:
    camera = look_at([0, 0, 3], [0, 0, 0], width=5, height=4)
    text = {"splatpainter": camera.to_json()[:-1] + ', "alpha": "premultiplied"}'}
    (tmp_path / "a.png").write_bytes(encode_png(np.zeros((4, 5, 4), np.uint16), text))
    (tmp_path / "a.exr").write_bytes(encode_exr(np.zeros((4, 5, 4), np.float16), ("R", "G", "B", "A"), text))
    (tmp_path / "b.png").write_bytes(encode_png(np.zeros((4, 5, 4), np.uint8)))
    (tmp_path / "b.json").write_text(text["splatpainter"])
    for name, alpha in (("a.png", "premultiplied"), ("a.exr", "straight"), ("b.png", "premultiplied")):
        assert find_camera(tmp_path / name) == camera and find_alpha(tmp_path / name) == alpha
    (tmp_path / "c.png").write_bytes(encode_png(np.zeros((4, 5, 4), np.uint8)))
    assert find_alpha(tmp_path / "c.png") is None and find_alpha(tmp_path / "none.png") is None


def test_light_and_display_are_inverse_and_light_goes_beyond_white() -> None:
    colors = np.linspace(0, 1, 50, dtype=np.float32)
    assert np.abs(to_display(to_light(colors, "srgb"), "linear") - colors).max() < 1e-6
    assert to_light(np.array([2.0]), "srgb")[0] == pytest.approx(((2 + 0.055) / 1.055) ** 2.4)
    assert to_light(np.array([2.0]), "linear")[0] == 2


def test_two_cameras_in_one_png_are_not_one_of_them(tmp_path: Path) -> None:
    """The last won without a word: pictures that were put together carry both."""
    one, other = (look_at((0, 0, distance), (0, 0, 0), width=9, height=8).to_json() for distance in (3, 4))
    head, *rest = chunks_of(encode_png(RNG.integers(0, 255, (8, 9, 3), np.uint8)))
    path = tmp_path / "a.png"

    def text(words: str) -> tuple[bytes, bytes]:
        return b"tEXt", b"splatpainter\0" + words.encode()

    for chunks in ([head, text(one), text(other), *rest], [head, text(one), *rest[:-1], text(other), rest[-1]]):
        path.write_bytes(png_of_chunks(chunks))
        with pytest.raises(ValueError, match=r"a.png: expected one camera, got 2 cameras that differ .*--camera"):
            find_camera(path)
        (tmp_path / "mine.json").write_text(other)
        assert find_camera(path, tmp_path / "mine.json").to_json() == other
    # The same one twice, however it is packed, says one thing.
    international = b"iTXt", b"splatpainter\0\0\0\0\0" + one.encode()
    packed = b"zTXt", b"splatpainter\0\0" + zlib.compress(one.encode())
    path.write_bytes(png_of_chunks([head, text(one), international, *rest[:-1], packed, text(one), rest[-1]]))
    assert find_camera(path).to_json() == one
