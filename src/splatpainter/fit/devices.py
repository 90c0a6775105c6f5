"""The few operations of the optimiser that numpy and torch name differently: arrays on the CPU, tensors elsewhere.

Exponentials and logarithms of arrays are the core's, so that a fit gives the same bits on every machine.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run

DeviceArray: TypeAlias = Any
"""numpy.ndarray on the CPU, torch.Tensor elsewhere: the device of a fit, chosen when it starts, says which."""


def on_device(values: Any, device: str) -> DeviceArray:
    """A copy of numpy values where the optimiser works: an array for "cpu", else a tensor."""
    if device == "cpu":
        return np.array(values)
    import torch

    return torch.tensor(values, device=device)


def as_numpy(values: DeviceArray) -> np.ndarray:
    """The values as an array; shares memory on the CPU."""
    return values if isinstance(values, np.ndarray) else values.detach().cpu().numpy()


def copied(values: DeviceArray) -> DeviceArray:
    return values.copy() if isinstance(values, np.ndarray) else values.clone()


def zeros_like(values: DeviceArray, count: int | None = None) -> DeviceArray:
    """Zeros in the shape of [N, ...] values, or with another N."""
    shape = (len(values) if count is None else count, *values.shape[1:])
    return np.zeros(shape, values.dtype) if isinstance(values, np.ndarray) else values.new_zeros(shape)


def joined(parts: list[DeviceArray]) -> DeviceArray:
    """Along the first axis."""
    if isinstance(parts[0], np.ndarray):
        return np.concatenate(parts)
    import torch

    return torch.cat(parts)


def indices(mask: DeviceArray) -> DeviceArray:
    """[M] int64 where a mask [N] is set."""
    if isinstance(mask, np.ndarray):
        return np.flatnonzero(mask)
    import torch

    return torch.nonzero(mask)[:, 0]


def exp(values: DeviceArray) -> DeviceArray:
    return _elementwise("exp", values)


def log(values: DeviceArray) -> DeviceArray:
    """Natural; NaN below 0."""
    return _elementwise("log", values)


def sigmoid(values: DeviceArray) -> DeviceArray:
    """1 / (1 + exp(-x))."""
    return 1 / (1 + exp(-values)) if isinstance(values, np.ndarray) else values.sigmoid()


def _elementwise(name: str, values: DeviceArray) -> DeviceArray:
    if not isinstance(values, np.ndarray):
        return getattr(values, name)()
    # The core's own functions: numpy's differ in the last bit from machine to machine.
    flat = np.ascontiguousarray(values).reshape(-1)
    out = np.empty_like(flat)
    run(getattr(kernels, f"{name}_each"), flat, out)
    return out.reshape(values.shape)
