"""What files say of their colours: PNG's chunks in the third edition's order, and profiles of more than 8 bits."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms
from scipy.ndimage import maximum_filter, minimum_filter

from splatpainter.image_files import can_do_deep
from splatpainter.pictures.color_profiles import matrix_profile
from splatpainter.pictures.encodings import edited_in_encoded
from splatpainter.pictures.picture_reader import read_picture

RNG = np.random.default_rng(11)
LEVELS = RNG.integers(20, 236, (10, 12, 3), np.uint8)
STORED = LEVELS / 255
P3_TO_SRGB = np.array([[1.2249401, -0.2249402, 0], [-0.0420569, 1.0420571, 0], [-0.0196376, -0.0786361, 1.0982735]])
"""CSS Color 4's sample code: linear Display P3 to linear sRGB."""
SRGB_CHROMATICITIES = (31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)
P3_CHROMATICITIES = (31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)


def decoded(colors: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, written out."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def encoded(light: np.ndarray) -> np.ndarray:
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def png(path: Path, *parts: tuple[bytes, bytes], deep: bool = False) -> Path:
    """LEVELS as an RGB PNG by hand, with these chunks ahead of the pixels."""
    rows = LEVELS.astype(">u2") * 257 if deep else LEVELS
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", 12, 10, 16 if deep else 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", header), *parts, (b"IDAT", zlib.compress(raw)), (b"IEND", b"")):
        data += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    path.write_bytes(data)
    return path


def gamma(value: int) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", value)


def primaries(*values: int) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *values)


def icc(name: str = "sRGB") -> tuple[bytes, bytes]:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile(name)).tobytes()  # type: ignore[arg-type]
    return b"iCCP", b"any\0\0" + zlib.compress(profile)


P3 = encoded(decoded(STORED) @ P3_TO_SRGB.T)
ADOBE_CHROMATICITIES = (31270, 32900, 64000, 33000, 21000, 71000, 15000, 6000)
ADOBE_TO_SRGB = np.array([[1.3983557, -0.3983557, 0], [0, 1, 0], [0, -0.0429290, 1.0429290]])
"""From Adobe RGB (1998) Color Image Encoding's matrices: linear light to linear sRGB."""
BROKEN = (b"iCCP", b"any\0\0" + zlib.compress(b"no profile at all"))
NOT_PACKED = (b"iCCP", b"any\0\0no zlib stream")
RED_BLUE = (b"cICP", bytes([12, 13, 0, 1]))
EXPECTED = {
    "nothing": ((), STORED),
    "gAMA of sRGB": ((gamma(45455),), STORED),
    "gAMA of sRGB, as rounded elsewhere": ((gamma(45450), primaries(*SRGB_CHROMATICITIES)), STORED),
    "sRGB": (((b"sRGB", b"\0"), gamma(100000)), STORED),
    "linear": ((gamma(100000),), encoded(STORED)),
    "gamma 1.8": ((gamma(55556),), encoded(STORED ** (1 / 0.55556))),
    "P3 by cHRM, with sRGB's gamma": ((gamma(45455), primaries(*P3_CHROMATICITIES)), P3),
    "Adobe RGB by cHRM, whose gamma is close to sRGB's": (
        (gamma(45455), primaries(*ADOBE_CHROMATICITIES)),
        encoded(STORED**2.2 @ ADOBE_TO_SRGB.T),
    ),
    "a profile that is none, before gAMA": ((BROKEN, gamma(100000)), encoded(STORED)),
    "a profile that is not packed, before gAMA and cHRM": (
        (NOT_PACKED, gamma(100000), primaries(*P3_CHROMATICITIES)),
        encoded(STORED @ P3_TO_SRGB.T),
    ),
    "linear P3": (
        (gamma(100000), primaries(*P3_CHROMATICITIES)),
        encoded(STORED @ P3_TO_SRGB.T),
    ),
    "cICP P3": ((RED_BLUE,), P3),
    "cICP ahead of all": ((gamma(100000), (b"sRGB", b"\0"), icc(), RED_BLUE), P3),
    "iCCP ahead of gAMA": ((gamma(100000), icc()), STORED),
    "cICP sRGB ahead of gAMA": ((gamma(100000), (b"cICP", bytes([1, 13, 0, 1]))), STORED),
    "cICP linear": (((b"cICP", bytes([1, 8, 0, 1])),), encoded(STORED)),
}


