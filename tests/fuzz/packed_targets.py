"""Formats of packed words: .splat, .ksplat, SPZ (bent inside its gzip and zstd streams), GLB (JSON tree and chunks)."""

from __future__ import annotations

import gzip
import json
import random
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import zstandard

from splatpainter.io.formats.spz import write_spz
from tests.support.io_assets import random_splats, written

from .mutations import INTEGERS, bend_bytes, bend_fields, bend_floats, bend_integer, bend_json, few, json_bytes, maybe
from .reader_oracle import FileTarget


class SplatTarget(FileTarget):
    """No header: rows of 32 bytes."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds = [written(folder, "a.splat", random_splats(count, 0, log_scale=-2)) for count in (1, 8, 40)]

    def make(self, rng: random.Random) -> dict[str, bytes]:
        data = rng.choice(self.seeds)
        kind = rng.randrange(4)
        if kind == 0:
            data = data[: rng.randrange(len(data) + 1)]
        elif kind == 1:
            data = rng.choice((b"PK\x03\x04", b"glTF", b"NGSP", b"ply\n", b"\x1f\x8b", b"SQLite format 3\0")) + data
        data = bend_floats(rng, data) if maybe(rng, 0.5) else bend_bytes(rng, data)
        return {"a.splat": data}


KSPLAT_HEADER = [
    ("B", 0),
    ("B", 1),
    *(("I", at) for at in (4, 8, 12, 16)),
    ("H", 20),
    *(("f", 24 + 4 * k) for k in range(5)),
]
KSPLAT_SECTION = [
    *(("I", at) for at in (0, 4, 8, 12)),
    ("f", 16),
    ("H", 20),
    *(("I", at) for at in (24, 28, 32, 36)),
    ("H", 40),
]


class KsplatTarget(FileTarget):
    """Header and section headers are bent by field, rows by number."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds = [ksplat(level, degrees) for level in (0, 1, 2) for degrees in ([0], [2], [1, 0])]

    def make(self, rng: random.Random) -> dict[str, bytes]:
        data, sections = rng.choice(self.seeds)
        body = 4096 + 1024 * sections
        if maybe(rng, 0.3):
            data = bend_fields(rng, data, KSPLAT_HEADER)
        if maybe(rng, 0.5):
            base = 4096 + 1024 * rng.randrange(sections)
            data = bend_fields(rng, data, [(code, base + at) for code, at in KSPLAT_SECTION])
        if maybe(rng, 0.4):
            data = data[:body] + bend_floats(rng, data[body:])
        if maybe(rng, 0.3):
            data = data[:body] + bend_bytes(rng, data[body:])
        if maybe(rng, 0.04):
            data = data[: rng.randrange(len(data) + 1)]
        return {"a.ksplat": data}


def ksplat(level: int, degrees: list[int]) -> tuple[bytes, int]:
    """(file, sections): each section has 7 rows, in one full bucket of 4 and a partly filled one."""
    rng = np.random.default_rng(level)
    heads, bodies = b"", b""
    for degree in degrees:
        real = "<f2" if level else "<f4"
        body = struct.pack("<I", 3) + rng.normal(0, 3, (2, 3)).astype("<f4").tobytes() if level else b""
        for _ in range(7):
            position = rng.integers(0, 65536, 3).astype("<u2") if level else rng.normal(0, 1, 3).astype("<f4")
            body += position.tobytes() + np.exp(rng.normal(-2, 1, 3)).astype(real).tobytes()
            body += rng.normal(0, 1, 4).astype(real).tobytes() + rng.bytes(4)
            rest = rng.normal(0, 0.3, 3 * (degree + 1) ** 2 - 3)
            body += rng.bytes(len(rest)) if level == 2 else rest.astype(real).tobytes()
        head = bytearray(1024)
        buckets = [4, 2, 5.0, 12, 32767, 1, 1] if level else [0, 0, 0.0, 0, 0, 0, 0]
        struct.pack_into("<4IfH", head, 0, 7, 7, buckets[0], buckets[1], buckets[2], buckets[3])
        struct.pack_into("<4IH", head, 24, buckets[4], len(body), buckets[5], buckets[6], degree)
        heads, bodies = heads + bytes(head), bodies + body
    header = bytearray(4096)
    total = 7 * len(degrees)
    struct.pack_into("<2B2x4IH", header, 0, 0, 1, len(degrees), len(degrees), total, total, level)
    return bytes(header) + heads + bodies, len(degrees)


