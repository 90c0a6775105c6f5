"""What a file does not hold of the Gaussians that were written into it: measured on what was read again, row by row.

Behind `convert`, exports and edits (of what they wrote) and `info` (of samples that it writes). A Gaussian's size is
its largest standard deviation; shares are of the Gaussians that can be drawn and are not hidden.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import FORMATS, files, read, write
from splatpainter.io.formats.packing import morton_order
from splatpainter.io.formats.ply import stored_positions
from splatpainter.io.formats.reuse import drawable_rows
from splatpainter.io.size_estimate import sample
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import each, run
from splatpainter.order_statistics import quantile
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max, row_norm

MIN_DRAWN_OPACITY = 1 / 255
"""Opacity of Gaussians that are drawn; what fainter ones lose cannot be seen."""


@dataclass(frozen=True)
class LossThresholds:
    """What of an asset a format loses, and from when on that is told. Source: steps of the formats, as each entry says;
    else taste."""

    block_rows: int = 1 << 14
    """Rows measured at a time, to bound the float64 intermediates."""
    cut_tolerance: float = 0.05
    """SH coefficients: a value beyond all that came back is cut if it is beyond them by more than this, which is more
    than a step of any format's quantisation, and 4/255 of a base colour."""
    min_anisotropy: float = 1.2
    """Largest by smallest standard deviation from which a turned Gaussian looks otherwise."""
    thin_share: float = 0.02
    """Part of the largest standard deviation below which an axis counts as flat, however flat."""
    sample_rows: int = 4096
    """Rows of the samples that are written in other formats."""
    better_factor: int = 4
    """Factor by which the worst loss of another format has to be less severe to be named."""


LOSSES = LossThresholds()


ERRORS = ("move", "color", "sh", "opacity", "scale", "rotation")
"""What the kernel measures of each row, in its order."""
TRIED_FORMATS = ("sog", "spz", "glb", "ply")
"""Formats that are tried when a better one is to be named, the smallest files first."""


@dataclass(frozen=True)
class Loss:
    """One kind of loss."""

    what: str
    """positions, colours, cut colours, SH, cut SH, opacities, scales or rotations."""
    text: str
    """For people: with numbers, without a full stop."""
    severity: float
    """1 where it begins to be seen; the worst comes first."""


