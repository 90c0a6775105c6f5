"""Files that are no splats, whatever their name says: web pages, git-LFS pointers, films, pictures, archives.

Known by their first bytes. The formats with a magic of their own are told apart before (`io.detect`); of the two
without one (.splat, .ksplat) no honest file begins so: its first twelve bytes are a position.
"""

from __future__ import annotations

import string
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

HEAD_BYTES = 512
"""Bytes that are looked at."""
EXPORT_ADVICE = "export the splats from it (nerfstudio: ns-export gaussian-splat; gsplat: --save_ply)"
DOWNLOAD = "download the file itself (on GitHub and Hugging Face: raw, or download)"
SPLATS = "expected Gaussian splats"
USD_SCENE = ("a USD scene", "save its splats as .ply or .spz")
FILM_ADVICE = "render frames of it and train an asset from them"
_MAGIC: tuple[tuple[int, bytes, str, str], ...] = (
    (0, b"version https://git-lfs", "a git-LFS pointer", "run `git lfs pull` in its folder to get the file itself"),
    (4, b"ftypheic", "a picture (HEIC)", SPLATS),
    (4, b"ftypavif", "a picture (AVIF)", SPLATS),
    (4, b"ftyp", "a film (MP4, MOV)", FILM_ADVICE),
    (0, b"\x1a\x45\xdf\xa3", "a film (WebM, Matroska)", FILM_ADVICE),
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
    (0, b"#usda ", *USD_SCENE),
    (0, b"PXR-USDC", *USD_SCENE),
    (0, b"SQLite format 3\x00", "a database (a .splatproj project?)", "open projects with `splatpainter studio`"),
    (0, b"7z\xbc\xaf\x27\x1c", "a 7z archive", "unpack it first"),
    (0, b"Rar!\x1a\x07", "a RAR archive", "unpack it first"),
    *((4, box, "a film (MOV)", FILM_ADVICE) for box in (b"moov", b"mdat", b"wide", b"free", b"skip")),
    (0, b"FLV\x01", "a film (FLV)", FILM_ADVICE),
    (0, b"OggS\0", "a film or sound (Ogg)", FILM_ADVICE),
    (0, b"\0\0\x01\xba\x44", "a film (MPEG)", FILM_ADVICE),
    (0, b"II*\0", "a picture (TIFF)", SPLATS),
    (0, b"MM\0*", "a picture (TIFF)", SPLATS),
    (0, b"8BPS\0", "a picture (PSD)", SPLATS),
    (4, b"JXL \r\n\x87\n", "a picture (JPEG XL)", SPLATS),
    (6, b"\0\0\0\0\x36\0\0\0\x28\0\0\0", "a picture (BMP)", SPLATS),
    (0, b"\0\x05\x16\x07\0\x02\0\0", "a shadow file of macOS", "open the file of that name without ._"),
    (0, b"\x89HDF\r\n\x1a\n", "a container (HDF5)", "save its splats as .ply"),
    (0, b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "a document of Office", SPLATS),
    (0, b"\x7fELF", "a program", SPLATS),
    (0, b"MZ\x90\0", "a program", SPLATS),
    (0, b"\x04\x22\x4d\x18", "packed by LZ4", "unpack it first"),
    (8, b"WEBP", "a picture (WebP)", SPLATS),
    (8, b"AVI ", "a film (AVI)", FILM_ADVICE),
    (257, b"ustar", "a tar archive", "unpack it first"),
)
"""(offset, bytes there, what it is, what to do)."""
GZIP = b"\x1f\x8b"
TS_PACKET, TS_SYNC = 188, 0x47
"""Bytes of a packet of an MPEG transport stream, and the first of each."""
EXPORTS = (
    (".psht", "a project of Postshot", "export it there as .ply"),
    (".lcc", "a scene of XGRIDS (LCC)", "export it there as .ply"),
    (".rad", "a streamed scene of Spark (RAD)", "open the file that it was made from"),
    (".splatv", "a moving scene (.splatv)", "save one moment of it as .ply"),
    (".spx", "a scene of Reall3D (.spx)", "convert it there to .ply or .spz"),
    (".safetensors", "weights (safetensors)", "save its splats as .ply"),
    (".blend", "a scene of Blender", "export its splats as .ply"),
    *((ending, *USD_SCENE) for ending in (".usd", ".usda", ".usdc", ".usdz")),
    *((ending, "a checkpoint of a trainer", EXPORT_ADVICE) for ending in (".pt", ".pth", ".ckpt", ".pkl")),
)
"""(ending, what it is, what to do) of files whose bytes do not say so."""
COPY_AGAIN = "its download or copy was not finished, or the disk was full: get it again"
MIN_ZEROS = 64
"""Bytes: two rows of a .splat, whose rotations are no zeros."""
MIN_ROW = 32
"""Bytes: one row of a .splat, the smallest file of splats."""
SPLAT_ENDINGS = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb")
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
    for is_it, what, remedy in _SHAPES:
        if is_it(head):
            raise ValueError(f"{path}: is {what}, not a splat file; {remedy}")
    if _is_transport_stream(head):
        raise ValueError(f"{path}: is a film (MPEG transport stream), not a splat file; {FILM_ADVICE}")
    ending = path.suffix.lower()
    packed = ending in (".ply", ".glb", ".sog") or (ending in (".splat", ".ksplat") and _is_gzip(head))
    if head.startswith(GZIP) and packed:  # SPZ has it too, and a .splat may
        raise ValueError(f"{path}: is packed by gzip; unpack it first (gunzip), or call it .spz if it is one")
    for other, what, remedy in EXPORTS:
        if ending == other:
            raise ValueError(f"{path}: is {what}, not a splat file; {remedy}")
    letters = len(text) - len(text.translate(None, string.ascii_letters.encode()))
    is_json = text.startswith((b'{"', b"[{")) and len(text) > MIN_LETTERS
    is_short = len(head) < MIN_ROW and letters and ending in SPLAT_ENDINGS and not text.startswith(b"ply")
    if (letters >= MIN_LETTERS or is_json or is_short) and ending != ".json" and _PRINTABLE.issuperset(text):
        remedy = "save it as .glb" if is_json and b'"asset"' in text else DOWNLOAD
        raise ValueError(f"{path}: is a text {text[:40].decode('ascii')!r}, not a splat file; {remedy}")


