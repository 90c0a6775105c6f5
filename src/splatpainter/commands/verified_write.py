"""An edited asset and its receipt on disk: written, read again, compared, and only then under their names."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import splatpainter.session  # noqa: F401 - whose files regions and looks may name
from splatpainter.atomic import clash
from splatpainter.commands.output_paths import check_target, placed, splat_format
from splatpainter.commands.terminal import Stages
from splatpainter.commands.verify import read_receipt
from splatpainter.io import files, write
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, Verification, prove, receipt_of
from splatpainter.scene.merge import carried
from splatpainter.splats import Frame, Splats


def check_outputs(out: Path, receipt: Path, overwrite: bool, asset: Path, inputs: Sequence[Path]) -> None:
    """Refuse OUT and the receipt before any work is done. inputs: other files that are read. Raises ValueError."""
    splat_format(out)
    check_target(out, overwrite, [asset], inputs)
    check_target(receipt, overwrite, [], [asset, *inputs])
    if clash(receipt, out):
        raise ValueError(f"{receipt}: OUT and the receipt need different names, not only in upper and lower case")


def write_proved(
    original: Splats, edited: Asset, out: Path, receipt_path: Path, out_frame: Frame, bar: Stages, read_seconds: float
) -> tuple[Receipt, Verification]:
    """Write an edited asset and its receipt, which then says how long reading, editing, writing and verifying took.
    Raises ValueError: a full disk, no permission; RuntimeError: the file does not prove the receipt."""
    assert edited.receipt is not None
    clock = time.perf_counter()
    # Left in reverse order: OUT takes its name first, the receipt, which is on disk by then, after it.
    with files.writing(receipt_path) as file, placed(out) as partial:
        bar.enter("writing")
        write(partial, edited.splats, frame=out_frame)
        written = time.perf_counter()
        bar.enter("verifying")
        receipt, verification = prove(original, partial, edited.receipt, out_frame, edited.splats)
        timings = {"write": written - clock, "verify": time.perf_counter() - written}
        receipt = carried(receipt, _receipt_beside(original))
        receipt = replace(receipt, seconds={"read": read_seconds, **receipt.seconds, **timings})
        file.write(receipt.to_json().encode())
        file.flush()
        os.fsync(file.fileno())
    return receipt, verification


def _receipt_beside(original: Splats) -> Receipt | None:
    """The receipt of the asset that is edited; None where there is none that can be read."""
    if original.source is None:
        return None
    path = receipt_of(Path(original.source.path))
    try:
        return read_receipt(path) if path.is_file() else None
    except (ValueError, OSError):
        return None


def proved_record(out: Path, receipt_path: Path, receipt: Receipt, verification: Verification) -> dict:
    """What --json says of an edited asset."""
    return {
        "out": out,
        "receipt_file": receipt_path,
        "verified": verification.ok,
        "same_rows": verification.same,
        "compared": verification.exact,
        "frame": verification.frame,
        "receipt": json.loads(receipt.to_json()),
    }
