"""`splatpainter render`: pictures of an asset that carry their camera, ready to be painted on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from splatpainter.cameras import Camera, UpAxis
from splatpainter.commands import Outcome
from splatpainter.commands.parts.asset_doubts import warn_of_doubts
from splatpainter.commands.parts.option_marks import Argument
from splatpainter.commands.parts.option_parsing import AssetFile, CameraFiles, InAxesOption
from splatpainter.commands.parts.terminal import count, progress
from splatpainter.commands.parts.view_options import (
    MAX_VIEWS,
    check_ranges,
    check_ring,
    color,
    given_cameras,
    ring_of_views,
)
from splatpainter.io import axes_news, files, read
from splatpainter.output_paths import check_folder, check_target, made_folder
from splatpainter.rendering import check_views
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.view_files import PictureOptions


@dataclass(frozen=True)
class Config:
    """Render pictures of an asset: a ring of views around it, or the cameras that you give.

    Every picture carries its camera (PNG in a text chunk, EXR in its header, and in NAME.json beside it), so that
    `edit` knows where a painted picture was seen from. 16-bit PNG and EXR need pip install 'splatpainter[pictures]'.

    example:
      splatpainter render vase.ply --out views --views 8 --size 800
      splatpainter render vase.ply --out views --camera views/view_003.json --size 4096 --transparent straight
      splatpainter render vase.ply --out comp --format exr --transparent premultiplied --aov depth,normal
    """

    asset: AssetFile
    """The splat file, or a folder of INRIA's trainer (its last iteration)."""
    out: Annotated[Path, Argument(metavar="DIR")]
    """Folder for view_000.png, view_000.json, ...; made if missing."""
    views: int = 8
    """How many views around the asset."""
    camera: CameraFiles = ()
    """Use these cameras instead: CAM.json, PNGs that carry one, cameras.json, transforms.json, camera_path.json or
    COLMAP's sparse/0, all of these or the one that :N behind it names by number or picture; --views, --up and so on are
    then ignored."""
    size: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side, up to 8192; default: 800, or what the camera says."""
    width: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels; with --height, in place of --size: views around the asset that are not square."""
    height: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """See --width."""
    background: Annotated[str | None, Argument(metavar="R,G,B", help_behavior_hint="")] = None
    """Colour behind the asset, 0..1 or #rrggbb; default: 0.25,0.25,0.25, or what the camera says."""
    transparent: Annotated[Literal["straight", "premultiplied"] | None, Argument(help_behavior_hint="")] = None
    """No background but an alpha channel; colours as they are (what painting programs expect of a PNG), or multiplied
    by alpha (EXR always)."""
    format: Literal["png", "exr"] = "png"
    """PNG of display colours, or EXR of linear light."""
    bits: Annotated[Literal["8", "16", "32"] | None, Argument(help_behavior_hint="")] = None
    """Bits of each colour sample: PNG 8 (default) or 16, EXR 16 (default) or 32."""
    aov: Annotated[str, Argument(metavar="NAMES", help_behavior_hint="")] = ""
    """More files beside each picture, separated by commas: alpha, depth, normal, gaussian-ids. Depth and normal are
    those of the surface that edits are painted on; weighted means over Gaussians where no surface is trusted."""
    profile: Profile = "inria"
    """Which renderer to match: inria, as most assets were trained, or playcanvas (about 1 % darker)."""
    in_axes: InAxesOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    up: UpAxis = "auto"
    """Direction that is up in the pictures; auto: -y, as most captures have it (GLB and SPZ are turned when read)."""
    elevation: float = 15.0
    """Degrees above the horizon."""
    fov: float = 40.0
    """Vertical field of view, degrees."""
    distance: Annotated[float | None, Argument(metavar="FLOAT", help_behavior_hint="")] = None
    """Camera's distance from the asset's centre, world units; default: so that it fills the picture."""
    overwrite: bool = False
    """Replace pictures that exist, even if they were painted on."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Render and save."""
    # All that can be refused is refused before the asset is read.
    _check(config)
    options = _options(config)
    given = given_cameras(config.camera, config.size, config.asset)
    for camera in given:  # of a capture they may claim any size
        check_views([camera])
    stems = [f"view_{k:03d}" for k in range(len(given) or config.views)]
    # Files that are there may have been painted on, so none is replaced without a word.
    check_folder(config.out)
    if config.out.is_dir():
        for name in (name for stem in stems for name in options.file_names(stem)):
            check_target(config.out / name, config.overwrite)
    # Only now: what was wrong with options and names cost nothing.
    splats = read(config.asset, axes=config.in_axes, lenient=config.lenient)
    cameras = given or ring_of_views(config, splats, config.views)
    if given and config.background is not None:
        cameras = [replace(camera, background=color(config.background, splats)) for camera in cameras]
    # Each picture carries the hash of its asset, by which `edit` warns of another one.
    cameras = [replace(camera.relative_to(splats.offset), asset_sha256=splats.sha256) for camera in cameras]
    # With the views at hand: some doubts are about a view and not about the asset.
    doubtful = warn_of_doubts(splats, config.asset, list(zip(stems, cameras, strict=True)))
    # The folder is made last, so that a refusal leaves none behind.
    with made_folder(config.out):
        for _ in progress(_save_all(splats, cameras, stems, config.out, options), len(cameras), "rendering"):
            pass
    hidden = int((~splats.drawable).sum())
    record = {
        "asset": {"file": config.asset, "sha256": splats.sha256, "rows": len(splats), "rows_not_drawn": hidden},
        "doubts": doubtful,
        "views": [_files(config.out, stem, camera, options) for stem, camera in zip(stems, cameras, strict=True)],
    }
    # The first name stands for all of them.
    first = options.file_names(stems[0])
    beside = f", and {', '.join(options.aovs)} beside it" if options.aovs else ""
    lines = [f"{count(len(stems), 'picture')} in {config.out}: {first[0]} ... each with its camera inside{beside}"]
    lines += axes_news(splats)
    if hidden:
        lines.append(f"{count(hidden, 'Gaussian')} of {len(splats):,} cannot be drawn")
    return Outcome(record, lines)


