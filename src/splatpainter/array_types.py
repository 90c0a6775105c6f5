"""Kinds of arrays by what they hold, for annotations. Imports neither torch nor anything of the package."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating[Any]]
"""float32 or float64."""
Bools: TypeAlias = NDArray[np.bool_]
Ids: TypeAlias = NDArray[np.integer[Any]]
"""Indices of Gaussians, or counts: integers of any width."""
Bytes: TypeAlias = NDArray[np.uint8]
"""Pictures of 8 bits, and packed words."""


class AnyArray(Protocol):
    """What numpy.ndarray and torch.Tensor have in common here."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def dtype(self) -> Any: ...
    def __getitem__(self, index: Any, /) -> Any: ...


if TYPE_CHECKING:
    import torch
    from typing_extensions import TypeVar

    ArrayT = TypeVar("ArrayT", bound=AnyArray, default=Floats, covariant=True)
    """What values hold that are made of arrays: Floats where nothing is said, or torch.Tensor."""
    FloatsOrTensor = TypeVar("FloatsOrTensor", Floats, torch.Tensor)
    """What functions take and give back alike: numpy for numpy, torch for torch."""
else:
    from typing import TypeVar

    ArrayT = TypeVar("ArrayT", covariant=True)
    FloatsOrTensor = TypeVar("FloatsOrTensor")
