"""`splatpainter watch`: a folder, an asset and a result that follows the pictures that are saved in the folder."""

from __future__ import annotations

import os
import time
from dataclasses import field
from pathlib import Path
from typing import Annotated

from splatpainter.commands import Outcome
from splatpainter.commands.parts.asset_doubts import warn_of_doubts
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.option_parsing import AxesOption, InAxesOption
from splatpainter.commands.parts.terminal import complain, count, decibels, warn
from splatpainter.gatekeeper.photographs import laid_over, picture_edit
from splatpainter.gatekeeper.picture_gate import checked_picture
from splatpainter.io import axes_news, files, read, write
from splatpainter.output_paths import check_target, placed, receipt_of, splat_format
from splatpainter.painter import MAX_VIEWS, Asset, Method, Mode, Painter
from splatpainter.pictures import PictureFile
from splatpainter.pictures.saved_pictures import LOOK_SECONDS, SavedPictures
from splatpainter.receipts import prove
from splatpainter.splats import Splats
from splatpainter.system.atomic import clash
from splatpainter.system.quick_dataclass import dataclass

MASK_ENDING = ".mask.png"
"""view_000.mask.png is the mask of view_000.png: what is not black was edited."""
SIDE_FILES = (".mask.", ".reference_", ".depth.", ".normal.", ".alpha.", ".gaussian-ids.", ".coverage.")
"""Parts of names of pictures that are no edits."""


