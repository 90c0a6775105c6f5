"""Edits on dense Gaussians: a sphere of known normals, formulas in float64, and renders of what was painted."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatpainter.cameras import Camera, look_at
from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.grading import color_grading
from splatpainter.rendering import render
from splatpainter.splats import SH_C0, Splats
from splattrain.data.edits import change_masks, on_surfels
from splattrain.data.edits.content import PaintCoverage


def sphere(
    count: int = 6000, radius: float = 0.5, middle: tuple[float, float, float] = (0, 0, 0)
) -> Splats[torch.Tensor]:
    """Flat Gaussians evenly on a sphere, grey. Their normals: (means - middle) / radius."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    size = radius * math.sqrt(4 * math.pi / count) * 0.6
    w = np.sqrt(np.maximum((1 + normals[:, 2]) / 2, 1e-9))  # the shortest turn from z to the normal
    quats = np.stack([w, -normals[:, 1] / (2 * w), normals[:, 0] / (2 * w), np.zeros(count)], 1)
    scales = np.tile([size, size, size / 20], (count, 1))
    attributes = (normals * radius + middle, quats, scales, np.full(count, 0.98), np.zeros((count, 4, 3)))
    return Splats(*attributes).torch()


def camera(eye: tuple[float, float, float] = (0, 0, 3), size: int = 96) -> Camera:
    return look_at(eye, (0, 0, 0), width=size, height=size, fov=24)


