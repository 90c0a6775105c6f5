"""Sparse differences of assets: the Gaussians that changed and those that came, as values and as bytes, and between the
versions that a viewer has seen.

T changed Gaussians, A appended ones, N Gaussians below, K SH coefficients.
"""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import field, replace
from functools import cached_property

import numpy as np

from splatpainter.io.files import printable
from splatpainter.order_statistics import distinct
from splatpainter.session.replay.recent_changes import changes
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Splats, changed_rows, float_bits
from splatpainter.system.quick_dataclass import dataclass

PART_BYTES = 1 << 20
"""Bytes before compression of one part of a stored delta: what reading or writing one holds in memory at a time."""
MAX_REASON = 300
"""Characters of a reason that may quote what a damaged delta, layer or document holds."""
VERSION = 1
"""Version of the layout that `encode` writes."""
MAX_GAUSSIANS = 1 << 27
"""Most Gaussians of an asset that a delta may speak of."""
UNPACKED_FREE_BYTES = 512 << 20
"""Bytes that any delta may unpack to."""
UNPACKED_RATIO = 100
"""Or that it may unpack to for each packed byte that was read. Ids (8 bytes each) pack 1000 times, and the floats
of real Gaussians 1.1 to 5 times."""
MAX_VERSIONS = 256
"""Versions back from which a sparse answer is possible, at most; older ones get everything."""
MAX_VERSION_GAUSSIANS = 1 << 24
"""Gaussians that all of them may name together: global edits of a large asset are forgotten sooner."""
GEOMETRY = ("means", "quats", "scales")


