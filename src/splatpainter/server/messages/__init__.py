"""The studio's protocol, defined once: commands, their answers, events. web/src/messages.ts is generated from here.

Over the socket /ws a client sends {"id": n, "do": NAME, ...fields} and gets, for the same n, first any number of
{"re": n, "progress": 0..1, "stage": "..."} and then one of
  {"re": n, "ok": true, "python": "...", "version": v, ...fields of the answer}
  {"re": n, "ok": false, "error": {"kind", "message", "hint"}}.
Binary frames with changed rows (frames.py) come BEFORE the answer of the command that changed them. The server also
sends events: {"event": "state" | "toast" | "picture", ...}. First message of a client: `hello`.
Over HTTP the same: POST /api/do/NAME with the fields as body, the answer as response (rows: GET /api/splats).
Big things in: POST /api/blobs (raw body) -> {"blob": sha256, "kind": ..., "name": ...}.  Out: GET /api/blobs/{blob}.
"""

from __future__ import annotations

from splatpainter.server.messages import connection, files, layers, looking, looks, painting
from splatpainter.server.messages.base import Answer as Answer
from splatpainter.server.messages.base import Command as Command
from splatpainter.server.messages.base import Failure as Failure
from splatpainter.server.messages.base import Problem as Problem
from splatpainter.server.messages.base import Progress as Progress
from splatpainter.server.messages.state import Model as Model

COMMANDS: dict[str, type[Command]] = {
    kind.NAME: kind
    for module in (connection, painting, layers, looks, looking, files)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Command) and kind is not Command
}
"""What `do` says -> the class of the command."""
EVENTS: tuple[type[Model], ...] = (connection.StateEvent, connection.ToastEvent, connection.PictureEvent)
REPLIES: tuple[type[Model], ...] = (Progress, Failure)
