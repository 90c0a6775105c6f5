"""Words of compressed PLY files: the kernels against the format's formulas in numpy, on every kind of CPU."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.kernels import library
from splatpainter.kernels.parallel import run
from splatpainter.splats import SH_C0

COUNT, CHUNK = 700, 256
SHIFTS, WIDTHS = (21, 11, 0), (11, 10, 11)
LEVELS = np.array([2047, 1023, 2047])


def quantised(values: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """[N, 3] the nearest of 0..levels between the ends; of an empty range 0."""
    with np.errstate(all="ignore"):
        share = (values - low) / (high - low)
    share[~((high > low) & np.isfinite(high - low))] = 0
    return np.floor(np.clip(share, 0, 1) * levels + 0.5).astype(np.uint32)


def between(fields: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        part = fields / levels.astype(float)
        return low * (1 - part) + high * part


def rotation_fields(quats: np.ndarray) -> np.ndarray:
    """[N, 4]: which component is the largest, then the others in order, 0..1023."""
    out = []
    for q in quats.astype(float):
        unit = q / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
        at = int(np.abs(unit).argmax())
        unit = unit * (-1 if unit[at] < 0 else 1)
        small = np.delete(unit, at) / np.sqrt(2)
        out.append([at, *np.clip(np.floor((small + 0.5) * 1023 + 0.5), 0, 1023).astype(int)])
    return np.array(out, np.uint32)


def row_values(seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.normal(size=(COUNT, 3)) * 10.0 ** rng.integers(-6, 7, (COUNT, 1)),
        "log_scales": rng.uniform(-20, 20, (COUNT, 3)),
        "sh": rng.normal(size=(COUNT, 4, 3)) * 3,
        "opacities": rng.uniform(size=COUNT),
        "quats": rng.normal(size=(COUNT, 4)),
    }
    arrays = {name: array.astype(np.float32) for name, array in values.items()}
    # A chunk of one value, equal components, both signs of the largest one, half a step, the ends.
    arrays["means"][CHUNK : 2 * CHUNK, 1] = arrays["log_scales"][:CHUNK, 2] = 3
    arrays["quats"][:5] = [[1, 1, 1, 1], [-1, 1, -1, 1], [0, 0, 0, -2], [-1, 0, 0, 0], [3, -4, 0, 12]]
    arrays["opacities"][:4] = 0, 1, 0.5 / 255, np.float32(254.5 / 255)
    return arrays


@pytest.mark.parametrize("cpu", library.current().cpus)
@pytest.mark.parametrize("threads", ["1", "3"])
def test_words_are_those_of_the_formulas(cpu: str, threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    arrays, chunk = row_values(1), np.arange(COUNT) // CHUNK
    colors = (0.5 + SH_C0 * arrays["sh"][:, 0].astype(float)).astype(np.float32)
    groups = (arrays["means"], arrays["log_scales"], colors)
    ranges = np.full((3, 18), np.nan, np.float32)
    words = np.zeros((COUNT, 4), np.uint32)
    with library.using(cpu) as kernels:
        run(kernels.pack_chunks, *arrays.values(), SH_C0, ranges, words)
        rounded = np.full((COUNT, 3), np.nan, np.float32)
        run(kernels.round_in_chunks, arrays["means"], rounded)
    for at, (word, values) in enumerate(zip((0, 2, 3), groups, strict=True)):
        low = np.array([values[chunk == c].min(0) for c in range(3)])
        high = np.array([values[chunk == c].max(0) for c in range(3)])
        np.testing.assert_array_equal(ranges[:, 6 * at : 6 * at + 6], np.hstack([low, high]))
        low, high = low[chunk].astype(float), high[chunk].astype(float)
        levels = LEVELS if at < 2 else np.array([255] * 3)
        fields = quantised(values.astype(float), low, high, levels)
        shifts = SHIFTS if at < 2 else (24, 16, 8)
        result = np.stack(
            [words[:, word] >> s & (n if at < 2 else 255) for s, n in zip(shifts, LEVELS, strict=True)], 1
        )
        np.testing.assert_array_equal(result, fields)
        if at == 0:
            np.testing.assert_array_equal(rounded, between(fields, low, high, levels).astype(np.float32))
    np.testing.assert_array_equal(words[:, 3] & 255, np.floor(arrays["opacities"].astype(float) * 255 + 0.5))
    turned = np.stack([words[:, 1] >> 30, *(words[:, 1] >> s & 1023 for s in (20, 10, 0))], 1)
    np.testing.assert_array_equal(turned, rotation_fields(arrays["quats"]))


@pytest.mark.parametrize("cpu", library.current().cpus)
@pytest.mark.parametrize("threads", ["1", "3"])
def test_values_are_those_of_the_formulas(cpu: str, threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in ranges that no value can lie in, as files may have them."""
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    rng = np.random.default_rng(2)
    words = rng.integers(0, 1 << 32, (COUNT, 4), np.uint32)
    ranges = rng.normal(size=(3, 18)).astype(np.float32)
    ranges[1, [0, 6, 12]], ranges[2, 3], ranges[2, 9] = np.nan, np.inf, -np.inf
    means, sh = np.zeros((COUNT, 3), np.float32), np.full((COUNT, 4, 3), 7, np.float32)
    log_scales, opacities = np.zeros((COUNT, 3)), np.zeros(COUNT, np.float32)
    quats = np.zeros((COUNT, 4), np.float32)
    with library.using(cpu) as kernels:
        run(kernels.unpack_chunks, words, ranges, SH_C0, means, log_scales, sh, opacities, quats)
    ends = ranges[np.arange(COUNT) // CHUNK].astype(float)
    for at, (word, result) in enumerate(((0, means), (2, log_scales), (3, sh[:, 0]))):
        levels = LEVELS if at < 2 else np.array([255] * 3)
        shifts = SHIFTS if at < 2 else (24, 16, 8)
        fields = np.stack([words[:, word] >> s & n for s, n in zip(shifts, levels, strict=True)], 1)
        expected = between(fields, ends[:, 6 * at : 6 * at + 3], ends[:, 6 * at + 3 : 6 * at + 6], levels)
        expected = (expected - 0.5) / SH_C0 if at == 2 else expected
        np.testing.assert_array_equal(result, expected.astype(result.dtype))
    np.testing.assert_array_equal(opacities, ((words[:, 3] & 255) / 255).astype(np.float32))
    assert (sh[:, 1:] == 7).all(), "bands beyond the first are not in these words"
    for word, q in zip(words[:50, 1], quats, strict=False):
        small = [((int(word) >> shift & 1023) / 1023 - 0.5) * np.sqrt(2) for shift in (20, 10, 0)]
        largest = np.sqrt(max(0.0, 1 - ((small[0] * small[0] + small[1] * small[1]) + small[2] * small[2])))
        np.testing.assert_array_equal(q, np.insert(small, int(word) >> 30, largest).astype(np.float32))


@pytest.mark.parametrize("cpu", library.current().cpus)
@pytest.mark.parametrize("threads", ["1", "3"])
def test_bytes_of_sh_are_those_of_the_formulas(cpu: str, threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", threads)
    sh = row_values(3)["sh"]
    sh[:6, 2] = np.array([np.nan, np.inf, -np.inf, 4, -4, 3e38], np.float32)[:, None]
    result, table = np.zeros((COUNT, 9), np.uint8), np.random.default_rng(4).normal(size=256).astype(np.float32)
    again = sh.copy()
    with library.using(cpu) as kernels:
        run(kernels.pack_sh_bytes, sh, result)
        run(kernels.unpack_sh_bytes, result, table, again)
    with np.errstate(over="ignore"):
        values = np.nan_to_num(sh[:, 1:].astype(float)).transpose(0, 2, 1).clip(-9, 9)
    expected = np.clip(np.trunc((values / 8 + 0.5) * 256), 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(result, expected.reshape(COUNT, 9))
    np.testing.assert_array_equal(again[:, 1:], table[expected].transpose(0, 2, 1))
    np.testing.assert_array_equal(again[:, 0], sh[:, 0])
