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
from splatpainter.lights.sky_maps import read_radiance, read_samples

CHANNELS = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}


def load_environment(path: str | Path) -> Any:
    """[h, w, 3] float32 torch, linear, from .hdr (Radiance) or .exr. Pixels that are not finite or negative become 0.

    Raises ValueError as `read_radiance`.
    """
    import torch

    return torch.from_numpy(read_radiance(Path(path)))


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
        return read_samples(path, where)
