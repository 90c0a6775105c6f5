"""What one edited view says of a row: flat changes can be followed, fine ones cannot, and hidden parts hold."""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.lift.local.evidence import Evidence, footprints
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats

SIZE = 64
CAMERA = look_at((0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=SIZE, height=SIZE, fov=40.0)
EVERYWHERE = np.ones((SIZE, SIZE), bool)


def seen(*x: float, z: tuple[float, ...] = (), opacity: float = 0.8) -> tuple[Splats, ProjectedView]:
    """Round rows of 0.2 at x, and the frame of CAMERA."""
    n = len(x)
    means = np.zeros((n, 3), np.float32)
    means[:, 0], means[:, 2] = x, z or 0.0
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    splats = Splats(
        means=means,
        quats=quats,
        scales=np.full((n, 3), 0.2, np.float32),
        opacities=np.full(n, opacity, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
    )
    return splats, project(splats, CAMERA)


def test_a_flat_change_is_followed_and_a_checkerboard_is_not() -> None:
    _, frame = seen(0.0)
    flat = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    fine = np.where((np.indices((SIZE, SIZE)).sum(0) % 2 == 0)[..., None], flat, -flat)
    assert abs(Evidence.of(frame, flat, EVERYWHERE).followed - 1) < 1e-4
    assert Evidence.of(frame, flat, EVERYWHERE).doubt < 1e-3
    assert Evidence.of(frame, fine, EVERYWHERE).followed < 0.01
    # By hand: the variance of +-0.3 is 0.09.
    np.testing.assert_allclose(Evidence.of(frame, fine, EVERYWHERE).spread, 0.09, rtol=0.01)


def test_footprints_are_the_sum_of_alpha_over_an_unbounded_picture() -> None:
    _, frame = seen(0.0, opacity=0.8)
    _, alpha, _ = frame.rasterize()
    # The kernel leaves out alpha below 1/255, a share of 1 / (255 * 0.8) of the integral.
    np.testing.assert_allclose(footprints(frame)[0] * (1 - 1 / (255 * 0.8)), alpha.sum(), rtol=0.01)


def test_only_what_a_view_hides_of_a_row_holds_it() -> None:
    _, frame = seen(0.0, 0.02, z=(-0.5, 0.5), opacity=0.95)  # front to back: the second one is behind the first
    fine = np.where((np.indices((SIZE, SIZE)).sum(0) % 2 == 0)[..., None], np.float32(0.3), np.float32(-0.3))
    change = np.repeat(fine, 3, 2)
    front, back = Evidence.of(frame, change, EVERYWHERE).hold(frame)
    assert back > 5 * max(front, 0)
    flat = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    assert Evidence.of(frame, flat, EVERYWHERE).hold(frame).max() < 1e-3 * back