@dataclass(frozen=True)
class Losses:
    """All that was measured; largest values, and root mean squares over Gaussians."""

    compared: int = 0
    """Gaussians."""
    move_largest: float = 0.0
    """Sizes of the Gaussian."""
    move_usual: float = 0.0
    """The same that 99 of 100 stay below."""
    moved_share: float = 0.0
    """Share that moved by more than one size, 0..1."""
    color_largest: float = 0.0
    """Base colour of a channel, of a display range of 1."""
    color_rms: float = 0.0
    color_cut_share: float = 0.0
    """Share whose base colour was cut to the range that came back."""
    color_range: tuple[float, float] = (0.0, 0.0)
    """Least and largest base colour before the round trip."""
    color_range_after: tuple[float, float] = (0.0, 0.0)
    """Least and largest base colour after it."""
    sh_largest: float = 0.0
    """Root mean square over directions of the error of a channel by SH above degree 0."""
    sh_rms: float = 0.0
    sh_cut_share: float = 0.0
    sh_range: tuple[float, float] = (0.0, 0.0)
    sh_range_after: tuple[float, float] = (0.0, 0.0)
    opacity_largest: float = 0.0
    opacity_rms: float = 0.0
    scale_largest: float = 0.0
    """Factor less 1 by which a standard deviation is off."""
    scale_rms: float = 0.0
    rotation_largest: float = 0.0
    """Degrees."""
    rotation_rms: float = 0.0

    @property
    def worst_first(self) -> tuple[Loss, ...]:
        """Everything that is more than the rounding of float32."""
        kinds = [
            Loss("positions", self._move_text(), max(self.moved_share / 0.001, self.move_usual / 0.5)),
            Loss("cut colours", self._cut_text("colours", "color"), self.color_cut_share / 0.001),
            Loss("cut SH", self._cut_text("SH", "sh"), self.sh_cut_share / 0.001),
            Loss("colours", _levels("colours", self.color_largest, self.color_rms), 255 * self.color_rms / 1.5),
            Loss("SH", _levels("view-dependent colour", self.sh_largest, self.sh_rms), 255 * self.sh_rms / 2),
            Loss("opacities", _levels("opacities", self.opacity_largest, self.opacity_rms), 255 * self.opacity_rms / 2),
            Loss("scales", f"scales are off by up to {100 * self.scale_largest:.2g} %", self.scale_rms / 0.1),
            Loss("rotations", f"rotations by up to {self.rotation_largest:.2g} degrees", self.rotation_rms / 3),
        ]
        present = {
            "positions": self.move_largest > 0.005,
            "cut colours": self.color_cut_share > 0,
            "cut SH": self.sh_cut_share > 0,
            "colours": 255 * self.color_largest > 0.05,
            "SH": 255 * self.sh_largest > 0.05,
            "opacities": 255 * self.opacity_largest > 0.05,
            "scales": self.scale_largest > 0.001,
            "rotations": self.rotation_largest > 0.02,
        }
        return tuple(sorted((one for one in kinds if present[one.what]), key=lambda one: -one.severity))

    @property
    def severity(self) -> float:
        """Of the worst; 0 where nothing is lost."""
        return max((one.severity for one in self.worst_first), default=0.0)

    @property
    def line(self) -> str:
        """All losses in one line, the worst first; "" where there are none."""
        return ", ".join(one.text for one in self.worst_first)

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def _move_text(self) -> str:
        beyond = f" ({_share(self.moved_share)} of them by more than one)" if self.moved_share else ""
        return f"positions move by up to {self.move_largest:.2g} sizes of a Gaussian{beyond}"

    def _cut_text(self, what: str, name: str) -> str:
        before, after = getattr(self, f"{name}_range"), getattr(self, f"{name}_range_after")
        share = _share(getattr(self, f"{name}_cut_share"))
        reach = f"from {before[0]:.2f}..{before[1]:.2f} to {after[0]:.2f}..{after[1]:.2f}"
        return f"{what} of {share} of the Gaussians are cut ({reach})"


def _levels(what: str, largest: float, rms: float) -> str:
    return f"{what} off by up to {255 * largest:.2g}/255 (rms {255 * rms:.2g})"


def _share(share: float) -> str:
    percent = 100 * share
    return f"{percent:.0f} %" if percent >= 9.95 else f"{percent:.2g} %"


def measure(before: Splats, after: Splats) -> Losses:
    """What the rows of `after`, as read from a file, lack of those of `before`, which were written; row i is row i of
    both, as far as both go. A lower SH degree counts as coefficients that became 0."""
    old, new = before.numpy(), after.numpy()
    count = min(len(old), len(new))
    counted = (old.drawable[:count] & new.drawable[:count]) & (old.opacities[:count] >= MIN_DRAWN_OPACITY)
    total = int(counted.sum())
    if not total or old is new:  # read and written alike
        return Losses(compared=total)
    errors = _errors(old, new, counted)
    moves = errors.moves
    # A PLY has the stored numbers again; few other files were made from finer positions than memory has.
    if new.source is not None and new.source.format != "ply" and (finer := _moves_from_file(old, new)).any():
        moves = np.maximum(moves, finer)
    moves = moves if total == count else moves[counted]
    if not errors.differs.any():
        return Losses(compared=total, **_moved(moves))
    base, rest = errors.base, errors.rest
    with np.errstate(all="ignore"):
        base_cut, rest_cut = (_cut_rows(old, errors.differs, part, span) for part, span in ((0, base), (1, rest)))
    largest = errors.largest
    rms = {name: math.sqrt(squares / total) for name, squares in errors.squares.items()}
    return Losses(
        compared=total,
        **_moved(moves),
        color_largest=largest["color"],
        color_rms=rms["color"],
        color_cut_share=base_cut / total,
        color_range=_colors(base.before),
        color_range_after=_colors(base.after),
        sh_largest=largest["sh"],
        sh_rms=rms["sh"],
        sh_cut_share=rest_cut / total,
        sh_range=rest.before,
        sh_range_after=rest.after,
        opacity_largest=largest["opacity"],
        opacity_rms=rms["opacity"],
        scale_largest=math.expm1(min(largest["scale"], 700.0)),
        scale_rms=rms["scale"],
        rotation_largest=largest["rotation"],
        rotation_rms=rms["rotation"],
    )


