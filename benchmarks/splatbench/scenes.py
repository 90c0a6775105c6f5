"""What the benches edit: the demo asset with any number of Gaussians, and the paint that is put over its pictures.

The paint (bold text, soft strokes, discs) stays as it is, so that figures of the lift compare over time;
pictures/drawing.py has richer brushes. A layer is [H, W, 4] float32: display colour 0..1 and coverage 0..1, the colour
not multiplied by it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import to_uint8
from splatpainter.io import write
from splatpainter.pictures.drawing import centered_text, load_font, over, solid_layer
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.transforms import quat_to_matrix

DAB_WIDTH = 64 / 512
"""Diameter of the brush dab, of the picture's size."""
TEXT_HEIGHT = 90 / 512
"""Height of its capitals over the picture's size."""
SUPERSAMPLING = 4
"""Text is drawn at this many times the size per axis and averaged."""
PALETTE = ((0.76, 0.09, 0.13), (0.09, 0.26, 0.72), (0.98, 0.82, 0.12), (0.94, 0.95, 0.93), (0.05, 0.45, 0.25))
"""Crimson, ultramarine, yellow, white, green: paint that is not the colour of what it is put on."""


def resampled(splats: Splats, count: int, sh_degree: int) -> Splats:
    """A surface of the same shape made of `count` Gaussians: parents drawn evenly, each child inside its parent's
    ellipse (a normal offset along the two long axes, so that the mixture keeps the parent's spread) and smaller by the
    square root of the ratio of counts; with fewer than parents, larger by it. SH above `sh_degree` is dropped."""
    rng = np.random.default_rng(0)
    splats = splats.numpy()
    repeats, rest = divmod(count, len(splats))
    parent_ids = np.repeat(np.arange(len(splats)), repeats)
    parent_ids = np.concatenate([parent_ids, rng.permutation(len(splats))[:rest]])
    parents = splats.take(rng.permutation(parent_ids))  # files are in no useful order
    factor = np.float32(np.sqrt(len(splats) / count))
    flat = parents.scales.argmin(1)
    offset = rng.standard_normal((count, 3)).astype(np.float32) * np.sqrt(max(1 - factor**2, 0.0)) * parents.scales
    offset[np.arange(count), flat] = 0
    means = (parents.means + np.einsum("nij,nj->ni", quat_to_matrix(parents.quats), offset)).astype(np.float32)
    sh = np.ascontiguousarray(parents.sh[:, : (sh_degree + 1) ** 2])
    scales = (parents.scales * factor).astype(np.float32)
    return replace(parents, means=means, scales=scales, sh=sh, source=None, origin=None)


def save_scene(folder: Path, splats: Splats) -> None:
    """Arrays (quick to load in a fresh process) and a PLY."""
    folder.mkdir(parents=True)
    for name in ATTRIBUTES:
        np.save(folder / f"{name}.npy", getattr(splats, name))
    write(folder / "scene.ply", splats)


