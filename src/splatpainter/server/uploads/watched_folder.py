"""The watched folder: a picture that is saved there, or in a folder in it, is offered to every client as an edit.

The folder is looked at every moment, as `splatpainter watch` does it: network folders, and those that a virtual machine
shares, send no events.

What is wrong with one file is sent to the clients, and the watch goes on.
"""

from __future__ import annotations

import asyncio
import os
import stat
import time
from collections.abc import Callable

from splatpainter.io import files
from splatpainter.pictures.picture_reader import PICTURE_SUFFIXES, read_picture
from splatpainter.pictures.saved_pictures import SavedPictures
from splatpainter.pictures.view_search import same_shape, views_in
from splatpainter.server.commands.context import naming_errors
from splatpainter.server.hub import Hub, log, problem_of
from splatpainter.server.protocol import PictureEvent, ToastEvent
from splatpainter.server.studio import Studio
from splatpainter.server.uploads.storage import Folder, StoredBlob
from splatpainter.system.jsonio import load_object

LOOK_SECONDS = 0.2
"""Seconds between two looks at the folder, at least."""
REST_PER_LOOK = 9.0
"""Pause after a look, in times of what it took: a large folder far away must not keep the studio busy."""
RETRY_SECONDS = 5.0
"""Seconds after the watch itself failed (the folder is gone, it has too many pictures), until it is tried again."""


async def watch(hub: Hub, retry_seconds: float = RETRY_SECONDS) -> None:
    """Until cancelled; at once where the studio has no folder."""
    studio = hub.studio
    if studio.folder is None:
        return
    saved, last_warning = None, ""
    # A folder that cannot be watched now may come back: another disk, a network.
    while True:
        began = time.monotonic()
        try:
            # Made anew after a failure, so that what is there then is no news.
            if saved is None:
                saved = await asyncio.to_thread(SavedPictures, studio.folder.root)
            for path in await asyncio.to_thread(saved.take):
                await offer(hub, saved.name_of(path))
        except Exception as error:
            log.warning("the watched folder: %s", error)
            text = f"The folder {studio.folder.root.name} cannot be watched."
            # Once for each reason and not every few seconds.
            if text != last_warning:
                hub.publish(ToastEvent(level="warning", message=text, hint="Drop pictures into the page instead."))
            last_warning = text
            await asyncio.sleep(retry_seconds)
        else:
            last_warning = ""
            await asyncio.sleep(max(LOOK_SECONDS, REST_PER_LOOK * (time.monotonic() - began)))


async def offer(hub: Hub, name: str, read: Callable[[Studio, str], StoredBlob | None] | None = None) -> None:
    """Offer the file of that name in the folder ("a.png", "final/a.png") to every client, or say what is wrong with it.
    Raises nothing. read: default saved_picture."""
    # Whatever is wrong with one file, the watch goes on.
    title = name.encode("utf-8", "replace").decode()  # names need not be text
    try:
        blob = await asyncio.to_thread(read or saved_picture, hub.studio, name)
        if blob is not None:
            hub.publish(PictureEvent(picture=blob.sha256, name=title[:200]))
    except FileNotFoundError:
        pass  # it was there for a moment only
    except Exception as error:
        # A file that is gone again, as programs write beside and rename, is no fault of anybody's.
        folder = hub.studio.folder
        if folder is None or not os.path.lexists(folder.root / name):
            return
        problem = hub.studio.public_problem(problem_of(error))
        text = problem.message.removeprefix(f"{title}: ")
        hub.publish(ToastEvent(level="warning", message=f"{title[:200]}: {text}"[:400], hint=problem.hint))


def saved_picture(studio: Studio, name: str) -> StoredBlob | None:
    """The picture in the folder, None where the file is no picture by its name, or is what the studio wrote there or
    offered before. Raises FileNotFoundError where it is gone; ValueError: no regular file, too large, no whole
    picture."""
    # Hidden files are how programs write before they rename.
    hidden = any(part.startswith(".") for part in name.split("/"))
    if studio.folder is None or hidden or not name.lower().endswith(PICTURE_SUFFIXES) or _is_aov(studio.folder, name):
        return None
    try:
        status = (studio.folder.root / name).stat()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror or error})") from None
    # A pipe would be waited for without end.
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("expected a picture, got a folder, a pipe or a device")
    path = studio.folder.within(name)
    limit = studio.options.limits.picture
    if status.st_size > limit:
        raise ValueError(f"expected at most {limit >> 20} MiB")
    data = files.read_all(path)
    sha256 = files.sha256(data)
    # What the studio wrote there itself, or offered already, is no edit.
    if studio.written.get(name) == sha256:
        return None
    blob = studio.blobs.put(data, path.name)
    if blob.info.kind == "sky" and not _has_a_views_shape(studio, name, (blob.info.width, blob.info.height)):
        raise ValueError(
            "twice as wide as high, without a camera, and of no view's shape: a sky, for Light, Sky from a file; a "
            "painted view keeps its shape"
        )
    if blob.info.kind not in ("picture", "sky"):
        raise ValueError("expected a picture")
    # Whole or not: only reading all of it tells.
    with naming_errors(blob.path, name):
        read_picture(blob.path, inks=False)  # half a file has a whole header
    studio.written[name] = sha256
    return blob


def _has_a_views_shape(studio: Studio, name: str, size: tuple[int, int]) -> bool:
    """Whether a picture has the shape of a view that was exported, or of one in its folder or the watched one."""
    assert studio.folder is not None
    root = studio.folder.root
    at = root / name
    exported = any(same_shape(size, (export.camera.width, export.camera.height)) for export in studio.exports)
    return exported or bool(views_in([at.parent, root], size, besides=at))


def _is_aov(folder: Folder, name: str) -> bool:
    """Whether the view that a file is named after lists it as one of its AOVs, as `render --aov` writes them."""
    above, _, last = name.rpartition("/")
    stem = last.split(".")[0]
    try:
        path = folder.within(f"{above}/{stem}.json" if above else f"{stem}.json")
        aovs = load_object(files.read_all(path), path, "a view").get("aov")
    except (ValueError, OSError):
        return False
    entries = aovs.values() if isinstance(aovs, dict) else ()
    return any(isinstance(entry, dict) and entry.get("file") == last for entry in entries)
