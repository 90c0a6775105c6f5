"""Files that picture programs save and that are not read here: each by its name, with what to do."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.pictures.foreign_pictures import READ_KINDS, foreign_kind
from splatpainter.pictures.picture_reader import PICTURE_SUFFIXES, declared_size, read_picture
from splatpainter.server.uploads.upload_sniffing import sniff

PICTURE = Image.fromarray((np.random.default_rng(0).uniform(size=(20, 30, 3)) * 255).astype(np.uint8))


def saved(kind: str, mode: str = "RGB", **settings: object) -> bytes:
    file = io.BytesIO()
    PICTURE.convert(mode).save(file, kind, **settings)
    return file.getvalue()


def tiff(*entries: tuple[int, int, int, int], order: str = "<") -> bytes:
    """A page of these tags: (tag, type, count, value)."""
    mark = b"II*\0" if order == "<" else b"MM\0*"
    tags = b"".join(struct.pack(order + "HHII", *entry) for entry in entries)
    return mark + struct.pack(order + "IH", 8, len(entries)) + tags + bytes(400)


SIZE = ((256, 4, 1, 16), (257, 4, 1, 16))
STRIP = ((273, 4, 1, 300), (278, 4, 1, 16), (279, 4, 1, 100))
TGA, RAW, FILM = "a TGA picture", "a raw photograph", "a film"
FILES = {
    "a.tga": (saved("TGA"), TGA),
    "packed.tga": (saved("TGA", compression="tga_rle"), TGA),
    "alpha.tga": (saved("TGA", "RGBA"), TGA),
    "grey.tga": (saved("TGA", "L"), TGA),
    "palette.tga": (saved("TGA", "P"), TGA),
    "without_footer.tga": (saved("TGA")[:-26], TGA),
    "footer.bin": (saved("TGA"), TGA),
    "a.bmp": (saved("BMP"), "a BMP"),
    "a.dng": (tiff((254, 4, 1, 1), *SIZE, *STRIP, (50706, 1, 4, 0x401)), RAW),
    "sensor.tif": (tiff((254, 4, 1, 0), *SIZE, (262, 3, 1, 32803), *STRIP), RAW),
    "preview.nef": (tiff((254, 4, 1, 1), *SIZE, (262, 3, 1, 2), *STRIP, (330, 4, 1, 300)), RAW),
    "a.orf": (b"IIRO\x08\0\0\0" + bytes(90), RAW),
    "a.cr3": (b"\0\0\0\x18ftypcrx \0\0\0\1crx isom" + bytes(90), RAW),
    "a.heif": (b"\0\0\0\x18ftypmsf1\0\0\0\0msf1hevc" + bytes(90), "a HEIC picture"),
    "a.avif": (b"\0\0\0\x1cftypmif1\0\0\0\0mif1avifmiaf" + bytes(90), "an AVIF picture"),
    "a.mov": (b"\0\0\0\x14ftypqt  \0\0\0\0qt  " + bytes(90), FILM),
    "a.webm": (b"\x1aE\xdf\xa3" + bytes(90), FILM),
    "a.sai2": (b"SAI-CANVAS-TYPE0" + bytes(90), "a PaintTool SAI file"),
}


@pytest.mark.parametrize("name", FILES)
def test_what_artists_may_try_is_named(name: str, tmp_path: Path) -> None:
    data, kind = FILES[name]
    path = tmp_path / name
    path.write_bytes(data)
    advice = {RAW: "develop it, and export that as PNG", FILM: "export one of its frames as PNG"}
    expected = f"{path}: expected a {READ_KINDS} picture, got {kind}; {advice.get(kind, 'export it as PNG')}"
    with pytest.raises(ValueError) as refusal:
        read_picture(path)
    assert str(refusal.value) == expected
    if data[:2] in (b"II", b"MM") and kind == RAW:  # of no other shape than its view: it is no picture of one
        with pytest.raises(ValueError, match="got a raw photograph"):
            declared_size(path)


def test_the_studio_says_so_by_the_name_that_a_file_had(tmp_path: Path) -> None:
    path = tmp_path / "upload"
    path.write_bytes(saved("TGA")[:-26])
    with pytest.raises(ValueError) as refusal:
        sniff(path, "leaf.tga", 1000)
    assert str(refusal.value).startswith("leaf.tga: expected a picture (")
    assert str(refusal.value).endswith(", got a TGA picture; export it as PNG")
    with pytest.raises(ValueError, match="a splat file or a project$"):
        sniff(path, "leaf", 1000)


def test_what_is_no_tga_is_not_called_one(tmp_path: Path) -> None:
    for name, data in (("a.tga", bytes(60)), ("b.tga", b"something else" * 4), ("c.tga", b"\0")):
        (tmp_path / name).write_bytes(data)
        assert foreign_kind(tmp_path / name) is None


@pytest.mark.parametrize("settings", [{}, {"compression": "tiff_lzw"}, {"compression": "jpeg"}])
def test_a_plain_tiff_is_no_raw_photograph(settings: dict, tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(saved("TIFF", **settings))
    assert read_picture(tmp_path / "a.tif").size == PICTURE.size


def test_the_words_name_every_kind_that_is_read() -> None:
    kinds = {".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".exr": "OpenEXR", ".hdr": "Radiance"}
    kinds |= {".ora": "OpenRaster", ".kra": "Krita", ".webp": "WebP"}
    for suffix in PICTURE_SUFFIXES:
        assert kinds.get(suffix, suffix[1:].upper()) in READ_KINDS
