"""GaussianSplats3D .ksplat (mkkellogg), read only: header version 0.1 and later, levels 0-2, SH degree 0-3.

    header, 4096 bytes: u8 major, u8 minor; u32 at 4 section headers, 12 rows there is room for, 16 rows; u16 at 20
        compression level; f32 at 36, 40 range of 8-bit SH (0 means -1.5, 1.5)
    section headers, 1024 bytes each: u32 rows, room, bucket size, buckets; f32 at 16 block size; u16 at 20 bytes of a
        bucket; u32 at 24 range of a packed position, 32 full buckets, 36 partly filled buckets; u16 at 40 SH degree
    section data: u32 lengths of the partly filled buckets; bucket centres, 3 x f32; rows
    row: position, scale (linear), rotation w x y z, RGBA u8, SH (band by band, channel-major within a band)
        level 0: all float32; level 1: position u16 about the bucket's centre, others float16; level 2: and SH u8

GaussForge 0.6 stores SH channel by channel, all bands of red first; its files are known by the header's counts of
sections and of room, both 0, and are read so.

Rows come in the file's order: full buckets, then partly filled ones, section after section.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats import activations
from splatpainter.io.formats.reuse import row_problems
from splatpainter.splats import Source, Splats
from splatpainter.system.quick_dataclass import dataclass

HEADER, SECTION = 4096, 1024
MAX_DEGREE = 3
"""SH degree that sections may have. GaussianSplats3D 0.4 writes up to 2; others write and read 3, in the same order."""
SH_RANGE = 1.5
"""Half range of 8-bit SH where the header says 0."""
MAX_SECTIONS = 4096
"""Sections of a file; converters write one, or one for each joined scene."""
SH_BY_CHANNEL = "GaussForge"
"""Source.detail of a file whose SH are in that program's order."""
POSITION_RANGE = 32767
"""Half range of a 16-bit position where a section header says 0."""


@dataclass(frozen=True)
class _Section:
    """One section header, and where its data begin."""

    rows: int
    capacity: int
    bucket_size: int
    buckets: int
    block: float
    bucket_bytes: int
    position_range: int
    full: int
    partial: int
    degree: int
    start: int

    @property
    def buckets_size(self) -> int:
        return 4 * self.partial + self.bucket_bytes * self.buckets


def read_ksplat(path: Path) -> Splats:
    """Read a .ksplat file. Raises ValueError with one line: unknown version or level, truncated, contradictory."""
    data = files.read_all(path)
    head = files.take(data, 0, HEADER, path, "the .ksplat header")
    major, minor = head[0], head[1]
    if (major, minor) < (0, 1) or major > 0:
        raise ValueError(f"{path}: expected .ksplat version 0.1 or a later 0.x, got {major}.{minor}")
    (sections,), (total,) = np.frombuffer(head, "<u4", 1, 4), np.frombuffer(head, "<u4", 1, 16)
    level = int(np.frombuffer(head, "<u2", 1, 20)[0])
    if level > 2:
        raise ValueError(f"{path}: expected .ksplat compression level 0, 1 or 2, got {level}")
    low, high = (float(x) for x in np.frombuffer(head, "<f4", 2, 36))
    span = (low or -SH_RANGE, high or SH_RANGE)
    by_channel = not np.frombuffer(head, "<u4", 2, 8).any()
    with np.errstate(all="ignore"):  # NaN and overflow in a damaged file are reported below, not warned of
        parts = [
            _read_section(data, section, level, span, by_channel, path)
            for section in _sections(data, int(sections), level, path)
        ]
    coefficients = max(p.sh.shape[1] for p in parts)
    splats = Splats(
        means=np.concatenate([p.means for p in parts]),
        quats=np.concatenate([p.quats for p in parts]),
        scales=np.concatenate([p.scales for p in parts]),
        opacities=np.concatenate([p.opacities for p in parts]),
        sh=np.concatenate([np.pad(p.sh, ((0, 0), (0, coefficients - p.sh.shape[1]), (0, 0))) for p in parts]),
    )
    problems = row_problems(splats)
    if len(splats) != total:
        problems.insert(0, f"the header says {total} rows, the sections hold {len(splats)}")
    # In the lowest band both orders are the same.
    detail = SH_BY_CHANNEL if by_channel and coefficients > 4 else None
    source = Source(str(path), "ksplat", splats, files.sha256(data), detail, tuple(problems))
    return replace(splats, source=source, origin=np.arange(len(splats), dtype=np.int64))


