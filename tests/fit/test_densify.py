"""Density control: who is cloned, split and removed, and when."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from splatpainter.cameras import look_at
from splatpainter.fit.densify import DensityOptions, Pulls, Round, Schedule, densify, reset_opacities
from splatpainter.fit.gradients import Pull
from splatpainter.fit.parameters import RawGaussians
from splatpainter.splats import Splats

OPTIONS = DensityOptions()


def parameters(scales, opacities) -> RawGaussians:
    rng = np.random.default_rng(0)
    n = len(scales)
    raw = Splats(
        means=rng.random((n, 3)).astype(np.float32),
        quats=rng.standard_normal((n, 4)).astype(np.float32),
        scales=np.repeat(np.array(scales, np.float32)[:, None], 3, 1),
        opacities=np.array(opacities, np.float32),
        sh=rng.random((n, 4, 3)).astype(np.float32),
    )
    return RawGaussians.of(raw)


def controlled(raw: RawGaussians, pulls, most: int = 100, prune_large: bool = False) -> Round:
    rng = np.random.default_rng(0)
    return densify(raw, np.array(pulls, np.float32), 1.0, OPTIONS, most, prune_large, rng)


def test_small_gaussians_are_cloned_large_ones_split_faint_ones_removed() -> None:
    raw = parameters([0.005, 0.05, 0.005, 0.05, 0.005], [0.9, 0.9, 0.9, 0.9, 0.001])
    done = controlled(raw, [3e-4, 3e-4, 1e-4, 1e-4, 9e-4])
    assert done.survivors.tolist() == [0, 2, 3]
    assert done.source.tolist() == [0, 2, 3, 0, 1, 1]
    new = done.parameters
    assert np.array_equal(new.means[3], raw.means[0]) and np.array_equal(new.sh[4], raw.sh[1])
    np.testing.assert_allclose(np.exp(new.scales[4:]), 0.05 / 1.6, rtol=1e-5)
    assert not np.array_equal(new.means[4], new.means[5])


def test_children_are_drawn_from_their_parent() -> None:
    """20,000 children of one turned ellipsoid have its mean and covariance, within sampling error."""
    one = parameters([0.05], [0.9])
    one.scales = np.log(np.array([[0.5, 0.2, 0.05]], np.float32))
    many = one.take(np.zeros(10_000, np.int64))
    done = controlled(many, np.full(10_000, 1.0), most=10**6)
    means = done.parameters.means.astype(np.float64)
    assert len(means) == 20_000
    turn = Rotation.from_quat(one.quats[0, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(means.mean(0), one.means[0], atol=0.015)
    expected = turn @ np.diag([0.5**2, 0.2**2, 0.05**2]) @ turn.T
    np.testing.assert_allclose(np.cov(means.T), expected, atol=0.01)


def test_the_hardest_pulled_come_first_where_there_is_no_room_for_all() -> None:
    raw = parameters([0.005] * 6, [0.9] * 6)
    done = controlled(raw, [5e-4, 9e-4, 3e-4, 8e-4, 1e-4, 7e-4], most=8)
    assert sorted(done.source.tolist()[6:]) == [1, 3]
    assert len(controlled(raw, [1.0] * 6, most=3).source) == 6, "a limit below the Gaussians adds none and removes none"


def test_huge_gaussians_go_once_opacities_were_reset() -> None:
    raw = parameters([0.005, 0.2], [0.9, 0.9])
    assert controlled(raw, [0, 0]).survivors.tolist() == [0, 1]
    assert controlled(raw, [0, 0], prune_large=True).survivors.tolist() == [0]


def test_gaussians_that_cannot_be_drawn_stay_as_they_are() -> None:
    raw = parameters([0.05, 0.05], [0.9, 0.9])
    raw.scales[0] = float("nan")
    done = controlled(raw, [1.0, 0.0])
    assert done.source.tolist() == [0, 1]


def test_opacities_are_reset_to_a_hundredth() -> None:
    raw = parameters([0.1, 0.1], [0.9, 0.004])
    reset_opacities(raw, 0.01)
    np.testing.assert_allclose(1 / (1 + np.exp(-raw.opacities)), [0.01, 0.004], rtol=1e-5)


def test_pulls_are_means_over_the_views_that_draw_a_gaussian_per_half_picture() -> None:
    camera = look_at((0, 0, 2), (0, 0, 0), width=40, height=20)
    pulls = Pulls(3)
    pulls.add(Pull(np.array([0, 2]), np.array([[0.3, 0.4], [1.0, 0.0]], np.float32), np.ones(2)), camera)
    pulls.add(Pull(np.array([2]), np.array([[0.0, 3.0]], np.float32), np.ones(1)), camera)
    np.testing.assert_allclose(pulls.mean(), [np.hypot(0.3 * 20, 0.4 * 10), 0, (20 + 30) / 2])


def test_the_original_schedule() -> None:
    due = [step for step in range(1, 30_001) if Schedule().due(step)]
    assert (due[0], due[1], due[-1], len(due)) == (500, 600, 15_000, 146)
    assert [step for step in range(1, 30_001) if Schedule().resets(step)] == [3000, 6000, 9000, 12_000, 15_000]
    assert Schedule.scaled(30_000, 50) == Schedule()


def test_short_runs_have_the_schedule_in_proportion() -> None:
    half = Schedule.scaled(15_000, 50)
    assert half == Schedule(250, 50, 7500, 1500)
    assert Schedule.scaled(1000, 24) == Schedule(25, 25, 500, 0), (
        "Gaussians settle between rounds, and nothing is reset"
    )
    assert Schedule.scaled(1000, 60) == Schedule(60, 60, 500, 0), "every view is seen between rounds"
    assert not any(Schedule.scaled(40, 24).due(step) for step in range(1, 41)), "too short to grow"
