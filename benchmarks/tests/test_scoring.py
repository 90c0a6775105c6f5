"""Scores of the tables: against closed forms, and against the metric file called by hand."""

from __future__ import annotations

import numpy as np
import pytest
from splatbench.cases import PosedImages
from splatbench.scoring import MAX_PSNR_DB, bounding_box, compared, object_masks, rendered, scored

from splatpainter.cameras import orbit
from splatpainter.metrics import ssim
from tests.support.cli_scenes import ball


def noise(seed: int, views: int = 2, size: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (views, size, size, 3)).astype(np.float32)


class Squares:
    """Stands for LPIPS: the mean squared difference of what it is given, and the sizes of it."""

    def __init__(self) -> None:
        import torch

        self.weights = {"any": torch.zeros(1)}
        self.shapes: list[tuple[int, ...]] = []

    def __call__(self, a, b):
        self.shapes.append(tuple(a.shape))
        return ((a - b) ** 2).mean((1, 2, 3))


def test_a_constant_difference_has_the_psnr_of_the_formula() -> None:
    target = noise(0)
    made = target + np.float32(0.1)
    figures = compared(made, target, None, None)
    assert figures["psnr"] == pytest.approx(20.0, abs=1e-4)  # -10 log10 of 0.01
    assert figures["lpips"] is None


def test_means_are_over_views_not_over_pixels() -> None:
    target = noise(1)
    made = target + np.array([0.1, 0.01], np.float32)[:, None, None, None]
    masks = np.zeros(target.shape[:3], bool)
    masks[0, :30], masks[1, :3] = True, True
    assert compared(made, target, masks, None)["psnr"] == pytest.approx((20 + 40) / 2, abs=1e-3)


def test_only_pixels_of_the_mask_count_and_views_without_any_are_left_out() -> None:
    target = noise(2)
    made = target.copy()
    made[0, :20] += 0.1
    made[0, 20:] = 0
    made[1] = 0
    masks = np.zeros(target.shape[:3], bool)
    masks[0, :20] = True
    figures = compared(made, target, masks, None)
    assert figures["psnr"] == pytest.approx(20.0, abs=1e-4)
    assert figures["ssim"] == pytest.approx(ssim(made[0], target[0], masks[0]))


def test_without_any_pixel_nothing_is_scored() -> None:
    target = noise(3)
    assert compared(target, target, np.zeros(target.shape[:3], bool), Squares()) == dict.fromkeys(
        ("psnr", "ssim", "lpips")
    )
    empty = PosedImages((), target[:0])
    assert scored(ball(10), empty, None, None) == dict.fromkeys(("psnr", "ssim", "lpips"))


def test_equal_pictures_have_a_finite_psnr() -> None:
    target = noise(4)
    figures = compared(target, target, None, None)
    assert figures["psnr"] == MAX_PSNR_DB and figures["ssim"] == pytest.approx(1)


def test_too_small_pictures_have_no_ssim_and_no_lpips() -> None:
    target = noise(5, size=10)
    figures = compared(target, target + np.float32(0.1), None, Squares())
    assert figures["psnr"] == pytest.approx(20, abs=1e-4)
    assert figures["ssim"] is None and figures["lpips"] is None


def test_lpips_sees_the_masks_box_with_wanted_pixels_outside_the_mask() -> None:
    target, made = noise(6, 1, 64), noise(7, 1, 64)
    masks = np.zeros((1, 64, 64), bool)
    masks[0, 10:50, 20:55] = True
    masks[0, 12:20, 25:30] = False  # a hole
    network = Squares()
    figures = compared(made, target, masks, network)["lpips"]
    assert network.shapes == [(1, 3, 40, 35)]
    squared = ((made - target) ** 2)[0] * masks[0][..., None]
    assert figures == pytest.approx(squared.sum() / (40 * 35 * 3), rel=1e-5)


@pytest.mark.parametrize(
    ("rows", "columns", "expected"),
    [
        (slice(10, 45), slice(5, 60), (slice(10, 45), slice(5, 60))),  # large enough
        (slice(30, 34), slice(30, 34), (slice(16, 48), slice(16, 48))),  # grown about the middle: 14 each way
        (slice(0, 2), slice(62, 64), (slice(0, 32), slice(32, 64))),  # in the corners
    ],
)
def test_bounding_boxes_hold_the_mask_and_32_pixels(rows: slice, columns: slice, expected: tuple[slice, slice]) -> None:
    mask = np.zeros((64, 64), bool)
    mask[rows, columns] = True
    assert bounding_box(mask) == expected


def test_a_bounding_box_needs_a_pixel() -> None:
    with pytest.raises(ValueError, match="at least one pixel"):
        bounding_box(np.zeros((8, 8), bool))


def test_object_masks_are_where_the_background_is_not_also_after_a_case_was_kept() -> None:
    behind = (0.1, 0.5, 0.3)
    cameras = tuple(orbit([0, 0, 0], 3, 2, width=8, height=8, background=behind))
    colors = np.broadcast_to(np.array(behind, np.float32), (2, 8, 8, 3)).copy()
    colors[0, 2, 3, 1] += 0.01
    colors[1, 4:6] = 0
    expected = np.zeros((2, 8, 8), bool)
    expected[0, 2, 3], expected[1, 4:6] = True, True
    assert np.array_equal(object_masks(PosedImages(cameras, colors)), expected)
    stored = colors.astype(np.float16).astype(np.float32)
    assert np.array_equal(object_masks(PosedImages(cameras, stored)), expected)


def test_renders_of_an_asset_against_themselves_are_perfect() -> None:
    asset = ball(200, degree=1)
    cameras = tuple(orbit([0, 0, 0], 3, 2, width=32, height=32))
    pictures = rendered(asset, cameras)
    assert pictures.dtype == np.float32 and pictures.min() >= 0 and pictures.max() <= 1
    figures = scored(asset, PosedImages(cameras, pictures), None, None)
    assert figures["psnr"] == MAX_PSNR_DB
    inverse = scored(asset, PosedImages(cameras, 1 - pictures), None, None)["psnr"]
    assert inverse is not None and inverse < 30
