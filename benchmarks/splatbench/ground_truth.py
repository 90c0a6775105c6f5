"""Truth: pictures of an object in a light, path traced or drawn from dense surfels, with what is surface and how far.

The tone map and the exposure are those of the training data (data/path_samples.py). No denoising: truth has the noise
of its paths, other in every view. It bounds what can be scored: over four HDRIs, a perfect answer to a noisy truth of a
matt packet has 30.5 to 33.8 dB at 64 paths per pixel, 36.6 to 39.7 at 256. Knows no asset and no method.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from splatbench.cases import PosedImages, Setup
from splatbench.objects import generator
from splatpainter.cameras import Camera
from splatpainter.data.meshes import Mesh
from splatpainter.data.viewpoints import Optics

if TYPE_CHECKING:
    from splatpainter.data.lights import Light
    from splatpainter.data.surfels import Surfels

BACKGROUND = (0.5, 0.5, 0.5)
"""Of all pictures: a grey that float16 keeps exactly and that hardly any surface has, so that pictures alone tell what
is object (scoring.object_masks)."""
FOV = 40.0
"""Vertical, degrees, of views of the whole object."""
TRUTHS = ("traced", "surfels")
FEWEST, MOST = 20_000, 600_000
"""Surfels."""
PER_PIXEL = 0.6
"""Surfels per pixel of the largest picture: about one per pixel of surface, all around."""
DEGREE = 2
"""Of the SH of surfels' colours."""


@dataclass(frozen=True)
class Subject:
    """An object whose truth can be shown."""

    name: str
    mesh: Mesh = field(repr=False)
    radius: float
    """Of the sphere about the origin that holds it."""
    surfels: Surfels | None = field(repr=False)
    """Dense; None: it is path traced."""


@dataclass(frozen=True)
class Shown:
    """V views of a subject."""

    pictures: PosedImages
    alphas: np.ndarray = field(repr=False)
    """[V, H, W] float32 share of the pixel that is surface."""
    depths: np.ndarray = field(repr=False)
    """[V, H, W] float32 z-depth of that share, world units; 0 where there is none."""

    @property
    def masks(self) -> np.ndarray:
        """[V, H, W] bool where the object is."""
        return self.alphas > 0.5


def subject(name: str, mesh: Mesh, setup: Setup) -> Subject:
    """An object as the setup wants its truth. Raises ValueError: a truth that there is not, a mesh of which nothing can
    be seen."""
    if setup.truth not in TRUTHS:
        raise ValueError(f"truth: expected {' or '.join(TRUTHS)}, got {setup.truth!r}")
    used = mesh.vertices[np.unique(mesh.faces)]
    surfels = None
    if setup.truth == "surfels":
        from splatpainter.data.surfels import sample_surfels

        count = int(np.clip(PER_PIXEL * (setup.size * setup.detail) ** 2, FEWEST, MOST))
        surfels = sample_surfels(mesh, count, setup.seed)
    return Subject(name, mesh, float(np.linalg.norm(used, axis=1).max()), surfels)


def optics(setup: Setup) -> Optics:
    """Of views of the whole object."""
    return Optics(setup.size, FOV, BACKGROUND)


def show(what: Subject, light: Light, cameras: Sequence[Camera], setup: Setup, purpose: str) -> Shown:
    """PosedImages of the subject; cameras of one size. purpose: keeps the noise of this set apart from that of others
    ("base", "novel", ...). Raises ValueError without Mitsuba."""
    if what.surfels is None:
        return _traced(what, light, cameras, setup, purpose)
    from splatpainter.data.lights import shade
    from splatpainter.data.lit_scenes import render_views
    from splatpainter.data.surfels import to_splats

    shots = render_views(to_splats(what.surfels, shade(what.surfels, light, DEGREE)), cameras)
    colors, alphas, depths = (x.numpy() for x in (shots.views.colors, shots.alphas, shots.depths))
    return Shown(PosedImages(tuple(cameras), colors), alphas, depths)


def blocked(mesh: Mesh, eye: np.ndarray, spot: np.ndarray, slack: float = 0.01) -> bool:
    """Whether a triangle lies between two points, more than `slack` world units in front of the second (cut-out holes
    count as surface). Moeller and Trumbore 1997, all triangles at once."""
    line = np.asarray(spot, np.float64) - eye
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(line, second)
    determinant = (first * across).sum(1)
    sound = np.abs(determinant) > 1e-15
    scale = 1 / np.where(sound, determinant, 1)
    offset = eye - corners[:, 0]
    u = scale * (offset * across).sum(1)
    turned = np.cross(offset, first)
    v = scale * (turned @ line)
    t = scale * (second * turned).sum(1)
    hit = sound & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)
    return bool((t[hit] < 1 - slack / max(math.sqrt(line @ line), 1e-12)).any())


def places(camera: Camera, depths: np.ndarray) -> np.ndarray:
    """[H, W, 3] float64 world points of pixel centres at z-depths [H, W]."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    local = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1) * depths[..., None]
    return (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]


def told(setup: Setup) -> dict[str, Any]:
    """Facts of every case about its truth."""
    traced = setup.truth == "traced"
    return {"truth": setup.truth, "samples": setup.samples if traced else None, "size": setup.size}


def _traced(what: Subject, light: Light, cameras: Sequence[Camera], setup: Setup, purpose: str) -> Shown:
    from splatpainter.data.pathtrace import PathOptions, display, path_trace

    seed = int(generator(setup.seed, f"paths {purpose}", what.name).integers(1 << 31))
    environment = light.environment.cpu().numpy()
    done = path_trace(what.mesh, environment, cameras, PathOptions(setup.samples, seed=seed))
    colors = display(done, float(light.exposure), cameras)
    return Shown(PosedImages(tuple(cameras), colors), done.alphas, done.depths)
