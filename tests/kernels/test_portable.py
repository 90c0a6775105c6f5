"""Products and functions against numpy's own, and their bytes on every kind of CPU."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.kernels import portable
from tests.support.kernel_goldens import CPUS, Numbers, check


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("first", "second"),
    [
        ((7, 3), (3, 3)),
        ((4, 5, 3), (3, 3)),
        ((3,), (3, 2)),
        ((7, 3), (3,)),
        ((4, 5, 3), (3,)),
        ((6, 3, 3), (6, 3, 3)),
        ((3, 3), (6, 3, 2)),
        ((6, 4, 5), (5, 7)),
        ((1, 2, 3), (5, 3, 3)),
        ((9000, 36), (36, 36)),
        ((3, 10, 17), (17, 16)),
        ((3, 11, 2), (3, 2, 35)),
        ((0, 3), (3, 3)),
        ((0, 3, 3), (3, 3)),
        ((3, 3), (0, 3, 3)),
        ((5, 0), (0, 2)),
    ],
)
def test_products_are_numpys(first: tuple[int, ...], second: tuple[int, ...], dtype: type):
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=shape).astype(dtype) for shape in (first, second))
    out = portable.matmul(a, b)
    assert out.dtype == dtype
    np.testing.assert_allclose(out, a @ b, rtol=0, atol=60 * np.finfo(dtype).eps)
    np.testing.assert_array_equal(portable.matmul(np.asfortranarray(a), b[::-1][::-1]), out)


def test_products_of_other_shapes_are_refused():
    for first, second in (((4, 3), (2, 3)), ((2, 3, 3), (4, 3, 3))):
        with pytest.raises(ValueError, match="matmul"):
            portable.matmul(np.ones(first), np.ones(second))


@pytest.mark.filterwarnings("error")
def test_hypot_of_numbers_whose_squares_overflow():
    x = np.array([3e30, 3, np.inf, np.nan, 0, -3e38], np.float32)
    y = np.array([4e30, 4, 1, 1, 0, 1], np.float32)
    np.testing.assert_allclose(portable.hypot(x, y), [5e30, 5, np.inf, np.nan, 0, 3e38], rtol=1e-6)
    assert portable.hypot(3e200, 4e200) == pytest.approx(5e200)


@pytest.mark.parametrize("size", [1, 5, 10, 36])
def test_least_squares_are_numpys(size: int):
    rng = np.random.default_rng(1)
    rows, weights, right = rng.normal(size=(700, size)), rng.random(700), rng.normal(size=(700, 3))
    gram = portable.gram(rows, weights)
    np.testing.assert_allclose(gram, (rows * weights[:, None]).T @ rows, atol=1e-11)
    np.testing.assert_allclose(portable.gram(rows.astype(np.float32), weights), gram, atol=1e-3)
    product = portable.transposed_product(rows, right)
    np.testing.assert_allclose(product, rows.T @ right, atol=1e-11)
    np.testing.assert_allclose(portable.solved(gram, product), np.linalg.solve(gram, product), atol=1e-12)
    np.testing.assert_allclose(portable.solved(gram, np.eye(size)), np.linalg.inv(gram), atol=1e-12)
    assert portable.log_determinant(gram) == pytest.approx(np.linalg.slogdet(gram)[1], rel=1e-12)


def test_axes_of_symmetric_matrices_are_numpys() -> None:
    """Of round, flat and long ones, and of those whose values are equal."""
    rng = np.random.default_rng(4)
    points = rng.normal(size=(500, 9, 3)) * 10 ** rng.uniform(-4, 0, (500, 1, 3))
    turned = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
    matrices = np.einsum("npi,npj,nik,njl->nkl", points, points, turned, turned)
    equal = [np.eye(3), np.zeros((3, 3)), np.diag([1.0, 1, 2]), np.diag([2.0, 1, 2]), np.ones((3, 3))]
    matrices = np.concatenate([matrices, equal])
    values, axes = portable.symmetric_axes(matrices)
    largest = np.maximum(np.abs(matrices).max((1, 2)), 1e-30)[:, None]
    assert np.abs((values - np.linalg.eigvalsh(matrices)) / largest).max() < 1e-14
    assert np.abs(axes.transpose(0, 2, 1) @ axes - np.eye(3)).max() < 1e-14
    assert np.abs((matrices @ axes - values[:, None] * axes) / largest[..., None]).max() < 1e-14


def test_inverses_and_determinants_are_numpys() -> None:
    matrices = np.random.default_rng(5).normal(size=(50, 3, 3))
    assert np.allclose(portable.determinant(matrices), np.linalg.det(matrices), rtol=1e-12)
    for matrix in matrices:
        assert np.allclose(portable.inverse(matrix), np.linalg.inv(matrix), rtol=1e-9)
    with pytest.raises(ValueError, match="singular"):
        portable.inverse(np.ones((3, 3)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_functions_are_numpys(dtype: type):
    x = np.linspace(-3, 3, 40001).astype(dtype).reshape(1, -1)
    y = x[:, ::-1] + dtype(0.1)
    pairs = [
        (portable.exp(x), np.exp(x)),
        (portable.log(x + 4), np.log(x + 4)),
        (portable.sin(x), np.sin(x)),
        (portable.cos(x), np.cos(x)),
        (portable.arccos(x / 3), np.arccos(x / 3)),
        (portable.arctan2(y, x), np.arctan2(y, x)),
        (portable.hypot(x, y), np.hypot(x, y)),
        (portable.power(x + 3, 2.4), (x + 3) ** 2.4),
        (portable.power(x + 3, 1 / 3), np.cbrt(x + 3)),
    ]
    light = np.abs(x)
    curved, bent = 1.055 * light ** (1 / 2.4) - 0.055, ((light + 0.055) / 1.055) ** 2.4
    pairs.append((portable.srgb(light, False), np.where(light <= 0.0031308, 12.92 * light, curved)))
    pairs.append((portable.srgb(light, True), np.where(light <= 0.04045, light / 12.92, bent)))
    for ours, numpys in pairs:
        assert ours.dtype == dtype and ours.shape == x.shape
        np.testing.assert_allclose(ours, numpys, rtol=4 * np.finfo(dtype).eps, atol=np.finfo(dtype).eps)
    assert isinstance(portable.cos(0.5), float) and portable.length(np.array([3.0, 0, 4])) == 5


def test_silu_is_that_of_the_formula():
    x = np.concatenate([np.linspace(-100, 100, 20003), [0, -0.0, np.inf]]).astype(np.float32)
    with np.errstate(over="ignore"):
        expected = x.astype(np.float64) / (1 + np.exp(-x.astype(np.float64)))
    np.testing.assert_allclose(portable.silu(x), expected, rtol=5e-6, atol=2e-34)
    assert np.isnan(portable.silu(np.array([np.nan, 1])))[0]


def test_interpolation_is_numpys():
    points, values = np.array([0.0, 0.1, 0.5, 2]), np.array([1.0, 3, -1, 0])
    x = np.linspace(-1, 3, 1001)
    np.testing.assert_allclose(portable.interp(x, points, values), np.interp(x, points, values), atol=1e-15)
    assert portable.interp(0.3, points, values) == pytest.approx(1)


def products() -> list[np.ndarray]:
    r = Numbers(1)
    stacks, rows, weights = r.uniform(-1, 1, 300, 3, 3), r.uniform(-1, 1, 900, 21), r.uniform(0, 2, 900)
    gram, right = portable.gram(rows, weights), portable.transposed_product(rows, rows[:, :4])
    turned = portable.matmul(rows[:, :3], stacks[0]), portable.matmul(stacks.astype(np.float32), stacks[0].astype("f4"))
    return [
        portable.matmul(stacks, stacks[::-1]),
        *turned,
        portable.matmul(rows, gram),
        gram,
        portable.solved(gram, right),
    ]


def functions() -> list[np.ndarray]:
    x, y = Numbers(2).uniform(-1, 1, 2, 40000)
    out = [portable.exp(9 * x), portable.log(1 + x), portable.sin(20 * x), portable.cos(20 * x), portable.arccos(x)]
    single = (9 * x).astype(np.float32)
    return [*out, portable.arctan2(x, y), portable.hypot(x, y), portable.exp(single), portable.silu(single)]


GOLDENS = {products: "0cca80f0836e8b87", functions: "bf299f9afad96b27"}


@pytest.mark.parametrize("cpu", CPUS)
@pytest.mark.parametrize("case", GOLDENS)
def test_bytes_are_the_same_everywhere(case, cpu: str, monkeypatch: pytest.MonkeyPatch):
    check(case, GOLDENS[case], cpu, monkeypatch)


def test_differences_from_one_are_precise_near_zero():
    sizes = np.concatenate([10.0 ** np.linspace(-300, 2, 3001), np.linspace(0, 700, 3001)])
    x = np.concatenate([-sizes, sizes, [np.inf, -np.inf]])
    with np.errstate(all="ignore"):
        np.testing.assert_allclose(portable.expm1(x), np.expm1(x), rtol=5e-16)
        y = x[x > -1]
        np.testing.assert_allclose(portable.log1p(y), np.log1p(y), rtol=5e-16)
        ends = portable.log1p(np.array([-1.0, -2.0, np.nan]))
    assert ends[0] == -np.inf and np.isnan(ends[1:]).all() and np.isnan(portable.expm1(np.nan))
