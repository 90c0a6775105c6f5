"""Other projects' readers and writers of splat files that are Python packages: gsply, and GaussForge with Niantic's own
SPZ library. Their values are turned into ours here and nowhere else. A test that wants one is skipped where it is not
installed (`make install` does: pip install --no-deps gsply gaussforge)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatpainter.splats import Splats
from tests.support.io_assets import float_columns


def _activated(
    means: np.ndarray, quats: np.ndarray, logs: np.ndarray, logits: np.ndarray, base: np.ndarray, rest: np.ndarray
) -> Splats:
    """quats: w x y z; rest: [N, K - 1, 3]."""
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits.astype(np.float64)))
    sh = np.concatenate([base[:, None], rest], 1)
    columns = (means, quats, np.exp(logs.astype(np.float64)), opacities.reshape(-1), sh)
    means, quats, scales, opacities, sh = (np.ascontiguousarray(column, np.float32) for column in columns)
    return Splats(means, quats, scales, opacities, sh)


def _raw(splats: Splats) -> tuple[np.ndarray, ...]:
    """means, unit quats w x y z, log-scales, logits, base, rest: float32."""
    quats = splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True)
    opacities = splats.opacities.astype(np.float64)
    logits = np.log(opacities / (1 - opacities))
    arrays = (splats.means, quats, np.log(splats.scales), logits, splats.sh[:, 0], splats.sh[:, 1:])
    return tuple(np.ascontiguousarray(array, np.float32) for array in arrays)


def gsply_spz(path: Path) -> Splats:
    """What gsply reads of an SPZ file."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    data = gsply.read_spz(str(path))
    rest = np.zeros((len(data.means), 0, 3)) if data.shN is None else data.shN
    return _activated(data.means, data.quats, data.scales, data.opacities, data.sh0, rest)


def gsply_write_spz(path: Path, splats: Splats, version: int) -> None:
    """The SPZ file that gsply makes of these Gaussians."""
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    means, quats, logs, logits, base, rest = _raw(splats)
    data = gsply.GSData(
        means=means, scales=logs, quats=quats, opacities=logits, sh0=base, shN=rest if rest.shape[1] else None
    )
    gsply.write_spz(str(path), data, version=version)


def gaussforge_read(path: Path, key: str) -> Splats:
    """What GaussForge reads of a file of its format `key` (ply, compressed.ply, splat, ksplat, spz, sog), by way of the
    PLY that it makes of it: its `read` fails where there is no SH (0.6.0, std::bad_cast)."""
    target = path.with_name(f"{path.name}.gaussforge.ply")
    gaussforge_convert(path, key, target, "ply")
    table = float_columns(target)
    count, more = len(table["x"]), sum(name.startswith("f_rest_") for name in table)

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], 1) if names else np.zeros((count, 0), np.float32)

    rest = columns(*(f"f_rest_{k}" for k in range(more))).reshape(count, 3, more // 3).transpose(0, 2, 1)
    quats, logs = columns(*(f"rot_{k}" for k in range(4))), columns(*(f"scale_{k}" for k in range(3)))
    base = columns(*(f"f_dc_{k}" for k in range(3)))
    return _activated(columns("x", "y", "z"), quats, logs, table["opacity"], base, rest)


def gaussforge_convert(source: Path, key: str, target: Path, target_key: str, spz_version: int = 3) -> None:
    """The file that GaussForge makes of another."""
    data = _gaussforge("convert", source.read_bytes(), key, target_key, spz_version=spz_version)
    target.write_bytes(data)


def _gaussforge(method: str, *arguments: Any, **options: Any) -> Any:
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed")
    with _quiet():
        answer = getattr(gaussforge.GaussForge(), method)(*arguments, **options)
    assert not answer.get("error"), f"GaussForge {method}: {answer['error']}"
    return answer["data"]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what its C++ writes to stderr."""
    before = os.dup(2)
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(nothing)
        os.close(before)
