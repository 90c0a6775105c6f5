"""Elementary functions of native/maths.h against numpy's, and fused multiply-adds against exact fractions."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

from splatpainter.kernels import library
from splatpainter.kernels.library import kernels

RNG = np.random.default_rng(0)
WIDE = np.concatenate([RNG.uniform(-1, 1, 3000) * 10.0**k for k in (-12, -6, -3, 0, 1, 2, 3, 5)])
EDGES = np.array([0.0, -0.0, 1.0, -1.0, 1e-300, -1e-300, 1e300, -1e300, np.inf, -np.inf, np.nan, np.pi / 2, np.pi])


@pytest.mark.parametrize(
    ("name", "expected", "inputs"),
    [
        ("exp", np.exp, np.clip(WIDE, -700, 700)),
        ("log", np.log, np.abs(WIDE[WIDE != 0])),
        ("log", np.log, np.exp(RNG.uniform(-700, 700, 3000))),
        ("sin", np.sin, WIDE),
        ("cos", np.cos, WIDE),
        ("sin", np.sin, np.arange(-300, 300) * (np.pi / 2)),
        ("cos", np.cos, np.arange(-300, 300) * (np.pi / 2)),
        ("acos", np.arccos, RNG.uniform(-1, 1, 5000)),
        ("atan", np.arctan, WIDE),
    ],
)
def test_functions_are_numpys_to_the_last_places(name: str, expected: Callable, inputs: np.ndarray):
    out = np.empty_like(inputs)
    getattr(kernels, f"{name}_each")(inputs, out, 0, 1)
    np.testing.assert_array_max_ulp(out, expected(inputs), 2)
    single = inputs[np.abs(inputs) < 80].astype(np.float32)
    single = single[single != 0]
    rounded = np.empty_like(single)
    getattr(kernels, f"{name}_each")(single, rounded, 0, 1)
    np.testing.assert_array_max_ulp(rounded, expected(single.astype(np.float64)).astype(np.float32), 1)


@pytest.mark.parametrize(
    ("name", "expected"), [("log", np.log), ("acos", np.arccos), ("atan", np.arctan), ("exp", np.exp)]
)
def test_functions_at_their_edges(name: str, expected: Callable):
    out = np.empty_like(EDGES)
    getattr(kernels, f"{name}_each")(EDGES, out, 0, 1)
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(out, expected(EDGES), rtol=1e-15)


@pytest.mark.parametrize("name", ["sin", "cos"])
def test_angles_beyond_their_range_are_bounded_or_nan(name: str):
    out = np.empty_like(EDGES)
    getattr(kernels, f"{name}_each")(EDGES, out, 0, 1)
    assert (np.abs(out[np.isfinite(EDGES)]) <= 1).all() and np.isnan(out[~np.isfinite(EDGES)]).all()


def test_atan2_is_numpys_in_all_quadrants_and_at_the_edges():
    edges = np.array([0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, np.inf, -np.inf, np.nan])
    y, x = (a.ravel() for a in np.meshgrid(edges, edges))
    y, x = np.concatenate([y, RNG.normal(size=5000)]), np.concatenate([x, RNG.normal(size=5000)])
    out = np.empty_like(x)
    kernels.atan2_each(y, x, out, 0, 1)
    expected = np.arctan2(y, x)
    np.testing.assert_allclose(out, expected, rtol=1e-15, atol=1e-300)
    valid = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(out[valid]), np.signbit(expected[valid]))


def test_exp_of_float32_in_vectors():
    x = -np.abs(RNG.normal(size=1024).astype(np.float32)) * 20
    out = np.empty_like(x)
    kernels.exp_of_negative_each(x, out, 0, 1)
    np.testing.assert_allclose(out, np.exp(x.astype(np.float64)), rtol=5e-6)
    edges = np.array([0, -0.0, -200, -np.inf, np.nan, -126, -1e-30, -1e30] * 2, np.float32)
    out = np.empty_like(edges)
    kernels.exp_of_negative_each(edges, out, 0, 1)
    assert (out[:2] == 1).all() and (out[2:5] < 2e-38).all() and (out[2:] >= 0).all()


@pytest.mark.parametrize("cpu", library.current().cpus)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_fused_multiply_adds_are_rounded_once(cpu: str, dtype: type):
    """Also where nearly everything cancels, and at ties."""
    a, b = (RNG.normal(size=1500).astype(dtype) for _ in range(2))
    epsilon = np.finfo(dtype).eps
    c = (-a * b * (1 + RNG.integers(-3, 4, 1500) * epsilon * RNG.choice([0.5, 1, 1e3, 1e9], 1500))).astype(dtype)
    a[:300], b[:300] = np.round(a[:300] * 4), np.round(b[:300] * 4)
    c[:300] = np.ldexp(RNG.choice([1.0, -1, 3], 300), RNG.integers(20, 70, 300)).astype(dtype)
    out = np.empty_like(a)
    with library.using(cpu):
        kernels.fused_each(a, b, c, out, 0, 1)
    for x, y, z, result in zip(*(values.tolist() for values in (a, b, c, out)), strict=True):
        exact = Fraction(x) * Fraction(y) + Fraction(z)
        if dtype is np.float64:
            assert result == float(exact)
        else:  # no double rounding: no float32 is nearer
            error = abs(Fraction(result) - exact)
            for other in np.nextafter(np.float32(result), np.array([-np.inf, np.inf], np.float32)).tolist():
                assert error <= abs(Fraction(other) - exact)


@pytest.mark.parametrize("cpu", library.current().cpus)
def test_fused_multiply_adds_beside_the_middle_of_two_floats(cpu: str):
    """Sums that a double rounds to the very middle, also of subnormal floats: rounded again, half of them would go the
    wrong way."""
    k, count = RNG.integers(1, 4, 600), 600
    c = np.ldexp(RNG.integers(1 << 23, 1 << 24, count), -23).astype(np.float32)
    half = np.ldexp(RNG.choice([1.0, -1.0], count), -24)  # of the distance between neighbours of 1 to 2
    a, b = (1 + k * 2.0**-23).astype(np.float32), (half * (1 - k * 2.0**-23)).astype(np.float32)
    scale = np.ldexp(np.float32(1), np.where(np.arange(count) < 400, 0, -RNG.integers(127, 140, count)))
    c, a = (c * scale).astype(np.float32), (a * scale).astype(np.float32)
    out = np.empty_like(c)
    with library.using(cpu):
        kernels.fused_each(a, b, c, out, 0, 1)
    for x, y, z, result in zip(*(values.tolist() for values in (a, b, c, out)), strict=True):
        exact = Fraction(x) * Fraction(y) + Fraction(z)
        error = abs(Fraction(result) - exact)
        for other in np.nextafter(np.float32(result), np.array([-np.inf, np.inf], np.float32)).tolist():
            assert error <= abs(Fraction(other) - exact)
