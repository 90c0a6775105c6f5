"""Lens models against COLMAP and OpenCV, and photographs made straight again against what a pinhole camera sees."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.captures.colmap import MODELS
from splatpainter.captures.lenses import DivisionLens, Lens, PolynomialLens, lens_or_none, pinhole_window, straightened
from tests.support.capture_folders import Bend, brown, fisheye, unbent

SLOPES = np.array([[0.3, -0.2], [-0.55, 0.4], [0.05, 0.7]])
BENT: dict[str, tuple[list[float], list[list[float]]]] = {
    "SIMPLE_RADIAL": ([500, 400, 300, -0.12], [[547.66, 201.56], [140.2625, 488.9], [423.5225, 629.315]]),
    "RADIAL": ([500, 400, 300, -0.12, 0.03], [[547.736, 201.5093], [138.4978, 490.1834], [423.7044, 631.8618]]),
    "OPENCV": (
        [500, 510, 400, 300, -0.12, 0.03, 0.002, -0.0015],
        [[547.3836, 199.8455], [137.2571, 495.1219], [423.4013, 639.9475]],
    ),
    "OPENCV_FISHEYE": (
        [300, 305, 400, 300, 0.03, -0.01, 0.004, -0.001],
        [[486.677, 241.2522], [253.7102, 408.1658], [413.2104, 488.0275]],
    ),
    "FULL_OPENCV": (
        [500, 510, 400, 300, -0.12, 0.03, 0.002, -0.0015, 0.01, 0.05, -0.02, 0.003],
        [[546.4811, 200.4592], [141.9023, 491.676], [422.9628, 633.6853]],
    ),
    "FOV": ([500, 510, 400, 300, 0.8], [[553.892, 195.3534], [136.2105, 495.6839], [423.8484, 640.5558]]),
    "SIMPLE_RADIAL_FISHEYE": (
        [300, 400, 300, 0.03],
        [[486.6888, 242.2074], [253.5498, 406.5092], [413.2262, 485.167]],
    ),
    "RADIAL_FISHEYE": (
        [300, 400, 300, 0.03, -0.01],
        [[486.6765, 242.2157], [253.7342, 406.3752], [413.2079, 484.9103]],
    ),
    "THIN_PRISM_FISHEYE": (
        [300, 305, 400, 300, 0.03, -0.01, 0.002, -0.0015, 0.004, -0.001, 0.003, -0.002],
        [[486.59, 241.3478], [253.4572, 408.4716], [413.4091, 488.4577]],
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [300, 305, 400, 300, 0.03, -0.01, 0.004, -0.001, 0.0005, -0.0002]
        + [0.002, -0.0015, 0.003, -0.002, 0.0015, -0.001],
        [[486.9994, 241.146], [254.6169, 407.7997], [413.6737, 487.669]],
    ),
    "SIMPLE_DIVISION": ([500, 400, 300, -0.2], [[546.2905, 202.473], [146.5987, 484.2919], [422.9287, 621.0011]]),
    "DIVISION": ([500, 510, 400, 300, -0.2], [[546.2905, 200.5225], [146.5987, 487.9777], [422.9287, 627.4211]]),
    "SIMPLE_FISHEYE": ([300, 400, 300], [[486.3785, 242.4143], [255.1003, 405.3816], [413.0793, 483.11]]),
    "FISHEYE": ([300, 305, 400, 300], [[486.3785, 241.4545], [255.1003, 407.138], [413.0793, 486.1619]]),
    "EUCM": ([300, 305, 400, 300, 0.6, 1.1], [[486.4166, 241.4288], [254.8796, 407.3011], [413.1004, 486.4623]]),
}
"""Parameters -> the pixels of SLOPES as pycolmap 4.2.1 gives them (Camera.img_from_cam), 800 x 600."""


@pytest.mark.parametrize("name", BENT)
def test_every_model_of_colmap_bends_as_colmap(name: str) -> None:
    parameters, expected = BENT[name]
    model = next(model for model in MODELS.values() if model.name == name)
    assert model.parameters == len(parameters) and model.lens is not None
    focal, (cx, cy, *rest) = parameters[: model.focals], parameters[model.focals :]
    lens = model.lens(tuple(rest))
    assert lens is not None
    pixels = lens.distorted(SLOPES) * (focal[0], focal[-1]) + (cx, cy)
    assert abs(pixels - expected).max() < 1e-4


def test_opencv_agrees() -> None:
    """cv2.projectPoints and cv2.fisheye.projectPoints of OpenCV 5.0 with fx 500, fy 510, cx 400, cy 300."""
    five = PolynomialLens((-0.12, 0.03, 0.01), (0.002, -0.0015))
    twelve = PolynomialLens(
        (-0.12, 0.03, 0.01), (0.002, -0.0015), (0.05, -0.02, 0.003), (0.003, 0.0007, -0.002, 0.0004)
    )
    fish = PolynomialLens((0.03, -0.01, 0.004, -0.001), fisheye=True)
    for lens, expected in (
        (five, [[547.3868, 199.8432], [136.9851, 495.3237], [423.4312, 640.3739]]),
        (twelve, [[546.682, 200.33], [142.6709, 491.2479], [423.7864, 633.2324]]),
        (fish, [[544.4617, 201.766], [156.1837, 480.8674], [422.0173, 614.4067]]),
    ):
        assert abs(lens.distorted(SLOPES) * (500, 510) + (400, 300) - expected).max() < 1e-4


def test_a_lens_of_zeros_is_none_and_the_middle_stays() -> None:
    assert lens_or_none(PolynomialLens((0.0, 0.0), (0.0, 0.0))) is None
    for lens in (PolynomialLens((0.1,), fisheye=True), DivisionLens(-0.2), *(model_lenses())):
        assert np.abs(lens.distorted(np.zeros((1, 2)))).max() == 0


def model_lenses() -> list[Lens]:
    out = []
    for model in MODELS.values():
        if model.name in BENT and model.lens is not None:
            lens = model.lens(tuple(BENT[model.name][0][model.focals + 2 :]))
            out += [lens] if lens is not None else []
    return out


def test_a_polynomial_that_turns_back_is_not_followed() -> None:
    """r (1 - 0.3 r^2) rises to r = 1 / sqrt(0.9), 1.054, and shows the middle again at 1.826."""
    lens = PolynomialLens((-0.3,))
    assert lens.reach == pytest.approx(1.054, abs=0.01)
    camera = Camera(400, 400, 100, 100, 200, 200, np.eye(4))
    window = pinhole_window(camera, lens, all_of_it=True)
    _, inside = straightened(np.ones((400, 400, 1), np.float32), camera, lens, window)
    y, x = np.nonzero(inside)
    slopes = window.slopes(np.stack([x, y], -1) + 0.5)
    assert np.linalg.norm(slopes, axis=1).max() <= lens.reach < np.linalg.norm(window.slopes(np.zeros(2)))


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[..., 3] smooth colours of directions."""
    return np.stack([0.5 + 0.4 * np.sin(9 * x + 2), 0.5 + 0.4 * np.cos(8 * y), 0.5 + 0.4 * np.sin(6 * (x + y))], -1)