SPZ_FIELDS = [("I", 0), ("I", 4), ("I", 8), ("B", 12), ("B", 13), ("B", 14), ("B", 15)]
EXTENSIONS = (0xADBE0002, 0xADBE0003, 1, 0xFFFFFFFF)


class SpzTarget(FileTarget):
    """Versions 1-3 are bent inside their gzip stream and around it, version 4 in header, table and zstd frames."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.payloads: list[bytes] = []
        self.plain: list[bytes] = []
        for version, degree in ((2, 0), (2, 1), (3, 0), (3, 3)):
            write_spz(folder / "a.spz", random_splats(6, degree, log_scale=-2), version=version)
            self.payloads.append(gzip.decompress((folder / "a.spz").read_bytes()))
        first = self.payloads[0]  # version 1: half-float positions, 6 bytes a row
        self.payloads.append(first[:4] + struct.pack("<I", 1) + first[8:16] + bytes(36) + first[16 + 54 :])
        for degree in (0, 2, 4):
            write_spz(
                folder / "a.spz", replace(random_splats(6, degree, log_scale=-2), antialiased=degree > 0), version=4
            )
            self.plain.append((folder / "a.spz").read_bytes())

    def make(self, rng: random.Random) -> dict[str, bytes]:
        data = self._gzipped(rng) if maybe(rng, 0.6) else self._streams(rng)
        return {"a.spz": bend_bytes(rng, data) if maybe(rng, 0.1) else data}

    def _gzipped(self, rng: random.Random) -> bytes:
        data = rng.choice(self.payloads)
        if maybe(rng, 0.4):
            data = bend_fields(rng, data, SPZ_FIELDS)
        if maybe(rng, 0.4):
            data = data[:16] + bend_bytes(rng, data[16:])
        if maybe(rng, 0.3):
            data = data[:14] + bytes([data[14] | 2]) + data[15:] + _extensions(rng)
        level = 6 if maybe(rng, 0.1) else 1
        packer = zlib.compressobj(level, zlib.DEFLATED, 31)
        if maybe(rng, 0.02):
            data += bytes(rng.choice((1 << 20, 40 << 20)))
        out = packer.compress(data) + packer.flush()
        kind = rng.randrange(14)
        if kind == 0:
            out += rng.choice((b"tail", out, b"\x1f\x8b", bytes(1000)))
        elif kind == 1:
            out = out[:-8] + struct.pack("<II", rng.choice(INTEGERS) & 0xFFFFFFFF, rng.choice(INTEGERS) & 0xFFFFFFFF)
        elif kind == 2:
            out = out[:3] + b"\x1f" + out[4:]  # flags: name, extra field, comment
        elif kind == 3:
            cut = rng.randrange(len(data) + 1)
            out = gzip.compress(data[:cut], 1, mtime=0) + gzip.compress(data[cut:], 1, mtime=0)
        elif kind == 4:
            out = out[: rng.randrange(len(out) + 1)]
        return out

    def _streams(self, rng: random.Random) -> bytes:
        data = rng.choice(self.plain)
        (streams,), (table,) = struct.unpack_from("<B", data, 15), struct.unpack_from("<I", data, 16)
        entries = [struct.unpack_from("<QQ", data, table + 16 * k) for k in range(streams)]
        at, frames = table + 16 * streams, []
        for packed, _ in entries:
            frames.append(data[at : at + packed])
            at += packed
        sizes = [size for _, size in entries]
        if maybe(rng, 0.4):
            k = rng.randrange(streams)
            frames[k], sizes[k] = self._frame(rng, frames[k], sizes[k])
        extensions = _extensions(rng) if maybe(rng, 0.3) else b""
        header = bytearray(data[:32])
        if extensions:
            header[14] |= 2
            struct.pack_into("<I", header, 16, 32 + len(extensions))
        if maybe(rng, 0.3):
            header = bytearray(bend_fields(rng, bytes(header), [*SPZ_FIELDS, ("I", 16), ("Q", 20)]))
        listed = b"".join(
            struct.pack("<QQ", len(frame), size & (2**64 - 1)) for frame, size in zip(frames, sizes, strict=True)
        )
        if maybe(rng, 0.2):
            listed = bend_fields(rng, listed, [("Q", 8 * k) for k in range(len(listed) // 8)])
        return bytes(header) + extensions + listed + b"".join(frames) + (b"tail" if maybe(rng, 0.1) else b"")

    def _frame(self, rng: random.Random, frame: bytes, size: int) -> tuple[bytes, int]:
        content = zstandard.ZstdDecompressor().decompress(frame, max_output_size=size)
        kind = rng.randrange(7)
        if kind == 0:
            content = bend_bytes(rng, content, moves=False)
        elif kind == 1:
            return zstandard.ZstdCompressor(write_content_size=False).compress(content), size
        elif kind == 2:
            content += bytes(rng.choice((1, 1000, 30 << 20)))
        elif kind == 3:
            return struct.pack("<II", 0x184D2A50, 4) + b"skip" + frame, size
        elif kind == 4:
            return frame + frame, size
        elif kind == 5:
            return bend_bytes(rng, frame), size
        else:
            return frame, bend_integer(rng, size)
        return zstandard.ZstdCompressor(level=1).compress(content), len(content) if maybe(rng, 0.5) else size


def _extensions(rng: random.Random) -> bytes:
    out = b""
    for _ in range(few(rng, 3)):
        body = struct.pack("<I", rng.choice((*range(0, 18), *INTEGERS)) & 0xFFFFFFFF)
        size = len(body) if maybe(rng, 0.8) else rng.choice(INTEGERS) & 0xFFFFFFFF
        out += struct.pack("<II", rng.choice(EXTENSIONS), size) + body
    return out


GLB_HINTS = (0, 1, 2, "KHR_gaussian_splatting", "SCALAR", "VEC3", "VEC4", 5126, 5121, 5123, 5125, [0], [1, 0, 0, 0])
GLB_HINTS += ({"mesh": 0}, {"mesh": 0, "scale": [2, 2, 2]}, {"children": [0]}, "POSITION", "COLOR_0")


class GlbTarget(FileTarget):
    """The JSON chunk is bent as a tree, the binary one as floats, the chunks as chunks."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds: list[tuple[str, bytes]] = []
        for degree in (0, 1, 3):
            data = written(folder, "a.glb", random_splats(4, degree, log_scale=-2))
            size = struct.unpack_from("<I", data, 12)[0]
            self.seeds.append((data[20 : 20 + size].decode(), data[28 + size :]))
        self.seeds += [self._placed(), self._twice()]

    def _placed(self) -> tuple[str, bytes]:
        doc = json.loads(self.seeds[1][0])
        doc["nodes"] = [{"children": [1], "rotation": [0, 0.6, 0, 0.8]}, {"mesh": 0, "scale": [2, 2, 2]}]
        return json.dumps(doc), self.seeds[1][1]

    def _twice(self) -> tuple[str, bytes]:
        doc = json.loads(self.seeds[0][0])
        doc["meshes"][0]["primitives"] *= 2
        doc["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [1, 2, 3]}]
        doc["scenes"] = [{"nodes": [0, 1]}]
        return json.dumps(doc), self.seeds[0][1]

    def make(self, rng: random.Random) -> dict[str, bytes]:
        text, binary = rng.choice(self.seeds)
        bent = json.loads(text)
        if maybe(rng, 0.7):
            bent = bend_json(rng, bent, GLB_HINTS)
        packed = json_bytes(rng, bent)
        packed += b" " * (-len(packed) % 4)
        if maybe(rng, 0.5):
            binary = bend_floats(rng, binary)
        if maybe(rng, 0.1):
            binary = bend_bytes(rng, binary)
        chunks = [(0x4E4F534A, packed), (0x004E4942, binary)]
        if maybe(rng, 0.1):
            chunks.append((0x12345678, rng.randbytes(8)))
        if maybe(rng, 0.05):
            rng.shuffle(chunks)
        body = b"".join(struct.pack("<II", len(part), kind) + part for kind, part in chunks)
        data = struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body + (b"tail" if maybe(rng, 0.1) else b"")
        if maybe(rng, 0.1):
            fields = [("I", 4), ("I", 8), ("I", 12), ("I", 16), ("I", 20 + len(packed)), ("I", 24 + len(packed))]
            data = bend_fields(rng, data, fields)
        return {"a.glb": bend_bytes(rng, data) if maybe(rng, 0.05) else data}


TARGETS = {"splat": SplatTarget, "ksplat": KsplatTarget, "spz": SpzTarget, "glb": GlbTarget}
