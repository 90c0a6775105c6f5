"""The watched folder: a picture that is saved there is offered to every client as an edit."""

from __future__ import annotations

import asyncio
from pathlib import Path

from splatpainter.io import files
from splatpainter.sources.pictures import read_picture
from splatpainter.studio.blobs import Blob
from splatpainter.studio.core import Studio
from splatpainter.studio.hub import Hub
from splatpainter.studio.messages.connection import PictureEvent

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
QUIET = 300
"""Milliseconds without a change, after which a file counts as saved."""


async def watch(hub: Hub) -> None:
    """Until cancelled; at once where the studio has no folder."""
    studio = hub.studio
    if studio.folder is None:
        return
    from watchfiles import Change, awatch

    async for changes in awatch(studio.folder.root, recursive=False, step=QUIET, debounce=10 * QUIET):
        names = sorted({Path(path).name for change, path in changes if change != Change.deleted})
        for name in names:
            blob = await asyncio.to_thread(saved_picture, studio, name)
            if blob is not None:
                hub.publish(PictureEvent(picture=blob.sha256, name=name))


def saved_picture(studio: Studio, name: str) -> Blob | None:
    """The picture in the folder, if it is one, whole, and not what the studio wrote there or offered before."""
    if studio.folder is None or not name.lower().endswith(SUFFIXES):
        return None
    try:
        place = studio.folder.file(name)
        if place.stat().st_size > studio.options.limits.picture:
            return None
        data = files.read_all(place)
        sha256 = files.sha256(data)
        if studio.written.get(name) == sha256:
            return None
        blob = studio.blobs.put(data, name)
        if blob.claim.kind != "picture":
            return None
        read_picture(blob.path)  # half a file has a whole header
    except (ValueError, OSError):
        return None  # not (yet) a picture: the next change of the file says more
    studio.written[name] = sha256
    return blob
