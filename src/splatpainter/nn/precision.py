"""Arithmetic of the networks: float32 throughout, or bf16 in their matrix products (torch.autocast).

Who decides, first to last: the caller, the environment variable, the machine. What has to be exact whatever was chosen
(Gaussians in order of opacity, positions, values of files, learning rates) is computed under `exact`. Costs no torch
until a context is entered.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Literal, cast, get_args

if TYPE_CHECKING:
    import torch

Precision = Literal["auto", "float32", "bfloat16"]
Arithmetic = Literal["float32", "bfloat16"]
VARIABLE = "SPLATPAINTER_PRECISION"
"""Environment variable: a Precision, for callers that say "auto"."""


def setting(precision: str = "auto") -> Precision:
    """What the caller says, or the environment where that is "auto". Raises ValueError, in one line, for another word
    in either."""
    # The error names where the word came from: a caller did not write what the environment says.
    where, value = "precision", precision
    if precision == "auto":
        where, value = VARIABLE, os.environ.get(VARIABLE) or "auto"
    if value not in get_args(Precision):
        raise ValueError(f"{where}: expected auto, float32 or bfloat16, got {value!r}")
    return cast(Precision, value)


def resolve(precision: str = "auto", device: torch.device | str = "cpu") -> Arithmetic:
    """The arithmetic on a device: of "auto" bf16 where the machine multiplies it faster than float32 (CUDA; CPUs with
    AVX512-BF16 or AMX: twice the speed, measured), else float32. Raises ValueError as `setting`."""
    decided = setting(precision)
    if decided != "auto":
        return decided
    return "bfloat16" if _multiplies_bf16(device) else "float32"


def autocast(device: torch.device | str = "cpu", precision: str = "auto") -> torch.autocast:
    """A context in which matrix products use `resolve(precision, device)`; float32 also inside another autocast. Raises
    ValueError as `setting`."""
    import torch

    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16, enabled=resolve(precision, device) == "bfloat16")


def exact(device: torch.device | str) -> torch.autocast:
    """A context without autocast: operations keep the type of their arguments, which the caller makes float32."""
    import torch

    return torch.autocast(torch.device(device).type, enabled=False)


def _multiplies_bf16(device: torch.device | str) -> bool:
    import torch

    kind = torch.device(device).type
    if kind == "cpu":
        return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return kind == "cuda" and torch.cuda.is_bf16_supported()
