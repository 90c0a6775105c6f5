"""The studio's commands by topic, each with its message, its answer and the function that does it."""

from __future__ import annotations

from splatpainter.server.commands import batch as _batch  # noqa: F401 - each registers its commands
from splatpainter.server.commands import color_grading as _color_grading  # noqa: F401
from splatpainter.server.commands import decals as _decals  # noqa: F401
from splatpainter.server.commands import exports as _exports  # noqa: F401
from splatpainter.server.commands import files as _files  # noqa: F401
from splatpainter.server.commands import filling as _filling  # noqa: F401
from splatpainter.server.commands import layer_options as _layer_options  # noqa: F401
from splatpainter.server.commands import layers as _layers  # noqa: F401
from splatpainter.server.commands import lighting as _lighting  # noqa: F401
from splatpainter.server.commands import painting as _painting  # noqa: F401
from splatpainter.server.commands import picture_check as _picture_check  # noqa: F401
from splatpainter.server.commands import relief as _relief  # noqa: F401
from splatpainter.server.commands import scene_assets as _scene_assets  # noqa: F401
from splatpainter.server.commands import selection as _selection  # noqa: F401
from splatpainter.server.commands import source_edit as _source_edit  # noqa: F401
from splatpainter.server.commands import surface as _surface  # noqa: F401
from splatpainter.server.commands import turntables as _turntables  # noqa: F401
from splatpainter.server.commands import viewing as _viewing  # noqa: F401
from splatpainter.server.commands.context import HANDLERS as HANDLERS
from splatpainter.server.protocol import Cancel, Command, Hello, Sync

COMMANDS: dict[str, type[Command]] = {kind.NAME: kind for kind in (Hello, Sync, Cancel, *HANDLERS)}
"""What `do` says -> the class of the command."""
