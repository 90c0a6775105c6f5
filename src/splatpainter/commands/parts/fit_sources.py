"""What `fit` fits to: pictures with cameras and first Gaussians, from a mesh, a splat asset or a folder of pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatpainter.cameras import AUTO_UP, FRAME_MARGIN, UPS, Camera, bounding_sphere, spherical_cameras
from splatpainter.captures import is_capture, split_selector
from splatpainter.commands.parts.fit_photographs import (
    BACKGROUNDS,
    first_gaussians,
    near_zero,
    notes_on,
    posed_pictures,
    unsure_turns,
    unused_models,
)
from splatpainter.fit.optimize import TrainingView
from splatpainter.io import files, read
from splatpainter.io.folders import inside, trained_file
from splatpainter.io.formats.sog_container import META
from splatpainter.io.positions import NO_OFFSET, Offset
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

FOV = 40.0
"""Degrees, of rendered views."""
MESHES = (".glb", ".gltf", ".obj")
MESH_ENTRY_POINTS = "splatpainter.fit_sources"
"""Group of the entry point by which the distribution of training makes pictures of meshes: mesh = module:function."""


@dataclass(frozen=True)
class FitPictureSettings:
    """What the user asked for: settings of the pictures."""

    views: int
    held_out: int
    size: int | None
    rows: int
    sh_degree: int
    seed: int
    truth: Literal["surfels", "traced"] = "surfels"
    environment: Path | None = None
    surfels: int = 200_000
    samples: int = 64


@dataclass(frozen=True)
class FitPictures:
    """Pictures to fit and to judge by, and first Gaussians."""

    kind: Literal["mesh", "asset", "pictures"]
    views: list[TrainingView] = field(repr=False)
    held_out: list[TrainingView] = field(repr=False)
    start: Splats = field(repr=False)
    """Its means, and the views' cameras, are relative to `offset`."""
    offset: Offset = NO_OFFSET
    """World coordinates, float64 (Splats.offset); not zero where float32 cannot hold those of the source."""
    notes: list[str] = field(default_factory=list)


def fit_pictures(source: Path, settings: FitPictureSettings) -> FitPictures:
    """Everything that a fit needs. Raises ValueError, in one line: nothing there, or nothing that can be used."""
    if not source.exists():
        capture, selector = split_selector(source)
        if selector and is_capture(capture):
            raise ValueError(f"{source}: all photographs of a capture are fitted to; leave :{selector[:40]} out")
        raise ValueError(f"{source}: no such file or folder; expected a mesh, a splat file or a folder of pictures")
    is_folder = source.is_dir() and not inside(source, META).is_file() and trained_file(source) is None
    if is_folder or (source.is_file() and is_capture(source)):
        return _from_pictures(source, settings)
    return _from_mesh(source, settings) if is_mesh(source) else _from_asset(source, settings)


def is_mesh(path: Path) -> bool:
    """Whether a file is a mesh by its name; a GLB, unless it says KHR_gaussian_splatting."""
    suffix = path.suffix.lower()
    return suffix in MESHES and not (suffix == ".glb" and b"KHR_gaussian_splatting" in files.read_head(path, 1 << 16))


# Rendered


def _from_asset(source: Path, settings: FitPictureSettings) -> FitPictures:

    splats = read(source)
    if not splats.drawable.any():
        raise ValueError(f"{source}: none of its {len(splats):,} Gaussians can be drawn; there is nothing to fit to")
    offset, splats = splats.offset, replace(splats, offset=NO_OFFSET, source=None, origin=None)
    center, radius = bounding_sphere(splats)

    pictures = rendered_pictures(
        "asset", partial(drawn, splats), center, radius, np.array(UPS[AUTO_UP]), settings, np.eye(4)
    )
    return replace(pictures, start=replace(pictures.start, color_space=splats.color_space), offset=offset)


def _from_mesh(source: Path, settings: FitPictureSettings) -> FitPictures:
    points = list(entry_points(group=MESH_ENTRY_POINTS, name="mesh"))
    if not points:
        raise ValueError(f"{source}: meshes need splatpainter-train; pip install 'splatpainter[train]'")
    return points[0].load()(source, settings)


def drawn(splats: Splats, cameras: Sequence[Camera]) -> tuple[np.ndarray, ...]:
    """Colours [V, H, W, 3], depths and alphas [V, H, W] of an asset."""
    from splatpainter.rendering import render

    views = render(splats, list(cameras))
    return np.clip(views.colors, 0, 1), views.depths[..., 0], views.alphas[..., 0]


def rendered_pictures(
    kind: Literal["mesh", "asset"],
    render_views: Callable[[Sequence[Camera]], tuple[np.ndarray, ...]],
    center: np.ndarray,
    radius: float,
    up: np.ndarray,
    settings: FitPictureSettings,
    frame: np.ndarray,
) -> FitPictures:
    """Pictures to fit to and to judge by, and first Gaussians. render_views: cameras -> colours [V, H, W, 3], depths
    and alphas [V, H, W]. frame: [4, 4] from the asset's world to the rendered one (a half turn is its own inverse)."""
    from splatpainter.fit.start import from_depths

    distance = FRAME_MARGIN * radius / math.sin(math.radians(FOV / 2))
    kinds: dict[str, Any] = {"size": settings.size or 256, "fov": FOV, "up": up}
    cameras = spherical_cameras(center, distance, settings.views, backgrounds=BACKGROUNDS, **kinds)
    held_out = spherical_cameras(
        center, distance, settings.held_out, backgrounds=((0.5, 0.5, 0.5),), between=True, **kinds
    )
    colors, depths, alphas = render_views(cameras)
    unseen = render_views(held_out)[0] if held_out else []
    cameras, held_out = (
        [replace(c, world_to_camera=c.world_to_camera @ frame) for c in some] for some in (cameras, held_out)
    )
    start = from_depths(cameras, colors, depths, alphas, settings.rows, settings.seed, settings.sh_degree, opacity=0.5)
    views, unseen_views = [*map(TrainingView, cameras, colors)], [*map(TrainingView, held_out, unseen)]
    return FitPictures(kind, views, unseen_views, start)


# Pictures


def _from_pictures(folder: Path, settings: FitPictureSettings) -> FitPictures:
    posed, offset = near_zero(posed_pictures(folder, settings.size))
    if len(posed) < 2:
        raise ValueError(f"{folder}: expected at least two pictures with cameras, got {len(posed)}")
    count = min(settings.held_out, len(posed) // 4)
    apart = np.linspace(0, len(posed) - 1, count + 2)[1:-1].round().astype(int).tolist() if count else []
    rest = [picture for k, picture in enumerate(posed) if k not in apart]
    start, note = first_gaussians(folder, rest, settings.rows, settings.sh_degree, settings.seed, offset)
    views, held_out = (
        [TrainingView(picture.camera, picture.colors, mask=picture.mask) for picture in some]
        for some in (rest, [posed[k] for k in dict.fromkeys(apart)])
    )
    notes = [note, *unused_models(folder), *unsure_turns(folder), *notes_on(folder)]
    return FitPictures("pictures", views, held_out, start, offset, notes)
