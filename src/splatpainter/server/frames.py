"""Gaussians on the wire: the binary frames of snapshots, deltas and previews. Knows no session.

Little endian. Header, eight u32: magic, format, flags, version_from, version_to, total, count, K.
Then, one array after the other:
  indices   u32[count]           absent in a snapshot, whose Gaussians are 0 .. count - 1
  means     f32[count][3]        }
  scales    f32[count][3]        } absent with COLORS_ONLY; scales are linear
  quats     f32[count][4]        } w, x, y, z, unit length
  opacities f32[count]           0..1
  sh        f32[count][K][3]     coefficient after coefficient, red green blue; colour = 0.5 + sum_k Y_k sh_k
or, with PACKED, only colours as the page's textures hold them: a third of the bytes, and nothing to convert on arrival
(the same numbers as web/src/splats/texels.ts and sh.ts make of floats)
  indices   u32[count]           absent where count = total: all Gaussians
  base      f16[count][3]        0.5 + Y_0 sh_0, and two bytes more where that makes whole words
  codes     u32[count][K - 1]    the other coefficients; K = 1: they stay as they are
A delta turns version_from into version_to; total is the number of Gaussians afterwards (it may shrink after an undo:
those from there on no longer exist). A preview changes no version: its Gaussians stay so until the next frame names
them.
"""

from __future__ import annotations

import struct

import numpy as np

from splatpainter.color import sh_from_color
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run_sized
from splatpainter.kernels.rows import take
from splatpainter.splats import SH_C0, SH_COUNTS, Splats
from splatpainter.system.quick_dataclass import dataclass

MAGIC = 0x53504C44
FORMAT = 1
SNAPSHOT = 1
"""All Gaussians; forget what was there."""
PREVIEW = 2
"""Not part of the asset: version_from = version_to = the version that is previewed on (or put back)."""
COLORS_ONLY = 4
"""Only indices, opacities and sh travel."""
PACKED = 8
"""Only colours travel, as the screen's textures hold them."""
HEADER = struct.Struct("<8I")
MAX_HALF = 65504.0


@dataclass(frozen=True)
class SplatFrame:
    """A frame taken apart, for clients in Python and for tests."""

    flags: int
    version_from: int
    version_to: int
    total: int
    """Gaussians of the asset."""
    gaussian_ids: np.ndarray
    """[C] indices."""
    splats: Splats
    """[C] Gaussians; with COLORS_ONLY the geometry is empty arrays of shape [C, 0], with PACKED also the opacities."""


def snapshot(splats: Splats, version: int) -> bytes:
    """All Gaussians."""
    return pack(splats, None, len(splats), version, version)


def delta(
    splats: Splats, gaussian_ids: np.ndarray, version_from: int, version_to: int, recolored: bool = False
) -> bytes:
    """The given Gaussians ([C] ascending) of the asset `splats`, which is at version_to. recolored: means, scales and
    rotations are as they were."""
    changed = take(splats, gaussian_ids)
    return pack(changed, gaussian_ids, len(splats), version_from, version_to, COLORS_ONLY * recolored)


def preview(splats: Splats, gaussian_ids: np.ndarray, total: int, version: int, shapes: bool = False) -> bytes:
    """Colours and opacities (of the C in `splats`) to show for given Gaussians ([C] ascending) of `total`. shapes: and
    means, scales and rotations; `total` may then be larger than the asset."""
    return pack(splats, gaussian_ids, total, version, version, PREVIEW | COLORS_ONLY * (not shapes))


def has_shapes(frame: bytes) -> bool:
    """Whether a frame holds means, scales and rotations."""
    return not HEADER.unpack_from(frame)[2] & (COLORS_ONLY | PACKED)


def preview_colors(sh: np.ndarray, gaussian_ids: np.ndarray, total: int, version: int) -> bytes:
    """Colours to show for given Gaussians ([C] ascending) of `total`, as near as a screen shows them. sh: [C, K, 3], or
    [C, 1, 3] where only base colours change."""
    head = HEADER.pack(MAGIC, FORMAT, PREVIEW | PACKED, version, version, total, len(gaussian_ids), sh.shape[1])
    # A frame of all Gaussians leaves its indices out: they are 0 to total - 1.
    index = b"" if len(gaussian_ids) == total else np.asarray(gaussian_ids, "<u4").data
    base, codes = pack_base(sh).astype("<f2", copy=False), pack_harmonics(sh).astype("<u4", copy=False)
    # Whole words before the codes, so that a page can view the bytes as arrays where they lie.
    return b"".join([head, index, base.data, b"\0" * (-base.nbytes % 4), codes.data])


def pack(
    splats: Splats, gaussian_ids: np.ndarray | None, total: int, version_from: int, version_to: int, flags: int = 0
) -> bytes:
    """A frame of C Gaussians, which are those of `gaussian_ids` of an asset of `total` (None: all of it, a snapshot).

    Gaussians with values that the screen cannot show (NaN, infinite) travel with opacity 0."""
    flags |= SNAPSHOT * (gaussian_ids is None)
    drawable = splats.drawable
    coefficients = int(splats.sh.shape[1])
    parts = [HEADER.pack(MAGIC, FORMAT, flags, version_from, version_to, total, len(splats), coefficients)]
    if gaussian_ids is not None:
        parts.append(np.asarray(gaussian_ids, "<u4").tobytes())
    if not flags & COLORS_ONLY:
        # Squares of undrawable ones may overflow.
        quats = np.where(drawable[:, None], splats.quats, np.array([1, 0, 0, 0], np.float32))
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        parts += [_bytes(splats.means, drawable), _bytes(splats.scales, drawable), _bytes(quats, drawable)]
    parts += [_bytes(np.clip(splats.opacities, 0, 1), drawable), _bytes(splats.sh, drawable)]
    return b"".join(parts)


