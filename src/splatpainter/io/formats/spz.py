"""Niantic SPZ (.spz), versions 1 to 4, little-endian.

    versions 1-3, one gzip member:                    version 4, plain:
      u32 "NGSP", u32 version, u32 N                    u32 "NGSP", u32 4, u32 N
      u8 SH degree, u8 fractional bits, u8 flags, u8 0  u8 SH degree, u8 fractional bits, u8 flags, u8 streams
      positions    N * 9 (version 1: 6)                 u32 offset of the table, 12 bytes 0
      alphas       N                                    extensions, up to the table
      colors       N * 3                                table: streams * (u64 packed size, u64 size)
      scales       N * 3                                streams in the order on the left, each one zstd frame;
      rotations    N * 4 (versions 1, 2: 3)             empty ones are left out
      sh           N * 3 (K - 1)
      extensions

Flags: 1 trained with antialiasing, 2 extensions present: records of u32 type, u32 size, payload.

Axes: those of PLY files, as nearly every program writes and reads SPZ (docs/interop.md), unless extension 0xADBE0003
names others or the caller does; the format's README says right-up-back. New files do not say it: a program that obeys
the extension and turns SPZ files on top would turn them twice. Files of other axes are marked by the extension.

Writing over a source of this format keeps its version, fractional bits, axes, extensions and trailing bytes, and the
packed words of every value that did not change; only changed values are quantised. An untouched asset is written back
byte for byte. Other sources become version 3, which every current reader opens (4 holds the same words, better packed,
but is newer), or version 4 for SH degree 4.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.io import files
from splatpainter.io.axes import describe, flip, move, move_back
from splatpainter.io.bounded import BOUNDS, Gunzip, allow_rows, unzstd
from splatpainter.io.formats import activations
from splatpainter.io.formats.reuse import Unchanged, drawable_rows, row_problems, unchanged
from splatpainter.kernels.parallel import each
from splatpainter.splats import Axes, Source, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm

MAGIC = b"NGSP"
STREAMS = ("positions", "alphas", "colors", "scales", "rotations", "sh")
BLOCK_ROWS = 1 << 16
"""Rows decoded at a time, to bound the float64 intermediates."""
GZIP_LEVEL, GZIP_PIECE_BYTES = 6, 1 << 20
"""Level, and bytes that are compressed on their own: enough that their beginnings cost nothing (0.02 %)."""
DEFLATE_WINDOW_BYTES = 1 << 15
SH_BLOCK_ROWS = 1 << 12
"""Rows whose SH is packed at a time, so that it stays in the cache."""
ANTIALIASED, EXTENDED = 1, 2
COORDINATE_SYSTEM = 0xADBE0003
NAMES = ("ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf", "lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu")
CODES = {name: code for code, name in enumerate(NAMES, 1)}
"""Codes of COORDINATE_SYSTEM. Less 1, bits 0-2 say right, up, front; bit 3 says that y and z are exchanged."""
RDF = CODES["rdf"]
QUARTER_TURN = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], float)
"""About x, (x, y, z) -> (x, z, -y): from the axes of bit 3 to the others."""
SH_BITS = (7, 7)
"""Precision of the SH bytes that we quantise. The reference keeps (5, 4); on a view-dependent asset that costs 6.0/255
of colour (rms over directions), (7, 7) costs 0.75/255 and 26 % more file, (8, 8) 0.3/255 and 35 %."""
MIN_SH_BAND1_BITS = 5
"""Least bits of SH band 1, as in the reference."""
COLOR_SCALE = 0.15
"""A colour byte is 255 * (COLOR_SCALE * sh0 + 0.5): base colours from -0.44 to 1.44 in steps of 1/136."""
POSITION_LIMIT = 1 << 23
"""A 24-bit position lies in -POSITION_LIMIT .. POSITION_LIMIT - 1, in steps of 2^-fractional_bits."""


@dataclass(frozen=True)
class SpzFile:
    """The contents of an SPZ file, enough to write it again."""

    version: int
    degree: int
    fractional_bits: int
    flags: int
    reserved: bytes
    """The unused byte of the short header, the last 12 of the long one."""
    streams: dict[str, np.ndarray]
    """STREAMS -> uint8 [N, width]."""
    extensions: bytes
    tail: bytes
    """What follows the last stream or the gzip member."""
    data: bytes
    """The file."""
    axes: int = RDF
    """Code of the axes that the words are in."""


def read_spz(path: Path, axes: Axes = "auto") -> Splats:
    """Read any version. axes: of the file's words, whatever the file says; "auto": what it says, else as in PLY files.
    Raises ValueError: truncated, damaged, unknown version, or a size that cannot be honest."""
    # The whole file, as its streams are packed and its hash is wanted anyway.
    data = files.read_all(path)
    file = _parse(data, path)
    problems: list[str] = []
    # Programs differ about the axes of SPZ: the file's own word comes first, and a choice before it is reported.
    stated = _stated_axes(file, problems)
    code = (stated or RDF) if axes == "auto" else CODES[axes]
    if stated and stated != code:
        problems.append(f"the file says {describe(NAMES[stated - 1])}; read as {describe(axes)}, as chosen")
    file = replace(file, axes=code)
    rows = _to_ply_axes(_decode(file), code)
    problems += row_problems(rows)
    source = Source(str(path), "spz", rows, files.sha256(data), file, tuple(problems), NAMES[code - 1])
    source = replace(source, axes_from="choice" if axes != "auto" else "file" if stated else "format")
    return replace(rows, source=source, origin=np.arange(len(rows)))


def unpack_spz(data: bytes, path: Path, axes: str) -> Splats:
    """Rows of an SPZ stream inside another file, in the PLY's axes. axes: key of CODES, of words that do not say it."""
    file = _parse(data, path)
    return _to_ply_axes(_decode(file), _stated_axes(file, []) or CODES[axes])


