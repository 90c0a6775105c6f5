"""Files of the page that are packed, as wheels have them: served to browsers as they are, unpacked to others."""

from __future__ import annotations

import asyncio
import gzip
import re
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from starlette.applications import Starlette

from splatpainter.server.packed_files import page_file
from splatpainter.server.page_files import PageFiles

SCRIPT, PLAIN = b"export const answer = 42;\n" * 40, b"<!doctype html>"


@pytest.fixture
def get(tmp_path: Path) -> Callable[..., httpx.Response]:
    (tmp_path / "index.html").write_bytes(PLAIN)
    (tmp_path / "engine.js.gz").write_bytes(gzip.compress(SCRIPT, mtime=0))
    (tmp_path / "archive.gz").write_bytes(b"as it is")
    app = Starlette()
    app.mount("/", PageFiles(tmp_path))

    async def answer(path: str, **headers: str) -> httpx.Response:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://studio") as client:
            return await client.get(path, headers=named)

    return lambda path, **headers: asyncio.run(answer(path, **headers))


def test_browsers_get_the_packed_bytes_of_the_script_that_they_asked_for(get: Callable[..., httpx.Response]):
    answer = get("/engine.js", accept_encoding="deflate, gzip;q=0.5")
    assert answer.content == SCRIPT, "unpacked by the client"
    assert answer.headers["content-encoding"] == "gzip" and answer.headers["vary"] == "accept-encoding"
    assert answer.headers["content-type"].split(";")[0] in ("text/javascript", "application/javascript")
    assert int(answer.headers["content-length"]) < len(SCRIPT) / 4
    again = get("/engine.js", accept_encoding="gzip", if_none_match=answer.headers["etag"])
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("accepted", ["identity", "br, gzip;q=0", ""])
def test_others_get_it_unpacked(accepted: str, get: Callable[..., httpx.Response]):
    answer = get("/engine.js", accept_encoding=accepted)
    assert answer.content == SCRIPT and "content-encoding" not in answer.headers
    assert answer.headers["content-type"].split(";")[0] in ("text/javascript", "application/javascript")


def test_files_that_are_there_are_served_as_they_are(get: Callable[..., httpx.Response]):
    assert get("/").content == get("/index.html").content == PLAIN
    answer = get("/archive.gz", accept_encoding="identity")
    assert answer.content == b"as it is"
    assert get("/missing.js").status_code == get("/..%2Fx.js").status_code == 404


def test_exports_read_packed_scripts(tmp_path: Path):
    (tmp_path / "viewer.js.gz").write_bytes(gzip.compress(SCRIPT))
    assert page_file(tmp_path / "viewer.js") == SCRIPT
    with pytest.raises(FileNotFoundError):
        page_file(tmp_path / "engine.js")


def test_fill_is_what_comes_behind_something_and_no_light() -> None:
    """What buttons, sliders and headings of the page say."""
    sources = (Path(__file__).resolve().parents[2] / "web/src/ui").glob("*.tsx")
    texts = [source.read_text(encoding="utf-8") for source in sources]
    labels = [label for text in texts for label in re.findall(r'\b(?:label|text|title)="([^"]+)"', text)]
    fills = [label for label in labels if re.search(r"\bfill\b", label, re.IGNORECASE)]
    assert "Remove and fill" in fills and len(labels) > 100
    assert not [label for label in fills if re.search("light|sun|lamp", label, re.IGNORECASE)]
