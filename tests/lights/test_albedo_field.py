"""The second reading of a captured light, against its definition, and what it adds to the first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.color import luminance
from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights import albedo_field, source_light
from splatpainter.lights.albedo_field import (
    BLEND,
    FIELD,
    FieldWitnesses,
    both_readings,
    field_witnesses,
)
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.light_prior import upright, usual_light
from splatpainter.lights.light_set import turned_sky
from splatpainter.lights.prepared import _estimate
from splatpainter.lights.skies import sky
from splatpainter.lights.source_light import by_patches, estimate_source, unclipped
from splatpainter.splats import SH_C0
from splatpainter.transforms import fibonacci_sphere, sh_rotations
from tests.support.cli_scenes import ball

UP = np.array([0.0, 1.0, 0.0])


def witnesses(seed: int = 0, count: int = 90) -> FieldWitnesses:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    transfer = unoccluded_transfer(normals).astype(np.float64) / np.pi / SH_C0
    points = normals + 0.3 * rng.normal(size=(count, 3))
    return FieldWitnesses(
        rng.normal(-1, 0.5, count), rng.uniform(0, 0.05, count), transfer, points, 3 + np.arange(count)
    )


def turned(seen: FieldWitnesses, turn: np.ndarray) -> FieldWitnesses:
    first, second = sh_rotations(turn, 2)[1:]
    transfer = np.concatenate(
        [seen.transfer[:, :1], seen.transfer[:, 1:4] @ first.T, seen.transfer[:, 4:] @ second.T], 1
    )
    return replace(seen, transfer=transfer, positions=seen.positions @ turn.T)


def test_the_field_is_conditioned_on_what_is_seen() -> None:
    """Where no place is dark the last round is one linear step: the posterior of the light among all Gaussian variables
    (albedos and light together), by the inverse of their joint covariance."""
    seen = witnesses()
    axes, turn = upright(UP)
    result = albedo_field._field_light(seen, axes, turn)
    mean, covariance = usual_light(FIELD.skies)
    slopes = seen.transfer[:, 1:] @ turn
    # The fixed point of Gauss and Newton, by its own rounds until nothing moves.
    at = result.copy()
    for _ in range(50):
        lit = np.maximum(seen.transfer[:, 0] + slopes @ at, FIELD.darkest)
        jacobian = slopes / lit[:, None] * (lit > FIELD.darkest)[:, None]
        joint = jacobian @ covariance @ jacobian.T + albedo_field._covariance(seen, axes)
        off = seen.logs - np.log(lit) + jacobian @ (at - mean)
        at = mean + covariance @ jacobian.T @ np.linalg.solve(joint, off)
    np.testing.assert_allclose(result, at, atol=0.03)


def test_albedos_are_alike_near_each_other_all_around_and_by_height() -> None:
    seen, (axes, _) = witnesses(6, 50), upright(UP)
    result = albedo_field._covariance(seen, axes)
    points, normals = seen.positions, seen.normals
    middle = (points.max(0) + points.min(0))[[0, 2]] / 2
    rings = np.hypot(*(points[:, [0, 2]] - middle).T)
    for one, other in ((0, 1), (7, 3), (20, 40)):
        near = ((points[one] - points[other]) ** 2).sum() / (2 * FIELD.near_length**2)
        around = (rings[one] - rings[other]) ** 2 + (points[one, 1] - points[other, 1]) ** 2
        expected = (
            FIELD.level**2
            + FIELD.near**2 * np.exp(-near)
            + FIELD.around**2 * np.exp(-around / (2 * FIELD.around_length**2))
            + FIELD.unexplained**2 * np.exp(FIELD.unexplained_narrowness * (normals[one] @ normals[other] - 1))
            + FIELD.below**2 * normals[one, 1] * normals[other, 1]
        )
        # The middle is that of a box along the frame's own axes, which are those of the asset here.
        assert result[one, other] == pytest.approx(expected, rel=1e-6)
    alone = result[4, 4] - (FIELD.level**2 + FIELD.near**2 + FIELD.around**2 + FIELD.unexplained**2)
    alone -= FIELD.below**2 * normals[4, 1] ** 2
    noise = FIELD.noise**2 + FIELD.noise_within**2 * seen.spread[4] / np.sqrt(seen.members[4])
    assert alone == pytest.approx(noise + 1e-4, rel=1e-3)


def test_turning_an_asset_about_the_vertical_turns_the_answer() -> None:
    seen, first = witnesses(1), np.random.default_rng(2).normal(0, 0.3, 8)
    angle = 0.7
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    one, two = sh_rotations(turn, 2)[1:]
    straight = both_readings(first, seen, UP)
    after = both_readings(np.concatenate([one @ first[:3], two @ first[3:]]), turned(seen, turn), UP)
    # The middle of what is seen is that of a box along the axes, which is another box when it is turned.
    np.testing.assert_allclose(after, np.concatenate([one @ straight[:3], two @ straight[3:]]), atol=0.05)
    # Another way up is another question.
    assert np.abs(both_readings(first, seen, -UP) - straight).max() > 0.1


def test_the_second_reading_never_strays_far_from_the_first() -> None:
    seen, turn = witnesses(3), upright(UP)[1]
    for size, expected in ((3.0, FIELD.farthest), (0.0, None)):
        first = np.zeros(8)
        first[2] = size
        both, before, second = turn.T @ both_readings(first, seen, UP), turn.T @ first, np.empty(8)
        # What the second reading was, from what both together say.
        for rows, sets in zip(
            (BLEND.zero, BLEND.one, BLEND.two), ([(1, 5)], [(2, 6), (0, 4)], [(7,), (3,)]), strict=True
        ):
            for of in map(list, sets):
                weights, count = np.array(rows), len(of)
                rest = both[of] - weights[:, :count] @ before[of] - weights[:, 2 * count :].sum(1)
                second[of] = np.linalg.solve(weights[:, count : 2 * count], rest)
        away = float(np.linalg.norm(second - before))
        assert away == pytest.approx(expected) if expected else 0 < away <= FIELD.farthest + 1e-9


def test_too_few_observations_leave_the_first_reading() -> None:
    rng = np.random.default_rng(0)
    assert field_witnesses(rng.uniform(0.1, 0.9, (30, 3)), rng.normal(size=(30, 9)), rng.normal(size=(30, 3))) is None
    # Many places that all are one observation.
    one = np.full((500, 3), 0.4), np.ones((500, 9)), np.zeros((500, 3))
    assert field_witnesses(*one) is None


def test_observations_are_means_of_those_with_most_members() -> None:
    rng = np.random.default_rng(5)
    normals = fibonacci_sphere(4000)
    light = np.repeat(rng.uniform(0.2, 0.8, (4000, 1)), 3, 1)
    transfer = unoccluded_transfer(normals).astype(np.float64) / np.pi / SH_C0
    seen = field_witnesses(light, transfer, normals.astype(np.float32))
    assert seen is not None and len(seen.logs) <= FIELD.count and (np.diff(seen.members) <= 0).all()
    assert (np.sum(seen.normals * seen.positions, 1) > 0.8).all()
    assert np.log(0.2) <= seen.logs.min() and seen.logs.max() <= np.log(0.81) and (seen.spread >= 0).all()


@pytest.mark.parametrize("name", ["sunset", "noon"])
def test_paint_that_goes_with_height_misleads_less(name: str) -> None:
    """Balls painted in six bands, from top to bottom: the light is to be told from the way around."""
    splats = ball(6000)
    surface = LitSurface.of(splats, shadows=False)
    light = turned_sky(sky(name), np.eye(3))
    received = surface.from_sky(light / (light[0].mean() * SH_C0))
    basis = unoccluded_transfer(fibonacci_sphere(96)).astype(np.float64) / (np.pi * SH_C0)
    errors = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        band = ((splats.means[:, 1] + 1) * 3).astype(int).clip(0, 5)
        paint = 0.2 * rng.lognormal(0, 0.5, 6)[band] * rng.lognormal(0, 0.1, 6000)
        colors = (paint[:, None] * received).clip(0, 1)
        usable = surface.facing.trusted & unclipped(colors)
        first = by_patches(colors[usable], surface.transfer[usable] / SH_C0, surface.points[usable], "+y")
        assert first is not None
        alone = estimate_source(colors, surface.transfer, surface.points, surface.facing.trusted, "+y", both=False)
        np.testing.assert_array_equal(alone.coefficients, first.light.coefficients)
        both = estimate_source(colors, surface.transfer, surface.points, surface.facing.trusted, "+y")

        def shape(coefficients: np.ndarray) -> np.ndarray:
            total = luminance(coefficients)
            return basis @ (total / total[0])

        errors.append([((shape(c.coefficients) - shape(light)) ** 2).mean() for c in (first.light, both)])
    single, together = np.sqrt(np.array(errors)).mean(0)
    assert together < 0.8 * single


def test_flat_oriented_patches_keep_the_first_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their normals are known, and what the second reading is made of was learnt where they are not."""
    calls = []

    def witnesses_of(*arguments: np.ndarray) -> None:
        calls.append(arguments)

    monkeypatch.setattr(source_light, "field_witnesses", witnesses_of)
    splats = ball(3000)
    surface = LitSurface.of(splats)
    for oriented in (True, False):
        part = replace(surface, facing=replace(surface.facing, oriented=oriented))
        _estimate(splats, part, "+y")
        assert bool(calls) != oriented


def test_what_the_first_reading_is_sure_of_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """One grey paint under grey light leaves no doubt; spotted, it does."""
    rng, count = np.random.default_rng(0), 4000
    normals = fibonacci_sphere(count)
    transfer = unoccluded_transfer(normals).astype(np.float64) / np.pi
    received = transfer @ np.repeat([[1.0], [0.3], [0.2], *([[0.0]] * 6)], 3, 1) / SH_C0
    second = np.array([0.0, 0.2, 0, 0, 0, 0, 0, 0])
    monkeypatch.setattr(source_light, "both_readings", lambda first, seen, up: first + second)
    moves = []
    for spots in (0.0, 0.3):
        colors = 0.3 * np.exp(spots * rng.normal(size=(count, 1))) * received
        first, both = (
            estimate_source(colors, transfer, normals, np.ones(count, bool), "+y", both=with_second).coefficients
            for with_second in (False, True)
        )
        moves.append(float(np.abs(luminance(both - first)).max() / luminance(first)[0]))
    assert moves[0] < 0.02 and moves[1] > 0.15, moves
