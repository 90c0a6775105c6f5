"""Pictures of linear light, by OpenImageIO: environments (.hdr, .exr), and path traced radiance as OpenEXR of halves.

Half rather than 16-bit PNG: light has no upper end (a lamp is 1000 times paper), a half keeps 11 significant bits at
every level, and every compositor opens it. Range 6e-8 to 65504.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter import image_files
from splatpainter.image_files import HALF_MAX

MAX_PIXELS = 1 << 27
"""Most pixels of an environment; a larger size in its header is a fault of the file."""
MAX_BAD_SHARE = 0.01
"""Largest share of pixels that are not finite or negative; an environment with more is refused."""
CHANNELS = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def load_environment(path: str | Path) -> Any:
    """[h, w, 3] float32 torch, linear, from .hdr (Radiance) or .exr. Pixels that are not finite or negative become 0.

    Raises ValueError, one line that names the file: more than MAX_BAD_SHARE such pixels, all black, no such picture.
    """
    import torch

    path = Path(path)
    if path.suffix.lower() not in (".hdr", ".exr"):
        raise ValueError(f"{path}: expected an environment (.hdr or .exr), got {path.suffix or 'no suffix'}")
    pixels = _read(path, str(path))
    pixels = np.repeat(pixels, 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    bad = ~np.all(np.isfinite(pixels) & (pixels >= 0), axis=-1)
    if bad.mean() > MAX_BAD_SHARE:
        raise ValueError(
            f"{path}: {int(bad.sum())} of {bad.size} pixels are NaN, infinite or negative; repair the picture"
        )
    pixels = np.where(bad[..., None], np.float32(0), pixels).astype(np.float32)
    if not pixels.any():
        raise ValueError(f"{path}: the environment is black")
    return torch.from_numpy(pixels)


def encode_exr(image: np.ndarray) -> bytes:
    """[H, W, C] linear values, C = 1, 3 or 4 -> the bytes of an OpenEXR file of halves. Values above HALF_MAX become
    HALF_MAX. Raises ValueError for other shapes and for NaN."""
    if image.ndim != 3 or image.shape[2] not in CHANNELS:
        raise ValueError(f"EXR: expected an image [H, W, 1, 3 or 4], got {list(image.shape)}")
    if np.isnan(image).any():
        raise ValueError(f"EXR: {int(np.isnan(image).sum())} values are NaN")
    half = np.clip(image, -HALF_MAX, HALF_MAX).astype(np.float16)
    return image_files.encode_exr(half, CHANNELS[image.shape[2]])


def decode_exr(data: bytes, where: str = "EXR") -> np.ndarray:
    """The bytes of an OpenEXR file -> [H, W, C] float32. Raises ValueError naming `where`."""
    with tempfile.TemporaryDirectory(prefix="splatpainter-exr-") as folder:
        path = Path(folder) / "picture.exr"
        path.write_bytes(data)
        return _read(path, where)


def _read(path: Path, where: str) -> np.ndarray:
    """[h, w, C] float32. Only the header is read before its size was judged."""
    if not path.is_file():
        raise ValueError(f"{where}: no such file")
    oiio = image_files.require_deep(f"{where}: reading light")
    format_name = {".hdr": "hdr", ".exr": "openexr"}[path.suffix.lower()]
    source = oiio.ImageInput.open(str(path))
    if source is None or source.format_name() != format_name:
        kind = "a Radiance .hdr" if format_name == "hdr" else "an OpenEXR"
        raise ValueError(f"{where}: is not {kind} picture ({_one_line(oiio.geterror(), path)})")
    try:
        spec = source.spec()
        if not 0 < spec.width * spec.height <= MAX_PIXELS:
            raise ValueError(
                f"{where}: expected 1 to {MAX_PIXELS:,} pixels, the header says {spec.width} x {spec.height}"
            )
        pixels = source.read_image(0, 0, 0, min(spec.nchannels, 4), "float")
        if pixels is None:
            raise ValueError(f"{where}: damaged picture ({_one_line(source.geterror(), path)})")
        return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1)
    finally:
        source.close()


def _one_line(problem: str, path: Path) -> str:
    return " ".join(problem.replace(str(path), "").split())[:120] or "no reason given"