def _is_transport_stream(head: bytes) -> bool:
    starts = head[: 4 * TS_PACKET : TS_PACKET]
    return len(starts) >= 3 and set(starts) == {TS_SYNC}


def _is_safetensors(head: bytes) -> bool:
    """The length of a JSON text, and that."""
    return head[8:10] == b'{"' and 2 <= int.from_bytes(head[:8], "little") < 1 << 30


def _is_pickle(head: bytes) -> bool:
    """Protocol 4 and later: a frame and its length; before, torch's own number or a list, a dict, a class."""
    if head[:1] != b"\x80":
        return False
    return head[1:3] in (b"\x04\x95", b"\x05\x95") or (
        head[1:2] in (b"\x02", b"\x03") and head[2:4] in (b"\x8a\x0a", b"}q", b"]q", b"cn", b"cc", b"(d", b"(l")
    )


def _is_stl(head: bytes) -> bool:
    """Binary: 80 bytes of anything, a count, and triangles of 50 bytes whose last two say nothing. Two of them at
    least, with normals of length 1 or none."""
    if len(head) < 84 + 2 * 50 or head[:3] == b"ply":
        return False
    count = int.from_bytes(head[80:84], "little")
    triangles = [head[84 + 50 * k : 134 + 50 * k] for k in range(min(count, (len(head) - 84) // 50))]
    lengths = [sum(value * value for value in struct.unpack("<3f", one[:12])) for one in triangles]
    plain = all(one[48:] == b"\0\0" for one in triangles)
    return count > 1 and plain and all(one == 0 or abs(one - 1) < 1e-3 for one in lengths)


_SHAPES: tuple[tuple[Callable[[bytes], bool], str, str], ...] = (
    (_is_safetensors, "weights (safetensors)", "save its splats as .ply"),
    (_is_pickle, "a pickle of Python", EXPORT_ADVICE),
    (_is_stl, "a mesh (STL)", "make splats of it: splatpainter fit MESH.glb"),
)
"""(whether a beginning is of it, what it is, what to do) of those that no fixed bytes tell."""


def _is_gzip(head: bytes) -> bool:
    """Whether a beginning is that of a gzip stream, which no row of floats is: it unpacks."""
    try:
        return len(zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(head, 1 << 16)) > 0
    except zlib.error:
        return False
