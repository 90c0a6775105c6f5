"""Edits as an artist makes them: a spot on the surface, a view of it, and a stroke, sticker, word, photo patch or
recolouring there. What shows too little, or lies beside the object, is thrown away and tried again. Knows no protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from splatbench import ground_truth as ground
from splatbench.painted_truth import Paint, Tint, Truth, changed
from splatpainter.cameras import Camera
from splatpainter.data import viewpoints

if TYPE_CHECKING:
    from splatbench.cases import Setup
    from splatbench.ground_truth import Shown
    from splatpainter.data.edits.layers import EditResources

KINDS = ("stroke", "sticker", "text", "photo", "recolor")
"""In turn."""
Framing = Literal["close-up", "whole"]
SHARE = (0.06, 0.3)
"""Part of the object in view that paint covers: least, most."""
WINDOW = (0.7, 1.7)
"""Height of a close-up, in radii of the object."""
STEEPEST = 0.45
"""Least cosine between the surface at a spot and the line of sight that finds it."""
FILLED = 0.12
"""Least part of an edited view that the object fills."""
ON_OBJECT = 0.6
"""Least part of a layer that lies on the object."""
SMALLEST, LARGEST = 0.004, 0.5
"""Part of an edited view that an edit changes."""
VISIBLE = 0.1
"""Least change of display values in its own view, root mean square over the pixels that an edit changes."""
TRIES = 24
STRICT = 0.75
"""Share of the tries over which the standards fall to nothing: thin objects need patience first."""


@dataclass(frozen=True)
class Spot:
    """A place on the surface that some view sees."""

    place: np.ndarray
    """[3] world."""
    normal: np.ndarray
    """[3] unit, towards that view."""


def stock(setup: Setup) -> EditResources:
    """The files that edits are made of. Raises ValueError for a folder that there is not."""
    from splatpainter.data.edits.layers import EditResources, list_files

    found = [() if folder is None else list_files(folder) for folder in (setup.decals, setup.fonts, setup.textures)]
    return EditResources(*found)


def design(
    rough: Truth,
    base: Shown,
    kind: str,
    framing: Framing,
    files: EditResources,
    rng: np.random.Generator,
    accept: Callable[[Spot, np.ndarray], bool] = lambda spot, mask: True,
) -> tuple[Paint, Spot]:
    """An edit of a kind that shows in its own view. rough: a truth that is quickly drawn (Truth.rough), with earlier
    edits on it. base: views in which spots are found. accept: whether a spot and what the edit changes in its view
    ([H, W] bool) will do. Raises ValueError, naming the object, after TRIES."""
    optics = ground.optics(rough.setup)
    for attempt in range(TRIES):
        strict = max(1 - attempt / (STRICT * TRIES), 0.0)
        spot = any_spot(base, rng)
        camera = view_of(spot, framing, rough.subject.radius, optics, rng)
        if ground.blocked(rough.subject.mesh, camera.position, spot.place, 0.02):
            continue
        before = rough.show([camera], "design")
        paint = painting(kind, camera, spot, before, files, rng, strict)
        if paint is None:
            continue
        after = rough.painted(paint).show([camera], "design")
        mask = changed(before, after)[0]
        if shows(before.pictures.colors[0], after.pictures.colors[0], mask, strict) and accept(spot, mask):
            return paint, spot
    raise ValueError(f"{rough.subject.name}: {TRIES} choices of a {kind} edit changed nothing that can be seen")


def shows(before: np.ndarray, after: np.ndarray, mask: np.ndarray, strict: float = 1.0) -> bool:
    """Whether an edit is worth asking about: pictures [H, W, 3], what it changes [H, W] bool; strict: times VISIBLE."""
    if not SMALLEST <= mask.mean() <= LARGEST:
        return False
    return bool(np.sqrt(np.mean((after - before)[mask] ** 2)) >= strict * VISIBLE)


def painting(
    kind: str,
    camera: Camera,
    spot: Spot,
    shown: Shown,
    files: EditResources,
    rng: np.random.Generator,
    strict: float = 1.0,
) -> Paint | None:
    """An edit at a spot, designed on the picture of the view; None where the object fills too little of the view, or
    too much of the edit would lie beside it. strict: times FILLED and ON_OBJECT."""
    from splatpainter.data.edits.layers import LAYER_MAKERS, Canvas
    from splatpainter.data.mesh_visibility import projected

    alpha = shown.alphas[0]
    extent = float(np.sqrt(rng.uniform(*SHARE) * shown.masks[0].sum()))
    if shown.masks[0].mean() < strict * FILLED or extent < 2:
        return None
    x, y, z = (float(v) for v in projected(spot.place[None], camera)[0])
    if kind == "recolor":
        return Paint(kind, camera, Tint(spot.place, 0.8 * extent * z / camera.fy, int(rng.integers(1 << 31))))
    layer = LAYER_MAKERS[kind](Canvas(shown.pictures.colors[0], (x, y), extent), files, rng)
    if float((layer[..., 3] * alpha).sum()) < strict * ON_OBJECT * float(layer[..., 3].sum()):
        return None
    return Paint(kind, camera, layer)


def any_spot(shown: Shown, rng: np.random.Generator) -> Spot:
    """A pixel of the pictures where the surface faces the view. Raises ValueError where there is none."""
    order = rng.permutation(len(shown.pictures))
    for k in order:
        camera, depth = shown.pictures.cameras[k], shown.depths[k].astype(np.float64)
        points = ground.places(camera, depth)
        down, right = np.gradient(points, axis=(0, 1))
        normal = np.cross(down, right)
        line = camera.position - points
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
        normal *= np.where((normal * line).sum(-1, keepdims=True) < 0, -1, 1)
        cosine = (normal * line).sum(-1) / np.maximum(np.linalg.norm(line, axis=-1), 1e-30)
        solid = shown.alphas[k] > 0.99
        for axis in (0, 1):
            solid = solid & np.roll(solid, 1, axis) & np.roll(solid, -1, axis)
        fit = np.argwhere(solid & (cosine >= STEEPEST))
        if len(fit):
            y, x = fit[rng.integers(len(fit))]
            return Spot(points[y, x], normal[y, x])
    raise ValueError("no part of its surface faces a view")


def view_of(spot: Spot, framing: Framing, radius: float, optics: viewpoints.Optics, rng: np.random.Generator) -> Camera:
    """A close-up of the spot, or the whole object from its side."""
    if framing == "whole":
        return viewpoints.around(radius, optics, *viewpoints.view_angles(spot.normal, rng))
    return viewpoints.facing(spot.place, spot.normal, radius * rng.uniform(*WINDOW), optics, rng)


def beside(
    truth: Truth,
    camera: Camera,
    spot: Spot,
    count: int,
    apart: tuple[float, float],
    rng: np.random.Generator,
) -> list[Camera]:
    """`count` views of the spot from other sides that see it, `apart` (least, most) degrees away where that can be."""
    found = []
    for _ in range(count):
        for k in range(TRIES + 1):  # nearer and nearer to the view that sees it
            part = 1 - k / TRIES
            near = viewpoints.neighbour(camera, spot.place, rng, (apart[0] * part, max(apart[1] * part, 1.0)))
            if not ground.blocked(truth.subject.mesh, near.position, spot.place, 0.02):
                break
        found.append(near)
    return found


def apart(spots: Sequence[Spot], least: float) -> Callable[[Spot, np.ndarray], bool]:
    """For `design`: only spots at least this far, world units, from all of these."""
    return lambda spot, mask: all(np.linalg.norm(spot.place - other.place) >= least for other in spots)
