"""Shades over black backgrounds and over close-ups are named and taken back; large soft paint is none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.gatekeeper.gatekeeper import admit
from splatpainter.gatekeeper.mistaken_pictures import explain
from splatpainter.gatekeeper.small_copies import Explanation
from splatpainter.sources.picture_source import PictureRequest
from tests.support.drawn_views import ALPHA, VIEW, decoded, eight_bits, encoded

SIZE = len(VIEW)
DAB = np.s_[96:144, 96:144]
Y, X = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
RADIUS = (np.hypot(Y, X) / np.hypot(SIZE / 2, SIZE / 2))[..., None]
BALL = np.clip((95 - np.hypot(X, Y)) / 2, 0, 1).astype(np.float32)


def lit_ball() -> np.ndarray:
    """[H, W, 3] a ball of one colour, lit from above, over black."""
    height = np.sqrt(np.maximum(95**2 - X**2 - Y**2, 0)) / 95
    light = np.clip(0.35 + 0.35 * height - 0.3 * Y / 95 + 0.1 * X / 95, 0, 1)[..., None]
    return (light * np.array([0.9, 0.75, 0.6]) * BALL[..., None]).astype(np.float32)


VIEWS = {
    "a plain ball over black": (lit_ball(), BALL),
    "textured over black": (VIEW * (ALPHA[..., None] > 0.5), (ALPHA > 0.5).astype(np.float32)),
    "a close-up": (np.clip(VIEW + 0.05, 0, 1), np.ones_like(ALPHA)),
}
MADE: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "vignette": ("towards its corners", lambda p: p * (1 - 0.5 * RADIUS**2)),
    "slight vignette": ("towards its corners", lambda p: p * (1 - 0.25 * RADIUS**2)),
    "late vignette": ("towards its corners", lambda p: p * (1 - 0.9 * RADIUS**4)),
    "of a lens": ("towards its corners", lambda p: encoded(decoded(p) * (1 - 0.6 * RADIUS**2))),
    "gradient": ("from side to side", lambda p: p * np.linspace(1, 0.5, SIZE)[:, None, None]),
}


def explained(made: np.ndarray, name: str) -> Explanation | None:
    view, alpha = VIEWS[name]
    return explain(eight_bits(made), eight_bits(view), alpha)


@pytest.mark.parametrize("shade", MADE)
@pytest.mark.parametrize("name", VIEWS)
def test_a_shade_that_no_background_tells_is_named_and_taken_back(name: str, shade: str) -> None:
    """A half vignette over black, and any in a close-up, painted 2 to 77 % of the picture without a word."""
    view, alpha = VIEWS[name]
    words, made = MADE[shade]
    painted = np.array(view)
    painted[DAB] = (0.85, 0.45, 0.2)
    picture = eight_bits(made(painted))
    explanation = explained(picture, name)
    assert explanation is not None and explanation.cause == "shade" and words in explanation.words, explanation
    assert "background" not in explanation.words
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    undone = np.ascontiguousarray(explanation.mistake.undone(picture), np.float32)
    admitted = admit(undone, PictureRequest(eight_bits(view), alpha), mask_sent=False)
    beside = admitted.changed.copy()
    beside[90:150, 90:150] = False
    assert admitted.changed[DAB].mean() > 0.98 and beside.mean() < 0.005
    assert np.abs(admitted.image - painted)[DAB].mean() < 0.015


def soft(x: float, y: float, reach: float) -> np.ndarray:
    """[H, W, 1] a soft round brush."""
    return np.exp(-((X - x) ** 2 + (Y - y) ** 2) / (2 * reach**2))[..., None]


PAINT: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "a soft dark brush below": lambda p: p * (1 - 0.7 * soft(0, 70, 50)),
    "dark brushes along a rim": lambda p: p * (1 - 0.6 * soft(-80, 0, 40)) * (1 - 0.6 * soft(70, 60, 40)),
    "a glaze on the lower half": lambda p: p * np.where(Y[..., None] > 0, 0.7, 1),
    "a shadow with a soft edge": lambda p: p * (1 - 0.5 / (1 + np.exp(-(X[..., None] + 10) / 8))),
    "a light in the middle": lambda p: p + (1 - p) * 0.5 * soft(0, 0, 40),
    "a dark spot in the middle": lambda p: p * (1 - 0.6 * soft(0, 0, 40)),
    "a coloured rim": lambda p: p + RADIUS**2 * (np.array([0.9, 0.3, 0.1]) - p) * (p.sum(-1, keepdims=True) > 0),
}


@pytest.mark.parametrize("paint", PAINT)
@pytest.mark.parametrize("name", VIEWS)
def test_soft_paint_is_no_shade(name: str, paint: str) -> None:
    explanation = explained(PAINT[paint](VIEWS[name][0]), name)
    assert explanation is None or explanation.cause != "shade"


def test_a_gradient_on_a_part_is_no_shade() -> None:
    view, _ = VIEWS["a plain ball over black"]
    lower = np.where(Y[..., None] > -20, 1 - 0.5 * (Y[..., None] + 20) / SIZE * 2, 1)
    explanation = explained(view * lower, "a plain ball over black")
    assert explanation is None or explanation.cause != "shade"


@pytest.mark.parametrize(("name", "beyond"), [("a plain ball over black", 40), ("textured over black", 15)])
def test_a_shadow_by_hand_does_not_bend_a_shade(name: str, beyond: int) -> None:
    """Of no other hue than what it lies on, so that it counts as shaded until the fit has found where it is not."""
    view, _ = VIEWS[name]
    shadowed = np.where((X[..., None] > beyond) & (Y[..., None] > -30), view * 0.55, view)
    picture = eight_bits(shadowed * (1 - 0.5 * RADIUS**2))
    explanation = explained(picture, name)
    assert explanation is not None and explanation.cause == "shade", explanation
    assert explanation.mistake is not None and explanation.mistake.undone is not None
    left = np.abs(np.asarray(explanation.mistake.undone(picture)) - shadowed)
    assert np.quantile(left[VIEWS[name][1] > 0.5], 0.95) < 3 / 255
