"""The watched folder: a picture that is saved there is offered to every client as an edit.

What is wrong with one file is sent to the clients, and the watch goes on.
"""

from __future__ import annotations

import asyncio
import os
import stat
from collections.abc import Callable
from pathlib import Path

from splatpainter.io import files
from splatpainter.server.commands.context import naming_errors
from splatpainter.server.hub import Hub, log, problem_of
from splatpainter.server.protocol import PictureEvent, ToastEvent
from splatpainter.server.storage import StoredBlob
from splatpainter.server.studio import Studio
from splatpainter.sources.picture_reader import read_picture

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".psd", ".psb", ".ora", ".kra")
QUIET_MS = 300
"""Without a change, after which a file counts as saved."""
RETRY_SECONDS = 5.0
"""Seconds after the watch itself failed (the folder is gone, too many watches), until it is tried again."""


async def watch(hub: Hub, retry_seconds: float = RETRY_SECONDS) -> None:
    """Until cancelled; at once where the studio has no folder."""
    studio = hub.studio
    if studio.folder is None:
        return
    from watchfiles import Change, awatch

    last_warning = ""
    while True:
        try:
            async for changes in awatch(studio.folder.root, recursive=False, step=QUIET_MS, debounce=10 * QUIET_MS):
                names = sorted({Path(path).name for change, path in changes if change != Change.deleted})
                for name in names:
                    await offer(hub, name)
        except Exception as error:
            log.warning("the watched folder: %s", error)
            text = f"The folder {studio.folder.root.name} cannot be watched."
            if text != last_warning:
                hub.publish(ToastEvent(level="warning", message=text, hint="Drop pictures into the page instead."))
            last_warning = text
        await asyncio.sleep(retry_seconds)


async def offer(hub: Hub, name: str, read: Callable[[Studio, str], StoredBlob | None] | None = None) -> None:
    """Offer the file of that name to every client, or say what is wrong with it. Raises nothing. read: default
    saved_picture."""
    title = name.encode("utf-8", "replace").decode()  # names need not be text
    try:
        blob = await asyncio.to_thread(read or saved_picture, hub.studio, name)
        if blob is not None:
            hub.publish(PictureEvent(picture=blob.sha256, name=title[:200]))
    except FileNotFoundError:
        pass  # it was there for a moment only
    except Exception as error:
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
    if studio.folder is None or name.startswith(".") or not name.lower().endswith(SUFFIXES):
        return None
    try:
        status = (studio.folder.root / name).stat()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror or error})") from None
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("expected a picture, got a folder, a pipe or a device")
    path = studio.folder.file(name)
    limit = studio.options.limits.picture
    if status.st_size > limit:
        raise ValueError(f"expected at most {limit >> 20} MiB")
    data = files.read_all(path)
    sha256 = files.sha256(data)
    if studio.written.get(name) == sha256:
        return None
    blob = studio.blobs.put(data, name)
    if blob.info.kind != "picture":
        raise ValueError("expected a picture")
    with naming_errors(blob.path, name):
        read_picture(blob.path, inks=False)  # half a file has a whole header
    studio.written[name] = sha256
    return blob
