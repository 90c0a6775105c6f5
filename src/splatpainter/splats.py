"""`Splats`, the one currency of the package: io/ makes it, rendering/ and lift/ read it, models/ return it.

Knows no files, no cameras and no network. All values are *activated* (what the formulas use), never raw
(log-scales, logit-opacities): raw and activated are converted exactly once, in io/ and models/decode.py.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Literal, cast

import numpy as np

from splatpainter.array_types import ArrayT, Bools, Floats, Ids
from splatpainter.order_statistics import median
from splatpainter.system.old_names import formerly_called
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    import torch

    from splatpainter.kernels.row_checks import RowChecks

ColorSpace = Literal["srgb", "linear"]
Axes = Literal["auto", "rub", "rdf"]
"""Axes of a file's numbers: right-up-back, right-down-front (as INRIA's PLY files and everything in memory), or auto:
what the file says, else what its format has by default."""
SH_COUNTS = {1: 0, 4: 1, 9: 2, 16: 3, 25: 4}
"""Number of SH coefficients -> degree."""
MAX_MAGNITUDE = 1e15
"""Gaussians whose means, scales, quaternions or SH coefficients go beyond this are not drawn: their squares, summed
over a hundred million Gaussians or pixels, would not fit into float32."""
MIN_QUAT = 1e-15
"""A quaternion whose largest component is below this counts as zero: its squares vanish in float32."""
SH_C0 = 0.28209479177387814
"""Y_00, the constant spherical harmonic: base colour = 0.5 + SH_C0 * sh[:, 0]."""


@dataclass(frozen=True)
class Splats(Generic[ArrayT]):
    """N Gaussians. Immutable: edits return new objects that share the arrays they did not change.

    All attributes are of one kind, dtype (float32 or float64) and device: `Splats` are numpy's, `Splats[torch.Tensor]`
    torch's; what takes either says `Splats[Any]`."""

    means: ArrayT
    """[N, 3] centres, world units, relative to `offset`, each coordinate within MAX_MAGNITUDE."""
    quats: ArrayT
    """[N, 4] rotations w, x, y, z; any non-zero norm, normalised where used. Largest component MIN_QUAT to
    MAX_MAGNITUDE."""
    scales: ArrayT
    """[N, 3] standard deviations along the rotated axes, world units, above 0 to MAX_MAGNITUDE (linear, not log)."""
    opacities: ArrayT
    """[N] peak alpha, 0..1 (not logit)."""
    sh: ArrayT
    """[N, K, 3] spherical harmonics, K = (degree + 1)^2, 1 to 25; colour(d) = max(0.5 + sum_k Y_k(d) sh_k, 0).
    Magnitudes of one Gaussian sum to at most MAX_MAGNITUDE."""
    antialiased: bool = False
    """True: trained with Mip-Splatting's 2D filter; the renderer compensates opacity for the 0.3 px blur."""
    color_space: ColorSpace = "srgb"
    """What colours mean: "srgb" display values (the 3DGS habit) or "linear"."""
    source: Source | None = field(default=None, repr=False, compare=False)
    """The file they were read from, so that untouched Gaussians are written back byte for byte."""
    origin: Ids | None = field(default=None, repr=False, compare=False)
    """[N] int64 row of the source whose bytes each carries (a child its parent's), -1: none; None without source."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World coordinates (float64) of the point that `means` are relative to. Not zero where float32 cannot hold world
    coordinates, as of georeferenced assets: world positions are `means` + `offset` (`world_means`)."""

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        return SH_COUNTS[int(self.sh.shape[1])]

    def take(self, ids: Any) -> Splats[ArrayT]:
        """The given Gaussians, in the given order. ids: [M] int indices or [N] bool mask."""
        origin = None if self.origin is None else self.origin[np.asarray(ids)]
        if isinstance(self.means, np.ndarray):
            rows = _row_numbers(ids)
            # numpy copies whole rows so, and single values where arrays are indexed: three times slower.
            return replace(self, **{k: getattr(self, k).take(rows, 0) for k in ATTRIBUTES}, origin=origin)
        return replace(self, **{k: getattr(self, k)[ids] for k in ATTRIBUTES}, origin=origin)

    def geometry(self, ids: Ids | Bools) -> Splats:
        """As `take`, for what asks only where Gaussians are and how large: without colours (sh is [M, 0, 3]) and
        source. Numpy."""
        rows = _row_numbers(ids)
        shapes = {k: getattr(self, k).take(rows, 0) for k in ATTRIBUTES if k != "sh"}
        none = np.zeros((len(shapes["means"]), 0, 3), self.sh.dtype)
        return replace(cast(Splats, self), **shapes, sh=none, source=None, origin=None)

    def append(self, more: Splats[Any]) -> Splats[ArrayT]:
        """These followed by `more` (of the same SH degree); indices of self stay what they are."""
        assert more.sh.shape[1] == self.sh.shape[1], "append: SH degrees differ"
        # A row that came from another file carries no bytes of this one: it is encoded when it is written.
        origin = None
        if self.origin is not None:
            tail = more.origin if more.source is self.source else None
            tail = np.full(len(more), -1, np.int64) if tail is None else tail
            origin = np.concatenate([self.origin, tail])
        if isinstance(self.means, np.ndarray):
            joined = {k: np.concatenate([getattr(self, k), getattr(more, k)]) for k in ATTRIBUTES}
        else:
            import torch

            joined = {k: torch.cat([getattr(self, k), getattr(more, k)]) for k in ATTRIBUTES}
        return replace(self, **joined, origin=origin)

    def numpy(self) -> Splats[Floats]:
        """The same with numpy attributes: float32 from torch, as they are if they are numpy already."""
        if isinstance(self.means, np.ndarray):
            return cast(Splats, self)
        return replace(cast(Splats, self), **{k: getattr(self, k).detach().cpu().float().numpy() for k in ATTRIBUTES})

    def torch(self, device: str = "cpu", dtype: torch.dtype | None = None) -> Splats[torch.Tensor]:
        """The same with torch attributes (default float32); shares memory with numpy where possible."""
        import torch

        dtype = torch.float32 if dtype is None else dtype
        # Shared memory, but for arrays that are locked.
        values = {k: getattr(self, k) for k in ATTRIBUTES}
        for k, array in values.items():
            if isinstance(array, np.ndarray) and not array.flags.writeable:  # a tensor would offer to write to it
                values[k] = array.copy()
        return replace(
            cast("Splats[torch.Tensor]", self),
            **{k: torch.as_tensor(array).to(device, dtype) for k, array in values.items()},
        )

    @property
    def world_means(self) -> Floats:
        """[N, 3] float64 centres in world coordinates."""
        with np.errstate(invalid="ignore"):  # rows may hold signalling NaN
            return self.numpy().means.astype(np.float64) + np.array(self.offset)

    def relative_to(self, offset: tuple[float, float, float]) -> Splats[ArrayT]:
        """The same Gaussians with `means` (numpy) relative to another offset, computed in float64; these themselves
        where it is theirs already. What float32 cannot hold of the new `means` is rounded."""
        # Most assets have no offset, and then nothing is copied.
        if self.offset == offset:
            return self
        with np.errstate(all="ignore"):  # rows may hold NaN
            means = (self.world_means - np.array(offset)).astype(np.float32)
        return replace(self, means=means, offset=offset)

    @cached_property
    def middle(self) -> Floats:
        """[3] float64 the median of the centres of what can be drawn; zeros where nothing can."""
        points = self.numpy().means[self.drawable]
        return median(points).astype(np.float64) if len(points) else np.zeros(3)

    @cached_property
    def extremes(self) -> tuple[Floats, Floats, float]:
        """([3] float64 smallest, [3] float64 largest coordinates of `means`, largest of `scales`), of at least one
        Gaussian, drawable or not; NaN where there is one."""
        arrays = self.numpy()
        # Column by column: along so short an axis numpy's own reduction takes several times longer.
        low, high = (np.array([f(column) for column in arrays.means.T], np.float64) for f in (np.min, np.max))
        return low, high, max(float(column.max()) for column in arrays.scales.T)

    @property
    def drawable(self) -> Bools:
        """[N] bool: Gaussians that can be drawn (every attribute finite and in its range, as said at each above). The
        others are counted by `info` and `render`, keep their bytes, and are drawn by no renderer of this package."""
        return self.row_checks.drawable

    @cached_property
    def row_checks(self) -> RowChecks:
        """Which Gaussians can be drawn, and how many cannot for which reason."""
        # Of an asset as it was read they were looked for when it was read.
        if self.source is not None and self.source.splats is not self and self._is_as_read:
            return self.source.splats.row_checks
        from splatpainter.kernels.row_checks import checked  # readers need it, other users may not

        arrays = self.numpy()
        values = (arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.sh)
        return checked(*values, most=MAX_MAGNITUDE, least_quat=MIN_QUAT)

    @cached_property
    def sha256(self) -> str:
        """Hash of the file while these are exactly the arrays that were read from it, else of the attributes."""
        if self.source is not None and self._is_as_read:
            return self.source.sha256
        return rows_sha256(self)

    @property
    def _is_as_read(self) -> bool:
        """Whether the arrays are those of `source`, which there is, themselves."""
        assert self.source is not None
        return all(getattr(self, k) is getattr(self.source.splats, k) for k in ATTRIBUTES)


ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh")
COMPARED_VALUES = 1 << 16
"""Values that are compared at a time."""
BLOCK_ROWS = 1 << 14
"""Rows that are gathered at a time."""


