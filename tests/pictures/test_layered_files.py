"""The flattened picture of PSD, OpenRaster and Krita files; what is no picture here is named."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.pictures.foreign_pictures import READ_KINDS
from splatpainter.pictures.picture_reader import declared_size, read_picture
from tests.test_sources import icc, srgb_coded

RNG = np.random.default_rng(2)
LEVELS = RNG.integers(0, 256, (9, 13, 3), np.uint8)
LEVELS[3:6] = LEVELS[3, :1]  # runs, for PackBits


def packed(row: bytes) -> bytes:
    """PackBits: runs of three and more, and all between them as it is."""
    out, at, plain = b"", 0, b""

    def flushed() -> bytes:
        return b"".join(bytes([len(plain[k : k + 128]) - 1]) + plain[k : k + 128] for k in range(0, len(plain), 128))

    while at < len(row):
        run = 1
        while at + run < len(row) and run < 128 and row[at + run] == row[at]:
            run += 1
        if run > 2:
            out, plain = out + flushed() + bytes([257 - run, row[at]]), b""
        else:
            plain += row[at : at + run]
        at += run
    return out + flushed()


def psd(
    planes: list[np.ndarray],
    *,
    rle: bool = True,
    layers: int | None = None,
    large: bool = False,
    profile: bytes = b"",
    composite: bool = True,
    mode: int = 3,
    kind: int | None = None,
    channel: bytes = b"",
) -> bytes:
    """A PSD or PSB by hand. planes: [H, W] uint8 or uint16; layers: the number that its layer section says."""
    height, width = planes[0].shape
    bits = 8 * planes[0].dtype.itemsize
    version = 2 if large else 1
    out = b"8BPS" + struct.pack(">H6xHIIHH", version, len(planes), height, width, bits, mode) + bytes(4)
    resources = b"8BIM" + struct.pack(">H", 1057) + b"\0\0" + struct.pack(">IIB", 5, 1, composite) + b"\0"
    if profile:
        resources += b"8BIM" + struct.pack(">H", 1039) + b"\3abc" + struct.pack(">I", len(profile)) + profile
        resources += bytes(len(profile) % 2)
    if channel:  # its name, with its length before it
        name = bytes([len(channel)]) + channel
        resources += b"8BIM" + struct.pack(">H", 1006) + b"\0\0" + struct.pack(">I", len(name)) + name
        resources += bytes(len(name) % 2)
    out += struct.pack(">I", len(resources)) + resources
    length = ">Q" if large else ">I"
    section = b"" if layers is None else struct.pack(length, 2) + struct.pack(">h", layers)
    out += struct.pack(length, len(section)) + section
    rows = [row.astype(f">u{bits // 8}").tobytes() for plane in planes for row in plane]
    if not rle:
        return out + struct.pack(">H", 0 if kind is None else kind) + b"".join(rows)
    rows = [packed(row) for row in rows]
    table = b"".join(struct.pack(">I" if large else ">H", len(row)) for row in rows)
    return out + struct.pack(">H", 1 if kind is None else kind) + table + b"".join(rows)


def planes_of(levels: np.ndarray, *more: np.ndarray) -> list[np.ndarray]:
    return [*np.moveaxis(levels, -1, 0), *more]


@pytest.mark.parametrize("rle", [False, True])
@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_psd_is_its_composite(rle: bool, large: bool, bits: int, tmp_path: Path) -> None:
    levels = LEVELS if bits == 8 else LEVELS.astype(np.uint16) * 257 + 3
    path = tmp_path / "a.psd"
    path.write_bytes(psd(planes_of(levels), rle=rle, large=large))
    picture = read_picture(path)
    assert picture.alpha is None and picture.notes == () and declared_size(path) == (13, 9)
    assert np.abs(picture.colors - levels / (2**bits - 1)).max() < 1e-6
    if bits == 8 and not large:  # another reader
        with Image.open(path, formats=("PSD",)) as image:
            assert np.array_equal(np.asarray(image.convert("RGB")), LEVELS)


def test_the_alpha_of_a_psd_is_taken_off_white(tmp_path: Path) -> None:
    alpha = np.full((9, 13), 255, np.uint8)
    alpha[:, :6], alpha[:, 6:8] = 0, 128
    share = alpha[..., None] / 255
    on_white = np.round(LEVELS * share + 255 * (1 - share)).astype(np.uint8)
    path = tmp_path / "a.psd"
    path.write_bytes(psd(planes_of(on_white, alpha), layers=-2))
    picture = read_picture(path)
    assert picture.alpha is not None and np.allclose(picture.alpha, alpha / 255)
    assert np.abs(picture.colors - LEVELS / 255)[alpha > 0].max() < 1.01 / 255 * 2
    path.write_bytes(psd(planes_of(LEVELS, alpha), layers=2))
    assert read_picture(path).alpha is None, "a saved selection is no transparency"
    # Without layers: Photoshop names a selection, and other programs write four channels alone.
    for channel, is_there in ((b"Alpha 1", False), (b"Text", False), (b"Transparency", True), (b"", True)):
        path.write_bytes(psd(planes_of(on_white, alpha), channel=channel))
        assert (read_picture(path).alpha is not None) is is_there, channel


def test_grey_and_profiles(tmp_path: Path) -> None:
    path = tmp_path / "a.psd"
    path.write_bytes(psd([LEVELS[..., 0]], mode=1))
    assert np.array_equal(np.round(read_picture(path).colors * 255), np.repeat(LEVELS[..., :1], 3, -1))
    path.write_bytes(psd(planes_of(LEVELS), profile=icc()))
    linear = read_picture(path)
    assert np.abs(linear.colors - srgb_coded(LEVELS / 255)).max() < 1e-3 and "to sRGB" in linear.notes[0]


def psd_by_zip(levels: np.ndarray, predicted: bool, height: int = 0) -> bytes:
    """A PSD whose composite is one zlib stream (Adobe's compression 2; 3: by differences along rows)."""
    planes = np.stack(planes_of(levels))
    if predicted:
        planes = np.diff(planes, axis=2, prepend=np.zeros((*planes.shape[:2], 1), planes.dtype))
    raw = psd([np.zeros((height or levels.shape[0], levels.shape[1]), levels.dtype)] * 3, rle=False, kind=2 + predicted)
    head = raw[: raw.rindex(struct.pack(">H", 2 + predicted)) + 2]
    return head + zlib.compress(planes.astype(planes.dtype.newbyteorder(">")).tobytes())


@pytest.mark.parametrize("predicted", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_composite_packed_by_zip_is_read(predicted: bool, bits: int, tmp_path: Path) -> None:
    levels = LEVELS if bits == 8 else LEVELS.astype(np.uint16) * 257 + 3
    (tmp_path / "a.psd").write_bytes(psd_by_zip(levels, predicted))
    assert np.abs(read_picture(tmp_path / "a.psd").colors - levels / (2**bits - 1)).max() < 1e-6


GOOD = psd(planes_of(LEVELS))
REFUSED = {
    "cut in its header": (GOOD[:20], "its header is cut off"),
    "cut in its sections": (GOOD[:40], "a section lies beyond its end"),
    "cut in its rows": (GOOD[:-5], "cut off"),
    "raw, cut": (psd(planes_of(LEVELS), rle=False)[:-1], "has 350 bytes of 351"),
    "of a version": (GOOD[:4] + b"\0\7" + GOOD[6:], "version 1 or 2, got 7"),
    "huge": (GOOD[:14] + struct.pack(">II", 300000, 300000) + GOOD[22:], "megapixels, got 300000x300000"),
    "wide beyond its rows": (GOOD[:14] + struct.pack(">II", 9, 60000) + GOOD[22:], "too short for 60000 pixels"),
    "CMYK": (psd(planes_of(LEVELS, LEVELS[..., 0]), mode=4), "expected RGB colours, got CMYK; save it as RGB"),
    "of 32 bits": (GOOD[:22] + b"\0\x20" + GOOD[24:], "8 or 16 bits, got 32"),
    "without its composite": (psd(planes_of(LEVELS), composite=False), "maximum compatibility"),
    "packed by nothing known": (psd(planes_of(LEVELS), kind=4), "packed by method 4"),
    "of no zlib": (psd(planes_of(LEVELS), kind=2), "its flattened picture: Error -3"),
    "of too little zlib": (psd_by_zip(LEVELS[:-1], False, LEVELS.shape[0]), "bytes of 351"),
    "of empty rows": (psd(planes_of(LEVELS), rle=False, kind=1)[:-300] + bytes(300), "damaged PSD"),
}


@pytest.mark.parametrize(("data", "words"), REFUSED.values(), ids=REFUSED)
def test_a_damaged_psd_is_one_line(data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.psd"
    path.write_bytes(data)
    with pytest.raises(ValueError) as refusal:
        read_picture(path)
    assert type(refusal.value) is ValueError and str(refusal.value).startswith(f"{path}: ")
    assert words in str(refusal.value) and str(refusal.value).isprintable()


def zipped(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name.replace("_", "."), data)
    return path


def merged(levels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(levels).save(file, "PNG")
    return file.getvalue()


@pytest.mark.parametrize("name", ["a.ora", "a.kra"])
def test_openraster_and_krita_are_their_merged_picture(name: str, tmp_path: Path) -> None:
    alpha = RNG.integers(0, 256, (9, 13, 1), np.uint8)
    layered = np.concatenate([LEVELS, alpha], -1)
    path = zipped(tmp_path / name, mimetype=b"image/openraster", mergedimage_png=merged(layered))
    picture = read_picture(path)
    assert picture.alpha is not None and np.array_equal(np.round(picture.alpha * 255), alpha[..., 0])
    assert np.array_equal(np.round(picture.colors * 255), LEVELS) and declared_size(path) == (13, 9)


def test_a_zip_without_a_picture_or_with_a_damaged_one_is_one_line(tmp_path: Path) -> None:
    bomb = merged(LEVELS)[:60]
    for path, words in (
        (zipped(tmp_path / "a.zip", readme_txt=b"no"), "with mergedimage.png in it; export it as PNG"),
        (zipped(tmp_path / "b.ora", mergedimage_png=b"no picture"), "expected a PNG"),
        (zipped(tmp_path / "c.ora", mergedimage_png=bomb), "damaged picture"),
    ):
        with pytest.raises(ValueError) as refusal:
            read_picture(path)
        assert str(refusal.value).startswith(f"{path}: ") and words in str(refusal.value)
    (tmp_path / "d.kra").write_bytes(b"PK\3\4 and no directory")
    with pytest.raises(ValueError, match=r"d\.kra: damaged zip"):
        read_picture(tmp_path / "d.kra")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"gimp xcf v011\0" + bytes(40), "a file of GIMP's layers (XCF); export it as PNG"),
        (b"GIF89a" + bytes(40), "a GIF; export it as PNG"),
        (b"\0\0\0\x18ftypheic" + bytes(40), "a HEIC picture; export it as PNG"),
        (b"\0\0\0\x18ftypavif" + bytes(40), "an AVIF picture; export it as PNG"),
        (b"something else" + bytes(40), "another kind of file; export it as PNG"),
        (b"\n  <!DOCTYPE html><html>log in</html>", "a web page; download the picture itself"),
        (b"\xef\xbb\xbf<!doctype HTML><html>", "a web page; download the picture itself"),
        (b"\xff\xd8\xff\xf7" + bytes(40), "a JPEG-LS picture; export it as PNG"),
        (b"#?RGBE\n" + bytes(40), "a Radiance HDR picture; export it as PNG"),
        (b"\x01\xda\x01\x01" + bytes(40), "an SGI picture; export it as PNG"),
        (b'<?xml version="1.0"?><svg/>', "an XML or SVG file; export it as PNG"),
        (b"II*\0\x10\0\0\0CR\2\0" + bytes(40), "a raw photograph; develop it, and export that as PNG"),
        (b"qoif" + bytes(40), "a QOI picture; export it as PNG"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:0",
            "a pointer of Git LFS; git lfs pull fetches what it stands for",
        ),
    ],
)
def test_what_is_not_read_is_named(data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    with pytest.raises(ValueError) as refusal:
        read_picture(path)
    assert str(refusal.value) == f"{path}: expected a {READ_KINDS} picture, got {words}"


def test_an_empty_picture_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.png: is empty \(0 bytes\); expected a picture: save it again"):
        read_picture(path)
