"""Files that are no splats, whatever their name says: web pages, git-LFS pointers, films, pictures, archives.

Known by their first bytes. The formats with a magic of their own are told apart before (`io.detect`); of the two
without one (.splat, .ksplat) no honest file begins so: its first twelve bytes are a position.
"""

from __future__ import annotations

import string
import zlib
from pathlib import Path

HEAD_BYTES = 512
"""Bytes that are looked at."""
DOWNLOAD = "download the file itself (on GitHub and Hugging Face: raw, or download)"
SPLATS = "expected Gaussian splats"
_MAGIC: tuple[tuple[int, bytes, str, str], ...] = (
    (0, b"version https://git-lfs", "a git-LFS pointer", "run `git lfs pull` in its folder to get the file itself"),
    (4, b"ftypheic", "a picture (HEIC)", SPLATS),
    (4, b"ftypavif", "a picture (AVIF)", SPLATS),
    (4, b"ftyp", "a film (MP4, MOV)", "render frames of it and train an asset from them"),
    (0, b"\x1a\x45\xdf\xa3", "a film (WebM, Matroska)", "render frames of it and train an asset from them"),
    (0, b"\x89PNG\r\n", "a picture (PNG)", SPLATS),
    (0, b"\xff\xd8\xff", "a picture (JPEG)", SPLATS),
    (0, b"GIF8", "a picture (GIF)", SPLATS),
    (0, b"%PDF-", "a PDF", SPLATS),
    (0, b"\x28\xb5\x2f\xfd", "packed by zstd", "unpack it first"),
    (0, b"\xfd7zXZ\0", "packed by xz", "unpack it first"),
    (0, b"BZh", "packed by bzip2", "unpack it first"),
    (0, b"\x76\x2f\x31\x01", "a picture (OpenEXR)", SPLATS),
    (0, b"BLENDER", "a scene of Blender", "export its splats as .ply"),
    (0, b"Kaydara FBX", "a scene (FBX)", SPLATS),
    (0, b"\x93NUMPY", "an array of numpy", "save it as .ply (sp.write)"),
    (0, b"LASF", "a point cloud (LAS, LAZ)", "train Gaussians from pictures of it"),
    (0, b"ASTM-E57", "a point cloud (E57)", "train Gaussians from pictures of it"),
    (0, b"PXR-USDC", "a USD scene", "save its splats as .ply or .spz"),
    (0, b"SQLite format 3\x00", "a database (a .splatproj project?)", "open projects with `splatpainter studio`"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7z archive", "unpack it first"),
    (0, b"Rar!\x1a\x07", "a RAR archive", "unpack it first"),
    (8, b"WEBP", "a picture (WebP)", SPLATS),
    (8, b"AVI ", "a film (AVI)", "render frames of it and train an asset from them"),
    (257, b"ustar", "a tar archive", "unpack it first"),
)
"""(offset, bytes there, what it is, what to do)."""
GZIP = b"\x1f\x8b"
COPY_AGAIN = "its download or copy was not finished, or the disk was full: get it again"
MIN_ZEROS = 64
"""Bytes: two rows of a .splat, whose rotations are no zeros."""
MIN_LETTERS = 16
"""Of a text: bytes of floats have no such run of letters and spaces alone."""
_PRINTABLE = frozenset(range(32, 127)) | {9, 10, 13}
_PAGE_BEGINNINGS = (b"<!doctype html", b"<html", b"<head", b"<?xml", b"<svg", b"<error")
"""Lower case; what servers send in place of a file that is missing or not public."""


def check_not_foreign(head: bytes, path: Path) -> None:
    """Raises ValueError, in one line, where a file that begins with `head` is of a kind that is no splats."""
    if len(head) >= MIN_ZEROS and not any(head):
        raise ValueError(f"{path}: begins with {len(head):,} zero bytes, as no splat file does; {COPY_AGAIN}")
    text = head[:HEAD_BYTES].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith(_PAGE_BEGINNINGS):
        raise ValueError(f"{path}: is a web page (HTML or XML), not a splat file; {DOWNLOAD}")
    for offset, magic, what, remedy in _MAGIC:
        if head[offset : offset + len(magic)] == magic and (offset != 8 or head[:4] == b"RIFF"):
            raise ValueError(f"{path}: is {what}, not a splat file; {remedy}")
    ending = path.suffix.lower()
    packed = ending in (".ply", ".glb", ".sog") or (ending in (".splat", ".ksplat") and _is_gzip(head))
    if head.startswith(GZIP) and packed:  # SPZ has it too, and a .splat may
        raise ValueError(f"{path}: is packed by gzip; unpack it first (gunzip), or call it .spz if it is one")
    letters = len(text) - len(text.translate(None, string.ascii_letters.encode()))
    is_json = text.startswith((b'{"', b"[{")) and len(text) > MIN_LETTERS
    if (letters >= MIN_LETTERS or is_json) and path.suffix.lower() != ".json" and _PRINTABLE.issuperset(text):
        remedy = "save it as .glb" if is_json and b'"asset"' in text else DOWNLOAD
        raise ValueError(f"{path}: is a text {text[:40].decode('ascii')!r}, not a splat file; {remedy}")


def _is_gzip(head: bytes) -> bool:
    """Whether a beginning is that of a gzip stream, which no row of floats is: it unpacks."""
    try:
        return len(zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, 1 << 16)) > 0
    except zlib.error:
        return False
