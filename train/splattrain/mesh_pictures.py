"""What `splatpainter fit` fits to where it is given a mesh: the core finds this by an entry point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.commands.parts.fit_sources import FitPictures, FitPictureSettings, drawn, rendered_pictures
from splattrain.data.environments import load_environment
from splattrain.data.lights import make_light, shade, uniform_light
from splattrain.data.meshes import Mesh, load_mesh
from splattrain.data.pathtrace import PathOptions, display, path_trace
from splattrain.data.surfels import sample_surfels, to_splats

MESH_FRAME = np.diag([1.0, -1.0, -1.0, 1.0])
"""Meshes have y up, assets in memory y down (cameras.AUTO_UP)."""


def mesh_pictures(source: Path, settings: FitPictureSettings) -> FitPictures:
    """Pictures of a mesh (GLB, glTF, OBJ), drawn as surfels or path traced, and first Gaussians. Raises ValueError, in
    one line: no mesh that can be read, no environment."""
    mesh = load_mesh(source)
    light = make_light(load_environment(settings.environment)) if settings.environment is not None else uniform_light()
    render_views = _traced(mesh, light, settings) if settings.truth == "traced" else _surfels(mesh, light, settings)
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    return rendered_pictures("mesh", render_views, np.zeros(3), radius, np.array([0.0, 1.0, 0.0]), settings, MESH_FRAME)


def _surfels(
    mesh: Mesh, light: Any, settings: FitPictureSettings
) -> Callable[[Sequence[Camera]], tuple[np.ndarray, ...]]:
    dense = sample_surfels(mesh, settings.surfels, settings.seed)
    truth = to_splats(dense, shade(dense, light, min(settings.sh_degree, 2))).numpy()
    return partial(drawn, truth)


def _traced(
    mesh: Mesh, light: Any, settings: FitPictureSettings
) -> Callable[[Sequence[Camera]], tuple[np.ndarray, ...]]:
    def render_views(cameras: Sequence[Camera]) -> tuple[np.ndarray, ...]:

        traced = path_trace(mesh, light.environment.numpy(), cameras, PathOptions(settings.samples, seed=settings.seed))
        return display(traced, float(light.exposure), cameras), traced.depths, traced.alphas

    return render_views
