"""Where a picture was edited, after what files do to pictures: rounding, JPEG, soft brushes."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation, binary_erosion

import splatpainter as sp
from splatpainter.cameras import orbit
from splatpainter.kernels import library
from splatpainter.kernels.arrays import set_pixels
from splatpainter.lift.masks import (
    box_mean,
    change_mask,
    contrast,
    dilated,
    largest_difference,
    paste,
    window_around,
)
from tests.support.kernel_goldens import CPUS, Numbers
from tests.support.lift_scenes import disk, front, sheet

SIZE = 160


def render(background=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A sheet with texture and a rim of flat background."""
    return sp.render(sheet(60), front(SIZE, background)).colors[0]


def to_bytes(image: np.ndarray) -> np.ndarray:
    return np.floor(np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def through_png(image: np.ndarray) -> np.ndarray:
    return to_bytes(image).astype(np.float32) / 255


def through_jpeg(image: np.ndarray, quality: int, subsampling: int = 2) -> np.ndarray:
    """Pillow's own codec; subsampling 2 is 4:2:0, the usual."""
    file = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(file, "JPEG", quality=quality, subsampling=subsampling)
    with Image.open(file) as picture:
        return np.asarray(picture).astype(np.float32) / 255


def rectangle(image: np.ndarray, color=(0.9, 0.2, 0.1), opacity: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    where = np.zeros(image.shape[:2], bool)
    where[50:80, 40:95] = True
    blend = (1 - opacity) * image + opacity * np.array(color, np.float32)
    return np.where(where[..., None], blend, image).astype(np.float32), where


def grown(where: np.ndarray, pixels: int) -> np.ndarray:
    return np.asarray(binary_dilation(where, np.ones((3, 3)), iterations=pixels), bool)


def fractions(mask: np.ndarray, edit: np.ndarray) -> tuple[float, float]:
    """(part of the edit that is missed, part of the rest that is taken for edited)."""
    return float((~mask)[edit].mean()), float(mask[~edit].mean())


@pytest.mark.parametrize("background", [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5)])
@pytest.mark.parametrize("opacity", [1.0, 0.3])
def test_a_rectangle_is_found_to_the_pixel(background, opacity):
    image = render(background)
    edited, where = rectangle(image, opacity=opacity)
    for picture in (through_png(edited), edited):
        mask = change_mask(picture, image)
        assert mask.dtype == bool and mask.shape == where.shape
        assert not (mask & ~grown(where, 1)).any()
        missed = np.asarray(binary_erosion(where, np.ones((3, 3))), bool) & ~mask
        # Where the texture already has the paint's colour there is nothing to see.
        assert (np.abs(edited - image).max(-1)[missed] < 4 / 255).all()
        assert fractions(mask, where)[0] < 0.02


def test_rounding_to_bytes_is_no_edit():
    image = render() * 1.2 - 0.1  # also below 0 and above 1, as renders may be
    assert not change_mask(through_png(image), image).any()
    assert not change_mask(image, image).any()
    truncated = (np.clip(image, 0, 1) * 255).astype(np.uint8) / np.float32(255)
    assert not change_mask(truncated, image).any()
    off_by_one = np.clip(to_bytes(image).astype(int) + np.random.default_rng(0).integers(-1, 2, image.shape), 0, 255)
    assert not change_mask((off_by_one / 255).astype(np.float32), image).any()


@pytest.mark.parametrize("quality", [85, 90, 95])
@pytest.mark.parametrize("subsampling", [0, 2], ids=["444", "420"])
def test_a_jpeg_of_an_edit(quality, subsampling):
    image = render()
    edited, where = rectangle(image)
    missed, extra = fractions(change_mask(through_jpeg(edited, quality, subsampling), image), where)
    assert missed == 0 and extra < 0.04
    mask = change_mask(through_jpeg(edited, quality, subsampling), image)
    assert not (mask & ~grown(where, 8)).any()  # within a JPEG block of it
    assert change_mask(through_jpeg(image, quality, subsampling), image).mean() < 0.002


@pytest.mark.parametrize("name", ["massa.ply", "playbot_lod3.ply"])
def test_jpegs_of_captures(shared, name):
    """Fine texture on a flat background: noise that the background does not have."""
    splats = sp.read(shared / "data" / "splats" / name)
    center = np.median(splats.means, 0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.9))
    image = sp.render(splats, orbit(center, 2.2 * radius, 1, width=256, height=256)).colors[0]
    for opacity, allowed in ((1.0, 0.0), (0.15, 0.1)):
        edited, where = rectangle(image, opacity=opacity)
        where &= np.abs(edited - image).max(-1) > 8 / 255
        mask = change_mask(through_jpeg(edited, 85), image)
        missed, extra = fractions(mask, where)
        assert missed <= allowed and extra < 0.02
    assert change_mask(through_jpeg(image, 85), image).mean() < 0.002
    assert not change_mask(through_png(image), image).any()


