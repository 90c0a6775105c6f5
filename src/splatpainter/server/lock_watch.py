"""The lock of a project that is open elsewhere: whether it was let go of by now, so that windows offer to go on in it.

It is looked at every few seconds: a holder that is killed sends nothing, and network folders send no events.
"""

from __future__ import annotations

import asyncio

from splatpainter.server.hub import Hub, log
from splatpainter.server.protocol import ToastEvent
from splatpainter.server.work_queue import Ticket

LOOK_SECONDS = 2.0
"""Seconds between two looks: about what it takes to close the project there and turn to this window."""


async def watch(hub: Hub, look_seconds: float = LOOK_SECONDS) -> None:
    """Until cancelled. Looks at nothing where the project can be changed."""
    while True:
        await asyncio.sleep(look_seconds)
        # A folder that cannot be reached now may come back.
        try:
            if hub.studio.session.read_only:
                await _look(hub)
        except Exception as error:
            log.warning("the project's lock: %s", error)


async def _look(hub: Hub) -> None:
    studio, before = hub.studio, hub.studio.state
    files = studio.session.files
    holding = await asyncio.to_thread(lambda: (files.can_be_taken_over, files.noted_computer))
    if holding == (before.project.is_free, before.project.noted_computer):
        return
    # Looked at again by the thread that changes the state: by then it may be taken over, or another project be open.
    await hub.queue.run("write", studio.note_lock, Ticket())
    hub.mark_dirty()
    now = studio.state
    if now.session != before.session or not now.project.read_only or now.project.is_free == before.project.is_free:
        return
    if now.project.is_free:
        message, hint = f"{studio.name} is open nowhere else any more.", "Edit here, at the top, goes on in it."
    else:
        message, hint = f"{studio.name} was opened elsewhere again, and stays read only here.", ""
    hub.publish(ToastEvent(level="info", message=message, hint=hint))
