"""What can be said of a project file without opening its session: for lists of projects. Knows no Gaussians."""

from __future__ import annotations

import base64
import binascii
import hashlib
from dataclasses import field
from pathlib import Path

from splatpainter.session.project.project_file import Project
from splatpainter.system.quick_dataclass import dataclass

PICTURE_FACT = "picture"
"""Name of the fact that holds a small PNG of the asset as it was left, in base64."""
EDITED_FACT = "edited"
"""Name of the fact that holds when the latest step was made or taken back, seconds since 1970."""
MAX_PICTURE_TEXT = 1 << 18
"""Characters of the former."""


@dataclass(frozen=True)
class ProjectSummary:
    """One project."""

    original_sha256: str
    name: str
    """Name of the original's file; "asset" without one."""
    layers: int
    is_untouched: bool
    """Nothing was done in it: no step, no bookmark, not turned."""
    edited: float
    """When it was last changed, seconds since 1970."""
    id: str
    """By chance, since it was made; copies have it, too. "" of older projects."""
    content: str
    """Hash of the original and of all steps: that of a copy is the same."""
    picture: bytes | None = field(repr=False)
    """PNG of how it looks, if it was drawn, or else of what the uppermost layer edited."""


def summarize(path: Path) -> ProjectSummary | None:
    """The summary of a project file, which another session may have open; None where it cannot be read as it is."""
    try:
        project = Project.open(path, readonly=True)
    except ValueError:
        return None
    try:
        return _summary(project, path)
    except (ValueError, OSError):
        return None
    finally:
        project.close()


def _summary(project: Project, path: Path) -> ProjectSummary:
    steps, cursor = project.steps()
    document = project.document(steps[cursor].id)
    query = "SELECT step, sha256 FROM step_layers JOIN layers ON layers.id = layer ORDER BY step, place"
    sha = project.fact("sha256") or ""
    content = hashlib.sha256(f"{sha} {cursor}".encode())
    # By the texts of the layers: a copy of a project has other times, and the same content.
    for step, layer in project.rows(query, kinds=(int, str)):
        content.update(f" {step} {layer}".encode())
    text = project.fact(PICTURE_FACT) or ""
    picture = None
    if 0 < len(text) <= MAX_PICTURE_TEXT:
        try:
            picture = base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError):
            picture = None
    thumbnails = [layer.thumbnail for layer in document.layers if layer.thumbnail]
    if picture is None and thumbnails:
        picture = project.blob(thumbnails[-1])
    return ProjectSummary(
        sha,
        project.fact("name") or "asset",
        len(document.layers),
        len(steps) == 1 and not project.bookmarks() and not any(map(project.fact, ("up", "front"))),
        _seconds(project.fact(EDITED_FACT), path),
        project.fact("id") or "",
        content.hexdigest(),
        picture,
    )


def _seconds(text: str | None, path: Path) -> float:
    """The fact, or where nothing was done yet the time of the file."""
    try:
        value = float(text or "")
        return value if 0 < value < 1e11 else path.stat().st_mtime
    except ValueError:
        return path.stat().st_mtime
