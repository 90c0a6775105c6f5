"""The flattened picture in files of layers: PSD and PSB (Adobe's published file format), OpenRaster and Krita.

A PSD ends with a composite of all layers, channel after channel, raw or packed by PackBits or ZIP; OpenRaster and Krita
files are zips with a mergedimage.png. Bounded: sizes are judged by the header, and no row unpacks to more than its
pixels.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpainter.image_files import MAX_PICTURE_PIXELS
from splatpainter.io.bounded import zip_directory
from splatpainter.pictures.color_profiles import PNG_MAGIC
from splatpainter.system.quick_dataclass import dataclass

PSD_MAGIC, ZIP_MAGIC = b"8BPS", b"PK\x03\x04"
MERGED = "mergedimage.png"
"""Name of the flattened picture in OpenRaster and Krita files."""
MAX_MERGED_BYTES = 512 << 20
"""Most bytes of it."""
RGB_MODE, GREY_MODE = 3, 1
MODES = {0: "a bitmap", 2: "indexed colours", 4: "CMYK", 7: "multichannel", 8: "duotone", 9: "Lab"}
PROFILE_RESOURCE, VERSION_RESOURCE, CHANNEL_NAMES_RESOURCE = 1039, 1057, 1006
MAX_RESOURCES = 4096
MAX_PROFILE_BYTES = 16 << 20


def is_psd(path: Path) -> bool:
    return first_bytes(path, 4) == PSD_MAGIC


def is_zip(path: Path) -> bool:
    return first_bytes(path, 4) == ZIP_MAGIC


def first_bytes(path: Path, count: int) -> bytes:
    """As many as there are; none of what cannot be read, or is no regular file."""
    try:
        if not path.is_file():
            return b""
        with open(path, "rb") as file:
            return file.read(count)
    except OSError:
        return b""


@dataclass(frozen=True)
class Composite:
    """The flattened picture of a PSD."""

    colors: np.ndarray
    """[H, W, 3] float32 0..1, as stored."""
    alpha: np.ndarray | None
    """[H, W] float32 0..1."""
    profile: bytes | None
    """ICC profile."""


@dataclass(frozen=True)
class _PsdHeader:
    large: bool
    """Whether it is a PSB: lengths of 8 bytes."""
    channels: int
    height: int
    width: int
    bits: int
    mode: int


def psd_size(path: Path) -> tuple[int, int]:
    """(width, height). Raises ValueError as `read_psd`."""
    with open(path, "rb") as file:
        header = _psd_header(file, path)
    return header.width, header.height


def read_psd(path: Path) -> Composite:
    """The composite of a PSD or PSB. Raises ValueError naming the file: damaged, too many pixels, other than 8 or 16
    bits of RGB or grey, saved without its composite."""
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        header = _psd_header(file, path)
        # Sections in the order of the file: colour modes, resources, layers, then the composite.
        _skipped(file, 4, size, path)
        profile, has_composite, channel = _resources(file, size, path)
        if not has_composite:
            raise ValueError(
                f"{path}: a PSD that was saved without its flattened picture; save it with maximum compatibility, or "
                "export it as PNG"
            )
        transparent = _first_alpha_is_transparency(file, header, channel, size, path)
        planes = _planes(file, header, size, path)
    colors = np.stack(planes[:3], -1) if header.mode == RGB_MODE else np.repeat(planes[0][..., None], 3, -1)
    values = colors.astype(np.float32) / (255 if header.bits == 8 else 65535)
    # The first channel behind the colours may be transparency, or a saved selection.
    count = 3 if header.mode == RGB_MODE else 1
    if not transparent or len(planes) <= count:
        return Composite(values, None, profile)
    alpha = planes[count].astype(np.float32) / (255 if header.bits == 8 else 65535)
    if alpha.min() == 1:
        return Composite(values, None, profile)
    # Flattened on white, as the format wants: taken out again where anything shows.
    share = np.maximum(alpha, 1e-6)[..., None]
    straight = np.where(alpha[..., None] > 0, (values - (1 - share)) / share, 0)
    return Composite(np.clip(straight, 0, 1).astype(np.float32), alpha, profile)


def _psd_header(file: BinaryIO, path: Path) -> _PsdHeader:
    head = file.read(26)
    if len(head) < 26 or head[:4] != PSD_MAGIC:
        raise ValueError(f"{path}: damaged PSD (its header is cut off)")
    version, channels, height, width, bits, mode = struct.unpack(">H6xHIIHH", head[4:])
    # Everything that the header claims is judged here, before a byte of pixels is read.
    if version not in (1, 2):
        raise ValueError(f"{path}: expected a PSD of version 1 or 2, got {version}")
    if not 0 < width * height <= MAX_PICTURE_PIXELS:
        raise ValueError(
            f"{path}: expected at most {MAX_PICTURE_PIXELS // 10**6} megapixels, got {width}x{height}; scale it down"
        )
    if mode not in (RGB_MODE, GREY_MODE):
        raise ValueError(f"{path}: expected RGB colours, got {MODES.get(mode, f'mode {mode}')}; save it as RGB")
    if bits not in (8, 16):
        raise ValueError(f"{path}: expected a PSD of 8 or 16 bits, got {bits}; export it as PNG or OpenEXR")
    if not (3 if mode == RGB_MODE else 1) <= channels <= 56:
        raise ValueError(f"{path}: damaged PSD ({channels} channels)")
    return _PsdHeader(version == 2, channels, height, width, bits, mode)


def _skipped(file: BinaryIO, length_bytes: int, size: int, path: Path) -> tuple[int, int]:
    """(start, end) of a section; the file stands at its end."""
    stored = file.read(length_bytes)
    start = file.tell()
    end = start + int.from_bytes(stored, "big")
    if len(stored) < length_bytes or end > size:
        raise ValueError(f"{path}: damaged PSD (a section lies beyond its end)")
    file.seek(end)
    return start, end


def _resources(file: BinaryIO, size: int, path: Path) -> tuple[bytes | None, bool, bytes]:
    """(the ICC profile, whether the composite is one, the name of the first channel behind the colours, b"" where none
    is said); the file stands behind the resources."""
    start, end = _skipped(file, 4, size, path)
    profile, has_composite, channel = None, True, b""
    at = start
    for _ in range(MAX_RESOURCES):
        file.seek(at)
        head = file.read(7)
        if at + 12 > end or len(head) < 7:
            break
        id, name_bytes = int.from_bytes(head[4:6], "big"), head[6]
        file.seek(at + 6 + name_bytes + 1 + (name_bytes + 1) % 2)
        length = int.from_bytes(file.read(4), "big")
        body = file.tell()
        # An unknown signature means that the walk is lost; what was read so far counts.
        if head[:4] not in (b"8BIM", b"MeSa", b"AgHg", b"PHUT", b"DCSR") or body + length > end:
            break
        if id == PROFILE_RESOURCE and length <= MAX_PROFILE_BYTES:
            profile = file.read(length)
        elif id == VERSION_RESOURCE and length >= 5:
            has_composite = file.read(5)[4] != 0
        elif id == CHANNEL_NAMES_RESOURCE and length > 1:
            channel = file.read(min(length, 256))[1:]
        at = body + length + length % 2
    file.seek(end)
    return profile, has_composite, channel


def _first_alpha_is_transparency(file: BinaryIO, header: _PsdHeader, channel: bytes, size: int, path: Path) -> bool:
    """Whether the channel behind the colours is the composite's transparency, not a saved selection: the number of
    layers is below 0 then. Without layers its name says it (channel), which Photoshop writes; programs that write four
    channels alone mean it so."""
    length_bytes = 8 if header.large else 4
    start, end = _skipped(file, length_bytes, size, path)
    transparent = not channel or channel.startswith(b"Transparency")
    if end - start >= length_bytes + 2:
        file.seek(start + length_bytes)
        transparent = int.from_bytes(file.read(2), "big", signed=True) < 0
    file.seek(end)
    return transparent


def _planes(file: BinaryIO, header: _PsdHeader, size: int, path: Path) -> list[np.ndarray]:
    """At most four [H, W] channels as stored."""
    kind = int.from_bytes(file.read(2), "big")
    channel_count = min(header.channels, 4 if header.mode == RGB_MODE else 2)
    row_bytes = header.width * header.bits // 8
    rest = size - file.tell()
    dtype = np.dtype(np.uint8 if header.bits == 8 else ">u2")
    # Raw: channel after channel, all rows.
    if kind == 0:
        needed = channel_count * header.height * row_bytes
        if rest < needed:
            raise ValueError(f"{path}: damaged PSD (its flattened picture has {rest} bytes of {needed})")
        data = np.frombuffer(file.read(needed), dtype)
        return list(data.reshape(channel_count, header.height, header.width))
    if kind in (2, 3):
        return _inflated(file.read(rest), channel_count, header, dtype, kind == 3, path)
    if kind != 1:
        raise ValueError(f"{path}: damaged PSD (its flattened picture is packed by method {kind}, which there is not)")
    count_bytes = 4 if header.large else 2
    table = file.read(header.channels * header.height * count_bytes)
    if len(table) < header.channels * header.height * count_bytes:
        raise ValueError(f"{path}: damaged PSD (its table of rows is cut off)")
    lengths = np.frombuffer(table, f">u{count_bytes}").astype(np.int64)[: channel_count * header.height]
    if int(lengths.sum()) > size - file.tell():
        raise ValueError(f"{path}: damaged PSD (its flattened picture is cut off)")
    # A bomb would claim large rows and give few bytes: PackBits cannot expand by more than 64.
    if int(lengths.sum()) * 128 < channel_count * header.height * row_bytes:  # PackBits makes 128 bytes of 2
        raise ValueError(f"{path}: damaged PSD (its rows are too short for {header.width} pixels)")
    out = np.zeros((channel_count * header.height, row_bytes), np.uint8)
    for row, length in zip(out, lengths.tolist(), strict=True):
        _unpack(file.read(length), row, path)
    return [plane.reshape(header.height, -1).view(dtype) for plane in np.split(out, channel_count)]


def _inflated(
    packed: bytes, channel_count: int, header: _PsdHeader, dtype: np.dtype, predicted: bool, path: Path
) -> list[np.ndarray]:
    """Channels that are one zlib stream; predicted: each value but a row's first as the difference to the one before
    it. Raises ValueError: damaged, or less than the channels."""
    shape = (channel_count, header.height, header.width)
    needed = math.prod(shape) * dtype.itemsize
    stream = zlib.decompressobj()
    try:
        data = stream.decompress(packed, needed)
        stream.decompress(stream.unconsumed_tail, 1)  # the sum of what it holds comes last
    except zlib.error as error:
        raise ValueError(f"{path}: damaged PSD (its flattened picture: {error})") from None
    if len(data) < needed or (len(data) == needed and not stream.eof and header.channels == channel_count):
        raise ValueError(f"{path}: damaged PSD (its flattened picture has {len(data)} bytes of {needed})")
    planes = np.frombuffer(data, dtype).reshape(shape)
    if predicted:
        planes = np.cumsum(planes, axis=2, dtype=dtype.newbyteorder("="))
    return list(planes)


def _unpack(packed: bytes, row: np.ndarray, path: Path) -> None:
    """PackBits (TIFF 6.0, section 9) of one row into [B] uint8. Raises ValueError: more or less than the row."""
    at, filled, end, size = 0, 0, len(packed), len(row)
    while at < end and filled < size:
        code = packed[at]
        at += 1
        if code < 128:
            # 0 to 127: so many bytes and one more as they are; 129 to 255: one byte repeated; 128: nothing.
            piece = packed[at : at + code + 1]
            if filled + len(piece) > size or len(piece) <= code:
                break
            row[filled : filled + len(piece)] = np.frombuffer(piece, np.uint8)
            at += code + 1
            filled += code + 1
        elif code > 128:
            if at >= end or filled + 257 - code > size:
                break
            row[filled : filled + 257 - code] = packed[at]
            at += 1
            filled += 257 - code
    if filled != size:
        raise ValueError(f"{path}: damaged PSD (a row of {size} bytes unpacks to another number)")


def holds_merged(path: Path) -> bool:
    """Whether a file is a zip with a flattened picture in it."""
    if not is_zip(path):
        return False
    try:
        with open(path, "rb") as file:
            return any(entry.filename == MERGED for entry in zip_directory(file, path))
    except ValueError:
        return False


def merged_png(path: Path) -> bytes:
    """The flattened picture of an OpenRaster or Krita file. Raises ValueError: none in it, damaged, too large."""
    import zipfile
    import zlib

    with open(path, "rb") as file:
        # The directory is walked by our own bounded reader before zipfile sees the file.
        entries = [entry for entry in zip_directory(file, path) if entry.filename == MERGED]
        if not entries:
            raise ValueError(
                f"{path}: expected a picture, or an OpenRaster or Krita file with {MERGED} in it; export it as PNG"
            )
        if entries[0].file_size > MAX_MERGED_BYTES:
            raise ValueError(f"{path}: {MERGED} in it claims more than {MAX_MERGED_BYTES >> 20} MiB; export it as PNG")
        try:
            with zipfile.ZipFile(file) as archive, archive.open(entries[0]) as member:
                data = member.read(MAX_MERGED_BYTES + 1)
        except (zipfile.BadZipFile, zlib.error, OSError, RuntimeError, EOFError, ValueError) as error:
            reason = " ".join(str(error).split())[:80]
            raise ValueError(f"{path}: damaged: {MERGED} in it cannot be read ({reason})") from None
    if not data.startswith(PNG_MAGIC):  # a zip in a zip might hold itself
        raise ValueError(f"{path}: expected a PNG as {MERGED} in it, got another kind of file")
    if len(data) > MAX_MERGED_BYTES:
        raise ValueError(f"{path}: {MERGED} in it is larger than {MAX_MERGED_BYTES >> 20} MiB; export it as PNG")
    return data
