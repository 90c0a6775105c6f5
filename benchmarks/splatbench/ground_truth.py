"""Truth: pictures of an object in a light, path traced or drawn from dense surfels, with what is surface and how far;
the same with edits painted on it; and the asset that an artist has before any edit. Knows no table and no method.

The tone map and the exposure are those of the training data (data/path_samples.py). No denoising: truth has the noise
of its paths, other in every view. It bounds what can be scored: over four HDRIs, a perfect answer to a noisy truth of a
matt packet has 30.5 to 33.8 dB at 64 paths per pixel, 36.6 to 39.7 at 256.

Paint is a material under the light, not a light of its own: the edited view is a picture of the painted object, so that
what a method is given and what it is judged by agree.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatbench.cases import PosedImages, Setup
from splatbench.objects import environments, generator, objects
from splatpainter.cameras import Camera
from splattrain.data import viewpoints
from splattrain.data.meshes import Mesh

if TYPE_CHECKING:
    from splatpainter.fit.optimize import TrainingView
    from splatpainter.splats import Splats
    from splattrain.data.edits import EditDesign
    from splattrain.data.lights import Light
    from splattrain.data.surfels import Surfels

BACKGROUND = (0.5, 0.5, 0.5)
"""Background of all pictures: a grey that float16 keeps exactly and that hardly any surface has, so that pictures alone
tell what is object (scoring.object_masks)."""
FOV_DEGREES = 40.0
"""Vertical, of views of the whole object."""
TRUTHS = ("traced", "surfels")
MIN_SURFELS, MAX_SURFELS = 20_000, 600_000
SURFELS_PER_PIXEL = 0.6
"""Surfels per pixel of the largest picture: about one per pixel of surface, all around."""
SURFEL_SH_DEGREE = 2
ASSET_SH_DEGREE = 1
ASSET_START = {"opacity": 0.9, "size": 0.6}
"""How first Gaussians start (fit/start.py): true depth is a surface, not a cloud. Against 3DGS's 0.1 and 1 after 300
steps on 9 path traced views at 256 px, 30,000 Gaussians (a rover, a coffee packet): novel views 24.1 and 25.6 dB, not
23.1 and 24.7; base views 29.2 and 29.5, not 28.1 and 28.0. 500 steps: novel 24.4 and 26.0, base 31.4 and 31.6. The
asset of surfels, whose light is approximate: novel 19.5 and 23.3."""
FIT_BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""Backgrounds that the base views are fitted over. Over the pictures' grey alone, Gaussians of that grey were left
hanging beside the object, which no view told from holes."""
ASSET_ROUGHNESS = 0.3
"""Roughness of the asset of surfels."""
SURFELS_PER_GAUSSIAN = 4
"""Surfels per Gaussian of that asset, where the truth has no surfels."""


@dataclass(frozen=True)
class GroundTruthViews:
    """V views of the truth."""

    images: PosedImages
    alphas: np.ndarray = field(repr=False)
    """[V, H, W] float32 share of the pixel that is surface."""
    depths: np.ndarray = field(repr=False)
    """[V, H, W] float32 z-depth of that share, world units; 0 where there is none."""

    @property
    def masks(self) -> np.ndarray:
        """[V, H, W] bool where the object is."""
        return self.alphas > 0.5

    def take(self, views: Any) -> GroundTruthViews:
        """These views (a range), in their order."""
        index = np.asarray(views)
        return GroundTruthViews(self.images.take(index), self.alphas[index], self.depths[index])


