"""Grades of a whole asset are named, in part painted over too; glazes, shades and brushes may be meant."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.gatekeeper.mistaken_pictures import explain
from tests.support.drawn_views import ALPHA, VIEW, decoded, eight_bits, encoded, green_dab, on_the_asset, over, top


@pytest.mark.parametrize("gain", [0.5, 0.7])
@pytest.mark.parametrize("channels", ["each its own", "all one"])
def test_lower_contrast_of_the_asset_alone_is_a_mistake(gain: float, channels: str) -> None:
    """About the asset's own mean, as sliders of contrast have it: no glaze, whose colour somebody chose."""
    mean = VIEW[ALPHA > 0.5].mean(0)
    middle = mean if channels == "each its own" else np.full(3, float(mean @ np.array([0.2126, 0.7152, 0.0722])))
    explanation = explain(on_the_asset(middle + gain * (VIEW - middle)), VIEW, ALPHA)
    assert explanation is not None and not explanation.may_be_meant and "lower contrast" in explanation.words
    # A glaze of another grey may be meant.
    glazed = explain(on_the_asset(middle + 0.08 + gain * (VIEW - middle - 0.08)), VIEW, ALPHA)
    assert glazed is not None and glazed.cause == "look"


def test_lower_contrast_about_middle_grey_is_named_beside_the_glaze_that_it_may_be() -> None:
    """No word of it said contrast."""
    explanation = explain(on_the_asset(0.5 + 0.5 * (VIEW - 0.5)), VIEW, ALPHA)
    assert explanation is not None and explanation.words.startswith("of lower contrast, or glazed with middle grey")
    other = explain(on_the_asset(0.4 + 0.5 * (VIEW - 0.4)), VIEW, ALPHA)
    assert other is not None and "contrast" not in other.words


@pytest.mark.parametrize("color", [(0.7, 0.2, 0.1), (0.1, 0.3, 0.8), (0.5, 0.5, 0.5)])
@pytest.mark.parametrize("opacity", [0.3, 0.5])
def test_a_color_laid_over_all_of_the_asset_may_be_meant(color: tuple[float, float, float], opacity: float) -> None:
    glazed = VIEW + opacity * (np.array(color) - VIEW)
    for painted in (glazed, green_dab(glazed)):
        explanation = explain(on_the_asset(painted), VIEW, ALPHA)
        assert explanation is not None and explanation.cause == "look" and explanation.may_be_meant


@pytest.mark.parametrize(
    "graded",
    [
        0.5 + 0.5 * np.tanh(3 * (VIEW - 0.5)) / np.tanh(1.5),
        VIEW * np.array([1.15, 1, 0.75]),
        VIEW**1.3,
        np.clip(1.19 * VIEW, 0, 1),
    ],
    ids=["contrast curve", "warmer", "gamma", "half a stop"],
)
def test_a_grade_that_spares_the_background_is_a_mistake(graded: np.ndarray) -> None:
    """In mode local it would paint the one side that the picture shows."""
    explanation = explain(on_the_asset(graded), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "tone" and "graded as a whole" in explanation.words


GRADES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "exposure": lambda p: encoded(1.3 * decoded(p)),
    "white balance": lambda p: encoded(decoded(p) * np.array([1.25, 1, 0.7])),
    "contrast curve": lambda p: 0.5 + 0.5 * np.tanh(3 * (p - 0.5)) / np.tanh(1.5),
    "slight": lambda p: p * np.array([1.04, 1, 0.96]),
}


@pytest.mark.parametrize("name", GRADES)
def test_a_grade_under_paint_is_named(name: str) -> None:
    """It would have been painted onto the one side that the picture shows, along with the dab."""
    graded = np.array(GRADES[name](VIEW))
    slight = explain(eight_bits(graded), VIEW, ALPHA)
    assert slight is not None and not slight.may_be_meant
    graded = green_dab(graded)
    explanation = explain(eight_bits(graded), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "tone" and "graded as a whole" in explanation.words
    # Of the asset alone it may be a large brush that multiplies.
    explanation = explain(on_the_asset(graded), VIEW, ALPHA)
    assert explanation is not None and (explanation.cause == "tone" or name == "white balance")


def test_what_rounds_or_recolours_by_colour_is_no_grade() -> None:
    """A level more or less everywhere; one colour of the asset replaced by another; a grade of nine tenths of it,
    slight ones, too."""
    dabbed = over(np.hypot(*np.mgrid[-120:120, -120:120])[..., None] < 20, (0.9, 0.1, 0.1))
    reds = (VIEW[..., :1] > VIEW[..., 2:]) & (ALPHA[..., None] > 0.02)
    most, slightly = (
        VIEW + top(0.9) * (np.clip(VIEW * np.array(gains), 0, 1) - VIEW) for gains in ([1.1, 1, 0.9], [1.04, 1, 0.96])
    )
    for picture in (dabbed + 1 / 255, dabbed * (1 - 2.4 / 255), np.where(reds, VIEW[..., ::-1], VIEW), most, slightly):
        assert explain(eight_bits(np.asarray(picture)), VIEW, ALPHA) is None
    # Stripes of two grades are no function of colour: painted by hand.
    in_first = (np.arange(VIEW.shape[1]) // 24 % 2 == 0)[:, None]
    explanation = explain(on_the_asset(np.clip(VIEW * np.where(in_first, 1.3, 0.8), 0, 1)), VIEW, ALPHA)
    assert explanation is not None and explanation.may_be_meant


@pytest.mark.parametrize(("color", "most"), [((0.9, 0.5, 0.1), 0.2), ((0, 0, 0), 0.4)])
def test_a_shade_from_side_to_side_may_be_meant(color: tuple[float, float, float], most: float) -> None:
    """A function of colour nearly, as the colours run from side to side."""
    right = np.linspace(0, 1, VIEW.shape[1])[:, None]
    view = np.where(ALPHA[..., None] > 0.02, 0.25 * VIEW + 0.75 * (0.15 + 0.7 * right), 0.25).astype(np.float32)
    shaded = green_dab(view + most * right * (np.array(color) - view))
    explanation = explain(eight_bits(np.where(ALPHA[..., None] > 0.02, shaded, view)), view, ALPHA)
    assert explanation is not None and explanation.cause == "look" and explanation.may_be_meant


@pytest.mark.parametrize("background", [(0.9, 0.9, 0.9), (0.2, 0.5, 0.3)])
def test_a_fifth_of_an_asset_on_a_new_background_is_no_grade(background: tuple[float, float, float]) -> None:
    on_asset = ALPHA[..., None] > 0
    view = np.where(on_asset, np.where(top(0.2) > 0, VIEW, 0.02 + 0.06 * VIEW), 0.05).astype(np.float32)
    picture = np.where(on_asset, np.clip(1.15 * view, 0, 1), np.array(background))
    assert explain(eight_bits(picture), view, ALPHA) is None


@pytest.mark.parametrize("gains", [(1.15, 1, 0.75), (0.5, 0.6, 0.7)])
def test_a_brush_over_most_of_the_background_may_be_meant(gains: tuple[float, float, float]) -> None:
    """A grade would reach all of it."""
    under = (np.arange(VIEW.shape[1]) > 30)[:, None] | (ALPHA[..., None] > 0)
    explanation = explain(eight_bits(np.where(under, green_dab(VIEW * np.array(gains)), VIEW)), VIEW, ALPHA)
    assert explanation is not None and explanation.cause == "look" and explanation.may_be_meant
