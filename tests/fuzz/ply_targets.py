"""PLY in all its forms: binary of both byte orders, text, and PlayCanvas' compressed one. Headers are bent as lines,
rows as numbers or tokens."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np

from tests.support.io_assets import random_splats, written

from .mutations import FLOATS, INTEGERS, TOKENS, bend_bytes, bend_floats, bend_integer, bend_list, few, maybe
from .reader_oracle import FileTarget

TYPES = (b"char", b"uchar", b"short", b"ushort", b"int", b"uint", b"float", b"double", b"int8", b"float64", b"half")
LINES = (
    b"comment SplatRenderMode: mip",
    b"comment SplatColorSpace: linear",
    b"comment antialiased 1",
    b"comment \xff\xfe\x00\x1b[2J",
    b"comment",
    b"comment " + b"x" * 2000,
    b"obj_info made by hand",
    b"",
    b"element camera 1",
    b"element vertex 3",
    b"element face 2",
    b"property list uchar int vertex_indices",
    b"property list float int broken",
    b"property list int double long",
    b"property list uint uchar bytes",
    b"property uchar red",
    b"property uchar green",
    b"property double extra",
    b"property float f_rest_9",
    b"property float f_rest_00",
    b"property float x\x1b[2J",
    b"property float",
    b"property",
    b"element",
    b"end_header",
    b"ply",
    b"format binary_big_endian 1.0",
    b"format ascii 1.0",
    b"format binary_middle_endian 1.0",
    b"format",
    b"\xa0\x85comment",
)


class PlyTarget(FileTarget):
    """Binary PLY of both byte orders, with elements around the vertices."""

    file = "a.ply"

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.seeds = self.build()

    def build(self) -> list[tuple[list[bytes], bytes]]:
        """(header lines, body) of sound files."""
        out = [
            split(written(self.folder, "a.ply", random_splats(8, degree, degree, log_scale=-2)))
            for degree in (0, 1, 2, 3)
        ]
        head, body = out[1]
        swapped = [line.replace(b"little", b"big") for line in head]
        out.append((swapped, np.frombuffer(body, "<u4").astype(">u4").tobytes()))
        ahead = [*head[:2], b"comment by hand", b"element camera 2", b"property double fov", b"property uchar kind"]
        behind = [b"element face 2", b"property list uchar int vertex_indices", b"property float area"]
        lists = b"\3" + bytes(12) + b"\0\0\x80\x3f" + b"\0" + b"\0\0\x80\x3f"
        out.append(([*ahead, *head[2:-1], *behind, head[-1]], bytes(18) + body + lists + b"tail"))
        out.append(self._mixed())
        return out

    def _mixed(self) -> tuple[list[bytes], bytes]:
        """Doubles, colours in place of f_dc_*, an extra integer."""
        source = random_splats(6, 0, 5, log_scale=-2)
        kinds = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("label", "<i2"), ("red", "u1"), ("green", "u1")]
        kinds += [("blue", "u1"), ("opacity", "<f4")]
        kinds += [(f"scale_{k}", "<f4") for k in range(3)] + [(f"rot_{k}", "<f4") for k in range(4)]
        table = np.zeros(6, kinds)
        for k, axis in enumerate("xyz"):
            table[axis] = source.means[:, k]
        table["red"], table["green"], table["label"] = range(0, 60, 10), 200, range(6)
        for k in range(3):
            table[f"scale_{k}"] = np.log(source.scales[:, k])
        for k in range(4):
            table[f"rot_{k}"] = source.quats[:, k]
        names = {"<f8": "double", "<f4": "float", "u1": "uchar", "<i2": "short"}
        lines = ["ply", "format binary_little_endian 1.0", "element vertex 6"]
        lines += [*(f"property {names[kind]} {name}" for name, kind in kinds), "end_header"]
        return [line.encode() for line in lines], table.tobytes()

    def make(self, rng: random.Random) -> dict[str, bytes]:
        head, body = rng.choice(self.seeds)
        if maybe(rng, 0.6):
            head = bend_header(rng, head)
        if maybe(rng, 0.5):
            body = self.bend_body(rng, body)
        newline = rng.choice((b"\r\n", b"\r", b"\n\r")) if maybe(rng, 0.06) else b"\n"
        data = newline.join(head) + newline + body
        if maybe(rng, 0.1):
            data = bend_bytes(rng, data, 0, len(data) - len(body))
        return {self.file: data}

    def bend_body(self, rng: random.Random, body: bytes) -> bytes:
        kind = rng.randrange(4)
        if kind == 0:
            return bend_bytes(rng, body)
        if kind == 1:
            return body + rng.randbytes(rng.choice((1, 4, 100)))
        return bend_floats(rng, body, rng.choice("<>"))


class TextPlyTarget(PlyTarget):
    """PLY in words."""

    def build(self) -> list[tuple[list[bytes], bytes]]:
        out = []
        for degree in (0, 1, 3):
            head, body = split(written(self.folder, "a.ply", random_splats(5, degree, degree, log_scale=-2)))
            head = [line.replace(b"binary_little_endian", b"ascii") for line in head]
            table = np.frombuffer(body, "<f4").reshape(5, -1)
            out.append((head, b"".join(b" ".join(repr(float(x)).encode() for x in row) + b"\n" for row in table)))
        head, body = out[0]
        camera = [b"element camera 1", b"property float fov"]
        out.append(([*head[:2], *camera, *head[2:]], b"42\n" + body))
        face = [b"element face 1", b"property list uchar int vertex_indices"]
        out.append(([*head[:-1], *face, head[-1]], body + b"3 0 1 2\nmore\n"))
        return out

    def bend_body(self, rng: random.Random, body: bytes) -> bytes:
        for _ in range(few(rng)):
            lines = body.split(b"\n")
            kind = rng.randrange(6)
            if kind == 0:
                lines = bend_list(rng, lines)
            elif kind == 1:
                lines.insert(rng.randrange(len(lines) + 1), rng.choice((b"", b" ", b"\t", b"0", b"# no comment")))
            elif kind == 2:
                return bend_bytes(rng, body)
            else:
                row = rng.randrange(len(lines))
                words = lines[row].split(b" ")
                words[rng.randrange(len(words))] = rng.choice((*TOKENS, *(repr(x).encode() for x in FLOATS)))
                if kind == 3:
                    words = bend_list(rng, words)
                lines[row] = rng.choice((b" ", b"  ", b"\t")).join(words)
            body = b"\n".join(lines)
        return body.replace(b"\n", b"\r\n") if maybe(rng, 0.05) else body


class CompressedPlyTarget(PlyTarget):
    """Chunks with ranges, packed words, SH as bytes."""

    file = "a.compressed.ply"

    def build(self) -> list[tuple[list[bytes], bytes]]:
        made = [
            written(self.folder, self.file, random_splats(count, degree, log_scale=-2))
            for count, degree in ((4, 0), (6, 1), (300, 0))
        ]
        out = [split(data) for data in made]
        head, body = out[0]
        plain = [line for line in head if not line.endswith((b"_r", b"_g", b"_b"))]
        out.append((plain, body[:48] + body[72:]))  # an older file without colour ranges
        extra = [*head[:-1], b"element note 2", b"property uchar letter", head[-1]]
        out.append((extra, body + b"hi" + b"tail"))
        return out

    def bend_body(self, rng: random.Random, body: bytes) -> bytes:
        if maybe(rng, 0.5):
            return bend_floats(rng, body[:72], "<") + body[72:]
        return super().bend_body(rng, body)


def split(data: bytes) -> tuple[list[bytes], bytes]:
    """(header lines, body) of a PLY file with LF header."""
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return data[:end].split(b"\n")[:-1], data[end:]


def bend_header(rng: random.Random, lines: list[bytes]) -> list[bytes]:
    """Some lines of a header changed: counts, types, names, order, and lines that should not be there."""
    out = list(lines)
    for _ in range(few(rng)):
        if not out:
            break
        at = rng.randrange(len(out))
        words = out[at].split(b" ")
        kind = rng.randrange(8)
        counted = [k for k, line in enumerate(out) if line.startswith(b"element ") and line.count(b" ") == 2]
        if kind in (0, 1) and counted:
            at = rng.choice(counted)
            words = out[at].split(b" ")
            count = int(words[2]) if words[2].isdigit() else 0
            words[2] = str(bend_integer(rng, count)).encode() if kind else str(rng.choice(INTEGERS)).encode()
            out[at] = b" ".join(words)
        elif kind == 2 and words[0] == b"property" and len(words) > 1:
            words[1] = rng.choice(TYPES)
            out[at] = b" ".join(words)
        elif kind == 3:
            out = bend_list(rng, out)
        elif kind == 4:
            out.insert(rng.randrange(1, len(out) + 1), rng.choice(LINES))
        elif kind == 5:
            words[rng.randrange(len(words))] = rng.choice((*TOKENS, b"x", b"scale_0", b"list", b"vertex", b"chunk"))
            out[at] = b" ".join(words)
        elif kind == 6 and words[0] == b"property":
            middle = [line for line in out if line.startswith(b"property")]
            rng.shuffle(middle)
            fresh = iter(middle)
            out = [next(fresh) if line.startswith(b"property") else line for line in out]
        elif kind == 7:
            block = [b"element extra%d %d" % (rng.randrange(3), rng.choice((0, 1, 2, 10**6)))]
            block += [rng.choice(LINES[11:18]) for _ in range(rng.randrange(3))]
            index = rng.choice([*counted, max(len(out) - 1, 0)])
            out[index:index] = block
    return out


TARGETS = {"ply": PlyTarget, "text-ply": TextPlyTarget, "compressed-ply": CompressedPlyTarget}
