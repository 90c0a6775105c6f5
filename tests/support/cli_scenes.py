"""A small asset, the command line in this process, and paint on pictures, for the tests of the commands."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from PIL import Image, ImageDraw, PngImagePlugin

from splatpainter.cli import main
from splatpainter.io import write
from splatpainter.splats import SH_C0, Splats

Capture: TypeAlias = pytest.CaptureFixture[str]
BOX = (40, 44, 55, 53)
"""A rectangle on the ball, in pictures of 96 pixels: left, top, right, bottom."""


@dataclass(frozen=True)
class Ran:
    """One command line's outcome."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict:
        return json.loads(self.out)

    @property
    def error(self) -> str:
        """The one line on stderr of a refused command, with nothing on stdout."""
        assert (self.code, self.out) == (2, ""), self
        assert self.err.endswith("\n") and self.err.count("\n") == 1, self.err
        assert self.err.startswith("splatpainter")
        return self.err.strip()


def run(capfd: Capture, *words: object) -> Ran:
    """`splatpainter words...` in this process."""
    capfd.readouterr()
    code = main([str(word) for word in words])
    captured = capfd.readouterr()
    return Ran(code, captured.out, captured.err)


def ball(count: int = 3000, *, radius: float = 1.0, degree: int = 1) -> Splats:
    """A sphere of flat Gaussians about the origin, opaque from outside: pale, with a red cap around -y (up in
    pictures)."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = k * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.cos(angle), across * np.sin(angle), z], 1)
    sh = np.zeros((count, (degree + 1) ** 2, 3))
    colors = np.where(normals[:, 1:2] < -0.8, [0.9, 0.1, 0.1], [0.7, 0.75, 0.8])
    sh[:, 0] = (colors - 0.5) / SH_C0
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], 1)  # turns z to the normal
    half[normals[:, 2] < -0.999] = (0, 1, 0, 0)
    size = 1.5 * radius * np.sqrt(4 * np.pi / count)
    scales = np.repeat([[size / 2, size / 2, size / 40]], count, 0)
    arrays = (radius * normals, half, scales, np.full(count, 0.95), sh)
    means, quats, scales, opacities, sh = (array.astype(np.float32) for array in arrays)
    return Splats(means, quats, scales, opacities, sh)


def saved(path: Path, splats: Splats | None = None) -> Path:
    """The ball, or `splats`, as a file."""
    write(path, ball() if splats is None else splats, overwrite=True)
    return path


def with_bad_gaussians(splats: Splats) -> Splats:
    """The same with a NaN centre, an infinite scale, a NaN colour and a zero quaternion in Gaussians 3, 5, 7 and 9."""
    means, scales, sh, quats = (getattr(splats, name).copy() for name in ("means", "scales", "sh", "quats"))
    means[3, 1], scales[5, 0], sh[7, 0, 2], quats[9] = np.nan, np.inf, np.nan, 0
    return replace(splats, means=means, scales=scales, sh=sh, quats=quats)


def paint(source: Path, target: Path, box: tuple[int, int, int, int], color: tuple[int, ...] = (20, 160, 40)) -> Path:
    """A copy of a PNG with a filled rectangle (left, top, right, bottom inclusive); text chunks are kept."""
    with Image.open(source) as picture:
        texts = dict(getattr(picture, "text", {}))
        copy = picture.convert("RGB")
    ImageDraw.Draw(copy).rectangle(box, fill=color)
    chunk = PngImagePlugin.PngInfo()
    for key, value in texts.items():
        chunk.add_text(key, value)
    copy.save(target, pnginfo=chunk)
    return target


def without_camera(source: Path, target: Path) -> Path:
    """A copy of a picture without text chunks, in the format that the name says."""
    with Image.open(source) as picture:
        picture.convert("RGB").save(target)
    return target


def listing(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its bytes, to see that nothing changed."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def rows_of(path: Path) -> np.ndarray:
    """[N, F] uint8: the stored rows of a little-endian float PLY file, read without the package."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    width = 4 * head.count(b"property float")
    return np.frombuffer(body[: count * width], np.uint8).reshape(count, width)


def ball_and_painted_view(folder: Path, capfd: Capture) -> Path:
    """ball.ply, views/view_000.png of 96 pixels, and painted.png, BOX of it painted; returns painted.png."""
    asset = saved(folder / "ball.ply")
    assert run(capfd, "render", asset, "--out", folder / "views", "--views", 1, "--size", 96).code == 0
    return paint(folder / "views" / "view_000.png", folder / "painted.png", BOX)


def refused(capfd: Capture, folder: Path, picture: Path, *more: object) -> str:
    """The line that refuses to edit ball.ply by a picture; nothing in the folder may change."""
    before = listing(folder)
    done = run(capfd, "edit", folder / "ball.ply", picture, "--out", folder / "out.ply", *more)
    assert listing(folder) == before
    return done.error