@dataclass(frozen=True)
class Source:
    """What a file held beyond the attributes, so that the same format can be written back unchanged where unchanged."""

    path: str
    format: str
    """Key of io.FORMATS, e.g. "ply"."""
    splats: Splats = field(repr=False)
    """The rows as first decoded (without source): an attribute of a Gaussian is untouched if it equals this, bit for
    bit."""
    digest: str | Callable[[], str] = field(repr=False)
    """`sha256`, or what computes it: of a large file it takes as long as reading it, and not everybody asks."""
    detail: Any = field(default=None, repr=False)
    """The reader's own record (header bytes, row block, tail, codebooks ...); opaque outside its io module."""
    problems: tuple[str, ...] = ()
    """What the reader found odd, one line each, for `info`."""
    axes: str = "rdf"
    """Axes of the file's numbers, three letters as in io.axes.AXES; in memory it is always "rdf"."""
    axes_from: Literal["file", "format", "choice"] = "format"
    """Who says so: the file itself, its format by default, or whoever opened it."""
    flips: tuple[int, int, int] = (1, 1, 1)
    """Axes reversed (-1) since the reader of the format had its say, because axes were chosen."""

    @cached_property
    def sha256(self) -> str:
        """Hex SHA-256 of the file (of a folder: of its files' names and bytes, in name order)."""
        return self.digest if isinstance(self.digest, str) else self.digest()

    frame = formerly_called("axes")
    frame_from = formerly_called("axes_from")


