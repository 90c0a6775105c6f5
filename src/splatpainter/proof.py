"""The proof of an edit: what was written is read again and compared, before it takes the place of anything."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.io import FORMATS, format_of_name, frame_of_target, read, write
from splatpainter.receipts import Receipt, Verification, check, compare, untouched_hashes
from splatpainter.splats import Frame, Splats


def prove(original: Splats, written: Path, receipt: Receipt, frame: Frame = "auto") -> tuple[Receipt, Verification]:
    """The receipt of the file at `written`, and the outcome of checking the one against the other.

    A format that rounds may encode rows anew that the edit left alone. Such rows are different in the file, so they
    are listed as touched, and the note says how many and why. For a format that keeps everything this is a fault.
    An original that is no file is compared as that format holds it. frame: what it was written with.
    Raises RuntimeError where the file does not prove the receipt."""
    key = format_of_name(written)
    taken = frame if key is None else frame_of_target(original, key, frame)
    edited = read(written, frame=taken, lenient=True)  # what a lenient original had cut off is kept
    assert edited.source is not None
    entry = FORMATS[edited.source.format]
    found = compare(_as_file(original, written), edited)
    rounded = np.setdiff1d(found.differs, receipt.touched)
    notes = [receipt.note]
    if len(rounded) and entry.lossy:
        touched = np.union1d(receipt.touched, rounded)
        before, after = untouched_hashes(found.before, edited, touched)
        receipt = replace(receipt, touched=touched, untouched_sha256_before=before, untouched_sha256_after=after)
        notes.append(f"{len(rounded)} rows that the edit left alone were rounded anew by {entry.key}")
    if original.source is None or original.source.format != entry.key:
        notes.append(f"rows are compared with the original converted to {entry.key}")
    if entry.lossy:
        notes.append(f"dB are of the rows before {entry.key} rounds them")
    receipt = replace(
        receipt,
        output_sha256=edited.sha256,
        output_rows=len(edited),
        note="; ".join(filter(None, notes)),
    )
    verification = check(found, receipt if original.source else replace(receipt, asset_sha256=found.original_sha256))
    if not verification.ok:
        raise RuntimeError(f"the file written does not prove its receipt: {'; '.join(verification.problems)}")
    return receipt, verification


def _as_file(original: Splats, written: Path) -> Splats:
    if original.source is not None:
        return original
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / written.name
        write(place, original)
        return read(place)
