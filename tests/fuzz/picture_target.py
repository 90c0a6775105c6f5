"""Pictures with cameras: PNG bent chunk by chunk (checksums mended), other kinds as bytes, sidecars as JSON trees."""

from __future__ import annotations

import contextlib
import io
import json
import random
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from splatpainter.cameras import Camera, look_at
from splatpainter.image_files import CAMERA_KEYWORD
from splatpainter.pictures import edit_from_files
from splatpainter.pictures.edit_files import camera_from
from tests.pictures.test_color_profiles import float_tiff
from tests.pictures.test_layered_files import psd

from .mutations import bend_bytes, bend_integer, bend_json, bend_list, few, json_bytes, maybe
from .target import Fault, Target, Verdict, refusal

MAGIC = b"\x89PNG\r\n\x1a\n"
KINDS = (b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"tRNS", b"gAMA", b"acTL")
KINDS += (b"cICP", b"cHRM", b"sRGB")
NAMES = {"JPEG": "a.jpg", "WEBP": "a.webp", "TIFF": "a.tif", "PSD": "a.psd", "ORA": "a.ora"}


class PictureTarget(Target):
    """An edited picture, at times with a camera file and a mask beside it."""

    name = "picture"
    memory_limit = 1 << 30  # 64 megapixels are allowed, and in float32 they are 768 MB

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.camera = json.loads(look_at((0, 0, 3), (0, 0, 0), width=24, height=16, fov=45).to_json())
        pixels = np.random.default_rng(0).integers(0, 256, (16, 24, 4), np.uint8)
        self.pngs = [self._png(pixels, mode) for mode in ("RGBA", "RGB", "L", "P", "I;16")]
        self.other_pictures = []
        for kind, mode in (("JPEG", "RGB"), ("WEBP", "RGBA"), ("TIFF", "RGB"), ("TIFF", "RGBA"), ("JPEG", "CMYK")):
            out = io.BytesIO()
            Image.fromarray(pixels).convert(mode).save(out, kind)
            self.other_pictures.append((kind, out.getvalue()))
        for layers, large in ((None, False), (-1, False), (None, True)):
            planes = list(np.moveaxis(pixels, -1, 0))
            self.other_pictures.append(("PSD", psd(planes, layers=layers, large=large)))
        merged = io.BytesIO()
        with zipfile.ZipFile(merged, "w") as archive:
            archive.writestr("mergedimage.png", join(self.pngs[0]))
        self.other_pictures.append(("ORA", merged.getvalue()))
        self.other_pictures.append(("TIFF", float_tiff(pixels[..., :3] / 255)))

    def _png(self, pixels: np.ndarray, mode: str) -> list[tuple[bytes, bytes]]:
        out, note = io.BytesIO(), PngImagePlugin.PngInfo()
        note.add_text(CAMERA_KEYWORD, json.dumps(self.camera))
        image = Image.fromarray(pixels)
        if mode == "I;16":
            image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 257)
        else:
            image = image.convert(mode)
        image.save(out, "PNG", pnginfo=note)
        return chunks(out.getvalue())

    def make(self, rng: random.Random) -> dict[str, bytes]:
        files = {}
        if maybe(rng, 0.75):
            files["a.png"] = self._bent_png(rng)
        else:
            kind, data = rng.choice(self.other_pictures)
            files[{"JPEG": "a.jpg", "WEBP": "a.webp", "TIFF": "a.tif", "PSD": "a.psd", "ORA": "a.ora"}[kind]] = (
                bend_bytes(rng, data)
            )
        if maybe(rng, 0.4):
            files["a.json"] = self._camera_text(rng)
        if maybe(rng, 0.2):
            files["mask.png"] = join(rng.choice(self.pngs)) if maybe(rng, 0.5) else self._bent_png(rng)
        return files

    def _camera_text(self, rng: random.Random) -> bytes:
        tree = json.loads(json.dumps(self.camera))
        return json_bytes(rng, bend_json(rng, tree) if maybe(rng, 0.8) else tree)

    def _bent_png(self, rng: random.Random) -> bytes:
        parts = list(rng.choice(self.pngs))
        for _ in range(few(rng, 4)):
            at = rng.randrange(len(parts))
            kind, body = parts[at]
            action = rng.randrange(9)
            if action == 0:
                parts = bend_list(rng, parts) or parts
            elif action == 1:
                parts[at] = rng.choice(KINDS), body
            elif action in (2, 3):
                text = self._camera_text(rng)
                made = (b"tEXt", CAMERA_KEYWORD.encode() + b"\0" + text)
                if maybe(rng, 0.3):
                    large = bytes(rng.choice((0, 0, 1 << 20, 70 << 20))) if maybe(rng, 0.2) else b""
                    made = (b"zTXt", CAMERA_KEYWORD.encode() + b"\0\0" + zlib.compress(text + large, 1))
                elif maybe(rng, 0.2):
                    made = (b"iTXt", CAMERA_KEYWORD.encode() + b"\0\0\0\0\0" + text)
                parts = [part for part in parts if part[0] != b"tEXt"]
                parts.insert(1, made)
            elif action == 4 and parts[0][0] == b"IHDR" and len(parts[0][1]) == 13:
                fields = list(struct.unpack(">IIBBBBB", parts[0][1]))
                which = rng.randrange(7)
                limit = 0xFFFFFFFF if which < 2 else 255
                fields[which] = (bend_integer(rng, fields[which]) if which < 2 else rng.randrange(20)) & limit
                parts[0] = b"IHDR", struct.pack(">IIBBBBB", *fields)
            elif action == 5 and kind == b"IDAT":
                raw = bytes(17 * 97)
                with contextlib.suppress(zlib.error):
                    raw = zlib.decompressobj().decompress(body, 1 << 20)
                parts[at] = kind, zlib.compress(bend_bytes(rng, raw) + bytes(rng.choice((0, 1000))), 1)
            elif action == 6:
                profile = b"icc\0\0" + zlib.compress(bend_bytes(rng, bytes(200)), 1)
                parts.insert(1, rng.choice([(b"iCCP", profile), (b"eXIf", b"MM\0*" + rng.randbytes(40))]))
            else:
                parts[at] = kind, bend_bytes(rng, body)
        data = join(parts)
        return bend_bytes(rng, data) if maybe(rng, 0.08) else data

    def check(self, files: dict[str, bytes], rng: random.Random) -> Verdict:
        for old in self.folder.iterdir():
            old.unlink()
        for name, data in files.items():
            (self.folder / name).write_bytes(data)
        picture = self.folder / next(iter(files))
        camera = self.folder / "a.json" if "a.json" in files and rng.random() < 0.5 else None
        mask = self.folder / "mask.png" if "mask.png" in files else None
        try:
            camera_from(camera or picture)
        except ValueError as error:
            refusal(error, str(self.folder))
        try:
            made = edit_from_files(picture, camera, mask)
        except ValueError as error:
            refusal(error, str(self.folder))
            return Verdict(refused=1)
        size = (made.camera.height, made.camera.width)
        if made.picture.colors.shape != (*size, 3) or not np.isfinite(made.picture.colors).all():
            raise Fault(f"colours of shape {made.picture.colors.shape}, expected finite ones of {size}")
        if made.mask is not None and made.mask.shape != size:
            raise Fault(f"a mask of shape {made.mask.shape}, expected {size}")
        if not all(note.isprintable() for note in made.notes):
            raise Fault(f"notes that are not printable: {made.notes!r}")
        again = Camera.from_json(made.camera.to_json())
        if again != made.camera:
            raise Fault("the camera is not the same after a turn through JSON")
        return Verdict(opened=1)


def chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """(kind, content) of the chunks of a PNG file."""
    out, at = [], 8
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        out.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return out


def join(parts: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG file with sound checksums."""
    pieces = [MAGIC]
    for kind, body in parts:
        pieces += [struct.pack(">I", len(body)), kind, body, struct.pack(">I", zlib.crc32(kind + body))]
    return b"".join(pieces)


TARGETS = {"picture": PictureTarget}
