"""Pictures as users have them: read with what they state of their colours, their view found, letters drawn."""

from __future__ import annotations

from splatpainter.pictures.edit_files import PictureFile as PictureFile
from splatpainter.pictures.edit_files import edit_from_files as edit_from_files