@dataclass(frozen=True)
class SavedScene:
    """A scene saved by `save_scene`, seen in the demo's recommended view."""

    folder: Path
    size: int
    """Pixels of the view's edge."""

    @property
    def ply(self) -> Path:
        return self.folder / "scene.ply"

    @cached_property
    def splats(self) -> Splats:
        return Splats(**{name: np.load(self.folder / f"{name}.npy") for name in ATTRIBUTES})

    @cached_property
    def camera(self) -> Camera:
        from splatpainter.demo_asset import demo_view

        return demo_view(self.size)

    @cached_property
    def render(self) -> np.ndarray:
        """[H, W, 3] the view as it is."""
        from splatpainter.rendering import render

        return render(self.splats, self.camera).colors[0]

    def edited(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """([H, W, 3] uint8 picture, [H, W] bool painted pixels). kind: "dab", a soft disc on the pot's belly; "text",
        letters there and a stroke below; "grade", the whole picture warmer and darker."""
        from splatpainter.demo_asset import CALM

        size, shape = self.size, (self.size, self.size)
        if kind == "grade":
            return to_uint8(np.clip(self.render, 0, 1) ** 1.3 * [1.05, 0.92, 0.78]), np.ones(shape, bool)
        center = ((CALM[0] + CALM[2]) / 2 * size, (CALM[1] + CALM[3]) / 2 * size)
        red, blue = PALETTE[:2]
        if kind == "dab":
            layers = [stroke_layer(shape, np.array([center]), DAB_WIDTH * size, 4 / 512 * size, red)]
        else:
            below = wave(shape, center[1] / size + 0.15)
            layers = [
                text_layer("TEA", shape, center, TEXT_HEIGHT * size, blue),
                stroke_layer(shape, below, 24 / 512 * size, 5 / 512 * size, red),
            ]
        picture, mask = np.clip(self.render, 0, 1), np.zeros(shape, bool)
        for layer in layers:
            picture, mask = over(picture, layer), mask | (layer[..., 3] > 0)
        return to_uint8(picture), mask


# ---- paint


def color_against(image: np.ndarray, coverage: np.ndarray, excluded: tuple[float, ...] | None = None) -> tuple:
    """The colour of the palette that shows best on a [H, W, 3] image where coverage [H, W] is above a half (on the
    worst tenth of it), other than `excluded`."""
    under = image[coverage > 0.5]
    under = under if len(under) else np.full((1, 3), 0.5)

    def contrast(color: tuple[float, ...]) -> float:
        return float(np.quantile(((under - np.array(color)) ** 2).sum(-1), 0.1))

    return max((color for color in PALETTE if color != excluded), key=contrast)


def text_layer(
    text: str,
    shape: tuple[int, int],
    center: tuple[float, float],
    height: float,
    color: tuple[float, ...] = PALETTE[0],
    font: Path | None = None,
) -> np.ndarray:
    """Bold antialiased text. shape: (H, W) of the layer; center: x, y of the text's middle, pixels; height: of its
    capitals, pixels. font: a TrueType or OpenType file, by default Pillow's own scalable font.
    Raises ValueError when the font cannot be read."""
    from PIL import Image

    scale = SUPERSAMPLING
    position = (center[0] * scale, center[1] * scale)
    letters, weight_px = load_font(font, height * scale), round(0.04 * height * scale)
    fine = centered_text((shape[0] * scale, shape[1] * scale), text, position, letters, weight_px)
    coverage = Image.fromarray(fine).resize((shape[1], shape[0]), Image.Resampling.BOX)
    return solid_layer(np.asarray(coverage, np.float32) / 255, color)


def stroke_layer(
    shape: tuple[int, int], points: np.ndarray, width: float, softness: float, color: tuple[float, ...] = PALETTE[0]
) -> np.ndarray:
    """A round brush dragged along points [K, 2] (x, y, pixels): opaque in the middle, falling to nothing over the outer
    `softness` pixels of its `width`. One point makes a disc."""
    ends = np.asarray(points, np.float32)
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) + 0.5 for n in shape), indexing="ij")
    nearest = np.full(shape, np.inf, np.float32)
    for a, b in zip(ends, ends[1:] if len(ends) > 1 else ends, strict=False):
        along = b - a
        length = float(along @ along)
        t = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / length, 0, 1) if length else 0.0
        nearest = np.minimum(nearest, (x - a[0] - t * along[0]) ** 2 + (y - a[1] - t * along[1]) ** 2)
    fall = np.clip((width / 2 - np.sqrt(nearest)) / max(softness, 1e-3), 0, 1)
    return solid_layer(fall * fall * (3 - 2 * fall), color)


def wave(shape: tuple[int, int], height: float) -> np.ndarray:
    """[24, 2] points of a brush stroke across the middle three fifths of a picture. height: of its middle, 0..1 of the
    picture from the top."""
    t = np.linspace(0, 1, 24)
    return np.stack([(0.2 + 0.6 * t) * shape[1], (height + 0.045 * np.sin(2 * np.pi * t)) * shape[0]], 1)
