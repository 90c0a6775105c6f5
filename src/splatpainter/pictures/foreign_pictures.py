"""Files that picture programs save and nobody here reads: what each is, and what to do with it, in one line.

Told by their first bytes; TGA, which has no mark there, by a header that makes sense. Nothing is decoded.
"""

from __future__ import annotations

import struct
from pathlib import Path

from splatpainter.image_files import PAGES
from splatpainter.pictures.layered_files import first_bytes
from splatpainter.pictures.whole_files import CODES, TIFF_MAGICS, first_page

READ_KINDS = "PNG, JPEG, WebP, TIFF, OpenEXR, Radiance, PSD, PSB, OpenRaster or Krita"
"""What is read, as messages say it."""
RAW, FILM, WEB_PAGE, LFS_POINTER = "a raw photograph", "a film", "a web page", "a pointer of Git LFS"
ADVICE = {
    RAW: "develop it, and export that as PNG",
    FILM: "export one of its frames as PNG",
    WEB_PAGE: "download the picture itself",
    LFS_POINTER: "git lfs pull fetches what it stands for",
}
"""What to do, where that is not to export it as PNG."""
FOREIGN = {
    b"gimp xcf": "a file of GIMP's layers (XCF)",
    b"GIF8": "a GIF",
    b"BM": "a BMP",
    b"\x00\x00\x01\x00": "an icon",
    b"\xff\x0a": "a JPEG XL picture",
    b"\x00\x00\x00\x0cJXL ": "a JPEG XL picture",
    b"%PDF": "a PDF",
    b"CSFCHUNK": "a Clip Studio file",
    b"PDN3": "a Paint.NET file",
    b"\x00\xffKA": "an Affinity document",
    b"\x00\x00\x00\x0cjP  ": "a JPEG 2000 picture",
    b"\xff\x4f\xff\x51": "a JPEG 2000 picture",
    b"P6": "a PPM picture",
    b"\x0a\x05\x01": "a PCX picture",
    b"DDS ": "a DDS texture",
    b"\xabKTX ": "a KTX texture",
    b"qoif": "a QOI picture",
    b"#?RGBE": "a Radiance HDR picture",
    b"PF\n": "a PFM picture",
    b"Pf\n": "a PFM picture",
    b"P5": "a PGM picture",
    b"P7": "a PAM picture",
    b"\x01\xda": "an SGI picture",
    b"P3": "a PPM picture",
    b"P2": "a PGM picture",
    b"SAI-CANVAS": "a PaintTool SAI file",
    b"mdipack": "a MediBang or FireAlpaca file",
    b"BLENDER": "a Blender file",
    b"\x1aE\xdf\xa3": FILM,
    b"FLV\x01": FILM,
    b"II\xbc": "a JPEG XR picture",
    b"\xff\xd8\xff\xf7": "a JPEG-LS picture",
    b"%!PS": "a PostScript file",
    b"<svg": "an SVG drawing",
    b"<?xml": "an XML or SVG file",
    b"<!doctype": WEB_PAGE,
    b"<html": WEB_PAGE,
    b"version https://git-lfs": LFS_POINTER,
    b"II*\x00\x10\x00\x00\x00CR": RAW,
    b"FUJIFILMCCD-RAW": RAW,
    b"II\x1a\0\0\0HEAPCCDR": RAW,
    b"IIRO": RAW,
    b"IIRS": RAW,
    b"IIU\0": RAW,
    b"\x46OVb": RAW,
    b"\0MRM": RAW,
    # Of a kind that is read, in a form that is not: these come last.
    b"\xff\xd8\xff": "a JPEG of a kind that is not read (12 bits, lossless, or damaged)",
    b"\x89PNG": "a damaged PNG",
    b"II*\0": "a TIFF that is packed, or has numbers, in a way that is not read",
    b"MM\0*": "a TIFF that is packed, or has numbers, in a way that is not read",
    b"II+\0": "a TIFF that is packed, or has numbers, in a way that is not read",
    b"MM\0+": "a TIFF that is packed, or has numbers, in a way that is not read",
}
"""First bytes of files that picture programs save and nobody reads here; of texts in any capitals."""
BRANDS = {
    b"heic": "a HEIC picture",
    b"heix": "a HEIC picture",
    b"heim": "a HEIC picture",
    b"heis": "a HEIC picture",
    b"hevc": "a HEIC picture",
    b"hevx": "a HEIC picture",
    b"mif1": "a HEIC picture",
    b"msf1": "a HEIC picture",
    b"avif": "an AVIF picture",
    b"avis": "an AVIF picture",
    b"crx ": RAW,
}
"""Brands of ISO base media files; all others are films."""
MAX_BRANDS_BYTES = 64
"""First bytes of such a file that are looked at for AVIF's brand, which need not come first."""
TGA_FOOTER = b"TRUEVISION-XFILE.\0"
TGA_SUFFIXES = (".tga", ".targa", ".vda", ".icb", ".vst")
TGA_KINDS, TGA_BITS = (1, 2, 3, 9, 10, 11), (8, 15, 16, 24, 32)
"""Colours by a palette, as they are or grey, plain and packed; bits of a pixel."""
COLOR_FILTERS = (32803, 34892)
"""TIFF photometric: one colour a pixel, as sensors have it, and linear light of one (DNG)."""
DNG_VERSION, PARTS = 50706, 330
"""TIFF tags: that it is a DNG; pages within its first one."""


