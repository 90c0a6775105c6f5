"""A batch as clients see it, and what of it they may download: results, receipts, small pictures, the page, a ZIP."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from splatpainter.server.batches.batch_folder import ASSETS, OUT
from splatpainter.server.batches.batch_runs import BatchJob, StudioBatch
from splatpainter.server.protocol import BatchInfo, BatchJobInfo
from splatpainter.server.studio import Studio

PAGE, RECEIPT = "index.html", ".receipt.json"
PICTURES = ("before.webp", "after.webp")
ZIP_PIECE_BYTES = 1 << 18
BELOW = re.compile(rf"(?<![\w/\\])(?:{ASSETS}|{OUT})[/\\]")
"""Folders of a batch in its program's output, which are left out of what users see."""


def batch_info(studio: Studio, batch: StudioBatch) -> BatchInfo:
    """What the page shows of a batch."""
    page = batch.folder / OUT / PAGE
    return BatchInfo(
        id=batch.id,
        state=batch.state,
        title=batch.title,
        jobs=[job_info(studio, batch, number) for number in range(len(batch.jobs))],
        # The page is complete only when the work has ended.
        page_url=f"{_address(batch)}/out/{PAGE}" if not batch.at_work and page.is_file() else None,
        zip_url=zip_url(batch),
    )


def job_info(studio: Studio, batch: StudioBatch, number: int) -> BatchJobInfo:
    """What the page shows of one result of a batch."""
    entry = batch.jobs[number]
    done, out, address = entry.state == "done", entry.job.out, _address(batch)

    # Lines come from a program that names its folders; users know the results by name alone.
    def public(text: str) -> str:
        return studio.public(BELOW.sub("", text))

    # Addresses only of what is there: a job that failed has no file.
    return BatchJobInfo(
        number=number,
        name=out.name,
        asset=entry.job.asset.name,
        words=entry.words,
        state=entry.state,
        line=public(_line(entry)),
        warnings=[public(str(line).partition("warning: ")[2]) for line in entry.record.get("warnings", [])],
        bytes=out.stat().st_size if done and out.is_file() else None,
        url=f"{address}/out/{quote(out.name)}" if done else None,
        receipt_url=f"{address}/out/{quote(out.name)}{RECEIPT}" if done else None,
        before_url=f"{address}/{number}/{PICTURES[0]}" if done else None,
        after_url=f"{address}/{number}/{PICTURES[1]}" if done else None,
    )


def zip_url(batch: StudioBatch) -> str | None:
    """Address of the ZIP of all results so far; None while there are none."""
    return f"{_address(batch)}/all.zip" if any(job.state == "done" for job in batch.jobs) else None


def _line(entry: BatchJob) -> str:
    record = entry.record
    if entry.state == "cancelled":
        return ""
    if entry.state != "done":
        return str(record.get("error", ""))
    # A line of proof and not of success: what did not change, of how many.
    rows, touched = int(record.get("rows", 0)), int(record.get("touched", 0))
    appended = f", {int(record['appended']):,} appended" if record.get("appended") else ""
    return f"{rows - touched:,} of {rows:,} Gaussians unchanged{appended}, verified"


def _address(batch: StudioBatch) -> str:
    return f"/api/batch/{batch.id}"


def result_file(batch: StudioBatch, name: str) -> Path:
    """A result, its receipt, or the summary page. Raises ValueError for any other name."""
    # Only names that this batch made; a client's name never becomes a path.
    for entry in batch.jobs:
        if entry.state == "done" and name in (entry.job.out.name, entry.job.out.name + RECEIPT):
            return batch.folder / OUT / name
    if name == PAGE and not batch.at_work and (batch.folder / OUT / PAGE).is_file():
        return batch.folder / OUT / PAGE
    raise ValueError(f"{name[:100]}: not a result of this batch")


def picture_file(batch: StudioBatch, number: int, name: str) -> Path:
    """A small picture of a result. Raises ValueError for any other."""
    if 0 <= number < len(batch.jobs) and name in PICTURES and batch.jobs[number].state == "done":
        return batch.jobs[number].job.folder / name
    raise ValueError(f"{name[:100]}: not a picture of this batch")


def zipped(batch: StudioBatch) -> Iterator[bytes]:
    """Pieces of a ZIP of all results with their receipts, and the page. Not packed: splat files hardly get smaller."""
    # Each result with its receipt, for a file without it proves nothing.
    names = [entry.job.out.name + ending for entry in batch.jobs if entry.state == "done" for ending in ("", RECEIPT)]
    if not batch.at_work and (batch.folder / OUT / PAGE).is_file():
        names.append(PAGE)
    pieces = _Pieces()
    with zipfile.ZipFile(pieces, "w", zipfile.ZIP_STORED) as bundle:  # type: ignore[arg-type]
        for name in names:
            info = zipfile.ZipInfo.from_file(batch.folder / OUT / name, name)
            # Piece by piece, so that a file of a gigabyte passes through little memory.
            with open(batch.folder / OUT / name, "rb") as file, bundle.open(info, "w") as target:
                while piece := file.read(ZIP_PIECE_BYTES):
                    target.write(piece)
                    yield pieces.taken()
    yield pieces.taken()


class _Pieces:
    """What a ZipFile writes, to be taken away again and again; it cannot seek, and ZipFile does without."""

    def __init__(self) -> None:
        self._data = bytearray()

    def write(self, data: bytes) -> int:
        self._data += data
        return len(data)

    def flush(self) -> None: ...

    def taken(self) -> bytes:
        data = bytes(self._data)
        self._data.clear()
        return data