@dataclass(frozen=True)
class GroundTruth:
    """An object in a light, painted or not."""

    name: str
    mesh: Mesh = field(repr=False)
    radius: float
    """Radius of the sphere about the origin that holds it."""
    surfels: Surfels | None = field(repr=False)
    """Dense; None: it is path traced."""
    light: Light = field(repr=False)
    setup: Setup = field(repr=False)
    painted_sh: Any = field(default=None, repr=False)
    """[N, K, 3] torch: the painted surfels' colours; None: unpainted, or path traced."""

    @staticmethod
    def of(name: str, mesh: Mesh, light: Light, setup: Setup) -> GroundTruth:
        """A mesh as the setup has its truth. Raises ValueError: a truth that there is not, a mesh of which nothing can
        be seen."""
        if setup.truth not in TRUTHS:
            raise ValueError(f"truth: expected {' or '.join(TRUTHS)}, got {setup.truth!r}")
        used = mesh.vertices[np.unique(mesh.faces)]
        surfels = None
        if setup.truth == "surfels":
            from splattrain.data.surfels import sample_surfels

            count = int(np.clip(SURFELS_PER_PIXEL * (setup.size * setup.detail) ** 2, MIN_SURFELS, MAX_SURFELS))
            surfels = sample_surfels(mesh, count, setup.seed)
        return GroundTruth(name, mesh, float(np.linalg.norm(used, axis=1).max()), surfels, light, setup)

    @staticmethod
    def load(name: str, light: str, setup: Setup) -> GroundTruth:
        """The setup's object and light of these names. Raises ValueError where one cannot be read or seen."""
        return GroundTruth.of(name, objects(setup).load(name), environments(setup).load(light), setup)

    def under(self, light: str) -> GroundTruth:
        """The unpainted object in another light of the setup."""
        return replace(self, light=environments(self.setup).load(light), painted_sh=None)

    @property
    def optics(self) -> viewpoints.Optics:
        """Camera settings of views of the whole object."""
        return optics(self.setup)

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the truth, for every case."""
        traced = self.setup.truth == "traced"
        samples = self.setup.samples if traced else None
        return {"truth": self.setup.truth, "samples": samples, "size": self.setup.size}

    def ring(self, count: int, rng: np.random.Generator) -> list[Camera]:
        """`count` views of the whole object."""
        return viewpoints.ring(self.radius, self.optics, count, rng)

    def blocks(self, eye: np.ndarray, point: np.ndarray, slack: float = 0.01) -> bool:
        return blocked(self.mesh, eye, point, slack)

    def render(self, cameras: Sequence[Camera], purpose: str) -> GroundTruthViews:
        """Pictures from cameras of one size. purpose: keeps the noise of this set apart from that of others ("base",
        "novel", ...); equal cameras and purposes have equal noise, whatever is painted. Raises ValueError without
        Mitsuba."""
        if self.surfels is None:
            return self._traced(cameras, purpose)
        from splattrain.data.lit_scenes import render_views
        from splattrain.data.surfels import to_splats

        renders = render_views(to_splats(self.surfels, self._sh()), cameras)
        colors, alphas, depths = (x.numpy() for x in (renders.views.colors, renders.alphas, renders.depths))
        return GroundTruthViews(PosedImages(tuple(cameras), colors), alphas, depths)

    def paint(self, design: EditDesign) -> GroundTruth:
        """The truth with one more edit. Raises ValueError as data.edits.on_mesh.paint_mesh."""
        if self.surfels is None:
            from splattrain.data.edits.on_mesh import paint_mesh

            return replace(self, mesh=paint_mesh(self.mesh, design))
        from splattrain.data.edits.on_surfels import apply_paint, paint_coverage
        from splattrain.data.lit_scenes import render_views
        from splattrain.data.surfels import to_splats

        sh = self._sh()
        # What is painted already says nothing about the light that falls on a layer.
        unpainted = self._unpainted_sh() if isinstance(design.content, np.ndarray) else None
        view = render_views(to_splats(self.surfels, sh), [design.camera])
        paint = paint_coverage(design, self.surfels, sh, view.depths[0], view.alphas[0], unpainted_sh=unpainted)
        return replace(self, painted_sh=apply_paint(sh, paint))

    def preview(self) -> GroundTruth:
        """The truth for choices: unpainted and of few surfels; itself where it is of surfels."""
        if self.surfels is not None:
            return self
        from splattrain.data.surfels import sample_surfels

        return replace(self, surfels=sample_surfels(self.mesh, MIN_SURFELS, self.setup.seed))

    def _sh(self) -> Any:
        return self._unpainted_sh() if self.painted_sh is None else self.painted_sh

    def _unpainted_sh(self) -> Any:
        from splattrain.data.lights import shade

        assert self.surfels is not None
        return shade(self.surfels, self.light, SURFEL_SH_DEGREE)

    def _traced(self, cameras: Sequence[Camera], purpose: str) -> GroundTruthViews:
        from splattrain.data.pathtrace import PathOptions, display, path_trace

        seed = int(generator(self.setup.seed, f"paths {purpose}", self.name).integers(1 << 31))
        environment = self.light.environment.cpu().numpy()
        traced = path_trace(self.mesh, environment, cameras, PathOptions(self.setup.samples, seed=seed))
        colors = display(traced, float(self.light.exposure), cameras)
        return GroundTruthViews(PosedImages(tuple(cameras), colors), traced.alphas, traced.depths)


def optics(setup: Setup) -> viewpoints.Optics:
    """Camera settings of views of the whole object."""
    return viewpoints.Optics(setup.size, FOV_DEGREES, BACKGROUND)


def blocked(mesh: Mesh, eye: np.ndarray, point: np.ndarray, slack: float = 0.01) -> bool:
    """Whether a triangle lies between two points, more than `slack` world units in front of the second (cut-out holes
    count as surface). Moeller and Trumbore 1997, all triangles at once."""
    line = np.asarray(point, np.float64) - eye
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(line, second)
    determinant = (first * across).sum(1)
    valid = np.abs(determinant) > 1e-15
    scale = 1 / np.where(valid, determinant, 1)
    offset = eye - corners[:, 0]
    u = scale * (offset * across).sum(1)
    turned = np.cross(offset, first)
    v = scale * (turned @ line)
    t = scale * (second * turned).sum(1)
    hit = valid & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)
    return bool((t[hit] < 1 - slack / max(math.sqrt(line @ line), 1e-12)).any())


def changed(before: GroundTruthViews, after: GroundTruthViews) -> np.ndarray:
    """[V, H, W] bool where two truths of equal noise differ."""
    return changes(before.images.colors, after.images.colors)


def changes(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """[V, H, W] bool where pictures [V, H, W, 3] differ (data.edits.change_masks)."""
    import torch

    from splattrain.data.edits import change_masks

    if not len(before):
        return np.zeros(before.shape[:3], bool)
    one, other = (torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in (before, after))
    return change_masks(one, other).numpy()


# The asset before any edit.


@dataclass(frozen=True)
class BuiltAsset:
    splats: Splats = field(repr=False)
    """Numpy float32, at most `setup.rows` Gaussians."""
    seconds: float
    method: str
    """How it was made, in words, for the case's facts."""