BROWN, FISH = (-0.18, 0.04, 0.003, -0.002), (0.05, -0.02)
LENSES: dict[str, tuple[Lens, Bend, float]] = {
    "barrel": (PolynomialLens(BROWN[:2], BROWN[2:]), brown(*BROWN), 150.0),
    "pincushion": (PolynomialLens((0.12, 0.02)), brown(0.12, 0.02), 150.0),
    "fisheye": (PolynomialLens(FISH, fisheye=True), fisheye(*FISH), 120.0),
}


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("all_of_it", [True, False])
def test_a_straightened_photograph_is_what_a_pinhole_sees(name: str, all_of_it: bool) -> None:
    """The photograph is made the other way round: for each of its pixels, Newton's method finds the direction."""
    lens, bend, focal = LENSES[name]
    camera = Camera(200, 140, focal, focal * 1.02, 104, 66, np.eye(4))
    y, x = np.mgrid[:140, :200] + 0.5
    taken = pattern(*unbent((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, bend)).astype(np.float32)
    window = pinhole_window(camera, lens, all_of_it=all_of_it)
    straight, inside = straightened(taken, camera, lens, window)
    y, x = np.mgrid[: window.height, : window.width] + 0.5
    expected = pattern((x - window.cx) / window.fx, (y - window.cy) / window.fy)
    inner = inside & ~_rim(inside)
    assert abs(straight - expected)[inner].max() < 0.01
    assert (window.fx, window.fy) == (camera.fx, camera.fy)
    if all_of_it:
        corners = np.array([[0.5, 0.5], [199.5, 0.5], [0.5, 139.5], [199.5, 139.5], [100, 0.5], [0.5, 70]])
        x, y = ((corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
        slopes = np.stack(unbent(x, y, bend), -1)
        at = slopes * (window.fx, window.fy) + (window.cx, window.cy)
        wide = np.abs(slopes).max(1) > 1.7  # beyond 60 degrees nothing is kept
        visible = ((at > -1) & (at < (window.width + 1, window.height + 1))).all(1)
        assert (visible | wide).all()
    else:
        assert inside.all()
        assert window.width * window.height > 0.5 * 200 * 140, "not much less than the photograph"


def _rim(inside: np.ndarray) -> np.ndarray:
    """Two pixels along the edge of what a photograph shows, where it is repeated."""
    padded = np.pad(inside, 2)
    height, width = inside.shape
    return ~np.logical_and.reduce([padded[i : i + height, j : j + width] for i in range(5) for j in range(5)])


def test_a_lens_that_leaves_nothing_is_refused() -> None:
    camera = Camera(100, 100, 50, 50, 50, 50, np.eye(4))
    with pytest.raises(ValueError, match="leaves nothing"):
        pinhole_window(camera, PolynomialLens((-1e9,)), all_of_it=False)
