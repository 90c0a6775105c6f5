"""Where the user's programs keep caches and data on this system (platformdirs: XDG folders, Library, AppData)."""

from __future__ import annotations

import os
from pathlib import Path

NAME = "splatpainter"
PROJECTS_VARIABLE = "SPLATPAINTER_PROJECTS"
"""Environment variable: the folder of projects, in place of the one in the user's data folder."""


def cache_folder() -> Path:
    """What can be made again goes here. Linux: $XDG_CACHE_HOME/splatpainter or ~/.cache/splatpainter."""
    import platformdirs  # here, because most processes ask for no folder

    return platformdirs.user_cache_path(NAME, appauthor=False)


def projects_folder() -> Path:
    """Projects that nobody has named yet go here. Linux: splatpainter/projects in $XDG_DATA_HOME or ~/.local/share."""
    named = os.environ.get(PROJECTS_VARIABLE)
    if named:
        return Path(named)
    import platformdirs

    return platformdirs.user_data_path(NAME, appauthor=False) / "projects"