def _sections(data: bytes, count: int, level: int, path: Path) -> list[_Section]:
    files.take(data, HEADER, count * SECTION, path, f"{count} section headers")
    if count > MAX_SECTIONS:
        raise ValueError(f"{path}: expected at most {MAX_SECTIONS} sections in a .ksplat file, found {count}")
    start = HEADER + count * SECTION
    sections = []
    for k in range(count):
        base = HEADER + k * SECTION
        words = np.frombuffer(data, "<u4", 10, base)
        rows, capacity, bucket_size, buckets = (int(w) for w in words[:4])
        degree = int(np.frombuffer(data, "<u2", 1, base + 40)[0])
        if degree > MAX_DEGREE:
            raise ValueError(f"{path}: section {k}: expected SH degree 0 to {MAX_DEGREE}, got {degree}")
        if rows > capacity:
            raise ValueError(f"{path}: section {k}: {rows} rows, but room for {capacity}")
        section = _Section(
            rows,
            capacity,
            bucket_size,
            buckets,
            float(np.frombuffer(data, "<f4", 1, base + 16)[0]),
            int(np.frombuffer(data, "<u2", 1, base + 20)[0]),
            int(words[6]) or POSITION_RANGE,
            int(words[8]),
            int(words[9]),
            degree,
            start,
        )
        if level and section.bucket_bytes != 12 and rows:
            raise ValueError(f"{path}: section {k}: expected 12 bytes a bucket, got {section.bucket_bytes}")
        size = section.buckets_size + capacity * _row(level, degree).itemsize
        files.take(data, start, size, path, f"section {k} with {capacity} rows")
        start += size
        sections.append(section)
    if not sections:
        raise ValueError(f"{path}: expected at least one section in a .ksplat file, found none")
    return sections


def _row(level: int, degree: int) -> np.dtype:
    real = "<f4" if level == 0 else "<f2"
    harmonics = ("<f4", "<f2", "u1")[level]
    return np.dtype(
        [
            ("means", "<f4" if level == 0 else "<u2", 3),
            ("scales", real, 3),
            ("quats", real, 4),
            ("rgba", "u1", 4),
            ("sh", harmonics, (3 * (degree + 1) ** 2 - 3,)),
        ]
    )


def _read_section(
    data: bytes, section: _Section, level: int, span: tuple[float, float], by_channel: bool, path: Path
) -> Splats:
    rows = np.frombuffer(data, _row(level, section.degree), section.rows, section.start + section.buckets_size)
    colors = rows["rgba"] / np.float64(255)
    means = rows["means"].astype(np.float64)
    if level:
        centres = np.frombuffer(data, "<f4", 3 * section.buckets, section.start + 4 * section.partial).reshape(-1, 3)
        step = section.block / 2 / section.position_range
        means = (means - section.position_range) * step + centres[_bucket_of_rows(data, section, path)]
    rest = rows["sh"].astype(np.float64)
    if level == 2:
        rest = span[0] + rest / 255 * (span[1] - span[0])
    bands = [activations.color_to_dc(colors[:, :3])[:, None]]
    if by_channel:
        bands.append(rest.reshape(len(rest), 3, -1).transpose(0, 2, 1).astype(np.float32))
    for l in range(1, 0 if by_channel else section.degree + 1):
        width = 2 * l + 1
        band = rest[:, 3 * (l * l - 1) : 3 * (l * l - 1) + 3 * width].reshape(-1, 3, width)
        bands.append(band.transpose(0, 2, 1).astype(np.float32))
    return Splats(
        means=means.astype(np.float32),
        quats=rows["quats"].astype(np.float32),
        scales=rows["scales"].astype(np.float32),
        opacities=colors[:, 3].astype(np.float32),
        sh=np.concatenate(bands, 1),
    )


def _bucket_of_rows(data: bytes, section: _Section, path: Path) -> np.ndarray:
    """[rows] index of the bucket about whose centre each row's position is packed."""
    rows = np.arange(section.rows)
    in_full = min(section.full * section.bucket_size, section.rows)
    lengths = np.frombuffer(data, "<u4", section.partial, section.start).astype(np.int64)
    bucket = section.full + np.searchsorted(np.cumsum(lengths), rows - in_full, side="right")
    if section.bucket_size:
        bucket = np.where(rows < in_full, rows // section.bucket_size, bucket)
    if bucket.max(initial=0) >= section.buckets:
        raise ValueError(f"{path}: {section.rows} rows do not fit the {section.buckets} buckets of their section")
    return bucket
