"""What `fit` fits to: pictures with cameras and first Gaussians, from a mesh, a splat asset or a folder of pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatpainter.cameras import AUTO_UP, FRAME_MARGIN, UPS, Camera, bounding_sphere, spherical_cameras
from splatpainter.commands.terminal import reason
from splatpainter.io import files, read
from splatpainter.io.sog_container import META
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.data.meshes import Mesh

FOV = 40.0
"""Degrees, of rendered views."""
BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""Colours that stand in turn behind rendered views and transparent pictures: over one colour alone, Gaussians of that
colour may as well be holes, and holes Gaussians. The demo asset (96 px, 600 steps) lost 0.059 of its alpha over its own
dark background and the space around it gained 0.016; over these two in turn 0.005 and 0.003, held-out views 0.1 dB
better."""
MESHES = (".glb", ".gltf", ".obj")
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
TRANSFORMS = ("transforms.json", "transforms_train.json")
MESH_FRAME = np.diag([1.0, -1.0, -1.0, 1.0])
"""Meshes have y up, assets in memory y down (cameras.AUTO_UP)."""
TRIES_PER_GAUSSIAN = 20
"""Random points per first Gaussian that carving may throw away."""


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
    cameras: list[Camera]
    colors: list[np.ndarray] = field(repr=False)
    """Each [H, W, 3] float32 0..1."""
    held_out: list[tuple[Camera, np.ndarray]] = field(repr=False)
    start: Splats = field(repr=False)
    notes: list[str] = field(default_factory=list)


def fit_pictures(source: Path, settings: FitPictureSettings) -> FitPictures:
    """Everything that a fit needs. Raises ValueError, in one line: nothing there, or nothing that can be used."""
    if not source.exists():
        raise ValueError(f"{source}: no such file or folder; expected a mesh, a splat file or a folder of pictures")
    if source.is_dir() and not (source / META).is_file():
        return _from_pictures(source, settings)
    return _from_mesh(source, settings) if is_mesh(source) else _from_asset(source, settings)


def is_mesh(path: Path) -> bool:
    """Whether a file is a mesh by its name; a GLB, unless it says KHR_gaussian_splatting."""
    suffix = path.suffix.lower()
    return suffix in MESHES and not (suffix == ".glb" and b"KHR_gaussian_splatting" in files.read_head(path, 1 << 16))


# Rendered


def _from_asset(source: Path, settings: FitPictureSettings) -> FitPictures:
    from splatpainter.kernels.compile import ensure_compiled

    splats = read(source)
    if not splats.drawable.any():
        raise ValueError(f"{source}: none of its {len(splats):,} Gaussians can be drawn; there is nothing to fit to")
    if any(splats.offset):
        raise ValueError(f"{source}: has positions that float32 cannot hold; move it near 0, then fit to it")
    ensure_compiled()
    center, radius = bounding_sphere(splats)

    pictures = _rendered("asset", partial(_drawn, splats), center, radius, np.array(UPS[AUTO_UP]), settings, np.eye(4))
    return replace(pictures, start=replace(pictures.start, color_space=splats.color_space))


def _from_mesh(source: Path, settings: FitPictureSettings) -> FitPictures:
    try:
        from splatpainter.data.environments import load_environment
        from splatpainter.data.lights import make_light, uniform_light
        from splatpainter.data.meshes import load_mesh

        mesh = load_mesh(source)
    except ImportError as error:
        raise ValueError(f"{source}: meshes need {error.name}; pip install 'splatpainter[data]'") from None
    light = make_light(load_environment(settings.environment)) if settings.environment is not None else uniform_light()
    render_views = _traced(mesh, light, settings) if settings.truth == "traced" else _surfels(mesh, light, settings)
    radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
    return _rendered("mesh", render_views, np.zeros(3), radius, np.array([0.0, 1.0, 0.0]), settings, MESH_FRAME)


def _surfels(
    mesh: Mesh, light: Any, settings: FitPictureSettings
) -> Callable[[Sequence[Camera]], tuple[np.ndarray, ...]]:
    from splatpainter.data.lights import shade
    from splatpainter.data.surfels import sample_surfels, to_splats
    from splatpainter.kernels.compile import ensure_compiled

    ensure_compiled()
    dense = sample_surfels(mesh, settings.surfels, settings.seed)
    truth = to_splats(dense, shade(dense, light, min(settings.sh_degree, 2))).numpy()
    return partial(_drawn, truth)


