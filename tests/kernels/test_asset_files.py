"""Rows of PLY and SOG files, and the look at which of them can be drawn, against the same formulas in numpy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.io.formats import activations
from splatpainter.kernels import library
from splatpainter.kernels.parallel import THREADS_VARIABLE, run, threads
from splatpainter.splats import ATTRIBUTES, MAX_MAGNITUDE, MIN_QUAT, Splats
from tests.support.render_scenes import scene

COUNT = 200
ODD = np.array([0.0, -0.0, 1.0, -1.0, 1e-30, 1e-45, 1e38, -1e38, np.inf, -np.inf, np.nan, 0.5, 16.7, -42], np.float32)


def asset(seed: int = 0) -> Splats:
    return scene(COUNT, 1, seed, dtype=np.float32)


@pytest.fixture(params=["1", "3"], autouse=True)
def some_threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, request.param)


@pytest.mark.parametrize("cpu", library.current().cpus)
def test_ply_rows_are_taken_apart_and_put_together(cpu: str) -> None:
    rng = np.random.default_rng(0)
    records = rng.normal(size=(COUNT, 26)).astype(np.float32)
    records[: len(ODD), :] = ODD[:, None]
    records[100:150] = rng.integers(0, 1 << 32, (50, 26), np.uint32).view(np.float32)  # NaN with payloads among them
    columns = rng.permutation(26)[:23].astype(np.int64)
    means, quats, scales, opacities, sh = np.split(records[:, columns], [3, 7, 10, 11], axis=1)
    out = [np.empty((COUNT, width), np.float32) for width in (3, 4, 3, 1, 12)]
    with library.using(cpu), np.errstate(all="ignore"):
        bits = [values.view(np.uint32) for values in out]
        unpacked = bits[0], bits[1], out[2], out[3][:, 0], bits[4]
        run(library.current().unpack_ply_rows, records.view(np.uint32), columns, *unpacked)
        for values, expected in zip(out, (means, quats, None, None, sh), strict=True):
            if expected is not None:
                np.testing.assert_array_equal(values.view(np.uint32), np.ascontiguousarray(expected).view(np.uint32))
        np.testing.assert_array_equal(out[2], activations.exp(scales))
        np.testing.assert_array_equal(out[3], activations.sigmoid(opacities))
        # Put together again: the logarithms and logits of these, and nothing in the columns of others.
        out[2][:40, 0] = np.resize(ODD, 40)
        out[3][:40, 0] = np.resize(ODD, 40)
        again = np.full_like(records, 7)
        limits = (activations.MIN_SCALE, activations.MIN_OPACITY, activations.MAX_OPACITY)
        packed = bits[0], bits[1], out[2], out[3][:, 0], bits[4]
        run(library.current().pack_ply_rows, *packed, columns, *limits, again.view(np.uint32))
        expected = np.concatenate([means, quats, activations.log(out[2]), activations.logit(out[3]), sh], 1)
        np.testing.assert_array_equal(again[:, columns], expected)
        assert (np.delete(again, columns, 1) == 7).all()


@pytest.mark.parametrize("cpu", library.current().cpus)
def test_sog_pixels_are_what_their_formulas_say(cpu: str) -> None:
    rng = np.random.default_rng(1)
    low, high, turns, sizes, colors, labels = rng.integers(0, 256, (6, COUNT, 4), np.uint8)
    turns[:, 3] = rng.integers(250, 256, COUNT)
    turns[:8] = 255, 255, 255, 252  # three components as large as can be: nothing is left for the fourth
    labels[:, 1] = rng.integers(0, 2, COUNT)
    positions = rng.normal(size=(3, 1 << 16)).astype(np.float32)
    scale_of, base_of = rng.normal(size=(2, 256)).astype(np.float32)
    palette = rng.normal(size=(300, 9)).astype(np.float32)
    out = replace(asset(), **{name: np.full_like(getattr(asset(), name), np.nan) for name in ATTRIBUTES})
    counts = np.zeros((threads(), 2), np.int64)
    with library.using(cpu):
        run(
            library.current().unpack_sog_rows, low, high, turns, sizes, colors, labels, positions, scale_of, base_of,
            palette, out.means, out.quats, out.scales, out.opacities, out.sh.reshape(COUNT, -1), counts,
        )  # fmt: skip
    entries = labels[:, 0].astype(int) + 256 * labels[:, 1].astype(int)
    named = entries < len(palette)
    for k in range(3):
        words = low[:, k].astype(int) + 256 * high[:, k].astype(int)
        np.testing.assert_array_equal(out.means[:, k], positions[k][words])
        np.testing.assert_array_equal(out.scales[:, k], scale_of[sizes[:, k]])
        np.testing.assert_array_equal(out.sh[:, 0, k], base_of[colors[:, k]])
    np.testing.assert_array_equal(out.opacities, (colors[:, 3] / 255).astype(np.float32))
    rest = out.sh[:, 1:].reshape(COUNT, -1)
    np.testing.assert_array_equal(rest[named], palette[entries[named]])
    assert not rest[~named].any()
    for quat, pixel in zip(out.quats, turns, strict=True):
        small = [(float(value) / 255 * 2 - 1) / math.sqrt(2) for value in pixel[:3]]
        left = math.sqrt(max(0.0, 1 - (small[0] * small[0] + small[1] * small[1] + small[2] * small[2])))
        expected = [*small[: pixel[3] - 252], left, *small[pixel[3] - 252 :]] if pixel[3] >= 252 else [1, 0, 0, 0]
        np.testing.assert_array_equal(quat, np.array(expected, np.float32))
    assert counts.sum(0).tolist() == [int((turns[:, 3] < 252).sum()), int((~named).sum())]
    assert 0 < (~named).sum() < COUNT and 0 < (turns[:, 3] < 252).sum() < COUNT


@pytest.mark.parametrize("cpu", library.current().cpus)
def test_which_rows_can_be_drawn_and_why_others_cannot(cpu: str) -> None:
    splats, rng = asset(), np.random.default_rng(2)
    limits = np.array([MAX_MAGNITUDE, 2 * MAX_MAGNITUDE, MIN_QUAT, 0.4 * MIN_QUAT, MAX_MAGNITUDE / 100], np.float32)
    values = np.concatenate([ODD, limits, -limits])
    for name in ATTRIBUTES:
        array = getattr(splats, name).reshape(COUNT, -1)
        rows = rng.choice(COUNT, 40, replace=False)
        array[rows, rng.integers(0, array.shape[1], 40)] = rng.choice(values, 40)
    splats.quats[5] = 0
    splats.quats[6] = MIN_QUAT / 2
    splats.sh[7] = MAX_MAGNITUDE / 20  # of twelve: less than the limit
    splats.sh[8] = MAX_MAGNITUDE / 10
    with np.errstate(all="ignore"):
        columns = {name: getattr(splats, name).reshape(COUNT, -1) for name in ATTRIBUTES}
        finite = np.isfinite(np.concatenate(list(columns.values()), 1)).all(1)
        unturned, flat = (splats.quats == 0).all(1), (splats.scales <= 0).any(1)
        outside = (splats.opacities < 0) | (splats.opacities > 1)
        turned = (np.abs(splats.quats) >= np.float32(MIN_QUAT)).any(1)
        within = (np.abs(np.concatenate([columns[k] for k in ("means", "quats", "scales")], 1)) <= MAX_MAGNITUDE).all(1)
        tints = np.abs(columns["sh"].astype(np.float64)).sum(1) <= MAX_MAGNITUDE
    drawable = finite & turned & ~flat & ~outside & within & tints
    with library.using(cpu):
        checks = splats.row_checks
        assert replace(splats, means=splats.means.astype(np.float64)).drawable.tolist() == drawable.tolist()
    np.testing.assert_array_equal(checks.drawable, drawable)
    assert not checks.drawable[[5, 6, 8]].any() and checks.drawable.any()
    beyond = ~(drawable | ~finite | unturned | flat | outside)
    counts = [int(kind.sum()) for kind in (~finite, unturned, flat, outside, beyond)]
    assert [checks.not_finite, checks.zero_rotation, checks.flat_scale, checks.opacity_outside, checks.beyond] == counts
    assert min(counts) > 0
