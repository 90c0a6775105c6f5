"""Damaged files: whatever the bytes, a reader returns rows or raises ValueError with one line, in little memory."""

from __future__ import annotations

import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatpainter import io
from tests.io.test_ksplat import make
from tests.support.io_assets import random_splats


def seed_file(name: str) -> bytes:
    """A small sound file of each kind."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        if name.endswith(".ksplat"):
            return make(Path(folder), 1, [1, 0])[0].read_bytes()
        io.write(path, random_splats(20, 1))
        return path.read_bytes()


def as_text(data: bytes) -> bytes:
    head, body = data.split(b"end_header\n", 1)
    table = np.frombuffer(body, "<f4").reshape(20, -1)
    lines = "\n".join(" ".join(map(repr, row.tolist())) for row in table)
    return head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode()


SEEDS = {name: seed_file(name) for name in ("a.ply", "a.compressed.ply", "a.splat", "a.ksplat")}
SEEDS["text.ply"] = as_text(SEEDS["a.ply"])
DIGITS = st.sampled_from([b"0", b"9", b"99999999", b"-1", b"\xff\xff\xff\xff", b"\n", b" ", b"list", b"double", b"1e9"])
CHANGE = st.tuples(st.floats(0, 1), st.integers(0, 4), st.one_of(DIGITS, st.binary(max_size=4)))


@pytest.mark.parametrize("name", SEEDS)
@given(changes=st.lists(CHANGE, min_size=1, max_size=4), keep=st.floats(0, 1), complete=st.booleans())
@settings(max_examples=60, deadline=None, database=None)
def test_damaged(name: str, changes: list[tuple[float, int, bytes]], keep: float, complete: bool) -> None:
    data = SEEDS[name]
    # Headers are short and decide most: half of the places fall into the first 2,000 bytes.
    for k, (where, drop, insert) in enumerate(changes):
        at = int(where * (len(data) if k % 2 else min(len(data), 2000)))
        data = data[:at] + insert + data[at + drop :]
    data = data if complete else data[: int(keep * len(data))]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, name)
        path.write_bytes(data)
        tracemalloc.start()
        try:
            splats = io.read(path)
        except ValueError as error:
            assert "\n" not in str(error) and len(str(error)) < 600
        else:
            entry = io.FORMATS[splats.source.format] if splats.source else None
            if entry is not None and entry.write is not None:  # what can be read can be written back as it was
                entry.write(Path(folder, "same"), splats)
                assert Path(folder, "same").read_bytes() == data
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
    assert peak < 8 << 20, peak
