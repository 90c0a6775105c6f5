"""Clarity and unsharp masks over all of a picture are called so and taken back; sharpening by hand is paint."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageFilter

from splatpainter.gatekeeper.gatekeeper import admit
from splatpainter.gatekeeper.local_contrast import raised_contrast
from splatpainter.gatekeeper.mistaken_pictures import explain
from splatpainter.sources.picture_source import PictureRequest
from tests.support.drawn_views import ALPHA, VIEW, eight_bits, over, top

DAB = np.s_[96:144, 96:144]


def raised(colors: np.ndarray, radius: float, amount: float) -> np.ndarray:
    """By Pillow's Gaussian blur: an unsharp mask, written out."""
    blurred = Image.fromarray((np.clip(colors, 0, 1) * 255).round().astype(np.uint8)).filter(
        ImageFilter.GaussianBlur(radius)
    )
    return eight_bits(colors + amount * (colors - np.asarray(blurred, np.float32) / 255))


def dabbed() -> np.ndarray:
    painted = VIEW.copy()
    painted[DAB] = (0.35, 0.6, 0.4)
    return painted


@pytest.mark.parametrize(("radius", "amount"), [(20, 0.5), (12, 1.0), (8, 0.6)])
def test_clarity_is_named_and_taken_back(radius: float, amount: float) -> None:
    picture = raised(dabbed(), radius, amount)
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and "local contrast" in explanation.words, explanation
    assert not explanation.may_be_meant and explanation.mistake is not None and explanation.mistake.undone is not None
    undone = np.ascontiguousarray(explanation.mistake.undone(picture), np.float32)
    before, after = (np.abs(one - dabbed())[ALPHA > 0.5].mean() for one in (picture, undone))
    assert after < 0.15 * before
    changed = admit(undone, PictureRequest(VIEW, ALPHA), mask_sent=False).changed
    beside = changed.copy()
    beside[90:150, 90:150] = False
    assert changed[DAB].mean() > 0.98 and beside.mean() < 0.02
    untouched = admit(picture, PictureRequest(VIEW, ALPHA), mask_sent=False).changed
    untouched[90:150, 90:150] = False
    assert beside.sum() < 0.1 * untouched.sum()


@pytest.mark.parametrize(("radius", "amount"), [(1, 0.8), (2, 1.0)])
def test_an_unsharp_mask_over_all_of_it_is_remarked_and_taken_back(radius: float, amount: float) -> None:
    picture = raised(dabbed(), radius, amount)
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and "sharpened all over (an unsharp mask)" in explanation.words, explanation
    assert explanation.may_be_meant and explanation.mistake is not None and explanation.mistake.undone is not None
    undone = explanation.mistake.undone(picture)
    before, after = (np.abs(one - dabbed())[ALPHA > 0.5].mean() for one in (picture, undone))
    assert after < 0.35 * before


def test_what_was_cut_at_black_and_white_stays_as_it_was_rendered() -> None:
    picture = raised(VIEW, 20, 2.0)
    cut = ((picture <= 0) | (picture >= 1)) & (ALPHA > 0.9)[..., None]
    assert cut.mean() > 0.01
    explanation = explain(picture, VIEW, ALPHA)
    assert explanation is not None and explanation.mistake is not None and explanation.mistake.undone is not None
    assert np.abs(explanation.mistake.undone(picture) - VIEW)[cut].mean() < 0.01


SHARPER = raised(VIEW, 2, 1.5)
CLEARER = raised(VIEW, 16, 0.8)


@pytest.mark.parametrize(
    "picture",
    [
        VIEW,
        over(top(0.6), (0.2, 0.5, 0.3)),
        VIEW + top(0.7) * (SHARPER - VIEW),
        VIEW + top(0.7) * (CLEARER - VIEW),
        VIEW * 0.8,
        VIEW[:, ::-1],
        VIEW + np.random.default_rng(0).normal(0, 0.05, VIEW.shape),
    ],
)
def test_paint_and_other_mistakes_are_none_of_it(picture: np.ndarray) -> None:
    assert raised_contrast(eight_bits(picture), VIEW, ALPHA, 0.0) is None


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (3, 5), (33, 47)])
def test_pictures_of_a_few_pixels(size: tuple[int, int]) -> None:
    picture, view = np.random.default_rng(1).uniform(size=(2, *size, 3)).astype(np.float32)
    for alpha in (np.zeros(size, np.float32), np.ones(size, np.float32)):
        assert raised_contrast(picture, view, alpha, 0.0) is None
