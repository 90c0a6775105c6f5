"""Pictures bent over their render: by a lens, in perspective, or stretched in one direction.

A polynomial of the place says by how much each pixel lies beside where it was rendered: Gauss-Newton steps on a pyramid
as in registration.py, with more and more unknowns: an affine move, what cameras do (a homography and radial distortion,
Brown 1966: r^2 and r^4 times the place), any polynomial of degree 3 and r^4. What it says has to be judged.
Pure. H, W: pixels of the render; colours are display sRGB 0..1; places are -1..1 along the longer side.
"""

from __future__ import annotations

from itertools import accumulate
from typing import Literal

import numpy as np

from splatpainter.gatekeeper.registration import REGISTRATION, PyramidLevel, resampled_at
from splatpainter.kernels.portable import gram, matmul, solved, transposed_product
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
    max_halvings: int = 3
    """How often a step that leaves more than before is halved."""
    first_radial: tuple[float, ...] = (0.0, -0.1, -0.04, 0.04, 0.1)
    """Radial distortions of which the best is started from: fine detail that lies beside itself by more than its own
    size draws descents from no motion the wrong way (two of twelve views at 0.03 and 0.05)."""
    max_lens_error: float = 0.9
    """Error that r^4 must leave in parts of what degree 3 leaves, to be believed: it is one more unknown that fits
    noise at a picture's rim."""
    min_cutoff: float = 0.7
    """Least error, in deviations of a pixel's surroundings, from which a pixel does not count: where half of the
    texture hardly moves, the middle error says little of the rest."""
    error_quantiles: tuple[float, ...] = (0.5, 0.75)
    """Quantiles of the errors by which a bend is told."""
    max_error_left: tuple[float, ...] = (0.98, 0.88, 0.8)
    """Error of the pixels of texture, in parts of that of no motion, up to which each level says that a picture may
    have been bent. Distortions of six captures leave up to 0.96, 0.65, 0.5; what else comes so far is judged."""


BENDS = BendThresholds()


@dataclass(frozen=True)
class Bend:
    """By how much a picture lies beside its render: a polynomial of the place."""

    coefficients: np.ndarray
    """[T, 2] float64 of right and down, in halves of the longer side; T terms."""

    def shift(self, width: int, height: int) -> np.ndarray:
        """[H, W, 2] pixels by which each point of a render of that size lies further right and down in the picture."""
        return matmul(_terms(width, height), self.coefficients) * max(width, height) / 2

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
    coefficients, textured = np.zeros((TERMS, 2)), None
    for number, longer_px in enumerate(BENDS.levels_px):
        if longer_px > BENDS.levels_px[0] and max(render.shape[:2]) <= longer_px / 2:
            break
        textured = _TexturedLevel.of(PyramidLevel.of(picture, render, weight, None, frame, longer_px))
        if textured is None:
            return None
        if number == 0:
            coefficients = min((radial * _RADIAL for radial in BENDS.first_radial), key=textured.loss)
        coefficients = textured.descended(coefficients, _STAGES)
        # Most pictures that come here are not bent at all: the smallest size tells most of them.
        if textured.error_left(coefficients) > BENDS.max_error_left[number]:
            return None
    # What lenses do beyond degree 3 is sought where the rest is found.
    if textured is not None:
        with_lens = textured.descended(coefficients, _LENS_STAGES)
        if textured.error_left(with_lens) < BENDS.max_lens_error * textured.error_left(coefficients):
            coefficients = with_lens
    return Bend(coefficients)


_POWERS = tuple((across, down) for across in range(BENDS.degree + 1) for down in range(BENDS.degree + 1 - across))
"""Exponents of right and down of the polynomial's terms."""
TERMS = len(_POWERS) + 2
"""And r^4 times the place, right and down: what lenses do beyond degree 3."""


def _field(*terms: tuple[Literal["right", "down"], int, int]) -> np.ndarray:
    """[T, 2] a shift to the right and down that is the sum of these terms."""
    out = np.zeros((TERMS, 2))
    for direction, across, down in terms:
        out[_POWERS.index((across, down)), direction == "down"] = 1
    return out


_AFFINE = tuple(_field((direction, *power)) for direction in ("right", "down") for power in ((0, 0), (1, 0), (0, 1)))
_KEYSTONES = _field(("right", 2, 0), ("down", 1, 1)), _field(("right", 1, 1), ("down", 0, 2))
_RADIAL = _field(("right", 3, 0), ("right", 1, 2), ("down", 2, 1), ("down", 0, 3))
_RADIAL_4 = np.zeros((TERMS, 2))
_RADIAL_4[-2, 0] = _RADIAL_4[-1, 1] = 1
_STAGES = (
    np.stack(_AFFINE),
    np.stack([*_AFFINE, *_KEYSTONES, _RADIAL]),
    np.eye(2 * TERMS).reshape(-1, TERMS, 2)[:-4],
)
_LENS_STAGES = (np.stack([*_AFFINE, *_KEYSTONES, _RADIAL, _RADIAL_4]), np.concatenate([_STAGES[-1], _RADIAL_4[None]]))
"""[U, T, 2] each: fields whose sum is sought. With all unknowns at once the few edges of a small asset are explained by
a wild bend."""