def shot(splats: Splats[torch.Tensor], view: Camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    drawn = render(splats, view)
    return drawn.colors[0], drawn.depths[0, ..., 0], drawn.alphas[0, ..., 0]


def test_a_view_shows_the_side_of_a_sphere_that_faces_it() -> None:
    ball, view = sphere(), camera()
    _, depth, alpha = shot(ball, view)
    normals = ball.means / 0.5
    towards = torch.nn.functional.normalize(torch.tensor([0.0, 0, 3]) - ball.means, dim=-1)
    cosine = (normals * towards).sum(1)
    seen = on_surfels.view_visibility(ball.means, normals, view, depth, alpha)
    assert (seen[cosine > on_surfels.FULL_PAINT_COSINE + 0.01] == 1).all()
    assert (seen[cosine < on_surfels.MIN_PAINT_COSINE] == 0).all()
    between = (cosine > 0.15) & (cosine < 0.25)
    assert ((seen[between] > 0) & (seen[between] < 1)).all()


def test_what_stands_behind_something_is_not_seen() -> None:
    near, far = sphere(), sphere(3000, 0.4, (0, 0, -1.5))
    both, view = near.append(far), camera()
    _, depth, alpha = shot(both, view)
    normals = torch.cat([near.means / 0.5, (far.means - torch.tensor([0, 0, -1.5])) / 0.4])
    seen = on_surfels.view_visibility(both.means, normals, view, depth, alpha)
    assert seen[: len(near)].max() == 1
    assert seen[len(near) :].max() == 0  # the far one hides behind the near one
    beside = camera((2.5, 0, 2.5))
    _, depth, alpha = shot(both, beside)
    assert on_surfels.view_visibility(both.means, normals, beside, depth, alpha)[len(near) :].max() == 1


def test_without_normals_depth_alone_decides() -> None:
    ball, view = sphere(), camera()
    _, depth, alpha = shot(ball, view)
    seen = on_surfels.view_visibility(ball.means, None, view, depth, alpha)
    assert (seen[ball.means[:, 2] > 0.25] == 1).all() and (seen[ball.means[:, 2] < -0.15] == 0).all()


def test_gaussians_outside_the_picture_or_behind_the_camera_are_not_seen() -> None:
    view = camera()
    means = torch.tensor([[0.0, 0, 5], [3, 0, 0], [0, 0, 0], [float("nan"), 0, 0]])
    surface, solid = torch.full((96, 96), 3.0), torch.ones(96, 96)
    seen = on_surfels.view_visibility(means, None, view, surface, solid)
    assert seen.tolist() == [0, 0, 1, 0]


def test_a_layer_is_carried_to_projections_as_bilinear_sampling_says() -> None:
    rng = np.random.default_rng(0)
    layer, view = rng.random((96, 96, 4)), camera()
    means = np.concatenate([rng.uniform(-0.5, 0.5, (200, 3)), [[9, 0, 0], [0, 0, 9]]])
    colors, coverage = on_surfels.project_layer(torch.from_numpy(layer), view, torch.from_numpy(means))
    local = means @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    pixel = view.fx * local[:, :2] / local[:, 2:] + 48 - 0.5
    packed = np.concatenate([layer[..., :3] * layer[..., 3:], layer[..., 3:]], -1)
    for i in range(200):
        (x, y), (left, top) = pixel[i], np.floor(pixel[i]).astype(int)
        corners = [(u, v) for u in (left, left + 1) for v in (top, top + 1)]
        mixed = np.sum([(1 - abs(x - u)) * (1 - abs(y - v)) * packed[v, u] for u, v in corners], 0)
        np.testing.assert_allclose(coverage[i], mixed[3], atol=1e-6)
        np.testing.assert_allclose(colors[i], mixed[:3] / mixed[3], atol=1e-5)
    assert (coverage[200:] == 0).all()


def test_paint_covers_in_every_direction_and_leaves_other_gaussians_their_bits() -> None:
    sh = torch.randn(50, 4, 3)
    before = sh.clone()
    coverage = torch.tensor([0.0] * 20 + [on_surfels.MIN_COVERAGE / 2] * 10 + [0.5] * 10 + [1.0] * 10)
    coat = PaintCoverage(torch.rand(50, 3), coverage)
    after = on_surfels.apply_paint(sh, coat)
    assert (sh == before).all() and (after[:30] == sh[:30]).all()
    paint = torch.zeros(50, 4, 3)
    paint[:, 0] = (coat.colors - 0.5) / SH_C0
    np.testing.assert_allclose(after[30:40], (sh[30:40] + paint[30:40]) / 2, atol=1e-6)
    np.testing.assert_allclose(on_surfels.display_colors(after)[40:], coat.colors[40:], atol=1e-6)
    assert after[40:, 1:].abs().max() < 1e-6


def test_the_render_of_painted_gaussians_is_the_picture_with_the_layer() -> None:
    ball, view = sphere(20000), camera()
    before, depth, alpha = shot(ball, view)
    layer = torch.zeros(96, 96, 4)
    layer[30:66, 40:60] = torch.tensor([0.9, 0.2, 0.1, 1.0])
    colors, coverage = on_surfels.project_layer(layer, view, ball.means)
    seen = on_surfels.view_visibility(ball.means, ball.means / 0.5, view, depth, alpha)
    coat = PaintCoverage(colors, coverage * seen)
    edited = replace(ball, sh=on_surfels.apply_paint(ball.sh, coat))
    after, _, _ = shot(edited, view)
    np.testing.assert_allclose(after[34:62, 44:56], torch.tensor([0.9, 0.2, 0.1]).expand(28, 12, 3), atol=0.03)
    outside = torch.ones(96, 96, dtype=torch.bool)
    outside[26:70, 36:64] = False
    np.testing.assert_allclose(after[outside], before[outside], atol=0.004)
    mask = change_masks(before[None], after[None])[0]
    assert mask[31:65, 41:59].all() and not mask[outside].any()
    back, _, _ = shot(edited, camera((0, 0, -3)))
    np.testing.assert_allclose(back, shot(ball, camera((0, 0, -3)))[0], atol=0.004)  # of paint on the front


def test_lit_paint_is_as_bright_as_the_light_on_the_surface() -> None:
    albedo = torch.rand(40, 3) * 0.8 + 0.1
    light = torch.linspace(0.1, 1, 40)[:, None]
    reflected = linear_to_srgb(albedo * light)
    sh = ((reflected - 0.5) / SH_C0)[:, None]
    paint = torch.rand(40, 3)
    expected = linear_to_srgb(srgb_to_linear(paint) * light)
    np.testing.assert_allclose(on_surfels.shade_paint(paint, sh, albedo), expected, atol=1e-4)


def test_a_regrade_of_matt_gaussians_is_the_look_of_their_colours() -> None:
    look = color_grading.random_grade(np.random.default_rng(1))
    colors = torch.rand(60, 3)
    out = on_surfels.grade_sh(((colors - 0.5) / SH_C0)[:, None], look)
    np.testing.assert_allclose(0.5 + SH_C0 * out[:, 0], color_grading.apply_grade(colors, look), atol=1e-6)


def test_a_regrade_of_a_small_lobe_is_the_look_of_what_each_direction_shows() -> None:
    look = color_grading.ColorGrade(contrast=1.4, saturation=1.5, curve=((0.0, 0.0), (0.5, 0.6), (1.0, 1.0)))
    generator = torch.Generator().manual_seed(0)
    sh = torch.randn(200, 4, 3, generator=generator, dtype=torch.float64) * 0.01
    sh[:, 0] = (torch.rand(200, 3, generator=generator, dtype=torch.float64) * 0.5 + 0.25 - 0.5) / SH_C0
    out = on_surfels.grade_sh(sh, look)
    c1 = 0.4886025119029199
    for x, y, z in ((0.0, 0.0, 1.0), (0.6, -0.8, 0.0)):
        basis = torch.tensor([SH_C0, -c1 * y, c1 * z, -c1 * x], dtype=torch.float64)[:, None]
        expected = color_grading.apply_grade(0.5 + (basis * sh).sum(1), look)
        inner = ((expected > 0.04) & (expected < 0.96)).all(1)  # a lobe that clips has no derivative
        assert inner.sum() > 100
        np.testing.assert_allclose((0.5 + (basis * out).sum(1))[inner], expected[inner], atol=5e-4)


def test_masks_hold_what_differs_without_lone_pixels() -> None:
    before = torch.full((2, 20, 20, 3), 0.5)
    after = before.clone()
    after[0, 5:9, 5:9, 1] += 0.05
    after[0, 15, 15] += 0.3  # one pixel
    after[1, 3:6, 3:6] += 0.015  # too little
    masks = change_masks(before, after)
    expected = torch.zeros(20, 20, dtype=torch.bool)
    expected[4:10, 4:10] = True
    assert (masks[0] == expected).all() and not masks[1].any()


@pytest.mark.parametrize(("close", "closed"), [(0, False), (2, True)])
def test_masks_can_close_gaps(close: int, closed: bool) -> None:
    before = torch.full((1, 30, 30, 3), 0.5)
    after = before.clone()
    after[0, 10:20, 5:12] += 0.2
    after[0, 10:20, 16:24] += 0.2
    mask = change_masks(before, after, grow_px=0, close_px=close)[0]
    assert bool(mask[10:20, 5:24].all()) == closed
    assert not mask[:9].any() and not mask[:, :4].any()
