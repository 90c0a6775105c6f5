"""`splatpainter render`: pictures of an asset that carry their camera, ready to be painted on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import from_display
from splatpainter.commands import Outcome
from splatpainter.commands.option_parsing import AssetFile, CameraFiles, FrameOption
from splatpainter.commands.targets import check_folder, check_target, make_folder
from splatpainter.commands.terminal import count, progress
from splatpainter.io import files, frame_is_news, frame_line, read
from splatpainter.rendering import MAX_SIDE_PX
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.view_files import PictureOptions

MOST_VIEWS = 1000


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
    """The splat file."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for view_000.png, view_000.json, ...; made if missing."""
    views: int = 8
    """How many views around the asset."""
    camera: CameraFiles = ()
    """Use these cameras instead (CAM.json, or PNGs that carry one); --views, --up and so on do not count then."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side, up to 8192; default: 800, or what the camera says."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """With --height, in place of --size: views around the asset that are not square."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """See --width."""
    background: Annotated[str | None, arg(metavar="R,G,B", help_behavior_hint="")] = None
    """Colour behind the asset, 0..1 or #rrggbb; default: 0.25,0.25,0.25, or what the camera says."""
    transparent: Annotated[Literal["straight", "premultiplied"] | None, arg(help_behavior_hint="")] = None
    """No background but an alpha channel; colours as they are (what painting programs expect of a PNG), or multiplied
    by alpha (EXR always)."""
    format: Literal["png", "exr"] = "png"
    """PNG of display colours, or EXR of linear light."""
    bits: Annotated[Literal["8", "16", "32"] | None, arg(help_behavior_hint="")] = None
    """Of each colour sample: PNG 8 (default) or 16, EXR 16 (default) or 32."""
    aov: Annotated[str, arg(metavar="NAMES", help_behavior_hint="")] = ""
    """Files beside each picture, names with commas between: alpha, depth, normal, gaussian-ids. Depth and normal are
    those of the surface on which edits are laid, weighted means over Gaussians where no surface is trusted."""
    profile: Profile = "inria"
    """Whose picture: inria as most assets were trained, playcanvas as PlayCanvas's tools render (about 1 % darker)."""
    frame: FrameOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off behind its last whole row; what is left of the cut part is kept."""
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Direction that is up in the pictures; auto: -y, the habit of captures (GLB and SPZ are turned when read)."""
    elevation: float = 15.0
    """Degrees above the horizon."""
    fov: float = 40.0
    """Vertical field of view, degrees."""
    distance: Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint="")] = None
    """From the asset's centre, world units; default: so that it fills the picture."""
    overwrite: bool = False
    """Replace pictures that exist (they may have been painted on)."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Render and save."""
    _check(config)
    options = _options(config)
    given = given_cameras(config.camera, config.size)
    stems = [f"view_{k:03d}" for k in range(len(given) or config.views)]
    check_folder(config.out)
    if config.out.is_dir():
        for name in (name for stem in stems for name in options.file_names(stem)):
            check_target(config.out / name, config.overwrite)
    splats = read(config.asset, frame=config.frame, lenient=config.lenient)
    cameras = given or _ring(config, splats)
    if given and config.background is not None:
        cameras = [replace(camera, background=color(config.background, splats)) for camera in cameras]
    cameras = [replace(camera, asset_sha256=splats.sha256) for camera in cameras]
    make_folder(config.out)
    for _ in progress(_save_all(splats, cameras, stems, config.out, options), len(cameras), "rendering"):
        pass
    hidden = int((~splats.drawable).sum())
    record = {
        "asset": {"file": config.asset, "sha256": splats.sha256, "rows": len(splats), "rows_not_drawn": hidden},
        "views": [_files(config.out, stem, camera, options) for stem, camera in zip(stems, cameras, strict=True)],
    }
    first = options.file_names(stems[0])
    beside = f", and {', '.join(options.aovs)} beside it" if options.aovs else ""
    lines = [f"{count(len(stems), 'picture')} in {config.out}: {first[0]} ... each with its camera inside{beside}"]
    assert splats.source is not None
    if frame_is_news(splats.source):
        lines.append(f"frame: {frame_line(splats.source)}")
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
    from splatpainter.kernels.compile import ensure_compiled
    from splatpainter.surface.estimate import Surface
    from splatpainter.view_files import normals_of, view_files

    ensure_compiled()
    normals = normals_of(splats) if "normal" in options.aovs else None
    surface = Surface.of(splats.numpy()) if {"normal", "depth"} & {*options.aovs} else None
    for camera, stem in zip(cameras, stems, strict=True):
        for name, data in view_files(splats, camera, stem, options, normals=normals, surface=surface).items():
            with files.writing(out / name) as file:
                file.write(data)
        yield