def _terms(width: int, height: int) -> np.ndarray:
    """[H, W, T] the polynomial's terms at pixel centres."""
    reach = max(width, height) / 2
    y, x = np.mgrid[:height, :width] + 0.5
    x, y = (x - width / 2) / reach, (y - height / 2) / reach
    r4 = (x**2 + y**2) ** 2
    # numpy's powers depend on the CPU from the third on.
    rights, downs = (list(accumulate([np.ones_like(v), *[v] * BENDS.degree], np.multiply)) for v in (x, y))
    return np.stack([*(rights[across] * downs[down] for across, down in _POWERS), x * r4, y * r4], -1)


@dataclass(frozen=True)
class _Channel:
    """Pixels of texture of one feature of a level."""

    number: int
    steep: np.ndarray
    """[P] their flat indices."""
    target: np.ndarray
    """[P] the feature in the render."""
    slopes: np.ndarray
    """[P, 2 T] by how much a unit of each coefficient changes it."""


@dataclass(frozen=True)
class _TexturedLevel:
    """A level of the pyramid and what of it can tell a bend."""

    picture: np.ndarray
    """[H, W, C] features."""
    terms: np.ndarray
    """[H W, T]."""
    channels: tuple[_Channel, ...]

    @staticmethod
    def of(level: PyramidLevel) -> _TexturedLevel | None:
        """None where too few pixels have texture."""
        height, width = level.weight.shape
        terms = _terms(width, height).reshape(height * width, -1)
        # Inverse form, as in registration: the render's slopes stay. Of each channel only pixels of texture are asked.
        channels = []
        for number in range(level.render.shape[2]):
            target = level.render[..., number]
            down, across = np.gradient(target)
            steep = np.flatnonzero(across**2 + down**2 > BENDS.min_slope)
            if len(steep) < BENDS.min_samples:
                return None
            steep = steep[:: -(-len(steep) // BENDS.max_samples)]
            slopes = np.stack([across.flat[steep], down.flat[steep]], -1)[:, None] * terms[steep][..., None]
            slopes = slopes.reshape(len(steep), -1) * (max(width, height) / 2)
            channels.append(_Channel(number, steep, target.flat[steep], slopes))
        return _TexturedLevel(level.picture, terms, tuple(channels))

    def loss(self, coefficients: np.ndarray) -> float:
        """Tukey's loss after a bend is undone, with the widest cutoff."""
        return _loss(self._errors_after(coefficients)[0], [BENDS.min_cutoff] * len(self.channels))

    def error_left(self, coefficients: np.ndarray) -> float:
        """Error of the pixels of texture after a bend is undone, in parts of that of no motion: of the middle one, or
        of those that differ more, whichever says more. A bend moves the middle of a picture little."""
        after, still = (
            np.array([np.quantile(np.abs(error), BENDS.error_quantiles) for error in self._errors_after(bend)[0]]).sum(
                0
            )
            for bend in (coefficients, 0 * coefficients)
        )
        return float((after / np.maximum(still, 1e-9)).min())

    def descended(self, coefficients: np.ndarray, stages: tuple[np.ndarray, ...]) -> np.ndarray:
        """[T, 2] the bend that leaves least, from one that is near. stages: fields, [U, T, 2] each."""
        reach = max(self.picture.shape[:2]) / 2
        errors, inside = self._errors_after(coefficients)
        for fields in stages:
            bases = fields.reshape(len(fields), -1).T
            slopes = [matmul(channel.slopes, bases) for channel in self.channels]
            for _ in range(BENDS.max_steps):
                # Tukey's weights: what was painted over does not count.
                cutoffs = [max(REGISTRATION.tukey * 1.4826 * _middle(error), BENDS.min_cutoff) for error in errors]
                normal, gain = np.zeros((len(fields), len(fields))), np.zeros((len(fields), 1))
                for channel, error, cutoff, slope in zip(self.channels, errors, cutoffs, slopes, strict=True):
                    share = np.maximum(1 - (error / cutoff) ** 2, 0) ** 2 / cutoff**2
                    share = share * inside.flat[channel.steep]
                    normal += gram(slope, share)
                    gain += transposed_product(slope, (share * error)[:, None])
                normal += BENDS.ridge * np.trace(normal) / len(normal) * np.eye(len(normal))
                step = matmul(bases, solved(normal, gain)).reshape(-1, 2)
                before = _loss(errors, cutoffs)
                for _ in range(BENDS.max_halvings):
                    after, inside_after = self._errors_after(coefficients - step)
                    if _loss(after, cutoffs) < before:
                        break
                    step = step / 2
                else:  # no step along this direction leaves less
                    break
                coefficients, errors, inside = coefficients - step, after, inside_after
                if np.abs(matmul(self.terms, step)).max() * reach < BENDS.still_px:
                    break
        return coefficients

    def _errors_after(self, coefficients: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
        """([P] error of each channel after a bend is undone, [H, W] bool where the picture shows anything)."""
        height, width = self.picture.shape[:2]
        shift = matmul(self.terms, coefficients).reshape(height, width, 2) * (max(width, height) / 2)
        image, inside = resampled_at(self.picture, shift)
        return [image[..., one.number].flat[one.steep] - one.target for one in self.channels], inside


def _middle(error: np.ndarray) -> float:
    return float(np.median(np.abs(error)))


def _loss(errors: list[np.ndarray], cutoffs: list[float]) -> float:
    """Tukey's loss of all errors, each over its cutoff."""
    shares = (np.maximum(1 - (error / cutoff) ** 2, 0) for error, cutoff in zip(errors, cutoffs, strict=True))
    return sum(float((1 - share * share * share).mean()) for share in shares)