def _moved(moves: np.ndarray) -> dict[str, Any]:
    return {
        "move_largest": float(moves.max()),
        "move_usual": float(quantile(moves, 0.99)),
        "moved_share": float((moves > 1).mean()),
    }


def _moves_from_file(old: Splats, new: Splats) -> np.ndarray:
    """[count] float64 how far the rows of `new` are, in sizes, from where the file of `old` has them, where that holds
    finer positions than float32 does beside an offset; else 0."""
    count, source = min(len(old), len(new)), old.source
    moves = np.zeros(count)
    if source is None or source.format != "ply" or old.origin is None:
        return moves
    stored = stored_positions(source.detail)
    if stored is None:
        return moves
    origin = np.asarray(old.origin[:count])
    with np.errstate(all="ignore"):
        means, read_means = np.asarray(old.means[:count]), source.splats.numpy().means
        # Rows that an edit moved have their place in memory alone.
        rows = np.flatnonzero((origin >= 0) & (means == read_means[origin]).all(1))
        apart = np.asarray(new.means)[rows].astype(np.float64) + np.array(new.offset) - stored[origin[rows]]
        sizes = np.sqrt((apart * apart).sum(1)) / row_max(np.asarray(old.scales)[rows])
    moves[rows] = np.where(np.isfinite(sizes), sizes, 0)
    return moves


@dataclass(frozen=True)
class _Errors:
    """What is off of N Gaussians."""

    differs: np.ndarray
    """[N] bool: those that are counted and not as they were."""
    moves: np.ndarray
    """[N] float64 sizes of the Gaussian."""
    largest: dict[str, float]
    """What is off -> the largest error."""
    squares: dict[str, float]
    """The sum of their squares."""
    base: _Range
    """Of base colours' coefficients."""
    rest: _Range
    """Of those beyond them."""


def _errors(old: Splats, new: Splats, counted: np.ndarray) -> _Errors:
    """Of the `counted` rows ([N] bool)."""
    count, kinds = len(counted), range(len(ERRORS))
    # Rows relative to other offsets, or of another SH degree, cannot be as they were.
    comparable = old.offset == new.offset and old.sh.shape[1] == new.sh.shape[1]
    pairs: list[np.ndarray] = []
    for name in ATTRIBUTES:
        for splats in (old, new):
            values = getattr(splats, name)[:count]
            pairs.append(readonly(values.reshape(count, -1) if name == "sh" else values, np.float32))
    shift = readonly(np.array([*old.offset, *new.offset], np.float64), np.float64)
    counted = readonly(counted, bool)
    differs, moves = np.empty(count, bool), np.zeros(count)

    def look(start: int) -> tuple[list[float], list[float], np.ndarray]:
        block = slice(start, min(start + LOSSES.block_rows, count))
        errors, span = np.empty((len(ERRORS), block.stop - start)), np.full((1, 8), np.inf, np.float32)
        span[:, 1::2] = -np.inf
        run(
            kernels.row_losses, counted[block], comparable, shift, LOSSES.thin_share, LOSSES.min_anisotropy,
            *(values[block] for values in pairs), errors, differs[block], span,
        )  # fmt: skip
        rows = np.flatnonzero(differs[block])
        if not len(rows):
            return [0.0 for _ in kinds], [0.0 for _ in kinds], span
        values = errors[:, rows] if len(rows) < errors.shape[1] else errors
        moves[start + rows] = values[0]
        with np.errstate(all="ignore"):
            for k in kinds:
                _finish(ERRORS[k], values[k])
            return [float(row.max()) for row in values], [float((row * row).sum()) for row in values], span

    # Blocks stay in the cache, and of a million rows every pass over new memory counts.
    largest, squares, spans = zip(*each(look, range(0, count, LOSSES.block_rows)), strict=True)
    span = np.concatenate(spans)
    return _Errors(
        differs,
        moves,
        {ERRORS[k]: max(block[k] for block in largest) for k in kinds},
        {ERRORS[k]: sum(block[k] for block in squares) for k in kinds},
        _Range.of(span[:, [0, 1, 4, 5]]),
        _Range.of(span[:, [2, 3, 6, 7]]),
    )