@pytest.mark.parametrize(("chunks", "expected"), EXPECTED.values(), ids=EXPECTED)
@pytest.mark.parametrize("deep", [False, True])
def test_png_says_its_colours(chunks: tuple, expected: np.ndarray, deep: bool, tmp_path: Path) -> None:
    if deep and not can_do_deep():
        pytest.skip("OpenImageIO is not installed")
    picture = read_picture(png(tmp_path / "a.png", *chunks, deep=deep))
    assert np.abs(picture.colors - expected).max() < 3e-4 + (1e-6 if expected is STORED else 5e-4)
    assert (len(picture.notes) == 0) == (np.abs(expected - STORED).max() < 1e-9)


@pytest.mark.parametrize("name", ["a.jpg", "a.webp"])
@pytest.mark.parametrize(("space", "index"), [(65535, "R03"), (2, None), (65535, None), (1, "R98"), (65535, "R98")])
def test_adobe_rgb_by_exif(name: str, space: int, index: str | None, tmp_path: Path) -> None:
    """As cameras write it: colours of the space, no profile."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = space
    if index is not None:
        exif.get_ifd(0x8769)[0xA005] = {1: index}
    flat = np.full((16, 16, 3), (150, 160, 120), np.uint8)
    options = {"a.jpg": {"quality": 98}, "a.webp": {"lossless": True}}.get(name, {})
    Image.fromarray(flat).save(tmp_path / name, exif=exif, **options)
    picture = read_picture(tmp_path / name)
    adobe = space == 2 or index == "R03"
    expected = encoded((flat / 255) ** (563 / 256) @ ADOBE_TO_SRGB.T) if adobe else flat / 255
    assert np.abs(picture.colors - expected).max() < 0.01
    assert [note for note in picture.notes if "Adobe RGB" in note] == list(picture.notes) and len(
        picture.notes
    ) == adobe


@pytest.mark.parametrize("bits", [8, 16])
def test_limited_range(bits: int, tmp_path: Path) -> None:
    """H.273, 8.3: black at 16 and white at 235, times 256 in 16 bits."""
    if bits == 16 and not can_do_deep():
        pytest.skip("OpenImageIO is not installed")
    picture = read_picture(png(tmp_path / "a.png", (b"cICP", bytes([1, 13, 0, 0])), deep=bits == 16))
    step = 1 << (bits - 8)
    expected = np.clip(((2**bits - 1) * STORED - 16 * step) / (219 * step), 0, 1)
    assert np.abs(picture.colors - expected).max() < 1e-5


@pytest.mark.parametrize(
    ("chunk", "note"),
    [
        ((b"cICP", bytes([12, 200, 0, 1])), "cICP chunk (12/200/0/1) says colours that are not read here"),
        ((b"cICP", bytes([77, 13, 0, 1])), "cICP chunk (77/13/0/1) says colours that are not read here"),
        ((b"cICP", bytes([1, 13, 5, 1])), "cICP chunk (1/13/5/1) says colours that are not read here"),
        ((b"cICP", b"\1"), "cICP chunk is damaged"),
        ((b"gAMA", b"\0\0\0\0"), "gAMA chunk makes no sense"),
        ((b"gAMA", b"\0"), "gAMA chunk makes no sense"),
        ((b"cHRM", bytes(32)), "cHRM chunk makes no sense"),
        ((b"cHRM", struct.pack(">8I", *[33333] * 8)), "cHRM chunk makes no sense"),
    ],
)
def test_what_makes_no_sense_is_noted(chunk: tuple[bytes, bytes], note: str, tmp_path: Path) -> None:
    try:
        picture = read_picture(png(tmp_path / "a.png", chunk))
    except ValueError as error:  # Pillow refuses some of them before
        assert str(error).startswith(str(tmp_path / "a.png")) and "\n" not in str(error)
        return
    assert len(picture.notes) == 1 and note in picture.notes[0]
    assert np.array_equal(np.round(picture.colors * 255), LEVELS)


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_light_beyond_white_is_refused(transfer: int, name: str, tmp_path: Path) -> None:
    path = png(tmp_path / "a.png", (b"cICP", bytes([9, transfer, 0, 1])))
    with pytest.raises(ValueError, match=f"a.png: its cICP chunk says {name}, light beyond white; expected sRGB"):
        read_picture(path)


def test_an_unknown_cicp_leaves_the_next_statement(tmp_path: Path) -> None:
    picture = read_picture(png(tmp_path / "a.png", (b"cICP", bytes([12, 200, 0, 1])), gamma(100000)))
    assert np.abs(picture.colors - encoded(STORED)).max() < 1e-3 and len(picture.notes) == 2


def test_profiles_of_a_matrix_agree_with_littlecms() -> None:
    """Pillow's own profiles, by Pillow's colour management, to its 8 bits."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    statement = matrix_profile(profile.tobytes())
    assert statement is not None and statement.is_srgb
    assert np.abs(statement.to_srgb(STORED) - STORED).max() < 2e-3
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    for damaged in (lab, b"", b"RGB " * 40, profile.tobytes()[:300]):
        assert matrix_profile(damaged) is None


