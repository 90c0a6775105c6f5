"""Synthetic moves of pictures are recovered below a pixel, painted over, recoloured and compressed."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.gatekeeper.registration import register
from tests.support.distorted_pictures import corner_error, drawn_scene, jpeg, moved, painted_over

SIZE = 240


@pytest.mark.parametrize("seed", range(3))
def test_small_moves_are_recovered(seed: int) -> None:
    rng, (image, _) = np.random.default_rng(seed), drawn_scene(SIZE, seed)
    right, down = rng.uniform(-8, 8, 2)
    picture, truth = moved(
        image, scale=rng.uniform(0.96, 1.04), degrees=rng.uniform(-2, 2), right=right, down=down, size=320
    )
    result = register(jpeg(0.85 * painted_over(picture, 0.15, seed), 85), image)
    assert corner_error(result.matrix, truth, SIZE, SIZE) < 0.25
    assert result.framing == "full" and not result.is_still(SIZE, SIZE)
    assert (result.right, result.down) == pytest.approx((right, down), abs=0.15)


@pytest.mark.parametrize(
    ("scale", "degrees", "right", "down"), [(0.82, -6.0, -18.0, 12.0), (1.15, 5.0, 10.0, -20.0), (1.0, 8.0, 30.0, 0.0)]
)
def test_large_moves_are_recovered(scale: float, degrees: float, right: float, down: float) -> None:
    image, _ = drawn_scene(SIZE, 5)
    picture, truth = moved(image, scale=scale, degrees=degrees, right=right, down=down)
    result = register(painted_over(picture, 0.2, 1), image)
    assert corner_error(result.matrix, truth, SIZE, SIZE) < 0.3
    assert result.rotation == pytest.approx(degrees, abs=0.1) and result.scale == pytest.approx(scale, abs=0.003)


@pytest.mark.parametrize("seed", [1])
def test_a_picture_that_was_only_painted_on_or_recoloured_is_not_moved(seed: int) -> None:
    image, _ = drawn_scene(SIZE, seed)
    for picture in (image, jpeg(painted_over(image, 0.3, seed), 80), image[..., ::-1] ** 1.4, 1 - image):
        result = register(picture, image)
        assert result.is_still(SIZE, SIZE) and np.array_equal(result.matrix, np.eye(3)[:2]), result
    assert register(image, image).score == pytest.approx(1)


@pytest.mark.parametrize("kind", ["cropped", "padded", "stretched"])
def test_other_shapes_are_told_apart(kind: str) -> None:
    image, _ = drawn_scene(SIZE, 2)
    if kind == "cropped":
        picture, truth = image[30:-30], np.array([[1, 0, 0], [0, 1, -30.0]])
    elif kind == "padded":
        picture, truth = np.pad(image, ((0, 0), (40, 40), (0, 0))), np.array([[1, 0, 40.0], [0, 1, 0]])
    else:
        picture, truth = image[np.arange(160) * 3 // 2], np.array([[1, 0, 0], [0, 2 / 3, 0]])
    result = register(np.ascontiguousarray(picture), image)
    assert result.framing == kind and corner_error(result.matrix, truth, SIZE, SIZE) < 1
    assert result.score > 0.8


def test_a_small_window_of_the_view_is_placed() -> None:
    image, _ = drawn_scene(SIZE, 3)
    result = register(painted_over(image[60:180, 50:190], 0.1, 0), image)
    assert result.framing == "part"
    assert np.allclose(result.matrix @ (50, 60, 1), 0) and np.allclose(result.matrix @ (190, 180, 1), (140, 120))


def test_what_was_masked_does_not_count() -> None:
    image, _ = drawn_scene(SIZE, 4)
    picture, truth = moved(image, right=2.5, down=-1.5)
    weight = np.ones((SIZE, SIZE), np.float32)
    weight[60:180, 60:180] = 0
    other, _ = moved(image[::-1, ::-1], right=-6)
    picture[62:178, 62:178] = other[62:178, 62:178]  # something else altogether, of the same kind
    result = register(picture, image, weight)
    assert corner_error(result.matrix, truth, SIZE, SIZE) < 0.3 and result.score > 0.9 and not result.inside
    everything = register(picture, image, np.zeros_like(weight))
    assert everything.inside and everything.score < result.score


def test_other_pictures_score_low() -> None:
    image, _ = drawn_scene(SIZE, 6)
    noise = np.random.default_rng(0).uniform(size=image.shape).astype(np.float32)
    for other in (drawn_scene(SIZE, 7)[0], image[::-1, ::-1], noise):
        assert register(other, image).score < 0.35
