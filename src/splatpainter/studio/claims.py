"""What uploaded bytes claim to be (kind, pixels, rows), from headers alone: nothing is decoded to find out."""

from __future__ import annotations

import json
import struct
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatpainter.io import detect
from splatpainter.io.bounded import Gunzip
from splatpainter.io.files import read_head, reading
from splatpainter.sources.pictures import KINDS, LIMIT

Kind = Literal["picture", "asset", "project", "layer"]
SQLITE, ZIP = b"SQLite format 3\0", b"PK\x03\x04"
MEDIA = {"PNG": "image/png", "JPEG": "image/jpeg", "WEBP": "image/webp", "TIFF": "image/tiff"}
ENDINGS = {"PNG": ".png", "JPEG": ".jpg", "WEBP": ".webp", "TIFF": ".tif"}
MAX_META_BYTES = 1 << 20
"""Of a SOG bundle's meta.json, unpacked."""
MAX_GLB_JSON_BYTES = 16 << 20
"""Of a GLB's JSON chunk."""
MAX_ZIP_DIRECTORY_BYTES = 4 << 20
"""Of a zip archive's directory; an entry of it takes 46 bytes and its name, and half a kilobyte of memory."""
ZIP_TAIL_BYTES = 65_557 + 20
"""In which a zip archive's end record lies, and what locates its 64-bit form before it."""


@dataclass(frozen=True)
class Claim:
    """What a file says of itself."""

    kind: Kind
    ending: str
    """File name ending that fits the content."""
    media: str
    """Content type that it is served with; of pictures only, for nothing else may be opened by a browser."""
    width: int = 0
    height: int = 0
    rows: int = 0


def claim_of(path: Path, name: str, most_rows: int) -> Claim:
    """Judge the file at `path`; `name` is what its owner called it (splat formats without a magic need its ending).
    Raises ValueError: neither picture, splat file nor project, or more pixels or rows than are allowed."""
    head = read_head(path, 16)
    if head == SQLITE:
        return Claim("project", ".splatproj", "application/octet-stream")
    picture = _picture(path, name)
    if picture is not None:
        return picture
    if head[:4] == ZIP and _is_layer(path):
        return Claim("layer", ".splatlayer", "application/octet-stream")
    shown = name or "the upload"
    key = _detected(path, name)
    if key is None:
        raise ValueError(f"{shown}: expected a picture (PNG, JPEG, WebP, TIFF), a splat file or a project")
    from splatpainter.io import FORMATS

    try:
        rows = _rows(path, key)
        if rows < 0:
            raise ValueError(f"{rows} rows")
    except Exception as error:  # readers of damaged files raise anything
        said = " ".join(str(error).replace(str(path), shown).split()) or type(error).__name__
        raise ValueError(f"{shown}: damaged ({said.removeprefix(f'{shown}: ')[:200]})") from None
    if rows > most_rows:
        raise ValueError(f"{shown}: expected at most {most_rows:,} rows, it claims {rows:,}")
    return Claim("asset", FORMATS[key].suffixes[0], "application/octet-stream", rows=rows)


def _is_layer(path: Path) -> bool:
    try:
        with _zip(path) as archive:
            return "layer.json" in archive.namelist()
    except Exception:  # readers of damaged files raise anything; `_rows` says what is wrong
        return False


def _zip(path: Path) -> zipfile.ZipFile:
    """The archive. Raises ValueError where its directory is longer than any that we know what to do with."""
    size = path.stat().st_size
    with reading(path) as file:
        file.seek(max(size - ZIP_TAIL_BYTES, 0))
        tail = file.read(ZIP_TAIL_BYTES)
        end = tail.rfind(b"PK\5\6")
        if end < 0 or len(tail) < end + 22:
            raise ValueError("no zip directory")
        length = struct.unpack_from("<I", tail, end + 12)[0]
        if end >= 20 and tail[end - 20 : end - 16] == b"PK\6\7":
            file.seek(min(struct.unpack_from("<Q", tail, end - 12)[0], size))
            record = file.read(56)
            length = struct.unpack_from("<Q", record, 40)[0] if len(record) == 56 else size
    if length > MAX_ZIP_DIRECTORY_BYTES:
        raise ValueError(f"a zip directory of {length} bytes")
    return zipfile.ZipFile(path)


def _detected(path: Path, name: str) -> str | None:
    """Key of the format by content, or by the ending for the two formats that have no magic."""
    try:
        return detect(path)
    except Exception:  # of a damaged file
        return {".splat": "splat", ".ksplat": "ksplat"}.get(Path(name.lower()).suffix)


def _picture(path: Path, name: str) -> Claim | None:
    from PIL import Image, UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own size warning: judged here
        try:
            with Image.open(path, formats=KINDS) as image:
                width, height, kind = image.width, image.height, str(image.format)
        except UnidentifiedImageError:
            return None
        except Image.DecompressionBombError:
            raise ValueError(f"{name or 'picture'}: expected at most {LIMIT // 10**6} megapixels") from None
        except Exception as error:  # decoders of damaged files raise anything
            raise ValueError(f"{name or 'picture'}: cannot be read as a picture ({str(error)[:120]})") from None
    if width * height > LIMIT:
        raise ValueError(f"{name or 'picture'}: expected at most {LIMIT // 10**6} megapixels, got {width}x{height}")
    return Claim("picture", ENDINGS[kind], MEDIA[kind], width, height)


def _rows(path: Path, key: str) -> int:
    """Rows that the header speaks of."""
    size = path.stat().st_size
    if key in ("ply", "compressed.ply"):
        from splatpainter.io.ply_header import read_header

        with reading(path) as file:
            vertex = read_header(file, path).element("vertex")
        return 0 if vertex is None else vertex.count
    if key == "splat":
        return size // 32
    if key == "ksplat":
        return struct.unpack_from("<I", read_head(path, 20), 16)[0]
    if key == "spz":
        head = read_head(path, 4096)
        if head[:2] == b"\x1f\x8b":
            head = Gunzip(head, path).take(16, "the header")
        return struct.unpack_from("<I", head, 8)[0]
    if key == "sog":
        with _zip(path) as archive:
            entry = archive.getinfo("meta.json")
            # Others unpack a whole piece of the archive at once, whatever it is asked for.
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("its meta.json is packed otherwise than by deflate")
            with archive.open(entry) as member:
                text = member.read(MAX_META_BYTES + 1)
            if len(text) > MAX_META_BYTES:
                raise ValueError("its meta.json is too long")
            return int(json.loads(text)["count"])
    head = read_head(path, 20)
    length = struct.unpack_from("<I", head, 12)[0]
    if length > size - 20:
        raise ValueError("its JSON chunk is cut off")
    if length > MAX_GLB_JSON_BYTES:
        raise ValueError(f"its JSON chunk has {length} bytes")
    text = read_head(path, 20 + length)[20:]
    counts = [int(entry.get("count", 0)) for entry in json.loads(text).get("accessors", [])]
    return max(counts, default=0)
