"""Calls every kernel of this package once, so that numba compiles and caches it; see splatpainter.kernels.compile.

Two functions of about equal work, for two processes: kernels over Gaussians, and kernels over tiles.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.kernels import simd
from splatpainter.kernels.parallel import run
from splatpainter.rendering.cpu import geometry, projection
from splatpainter.rendering.cpu.geometry import COLUMNS
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.sirt import CachedWeights
from splatpainter.splats import ATTRIBUTES, Splats

CAMERA = look_at([0, 0, 3], [0, 0, 0], width=32, height=32)


def warm_projection() -> None:
    """Projection, sorting, binning, and the derivative of projection."""
    rng = np.random.default_rng(0)
    shapes = {"means": (2, 3), "quats": (2, 4), "scales": (2, 3), "opacities": (2,), "sh": (2, 4, 3)}
    splats = Splats(**{name: rng.uniform(0.1, 0.5, shape).astype(np.float32) for name, shape in shapes.items()})
    view = project(splats, CAMERA)
    cam = geometry.camera_vector(CAMERA, np.array([0, 32, 0, 32]), np.dtype(np.float32))
    attributes = (simd.readonly(getattr(splats, name), np.float32) for name in ("means", "scales", "opacities"))
    run(projection.select_near_window, *attributes, cam, np.empty(2, bool))
    sums = simd.aligned((len(view.flatten_ids), COLUMNS), np.dtype(np.float32))
    sums[:] = 0
    view.project_backward(splats, sums, tuple(np.empty_like(getattr(splats, name)) for name in ATTRIBUTES))


def warm_tiles() -> None:
    """Drawing, its adjoint, the lift's step, and the derivative of drawing. On a view made by hand, so that this
    process does not compile the kernels of the other."""
    integers, indices = np.zeros(1, np.int64), np.zeros(0, np.int32)
    projected = simd.readonly(np.zeros((0, COLUMNS)), np.float32)
    view = ProjectedView(
        CAMERA, 2, np.zeros((2, 2), bool), integers[:0], projected, integers, indices, indices, indices, integers
    )
    image, alpha, depth = (np.zeros((32, 32, *rest), np.float32) for rest in ((3,), (), ()))
    ends = view.rasterize_into(image, alpha, depth)
    view.backproject(image, alpha)
    view.mask_sums(alpha, alpha)
    view.sirt_step(image, alpha)
    view.heaviest_gaussians()
    view.touched_tiles(np.zeros(0, bool))
    view.part().merged(view)
    CachedWeights.of(view, image, alpha, np.zeros(0, bool))
    view.rasterize_backward(ends, image, alpha, depth, image, alpha, depth)
