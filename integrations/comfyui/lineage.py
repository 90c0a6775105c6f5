"""What a SPLAT made by these nodes carries along besides its tensors: the file that it came from, and its edits.

With it, later edits lay their paint on the surface of the first asset, and what is saved is proved against the file,
as by `splatpainter edit`. A SPLAT from other nodes has none, and one whose tensors another node changed has lost it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatpainter.painter import Asset
from splatpainter.receipts import Receipt
from splatpainter.splats import ATTRIBUTES, Splats

from .values import splat_of, splats_of

ATTRIBUTE = "splatpainter_lineage"
"""Attribute of the SPLAT's object that holds its lineage."""


@dataclass(frozen=True)
class Lineage:
    """Where a SPLAT comes from."""

    file: Splats
    """The asset as it was read."""
    asset: Asset
    """As it is now."""
    receipts: tuple[Receipt, ...] = ()
    """One per edit, oldest first."""

    def edited(self, result: Asset) -> Lineage:
        """The lineage with one more edit; result: of `Painter.apply`."""
        assert result.receipt is not None
        return Lineage(self.file, result, (*self.receipts, result.receipt))

    @property
    def receipt(self) -> Receipt:
        """Receipt of all edits together."""
        if len(self.receipts) == 1:
            return self.receipts[0]
        from splatpainter.source_edits.edit import joined_receipt

        return joined_receipt(self.file, self.asset.splats, self.receipts)


def asset_of(splat: Any) -> tuple[Asset, Lineage | None]:
    """The asset of a SPLAT, and where it comes from if that is known. Raises ValueError for a batch of several."""
    splats, lineage = splats_of(splat), getattr(splat, ATTRIBUTE, None)
    if isinstance(lineage, Lineage) and _same(splats, lineage.asset.splats):
        return lineage.asset, lineage
    return Asset(splats), None


def with_lineage(splats: Splats, lineage: Lineage | None, kind: Any, device: Any = "cpu") -> Any:
    """A SPLAT of a class, which carries its lineage where the class takes attributes."""
    splat = splat_of(splats, kind, device)
    if lineage is not None:
        with contextlib.suppress(AttributeError, TypeError):
            setattr(splat, ATTRIBUTE, replace(lineage))
    return splat


def _same(one: Splats, other: Splats) -> bool:
    return len(one) == len(other) and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in ATTRIBUTES
    )
