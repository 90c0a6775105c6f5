"""Files that are to be written: refused before any work where they cannot be, whole or not at all afterwards."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import write_png
from splatpainter.io import FORMATS, Format, asset_file, files, format_of_name
from splatpainter.io.folders import inside
from splatpainter.io.formats.sog_container import META
from splatpainter.system.atomic import (
    MAX_NAME_BYTES,
    brief_name,
    check_name,
    copy_mode,
    is_mounted_read_only,
    write_text,
)
from splatpainter.system.plain_words import reason

RECEIPT_ENDING = ".receipt.json"


def splat_format(path: Path) -> Format:
    """The format that the name of an output asks for. Raises ValueError: unknown, or one that can only be read."""
    key = format_of_name(path)
    names = ", ".join(entry.suffixes[0] for entry in FORMATS.values() if entry.write is not None)
    if key is None:
        raise ValueError(f"{path}: unknown format; expected a name ending in {names}")
    if FORMATS[key].write is None:
        raise ValueError(f"{path}: {FORMATS[key].description}; expected a name ending in {names}")
    return FORMATS[key]


def receipt_of(asset: str | os.PathLike[str]) -> Path:
    """Where the receipt of a file lies by default: beside it, ASSET.receipt.json; of a folder of SOG planes beside the
    folder. A name that leaves no room for the ending is shortened, with a digest in place of the rest."""
    path = Path(asset)
    if path.name.lower() == META:
        path = Path(os.path.abspath(path)).parent
    fits = len(os.fsencode(path.name + RECEIPT_ENDING)) <= MAX_NAME_BYTES
    return path.with_name((path.name if fits else brief_name(path.name)) + RECEIPT_ENDING)


def check_target(path: Path, overwrite: bool, inputs: Sequence[Path] = (), untouchable: Sequence[Path] = ()) -> None:
    """Refuse an output before any work is done. inputs: files that the command reads and may replace; untouchable:
    those that it may not.

    Raises ValueError: it exists (or is an input) and overwrite is False, is untouchable, is no plain file, its name is
    none on this system, its folder is missing or cannot be written to."""
    # What can fail is asked before the work: an hour of fitting should not end at a name.
    check_name(path)
    for source in untouchable:
        if _same(path, source):
            raise ValueError(f"{path}: is an input; choose another name")
    for source in inputs:
        if _same(path, source) and not overwrite:
            raise ValueError(f"{path}: is the input itself; choose another name, or replace it with --overwrite")
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "no plain file"
        raise ValueError(f"{path}: is {what}; expected the name of a file to write")
    if path.exists() and not overwrite:
        raise ValueError(f"{path}: already exists; choose another name, or replace it with --overwrite")
    folder = path.parent
    if path.name.lower() == META and not folder.exists():
        folder = folder.parent  # the folder of planes is made
    if not folder.is_dir():
        if folder.exists():
            raise ValueError(f"{path}: {folder} is a file, not a folder; choose another name")
        raise ValueError(f"{path}: no such folder: {folder}; make it first")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: cannot be written: {_why_not(folder)}")


def check_folder(path: Path) -> None:
    """Refuse a folder for several files before any work is done; it may be missing. Raises ValueError."""
    check_name(path.absolute())
    if path.exists() and not path.is_dir():
        raise ValueError(f"{path}: is a file; expected a folder")
    # Folders on the way may be missing too; the nearest that is there decides.
    above = path
    while not above.exists() and above != above.parent:
        above = above.parent
    if not above.is_dir():
        raise ValueError(f"{path}: cannot be made: {above} is a file")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ValueError(f"{path}: cannot be written: {_why_not(above)}")


def _why_not(folder: Path) -> str:
    """Why nothing can be written into a folder: no permission would send people to chmod where it cannot help."""
    is_read_only = is_mounted_read_only(folder)
    return f"{folder} is on a disk that is mounted read-only" if is_read_only else f"no permission in {folder}"


def make_folder(path: Path) -> None:
    """Make a folder and those above it. Raises ValueError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: cannot be made ({reason(error)})") from None


@contextlib.contextmanager
def made_folder(path: Path) -> Iterator[None]:
    """A folder, made with those above it. Where the block raises, those that were made and are empty are removed: a
    command that is refused leaves nothing. Raises ValueError."""
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    make_folder(path)
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):  # the first that holds something ends it
            for folder in made:
                folder.rmdir()
        raise


@contextlib.contextmanager
def placed(path: Path) -> Iterator[Path]:
    """A name beside `path` of the same format, to write and to check; it becomes `path` when the block ends well and
    is removed otherwise. An existing file keeps its permissions, a link keeps pointing where it points."""
    # Beside the target, as a rename is one step within a file system; of a SOG folder the folder itself is moved.
    target = Path(os.path.realpath(path))
    is_folder = target.name.lower() == META
    final = target.parent if is_folder else target
    partial = final.with_name(f".{os.getpid()}.part.{brief_name(final.name, keep_ending=True)}")  # it says the format
    try:
        if is_folder:
            make_folder(partial)
        yield partial / META if is_folder else partial
        try:
            # A folder cannot replace one that has files in it: they are moved in one by one.
            if is_folder and final.exists():
                _move_into(partial, final)
            else:
                if final.exists():
                    copy_mode(final, partial)
                files.replace(partial, final)
                files.sync_folder(final.parent)
        except OSError as error:
            raise ValueError(f"{path}: cannot be written ({reason(error)})") from None
    except ValueError as error:  # the user knows the name that was asked for
        requested = path.parent if is_folder else path
        raise ValueError(str(error).replace(str(partial), str(requested))) from None
    finally:
        if partial.is_dir():
            shutil.rmtree(partial, ignore_errors=True)
        else:
            files.remove(partial)


def _move_into(partial: Path, final: Path) -> None:
    """Planes first, the meta.json that names them last; what is there keeps the capitals of its name."""
    for file in sorted(partial.iterdir(), key=lambda file: file.name == META):
        files.replace(file, inside(final, file.name))
    files.sync_folder(final)


def save_picture(path: Path, pixels: np.ndarray, camera: Camera | None = None) -> None:
    """A PNG of [H, W, 3] display colours; with its camera inside and in the sidecar NAME.json, if there is one.
    Raises ValueError."""
    write_png(path, pixels, camera)
    if camera is not None:
        write_text(path.with_suffix(".json"), camera.to_json() + "\n")


def _same(a: Path, b: Path) -> bool:
    """Whether two names mean one asset; a SOG folder is its meta.json, a trainer's folder its last iteration."""
    try:
        a, b = (path / META if path.is_dir() else path for path in map(asset_file, (a, b)))
        return os.path.samefile(a, b)
    except (OSError, ValueError):
        return False
