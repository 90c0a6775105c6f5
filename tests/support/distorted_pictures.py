"""Pictures as generators and editors give them back: moved, turned, scaled, recoloured, painted over, compressed."""

from __future__ import annotations

import io
import math
from functools import cache

import numpy as np
from PIL import Image

from splatpainter.gatekeeper.registration import warped


@cache
def drawn_scene(size: int = 240, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """([size, size, 3] overlapping shaded disks with grain on grey, [size, size] alpha: where they are), read-only."""
    rng = np.random.default_rng(seed)
    image, alpha = np.full((size, size, 3), 0.25), np.zeros((size, size))
    for _ in range(24):
        cx, cy = rng.uniform(0.25 * size, 0.75 * size, 2)
        radius = rng.uniform(0.05, 0.16) * size
        rows, columns = (slice(int(max(c - radius - 1, 0)), int(c + radius + 2)) for c in (cy, cx))
        y, x = np.mgrid[rows, columns][:, : size - rows.start, : size - columns.start] + 0.5
        cover = np.clip(radius - np.hypot(x - cx, y - cy), 0, 1)
        light = 0.7 + 0.3 * (x - cx + cy - y) / radius / 2
        stripes = 0.85 + 0.15 * np.sin((x * rng.normal() + y * rng.normal()) / 2.5)
        color = rng.uniform(0.15, 0.85, 3) * (light * stripes)[..., None]
        image[rows, columns] = image[rows, columns] * (1 - cover[..., None]) + color * cover[..., None]
        alpha[rows, columns] = np.maximum(alpha[rows, columns], cover)
    pictures = np.clip(image, 0.02, 0.98).astype(np.float32), alpha.astype(np.float32)
    for picture in pictures:
        picture.flags.writeable = False
    return pictures


def moved(
    image: np.ndarray, *, scale: float = 1.0, degrees: float = 0.0, right: float = 0.0, down: float = 0.0, size: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """(the picture as if scaled and turned about its centre and moved, resized to size x size (0: as it is), [2, 3]
    where its pixels lie now). What comes in from beyond the borders has the corner's colour."""
    height, width = image.shape[:2]
    across = size or width
    angle = math.radians(degrees)
    sine, cosine = scale * math.sin(angle), scale * math.cos(angle)
    center = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]])
    turn = np.array([[cosine, -sine, right], [sine, cosine, down], [0, 0, 1]])
    matrix = np.diag([across / width, across / width, 1]) @ center @ turn @ np.linalg.inv(center)
    out, inside = warped(image, np.linalg.inv(matrix)[:2], (across, round(across * height / width)))
    return np.where(inside[..., None], out, image[0, 0]).astype(np.float32), matrix[:2]


def painted_over(image: np.ndarray, share: float, seed: int) -> np.ndarray:
    """Noisy disks of any colour over about a share of the picture."""
    rng, out = np.random.default_rng(seed), image.copy()
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    area = 0.0
    while area < share * height * width:
        radius = rng.uniform(width / 12, width / 6)
        disk = np.hypot(x - rng.uniform(0, width), y - rng.uniform(0, height)) < radius
        out[disk] = 0.7 * rng.uniform(size=3) + 0.3 * rng.uniform(size=(int(disk.sum()), 3))
        area += disk.sum()
    return out


def jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray((image * 255 + 0.5).astype(np.uint8)).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file), np.float32) / 255


def corner_error(matrix: np.ndarray, truth: np.ndarray, width: int, height: int) -> float:
    """Pixels of the render by which a corner lies elsewhere."""
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]).T
    return float(np.abs((matrix - truth) @ corners).max() / math.sqrt(abs(np.linalg.det(truth[:, :2]))))
