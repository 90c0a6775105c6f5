"""Medians and quantiles against numpy's own, bit for bit."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from splatpainter.order_statistics import MAX_EXACT, distinct, groups, median, quantile, row_keys, without


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 100, 1001])
@pytest.mark.parametrize("shape", [(), (3,)])
def test_they_are_the_bits_of_numpy(dtype: type, count: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(count)
    for values in (rng.normal(size=(count, *shape)).astype(dtype), rng.integers(0, 3, (count, *shape)).astype(dtype)):
        expected = np.median(values, axis=0)
        assert median(values).dtype == expected.dtype and np.array_equal(median(values), expected)
        for share in (0, 0.01, 0.25, 0.5, 0.75, 0.98, 0.99, 1):
            expected = np.quantile(values, share, axis=0)
            result = quantile(values, share)
            assert result.dtype == expected.dtype and np.array_equal(result, expected), share

            # A share in double precision makes the result double, as an array of shares does.
            in_doubles = quantile(values, np.float64(share))
            expected = np.quantile(values, [float(share)], axis=0)[0]
            assert in_doubles.dtype == expected.dtype and np.array_equal(in_doubles, expected), share


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_distinct_values_are_those_of_numpy(count: int) -> None:
    values, excluded = np.random.default_rng(count).integers(-20, 20, (2, count))
    for one, two in ((values, excluded), (excluded, values[:0]), (values, values)):
        assert np.array_equal(distinct(one), np.unique(one)) and distinct(one).dtype == one.dtype
        assert np.array_equal(without(one, two), np.setdiff1d(one, two))


@pytest.mark.parametrize("largest", [2, 1 << 20, 1 << 40, MAX_EXACT - 1])
@pytest.mark.parametrize("dtype", [np.int64, np.float64])
def test_keys_of_rows_group_them_as_numpy_does(largest: int, dtype: type) -> None:
    rng = np.random.default_rng(0)
    rows = rng.integers(-largest, largest, (60, 5), endpoint=True)[rng.integers(0, 60, 200)].astype(dtype)
    strays = rows.copy()
    strays[::7, 1] *= 1 << 10  # beyond what a float64 tells apart, or, of few bits, far from the others
    for values in (rows, strays, rows[:1], rows[:0], rows[:, :1]):
        expected = np.unique(values, axis=0, return_index=True, return_inverse=True, return_counts=True)[1:]
        for result, of_numpy in zip(groups(row_keys(values)), expected, strict=True):
            assert np.array_equal(result, of_numpy.ravel())


def test_one_nan_makes_its_column_nan() -> None:
    values = np.arange(15.0).reshape(5, 3)
    values[1, 2] = np.nan
    for result, expected in (
        (median(values), np.median(values, axis=0)),
        (quantile(values, 0.3), np.quantile(values, 0.3, axis=0)),
    ):
        assert np.array_equal(result, expected, equal_nan=True) and np.isnan(result).tolist() == [False, False, True]


def test_infinities_are_numbers() -> None:
    values = np.array([-np.inf, 1.0, 2.0, np.inf])
    assert median(values) == 1.5 and quantile(values, 0.5) == 1.5


def test_short_commands_and_edits_do_without_masked_arrays(tmp_path) -> None:
    program = (
        "import sys\n"
        "from pathlib import Path\n"
        "from splatpainter.cli import main\n"
        "from splatpainter.demo_asset import demo_asset, demo_view\n"
        "from splatpainter.io import write\n"
        "from splatpainter.output_paths import save_picture\n"
        "from splatpainter.rendering import render\n"
        "write('asset.ply', demo_asset())\n"
        "picture = render(demo_asset(), demo_view(256)).colors[0].copy()\n"
        "picture[100:140, 100:140] = (0.1, 0.8, 0.2)\n"
        "save_picture(Path('view.png'), picture, demo_view(256))\n"
        "edit = ['edit', 'asset.ply', 'view.png', '--out', 'painted.ply']\n"
        "codes = [main(words) for words in (['info', 'asset.ply'], ['convert', 'asset.ply', 'copy.ply'], edit)]\n"
        "print(codes, 'numpy.ma' in sys.modules, file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, encoding="utf-8")
    assert done.stderr.splitlines()[-1] == "[0, 0, 0] False"
