"""SOG: meta.json bent as a tree, planes as pictures of other sizes and as bytes, and a zip whose directory lies."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from dataclasses import dataclass
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
from PIL import Image

from splatpainter.io import write
from splatpainter.splats import Splats
from tests.support.io_assets import random_splats

from .mutations import INTEGERS, bend_bytes, bend_integer, bend_json, bend_list, few, json_bytes, maybe
from .reader_oracle import FileTarget

NAMES = (
    b"",
    b"../x",
    b"/etc/x",
    b"a\\b",
    b"meta.json",
    b"META.JSON",
    b"x/",
    b"\xff\xfe",
    b"a\x00b",
    b"con",
    b".",
    b"..",
)
NAMES += (b"a" * 300, b"means_l.webp", b"C:x", "é".encode(), b"\x1b[2J", b"extra/note.txt")


@dataclass(frozen=True)
class Entry:
    """A file of a zip, and what its headers say of it. None: the truth."""

    name: bytes
    data: bytes
    method: int = 0
    flags: int = 0
    says_size: int | None = None
    says_packed: int | None = None
    says_crc: int | None = None
    says_method: int | None = None
    extra: bytes = b""
    offset: int | None = None
    only_central: bool = False
    """The lies stand in the directory only, not in the file's own header."""


class SogFolderTarget(FileTarget):
    """A folder with meta.json and its planes."""

    entry = "meta.json"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds = [sog_files(folder, random_splats(5, degree, degree, log_scale=-2)) for degree in (0, 1, 2)]

    def make(self, rng: random.Random) -> dict[str, bytes]:
        files = self.bent_files(rng)
        return {name: data for name, data in files.items() if name.isprintable() and "/" not in name}

    def check_saved(self, splats: Splats, files: dict[str, bytes], back: Path) -> None:
        for old in back.iterdir():
            old.unlink()
        write(back / "meta.json", splats, overwrite=True)
        for path in back.iterdir():
            assert path.read_bytes() == (self.folder / path.name).read_bytes(), path.name

    def bent_files(self, rng: random.Random) -> dict[str, bytes]:
        files = dict(rng.choice(self.seeds))
        if maybe(rng, 0.6):
            meta = bend_json(rng, json.loads(files["meta.json"]), (*files, 5, 6, [0, 1]))
            files["meta.json"] = json_bytes(rng, meta)
        if maybe(rng, 0.5):
            name = rng.choice([name for name in files if name != "meta.json"])
            files[name] = bend_plane(rng, files[name])
        if maybe(rng, 0.1):
            one, two = rng.choice(list(files)), rng.choice(list(files))
            files[one] = files[two]
        return files


class SogTarget(SogFolderTarget):
    """A bundle."""

    entry = "a.sog"

    def make(self, rng: random.Random) -> dict[str, bytes]:
        entries = [Entry(name.encode(errors="replace"), data) for name, data in self.bent_files(rng).items()]
        if maybe(rng, 0.3):
            entries = [changed(entry, method=8) for entry in entries]
        for _ in range(few(rng, 3) if maybe(rng, 0.5) else 0):
            at = rng.randrange(len(entries))
            entries[at] = self._lie(rng, entries[at])
        if maybe(rng, 0.1):
            entries = bend_list(rng, entries) or entries
        if maybe(rng, 0.1):
            entries.append(Entry(rng.choice(NAMES), rng.randbytes(3)))
        data = pack_zip(rng, entries)
        return {"a.sog": bend_bytes(rng, data) if maybe(rng, 0.15) else data}

    def _lie(self, rng: random.Random, entry: Entry) -> Entry:
        size, kind = len(entry.data), rng.randrange(11)
        only = maybe(rng, 0.5)
        if kind == 0:
            return changed(entry, says_size=bend_integer(rng, size) & 0xFFFFFFFF, only_central=only)
        if kind == 1:
            return changed(entry, says_packed=bend_integer(rng, size) & 0xFFFFFFFF, only_central=only)
        if kind == 2:
            return changed(entry, says_crc=rng.choice(INTEGERS) & 0xFFFFFFFF)
        if kind == 3:
            return changed(entry, says_method=rng.choice((1, 6, 8, 9, 12, 14, 93, 97, 99, 65535)), only_central=only)
        if kind == 4:
            return changed(entry, flags=rng.choice((1, 8, 0x40, 0x800, 0x2000, 0xFFFF)))
        if kind == 5:
            return changed(entry, name=rng.choice(NAMES))
        if kind == 6:
            zip64 = struct.pack("<HHQQQ", 1, 24, *(rng.choice(INTEGERS) % 2**64 for _ in range(3)))
            return changed(
                entry, extra=rng.choice((zip64, b"\x01\x00\xff\xff", rng.randbytes(7))), says_size=0xFFFFFFFF
            )
        if kind == 7:
            return changed(entry, offset=rng.choice(INTEGERS) & 0xFFFFFFFF)
        if kind == 8:  # much more than it says
            more = bytes(rng.choice((1000, 70_000, 1 << 20, 24 << 20)) if maybe(rng, 0.3) else 1000)
            return changed(entry, data=entry.data + more, method=8, says_size=size)
        if kind == 9:
            return changed(entry, method=rng.choice((12, 14)), only_central=only)
        return changed(entry, method=8)

    def check_saved(self, splats: Splats, files: dict[str, bytes], back: Path) -> None:
        FileTarget.check_saved(self, splats, files, back)


