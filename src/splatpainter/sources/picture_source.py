"""What every origin of edited pictures is asked and what it answers: a program, an image service, a local model.

A source gets one rendered view and gives one picture back, as it came. It knows nothing of Gaussians, and it does not
judge its answer: `gatekeeper/gatekeeper.py` registers the picture, corrects its colours and cuts it to the mask.

    source = open_source("command", {"run": "upscale {image} {out}"})
    answer = source.edit(PictureRequest(image, alpha, prompt="rust"), progress, cancel)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Protocol, TypeAlias

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.system.quick_dataclass import dataclass

Progress: TypeAlias = Callable[[float, str], None]
"""Share done, 0..1, and a few words on what is being done."""
MAX_PROMPT_CHARACTERS = 4000
"""Most characters of a prompt in a receipt, which cuts longer ones, and in what a page sends."""
Map: TypeAlias = Callable[[], np.ndarray]
"""Renders a map of the view when a source takes it, and not before."""


class SourceError(ValueError):
    """One line: what was asked of which source, what came instead, what to do."""


class SourceCancelled(Exception):
    """The request was given up because `cancel` was set."""


class CancelFlag(Protocol):
    """A threading.Event, or anything else with its is_set."""

    def is_set(self) -> bool: ...


@dataclass(frozen=True)
class PictureRequest:
    """One picture to be edited. Colours are display sRGB, 0..1, float32."""

    image: np.ndarray
    """[H, W, 3], drawn on the background that `alpha` leaves free."""
    alpha: np.ndarray
    """[H, W], 0..1: where the asset is."""
    mask: np.ndarray | None = None
    """[H, W], 0..1: 1 where the picture may change. None: everywhere."""
    prompt: str = ""
    references: tuple[np.ndarray, ...] = ()
    """Further pictures [h, w, 3] that show what is meant."""
    seed: int | None = None
    scale: int = 1
    """Factor by which the answer is to be wider and higher."""
    camera: Camera | None = None
    depth: Map | None = None
    """Gives [H, W] float32, distances along the view axis in world units, 0 where nothing is."""
    normal: Map | None = None
    """Gives [H, W, 3] float32, unit normals in camera axes (x right, y down, z away), 0 where nothing is."""


@dataclass(frozen=True)
class PictureAnswer:
    """A source's answer, before anything is judged or corrected."""

    image: np.ndarray
    """[h, w, 3 or 4], display sRGB and alpha, 0..1, float32: of any size."""
    model: str = ""
    """What made it, in the source's own words."""
    seed: int | None = None
    """The seed that was used, where the source says it."""
    cost: str = ""
    """What it cost, where the source says it: "0.04 USD", "1290 tokens"."""
    notes: tuple[str, ...] = ()
    """One line each, for the user."""


@dataclass(frozen=True)
class Capabilities:
    """What a source understands. More than that is refused before anything is sent."""

    prompt: bool = False
    """Whether it takes a prompt."""
    needs_prompt: bool = False
    """Whether it can do nothing without one."""
    mask: bool = False
    """Whether it takes a mask; without, its picture is cut to it afterwards."""
    references: int = 0
    """How many reference pictures it takes."""
    seed: bool = False
    """Whether it takes a seed."""
    max_seed: int = 2**64 - 1
    """The largest that it takes."""
    maps: frozenset[str] = field(default_factory=frozenset)
    """Maps that it takes, of {"depth", "normal"}."""
    scales: tuple[int, ...] = (1,)
    """Enlargements that it can be asked for."""
    max_side_px: int = 4096
    """Longest side of a picture that it takes."""
    paid: bool = False
    """Whether a call costs money: dry runs count these."""
    hint: str = ""
    """How it can be made to take more, in words for the line that refuses a request."""


class PictureSource(Protocol):
    """Anything that edits pictures. Other packages add theirs by an entry point of the group splatpainter.sources: a
    callable that takes the options as a dict of strings and gives the source."""

    name: str
    capabilities: Capabilities

    def edit(self, request: PictureRequest, progress: Progress, cancel: CancelFlag) -> PictureAnswer:
        """The edited picture. Looks at `cancel` at least twice a second and keeps to a timeout of its own.

        Raises: SourceError in one line without keys or addresses of users; SourceCancelled.
        """
        ...


def check_request(request: PictureRequest, capabilities: Capabilities, name: str) -> None:
    """Refuses what the source would have to ignore.

    Raises: SourceError naming what was asked and what the source takes.
    """
    sides = request.image.shape[:2]
    # A refusal says how the source can be made to take it, where that is possible.
    hint = f"; {capabilities.hint}" if capabilities.hint else ""
    # Seeds differ in range from service to service; out of it they would be cut off in silence.
    if capabilities.seed and request.seed is not None and not 0 <= request.seed <= capabilities.max_seed:
        raise SourceError(f"source {name}: expected a seed of 0 to {capabilities.max_seed}, got {request.seed}")
    # Whatever the source would have to ignore: the user would take the answer for what was asked for.
    demands = {
        "a prompt": bool(request.prompt) and not capabilities.prompt,
        "a mask": request.mask is not None and not capabilities.mask,
        "a seed": request.seed is not None and not capabilities.seed,
        f"{len(request.references)} reference pictures": len(request.references) > capabilities.references,
        f"an enlargement of {request.scale}": request.scale not in capabilities.scales,
        f"a picture of {sides[1]} x {sides[0]} pixels": max(sides) > capabilities.max_side_px,
    }
    for what, refused in demands.items():
        if refused:
            raise SourceError(f"source {name}: does not take {what}; it takes {describe(capabilities)}{hint}")
    # Not every source can do something without words; the call would be paid for and useless.
    if capabilities.needs_prompt and not request.prompt.strip():
        raise SourceError(f"source {name}: needs a prompt (--prompt TEXT)")


def describe(capabilities: Capabilities) -> str:
    """What a source takes, in words for one line."""
    # In the order in which people think of them; what a source does not take is left out.
    parts = [
        "a prompt" if capabilities.prompt else "",
        "a mask" if capabilities.mask else "",
        f"up to {capabilities.references} reference pictures" if capabilities.references else "",
        "a seed" if capabilities.seed else "",
        *sorted(capabilities.maps),
        f"enlargements of {', '.join(map(str, capabilities.scales))}" if capabilities.scales != (1,) else "",
        f"pictures of up to {capabilities.max_side_px} pixels a side",
    ]
    return ", ".join(filter(None, parts))