def _ring(config: Config, splats: Splats) -> list[Camera]:
    """Views around the asset, which fills the shorter side."""
    size = config.size or 800
    width, height = config.width or size, config.height or size
    short = min(width, height)
    cameras = orbit_cameras(
        splats,
        config.views,
        size=short,
        up=config.up,
        elevation=config.elevation,
        fov=config.fov,
        distance=config.distance,
        background=color(config.background or "0.25,0.25,0.25", splats),
    )
    return [camera.cropped((short - width) // 2, (short - height) // 2, width, height) for camera in cameras]


def _options(config: Config) -> PictureOptions:
    from splatpainter.view_files import PictureOptions

    names: Any = tuple(name.strip() for name in config.aov.split(",")) if config.aov.strip() else ()
    if "coverage" in names:
        raise ValueError(
            "--aov coverage: only a session records which Gaussians its edits saw; export the view from the studio"
        )
    bits = None if config.bits is None else int(config.bits)
    options = PictureOptions(config.format, bits, config.transparent, names, config.profile)
    options.check_installed()
    return options


def _check(config: Config) -> None:
    for name, value, low, high in (
        ("--views", config.views, 1, MOST_VIEWS),
        ("--size", 1 if config.size is None else config.size, 1, MAX_SIDE_PX),
        ("--width", 1 if config.width is None else config.width, 1, MAX_SIDE_PX),
        ("--height", 1 if config.height is None else config.height, 1, MAX_SIDE_PX),
        ("--elevation", config.elevation, -90, 90),
        ("--fov", config.fov, 1, 170),
    ):
        if not low <= value <= high:
            raise ValueError(f"splatpainter render: expected {name} from {low} to {high}, got {value}")
    if (config.width is None) != (config.height is None) or (config.width and (config.size or config.camera)):
        raise ValueError("splatpainter render: expected --width and --height together, without --size and --camera")
    if config.distance is not None and not 0 < config.distance < float("inf"):
        raise ValueError(f"splatpainter render: expected --distance above 0, got {config.distance}")
    if config.background is not None:
        rgb(config.background)


def given_cameras(paths: Sequence[Path], size: int | None) -> list[Camera]:
    """The cameras in these files; size: pixels of the longer side, None: as they say. Raises ValueError."""
    from splatpainter.sources.edit_files import camera_from

    cameras = [camera_from(path) for path in paths]
    if size is None:
        return cameras
    scales = [size / max(camera.width, camera.height) for camera in cameras]
    return [
        camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        for camera, scale in zip(cameras, scales, strict=True)
    ]


def rgb(text: str) -> tuple[float, float, float]:
    """Display colour 0..1 from "0.2,0.5,1" or "#3380ff". Raises ValueError."""
    try:
        if text.startswith("#") and len(text) == 7:
            red, green, blue = (int(text[k : k + 2], 16) / 255 for k in (1, 3, 5))
        else:
            red, green, blue = (float(part) for part in text.split(","))
        if all(0 <= value <= 1 for value in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise ValueError(f"splatpainter render: expected --background as R,G,B from 0 to 1, or #rrggbb, got {text!r}")


def color(text: str, splats: Splats) -> tuple[float, float, float]:
    """A display colour, in the asset's colour space."""
    import numpy as np

    red, green, blue = from_display(np.array(rgb(text)), splats.color_space).tolist()
    return red, green, blue