def write_spz(
    path: Path,
    splats: Splats,
    version: int | None = None,
    axes: Axes = "auto",
    sh_bits: int | None = None,
    mark: bool | None = None,
) -> None:
    """Write `splats`. version: 2, 3 or 4; None keeps the source's, and is 3 for other formats (4 for SH degree 4).
    axes: of the words in the file; "auto" keeps the source's, and are those of PLY files for other formats.
    sh_bits: 4 to 8, precision of all SH bytes (4: band 1 has 5, as the reference writes); None: SH_BITS for those that
    changed, the file's own for the others.
    mark: whether the file names its axes by the extension; None: as the source where its axes stay, and else where
    they are not those of PLY files.

    Raises ValueError: a position that 24 bits cannot hold, SH degree 4 below version 4, a version not writable, or no
    room for the mark.
    """
    # A file that nothing changed is written as the bytes that were read.
    splats = splats.numpy()
    same = unchanged(splats, "spz")
    old: SpzFile | None = splats.source.detail if same and splats.source else None
    before = (same, old) if same and old else None
    code = CODES[axes] if axes != "auto" else old.axes if old else RDF
    untouched = same is not None and same.identity and old is not None and code == old.axes and sh_bits is None
    if mark is not None and old is not None:
        untouched = untouched and mark == (_stated_axes(old, []) is not None)
    # The version stays as long as it can hold the asset.
    if version is None:
        version = old.version if old else 3
        if splats.sh_degree > 3 and not untouched:
            version = 4
    if version not in (2, 3, 4) and not (old and version == old.version):
        raise ValueError(f"{path}: expected SPZ version 2, 3 or 4, got {version}")
    if splats.sh_degree > 3 and version < 4 and not (untouched and old and version == old.version):
        raise ValueError(
            f"{path}: SPZ version {version} holds SH up to degree 3, got {splats.sh_degree}; use version 4"
        )
    # Else rows are encoded, those that did not change by their old words.
    if old and untouched and version == old.version:
        out = old.data
    else:
        file = _encode(splats, before, version, code, path, sh_bits)
        room = not file.extensions or file.flags & EXTENDED  # a tree that no flag calls an extension leaves none
        if mark and not room:
            raise ValueError(f"{path}: bytes behind its rows leave no room to mark its axes; write it unmarked")
        if mark is None:
            stays = old is not None and code == old.axes and _stated_axes(old, []) is not None
            mark = bool(room) and (stays or code != RDF)
        file = _marked(file) if mark else _unmarked(file)
        out = _plain_bytes(file) if version >= 4 else _gzip_bytes(file)
    with files.writing(path) as target:
        target.write(out)