@dataclass(frozen=True)
class Delta:
    """A change of N Gaussians: values that are written, and Gaussians that are appended."""

    count: int
    """N."""
    gaussian_ids: np.ndarray = field(repr=False)
    """[T] int64 ascending: Gaussians whose values change."""
    values: Splats = field(repr=False)
    """T Gaussians: their new values."""
    appended: Splats = field(repr=False)
    """A Gaussians, which become number N, N + 1 and so on."""
    parent_ids: np.ndarray = field(repr=False)
    """[A] int64 the Gaussian below that each appended one was made from, -1: none."""
    base: np.ndarray | None = field(default=None, repr=False)
    """[T + A, K, 3] SH with which the changed and the appended Gaussians look as those below did (appearance.py); None:
    the SH of the same index and of the parents."""
    faded: np.ndarray | None = field(default=None, repr=False)
    """[T] bool: changed Gaussians of which only the opacity is another, such as those that a sheet took the place of;
    None: none is said to be. Their other values are not stored: in `values` they may be 0 (`complete`)."""

    def written(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(ids, values) of an attribute that have to be written."""
        values = getattr(self.values, name)
        if self.faded is None or name == "opacities":
            return self.gaussian_ids, values
        return self.gaussian_ids[~self.faded], values[~self.faded]

    def complete(self, below: Splats) -> Delta:
        """The delta with all values."""
        if self.faded is None or not self.faded.any():
            return self
        # Zeros in place of values that are not stored pack to nothing, and must not be mixed with.
        ids, values = self.gaussian_ids[self.faded], {}
        for name in (name for name in ATTRIBUTES if name != "opacities"):
            values[name] = getattr(self.values, name).copy()
            values[name][self.faded] = getattr(below, name)[ids]
        return replace(self, values=replace(self.values, **values))

    def apply(self, below: Splats) -> Splats:
        """The Gaussians after. Arrays in which no bit changes are shared with `below`."""
        assert len(below) == self.count, f"delta of {self.count} Gaussians on {len(below)}"
        written: dict[str, np.ndarray] = {}
        for name in ATTRIBUTES:
            # Bits are compared, not numbers: a NaN equals nothing, and -0 equals 0, yet the file has its bytes.
            old, (ids, new) = getattr(below, name), self.written(name)
            same = np.array_equal(float_bits(old[ids]), float_bits(new))
            if same and not len(self.appended):
                continue
            written[name] = np.concatenate([old, getattr(self.appended, name)])
            if not same:
                written[name][ids] = new
        if not written:
            return below
        return self.numbered(replace(below, **written), below)

    def numbered(self, after: Splats, below: Splats) -> Splats:
        """`after`, which has the values that this makes of `below`, with source and origin as `below` has them."""
        origin, tail = below.origin, self.origins(below)
        if origin is not None and tail is not None and len(tail):
            origin = np.concatenate([origin, tail])
        return replace(after, source=below.source, origin=origin)

    def origins(self, below: Splats) -> np.ndarray | None:
        """[A] int64 the original's Gaussian that each appended one comes from, by way of its parent."""
        if below.origin is None:
            return None
        return np.where(self.parent_ids >= 0, below.origin[np.maximum(self.parent_ids, 0)], -1)


def between(
    before: Splats, after: Splats, parent_ids: np.ndarray | None = None, changed: np.ndarray | None = None
) -> Delta:
    """The delta that makes `after` of `before`. parent_ids: [A], default none; changed: `changed_rows` of them, if at
    hand."""
    n = len(before)
    changed = changed_rows(before, after) if changed is None else changed
    tail = np.arange(n, len(after))
    parent_ids = np.full(len(tail), -1, np.int64) if parent_ids is None else parent_ids.astype(np.int64)
    values, faded = changed_values(before, after, changed)
    return Delta(n, changed, values, without_source(after.take(tail)), parent_ids, faded=faded)


def changed_values(before: Splats, after: Splats, ids: np.ndarray) -> tuple[Splats, np.ndarray]:
    """(values and `faded` of a delta) of some Gaussians ([T] int64), whatever of them changed."""
    from splatpainter.kernels.row_bits import differing
    from splatpainter.kernels.rows import take

    # Where only the opacity differs the rest is not stored: a sheet empties many Gaussians below it.
    faded, values = np.ones(len(ids), bool), {}
    for name in (name for name in ATTRIBUTES if name != "opacities"):
        faded &= ~differing(getattr(before, name), getattr(after, name), ids)
    rest = np.flatnonzero(~faded)
    written = take(without_source(after), ids[rest])
    for name in ATTRIBUTES:
        values[name] = np.zeros((len(ids), *getattr(after, name).shape[1:]), getattr(after, name).dtype)
        values[name][rest] = getattr(written, name)
    values["opacities"] = after.opacities[ids]
    return replace(without_source(after), **values), faded


def without_source(splats: Splats) -> Splats:
    """The Gaussians without the file they came from."""
    return replace(splats, source=None, origin=None)


def no_delta(below: Splats) -> Delta:
    """A delta that changes nothing."""
    none = np.zeros(0, np.int64)
    return Delta(len(below), none, without_source(below.take(none)), without_source(below.take(none)), none)


def encode(delta: Delta) -> Iterator[bytes]:
    """Parts of zstd with checksums, made one at a time: a JSON head, then ids, parents, the bits of `faded`, and the
    attributes of the changed and of the appended Gaussians, little-endian float32, one after the other; then the base
    where there is one. Of faded Gaussians all values but the opacities are left out. The bytes of each part's floats
    are stored as four planes, the lowest bytes first."""
    from splatpainter.io import zstd

    def pack(data: bytes) -> bytes:
        return zstd.pack(data, level=3, checksum=True)

    # Counts come first, so that a reader can judge all sizes before it unpacks any of them.
    head = {"count": delta.count, "rows": len(delta.gaussian_ids), "appended": len(delta.appended)}
    head["coefficients"] = int(delta.values.sh.shape[1])
    faded = np.zeros(len(delta.gaussian_ids), bool) if delta.faded is None else delta.faded
    yield pack(json.dumps({"version": VERSION, **head, "base": delta.base is not None}).encode())
    steps = np.diff(delta.gaussian_ids, prepend=0)  # small numbers, most of them 1
    values = [np.asarray(delta.written(name)[1], "<f4") for name in ATTRIBUTES]
    base = () if delta.base is None else (np.asarray(delta.base, "<f4"),)
    # In parts of bounded size, so that a delta of any size is written and read in little memory.
    for column in (steps, delta.parent_ids, np.packbits(faded), *values, *_columns(delta.appended), *base):
        data = np.ascontiguousarray(column).reshape(-1).view(np.uint8)
        for start in range(0, max(len(data), 1), PART_BYTES):
            part = data[start : start + PART_BYTES]
            yield pack((part.reshape(-1, 4).T if column.dtype == np.float32 else part).tobytes())


def decode(parts: Iterable[bytes], where: str = "delta") -> Delta:
    """The inverse of `encode`. Raises ValueError naming `where` for anything that `encode` does not write."""
    from splatpainter.io import zstd

    source = iter(parts)
    packed = unpacked = 0

    def unpack(part: bytes) -> bytes:
        nonlocal packed, unpacked
        # Judged by what the part says of itself, before anything is allocated for it.
        size = zstd.declared_size(part)
        if size is None or size > PART_BYTES:
            raise ValueError("a part is too large")
        # A file of some kilobytes could claim gigabytes, part by part; real Gaussians pack far less.
        packed, unpacked = packed + len(part), unpacked + size
        if unpacked > max(UNPACKED_FREE_BYTES, UNPACKED_RATIO * packed):
            raise ValueError(f"{packed} bytes unpack to more than {unpacked >> 20} MiB")
        return zstd.unpack(part, PART_BYTES)

    def column(count: int, dtype: str) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        pieces, size_read = [], 0
        while size_read < size or not pieces:
            piece = unpack(next(source))
            if dtype == "<f4":
                if len(piece) % 4:
                    raise ValueError("a part ends within a number")
                piece = np.frombuffer(piece, np.uint8).reshape(4, -1).T.tobytes()
            pieces.append(piece)
            size_read += len(piece)
            # Only the last part may be short, so that many tiny parts cannot cost more than their bytes.
            if len(piece) < PART_BYTES and size_read < size:
                raise ValueError("a part is too short")
        if size_read != size:
            raise ValueError(f"expected {size} bytes, got {size_read}")
        return np.frombuffer(b"".join(pieces), dtype)

    try:
        head = json.loads(unpack(next(source)))
        if head["version"] != VERSION or head["coefficients"] not in SH_COUNTS:
            raise ValueError(f"unknown layout {head}")
        n, t, a, k = (int(head[name]) for name in ("count", "rows", "appended", "coefficients"))
        if not (0 <= t <= n <= MAX_GAUSSIANS and 0 <= a <= MAX_GAUSSIANS):
            raise ValueError(f"impossible numbers of Gaussians {head}")
        # Ids and parents are judged before the floats are read: wrong ones would write beside the arrays.
        gaussian_ids = column(t, "<i8").cumsum()
        parent_ids = column(a, "<i8").copy()
        if t and not (gaussian_ids[0] >= 0 and gaussian_ids[-1] < n and (np.diff(gaussian_ids) > 0).all()):
            raise ValueError("ids are not ascending")
        if a and not (parent_ids.min() >= -1 and parent_ids.max() < n):
            raise ValueError("parents are out of range")
        faded = np.unpackbits(column(-(-t // 8), "u1"), count=t).astype(bool)
        faded = faded if faded.any() else None
        values, appended = _gaussians(column, t, k, faded), _gaussians(column, a, k)
        base = None
        if head["base"]:
            base = column((t + a) * k * 3, "<f4").reshape(t + a, k, 3).copy()
        # Bytes that nothing reads would still be kept, and copied with the project.
        if next(source, None) is not None:
            raise ValueError("more parts than expected")
        return Delta(n, gaussian_ids, values, appended, parent_ids, base, faded)
    except StopIteration:
        raise ValueError(f"{where}: damaged (parts are missing)") from None
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, zstd.ZstdError) as error:
        raise ValueError(f"{where}: damaged ({printable(str(error), MAX_REASON)})") from None


@dataclass(frozen=True)
class AssetDelta:
    """The way from one version of the asset to the present one: keep the first `retained` Gaussians (those beyond are
    gone), overwrite `gaussian_ids` with `values`, add `appended` at the end."""

    since: int | None
    """The version that it starts from; None: everything is sent, `retained` is 0."""
    version: int
    retained: int
    gaussian_ids: np.ndarray = field(repr=False)
    """[T] int64 ascending, all below `retained`."""
    splats: Splats = field(repr=False)
    """All Gaussians of `version`."""
    recolored: bool = False
    """Whether means, scales and rotations of all Gaussians are as they were."""

    @cached_property
    def values(self) -> Splats:
        """T Gaussians; made when they are asked for."""
        return without_source(self.splats.take(self.gaussian_ids))

    @cached_property
    def appended(self) -> Splats:
        """A Gaussians, which become number retained, retained + 1 and so on."""
        return without_source(self.splats.take(np.arange(self.retained, len(self.splats))))


class VersionLog:
    """The Gaussians that each of the latest versions changed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._steps: deque[tuple[int, int, np.ndarray, bool]] = deque(maxlen=MAX_VERSIONS)

    def note(self, version: int, before: Splats, after: Splats) -> None:
        """`after` is what `version` shows, `before` what the one before it showed."""
        # Half the bytes of int64, for up to MAX_VERSION_GAUSSIANS that are kept; indices fit.
        changed = changes(before, after).astype(np.int32)
        recolored = all(getattr(before, name) is getattr(after, name) for name in GEOMETRY)
        step = (version, min(len(before), len(after)), changed, recolored)
        with self._lock:
            self._steps.append(step)
            while len(self._steps) > 1 and sum(len(step[2]) for step in self._steps) > MAX_VERSION_GAUSSIANS:
                self._steps.popleft()

    def since(self, version: int | None, now: int, splats: Splats) -> AssetDelta:
        """Change from a version (None or unknown: from nothing) to the present one, `now`, which shows `splats`."""
        with self._lock:
            # A gap in the log means that changes were forgotten: then all is sent.
            steps = [] if version is None else [step for step in self._steps if version < step[0] <= now]
        if version is None or version > now or len(steps) != now - version:
            version, retained, changed = None, 0, np.zeros(0, np.int64)
        else:
            # The smallest asset on the way: what was gone once was made anew, whatever its index now.
            retained = min([len(splats), *(step[1] for step in steps)])
            rows = [step[2] for step in steps]
            changed = rows[0] if len(rows) == 1 else distinct(np.concatenate([np.zeros(0, np.int32), *rows]))
            changed = changed[: np.searchsorted(changed, retained)].astype(np.int64)
        recolored = version is not None and all(step[3] for step in steps)
        return AssetDelta(version, now, retained, changed, splats, recolored)


def _columns(splats: Splats) -> Iterator[np.ndarray]:
    for name in ATTRIBUTES:
        yield np.asarray(getattr(splats, name), "<f4")


def _gaussians(column, count: int, k: int, faded: np.ndarray | None = None) -> Splats:
    """faded: [count] bool, of which only the opacity is there; the rest of their values becomes 0."""
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (k, 3)}
    arrays = {}
    for name in ATTRIBUTES:
        size = int(np.prod(shapes[name], dtype=np.int64))
        if faded is None or name == "opacities":
            arrays[name] = column(count * size, "<f4").reshape(count, *shapes[name]).copy()
        else:
            arrays[name] = np.zeros((count, *shapes[name]), np.float32)
            arrays[name][~faded] = column(int((~faded).sum()) * size, "<f4").reshape(-1, *shapes[name])
    return Splats(**arrays)
