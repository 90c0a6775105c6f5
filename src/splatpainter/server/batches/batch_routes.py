"""What pages download of a batch, and the events by which they follow it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from pathlib import Path
from urllib.parse import quote

from fastapi import FastAPI
from fastapi.responses import FileResponse, Response, StreamingResponse

from splatpainter.server.batches.batch_runs import StudioBatch
from splatpainter.server.batches.describe_batch import (
    PAGE,
    batch_info,
    job_info,
    picture_file,
    result_file,
    zip_url,
    zipped,
)
from splatpainter.server.hub import Hub, problem_of
from splatpainter.server.protocol import BatchEvent, Problem

PAGE_CSP = "; ".join(
    (
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""The summary page runs no script."""


def add_batch_routes(
    app: FastAPI, hub: Hub, failed: Callable[[Problem, int | None], Response], headers: dict[str, str]
) -> None:
    """Downloads below /api/batch. failed: an answer that says what is wrong; headers: of what may change."""
    studio = hub.studio

    # A batch may be replaced between the page's look and the request, so what is gone is answered in words.
    def existing(id: str, find: Callable[[StudioBatch], Path]) -> Path | Response:
        try:
            path = find(studio.batches.get(id))
            if not path.is_file():
                raise ValueError(f"{path.name}: is gone")
            return path
        except ValueError as error:
            return failed(studio.public_problem(problem_of(error)), 404)

    @app.get("/api/batch/{id}/out/{name}", response_class=Response, summary="A result, its receipt, or the page")
    async def result(id: str, name: str) -> Response:
        path = existing(id, lambda batch: result_file(batch, name))
        if isinstance(path, Response):
            return path
        # The page is ours, but names in it are not: it may run no script.
        if name == PAGE:
            return FileResponse(path, media_type="text/html", headers={**headers, "content-security-policy": PAGE_CSP})
        # Everything else is a download, so that no result is opened by the browser as a document.
        return FileResponse(path, media_type="application/octet-stream", filename=name, headers=headers)

    @app.get("/api/batch/{id}/all.zip", response_class=Response, summary="All results, streamed")
    async def everything(id: str) -> Response:
        try:
            batch = studio.batches.get(id)
            name = f"{batch.title}.zip"
        except ValueError as error:
            return failed(studio.public_problem(problem_of(error)), 404)
        # Names of any language need the second form; the first one is for programs that do not know it.
        disposition = f"attachment; filename=\"batch.zip\"; filename*=UTF-8''{quote(name)}"
        extra = {**headers, "content-disposition": disposition}
        # Streamed: all results together may be larger than memory or disk.
        return StreamingResponse(zipped(batch), media_type="application/zip", headers=extra)

    @app.get(
        "/api/batch/{id}/{number}/{name}", response_class=Response, summary="A small picture: before.webp, after.webp"
    )
    async def picture(id: str, number: int, name: str) -> Response:
        path = existing(id, lambda batch: picture_file(batch, number, name))
        return path if isinstance(path, Response) else FileResponse(path, media_type="image/webp", headers=headers)


def publish_batches(hub: Hub) -> None:
    """Send every client what happens to the studio's batch, from now on. Called on the event loop."""
    loop, studio = asyncio.get_running_loop(), hub.studio

    def changed(batch: StudioBatch | None, number: int | None) -> None:
        # Read before the batch is described: what is described may be newer than the number, never older.
        revision = studio.batches.revision
        if batch is None:
            event = BatchEvent(revision=revision)
        elif number is None:
            # One job's change is sent alone, for a batch may have a thousand.
            event = BatchEvent(revision=revision, batch=batch_info(studio, batch), id=batch.id)
        else:
            job, archive = job_info(studio, batch, number), zip_url(batch)
            event = BatchEvent(revision=revision, id=batch.id, job=job, zip_url=archive)
        # Called from the batch's thread; sockets belong to the loop.
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(hub.publish, event)

    studio.batches.changed = changed
