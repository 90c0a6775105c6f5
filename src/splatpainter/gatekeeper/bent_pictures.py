"""Pictures bent over their render: by a lens, in perspective, or stretched in one direction.

A polynomial of the place says by how much each pixel lies beside where it was rendered: Gauss-Newton steps on a pyramid
as in registration.py, with more unknowns and from no motion on. Degree 3 holds radial distortion (Brown 1966: r^2
times the place), keystones and every affine stretch. What it says has to be judged.
Pure. H, W: pixels of the render; colours are display sRGB 0..1; places are -1..1 along the longer side.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from splatpainter.gatekeeper.registration import REGISTRATION, PyramidLevel, resampled_at
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class BendThresholds:
    """How far a picture may be bent to be told. Source: taste, tried on distortions of -0.1 to 0.1."""

    degree: int = 3
    """Degree of the polynomial."""
    levels_px: tuple[int, ...] = (64, 128, 256)
    """Longer sides of the pyramid's pictures."""
    max_samples: int = 20_000
    """Pixels of texture of one level that are asked, at most."""
    max_steps: int = 12
    """Gauss-Newton steps on one level."""
    ridge: float = 1e-4
    """Part of the mean curvature that holds back what no texture tells."""
    min_slope: float = 0.01
    """Squared slope of normalised brightness or edges, from which a pixel has texture."""
    min_samples: int = 200
    """Pixels of texture from which twenty unknowns are told."""
    still_px: float = 0.02
    """A step that moves no pixel by more ends a level, pixels of the level."""
    max_error_left: tuple[float, ...] = (0.95, 0.8, 0.75)
    """Error of the pixels of texture, in parts of that of no motion, up to which each level says that a picture was
    bent. Distortions of seven assets leave up to 0.94, 0.75, 0.6; true close-ups of coarse assets 0.82 of the second
    and more."""


BENDS = BendThresholds()


@dataclass(frozen=True)
class Bend:
    """By how much a picture lies beside its render: a polynomial of the place."""

    coefficients: np.ndarray
    """[T, 2] float64 of right and down, in halves of the longer side; T terms."""

    def shift(self, width: int, height: int) -> np.ndarray:
        """[H, W, 2] pixels by which each point of a render of that size lies further right and down in the picture."""
        return (_terms(width, height) @ self.coefficients) * max(width, height) / 2

    def undone(self, picture: np.ndarray) -> np.ndarray:
        """The picture [H, W, C] as it was before it was bent."""
        height, width = picture.shape[:2]
        return resampled_at(picture, self.shift(width, height))[0]

    def made(self, render: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """([H, W, C] what bending makes of a render, [H, W] bool where that is known)."""
        height, width = render.shape[:2]
        forward = self.shift(width, height)
        # The place p of the picture shows p + back(p) of the render, where back(p) = -shift(p + back(p)).
        back = -forward
        for _ in range(5):
            back = -resampled_at(forward, back)[0]
        return resampled_at(render, back)


def bend_of(picture: np.ndarray, render: np.ndarray) -> Bend | None:
    """How a picture [H, W, C] of its render's size [H, W, C] was bent; None where too little texture tells, or where it
    was not."""
    frame = np.array([[1.0, 0, 0], [0, 1, 0]])
    weight = np.ones(render.shape[:2], np.float32)
    coefficients = np.zeros((len(list(_powers())), 2))
    for number, longer_px in enumerate(BENDS.levels_px):
        if longer_px > BENDS.levels_px[0] and max(render.shape[:2]) <= longer_px / 2:
            break
        level = PyramidLevel.of(picture, render, weight, None, frame, longer_px)
        descent = _descended(level, coefficients)
        # Most pictures that come here are not bent at all: the smallest size tells most of them.
        if descent is None or descent.error_left > BENDS.max_error_left[number]:
            return None
        coefficients = descent.coefficients
    return Bend(coefficients)


def _powers() -> Iterator[tuple[int, int]]:
    for across in range(BENDS.degree + 1):
        for down in range(BENDS.degree + 1 - across):
            yield across, down


def _terms(width: int, height: int) -> np.ndarray:
    """[H, W, T] the polynomial's terms at pixel centres."""
    reach = max(width, height) / 2
    y, x = np.mgrid[:height, :width] + 0.5
    x, y = (x - width / 2) / reach, (y - height / 2) / reach
    return np.stack([x**across * y**down for across, down in _powers()], -1)


@dataclass(frozen=True)
class _Descent:
    coefficients: np.ndarray
    error_left: float
    """Median error of the pixels of texture, in parts of that of no motion."""


def _descended(level: PyramidLevel, coefficients: np.ndarray) -> _Descent | None:
    height, width = level.weight.shape
    reach = max(width, height) / 2
    terms = _terms(width, height).reshape(height * width, -1)
    count = terms.shape[1]
    # Inverse form, as in registration: the render's slopes stay. Of each channel only pixels of texture are asked.
    channels = []
    for number in range(level.render.shape[2]):
        target = level.render[..., number]
        down, across = np.gradient(target)
        steep = np.flatnonzero(across**2 + down**2 > BENDS.min_slope)
        if len(steep) < BENDS.min_samples:
            return None
        steep = steep[:: -(-len(steep) // BENDS.max_samples)]
        here = terms[steep]
        slopes = np.concatenate([here * across.flat[steep][:, None], here * down.flat[steep][:, None]], 1) * reach
        channels.append((number, steep, target.flat[steep], slopes))

    def errors(picture: np.ndarray) -> list[np.ndarray]:
        return [picture[..., number].flat[steep] - target for number, steep, target, _ in channels]

    def middle(error: np.ndarray) -> float:
        return float(np.median(np.abs(error)))

    left = still = sum(middle(error) for error in errors(level.picture))
    for _ in range(BENDS.max_steps):
        shift = (terms @ coefficients).reshape(height, width, 2) * reach
        image, inside = resampled_at(level.picture, shift)
        remaining, left = errors(image), 0.0
        normal, gain = np.zeros((2 * count, 2 * count)), np.zeros(2 * count)
        for error, (_, steep, _, slopes) in zip(remaining, channels, strict=True):
            # Tukey's weights: what was painted over does not count.
            spread = 1.4826 * middle(error) + 1e-3
            share = np.maximum(1 - (error / (REGISTRATION.tukey * spread)) ** 2, 0) ** 2 / spread**2
            scaled = slopes * (share * inside.flat[steep])[:, None]
            normal += scaled.T @ slopes
            gain += scaled.T @ error
            left += middle(error)
        normal += BENDS.ridge * np.trace(normal) / len(normal) * np.eye(len(normal))
        step = np.linalg.solve(normal, gain).reshape(2, count).T
        coefficients = coefficients - step
        if np.abs(terms @ step).max() * reach < BENDS.still_px:
            break
    return _Descent(coefficients, left / max(still, 1e-9))
