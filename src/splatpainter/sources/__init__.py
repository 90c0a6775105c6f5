"""Where edited pictures come from. Each source makes `painter.Edit` values; none knows how an edit is applied."""

from __future__ import annotations

from splatpainter.sources.files import FileEdit as FileEdit
from splatpainter.sources.files import edit_from_files as edit_from_files