@pytest.mark.skipif(not can_do_deep(), reason="OpenImageIO is not installed")
def test_a_deep_picture_keeps_its_bits_through_a_profile(tmp_path: Path) -> None:
    """A linear profile written by hand: 16-bit darks would be lost in 8 bits."""
    from tests.test_sources import icc as linear_profile

    path = png(tmp_path / "a.png", (b"iCCP", b"any\0\0" + zlib.compress(linear_profile())), deep=True)
    picture = read_picture(path)
    assert np.abs(picture.colors - encoded(STORED)).max() < 1e-3 and "hand-made" in picture.notes[0]
    with Image.open(path) as image:
        assert image.info["icc_profile"] == linear_profile()


def float_tiff(values: np.ndarray, profile: bytes = b"") -> bytes:
    """An RGB TIFF of 32-bit floats, uncompressed, by hand."""
    height, width = values.shape[:2]
    entries = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 3, None),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, None),
        (277, 3, 1, 3),
        (278, 4, 1, height),
        (279, 4, 1, values.size * 4),
        (339, 3, 3, None),
    ]
    if profile:
        entries.append((34675, 7, len(profile), None))
    table = 8 + 2 + 12 * len(entries) + 4
    bits, kinds, pixels = table, table + 6, table + 12 + len(profile)
    offsets = {258: bits, 339: kinds, 273: pixels, 34675: table + 12}
    body = b"".join(struct.pack("<HHII", tag, kind, n, offsets.get(tag, v)) for tag, kind, n, v in entries)
    tail = struct.pack("<6H", 32, 32, 32, 3, 3, 3) + profile + values.astype("<f4").tobytes()
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4) + tail


@pytest.mark.skipif(not can_do_deep(), reason="OpenImageIO is not installed")
def test_tiff_of_floats(tmp_path: Path) -> None:
    from tests.test_sources import icc as linear_profile

    values, path = RNG.uniform(0, 1.2, (6, 5, 3)), tmp_path / "a.tif"
    path.write_bytes(float_tiff(values))
    plain = read_picture(path)
    assert np.allclose(plain.colors, np.clip(values, 0, 1), atol=1e-6)
    assert len(plain.notes) == 1 and "without a colour profile" in plain.notes[0]
    path.write_bytes(float_tiff(values, linear_profile()))
    assert np.abs(read_picture(path).colors - encoded(values)).max() < 1e-3


@pytest.mark.parametrize("kind", ["PNG", "palette", "JPEG"])
def test_rounding_in_wide_colours_is_no_paint(kind: str, tmp_path: Path) -> None:
    """Saturated colours that were rounded to 8 bits as Adobe RGB come back up to ten levels of sRGB away: the same is
    made of the render, and what was painted is told from it."""
    rng = np.random.default_rng(4)
    sent = np.repeat(np.repeat(rng.integers(0, 256, (6, 8, 3), np.uint8), 16, 0), 16, 1)
    sent[..., 0] //= 8
    render = np.clip((sent + rng.uniform(-0.49, 0.49, sent.shape)) / 255, 0, 1)
    exponent = 563 / 256 if kind == "JPEG" else 2.2
    painted = sent.copy()
    painted[30:60, 40:80] = (230, 120, 40)
    for colors in (sent, painted):
        light = decoded(colors / 255) @ np.linalg.inv(ADOBE_TO_SRGB).T
        stored = Image.fromarray(np.round(255 * np.clip(light, 0, 1) ** (1 / exponent)).astype(np.uint8))
        path = tmp_path / ("a.jpg" if kind == "JPEG" else "a.png")
        if kind == "JPEG":
            exif = Image.Exif()
            exif.get_ifd(0x8769)[0xA001] = 2
            stored.save(path, quality=90, subsampling=0, exif=exif)
        else:
            (stored.quantize(256, dither=Image.Dither.NONE) if kind == "palette" else stored).save(path)
            data = path.read_bytes()
            for name, body in (gamma(45455), primaries(*ADOBE_CHROMATICITIES)):
                part = struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
                data = data[:33] + part + data[33:]
            path.write_bytes(data)
        picture = read_picture(path)
        assert picture.encoding is not None and np.abs(picture.colors - colors / 255).max() > 5 / 255
        mask = edited_in_encoded(picture.colors, render, np.ones(sent.shape[:2]), picture.encoding)
        assert mask is not None
        truth = (painted != sent).any(-1) & (colors is painted)
        assert not mask[
            ~np.asarray(maximum_filter(truth, 33 if kind == "JPEG" else 5), bool)
        ].any()  # blocks of JPEG ring
        assert mask[np.asarray(minimum_filter(truth, 5), bool)].all()
