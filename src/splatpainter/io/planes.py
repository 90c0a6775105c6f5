"""Small images that carry numbers: their size before decoding, their pixels, and lossless WebP. Knows no splats."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np

from splatpainter.io.files import printable


def size(data: bytes, where: Path | str) -> tuple[int, int]:
    """Width and height in pixels from the header of a WebP or PNG file; nothing is decoded.

    Pillow allocates a WebP canvas when it opens the file, so the size has to be known before that.
    """
    try:
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            kind = data[12:16]
            if kind == b"VP8L" and data[20] == 0x2F:
                (bits,) = struct.unpack_from("<I", data, 21)
                return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
            if kind == b"VP8X":
                width, high, height, top = struct.unpack_from("<HBHB", data, 24)
                return (width | high << 16) + 1, (height | top << 16) + 1
            if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
                width, height = struct.unpack_from("<HH", data, 26)
                return width & 0x3FFF, height & 0x3FFF
        elif data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
    except (struct.error, IndexError):
        raise ValueError(f"{where}: truncated image") from None
    raise ValueError(f"{where}: expected a WebP or PNG image, found {bytes(data[:12])!r}")


def decode(data: bytes, where: Path | str) -> np.ndarray:
    """[height, width, 4] uint8 RGBA. The caller has judged `size`. Raises ValueError where the image is damaged."""
    from PIL import Image

    expected = size(data, where)
    try:
        with warnings.catch_warnings():
            # Sizes were judged against the row count; Pillow's own limit is for pictures.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                if image.size != expected:
                    raise ValueError(f"its header says {expected}, its content {image.size} pixels")
                return np.asarray(image.convert("RGBA"))
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        RuntimeError,
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        struct.error,
        zlib.error,
        Image.DecompressionBombError,
    ) as error:  # Pillow's parsers of damaged chunks raise all of these
        raise ValueError(f"{where}: damaged image ({printable(' '.join(str(error).split()), 120)})") from None


def encode(pixels: np.ndarray) -> bytes:
    """[height, width, 4] uint8 -> lossless WebP that gives back every byte."""
    from PIL import Image

    out = io.BytesIO()
    # exact: WebP otherwise rewrites the colour of pixels whose alpha is 0, and here those bytes are data.
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, "WEBP", lossless=True, exact=True, quality=60, method=3)
    return out.getvalue()
