"""The surface of Gaussians whose true surface has a formula, and of geometry that has none."""

import math

import numpy as np
import pytest

from splatpainter.kernels.library import kernels
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.surface_samples import SurfaceSamples, _order_of

WIDTH = 0.02
"""Of the Gaussians, world units."""


def patches(points, normals, seed=0, width=WIDTH, opacity=0.9):
    """Irregular flat Gaussians: centres off the surface by 0.08 widths, a seventh as thick as wide."""
    rng = np.random.default_rng([seed, 1])
    count = len(points)
    quats = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], 0 * normals[:, 0]], 1)
    quats[normals[:, 2] < -0.999] = [0, 1, 0, 0]
    means = points + width * 0.08 * rng.normal(size=(count, 3))
    scales = width * np.exp(0.3 * rng.normal(size=(count, 2)))
    scales = np.concatenate([scales, np.full((count, 1), 0.15 * width)], 1)
    return splats_of(means, quats, scales, np.full(count, opacity))


def splats_of(means, quats, scales, opacities):
    sh = np.zeros((len(means), 1, 3), np.float32)
    means, quats, scales, opacities = (np.asarray(array, np.float32) for array in (means, quats, scales, opacities))
    return Splats(means, quats, scales, opacities, sh)


def joined(*parts):
    names = ("means", "quats", "scales", "opacities", "sh")
    means, quats, scales, opacities, sh = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    return Splats(means, quats, scales, opacities, sh)


def plane(count, seed=0, z=0.0, **options):
    """`count` patches in the unit square."""
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * [1, 1, 0] + [0, 0, z]
    return patches(points, np.tile([0.0, 0.0, 1.0], (count, 1)), seed, **options)


def above(count, seed=1, noise=0.1, slant=0.3):
    """(points near z = 0, slanted directions downwards)."""
    rng = np.random.default_rng([seed, 1])
    points = np.concatenate([rng.uniform(-0.35, 0.35, (count, 2)), noise * WIDTH * rng.normal(size=(count, 1))], 1)
    return points, unit(np.concatenate([slant * rng.normal(size=(count, 2)), -np.ones((count, 1))], 1))


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def ask(splats, points, directions, width=1.3 * WIDTH):
    return Surface.of(splats).at(points, directions, np.full(len(points), width))


def angles(normals, truth):
    return np.degrees(np.arccos(np.clip((normals * truth).sum(1), -1, 1)))


def sphere(count, seed=0):
    directions = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    return patches(0.5 * directions, directions, seed)


def ask_sphere(splats, count=500):
    rng = np.random.default_rng(1)
    out = unit(rng.normal(size=(count, 3)))
    directions = unit(-out + 0.3 * rng.normal(size=(count, 3)))
    return out, directions, ask(splats, 0.5 * out - directions * WIDTH * rng.uniform(-1, 1, (count, 1)), directions)


def test_a_sphere_is_found_to_a_twentieth_of_a_width():
    """Density as on coarse assets (10,000 Gaussians of width 0.02 on an area of pi); no bias inwards or outwards."""
    _, directions, result = ask_sphere(sphere(10_000))
    radius = np.linalg.norm(result.points, axis=1)
    heights = (radius - 0.5) / WIDTH
    assert np.median(np.abs(heights)) < 0.05 and abs(np.median(heights)) < 0.04
    assert np.quantile(np.abs(heights), 0.95) < 0.15
    assert np.median(angles(result.normals, result.points / radius[:, None])) < 2.5
    assert ((result.normals * directions).sum(1) < 0).all()  # towards the viewer
    assert np.median(result.trust) > 0.9


@pytest.mark.parametrize(("gap", "error"), [(1.5, 0.06), (2, 0.05), (4, 0.05)])
def test_both_sides_of_a_thin_wall_keep_their_heights(gap, error):
    """Walls of 1.5 and more widths; nearer ones are one surface, which the next test bounds."""
    wall = joined(plane(4000), plane(4000, seed=5, z=-gap * WIDTH))
    points, directions = above(500)
    front = ask(wall, points, directions)
    back = ask(wall, points * [1, 1, -1] - [0, 0, gap * WIDTH], directions * [1, 1, -1])
    assert np.median(np.abs(front.points[:, 2])) < error * WIDTH
    assert np.median(np.abs(back.points[:, 2] + gap * WIDTH)) < error * WIDTH
    assert front.normals[:, 2].min() > 0 and back.normals[:, 2].max() < 0


@pytest.mark.parametrize("gap", [0.5, 1])
def test_a_wall_thinner_than_its_gaussians_stays_on_its_own_half(gap):
    wall = joined(plane(4000), plane(4000, seed=5, z=-gap * WIDTH))
    points, directions = above(500)
    heights = ask(wall, points, directions).points[:, 2] / WIDTH
    assert np.median(np.abs(heights)) < 0.2 and (heights < -0.5 * gap).mean() < 0.15