def sog_files(folder: Path, splats: Splats) -> dict[str, bytes]:
    """The files of a sound asset, meta.json first."""
    path = folder / "seed.sog"
    write(path, splats, overwrite=True)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    path.unlink()
    return dict(sorted(files.items(), key=lambda item: item[0] != "meta.json"))


def bend_plane(rng: random.Random, data: bytes) -> bytes:
    """Another size, another mode, another format, other pixels, or damaged bytes."""
    kind = rng.randrange(6)
    if kind == 0:
        return bend_bytes(rng, data)
    if kind == 1:
        return bend_bytes(rng, data, 0, 40)
    with Image.open(io.BytesIO(data)) as image:
        pixels = np.array(image.convert("RGBA"))
    if kind == 2:
        pixels[rng.randrange(pixels.shape[0]), rng.randrange(pixels.shape[1])] = rng.choice((0, 255, 252, 128))
    elif kind == 3:
        height, width = (rng.choice((1, 2, 3, 64, 192, 512, 1000)) for _ in range(2))
        pixels = np.resize(pixels, (height, width, 4))
    out = io.BytesIO()
    made = Image.fromarray(pixels)
    if kind == 4:
        made = made.convert(rng.choice(("L", "RGB", "P", "1", "LA", "I;16" if maybe(rng, 0.5) else "RGB")))
    if maybe(rng, 0.5) or made.mode not in ("RGB", "RGBA"):
        made.save(out, "PNG", compress_level=1)
    else:
        made.save(out, "WEBP", lossless=maybe(rng, 0.7), exact=True, quality=10, method=0)
    return out.getvalue()


def pack_zip(rng: random.Random, entries: list[Entry]) -> bytes:
    """A zip file of the entries; at times its end record lies, too."""
    out, central = b"", b""
    for entry in entries:
        packed = entry.data
        if entry.method == 8:
            squeeze = zlib.compressobj(1, zlib.DEFLATED, -15)
            packed = squeeze.compress(entry.data) + squeeze.flush()
        elif entry.method in (12, 14):
            small = io.BytesIO()
            with zipfile.ZipFile(small, "w", entry.method) as archive:
                archive.writestr("a", entry.data)
            size = zipfile.ZipFile(small).infolist()[0].compress_size
            packed = small.getvalue()[31 : 31 + size]
        truth = (entry.method, zlib.crc32(entry.data), len(packed), len(entry.data))
        lies = (entry.says_method, entry.says_crc, entry.says_packed, entry.says_size)
        claims = tuple(t if lie is None else lie for t, lie in zip(truth, lies, strict=True))
        for central_one, (method, crc, packed_size, size) in (
            (False, truth if entry.only_central else claims),
            (True, claims),
        ):
            common = struct.pack("<HHHHHIIIHH", 20, entry.flags, method, 0, 0x21, crc, packed_size, size,
                                 len(entry.name), len(entry.extra))  # fmt: skip
            if central_one:
                offset = len(out) if entry.offset is None else entry.offset
                central += struct.pack("<IH", 0x02014B50, 20) + common + struct.pack("<HHHII", 0, 0, 0, 0, offset)
                central += entry.name + entry.extra
            else:
                start = struct.pack("<I", 0x04034B50) + common + entry.name + entry.extra + packed
        out += start
    ends = [0, 0, len(entries), len(entries), len(central), len(out)]
    if maybe(rng, 0.06):
        at = rng.randrange(6)
        ends[at] = bend_integer(rng, ends[at]) & (0xFFFF if at < 4 else 0xFFFFFFFF)
    comment = b"note" if maybe(rng, 0.05) else b""
    return out + central + struct.pack("<I4HIIH", 0x06054B50, *ends, len(comment)) + comment


TARGETS = {"sog": SogTarget, "sog-folder": SogFolderTarget}
