"""Messages as clients may see them: without the folders of this machine, and without names that only we know."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

SEPARATOR = r"[/\\]+"
FOLDERS = rf"(?:[^/\\\s:'\"]+{SEPARATOR})*"
"""Those below the one for temporary files: all of them are for a while."""
DOWNLOAD = rf"(?:[0-9a-f]{{16}}{SEPARATOR})?"
"""One of storage.Downloads."""
PARTIAL_NAMES = (
    re.compile(r"(?<![\w.])\.([^/\\\s][^/\\]*?)\.[0-9a-z_]{8}\.part\b"),
    re.compile(r"(?<![\w.])\.\d+\.part\.(?=\S)"),
)
"""Names of files before they are whole (atomic.writing, commands.targets.placed)."""
BLOB = re.compile(r"\b([0-9a-f]{64})\.[a-z.]{1,16}\b")
PART = re.compile(r"\b[0-9a-f]{16}\.part\b")
"""Names of uploads (storage.Blobs)."""


def public_text(text: str, folders: Iterable[Path], name_of: Callable[[str], str]) -> str:
    """The text without `folders` and those for temporary files; what lies in them keeps its name. name_of: what the
    owner of an upload calls it, by its SHA-256."""
    temporary = Path(tempfile.gettempdir())
    # A folder may be named by a link and by its real path; both have to go.
    below = {root: DOWNLOAD for root in folders} | {temporary: FOLDERS}
    below |= {root.resolve(): pattern for root, pattern in below.items()}
    # The longest first, or the part below a shorter one would be left standing.
    for root in sorted(below, key=lambda root: len(str(root)), reverse=True):
        # A root folder is in every path and gives nothing away.
        if len(root.parts) > 1:
            text = re.sub(re.escape(str(root)) + SEPARATOR + below[root], "", text)
            text = re.sub(re.escape(str(root)) + r"(?![\w-])", "the studio's folder", text)
    # Names of files that are not whole yet exist for seconds; the user knows the final one.
    for pattern in PARTIAL_NAMES:
        text = pattern.sub(lambda match: match[1] if match.re.groups else "", text)
    text = BLOB.sub(lambda match: name_of(match[1]) or "the upload", text)
    return PART.sub("the upload", text)
