"""What the tests of the packed formats (SPZ, SOG, GLB) share: damage, promises about unchanged rows."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.splats import ATTRIBUTES, Splats

Reader = Callable[[Path], Splats]


def damages(data: bytes, rounds: int, seed: int = 0, head: int = 400, cuts: int = 64) -> Iterator[bytes]:
    """Cut at every 64th, then random changes of 1-4 bytes, insertions and deletions, half of them near the start."""
    rng = np.random.default_rng(seed)
    yield from (data[: len(data) * k // cuts] for k in range(cuts))
    for round_ in range(rounds):
        out = bytearray(data)
        for _ in range(rng.integers(1, 5)):
            at = int(rng.integers(0, len(out) if round_ % 2 else min(len(out), head)))
            action = rng.integers(0, 4)
            if action == 0:
                out[at : at + 1] = rng.bytes(1)
            elif action == 1:
                out[at : at + 4] = [b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\0\x80", b"9999"][rng.integers(0, 4)]
            elif action == 2:
                del out[at : at + int(rng.integers(1, 5))]
            else:
                out[at:at] = rng.bytes(2)
        yield bytes(out)


def survives(read: Reader, path: Path, damaged: Iterator[bytes], peak: int = 16 << 20) -> tuple[int, int]:
    """(files read, files refused); fails on anything but a ValueError of one line, and on more than `peak` bytes."""
    good = bad = 0
    for data in damaged:
        path.write_bytes(data)
        tracemalloc.start()
        try:
            splats = read(path)
            assert splats.means.shape == (len(splats), 3)
            good += 1
        except ValueError as error:
            assert "\n" not in str(error) and str(error).startswith(str(path.parent)) and len(str(error)) < 500, error
            bad += 1
        finally:
            used = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert used < peak, used
    return good, bad


def same_bits(new: Splats, old: Splats, rows: np.ndarray | slice = slice(None)) -> bool:
    """Whether the given rows of `new` are bit for bit those of `old` (row by row)."""
    return all(
        np.array_equal(getattr(new, name)[rows].view(np.uint32), getattr(old, name)[rows].view(np.uint32))
        for name in ATTRIBUTES
    )


def alone(splats: Splats) -> Splats:
    """The rows without the file they came from."""
    return replace(splats, source=None, origin=None)


def quats_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Largest component difference of two sets of rotations, as unit quaternions up to sign."""
    a, b = (q / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (a, b))
    return float(np.minimum(np.abs(a - b).max(1), np.abs(a + b).max(1)).max())


def covariances(splats: Splats) -> np.ndarray:
    """[N, 3, 3]: what a rotation and scales mean, free of the signs and orders that do not matter."""
    w, x, y, z = (splats.quats / np.linalg.norm(splats.quats.astype(np.float64), axis=1, keepdims=True)).T
    rotation = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    spread = rotation * splats.scales.astype(np.float64)[:, None]
    return spread @ spread.transpose(0, 2, 1)
