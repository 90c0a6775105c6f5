"""`tone_change` against pictures made by hand: a curve over all of a picture is a tone, paint and grain are none."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.gatekeeper.color_drift import tone_change

SIZE = 120
EVERYWHERE = np.ones((SIZE, SIZE), bool)


def render() -> np.ndarray:
    """[120, 120, 3] display colours, all of the middle of the range, smooth."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return np.stack([0.2 + 0.4 * x, 0.3 + 0.3 * y, 0.5 - 0.2 * x * y], -1).astype(np.float32)


def toned() -> np.ndarray:
    return (0.9 * render() ** 0.8).astype(np.float32)


def dotted(step: int) -> np.ndarray:
    """With one pixel in step x step brightened so far that the 3 x 3 means around it are off."""
    picture = toned()
    picture[step // 2 :: step, step // 2 :: step] += 0.4
    return np.minimum(picture, 0.97)


def test_a_curve_over_all_of_it_is_a_tone() -> None:
    change = tone_change(toned(), render(), EVERYWHERE)
    assert change == pytest.approx(np.abs(toned() - render()).mean((0, 1)).max(), rel=1e-5)


def test_what_few_pixels_leave_unexplained_is_none_of_its_concern() -> None:
    """9 of 400 pixels; of 36 they are more than a tone may leave."""
    assert tone_change(dotted(20), render(), EVERYWHERE) is not None
    assert tone_change(dotted(6), render(), EVERYWHERE) is None


@pytest.mark.parametrize(("edge", "is_tone"), [(12, False), (2, True)])
def test_a_painted_patch_is_more_than_a_tone(edge: int, is_tone: bool) -> None:
    """However small its share of the picture is; a speck is compression's."""
    picture = toned()
    picture[40 : 40 + edge, 50 : 50 + edge] += 0.3
    assert (tone_change(picture, render(), EVERYWHERE) is not None) == is_tone


def test_paint_outside_the_reference_does_not_count() -> None:
    picture, reference = toned(), EVERYWHERE.copy()
    picture[40:60, 50:70] += 0.3
    reference[38:62, 48:72] = False
    assert tone_change(picture, render(), reference) is not None
