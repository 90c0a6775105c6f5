"""An asset that can be edited: its Gaussians, and what is worked out about them once and kept for the edits to come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from splatpainter.array_types import Floats, Ids
from splatpainter.receipts import Receipt
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.models.encode import Encoded
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState
    from splatpainter.surface.estimate import Surface
    from splatpainter.voxels.grid import VoxelGrid


@dataclass(frozen=True)
class Asset:
    """An asset that can be edited: its Gaussians, and what a painter keeps beside them. Immutable; edits return new
    ones, and to undo one is to go on from the old."""

    splats: Splats
    receipt: Receipt | None = None
    """Receipt of the edit that made this asset; None for an unedited one."""
    confidence: Floats | None = field(default=None, repr=False)
    """[N] float32 0..1 after a global edit: seen (1) or predicted (towards 0); after one of mode spread: how sure it is
    that a Gaussian is of the painted material."""
    encoding: EncodedAsset | None = field(default=None, repr=False)
    """Encoding for a model's edits; None where none has needed it yet."""
    original: Splats | None = field(default=None, repr=False)
    """The first Gaussians of `splats` as they were before all edits, on whose surface sheets are laid; None: `splats`,
    which has not been edited yet."""
    unlit: Floats | None = field(default=None, repr=False, compare=False)
    """[N, 1, 3] SH of its base colours before lights were put on it (lights/unlit.py); None: there were none."""
    make_grid: Callable[[Splats], VoxelGrid] | None = field(default=None, repr=False, compare=False)
    """Where voxels of Gaussians come from; None: they are made (`voxelize`)."""

    @cached_property
    def grid(self) -> VoxelGrid:
        """The 128^3 voxels of the Gaussians, made on first use."""
        from splatpainter.voxels.grid import voxelize

        return voxelize(self.splats) if self.make_grid is None else self.make_grid(self.splats)

    @property
    def originals(self) -> int:
        """How many of the first Gaussians are the original's, counted before all edits: what came after is paint."""
        return len(self.splats if self.original is None else self.original)

    @cached_property
    def surface(self) -> Surface:
        """Surface of the original; made on first use, and handed on by edits."""
        from splatpainter.surface.estimate import Surface

        return Surface.of(self.splats if self.original is None else self.original)

    @cached_property
    def normals(self) -> Floats:
        """[N, 3] float32 outward unit normals, made on first use; zeros for Gaussians that cannot be drawn."""
        from splatpainter.lift.depth_normals import outward_normals

        return outward_normals(self.splats)

    @cached_property
    def transfer(self) -> Floats:
        """[N, 10] float32 the light that reaches the rows (`lighting.prt_transfer`), made on first use."""
        from splatpainter.lighting import prt_transfer

        return prt_transfer(self.splats.means, self.normals)

    def child(self, splats: Splats, parents: Ids) -> Asset:
        """This asset with other Gaussians. parents: [len(splats)] int64 the Gaussian of this one that each is or was
        split from."""
        # Latents stay those of the encoded Gaussians: each new one reads that of its parent.
        encoding = self.encoding
        encoding = None if encoding is None else replace(encoding, parent_ids=encoding.parent_ids[parents])
        original = self.splats if self.original is None else self.original
        result = replace(self, splats=splats, encoding=encoding, original=original)
        return result.with_surface_of(self)

    def with_surface_of(self, other: Asset) -> Asset:
        """This asset; it has the other's surface (of the same original) where that is known already."""
        if "surface" in vars(other):
            vars(self)["surface"] = other.surface
        return self


@dataclass(frozen=True)
class EncodedAsset:
    """An asset encoded for a model, and what the edits since have taught that model."""

    model: SplatPainterModel
    """Another one encodes the asset anew."""
    encoded: Encoded
    """Encoding of the asset as it was before all edits."""
    parent_ids: Ids
    """[N] int64 the encoded Gaussian whose latent each of the asset's reads: itself, or the one it was split from."""
    state: RefineState | None = None
    """Fast weights, which the next edit starts from; None before the first."""
