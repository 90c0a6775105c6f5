"""Calls every kernel of this package once, so that numba compiles and caches it; see splatpainter.kernels.compile.

Two functions of about equal work, for two processes: kernels over rows, and kernels over tiles.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.kernels import simd as lanes
from splatpainter.rendering.cpu.heaviest import heaviest_rows
from splatpainter.rendering.cpu.projected_view import Frame, project
from splatpainter.rendering.cpu.sirt import Kept
from splatpainter.rendering.cpu.views import pixels_back, rows_back
from splatpainter.splats import ATTRIBUTES, Splats

CAMERA = look_at([0, 0, 3], [0, 0, 0], width=32, height=32)


def warm_rows() -> None:
    """Projection, sorting, binning, and the derivative of projection."""
    rng = np.random.default_rng(0)
    shapes = {"means": (2, 3), "quats": (2, 4), "scales": (2, 3), "opacities": (2,), "sh": (2, 4, 3)}
    splats = Splats(**{name: rng.uniform(0.1, 0.5, shape).astype(np.float32) for name, shape in shapes.items()})
    frame = project(splats, CAMERA)
    sums = lanes.aligned((len(frame.members), lanes.RECORD), np.dtype(np.float32))
    sums[:] = 0
    rows_back(splats, frame, sums, True, tuple(np.empty_like(getattr(splats, name)) for name in ATTRIBUTES))


def warm_tiles() -> None:
    """Drawing, its adjoint, the lift's round, and the derivative of drawing. On a frame made by hand, so that this
    process does not compile the kernels of the other."""
    integers, indices = np.zeros(1, np.int64), np.zeros(0, np.int32)
    records = lanes.readonly(np.zeros((0, lanes.RECORD)), np.float32)
    frame = Frame(
        CAMERA, 2, np.zeros((2, 2), bool), integers[:0], records, integers, indices, indices, indices, integers
    )
    image, alpha, depth = (np.zeros((32, 32, *rest), np.float32) for rest in ((3,), (), ()))
    ends = frame.draw_into(image, alpha, depth)
    frame.accumulate(image, alpha)
    frame.residual_round(image, alpha)
    heaviest_rows(frame)
    Kept.of(frame, image, alpha, np.zeros(0, bool))
    pixels_back(frame, ends, image, alpha, depth, image, alpha, depth)