def _finish(name: str, values: np.ndarray) -> None:
    """Errors of one kind, as the kernel has them, in the units of `Losses` (of scales the logarithm), in place."""
    if name == "color":
        values *= SH_C0
    elif name == "sh":
        # The mean over the sphere of a squared basis function is 1 / (4 pi), of a product of two of them 0.
        np.sqrt(np.divide(values, 4 * np.pi, out=values), out=values)
    elif name == "scale":
        np.log(values, out=values)
    elif name == "rotation":
        # Of the chord, as the arc cosine of a number near 1 has no digits left.
        np.minimum(np.divide(np.sqrt(values, out=values), 2, out=values), 1, out=values)
        np.degrees(np.multiply(4, np.arcsin(values, out=values), out=values), out=values)


@dataclass
class _Range:
    """Least and largest coefficients, before and after."""

    before: tuple[float, float] = (0.0, 0.0)
    after: tuple[float, float] = (0.0, 0.0)
    started: bool = False

    @staticmethod
    def of(spans: np.ndarray) -> _Range:
        """Of [blocks, 4] least and largest before, least and largest after."""
        low0, high0, low1, high1 = spans[:, 0].min(), spans[:, 1].max(), spans[:, 2].min(), spans[:, 3].max()
        if not (low0 <= high0 and low1 <= high1):  # no coefficients
            return _Range()
        return _Range((float(low0), float(high0)), (float(low1), float(high1)), True)


def _cut_rows(old: Splats, differs: np.ndarray, part: int, span: _Range) -> int:
    """How many of the rows that differ have a coefficient beyond all that came back. part: 0 the base, 1 others."""
    low, high = span.after[0] - LOSSES.cut_tolerance, span.after[1] + LOSSES.cut_tolerance
    if not span.started or (span.before[0] >= low and span.before[1] <= high):
        return 0
    cut, rows = 0, np.flatnonzero(differs)
    for start in range(0, len(rows), LOSSES.block_rows):
        block = old.sh[rows[start : start + LOSSES.block_rows]]
        sh = block[:, 1:] if part else block[:, :1]
        cut += int(((sh < low) | (sh > high)).any((1, 2)).sum())
    return cut


def _colors(span: tuple[float, float]) -> tuple[float, float]:
    return 0.5 + SH_C0 * span[0], 0.5 + SH_C0 * span[1]


# ---- formats that were not written


def measured_as(splats: Splats, key: str) -> tuple[Losses, int]:
    """(the losses of these Gaussians in a new file of the format `key`, its bytes), by writing one. Raises ValueError:
    it cannot hold them."""
    rows = replace(splats, source=None, origin=None)
    with tempfile.TemporaryDirectory(prefix="splatpainter-verify-") as folder, files.passing():
        path = Path(folder) / f"asset{FORMATS[key].suffixes[0]}"
        write(path, rows)
        return measure(rows, read(path, offset=rows.offset)), path.stat().st_size