def _drawn(splats: Splats, cameras: Sequence[Camera]) -> tuple[np.ndarray, ...]:
    from splatpainter.rendering import render

    views = render(splats, list(cameras))
    return np.clip(views.colors, 0, 1), views.depths[..., 0], views.alphas[..., 0]


def _traced(
    mesh: Mesh, light: Any, settings: FitPictureSettings
) -> Callable[[Sequence[Camera]], tuple[np.ndarray, ...]]:
    from splatpainter.data.pathtrace import PathOptions, display, path_trace

    def render_views(cameras: Sequence[Camera]) -> tuple[np.ndarray, ...]:
        from splatpainter.kernels.compile import ensure_compiled

        ensure_compiled()
        traced = path_trace(mesh, light.environment.numpy(), cameras, PathOptions(settings.samples, seed=settings.seed))
        return display(traced, float(light.exposure), cameras), traced.depths, traced.alphas

    return render_views


def _rendered(
    kind: Literal["mesh", "asset"],
    render_views: Callable[[Sequence[Camera]], tuple[np.ndarray, ...]],
    center: np.ndarray,
    radius: float,
    up: np.ndarray,
    settings: FitPictureSettings,
    frame: np.ndarray,
) -> FitPictures:
    """render_views: cameras -> colours [V, H, W, 3], depths and alphas [V, H, W]. frame: [4, 4] from the asset's world
    to the rendered one (a half turn is its own inverse)."""
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
    return FitPictures(kind, cameras, list(colors), list(zip(held_out, unseen, strict=True)), start)


# Pictures


def _from_pictures(folder: Path, settings: FitPictureSettings) -> FitPictures:
    table = next((folder / name for name in TRANSFORMS if (folder / name).is_file()), None)
    posed = _by_table(table, settings) if table is not None else _by_camera(folder, settings)
    if len(posed) < 2:
        raise ValueError(f"{folder}: expected at least two pictures with cameras, got {len(posed)}")
    count = min(settings.held_out, len(posed) // 4)
    apart = (
        np.unique(np.linspace(0, len(posed) - 1, count + 2)[1:-1].round().astype(int)) if count else np.array([], int)
    )
    held_out = [posed[k][:2] for k in apart]
    rest = [view for k, view in enumerate(posed) if k not in set(apart.tolist())]
    start = _carved([view[0] for view in rest], [view[1] for view in rest], [view[2] for view in rest], settings)
    notes = ["no depth maps: the first Gaussians are random points where no picture shows empty space"]
    return FitPictures("pictures", [view[0] for view in rest], [view[1] for view in rest], held_out, start, notes)


PosedPicture = tuple[Camera, np.ndarray, np.ndarray]
"""(camera, colours [H, W, 3], [H, W] bool where something may be)."""


def _by_camera(folder: Path, settings: FitPictureSettings) -> list[PosedPicture]:
    """Pictures that carry their camera, or have it beside them."""
    from splatpainter.image_files import find_camera

    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in PICTURES and path.is_file()]
    if not paths:
        raise ValueError(f"{folder}: expected pictures with cameras, or one of {', '.join(TRANSFORMS)}; found neither")
    return [_posed_picture(path, find_camera(path), settings, k) for k, path in enumerate(paths)]


def _by_table(table: Path, settings: FitPictureSettings) -> list[PosedPicture]:
    """Pictures by a table as NeRF's synthetic scenes and nerfstudio have it: OpenGL camera-to-world matrices, one field
    of view or focal lengths for all or for each frame."""
    try:
        record = json.loads(files.read_all(table))
        frames = list(record["frames"])
        return [_frame(table, {**record, **frame}, settings, k) for k, frame in enumerate(frames)]
    except (KeyError, TypeError, AttributeError, UnicodeDecodeError, json.JSONDecodeError) as error:
        problem = f"no {error}" if isinstance(error, KeyError) else reason(error)
        raise ValueError(f"{table}: expected a NeRF-style table of frames ({problem})") from None