@dataclass(frozen=True)
class Config:
    """Lift every edited picture that is saved into a folder onto an asset. OUT and its receipt are written again
    after each save, whole or not at all; all pictures count, each as last saved, in the order of their first save.
    Ctrl-C ends it.

    Pictures carry their camera, as those of splatpainter render do, or have it beside them (NAME.json); NAME.mask.png
    says what of NAME.png was edited. Photographs of the capture in whose folder ASSET lies need no camera but their
    name. What is in the folder at the start counts once it is saved again. Folders in DIR are watched, too.

    example:
      splatpainter watch views --asset vase.ply --out painted.ply

    (views made by splatpainter render vase.ply --out views; paint on them in any editor)
    """

    folder: Annotated[Positional[Path], Argument(metavar="DIR")]
    """The folder to watch."""
    asset: Annotated[Path, Argument(metavar="ASSET")]
    """The splat file that the pictures show; it is not changed."""
    out: Annotated[Path, Argument(metavar="OUT")]
    """The file to write; its name says the format. It must lie outside of DIR or not be a picture."""
    mode: Mode = "local"
    """local: only what was painted changes. global: a regraded or relit picture changes the whole asset."""
    correct: bool = False
    """Put pictures right first, as in splatpainter edit."""
    force: bool = False
    """Paint with pictures that differ from their view everywhere as they are."""
    method: Method = "auto"
    """Method of the edit, as in splatpainter edit."""
    preset: Annotated[str, Argument(metavar="NAME|DIR")] = "auto"
    """Weights, as in splatpainter edit."""
    in_axes: InAxesOption = "auto"
    """Axes of ASSET's numbers."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers."""
    receipt: Annotated[Path | None, Argument(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    once: bool = False
    """End after the first picture that was lifted."""
    timeout: Annotated[float | None, Argument(metavar="SECONDS", help_behavior_hint="")] = None
    """End after so many seconds; an error where nothing was lifted until then."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist at the start."""
    json: bool = False
    """Print one JSON object at the end instead of text."""


@dataclass
class _Watch:
    """The state of one watch."""

    config: Config
    receipt_path: Path
    splats: Splats
    painter: Painter
    asset: Asset
    edits: dict[str, PictureFile] = field(default_factory=dict)
    """File name in the folder -> the picture as it was saved last."""
    lifted: int = 0
    refused: int = 0
    last_line: str = ""

    def save(self, path: Path) -> None:
        """Lift a picture that was saved, or say in a line why not; the result stays as it was then."""
        # A picture that cannot be lifted must not end the watch: it will be saved again.
        try:
            edit = self._edit(path)
            # The result is of all pictures, so a failed one is taken back and the others stay as they were.
            edits_before = dict(self.edits)
            self.edits[self._name(path)] = edit
            try:
                line = self._write()
            except BaseException:
                self.edits = edits_before
                raise
        except (ValueError, OSError, MemoryError) as error:
            self.refused += 1
            text = str(error) or type(error).__name__
            complain(text if path.name in text else f"{path}: {text}")
            return
        self.lifted += 1
        self.last_line = line
        # With --json there is one object at the end, and no lines before it.
        if not self.config.json:
            print(line, flush=True)

    def _name(self, path: Path) -> str:
        return path.relative_to(self.config.folder).as_posix()

    def _edit(self, path: Path) -> PictureFile:
        # More pictures than an edit takes: from here on OUT is the asset to go on with.
        if self._name(path) not in self.edits and len(self.edits) >= MAX_VIEWS:
            raise ValueError(f"{path}: more than {MAX_VIEWS} pictures; go on with OUT as the new ASSET")
        mask = path.with_name(path.stem + MASK_ENDING)
        folder = self.config.asset.parent
        # The same way as `edit` finds cameras, masks and photographs, so that both agree.
        edit = picture_edit(
            path,
            mask=mask if mask.is_file() else None,
            asset=self.config.asset,
            folders=(self.config.folder, folder, folder / "views"),
        )
        made_for = edit.camera.asset_sha256
        # Only a picture that names another asset is refused; one that names none may be right.
        if made_for is not None and self.splats.sha256 is not None and made_for != self.splats.sha256:
            raise ValueError(f"{path}: was rendered from another asset (sha256 {made_for[:12]}...)")
        policy = "correct" if self.config.correct else "force" if self.config.force else "refuse"
        # Photographs are laid over their views first, for the gate compares picture and view.
        painted = laid_over(edit, self.splats, self.config.mode)
        checked = checked_picture(painted, self.splats, self.config.mode, policy)
        if checked.warning:
            warn(checked.warning)
        return checked.source

    def _write(self) -> str:
        """All pictures onto the asset, and OUT and the receipt; a line that says so."""
        config = self.config
        # All pictures on the first asset, and not the last one on the result: each counts as it was saved last.
        edits = [edit.edit(self.splats, config.mode) for edit in self.edits.values()]
        edited = self.painter.apply(self.asset, edits, config.mode, config.method)
        assert edited.receipt is not None
        # File and receipt appear together: a program that follows OUT must not see one without the other.
        with files.writing(self.receipt_path) as file, placed(config.out) as partial:
            write(partial, edited.splats, axes=config.axes)
            receipt, verification = prove(self.splats, partial, edited.receipt, config.axes, edited.splats)
            # On the disk before OUT has its name.
            file.write(receipt.to_json().encode())
            file.flush()
            os.fsync(file.fileno())
        latest = next(reversed(self.edits.values()))
        score = decibels(receipt.views[-1].psnr_after) if receipt.views else "no pixels"
        return (
            f"{self._name(latest.path)}: {count(len(self.edits), 'picture')} on {config.out}, "
            f"{count(len(receipt.touched), 'Gaussian')} changed, {receipt.appended_rows:,} appended, "
            f"{score} against the last; {verification.same:,} the same, verified"
        )


def run(config: Config) -> Outcome:
    """Watch until Ctrl-C, `once` or `timeout`. Raises ValueError: options, an asset that cannot be read, a folder that
    is gone; with a timeout also where nothing was lifted."""
    receipt_path = config.receipt or receipt_of(config.out)
    # Options and names before weights and assets are loaded.
    _check(config, receipt_path)
    painter = Painter.load(config.preset, modes=[config.mode]).with_settings(aside=True)
    # What is in the folder now was there before and is no edit.
    saved = SavedPictures(config.folder)
    splats = read(config.asset, axes=config.in_axes)
    # Doubts of the asset are told once, and not with every picture.
    warn_of_doubts(splats, config.asset, editing=True)
    watch = _Watch(config, receipt_path, splats, painter, painter.encode(splats, config.method, [config.mode]))
    # The asset is encoded once: every save edits it anew from there.
    until = None if config.timeout is None else time.monotonic() + config.timeout
    if not config.json:
        print(*axes_news(splats), f"watching {config.folder}; Ctrl-C ends it", sep="\n", flush=True)
    ended = "timeout"
    try:
        # Looked at again and again: not every file system tells of changes.
        while until is None or time.monotonic() < until:
            for path in saved.take():
                # Files that belong to a picture, and OUT itself, are no edits.
                if any(part in path.name for part in SIDE_FILES) or _same(path, config.out):
                    continue
                watch.save(path)
                if config.once and watch.lifted:
                    break
            if config.once and watch.lifted:
                ended = "once"
                break
            time.sleep(LOOK_SECONDS)
    except KeyboardInterrupt:
        ended = "interrupted"
    # A script that waits for a picture wants to know that none came.
    if ended == "timeout" and not watch.lifted:
        raise ValueError(f"splatpainter watch: no picture was lifted within {config.timeout:g} seconds")
    record = {
        "out": config.out if watch.lifted else None,
        "receipt_file": receipt_path if watch.lifted else None,
        "pictures": list(watch.edits),
        "lifted": watch.lifted,
        "refused": watch.refused,
        "ended": ended,
    }
    refused = f", {count(watch.refused, 'picture')} refused" if watch.refused else ""
    return Outcome(record, [f"ended: {count(watch.lifted, 'save')} lifted{refused}"])


def _check(config: Config, receipt_path: Path) -> None:
    if not config.folder.is_dir():
        raise ValueError(f"{config.folder}: no such folder; expected the folder to watch")
    # Opposite ways to treat a picture that differs everywhere.
    if config.correct and config.force:
        raise ValueError("splatpainter watch: expected one of --correct and --force")
    if config.timeout is not None and not config.timeout > 0:
        raise ValueError(f"splatpainter watch: expected --timeout of more than 0 seconds, got {config.timeout:g}")
    splat_format(config.out)
    # OUT and the receipt are written many times; what they may replace is settled once.
    check_target(config.out, config.overwrite, [], [config.asset])
    check_target(receipt_path, config.overwrite, [], [config.asset])
    if clash(receipt_path, config.out):
        raise ValueError(f"{receipt_path}: OUT and the receipt need different names, not only in upper and lower case")


def _same(a: Path, b: Path) -> bool:
    return os.path.abspath(a) == os.path.abspath(b)
