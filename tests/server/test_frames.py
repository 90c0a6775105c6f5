"""Binary frames of Gaussians, against bytes written out by hand."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.server import frames
from splatpainter.splats import SH_C0, Splats
from tests.support.studio_scenes import ball


def two_gaussians() -> Splats:
    return Splats(
        np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        np.array([[2, 0, 0, 0], [0, 3, 0, 4]], np.float32),
        np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], np.float32),
        np.array([0.5, 1], np.float32),
        np.array([[[0.1, 0.2, 0.3]], [[0.4, 0.5, 0.6]]], np.float32),
    )


def test_a_delta_is_these_bytes() -> None:
    header = struct.pack("<8I", 0x53504C44, 1, 0, 7, 9, 2, 1, 1)
    index = struct.pack("<I", 1)
    geometry = struct.pack("<10f", 4, 5, 6, 0.4, 0.5, 0.6, 0, 0.6, 0, 0.8)
    look = struct.pack("<4f", 1, 0.4, 0.5, 0.6)
    assert frames.delta(two_gaussians(), np.array([1]), 7, 9) == header + index + geometry + look


def test_a_snapshot_has_no_indices_and_a_preview_no_geometry() -> None:
    every = frames.snapshot(two_gaussians(), 4)
    assert struct.unpack_from("<8I", every) == (0x53504C44, 1, 1, 4, 4, 2, 2, 1)
    assert len(every) == 32 + 2 * 4 * (3 + 3 + 4 + 1 + 3)
    look = frames.preview(two_gaussians(), np.array([5, 8]), 20, 4)
    assert struct.unpack_from("<8I", look) == (0x53504C44, 1, 2 | 4, 4, 4, 20, 2, 1)
    assert len(look) == 32 + 2 * 4 * (1 + 1 + 3)


def test_what_was_packed_comes_out() -> None:
    splats = ball(50)
    ids = np.array([3, 17, 49])
    frame = frames.unpack(frames.delta(splats, ids, 1, 2))
    assert (frame.version_from, frame.version_to, frame.total) == (1, 2, 50)
    assert np.array_equal(frame.gaussian_ids, ids)
    assert np.array_equal(frame.splats.sh, splats.sh[ids])
    assert np.array_equal(frame.splats.means, splats.means[ids])
    unit = splats.quats[ids] / np.linalg.norm(splats.quats[ids], axis=1, keepdims=True)
    assert np.allclose(frame.splats.quats, unit, atol=1e-6)
    everything = frames.unpack(frames.snapshot(splats, 3))
    assert np.array_equal(everything.gaussian_ids, np.arange(50))
    assert np.array_equal(everything.splats.opacities, splats.opacities)


def test_tints_are_what_a_screen_holds() -> None:
    sh = np.array([[[0.3, -1.2, 0], [0.75, -0.3, 0.1], [1e-9, 0, 0], [-0.01, 0.02, 0.004]]], np.float32)
    # the same numbers as in web/test/splats.test.ts
    colors = struct.pack("<3Hxx3I", 0x38AD, 0x312B, 0x3800, 0x7A1A4DBF, 0, 0x5121A352)
    head = struct.pack("<8I", 0x53504C44, 1, 2 | 8, 6, 6, 9, 1, 4)
    assert frames.preview_colors(sh, np.array([7]), 9, 6) == head + struct.pack("<I", 7) + colors
    every = frames.preview_colors(sh, np.array([0]), 1, 6)
    assert every[32:] == colors  # all rows: none is named
    assert frames.preview_colors(sh[:, :1], np.array([0]), 1, 6)[32:] == colors[:8]
    assert frames.preview_colors(np.full((1, 1, 3), np.nan, np.float32), np.array([0]), 1, 6)[32:] == bytes(8)


@pytest.mark.parametrize(("count", "bands"), [(7, 4), (8, 1), (3, 16)])
def test_tints_are_as_near_as_their_bits(count: int, bands: int) -> None:
    rng = np.random.default_rng(3)
    sh = (rng.normal(size=(count, bands, 3)) * 2.0 ** rng.integers(-9, 2, (count, bands, 1))).astype(np.float32)
    ids = np.sort(rng.choice(20, count, replace=False))
    frame = frames.unpack(frames.preview_colors(sh, ids, 20, 2))
    assert np.array_equal(frame.gaussian_ids, ids) and frame.total == 20
    back = frame.splats.sh
    np.testing.assert_allclose(back[:, 0], sh[:, 0], atol=2e-3, rtol=1e-3)  # 11 bits of 0.5 + Y sh
    step = 2.0 ** np.ceil(np.log2(np.abs(sh[:, 1:]).max(2, keepdims=True))) / 255
    assert (np.abs(back[:, 1:] - sh[:, 1:]) <= 0.501 * step).all()
    with pytest.raises(ValueError, match="frame: expected"):
        frames.unpack(frames.preview_colors(sh, ids, 20, 2)[:-1])


def test_colors_are_packed_by_the_formula() -> None:
    """Halves are numpy's; codes are those of exact arithmetic, value by value."""
    rng = np.random.default_rng(1)
    sh = (rng.normal(size=(400, 4, 3)) * 10.0 ** rng.integers(-9, 7, (400, 1, 1))).astype(np.float32)
    sh[:4, 1] = [[0.25, -0.5, 2.0**-15], [3e38, -3e38, 1], [np.inf, -1, np.nan], [-0.0, 1e-45, 0]]
    sh[:4, 0] = [[0, np.nan, np.inf], [-np.inf, 1e9, -1e9], [-0.5 / SH_C0, 3e-5, -1.7725], [2.0**-24, 2.0**-14, 1]]
    colors = np.nan_to_num(0.5 + SH_C0 * sh[:, 0].astype(np.float64), nan=0).clip(-65504, 65504)
    assert np.array_equal(frames.pack_base(sh), colors.astype(np.float32).astype(np.float16))
    codes = frames.pack_harmonics(sh)
    for row, column in np.ndindex(codes.shape):
        values = [float(value) for value in np.nan_to_num(sh[row, 1 + column])]
        largest, expected = max(map(abs, values)), 0
        if largest > 0:
            fraction, power = math.frexp(largest)
            exponent = min(max(power - (fraction == 0.5) + 15, 0), 31)
            steps = [min(int(float(np.float32(abs(v) * 255 * 2.0 ** (15 - exponent))) + 0.5), 255) for v in values]
            expected = exponent << 27 | sum(
                step << 8 * k | (v < 0) << 24 + k for k, (step, v) in enumerate(zip(steps, values, strict=True))
            )
        assert codes[row, column] == expected, values


