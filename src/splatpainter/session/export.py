"""Out of a session: the asset as a file with the receipt of all that was done to it, and single layers as files."""

from __future__ import annotations

import io
import json
import os
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.io import FORMATS, files, format_of_name, read, write
from splatpainter.receipts import Receipt, Verification, check, compare, untouched_hashes
from splatpainter.session.deltas import differing
from splatpainter.session.layers import Layer
from splatpainter.splats import Splats

LAYER_SUFFIX = ".splatlayer"
LARGEST = 1 << 28
"""Bytes of one picture in a layer file."""


def receipt_between(original: Splats, now: Splats, preset: str, note: str) -> Receipt:
    """The receipt of a whole session: original against now. No file yet, so `output_sha256` is empty."""
    touched = differing(original, now)
    before, after = untouched_hashes(original, now, touched)
    return Receipt(
        asset_sha256=original.sha256,
        asset_rows=len(original),
        output_sha256="",
        output_rows=len(now),
        mode="session",
        method="layers",
        preset=preset,
        touched=touched,
        appended_rows=len(now) - len(original),
        untouched_sha256_before=before,
        untouched_sha256_after=after,
        note=note,
    )


def export_asset(
    original: Splats, now: Splats, receipt: Receipt, path: Path, overwrite: bool
) -> tuple[Receipt, Verification]:
    """Write an asset in the format that the name says, read it again, compare it with the original, and only then let
    it and its receipt (NAME.receipt.json) appear. Raises ValueError: the name, an existing file, a full disk;
    RuntimeError: what was written does not prove the receipt."""
    _check_target(path, overwrite)
    receipt_path = path.with_name(path.name + ".receipt.json")
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        write(partial, now)
        proved, found = prove(original, partial, receipt)
        with files.writing(receipt_path) as file:
            file.write(proved.to_json().encode())
            os.replace(partial, path)
    files.sync_folder(path.parent)
    return proved, found


def prove(original: Splats, written: Path, receipt: Receipt) -> tuple[Receipt, Verification]:
    """The receipt of the file at `written` and the outcome of checking one against the other. Rows that a format had to
    round anew are listed as touched. An original that is no file is compared as that format holds it.
    Raises RuntimeError where the file does not prove the receipt."""
    edited = read(written)
    assert edited.source is not None
    entry = FORMATS[edited.source.format]
    found = compare(_as_file(original, written), edited)
    rounded = np.setdiff1d(found.differs, receipt.touched)
    notes = [receipt.note]
    if len(rounded) and entry.lossy:
        touched = np.union1d(receipt.touched, rounded)
        before, after = untouched_hashes(found.before, edited, touched)
        receipt = replace(receipt, touched=touched, untouched_sha256_before=before, untouched_sha256_after=after)
        notes.append(f"{len(rounded)} rows that no layer changed were rounded anew by {entry.key}")
    if original.source is None or original.source.format != entry.key:
        notes.append(f"rows are compared with the original converted to {entry.key}")
    note = "; ".join(filter(None, notes))
    receipt = replace(receipt, output_sha256=edited.sha256, output_rows=len(edited), note=note)
    verification = check(found, replace(receipt, asset_sha256=found.original_sha256))
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


def _check_target(path: Path, overwrite: bool) -> None:
    key = format_of_name(path)
    if key is None or FORMATS[key].write is None or path.name.lower() == "meta.json":
        known = ", ".join(entry.suffixes[0] for entry in FORMATS.values() if entry.write is not None)
        raise ValueError(f"{path}: expected a name ending in {known}")
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder: {path.parent}; make it first")


def write_layer(path: Path, layer: Layer, blob: Callable[[str], bytes], overwrite: bool) -> None:
    """A layer with its pictures as one file: a zip of layer.json and HASH.png. Raises ValueError: it exists, ..."""
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    with files.writing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr("layer.json", json.dumps({"version": 1, "layer": layer.record()}))
        for name in sorted(layer.blobs()):
            bundle.writestr(f"{name}.png", blob(name))


def read_layer(path: Path) -> tuple[Layer, dict[str, bytes]]:
    """(layer, its pictures by hash) of a layer file. Raises ValueError naming the file and what is wrong with it."""
    try:
        with zipfile.ZipFile(io.BytesIO(files.read_all(path))) as bundle:
            record = json.loads(_member(bundle, "layer.json"))
            if not isinstance(record, dict) or record.get("version") != 1:
                raise ValueError("expected a layer of version 1")
            layer = Layer.parse(record.get("layer") or {}, str(path))
            blobs = {name: _member(bundle, f"{name}.png") for name in layer.blobs()}
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError, NotImplementedError, RecursionError) as error:
        raise ValueError(f"{path}: expected a {LAYER_SUFFIX} file ({str(error).removeprefix(f'{path}: ')})") from None
    for name, data in blobs.items():
        if files.sha256(data) != name:
            raise ValueError(f"{path}: damaged (picture {name[:12]}...)")
    return layer, blobs


def _member(bundle: zipfile.ZipFile, name: str) -> bytes:
    info = bundle.getinfo(name)
    if info.file_size > LARGEST or info.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is too large or compressed")
    return bundle.read(info)
