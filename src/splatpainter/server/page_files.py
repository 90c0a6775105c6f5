"""The files of the built page, served: as they are in a checkout, and packed by gzip (NAME.gz) in wheels, where they
take a quarter of the room."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

from splatpainter.server.packed_files import PACKED, STATIC


class PageFiles(StaticFiles):
    """Serves NAME from NAME.gz where only that is there: as it is to browsers, unpacked to who does not take gzip."""

    def __init__(self, directory: Path = STATIC) -> None:
        super().__init__(directory=directory, html=True)

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        plain = super().lookup_path(path)
        # Plain first, as in `page_file`; only wheels have the packed file alone.
        return plain if plain[1] is not None else super().lookup_path(path + PACKED)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        response = super().file_response(full_path, stat_result, scope, status_code)
        path = Path(full_path)
        # A .gz that was asked for by its name is a file like any other.
        if path.suffix != PACKED or scope["path"].endswith(PACKED):
            return response
        # Unpacked here for the few programs that take no gzip: wheels hold no second copy.
        if not _takes_gzip(Headers(scope=scope).get("accept-encoding", "")):
            return Response(gzip.decompress(path.read_bytes()), status_code, media_type=response.media_type)
        # Caches between must keep the two forms apart.
        response.headers["content-encoding"] = "gzip"
        response.headers["vary"] = "accept-encoding"
        return response


def _takes_gzip(accepted: str) -> bool:
    """Of the header accept-encoding; q=0 says no."""
    words = [word.replace(" ", "").lower().split(";q=") for word in accepted.split(",")]
    return any(name[0] in ("gzip", "*") and not (name[1:] and not float(name[1] or 0)) for name in words)