def test_colours_between_two_halves_become_the_even_one() -> None:
    """Steps of 2^-12 over 0.5 to 1, where halves are 2^-11 apart: every second one lies in the middle."""
    targets = 0.5 + np.arange(2049) / 4096
    sh = ((targets - 0.5) / SH_C0).astype(np.float32)
    # The coefficient nearest to each that gives just this colour, of those around its quotient.
    near = np.stack([np.nextafter(sh, np.float32(k)) if k else sh for k in (-1, 0, 9)])
    colors = (0.5 + SH_C0 * near.astype(np.float64)).astype(np.float32)
    coefficients = near[(colors == targets.astype(np.float32)).argmax(0), np.arange(len(sh))]
    exact = (0.5 + SH_C0 * coefficients.astype(np.float64)).astype(np.float32)
    middle = (exact == targets) & (np.arange(2049) % 2 == 1)
    assert middle.sum() > 200
    packed = frames.pack_base(np.repeat(coefficients, 3).reshape(-1, 1, 3))
    assert np.array_equal(packed, np.repeat(exact.astype(np.float16), 3).reshape(-1, 3))


def test_gaussians_that_no_screen_can_show_are_hidden() -> None:
    splats = ball(5)
    means, quats = splats.means.copy(), splats.quats.copy()
    means[1, 0], quats[3] = np.nan, 0
    frame = frames.unpack(frames.snapshot(replace(splats, means=means, quats=quats), 1))
    assert frame.splats.opacities.tolist() == pytest.approx([0.95, 0, 0.95, 0, 0.95])
    assert np.isfinite(frame.splats.means).all() and np.isfinite(frame.splats.quats).all()


@pytest.mark.parametrize("broken", [b"", b"\0" * 40, struct.pack("<8I", frames.MAGIC, 1, 0, 0, 0, 9, 9, 1)])
def test_what_is_no_frame_is_refused(broken: bytes) -> None:
    with pytest.raises(ValueError, match="frame: expected"):
        frames.unpack(broken)


def test_rotations_beyond_every_range_travel_without_a_warning() -> None:
    splats = two_gaussians()
    splats.quats[1] = 3e38
    received = frames.unpack(frames.snapshot(splats, 1)).splats
    assert received.opacities.tolist() == [0.5, 0] and received.quats.tolist()[0] == [1, 0, 0, 0]
