"""Out of a session: the asset as a file with the receipt of all that was done to it, and single layers as files."""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from splatpainter.cameras import Camera
from splatpainter.image_files import Alpha
from splatpainter.io import FORMATS, files, format_of_name, write
from splatpainter.receipts import Receipt, Verification, changed_rows, prove, untouched_hashes
from splatpainter.rendering.profiles import Profile
from splatpainter.session import conflicts
from splatpainter.session.layers import Layer
from splatpainter.splats import Splats
from splatpainter.view_files import Aov, PictureOptions, view_files

LAYER_SUFFIX = ".splatlayer"
LAYER_FILE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    ValueError,
    OverflowError,
    RuntimeError,
    EOFError,
)
"""What reading a file that is no layer file raises."""
LARGEST = 1 << 28
"""Bytes of one picture in a layer file."""


def receipt_between(original: Splats, now: Splats, preset: str, note: str, precision: str = "") -> Receipt:
    """The receipt of a whole session: original against now. No file yet, so `output_sha256` is empty."""
    touched = changed_rows(original, now)
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
        precision=precision,
    )


def export_asset(
    original: Splats, now: Splats, receipt: Receipt, path: Path, overwrite: bool
) -> tuple[Receipt, Verification]:
    """Write an asset in the format that the name says, read it again, compare it with the original, and only then let
    it and its receipt (NAME.receipt.json) appear. Raises ValueError: the name, an existing file, a full disk;
    RuntimeError: what was written does not prove the receipt."""
    _check_target(path, overwrite)
    receipt_path = path.with_name(path.name + ".receipt.json")
    with _partial_folder(path) as folder:
        partial = Path(folder) / path.name
        write(partial, now)
        proved, found = prove(original, partial, receipt)
        with files.writing(receipt_path) as file:
            file.write(proved.to_json().encode())
            files.replace(partial, path)
    files.sync_folder(path.parent)
    return proved, found


@contextlib.contextmanager
def _partial_folder(path: Path) -> Iterator[str]:
    """A folder beside `path` for what is not complete yet (scratch.sweep_folder knows its name). What goes wrong in the
    block is said of `path`, never of what is in the folder."""
    folder = None
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", suffix=".part", dir=path.parent) as folder:
            yield folder
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    except ValueError as error:
        hidden = f"{folder}{os.sep}"
        if folder is None or hidden not in str(error):
            raise
        raise ValueError(str(error).replace(hidden, f"{path.parent}{os.sep}")) from None


def _check_target(path: Path, overwrite: bool) -> None:
    key = format_of_name(path)
    if key is None or FORMATS[key].write is None or path.name.lower() == "meta.json":
        known = ", ".join(entry.suffixes[0] for entry in FORMATS.values() if entry.write is not None)
        raise ValueError(f"{path}: expected a name ending in {known}")
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder: {path.parent}; make it first")


def view_options(
    path: Path, bits: int | None, transparent: Alpha | None, aovs: tuple[Aov, ...], profile: Profile
) -> PictureOptions:
    """What the ending of a picture's name and the rest ask for. Raises ValueError."""
    ending = path.suffix.lower()
    if ending not in (".png", ".exr"):
        raise ValueError(f"{path}: expected a name ending in .png or .exr")
    return PictureOptions("png" if ending == ".png" else "exr", bits, transparent, aovs, profile)


def view_files_of(
    splats: Splats, touches: Sequence[conflicts.Touch], camera: Camera, stem: str, options: PictureOptions
) -> dict[str, bytes]:
    """A view of a session's rows as files (name -> bytes); its coverage comes from what its layers touched."""
    coverage = None
    if "coverage" in options.aovs:
        kinds = conflicts.coverage(touches, len(splats))
        coverage = (kinds == conflicts.PREDICTED, kinds == conflicts.SEEN)
    return view_files(splats, camera, stem, options, coverage=coverage)


def write_files(folder: Path, made: Mapping[str, bytes], overwrite: bool) -> list[Path]:
    """Write files into a folder, each whole or not at all; returns their paths. Raises ValueError: one exists, ..."""
    paths = [folder / name for name in made]
    for path in paths:
        if path.is_dir() or (path.exists() and not overwrite):
            raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    for path, data in zip(paths, made.values(), strict=True):
        with files.writing(path) as file:
            file.write(data)
    return paths


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
        data = files.read_all(path)
        with zipfile.ZipFile(io.BytesIO(data)) as bundle:
            if sum(info.file_size for info in bundle.infolist()) > len(data):  # they may lie over each other
                raise ValueError("its members claim more bytes than the file has")
            record = json.loads(_member(bundle, "layer.json"))
            if not isinstance(record, dict) or record.get("version") != 1:
                raise ValueError("expected a layer of version 1")
            layer = Layer.parse(record.get("layer") or {}, str(path))
            blobs = {name: _member(bundle, f"{name}.png") for name in layer.blobs()}
    except LAYER_FILE_ERRORS as error:
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
