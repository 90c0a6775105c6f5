"""A person with any 2D program as a source: the view, its camera and what is asked lie in a folder; the picture that is
saved there is the answer.

    DIR/view_000.png         the view, with its camera inside; save over it, or beside it as view_000-anything.png
    DIR/view_000.txt         the prompt
    DIR/view_000.mask.png    white may change, where there is a mask
    DIR/view_000.reference_0.png, and so on
"""

from __future__ import annotations

import re
import time
from pathlib import Path

from splatpainter.pictures.saved_pictures import LOOK_SECONDS, SavedPictures
from splatpainter.sources.answer_pictures import image_png, mask_png, read_answer_file, reference_png
from splatpainter.sources.picture_source import (
    CancelFlag,
    Capabilities,
    PictureAnswer,
    PictureRequest,
    Progress,
    SourceCancelled,
    SourceError,
)
from splatpainter.sources.source_options import SourceDescription, option
from splatpainter.system.atomic import writing
from splatpainter.system.quick_dataclass import dataclass

MAX_VIEWS = 100_000
"""Names view_000 ... that are tried."""
CAPABILITIES = Capabilities(prompt=True, mask=True, references=16, max_side_px=8192)


@dataclass(frozen=True)
class WatchOptions:
    """Options of the source `watch`."""

    folder: Path = option("Folder where the view is put and the picture is awaited; made if missing")
    timeout: float = option("Seconds to wait for a picture", 3600.0, least=0.1)


DESCRIPTION = SourceDescription(
    name="watch",
    summary="a person: the view waits in a folder until its edited picture is saved there",
    options=WatchOptions,
    capabilities=CAPABILITIES,
)


def open_source(options: WatchOptions) -> WatchSource:
    """Raises SourceError: a folder that cannot be."""
    return WatchSource(options)


class WatchSource:
    """One folder."""

    name = "watch"
    capabilities = CAPABILITIES

    def __init__(self, options: WatchOptions) -> None:
        self.options = options
        try:
            options.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise SourceError(f"source watch: {options.folder}: cannot be made ({error.strerror})") from None

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """Wait for one picture. What cannot be read is said in `progress`, and waited on. Raises SourceError: nothing
        in time; SourceCancelled."""
        # The folder is looked at before the view is put there: what is in it already is no answer.
        try:
            saved = SavedPictures(self.options.folder)
            stem, sent = self._put(request)
            # Our own files are no answers until somebody saves over them.
            for name in sent:
                saved.seen(self.options.folder / name)
            return self._await(stem, sent, saved, progress, cancel)
        except SourceError:
            raise
        except (ValueError, OSError) as error:
            raise SourceError(f"source watch: {error}") from None

    def _put(self, request: PictureRequest) -> tuple[str, dict[str, bytes]]:
        """(stem, file name -> contents) as they lie in the folder: under a new name, the view itself last."""
        folder = self.options.folder
        # Taken by making a file: of two that watch one folder only one gets the name.
        stem = next((name for name in map("view_{:03d}".format, range(MAX_VIEWS)) if _reserve(folder, name)), None)
        if stem is None:
            raise SourceError(f"source watch: {folder}: is full; remove the views that are done")
        # The view comes last, when all that belongs to it is there: its appearance is the sign to begin.
        contents = {f"{stem}.mask.png": mask_png(request)} if request.mask is not None else {}
        for index, picture in enumerate(request.references):
            contents[f"{stem}.reference_{index}.png"] = reference_png(picture)
        contents[f"{stem}.png"] = image_png(request)
        if request.camera is not None:
            contents = {f"{stem}.json": request.camera.to_json().encode() + b"\n", **contents}
        contents = {f"{stem}.txt": (request.prompt + "\n").encode(), **contents}
        # Whole or not at all, for a painting program may open them at once.
        for name, data in contents.items():
            with writing(folder / name) as file:
                file.write(data)
        return stem, contents

    def _await(
        self, stem: str, sent: dict[str, bytes], saved: SavedPictures, progress: Progress, cancel: CancelFlag
    ) -> PictureAnswer:
        view = self.options.folder / f"{stem}.png"
        until, problem = time.monotonic() + self.options.timeout, ""
        progress(0.0, f"waiting for {view}")
        while True:
            for path in saved.take():
                # Whatever begins with the name counts, so that "save as" may add to it; view_0001 is another view.
                ours = path.parent == view.parent and path.name in sent
                if not re.match(rf"{stem}(?!\d)", path.name) or (ours and path != view):
                    continue
                try:
                    # A file that was only touched is no answer yet.
                    if path.read_bytes() == sent[view.name]:
                        continue
                    image, notes = read_answer_file(path, "watch")
                except (SourceError, OSError) as error:
                    # Often half written: said, and waited on, until it can be read.
                    problem = f"{path.name}: {str(error).removeprefix('source watch: its picture: ')}"
                    progress(0.0, problem)
                else:
                    return PictureAnswer(image, model=f"saved as {path.name}", notes=notes)
            if cancel.is_set():
                raise SourceCancelled
            if time.monotonic() > until:
                last = f"; the last one could not be read: {problem}" if problem else ""
                raise SourceError(
                    f"source watch: no picture was saved as {view} within {self.options.timeout:g} seconds{last}"
                )
            time.sleep(LOOK_SECONDS)


def _reserve(folder: Path, stem: str) -> bool:
    """Whether this process took the name; two that watch one folder do not share a view."""
    # A view that lies there is somebody's work.
    if (folder / f"{stem}.png").exists():
        return False
    try:
        with open(folder / f"{stem}.txt", "x", encoding="utf-8"):
            return True
    except FileExistsError:
        return False
