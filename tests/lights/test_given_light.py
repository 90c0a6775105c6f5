"""How far an environment that is given beside relit pictures is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import UpAxis
from splatpainter.lights.given_light import HELD, LIMITS, NEARLY, ROUGHLY, LightFit, Trust, better_turn, chosen_trust
from splatpainter.lights.light_set import about_up, axes_of, turned_sky
from splatpainter.lights.match import MIN_WITNESSES, match_light
from splatpainter.lights.skies import sky
from splatpainter.splats import Splats
from tests.lights.test_match import linear, pictures, sh_light, textured_ball


def error(splats: Splats, truth: Splats) -> float:
    return float(np.abs(linear(splats) - linear(truth)).mean())


@pytest.mark.parametrize("level", [1.0, 0.4])
def test_a_true_environment_is_used_whatever_its_level(level: float) -> None:
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(level * sh_light("sunset"))
    seen = pictures(truth, 1)
    alone = match_light(asset, seen, shadows=False)
    helped = match_light(asset, seen, shadows=False, target=sh_light("sunset"))
    assert helped.environment is not None and helped.environment.trust is not None
    assert error(helped.asset.splats, truth) < 0.4 * error(alone.asset.splats, truth)
    assert helped.asset.receipt is not None and alone.asset.receipt is not None
    assert f"environment {helped.environment.trust.text}: held back, dB: alone" in helped.asset.receipt.note
    assert alone.environment is None and "environment" not in alone.asset.receipt.note


def test_an_environment_from_the_other_side_is_refused() -> None:
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(sh_light("sunset"))
    seen, turned = pictures(truth, 1), turned_sky(sky("sunset"), axes_of("+y"), 180)
    alone = match_light(asset, seen, shadows=False)
    refused = match_light(asset, seen, shadows=False, target=turned)
    assert refused.environment is not None and refused.environment.trust is None
    assert refused.asset.splats.sh.tobytes() == alone.asset.splats.sh.tobytes()
    assert refused.asset.receipt is not None
    assert "environment not used: the pictures are likelier with it turned by 180 degrees" in refused.asset.receipt.note


def test_an_environment_that_has_lost_its_sun_is_not_held() -> None:
    """As a file of 8 bits holds it: what is left is from the right side, and helps."""
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(0.8 * sh_light("sunset"))
    seen, cut = pictures(truth, 1), sh_light("sunset")
    cut[1:] *= 0.4
    alone, matched = (match_light(asset, seen, shadows=False, target=target) for target in (None, cut))
    assert matched.environment is not None and matched.environment.trust == ROUGHLY
    assert error(matched.asset.splats, truth) < 0.8 * error(alone.asset.splats, truth)


def test_what_was_held_back_says_how_far_an_environment_is_believed() -> None:
    def chosen(*scores: float, objection: str = "") -> Trust | None:
        return chosen_trust(dict(zip((None, HELD, NEARLY, ROUGHLY), scores, strict=True)), objection).trust

    assert chosen(20, 23, 22, 21) == HELD
    assert chosen(20, 22, 23, 23.5) == NEARLY, "what is looser has to be clearly better"
    assert chosen(20, 22, 23, 24.5) == ROUGHLY
    assert chosen(23, 20, 21.5, 22) == NEARLY, "pictures of one side are explained best by a light of their own"
    assert chosen(24, 20, 21, 21.5) is None
    assert chosen(20, 23, 20.5, 21, objection="turned") == NEARLY, "what they would have turned is not held"
    assert chosen(20, 23, 19.5, 20, objection="turned") is None
    assert chosen_trust({}).trust == NEARLY, "nothing is held back"
    assert chosen_trust({}, "turned").trust is None


def test_pictures_say_whether_they_would_rather_have_an_environment_turned() -> None:
    """Log odds of an environment, and of it turned in steps about the way up."""
    assert not better_turn(-2.0, [-12.0, -20.0, -18.0, -21.0, -20.0, -17.0, -7.0])
    assert not better_turn(-2.5, [-2.0, -2.5, -3.0, -3.0, -3.0, -3.0, -3.0]), "they hardly tell where it comes from"
    assert not better_turn(-12.0, [-10.0, -40.0, -40.0, -40.0, -40.0, -40.0, -40.0]), "a little turned"
    objection = better_turn(-12.0, [-20.0, -2.0, -18.0, -21.0, -20.0, -17.0, -17.0])
    assert "turned by 90 degrees (log odds 10.0)" in objection
    assert objection in chosen_trust({None: 20, HELD: 19, NEARLY: 19, ROUGHLY: 19}, objection).text


def test_an_environment_helps_where_pictures_alone_are_likelier() -> None:
    """Errors of normals are explained by a light of their own, which says nothing of what the picture does not show."""
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(sh_light("sunset"))
    # Noise of one side that looks like light from there.
    (view,) = pictures(truth, 1)
    tilted = np.clip(view.image * np.linspace(0.85, 1.15, 96)[None, :, None], 0, 1).astype(np.float32)
    seen = [replace(view, image=tilted)]
    alone, helped = (match_light(asset, seen, shadows=False, target=target) for target in (None, sh_light("sunset")))
    assert helped.environment is not None and helped.environment.trust is not None
    assert error(helped.asset.splats, truth) < 0.7 * error(alone.asset.splats, truth)


@pytest.mark.parametrize("up", ["auto", "+y", "-z"])
def test_an_environment_is_turned_about_the_way_up(up: UpAxis) -> None:
    for degrees in (0.0, 70.0):
        expected = turned_sky(sky("sunset"), axes_of(up), 30 + degrees)
        turned = about_up(turned_sky(sky("sunset"), axes_of(up), 30), up, degrees)
        np.testing.assert_allclose(turned, expected, atol=1e-9)


def test_pictures_of_little_are_judged_by_the_evidence_alone() -> None:
    asset, truth = textured_ball(sh_light("overcast")), textured_ball(sh_light("sunset"))
    (view,) = pictures(truth, 1)
    # Just enough witnesses, of which each half has too few.
    mask = np.zeros((96, 96), bool)
    mask[34:62, 34:62] = True
    matched = match_light(asset, [replace(view, mask=mask)], shadows=False, target=sh_light("sunset"))
    assert matched.environment is not None and matched.environment.trust is not None
    assert "held back" not in matched.environment.text and "less likely with it turned" in matched.environment.text
    half = replace(view, mask=mask & (np.arange(96) < 48))
    with pytest.raises(ValueError, match=f"at least {MIN_WITNESSES} Gaussians"):
        match_light(asset, [half], shadows=False, target=sh_light("sunset"))


def test_the_evidence_is_that_of_a_linear_model() -> None:
    """Where errors are small and slopes constant, Laplace's approximation is exact: y ~ N(J c, J D^2 J^T + s^2)."""
    rng = np.random.default_rng(3)
    slopes, noise = rng.normal(size=(200, 17)), 0.3
    ratio = slopes @ rng.normal(0, 0.2, 17) + rng.uniform(-0.3, 0.3, 200)

    def both(center: np.ndarray, deviation: np.ndarray) -> tuple[float, float]:
        precision = slopes.T @ slopes / noise**2 + np.diag(deviation**-2)
        solution = center + np.linalg.solve(precision, slopes.T @ (ratio - slopes @ center) / noise**2)
        away = (solution - center) / deviation
        fit = LightFit(ratio - slopes @ solution, np.ones(200), float(away @ away), deviation, precision)
        assert np.abs(fit.error).max() < LIMITS.huber * noise
        covariance = slopes @ np.diag(deviation**2) @ slopes.T + noise**2 * np.eye(200)
        off = ratio - slopes @ center
        exact = -off @ np.linalg.solve(covariance, off) / 2 - np.linalg.slogdet(covariance)[1] / 2
        return fit.evidence(noise), exact

    cases = [both(rng.normal(0, spread, 17), np.full(17, deviation)) for spread, deviation in ((0, 0.2), (0.1, 0.5))]
    (first, first_exact), (second, second_exact) = cases
    assert first - second == pytest.approx(first_exact - second_exact, abs=1e-6)
    assert abs(first - second) > 1, "else it would say nothing"


def test_an_outlier_is_no_evidence_against_a_light() -> None:
    def evidence(worst: float) -> float:
        fit = LightFit(np.array([0.0, 0.1, worst]), np.ones(3), 0.0, np.ones(17), np.eye(17))
        return fit.evidence(1.0)

    assert evidence(0.0) - evidence(1.0) == pytest.approx(0.5)
    assert evidence(9.0) - evidence(10.0) == pytest.approx(LIMITS.huber), "not 9.5"