def moved_share_sorted(splats: Splats) -> float:
    """`Losses.moved_share` of these Gaussians in a new compressed PLY, put into Morton order: of their positions alone,
    whose words no other attribute has a part in."""
    from splatpainter.io.formats.compressed_ply import rounded_means  # of that format alone

    rows = replace(splats.numpy().relative_to((0.0, 0.0, 0.0)), source=None, origin=None)
    order = morton_order(splats.numpy().means)
    counted, sizes = rows.drawable & (rows.opacities >= MIN_DRAWN_OPACITY), row_max(rows.scales)
    rounded, total = rounded_means(drawable_rows(rows).means[order]), int(counted.sum())
    means, offset = splats.numpy().means, np.array(splats.offset)

    def beyond(start: int) -> int:
        block = order[start : start + LOSSES.block_rows]
        # Against world positions in float64: what float32 makes of those moves them, too.
        world = means[block].astype(np.float64) + offset
        with np.errstate(all="ignore"):  # of rows that are not counted
            apart = rounded[start : start + LOSSES.block_rows].astype(np.float64) - world
            return int(((row_norm(apart) > sizes[block]) & counted[block]).sum())

    return sum(each(beyond, range(0, len(order), LOSSES.block_rows))) / total if total else 0.0


def spread_sample(splats: Splats, count: int = LOSSES.sample_rows) -> Splats:
    """About `count` Gaussians from all over the rows, those at the ends of each axis among them, in their order and
    without their file: they span what all of them span."""
    arrays = replace(splats.numpy(), source=None, origin=None)
    rows = np.flatnonzero(splats.drawable & (arrays.opacities >= MIN_DRAWN_OPACITY))
    if len(rows) <= count:
        return arrays.take(rows)
    # Axis by axis: numpy's own way along the longer axis takes several times longer.
    axes = [axis if len(rows) == len(arrays) else axis.take(rows) for axis in arrays.means.T]
    ends = np.array([*(axis.argmin() for axis in axes), *(axis.argmax() for axis in axes)])
    taken = np.zeros(len(rows), bool)
    taken[np.linspace(0, len(rows) - 1, count).astype(np.int64)] = taken[ends] = True
    return arrays.take(rows[taken])


def better_format(splats: Splats, key: str, losses: Losses) -> str:
    """Name ending of the smallest format that holds well what the format `key` does not: of samples of the Gaussians,
    the worst loss is invisible and LOSSES.better_factor less; "" where nothing visible is lost, or none is better."""
    worst = losses.severity
    if worst < 1:
        return ""
    few = spread_sample(splats)
    if not len(few):
        return ""
    # What reading has rounded already, only the file's own format still has.
    rounded = Losses(**_moved(_moves_from_file(splats, splats))).severity
    for other in (other for other in TRIED_FORMATS if other != key):
        try:
            severity = max(measured_as(few, other)[0].severity, 0 if other == "ply" else rounded)
        except ValueError:  # it cannot hold them at all
            continue
        if severity < 1 and severity * LOSSES.better_factor <= worst:
            return FORMATS[other].suffixes[0]
    return ""


def loss_line(splats: Splats, key: str, losses: Losses) -> str:
    """`losses.line` of a file of the format `key`, and which format would be better, where one is."""
    better = better_format(splats, key, losses)
    return losses.line + (f" ({better} would hold them)" if better else "")


def loss_of_edits(splats: Splats) -> Losses:
    """How an edit of these Gaussians would be rounded by the format that they were read from: a sample of them, moved
    by a tenth of their size and recoloured by 3/255 at random, is written anew. Of compressed PLY rows that stand
    together, as its chunks share their precision."""
    assert splats.source is not None
    key, rng = splats.source.format, np.random.default_rng(0)
    few = sample(splats, LOSSES.sample_rows) if key == "compressed.ply" else spread_sample(splats)
    if not len(few):
        return Losses()

    def noise(values: np.ndarray) -> np.ndarray:
        return rng.uniform(-1, 1, values.shape).astype(np.float32)

    with np.errstate(all="ignore"):  # of values at the edge of float32
        moved = replace(
            few,
            means=few.means + 0.1 * few.scales.max(1, keepdims=True) * noise(few.means),
            scales=few.scales * (1 + 0.05 * noise(few.scales)),
            opacities=np.clip(few.opacities + 0.01 * noise(few.opacities), 0, 1),
            sh=few.sh + 0.02 * noise(few.sh),
        )
    try:
        return measured_as(moved, key)[0]
    except ValueError:  # it does not hold more than it has
        return Losses()