def _parse(data: bytes, path: Path) -> SpzFile:
    # Since version 4 the file itself is no gzip stream any more.
    if data[:4] == MAGIC:
        return _parse_plain(data, path)
    if data[:2] == b"\x1f\x8b":
        return _parse_gzip(data, path)
    raise ValueError(f"{path}: not an SPZ file: expected a gzip stream or 'NGSP', found {bytes(data[:4])!r}")


def _widths(version: int, degree: int) -> dict[str, int]:
    rotations = 3 if version < 3 else 4
    return dict(zip(STREAMS, (6 if version == 1 else 9, 1, 3, 3, rotations, 3 * ((degree + 1) ** 2 - 1)), strict=True))


def _check_header(version: int, degree: int, bits: int, path: Path) -> None:
    if degree > 4:
        raise ValueError(f"{path}: expected SH degree 0-4, found {degree}")
    if version > 1 and bits > 23:
        raise ValueError(f"{path}: expected 0-23 fractional bits in a 24-bit position, found {bits}")


def _parse_gzip(data: bytes, path: Path) -> SpzFile:
    # A stream may unpack to anything: header first, and from it how much may follow.
    stream = Gunzip(data, path)
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<4sIIBBBB", stream.take(16, "the SPZ header"))
    if files.begins_as_ply(magic):
        raise ValueError(f"{path}: is a PLY file packed by gzip, not an SPZ file; unpack it first (gunzip)")
    if magic.startswith(b"\x1f\x8b"):
        raise ValueError(f"{path}: is packed by gzip twice; unpack it once (gunzip)")
    if magic != MAGIC:
        remedy = "; unpack it first (gunzip)" if path.suffix.lower() == ".gz" else ""
        raise ValueError(f"{path}: not an SPZ file: expected 'NGSP' inside the gzip stream, found {magic!r}{remedy}")
    if version not in (1, 2, 3):
        raise ValueError(f"{path}: expected SPZ version 1-3 in a gzip stream, found {version}")
    _check_header(version, degree, bits, path)
    widths = _widths(version, degree)
    allow_rows(len(data), count, (degree + 1) ** 2, path)
    rows = stream.take(count * sum(widths.values()), f"{count} rows of SPZ version {version}")
    streams, at = {}, 0
    for name, width in widths.items():
        streams[name] = np.frombuffer(rows, np.uint8, count * width, at).reshape(count, width)
        at += count * width
    extensions, tail = stream.rest()
    return SpzFile(version, degree, bits, flags, bytes([reserved]), streams, extensions, tail, data)


