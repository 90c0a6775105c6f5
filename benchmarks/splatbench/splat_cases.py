"""Splat assets as they are, for tables that take them: where they stand, views of them, and paint on a picture alone.

The asset is its own unedited truth; of the edit there is no other truth than the picture. Knows no protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatbench import edit_design as designs
from splatbench.cases import PosedImages
from splatbench.ground_truth import Shown
from splatbench.painted_truth import changes
from splatpainter.cameras import Camera

if TYPE_CHECKING:
    from splatbench.cases import Setup
    from splatbench.painted_truth import Paint
    from splatpainter.data.edits.layers import EditResources
    from splatpainter.data.viewpoints import Optics
    from splatpainter.splats import Splats

OPAQUE = 0.1
"""Fainter rows do not decide where the asset is."""


@dataclass(frozen=True)
class SplatSubject:
    """An asset, and the frame in which it is about the origin, y up, its rows within about -1..1."""

    name: str
    splats: Splats = field(repr=False)
    """Numpy float32; rows that cannot be drawn are left out."""
    center: np.ndarray
    """[3] in the asset's frame."""
    scale: float
    """Of the frame, times the asset's units."""
    radius: float
    """In the frame."""

    def placed(self, camera: Camera) -> Camera:
        """A camera of the frame, in the asset's own (y down, as files of this kind have it)."""
        matrix = camera.world_to_camera.copy()
        turn = matrix[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = matrix[:3, 3] / self.scale - turn @ self.center
        matrix[:3, :3] = turn
        return replace(camera, world_to_camera=matrix)

    def framed(self, spot: designs.Spot) -> designs.Spot:
        """A spot of the asset, in the frame."""
        turn = np.array([1.0, -1.0, -1.0])
        return designs.Spot((spot.place - self.center) * self.scale * turn, spot.normal * turn)

    def show(self, cameras: Sequence[Camera]) -> Shown:
        """PosedImages from cameras of the asset's frame."""
        from splatpainter.rendering import render

        drawn = render(self.splats, list(cameras))
        colors = np.clip(drawn.colors, 0, 1).astype(np.float32)
        return Shown(PosedImages(tuple(cameras), colors), drawn.alphas[..., 0], drawn.depths[..., 0])


def is_splat_folder(folder: Path | None) -> bool:
    """Whether a folder holds more files that can only be splat assets than files that may be meshes (.glb may be
    either)."""
    from splatpainter.data.meshes import SUFFIXES
    from splatpainter.data.scenes import SPLAT_SUFFIXES

    if folder is None or not folder.is_dir():
        return False
    found = [file.suffix.lower() for file in folder.rglob("*")]
    splats = sum(suffix in SPLAT_SUFFIXES and suffix not in SUFFIXES for suffix in found)
    return splats > sum(suffix in SUFFIXES for suffix in found)


def names(setup: Setup) -> list[str]:
    """The setup's assets, fewer where there are fewer. Raises ValueError as data.scenes.SplatFolder."""
    from splatpainter.data.scenes import SplatFolder

    assert setup.data is not None
    folder = SplatFolder(setup.data)
    order = np.random.default_rng([setup.seed, *b"objects"]).permutation(len(folder))
    return [folder.name(int(k)) for k in sorted(order[: setup.objects])]


def load(name: str, setup: Setup) -> SplatSubject:
    """Raises ValueError for a file that cannot be read, and one without a row that can be drawn."""
    from splatpainter.data.scenes import SplatFolder

    assert setup.data is not None
    own = SplatFolder(setup.data, [name]).splats(0).numpy()
    kept = own if own.drawable.all() else own.take(np.flatnonzero(own.drawable))
    if not len(kept):
        raise ValueError(f"{name}: none of its rows can be drawn")
    opaque = kept.opacities > OPAQUE
    means = (kept.means[opaque] if opaque.any() else kept.means).astype(np.float64)
    low, high = np.quantile(means, [0.01, 0.99], axis=0)  # captures have stray rows
    center, scale = (low + high) / 2, 2 / max(float((high - low).max()), 1e-6)
    radius = scale * float(np.quantile(np.linalg.norm(means - center, axis=1), 0.98))
    return SplatSubject(name, kept, center, scale, radius)


@dataclass(frozen=True)
class PaintedView:
    """A picture of the asset with an edit on it."""

    paint: Paint
    before: Shown = field(repr=False)
    """One view."""
    picture: np.ndarray = field(repr=False)
    """[H, W, 3] display colours."""
    mask: np.ndarray = field(repr=False)
    """[H, W] bool what was edited."""


def painted_view(
    what: SplatSubject,
    base: Shown,
    kind: str,
    framing: designs.Framing,
    optics: Optics,
    files: EditResources,
    rng: np.random.Generator,
) -> PaintedView:
    """An edit of a kind in a view of its own; as designs.design. base: views in which spots are found."""
    for attempt in range(designs.TRIES):
        strict = max(1 - attempt / (designs.STRICT * designs.TRIES), 0.0)
        spot = designs.any_spot(base, rng)
        camera = what.placed(designs.view_of(what.framed(spot), framing, what.radius, optics, rng))
        before = what.show([camera])
        paint = designs.painting(kind, camera, spot, before, files, rng, strict)
        if paint is None:
            continue
        picture = composed(before, paint)
        mask = changes(before.pictures.colors, picture[None])[0]
        if designs.shows(before.pictures.colors[0], picture, mask, strict):
            return PaintedView(paint, before, picture, mask)
    raise ValueError(f"{what.name}: {designs.TRIES} choices of a {kind} edit changed nothing that can be seen")


def composed(shown: Shown, paint: Paint) -> np.ndarray:
    """[H, W, 3] the picture with the edit on the asset's pixels of it: all that is known of the edit."""
    from splatbench.ground_truth import places

    before, alpha = shown.pictures.colors[0], shown.alphas[0]
    if isinstance(paint.what, np.ndarray):
        colors, coverage = paint.what[..., :3], paint.what[..., 3]
    else:
        solid = shown.masks[0]
        colors, coverage = before.copy(), np.zeros_like(alpha)
        points = places(paint.camera, shown.depths[0].astype(np.float64))
        colors[solid], coverage[solid] = paint.what.coat(points[solid], before[solid])
    share = (coverage * alpha)[..., None]
    return (before + share * (colors - before)).astype(np.float32)