def _frame(table: Path, record: dict[str, Any], settings: FitPictureSettings, k: int) -> PosedPicture:
    from splatpainter.sources.picture_reader import read_picture

    name = table.parent / str(record["file_path"])
    path = next((p for p in (name, name.with_name(name.name + ".png")) if p.is_file()), name)
    width, height = read_picture(path).size
    if any(record.get(name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")):
        raise ValueError(f"{table}: its lens is distorted (k1, k2, p1, p2); expected undistorted pictures")
    if "fl_x" in record:
        fx, fy = float(record["fl_x"]), float(record.get("fl_y", record["fl_x"]))
        sx, sy = width / float(record.get("w", width)), height / float(record.get("h", height))
        cx, cy = float(record.get("cx", width / sx / 2)) * sx, float(record.get("cy", height / sy / 2)) * sy
        fx, fy = fx * sx, fy * sy
    else:
        fx = fy = width / 2 / math.tan(float(record["camera_angle_x"]) / 2)
        cx, cy = width / 2, height / 2
    pose = np.array(record["transform_matrix"], np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3])) < 1e-9:
        raise ValueError(
            f"{table}: {record['file_path']}: expected a 4x4 transform_matrix, got shape {list(pose.shape)}"
        )
    pose = pose @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z with y up
    pose[:3, :3] /= np.cbrt(np.linalg.det(pose[:3, :3]))
    return _posed_picture(path, Camera(width, height, fx, fy, cx, cy, np.linalg.inv(pose)), settings, k)


def _posed_picture(path: Path, camera: Camera, settings: FitPictureSettings, k: int) -> PosedPicture:
    """Picture k. Transparent pixels show one of BACKGROUNDS; in pictures without any, those of exactly the camera's
    background count as empty."""
    from splatpainter.sources.picture_reader import read_picture

    if settings.size is not None:
        camera = camera.with_longest_side(settings.size)
    picture = read_picture(path)
    ratio = picture.size[0] / picture.size[1] / (camera.width / camera.height)
    if abs(ratio - 1) > 0.01 + 1 / min(camera.width, camera.height):
        size = f"{picture.size[0]}x{picture.size[1]}"
        raise ValueError(f"{path}: expected the aspect ratio of its camera, {camera.width}x{camera.height}, got {size}")
    picture = picture.resized(camera.width, camera.height)
    if picture.alpha is not None:
        camera = replace(camera, background=BACKGROUNDS[k % len(BACKGROUNDS)])
    background = np.array(camera.background, np.float32)
    if picture.alpha is not None:
        alpha = picture.alpha[..., None]
        return camera, picture.colors * alpha + background * (1 - alpha), picture.alpha > 0.02
    return camera, picture.colors, np.abs(picture.colors - background).max(-1) > 3 / 255


def _carved(
    cameras: list[Camera], colors: list[np.ndarray], solid: list[np.ndarray], settings: FitPictureSettings
) -> Splats:
    """Random points that lie before something in every picture that they fall into (a visual hull, where backgrounds
    are known), with their mean colour in the pictures."""
    from splatpainter.fit.start import from_points

    rng = np.random.default_rng(settings.seed)
    center, reach = _common_center(cameras)
    candidates: list[np.ndarray] = []
    for _ in range(TRIES_PER_GAUSSIAN):
        points = center + reach * rng.uniform(-1, 1, (settings.rows, 3))
        count, good = np.zeros(len(points)), np.ones(len(points), bool)
        total = np.zeros((len(points), 3))
        for camera, color, is_solid in zip(cameras, colors, solid, strict=True):
            pixels, z = camera.project(points)
            x, y = np.floor(np.where(z[:, None] > 1e-3, pixels, -1)).astype(np.int64).T
            seen = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            good[seen] &= is_solid[y[seen], x[seen]]
            total[seen] += color[y[seen], x[seen]]
            count[seen] += 1
        good &= count >= min(2, len(cameras))
        candidates.append(np.concatenate([points[good], total[good] / count[good, None]], 1))
        if sum(map(len, candidates)) >= settings.rows:
            break
    both = np.concatenate(candidates)[: settings.rows]
    if len(both) < 16:
        raise ValueError("pictures: no point in space is covered in two of them and empty in none; check their cameras")
    return from_points(both[:, :3], both[:, 3:], settings.sh_degree)


def _common_center(cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """([3] the point nearest to all lines of sight, half the edge of a cube around it that the pictures show)."""
    lines = np.array([camera.forward for camera in cameras])
    eyes = np.array([camera.position for camera in cameras])
    across = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    system = across.sum(0) + 1e-6 * np.eye(3)
    center = np.linalg.solve(system, np.einsum("vij,vj->i", across, eyes) + 1e-6 * eyes.mean(0))
    away = np.linalg.norm(eyes - center, axis=1)
    half = [max(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    return center, float(np.median(away * np.array(half)))