def test_a_crease_stays_sharp():
    rng = np.random.default_rng(3)
    count, side = 6000, np.where(rng.random(6000) < 0.5, -1.0, 1.0)
    root = math.sqrt(0.5)
    run = rng.uniform(0, 0.5, count)
    points = np.stack([side * run * root, rng.uniform(-0.5, 0.5, count), -run * root], 1)
    roof = patches(points, np.stack([side * root, 0 * side, 0 * side + root], 1))
    x = np.concatenate([np.linspace(-4, -1, 200), np.linspace(1, 4, 200)]) * WIDTH
    queries = np.stack([x, rng.uniform(-0.4, 0.4, 400), -np.abs(x)], 1)
    result = ask(roof, queries, np.tile([0.0, 0.0, -1.0], (400, 1)))
    truth = np.stack([np.sign(x) * root, 0 * x, 0 * x + root], 1)
    heights = ((result.points - queries) * truth).sum(1) / WIDTH
    assert np.median(np.abs(heights)) < 0.05 and np.median(angles(result.normals, truth)) < 3


def test_fog_and_floaters_are_outvoted():
    rng = np.random.default_rng(7)
    count = 1500
    fog = splats_of(
        rng.uniform(-0.5, 0.5, (count, 3)) * [1, 1, 0.3],
        rng.normal(size=(count, 4)),
        np.full((count, 3), 1.5 * WIDTH),
        np.full(count, 0.1),
    )
    points, directions = above(500)
    result = ask(joined(plane(4000), fog), points, directions)
    assert np.median(np.abs(result.points[:, 2])) < 0.1 * WIDTH
    assert np.quantile(np.abs(result.points[:, 2]), 0.9) < 0.5 * WIDTH


def test_a_cloud_of_round_gaussians_has_its_surface_where_light_stops():
    """Centres spread evenly through 0 .. -3 widths below z = 0, as an optimised asset has them: the surface of centres
    lies 1.5 widths down, what is seen lies near 0."""
    rng = np.random.default_rng(2)
    count = 15_000
    means = rng.uniform(-0.5, 0.5, (count, 3)) * [1, 1, 0] - [0, 0, 1] * rng.uniform(0, 3 * WIDTH, (count, 1))
    scales = WIDTH * np.exp(0.2 * rng.normal(size=(count, 3)))
    cloud = splats_of(means, rng.normal(size=(count, 4)), scales, np.full(count, 0.7))
    points, directions = above(500)
    result = ask(cloud, points, directions)
    assert abs(np.median(result.points[:, 2])) < 0.7 * WIDTH
    assert np.median(result.residuals) > 0.27  # CLOUDY_RESIDUAL
    assert np.median(result.trust) < 0.8


def test_trust_tells_a_surface_from_none():
    points, directions = above(300)
    rng = np.random.default_rng(4)
    noise = splats_of(
        rng.uniform(-0.5, 0.5, (20_000, 3)) * [1, 1, 0.2],
        rng.normal(size=(20_000, 4)),
        WIDTH * np.exp(rng.normal(size=(20_000, 3))),
        np.full(20_000, 0.3),
    )
    good, bad = ask(plane(4000), points, directions), ask(noise, points, directions)
    assert np.quantile(good.trust, 0.1) > 0.9
    assert np.quantile(bad.trust, 0.9) < 0.7
    far = ask(plane(4000), points + [0, 0, 50], directions)
    assert (far.trust == 0).all() and (far.patches == 0).all()


def test_size_and_position_do_not_matter():
    """Scales from 1e-12 to 1e9: the same surface, in its own units."""
    base = plane(3000)
    points, directions = above(200)
    expected = ask(base, points, directions)
    for factor in (1e-12, 1e-6, 1e4, 1e9):
        scaled = splats_of(base.means * factor, base.quats, base.scales * factor, base.opacities)
        result = ask(scaled, points * factor, directions, 1.3 * WIDTH * factor)
        np.testing.assert_allclose(result.points / factor, expected.points, atol=2e-3 * WIDTH)
        np.testing.assert_allclose(result.normals, expected.normals, atol=2e-3)
        np.testing.assert_allclose(result.trust, expected.trust, atol=2e-3)


def test_gaussians_that_cannot_be_drawn_change_nothing():
    base = plane(3000)
    points, directions = above(100)
    broken = splats_of(
        np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, 0], [0, 0, 0]]),
        np.array([[1, 0, 0, 0], [1, 0, 0, 0], [np.nan, 0, 0, 0], [1, 0, 0, 0]]),
        np.array([[1, 1, 1], [1, 1, 1], [1, 1, 1], [1, np.nan, 1]]),
        np.full(4, 0.9),
    )
    expected, result = ask(base, points, directions), ask(joined(base, broken), points, directions)
    assert (result.points == expected.points).all() and (result.trust == expected.trust).all()


def test_queries_that_are_no_queries_have_no_surface():
    points, directions = above(4)
    points[0, 0], directions[1, 0] = np.nan, np.nan
    result = Surface.of(plane(500)).at(points, directions, np.array([WIDTH, WIDTH, np.nan, -1]))
    assert (result.patches[[0, 2, 3]] == 0).all() and (result.trust[[0, 2, 3]] == 0).all()
    assert np.isfinite(result.trust).all()