def _files(out: Path, stem: str, camera: Camera, options: PictureOptions) -> dict[str, Any]:
    picture, *aovs, sidecar = (out / name for name in options.file_names(stem))
    record = {"file": picture, "camera": sidecar, "width": camera.width, "height": camera.height}
    return record | ({"aov": dict(zip(options.aovs, aovs, strict=True))} if aovs else {})


def _save_all(
    splats: Splats, cameras: list[Camera], stems: list[str], out: Path, options: PictureOptions
) -> Iterator[None]:
    from splatpainter.surface.estimate import Surface
    from splatpainter.view_files import normals_of, view_files

    # Normals and the surface are of the asset, so they are made once for all views.
    normals = normals_of(splats) if "normal" in options.aovs else None
    surface = Surface.of(splats.numpy()) if {"normal", "depth"} & {*options.aovs} else None
    for camera, stem in zip(cameras, stems, strict=True):
        # Whole or not at all: a painting program may be looking at the folder.
        for name, data in view_files(splats, camera, stem, options, normals=normals, surface=surface).items():
            with files.writing(out / name) as file:
                file.write(data)
        yield


def _options(config: Config) -> PictureOptions:
    from splatpainter.view_files import PictureOptions

    names: Any = tuple(name.strip() for name in config.aov.split(",")) if config.aov.strip() else ()
    # Named apart from other names, since people will look for it here.
    if "coverage" in names:
        raise ValueError(
            "--aov coverage: only a session records which Gaussians its edits saw; export the view from the studio"
        )
    bits = None if config.bits is None else int(config.bits)
    options = PictureOptions(config.format, bits, config.transparent, names, config.profile)
    # A library that is missing is told before anything is rendered.
    options.check_installed()
    return options


def _check(config: Config) -> None:
    check_ranges("render", {"--views": (config.views, 1, MAX_VIEWS)})
    check_ring("render", config)