def test_a_pale_wash_survives_a_jpeg():
    image = render()
    edited, where = rectangle(image, (0.9, 0.9, 0.2), 0.12)
    where &= np.abs(edited - image).max(-1) > 8 / 255
    missed, extra = fractions(change_mask(through_jpeg(edited, 90), image), where)
    assert missed < 0.1 and extra < 0.04


def test_the_soft_rim_of_a_brush_belongs_to_the_edit():
    image = render()
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    distance = np.hypot(u - 80, v - 80)
    alpha = np.clip((30 - distance) / 20, 0, 1)[..., None]
    edited = through_png(image * (1 - alpha) + alpha * np.ones(3, np.float32))
    change = np.abs(edited - image).max(-1)
    mask = change_mask(edited, image)
    assert mask[change > 5 / 255].mean() > 0.99
    assert not mask[distance > 30].any()


@pytest.mark.parametrize("width", [1, 2])
def test_thin_lines_are_found(width):
    image = render()
    edited = image.copy()
    edited[30 : 30 + width, 20:140] = (1, 1, 1)
    where = np.zeros((SIZE, SIZE), bool)
    where[30 : 30 + width, 20:140] = True
    mask = change_mask(through_png(edited), image)
    assert fractions(mask, where)[0] < 0.02 and not (mask & ~where).any()
    mask = change_mask(through_jpeg(edited, 92), image)
    assert fractions(mask, where)[0] < 0.05 and mask[~grown(where, 8)].sum() == 0


def test_faint_specks_are_dropped():
    image = render()
    edited = image.copy()
    specks = np.random.default_rng(0).integers(5, SIZE - 5, (30, 2))
    edited[specks[:, 0], specks[:, 1]] += 0.06
    assert not change_mask(through_png(edited), image).any()


def test_an_edit_of_nearly_the_whole_asset_is_found_whole():
    image = render()
    where = disk(front(SIZE), 80, 80, 70)
    edited = np.where(where[..., None], 0.7 * image + 0.3 * np.array([0.9, 0.2, 0.1], np.float32), image)
    change = np.abs(edited - image).max(-1)
    mask = change_mask(through_png(edited), image)
    assert mask[where & (change > 8 / 255)].mean() > 0.99 and not mask[~where].any()


def test_flat_pictures_and_edges():
    flat = np.full((20, 30, 3), 0.25, np.float32)
    assert not change_mask(flat, flat).any()
    edited = flat.copy()
    edited[:3, :4] = edited[17:, 20:] = 0.5
    mask = change_mask(through_png(edited), flat)
    np.testing.assert_array_equal(mask, np.abs(edited - flat).max(-1) > 0)
    one = np.zeros((1, 1, 3), np.float32)
    assert change_mask(one + 0.5, one).all() and not change_mask(one, one).any()