def _parse_plain(data: bytes, path: Path) -> SpzFile:
    header = files.take(data, 0, 32, path, "the SPZ header")
    _, version, count, degree, bits, flags, stored, table = struct.unpack("<4sIIBBBBI", header[:20])
    if version in (1, 2, 3):
        raise ValueError(
            f"{path}: an SPZ file of version {version} that was unpacked on its way here (a download that took its "
            "gzip for the connection's); download it again as it is, or pack it: gzip FILE, then call it .spz"
        )
    if version != 4:
        raise ValueError(f"{path}: expected SPZ version 4 after a plain 'NGSP', found {version}")
    _check_header(version, degree, bits, path)
    sizes = {name: count * width for name, width in _widths(version, degree).items()}
    needed = [name for name in STREAMS if sizes[name]]
    # Writers leave empty streams out; one that is listed all the same must say that it is empty.
    listed = needed if stored == len(needed) else list(STREAMS)
    if stored != len(listed):
        raise ValueError(f"{path}: expected {len(needed)} streams for SH degree {degree}, found {stored}")
    if not 32 <= table <= 32 + BOUNDS.max_tail_bytes:
        raise ValueError(f"{path}: expected the table of streams at byte 32 or after the extensions, found {table}")
    # What the table says is held against the file before anything is unpacked.
    entries = struct.unpack(f"<{2 * stored}Q", files.take(data, table, 16 * stored, path, "the table of streams"))
    at = table + 16 * stored
    if sum(entries[::2]) > len(data) - at:
        raise ValueError(f"{path}: truncated: the streams need {sum(entries[::2])} bytes, {len(data) - at} are left")
    for name, size in zip(listed, entries[1::2], strict=True):
        if size != sizes[name]:
            raise ValueError(f"{path}: expected {sizes[name]} bytes of {name} for {count} rows, the table says {size}")
    allow_rows(len(data), count, (degree + 1) ** 2, path)
    streams = {}
    for name, packed in zip(listed, entries[::2], strict=True):
        piece = unzstd(files.take(data, at, packed, path, name), sizes[name], path, f"the stream of {name}")
        streams[name] = np.frombuffer(piece, np.uint8).reshape(count, sizes[name] // max(count, 1))
        at += packed
    for name in STREAMS:
        streams.setdefault(name, np.zeros((count, 0 if count else _widths(version, degree)[name]), np.uint8))
    reserved, extensions = bytes(header[20:]), data[32:table]
    return SpzFile(version, degree, bits, flags, reserved, streams, extensions, data[at:], data)


def _decode(file: SpzFile) -> Splats:
    """Rows in the file's own axes."""
    streams, count = file.streams, len(file.streams["alphas"])
    unpack_quats = unpack_quats_first_three if file.version < 3 else unpack_quats_smallest_three
    out = Splats(
        np.empty((count, 3), np.float32),
        np.empty((count, 4), np.float32),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty((count, (file.degree + 1) ** 2, 3), np.float32),
        antialiased=bool(file.flags & ANTIALIASED),
    )
    for start in range(0, count, BLOCK_ROWS):
        block = slice(start, start + BLOCK_ROWS)
        positions = streams["positions"][block]
        if file.version == 1:
            out.means[block] = unpack_half_positions(positions)
        else:
            out.means[block] = unpack_positions(positions, file.fractional_bits)
        out.quats[block] = unpack_quats(streams["rotations"][block])
        out.scales[block] = unpack_scales(streams["scales"][block])
        out.opacities[block] = unpack_opacities(streams["alphas"][block])
        out.sh[block, 0] = unpack_colors(streams["colors"][block])
        if file.degree:
            out.sh[block, 1:] = unpack_sh(streams["sh"][block])
    return out


def _encode(
    splats: Splats, before: tuple[Unchanged, SpzFile] | None, version: int, code: int, path: Path, sh_bits: int | None
) -> SpzFile:
    old = before[1] if before else SpzFile(version, 0, 0, 0, b"", {}, b"", b"", b"", code)
    rows = _from_ply_axes(drawable_rows(splats), code)
    # Version 1 has no fixed point; 2 shares all words but the rotations with 3 and 4.
    keeps = {"positions": (old.version == 1) == (version == 1), "rotations": (old.version < 3) == (version < 3)}
    bits = old.fractional_bits if before and keeps["positions"] else _fractional_bits(rows)
    turned = code != old.axes
    if turned:
        keeps = {"positions": False, "rotations": False, "sh": False}
    bits_of_bands = (8, 8) if turned else SH_BITS  # a word with its sign changed needs all 8
    if sh_bits is not None:
        keeps["sh"], bits_of_bands = False, (max(sh_bits, MIN_SH_BAND1_BITS), sh_bits)
    pack_quats = pack_quats_first_three if version < 3 else pack_quats_smallest_three
    streams = {
        "positions": pack_half_positions(rows.means) if version == 1 else _pack_positions(rows, bits, path),
        "alphas": pack_opacities(rows.opacities),
        "colors": pack_colors(rows.sh[:, 0]),
        "scales": pack_scales(rows.scales),
        "rotations": pack_quats(rows.quats),
        "sh": pack_sh(rows.sh[:, 1:], bits_of_bands),
    }
    if before:
        same = before[0]
        masks = (same.means, same.opacities, same.base, same.scales, same.quats, same.rest)
        for name, mask in zip(STREAMS, masks, strict=True):
            if keeps.get(name, True) and mask.any():
                width = streams[name].shape[1]  # of SH the first bands: the degree may be lower than it was
                streams[name][mask] = old.streams[name][same.source_rows[mask], :width]
    flags = old.flags & ~ANTIALIASED | (ANTIALIASED if splats.antialiased else 0)
    extensions = old.extensions
    return SpzFile(version, splats.sh_degree, bits, flags, old.reserved, streams, extensions, old.tail, b"", code)


def _pack_positions(rows: Splats, bits: int, path: Path) -> np.ndarray:
    # Words of the file are within reach by themselves: unpacking and packing them is exact.
    clear = fits(rows.means, bits)
    if not clear.all():
        row = int(np.argmin(clear))
        raise ValueError(
            f"{path}: row {row} at {rows.means[row].tolist()} lies outside of the "
            f"+-{POSITION_LIMIT / 2**bits:g} units that {bits} fractional bits leave; write .ply instead"
        )
    return pack_positions(rows.means, bits)


def _fractional_bits(rows: Splats) -> int:
    """12 bits as the reference, or as many as small rows need: a step of a quarter of the 5th percentile of the
    middle scale. Twice the present extent must fit, so that later edits do. 0-20."""
    if not len(rows):
        return 12
    thin = float(np.percentile(np.sort(rows.scales, 1)[:, 1], 5))
    needed = 1 - math.frexp(max(thin / 4, 2.0**-20))[1]  # -log2, up
    extent = max(float(np.abs(rows.means).max()), 2.0**-10)
    possible = math.frexp(POSITION_LIMIT / (2 * extent))[1] - 1  # log2, down
    return int(np.clip(min(max(needed, 12), possible), 0, 20))


def _gzip_bytes(file: SpzFile) -> bytes:
    count, reserved = len(file.streams["alphas"]), (file.reserved or b"\0")[:1]
    header = struct.pack("<4sIIBBB", MAGIC, file.version, count, file.degree, file.fractional_bits, file.flags)
    body = b"".join([header, reserved, *(file.streams[name].tobytes() for name in STREAMS), file.extensions])
    return _gzip_member(body) + file.tail


def _gzip_member(body: bytes) -> bytes:
    """One gzip member of pieces that threads compress side by side, each with the end of the one before it as its
    dictionary: the size of the whole hardly grows, and the bytes do not depend on the number of threads."""
    starts = range(0, max(len(body), 1), GZIP_PIECE_BYTES)

    def deflated(start: int) -> bytes:
        before = body[max(start - DEFLATE_WINDOW_BYTES, 0) : start]
        options = (GZIP_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_DEFAULT_STRATEGY)
        packer = zlib.compressobj(*options, before) if before else zlib.compressobj(*options)
        packed = packer.compress(memoryview(body)[start : start + GZIP_PIECE_BYTES])
        return packed + packer.flush(zlib.Z_FINISH if start == starts[-1] else zlib.Z_SYNC_FLUSH)

    # Without a time and a system, so that equal rows make equal files.
    header = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"
    trailer = struct.pack("<II", zlib.crc32(body), len(body) & 0xFFFFFFFF)
    return b"".join([header, *each(deflated, starts), trailer])


def _plain_bytes(file: SpzFile) -> bytes:
    from splatpainter.io import zstd

    count, reserved = len(file.streams["alphas"]), file.reserved.ljust(12, b"\0")
    pieces = [file.streams[name].tobytes() for name in STREAMS]
    pieces = [piece for piece in pieces if piece]
    packed = [zstd.pack(piece, level=12) for piece in pieces]
    counts = (file.degree, file.fractional_bits, file.flags, len(pieces), 32 + len(file.extensions))
    header = struct.pack("<4sIIBBBBI", MAGIC, 4, count, *counts)
    table = b"".join(struct.pack("<QQ", len(a), len(b)) for a, b in zip(packed, pieces, strict=True))
    return b"".join([header, reserved[:12], file.extensions, table, *packed, file.tail])


def _stated_axes(file: SpzFile, problems: list[str]) -> int | None:
    """Code of the axes that the file names, None where it names none."""
    for at in _axes_records(file):
        (code,) = struct.unpack_from("<I", file.extensions, at + 8)
        if 1 <= code <= len(NAMES):
            return code
        problems.append(f"extension names the unknown coordinate system {code}; read as in PLY files")
    return None


def _axes_records(file: SpzFile) -> Iterator[int]:
    """Where records of COORDINATE_SYSTEM begin in the extensions."""
    at, data = 0, file.extensions if file.flags & EXTENDED else b""
    while len(data) - at >= 8:
        kind, size = struct.unpack_from("<II", data, at)
        if kind == COORDINATE_SYSTEM and size == 4 and len(data) - at >= 12:
            yield at
        at += 8 + size


def other_extensions(file: SpzFile) -> bytes:
    """The extensions without the records of the axes."""
    data, at = bytearray(), 0
    for record in _axes_records(file):
        data += file.extensions[at:record]
        at = record + 12
    return bytes(data + file.extensions[at:])


def _marked(file: SpzFile) -> SpzFile:
    """The file with its axes in the extension. In versions 1 to 3 that stands behind the rows, where some readers
    (spz-js) refuse bytes."""
    extensions = bytearray(file.extensions)
    records = list(_axes_records(file))
    for at in records:
        struct.pack_into("<I", extensions, at + 8, file.axes)
    if not records:
        extensions[:0] = struct.pack("<III", COORDINATE_SYSTEM, 4, file.axes)
    return replace(file, extensions=bytes(extensions), flags=file.flags | EXTENDED)


def _unmarked(file: SpzFile) -> SpzFile:
    """The file without its axes in the extension; other records, and bytes that no flag calls extensions, stay."""
    if not list(_axes_records(file)):
        return file
    rest = other_extensions(file)
    return replace(file, extensions=rest, flags=file.flags if rest else file.flags & ~EXTENDED)


def _flips(code: int) -> tuple[int, int, int]:
    differ = (code - 1) ^ (RDF - 1)
    return (-1 if differ & 1 else 1, -1 if differ & 2 else 1, -1 if differ & 4 else 1)


def _to_ply_axes(rows: Splats, code: int) -> Splats:
    rows = _flip(rows, code)
    return move(rows, QUARTER_TURN) if code > 8 else rows


def _from_ply_axes(rows: Splats, code: int) -> Splats:
    rows = move_back(rows, QUARTER_TURN) if code > 8 else rows
    return _flip(rows, code)


def _flip(rows: Splats, code: int) -> Splats:
    signs = _flips(code)
    rows = flip(rows, signs)
    if signs[1] < 0 and rows.sh.shape[1] == 25:
        # The reference reverses the last coefficient of band 4 with y, although Y_44 is even in y; it made the files.
        rows.sh[:, 24] *= -1
    return rows


# ---- packed words: one function each way for every stream, uint8 [N, width] <-> activated float32 of N rows. The
# formulas are those of SPZ's own README and reference implementation.


def unpack_positions(packed: np.ndarray, fractional_bits: int) -> np.ndarray:
    """[N, 9] bytes -> [N, 3]: signed 24-bit little-endian fixed point; exact in float32."""
    words = packed.reshape(-1, 3, 3).astype(np.int32)
    fixed = words[..., 0] | words[..., 1] << 8 | words[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1
    return np.ldexp(fixed.astype(np.float32), -fractional_bits)


def pack_positions(means: np.ndarray, fractional_bits: int) -> np.ndarray:
    """[N, 3] -> [N, 9] bytes. The caller has checked `fits`."""
    fixed = np.rint(np.ldexp(means.astype(np.float64), fractional_bits)).astype(np.int32)
    return np.stack([fixed >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8).reshape(-1, 9)


def fits(means: np.ndarray, fractional_bits: int) -> Bools:
    """[N] bool: rows whose positions 24 bits can hold."""
    fixed = np.rint(np.ldexp(means.astype(np.float64), fractional_bits))
    return np.asarray(np.logical_and(fixed >= -POSITION_LIMIT, fixed < POSITION_LIMIT).all(1))


def unpack_half_positions(packed: np.ndarray) -> np.ndarray:
    """[N, 6] bytes -> [N, 3]: the float16 positions of version 1."""
    return packed.reshape(-1, 6).view("<f2").astype(np.float32)


def pack_half_positions(means: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N, 6] bytes."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(means, dtype="<f2").view(np.uint8).reshape(-1, 6)


def unpack_scales(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 3] scales: log-scale = byte / 16 - 10, so 4.5e-5 to 378 in steps of 6.4 %."""
    return activations.exp(packed.astype(np.float32) / 16 - 10)


def pack_scales(scales: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N, 3] bytes; smaller and larger scales take the nearest end of the range."""
    return _byte((activations.log(scales).astype(np.float64) + 10) * 16)


def unpack_opacities(packed: np.ndarray) -> np.ndarray:
    """[N, 1] bytes -> [N]."""
    return (packed.reshape(-1).astype(np.float64) / 255).astype(np.float32)


def pack_opacities(opacities: np.ndarray) -> np.ndarray:
    """[N] -> [N, 1] bytes."""
    return _byte(opacities.astype(np.float64) * 255)[:, None]


def unpack_colors(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 3] coefficients of Y_00."""
    return ((packed.astype(np.float64) / 255 - 0.5) / COLOR_SCALE).astype(np.float32)


def pack_colors(base: np.ndarray) -> np.ndarray:
    """[N, 3] coefficients of Y_00 -> [N, 3] bytes."""
    return _byte((base.astype(np.float64) * COLOR_SCALE + 0.5) * 255)


def unpack_quats_first_three(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 4] w, x, y, z of versions 1 and 2: byte / 127.5 - 1, and w >= 0 from the unit norm."""
    vector = packed.astype(np.float64) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (vector * vector).sum(1, keepdims=True)))
    return np.concatenate([w, vector], 1).astype(np.float32)


def pack_quats_first_three(quats: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z of any non-zero norm -> [N, 3] bytes."""
    unit = _unit(quats)
    vector = unit[:, 1:] * np.where(unit[:, :1] < 0, -1, 1)
    return _byte((vector + 1) * 127.5)


def unpack_quats_smallest_three(packed: np.ndarray) -> np.ndarray:
    """[N, 4] bytes -> [N, 4] w, x, y, z of versions 3 and 4.

    A little-endian word: in bits 30-31 which of x, y, z, w is the largest; below it the other three in that order, each
    a sign bit and 9 bits of magnitude in steps of sqrt(1/2) / 511.
    """
    words = packed.reshape(-1, 4).view("<u4")[:, 0].astype(np.int64)
    largest = words >> 30
    xyzw = np.zeros((len(words), 4))
    for component in (3, 2, 1, 0):
        stored = largest != component
        value = (words & 511) * (np.sqrt(0.5) / 511)
        xyzw[:, component] = np.where(stored, np.where(words & 512, -value, value), 0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw * xyzw).sum(1)))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def pack_quats_smallest_three(quats: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z of any non-zero norm -> [N, 4] bytes."""
    xyzw = _unit(quats)[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    words = largest.astype(np.int64)
    for component in range(4):
        value = xyzw[:, component]
        magnitude = np.minimum(np.rint(np.abs(value) * (511 / np.sqrt(0.5))), 511).astype(np.int64)
        words = np.where(largest == component, words, words << 10 | np.where(value < 0, 512, 0) | magnitude)
    return words.astype("<u4").view(np.uint8).reshape(-1, 4)


def unpack_sh(packed: np.ndarray) -> np.ndarray:
    """[N, 3 (K - 1)] bytes -> [N, K - 1, 3] coefficients of bands >= 1: byte / 128 - 1, colour channel fastest."""
    return (packed.astype(np.float32) / 128 - 1).reshape(len(packed), packed.shape[1] // 3, 3)


def pack_sh(rest: np.ndarray, bits: tuple[int, int]) -> np.ndarray:
    """[N, K - 1, 3] -> [N, 3 (K - 1)] bytes. bits: precision kept of band 1 and of the higher bands, 1-8.

    Coarser values pack better; readers need not know. 0 stays 0 at any precision.
    """
    # Rounded once, to the bucket itself: two roundings, as the reference does, would add half a step of error.
    steps = np.where(np.arange(rest.shape[1]) < 3, 1 << (8 - bits[0]), 1 << (8 - bits[1])).astype(np.float32)[:, None]
    out = np.empty((len(rest), rest.shape[1], 3), np.uint8)
    for start in range(0, len(rest), SH_BLOCK_ROWS):
        # float32 is exact here: factors are powers of two, and what lies beyond 24 bits is cut.
        values = rest[start : start + SH_BLOCK_ROWS] * (np.float32(128) / steps)
        np.rint(values, out=values)
        values *= steps
        values += 128
        out[start : start + SH_BLOCK_ROWS] = np.clip(values, 0, 255, out=values)
    return out.reshape(len(rest), 3 * rest.shape[1])


def _unit(quats: np.ndarray) -> np.ndarray:
    wide = quats.astype(np.float64)
    return wide / row_norm(wide)[:, None]


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
