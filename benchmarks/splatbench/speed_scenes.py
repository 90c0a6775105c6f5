"""The demo asset with any number of Gaussians, and the pictures painted over it, for the speed bench."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from splatbench import strokes
from splatpainter.cameras import Camera
from splatpainter.image_files import to_uint8
from splatpainter.sources.layers import over
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.transforms import quat_to_matrix

DAB_WIDTH = 64 / 512
"""Diameter of the brush dab, of the picture's size."""
TEXT_HEIGHT = 90 / 512
"""Of its capitals, of the picture's size."""


def resampled(splats: Splats, count: int, sh_degree: int, seed: int = 0) -> Splats:
    """A surface of the same shape made of `count` Gaussians: parents drawn evenly, each child inside its parent's
    ellipse (a normal offset along the two long axes, so that the mixture keeps the parent's spread) and smaller by the
    square root of the ratio of counts; with fewer than parents, larger by it. SH above `sh_degree` is dropped."""
    rng = np.random.default_rng(seed)
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
    from splatpainter.io import write

    folder.mkdir(parents=True)
    for name in ATTRIBUTES:
        np.save(folder / f"{name}.npy", getattr(splats, name))
    write(folder / "scene.ply", splats)


@dataclass(frozen=True)
class Scene:
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
        red, blue = strokes.PALETTE[:2]
        if kind == "dab":
            layers = [strokes.stroke_layer(shape, np.array([center]), DAB_WIDTH * size, 4 / 512 * size, red)]
        else:
            below = strokes.wave(shape, center[1] / size + 0.15)
            layers = [
                strokes.text_layer("TEA", shape, center, TEXT_HEIGHT * size, blue),
                strokes.stroke_layer(shape, below, 24 / 512 * size, 5 / 512 * size, red),
            ]
        picture, mask = np.clip(self.render, 0, 1), np.zeros(shape, bool)
        for layer in layers:
            picture, mask = over(picture, layer), mask | (layer[..., 3] > 0)
        return to_uint8(picture), mask