def test_arguments_are_not_written_to():
    image = render()
    edited, _ = rectangle(image)
    copies = edited.copy(), image.copy()
    edited.flags.writeable = image.flags.writeable = False
    change_mask(edited, image)
    np.testing.assert_array_equal(edited, copies[0])
    np.testing.assert_array_equal(image, copies[1])


def mean_by_numpy(values: np.ndarray, radius: int) -> np.ndarray:
    """What the kernel computes, sum by sum in its order."""
    (height, width), size = values.shape[:2], 2 * radius + 1
    padded = np.pad(values.astype(np.float32), [(radius, radius)] * 2 + [(0, 0)] * (values.ndim - 2), mode="edge")
    sums = sum(padded[k : k + height] for k in range(1, size)) + padded[:height]
    return (sum(sums[:, k : k + width] for k in range(1, size)) + sums[:, :width]) / size**2


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("shape", [(1, 1), (5, 7), (33, 40, 3), (3, 200, 4), (0, 4)])
def test_box_means_are_sums_in_their_order(shape: tuple[int, ...], cpu: str):
    numbers = Numbers(3)
    values = numbers.uniform(-1, 1, *shape).astype(np.float32)
    if cpu not in library.current().cpus:
        pytest.skip(f"this CPU is not {cpu}")
    with library.using(cpu):
        for radius in (0, 1, 4, 33):
            for picture in (values, values > 0, values.astype(np.float64)):
                out = box_mean(picture, radius)
                assert out.dtype == np.float32
                if out.size:
                    np.testing.assert_array_equal(out, mean_by_numpy(picture, radius))


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_differences_and_contrast_are_those_of_their_formulas(dtype: type, cpu: str):
    if cpu not in library.current().cpus:
        pytest.skip(f"this CPU is not {cpu}")
    one, other = (Numbers(seed).uniform(-0.3, 1.3, 37, 53, 3).astype(dtype) for seed in (3, 4))
    grey = (other[..., 0] + other[..., 1] + other[..., 2]) * dtype(1 / 3)
    right, below = np.diff(grey, axis=1, append=grey[:, -1:]), np.diff(grey, axis=0, append=grey[-1:])
    with library.using(cpu):
        apart, detail = largest_difference(one, other), contrast(other)
    assert apart.dtype == detail.dtype == dtype
    assert np.array_equal(apart, np.abs(np.clip(one, 0, 1) - np.clip(other, 0, 1)).max(2))
    assert np.array_equal(detail, np.abs(right) + np.abs(below))


@pytest.mark.parametrize("where", [(0, 0), (20, 30), (39, 59)])
def test_masks_as_pixels_grown_and_pasted(where: tuple[int, int]):
    mask = np.zeros((40, 60), bool)
    mask[where] = True
    mask[where[0], 10:13] = True
    ys, xs = np.nonzero(mask)
    assert np.array_equal(np.stack(set_pixels(mask)), np.stack([ys, xs]))
    square = binary_dilation(mask, np.ones((7, 7), bool))
    assert np.array_equal(dilated(mask, 3), square) and not dilated(np.zeros_like(mask), 3).any()
    one, other = (Numbers(seed).uniform(0, 1, 40, 60, 3) for seed in (5, 6))
    expected, source = np.where(mask[..., None], other, one), other.copy()
    paste(one, other, mask)
    assert np.array_equal(one, expected) and np.array_equal(other, source)


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_a_window_holds_all_within_reach(reach: int):
    rng = np.random.default_rng(reach)
    for _ in range(30):
        height, width = rng.integers(1, 12, 2).tolist()
        mask = np.zeros((height, width), bool)
        for _ in range(rng.integers(0, 3)):
            mask[rng.integers(height), rng.integers(width)] = True
        window = np.zeros_like(mask)
        window[window_around(mask, reach)] = True
        rows, columns = (np.flatnonzero(dilated(mask, reach).any(axis)) for axis in (1, 0))
        expected = np.zeros_like(mask)
        expected[np.ix_(rows, columns)] = True
        if len(rows):
            expected[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
        assert np.array_equal(window, expected)
