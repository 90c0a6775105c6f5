"""What each command gets, and what several of them need: renders, uploaded masks, progress, Python lines.

`@command(Kind, writes=True)` registers a function of (context, request), which runs on a worker thread and returns the
answer. Those that write run one after the other, in the order in which their commands came; the others look at
snapshots and may run beside them. Wrong input is a ValueError of one line.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import to_display
from splatpainter.pictures.picture_reader import read_mask, resample
from splatpainter.pictures.view_search import same_shape
from splatpainter.rendering import render
from splatpainter.rendering.profiles import Profile
from splatpainter.server.describe import layer_info
from splatpainter.server.page_state import PageState
from splatpainter.server.protocol import Answer, Command, LayerMade
from splatpainter.server.studio import Studio
from splatpainter.server.work_queue import Lane, Ticket
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

Run = Callable[["CommandContext", Any], Answer]
Function = TypeVar("Function", bound=Callable[..., Answer])
Result = TypeVar("Result")


@dataclass
class CommandContext:
    """A command being carried out."""

    studio: Studio
    page: PageState
    ticket: Ticket
    preview: bytes | None = None
    """A frame of Gaussians to show to this page alone, with the answer."""
    previewed_ids: np.ndarray | None = None
    """[C] the Gaussians in it."""
    clear_preview: bool = False
    """Whether Gaussians that this page previews shall show their true colours again."""
    show: Callable[[bytes, np.ndarray], None] = lambda frame, gaussian_ids: None
    """Send a preview (frame, [C] the Gaussians in it) to this page at once, while the command goes on."""
    writer: Callable[[Callable[[], Any]], Any] | None = None
    """Runs a function where commands that write run, and sends every client what it changed; for long commands of the
    background. Raises Cancelled where the studio is being closed."""

    notice: str = ""
    """A line for the other windows, whose view changes without their doing."""

    def write(self, work: Callable[[], Result]) -> Result:
        """What `work` returns, or raises; run by `writer`, or here where there is none."""
        return work() if self.writer is None else self.writer(work)


@dataclass(frozen=True)
class Handler:
    """The function that carries out a command, and how."""

    run: Run
    writes: bool = False
    """Whether it may change the session."""
    background: bool = False
    """Whether the client's next commands need not wait for it (long work that changes nothing by itself)."""
    once: bool = False
    """For background commands: whether it outlives a lost connection, and is not done again for a page that comes back
    (it may cost money)."""
    bound: bool = False
    """Whether it is about what is open: refused where that is another project than its page showed when it was sent."""

    @property
    def lane(self) -> Lane:
        return "write" if self.writes else "background" if self.background else "read"


HANDLERS: dict[type[Command], Handler] = {}


def command(
    kind: type[Command],
    *,
    writes: bool = False,
    background: bool = False,
    once: bool = False,
    bound: bool | None = None,
) -> Callable[[Function], Function]:
    """Register the function for a command; the words are those of Handler. bound: by default where it writes."""

    # The registry is filled by importing the modules, so a new command needs no other list.
    def register(run: Function) -> Function:
        HANDLERS[kind] = Handler(run, writes, background, once, writes if bound is None else bound)
        return run

    return register


class RawExpr(str):
    """A Python expression in a `python_line`, not a string literal."""

    __repr__ = str.__str__


def python_line(function: str, *args: Any, **kwargs: Any) -> str:
    """A call as one would write it; keywords that are None are left out."""
    parts = [repr(value) for value in args]
    # As one would type it: what is at its default is not said.
    parts += [f"{name}={value!r}" for name, value in kwargs.items() if value is not None]
    return f"{function}({', '.join(parts)})"


@contextlib.contextmanager
def naming_errors(path: Path, name: str) -> Iterator[None]:
    """Errors about the file at `path` name it as its owner does."""
    try:
        yield
    except ValueError as error:
        # Uploads lie under their hash, which says nothing to people.
        if str(path) not in str(error):
            raise
        raise ValueError(str(error).replace(str(path), name)) from None


def render_display(splats: Splats, camera: Camera, profile: Profile = "inria") -> np.ndarray:
    """[H, W, 3] display colours."""
    return to_display(render(splats, camera, profile=profile).colors[0], splats.color_space)


def render_alpha(splats: Splats, camera: Camera) -> np.ndarray:
    """[H, W] how much of each pixel the asset covers, 0..1."""
    return render(splats, camera).alphas[0, ..., 0]


@contextlib.contextmanager
def progress(context: CommandContext, stage: str) -> Iterator[None]:
    """Let the session report what it computes, and stop it where the command was cancelled."""
    session = context.studio.session
    context.ticket.report(0, stage)
    # The session's progress goes to this command alone; jobs that write run one after the other.
    session.progress = lambda done, total, name: context.ticket.report(done / max(total, 1), name)
    try:
        yield
    finally:
        session.progress = None


def layer_made(context: CommandContext, layer: str, python: str) -> LayerMade:
    """The answer with a layer as it now is."""
    session = context.studio.session
    return LayerMade(layer=layer_info(session, session.layers.by_id(layer)), python=python)


def mask_from_upload(context: CommandContext, blob: str, camera: Camera) -> np.ndarray:
    """[H, W] bool of an uploaded mask. Raises ValueError where it is empty or of another shape than the camera."""
    stored = context.studio.blobs.get(blob, "picture")
    name, size = stored.name or "mask", (camera.width, camera.height)
    # Errors name the file as its owner knows it.
    with naming_errors(stored.path, name):
        mask = read_mask(stored.path)
    check_shape(name, (mask.shape[1], mask.shape[0]), size)
    if not mask.any():
        raise ValueError(f"{name}: is empty; expected some pixels that are not black")
    # A quarter and not half, so that a thin line of a larger mask does not vanish.
    return mask if mask.shape[::-1] == size else resample(mask.astype(np.float32), *size) > 0.25


def check_shape(name: str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    """Raises ValueError where an upload of `size` (width, height) is not its view, resized."""
    if not same_shape(size, expected):
        raise ValueError(
            f"{name}: expected the shape of its view ({expected[0]}x{expected[1]}), got {size[0]}x{size[1]}; "
            "resize without cropping"
        )
