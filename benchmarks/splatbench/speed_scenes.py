"""The demo asset at any number of rows, and the pictures painted over it, for the speed bench."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import ATTRIBUTES, Splats

DAB = 64 / 512
"""Diameter of the brush dab, of the picture's size."""
LETTERS = 90 / 512
"""Height of the text, of the picture's size."""


def with_rows(splats: Splats, rows: int, sh_degree: int, seed: int = 0) -> Splats:
    """A surface of the same shape made of `rows` rows: parents drawn evenly, each child inside its parent's ellipse (a
    normal offset along the two long axes, so that the mixture keeps the parent's spread) and smaller by the square root
    of the ratio of rows; with fewer rows than parents, larger by it. SH above `sh_degree` is dropped."""
    from splatpainter.lift.split import rotations

    rng = np.random.default_rng(seed)
    own = splats.numpy()
    repeats, rest = divmod(rows, len(own))
    parents = np.concatenate([np.repeat(np.arange(len(own)), repeats), rng.permutation(len(own))[:rest]])
    parents = rng.permutation(parents)  # files are in no useful order
    some = own.take(parents)
    factor = np.float32(np.sqrt(len(own) / rows))
    flat = some.scales.argmin(1)
    offset = rng.standard_normal((rows, 3)).astype(np.float32) * np.sqrt(max(1 - factor**2, 0.0)) * some.scales
    offset[np.arange(rows), flat] = 0
    means = some.means + np.einsum("nij,nj->ni", rotations(some.quats), offset)
    bands = (sh_degree + 1) ** 2
    sh = np.ascontiguousarray(some.sh[:, :bands])
    scales = (some.scales * factor).astype(np.float32)
    return replace(some, means=means.astype(np.float32), scales=scales, sh=sh, source=None, origin=None)


def save_scene(folder: Path, splats: Splats) -> None:
    """The rows as arrays (quick to load in a fresh process) and as a PLY."""
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
        from splatbench import strokes as paint
        from splatpainter.cameras import to_uint8
        from splatpainter.demo_asset import CALM

        size, shape = self.size, (self.size, self.size)
        if kind == "grade":
            return to_uint8(np.clip(self.render, 0, 1) ** 1.3 * [1.05, 0.92, 0.78]), np.ones(shape, bool)
        middle = ((CALM[0] + CALM[2]) / 2 * size, (CALM[1] + CALM[3]) / 2 * size)
        if kind == "dab":
            layers = [paint.stroke_layer(shape, np.array([middle]), DAB * size, 4 / 512 * size, paint.PALETTE[0])]
        else:
            letters = LETTERS * size
            lower = paint.wave(shape, middle[1] / size + 0.15)
            layers = [
                paint.text_layer("TEA", shape, middle, letters, paint.PALETTE[1]),
                paint.stroke_layer(shape, lower, 24 / 512 * size, 5 / 512 * size, paint.PALETTE[0]),
            ]
        picture, mask = np.clip(self.render, 0, 1), np.zeros(shape, bool)
        for layer in layers:
            picture, mask = paint.over(picture, layer), mask | (layer[..., 3] > 0)
        return to_uint8(picture), mask
