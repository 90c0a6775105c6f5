"""Where edited pictures come from. Each source makes `painter.Edit` values; none knows how an edit is applied."""

from __future__ import annotations

from splatpainter.sources.edit_files import FileEdit as FileEdit
from splatpainter.sources.edit_files import edit_from_files as edit_from_files