def unpack(data: bytes) -> SplatFrame:
    """The inverse of `pack`. Raises ValueError where the bytes are no frame."""
    # Checked to the byte before anything is viewed: frames may come from another program or another version.
    if len(data) < HEADER.size:
        raise ValueError(f"frame: expected at least {HEADER.size} bytes, got {len(data)}")
    magic, form, flags, first, last, total, count, coefficients = HEADER.unpack_from(data)
    if magic != MAGIC or form != FORMAT or coefficients not in SH_COUNTS:
        raise ValueError(
            f"frame: expected magic {MAGIC:#x}, format {FORMAT}, got {magic:#x}, {form}, K = {coefficients}"
        )
    if flags & PACKED:
        return _unpack_colors(data)
    snapshot, colors = bool(flags & SNAPSHOT), bool(flags & COLORS_ONLY)
    widths = [0 if snapshot else 1, *((0, 0, 0) if colors else (3, 3, 4)), 1, 3 * coefficients]
    expected = HEADER.size + 4 * count * sum(widths)
    if len(data) != expected:
        raise ValueError(f"frame: expected {expected} bytes for {count} Gaussians, got {len(data)}")
    # Arrays follow one another without gaps, so the widths alone say where each begins; what is absent has width 0.
    ends = HEADER.size + 4 * count * np.cumsum([0, *widths])
    kinds = ["<u4", *["<f4"] * 5]
    arrays = [
        np.frombuffer(data, kind, count * width, int(start)).reshape(count, width)
        for kind, width, start in zip(kinds, widths, ends[:-1], strict=True)
    ]
    gaussian_ids = np.arange(count) if snapshot else arrays[0][:, 0].astype(np.int64)
    splats = Splats(arrays[1], arrays[3], arrays[2], arrays[4][:, 0], arrays[5].reshape(count, coefficients, 3))
    return SplatFrame(flags, first, last, total, gaussian_ids, splats)


def _unpack_colors(data: bytes) -> SplatFrame:
    """`unpack` of `preview_colors`."""
    _, _, flags, first, last, total, count, coefficients = HEADER.unpack_from(data)
    index = 0 if count == total else 4 * count
    base = 6 * count + (-6 * count) % 4
    expected = HEADER.size + index + base + 4 * count * (coefficients - 1)
    # The same check as in `unpack`, for what the packed form holds.
    if len(data) != expected:
        raise ValueError(f"frame: expected {expected} bytes for {count} Gaussians, got {len(data)}")
    at = HEADER.size + index
    gaussian_ids = np.frombuffer(data, "<u4", count, HEADER.size).astype(np.int64) if index else np.arange(count)
    halves = np.frombuffer(data, "<f2", 3 * count, at).reshape(count, 3)
    codes = np.frombuffer(data, "<u4", count * (coefficients - 1), at + base).reshape(count, coefficients - 1)
    absent = np.zeros((count, 0), np.float32)
    splats = Splats(absent, absent, absent, absent, unpack_sh(halves, codes))
    return SplatFrame(flags, first, last, total, gaussian_ids, splats)


def _bytes(values: np.ndarray, drawable: np.ndarray) -> bytes:
    if not drawable.all():
        values = np.where(drawable.reshape(-1, *[1] * (values.ndim - 1)), values, 0)
    return np.ascontiguousarray(values, "<f4").tobytes()


def pack_base(sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] float32 SH -> [N, 3] float16 base colours 0.5 + Y_0 sh_0 within +-65504; NaN becomes 0."""
    out = np.empty((len(sh), 3), np.uint16)
    run_sized(sh.size, kernels.pack_base_colors, np.require(sh, np.float32, ["C", "A"]), SH_C0, out)
    return out.view(np.float16)


def pack_harmonics(sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] float32 SH -> [N, K - 1] uint32, one per coefficient but the first: three 8-bit magnitudes over a
    shared power of two, value = byte / 255 * 2^(exponent - 15), the exponent's 5 bits and three sign bits (red
    lowest)."""
    out = np.empty((len(sh), sh.shape[1] - 1), np.uint32)
    if out.size:
        run_sized(sh.size, kernels.pack_harmonic_codes, np.require(sh, np.float32, ["C", "A"]), out)
    return out


def unpack_sh(halves: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """What a screen makes of them: [N, 3] and [N, K - 1] -> SH [N, K, 3] float32."""
    out = np.empty((len(halves), 1 + codes.shape[1], 3), np.float32)
    out[:, 0] = sh_from_color(halves.astype(np.float64))
    unit = np.ldexp(np.float32(1 / 255), (codes >> 27).astype(np.int32) - 15)
    for k in range(3):
        sign = np.where(codes >> (24 + k) & 1, np.float32(-1), np.float32(1))
        out[:, 1:, k] = (codes >> (8 * k) & 255).astype(np.float32) * unit * sign
    return out