def build_asset(
    truth: GroundTruth, base: GroundTruthViews, source: Literal["fitted", "surfels"] = "fitted"
) -> BuiltAsset:
    """The asset of an object in its light. base: the views that it is built from. "fitted": their pixels put at their
    true depth, then 3DGS optimisation on them. "surfels": the coarse asset of the training data (data/degrade.py),
    which knows the surface all around but no picture. Raises ValueError where they show nothing."""
    start = time.perf_counter()
    splats = _fitted(base, truth.setup) if source == "fitted" else _coarse(truth)
    seconds = time.perf_counter() - start
    if source == "fitted":
        steps = truth.setup.asset_steps
        method = f"{len(base.images)} base views at true depth, then {steps} steps of 3DGS optimisation"
    else:
        method = "coarse surfels of the truth"
    return BuiltAsset(splats.numpy(), seconds, method)


def _fitted(base: GroundTruthViews, setup: Setup) -> Splats:
    from splatpainter.fit.optimize import FitOptions, optimize
    from splatpainter.fit.start import from_depths

    cameras, colors = base.images.cameras, base.images.colors
    views = (cameras, colors, base.depths, base.alphas)
    start = from_depths(*views, setup.rows, setup.seed, ASSET_SH_DEGREE, **ASSET_START)
    if setup.asset_steps == 0:
        return start
    over = [view for background in FIT_BACKGROUNDS for view in _over(base, background)]
    return optimize(start, over, FitOptions(steps=setup.asset_steps, densify=False, seed=setup.seed)).splats


def _over(base: GroundTruthViews, background: tuple[float, float, float]) -> list[TrainingView]:
    """The base views with another background."""
    from splatpainter.fit.optimize import TrainingView

    views = []
    for (camera, color), alpha in zip(base.images, base.alphas, strict=True):
        change = np.subtract(background, camera.background, dtype=np.float32)
        views.append(TrainingView(replace(camera, background=background), color + (1 - alpha[..., None]) * change))
    return views


def _coarse(truth: GroundTruth) -> Splats[Any]:
    from splattrain.data.lights import shade
    from splattrain.data.surfels import coarse_asset, sample_surfels, to_splats

    setup, dense = truth.setup, truth.surfels
    if dense is None or len(dense) < setup.rows:
        dense = sample_surfels(truth.mesh, SURFELS_PER_GAUSSIAN * setup.rows, setup.seed)
    coarse = coarse_asset(dense, setup.rows, setup.seed, ASSET_ROUGHNESS)
    return to_splats(coarse, shade(coarse, truth.light, ASSET_SH_DEGREE))
