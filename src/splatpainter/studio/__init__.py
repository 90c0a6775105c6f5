"""The browser studio's server: one session, its HTTP and socket API, and the built front end in static/.

messages/ is the one definition of what travels; web/src/messages.ts is generated from it (schema.py).
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpainter.studio.server import Running as Running


def studio(*args: Any, **kwargs: Any) -> Running:
    """Start the studio in the background: see splatpainter.studio.server.studio, which takes the same arguments."""
    from splatpainter.studio.server import studio as start

    return start(*args, **kwargs)


class _CallableModule(ModuleType):
    """`splatpainter.studio` is this package and, in the public API, the function; see render/__init__.py."""

    def __call__(self, *args: Any, **kwargs: Any) -> Running:
        return studio(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