def test_samples_are_ordered_by_level_then_cell_equal_ones_as_they_come():
    rng = np.random.default_rng(3)
    level, keys = rng.integers(0, 24, 5000), rng.integers(0, 1 << 60, 40)[rng.integers(0, 40, 5000)]
    assert np.array_equal(_order_of(level, keys), np.lexsort((keys, level)))
    # Numbers that differ in one of their parts alone.
    for shift in (0, 16, 32, 48, 58):
        keys = rng.integers(0, 4, 500) << shift
        assert np.array_equal(_order_of(np.zeros(500, np.int64), keys), np.argsort(keys, kind="stable"))


def test_few_gaussians():
    for count in (0, 1, 2, 50):
        points, directions = above(50)
        result = ask(plane(count), points, directions, 0.2)
        assert np.isfinite(result.points).all() and np.isfinite(result.trust).all()
        assert (result.trust <= 1).all() and (result.trust >= 0).all()
    assert np.median(np.abs(result.points[:, 2])) < WIDTH  # fifty are a plane


def test_many_gaussians_at_one_point_and_tiny_ones_in_a_huge_window_end():
    """A walk over all cells of the window would take 1e9 steps per query here, and this test hours."""
    count = 200_000
    one = splats_of(
        np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), WIDTH), np.full(count, 0.5)
    )
    points, directions = above(20)
    surface = Surface.of(one)
    result = surface.at(points, directions, np.full(20, WIDTH))
    dust = plane(count, width=1e-5)
    huge = Surface.of(joined(dust, plane(50, width=0.5, z=3))).at(points, directions, np.full(20, 2.0))
    assert np.isfinite(result.trust).all() and np.isfinite(huge.trust).all()


def test_one_search_looks_at_bounded_numbers_and_finds_what_brute_force_finds():
    rng = np.random.default_rng(0)
    count = 4000
    scales = 10 ** rng.uniform(-4, -1, (count, 3))
    many = splats_of(rng.uniform(-1, 1, (count, 3)), rng.normal(size=(count, 4)), scales, np.full(count, 0.9))
    s = SurfaceSamples.of(many)
    assert len(s.cell_sizes) > 4
    out, number = np.empty(count + 1, np.int64), np.zeros(1, np.int64)
    arrays = (s.keys, s.level_starts, s.cell_sizes, s.reaches, s.min_corner, s.patches)
    for window in (1e-3, 0.02, 0.2):
        for point in rng.uniform(-1.2, 1.2, (20, 3)):
            kernels.probe_gather(*arrays, point, window, out, number, 0, 1)
            square = ((s.patches[:, :3].astype(np.float64) - point) ** 2).sum(1)
            reach = s.patches[:, 12].astype(np.float64) ** 2 + window**2
            np.testing.assert_array_equal(np.sort(out[: number[0]]), np.flatnonzero(square < 2.5**2 * reach))
    kernels.probe_gather(*arrays, np.zeros(3), 10.0, np.empty(101, np.int64), number, 0, 1)
    assert number[0] == 101


def test_equal_bits_for_any_number_of_threads_and_any_batch(monkeypatch):
    digests = set()
    splats = joined(sphere(4000), plane(3000))
    for threads in ("1", "2", "3"):
        monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
        answers = vars(ask(splats, *above(700))).values()
        digests.add(b"".join(np.ascontiguousarray(values).tobytes() for values in answers))
    assert len(digests) == 1
    points, directions = above(100)
    together = ask(splats, points, directions)
    alone = [ask(splats, points[k : k + 1], directions[k : k + 1]) for k in (0, 50, 99)]
    for k, result in zip((0, 50, 99), alone, strict=True):
        assert (result.points[0] == together.points[k]).all() and result.trust[0] == together.trust[k]


@pytest.mark.parametrize("count", [300, 20_000])
def test_queries_that_share_a_search_find_what_each_finds_alone(count: int):
    """count: samples; the many are more than one search may find."""
    rng = np.random.default_rng(count)
    means = rng.uniform(-1, 1, (count, 3)) * (1, 1, 0.02)
    scales = 10 ** rng.uniform(-3, -1, (count, 3))
    surface = Surface.of(splats_of(means, rng.normal(size=(count, 4)), scales, np.full(count, 0.9)))
    # Close together, so that dozens of queries search at once, in windows of very different sizes; some are none.
    points, directions = above(400)
    points, widths = 0.3 * points, 10 ** rng.uniform(-2, -1, 400)
    points[::50], widths[::70] = np.nan, 0
    together = surface.at(points, directions, widths)
    mixed = rng.permutation(400)
    again = surface.at(points[mixed], directions[mixed], widths[mixed])
    for name, values in vars(together).items():
        alone = [getattr(surface.at(points[[k]], directions[[k]], widths[[k]]), name)[0] for k in range(400)]
        assert values.tobytes() == np.array(alone).tobytes(), name
        assert values[mixed].tobytes() == getattr(again, name).tobytes(), name
    assert (together.patches > 0).mean() > 0.9