def rows_sha256(splats: Splats[Any], ids: Ids | None = None) -> str:
    """SHA-256 over the float32 little-endian attributes of the given Gaussians (default: all), one after the other."""
    arrays = splats.numpy()
    # Of the arrays as they lie, so that the hash of an asset does not depend on its file format.
    if ids is not None:
        ids = _row_numbers(ids)
    digest = hashlib.sha256()
    for name in ATTRIBUTES:
        values = getattr(arrays, name)
        for part in [values] if ids is None else (values.take(rows, 0) for rows in row_blocks(ids)):
            digest.update(np.ascontiguousarray(part, dtype="<f4").data)
    if any(splats.offset):
        digest.update(np.array(splats.offset, "<f8").tobytes())
    return digest.hexdigest()


def _row_numbers(ids: Any) -> Ids:
    """[M] int64 of row numbers or a [N] bool mask; `take` of a mask would take rows 0 and 1."""
    ids = np.asarray(ids)
    return np.flatnonzero(ids) if ids.dtype == bool else ids.astype(np.int64, copy=False)


def row_blocks(ids: Ids) -> list[Ids]:
    """Row indices in parts of BLOCK_ROWS, whose values are gathered without a second copy of a large asset."""
    return [ids[first : first + BLOCK_ROWS] for first in range(0, len(ids), BLOCK_ROWS)]


def changed_rows(before: Splats, after: Splats, among: Ids | None = None) -> Ids:
    """[T] int64 ascending: rows that both have and of which any bit differs (NaN equals itself). among: [C] int64
    ascending, rows that both have, where no other can differ."""
    n = min(len(before), len(after))
    # An edit knows which rows it may have changed; the others need no look, and a row that differs in one attribute
    # needs none at the next.
    if among is not None and before.sh.shape[1:] == after.sh.shape[1:]:
        changed = np.zeros(len(among), bool)
        for name in ("opacities", *(name for name in ATTRIBUTES if name != "opacities")):  # the cheapest first
            old, new, at = getattr(before, name), getattr(after, name), np.flatnonzero(~changed)
            if old is not new:
                differs = float_bits(old[among[at]]) != float_bits(new[among[at]])
                changed[at] = differs.any(tuple(range(1, differs.ndim)))
        return among[changed]
    changed = np.zeros(n, bool)
    for name in ATTRIBUTES:
        old, new = getattr(before, name), getattr(after, name)
        if old is new or n == 0:
            continue
        if old.shape[1:] != new.shape[1:]:
            return np.arange(n)
        if n >= BLOCK_ROWS and old.dtype == new.dtype == np.float32:
            from splatpainter.kernels.row_bits import differing  # small assets need no kernels

            changed |= differing(old, new)
            continue
        old, new, width = float_bits(old[:n]).ravel(), float_bits(new[:n]).ravel(), old[:n].size // n
        for start in range(0, len(old), COMPARED_VALUES):  # which fit the processor's cache
            differs = old[start : start + COMPARED_VALUES] != new[start : start + COMPARED_VALUES]
            if differs.any():
                changed[(start + np.flatnonzero(differs)) // width] = True
    return np.flatnonzero(changed)


def float_bits(values: Floats) -> np.ndarray:
    """The bits of float32 values, as uint32: -0 and 0 differ, equal NaN do not."""
    return np.ascontiguousarray(values, np.float32).view(np.uint32)