def refusal(path: Path, name: str = "") -> str:
    """What was expected, what came and what to do, of a file that is not read. name: what its owner called it; "": as
    `path` says."""
    kind = foreign_kind(path, name)
    return f"expected a {READ_KINDS} picture, got {kind or 'another kind of file'}; {advice_for(kind)}"


def advice_for(kind: str | None) -> str:
    """What to do with a file of a kind that is not read."""
    return ADVICE.get(kind or "", "export it as PNG")


def foreign_kind(path: Path, name: str = "") -> str | None:
    """What a file is that is exported as PNG before it is used: "a GIF"; None of others. name: as of `refusal`."""
    head = first_bytes(path, MAX_BRANDS_BYTES)
    if head[4:8] == b"ftyp":
        return BRANDS[b"avif"] if b"avif" in head else BRANDS.get(head[8:12], FILM)
    if is_raw_tiff(path):
        return RAW
    # Texts may begin with a mark of UTF-8 or white space, tags in any capitals.
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    heads = (head, text, text.lower())
    words = next((words for magic, words in FOREIGN.items() if any(one.startswith(magic) for one in heads)), None)
    return words or ("a TGA picture" if _is_tga(path, head, name or path.name) else None)


def is_raw_tiff(path: Path) -> bool:
    """Whether a TIFF is a raw photograph (DNG, NEF, ARW): its first page may be a small preview, which is no
    picture to paint on."""
    if first_bytes(path, 4) not in TIFF_MAGICS:
        return False
    try:
        with open(path, "rb") as file:
            tags = first_page(file, file.seek(0, 2), path)
    except (OSError, ValueError):  # which the reader says
        return False
    (photometric, *_), (subfile, *_) = (tags.get(tag) or (0,) for tag in (CODES.photometric, PAGES.subfile))
    is_preview = bool(subfile & PAGES.reduced) and PARTS in tags
    return DNG_VERSION in tags or photometric in COLOR_FILTERS or is_preview


def _is_tga(path: Path, head: bytes, name: str) -> bool:
    """Whether it has TGA's footer, or its ending and a header that makes sense."""
    if len(head) < 18:
        return False
    with open(path, "rb") as file:
        file.seek(max(file.seek(0, 2) - len(TGA_FOOTER), 0))
        if file.read() == TGA_FOOTER:
            return True
    _, palette, kind, _, _, _, _, _, width, height, bits, _ = struct.unpack("<BBBHHBHHHHBB", head[:18])
    makes_sense = palette <= 1 and kind in TGA_KINDS and bits in TGA_BITS and width > 0 and height > 0
    return makes_sense and name.lower().endswith(TGA_SUFFIXES)
