"""A scene as one file: every visible asset in its own range of rows, what layers appended behind all of them, and the
receipt with which each range is verified against its own file (scene/merge.py)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import FORMATS, files, format_of_name, read
from splatpainter.io.joining import concatenated, write_joined
from splatpainter.io.losses import loss_line, measure
from splatpainter.output_paths import receipt_of
from splatpainter.receipts import Receipt, Verification, untouched_hashes
from splatpainter.scene.merge import BYTES, Part, check_merge, differing_rows, placed
from splatpainter.session.project.asset_files import check_target, partial_folder
from splatpainter.session.replay.scene_replay import Scene
from splatpainter.splats import changed_rows


def scene_receipt(scene: Scene, preset: str, note: str, precision: str, key: str = "ply") -> Receipt:
    """Receipt of all visible assets against their originals. key: format of the file that is written."""
    sources, edited = [], []
    for part in scene.parts:
        one = Part(part.original, part.asset.placement)
        touched = changed_rows(part.original, part.state.splats)
        sources.append(_source(part.asset.name, one, part.first, len(touched), key))
        edited.append(part.first + touched)
    # Receipts compare with one asset: the first one, where its bytes stay; else all of it counts as touched.
    lead = scene.parts[0]
    rows = len(lead.original)
    stays = sources[0]["how"] == BYTES and scene.original.sh.shape[1] == lead.original.sh.shape[1]
    touched = edited[0] if stays else np.arange(rows)
    before, after = untouched_hashes(lead.original, lead.state.splats, touched)
    return Receipt(
        asset_sha256=lead.original.sha256,
        asset_rows=rows,
        output_sha256="",
        output_rows=len(scene.state.splats),
        mode="session",
        method="layers",
        preset=preset,
        touched=touched,
        appended_rows=len(scene.state.splats) - rows,
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        note=note,
        precision=precision,
        merge={"sources": sources},
        merge_touched=np.concatenate(edited),
    )


def export_scene(scene: Scene, receipt: Receipt, path: Path, overwrite: bool) -> tuple[Receipt, Verification]:
    """Write the file and its receipt (NAME.receipt.json), proved by making every range once more from its own file.
    Rows of formats that round, which share their ranges and codebooks with edited ones, may be encoded anew; they are
    listed as touched. Raises ValueError: the name, an existing file; RuntimeError: the file does not prove it."""
    check_target(path, overwrite)
    receipt_path = receipt_of(path)
    key = format_of_name(path)
    assert key is not None
    heads, tails = [], []
    assets = [Part(part.original, part.asset.placement) for part in scene.parts]
    states = [part.state.splats for part in scene.parts]
    for part, splats in zip(scene.parts, placed(assets, states), strict=True):
        count = len(part.original)
        heads.append(splats.take(np.arange(count)))
        tails.append(splats.take(np.arange(count, len(splats))))
    with partial_folder(path) as folder:
        partial = Path(folder) / path.name
        parts = [*heads, *(tail for tail in tails if len(tail))]
        write_joined(partial, parts)
        written = read(partial, lenient=True)
        joined = concatenated(parts)
        lost = loss_line(joined, key, measure(joined, written))
        notes = (receipt.note, f"lost in {key}: {lost}" if lost else "")
        note = "; ".join(filter(None, notes))
        receipt = replace(receipt, output_sha256=written.sha256, output_rows=len(written), note=note)
        if FORMATS[key].lossy:
            rounded = np.setdiff1d(differing_rows(assets, written), receipt.merge_touched)
            if len(rounded):
                notes = (receipt.note, f"{len(rounded)} rows that no edit touched were rounded anew by {key}")
                touched = np.union1d(receipt.merge_touched, rounded)
                receipt = replace(receipt, merge_touched=touched, note="; ".join(filter(None, notes)))
        # From the written file, which is what people will have: not from the arrays that it was made of.
        checked = check_merge(written, [part.original for part in scene.parts], receipt)
        if not checked.ok:
            raise RuntimeError(f"the written file does not match its receipt: {'; '.join(checked.problems)}")
        with files.writing(receipt_path) as file:
            file.write(receipt.to_json().encode())
            # Last, so that a file of this name is always one that its receipt proves.
            files.replace(partial, path)
    files.sync_folder(path.parent)
    same = sum(one.same for one in checked.ranges)
    total = sum(one.rows for one in checked.ranges)
    return receipt, Verification(True, total, same, total - same, checked.appended, (), checked.exact, lost=lost)


def _source(name: str, part: Part, first: int, changed: int, key: str) -> dict[str, Any]:
    return {
        "name": name,
        "sha256": part.splats.sha256,
        "format": part.format,
        "rows": len(part.splats),
        "first": first,
        "sh_degree": part.splats.sh_degree,
        "how": part.stored_as(key),
        "exact_rows": len(part.splats) - changed,
        "placement": part.placement.record(),
        "seam": None,
    }
