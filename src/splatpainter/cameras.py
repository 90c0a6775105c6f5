"""Pinhole cameras: the frozen type, look-at and orbit helpers, and the JSON that travels with every rendered picture.

OpenCV axes (x right, y down, z forward); pixel centres at +0.5; depth is z. Knows no splats and no renderer.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from splatpainter.atomic import writing
from splatpainter.image_files import encode_png, exr_text, is_exr, quantized

CHUNK = "splatpainter"
"""Keyword of the PNG tEXt chunk, or name of the OpenEXR header attribute, that carries a camera."""
VERSION = 1
MAX_PICTURE_PIXELS = 1 << 26
"""Of a picture that is opened: a few hundred bytes can claim any number. 8192 x 8192."""
Alpha = Literal["straight", "premultiplied"]
"""How a picture that was rendered without a background keeps its colours: as they are, or multiplied by alpha."""
ALPHA = "alpha"
"""Key beside the camera's own that says it."""


@dataclass(frozen=True)
class Camera:
    """One view of a scene."""

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    fx: float
    """Focal length in pixels, > 0."""
    fy: float
    cx: float
    """Principal point in pixels (width / 2 for a centred one)."""
    cy: float
    world_to_camera: np.ndarray = field(compare=False)
    """[4, 4] float64 rigid transform; not part of ==."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the asset, 0..1, in the asset's colour space."""
    asset_sha256: str | None = None
    """The asset a picture was rendered from, to warn about a wrong one."""

    def __post_init__(self) -> None:
        matrix = np.array(self.world_to_camera, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise ValueError(f"camera: expected a finite 4x4 world_to_camera, got shape {matrix.shape}")
        turn = matrix[:3, :3]
        if abs(turn @ turn.T - np.eye(3)).max() > 0.01 or np.linalg.det(turn) < 0 or (matrix[3] != (0, 0, 0, 1)).any():
            raise ValueError("camera: expected a rotation and a translation as world_to_camera (last row 0 0 0 1)")
        if not (self.width > 0 and self.height > 0 and self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera: size and focal lengths must be positive, got {self.width}x{self.height}, {self.fx}, {self.fy}"
            )
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.background))):
            raise ValueError("camera: focal lengths, principal point and background must be finite")
        object.__setattr__(self, "world_to_camera", matrix)

    @property
    def intrinsics(self) -> np.ndarray:
        """[3, 3] K, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def position(self) -> np.ndarray:
        """[3] camera centre in world units."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> np.ndarray:
        """[3] unit viewing direction in world axes."""
        return self.world_to_camera[2, :3] / np.linalg.norm(self.world_to_camera[2, :3])

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution (aspect ratio may differ by rounding only)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The window [x, x + width) x [y, y + height) of this view."""
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """(origin [3], directions [H, W, 3]) through the pixel centres, world space, unit length, float32."""
        with np.errstate(
            over="ignore", invalid="ignore", divide="ignore"
        ):  # rays of absurd lenses are NaN and hit nothing
            u = (np.arange(self.width) + 0.5 - self.cx) / self.fx
            v = (np.arange(self.height) + 0.5 - self.cy) / self.fy
            local = np.stack([*np.meshgrid(u, v), np.ones((self.height, self.width))], -1)
            world = local @ self.world_to_camera[:3, :3]
            world /= np.linalg.norm(world, axis=-1, keepdims=True)
        return self.position.astype(np.float32), world.astype(np.float32)

    def to_json(self) -> str:
        """The object of design.md 5, as one line."""
        return json.dumps(
            {
                "version": VERSION,
                "width": self.width,
                "height": self.height,
                "fx": self.fx,
                "fy": self.fy,
                "cx": self.cx,
                "cy": self.cy,
                "world_to_camera": self.world_to_camera.tolist(),
                "background": list(self.background),
                "asset_sha256": self.asset_sha256,
            }
        )

    @staticmethod
    def from_json(text: str, where: str = "camera") -> Camera:
        """Parse `to_json`'s object. Raises ValueError naming `where` and the field that is wrong."""
        try:
            data: dict[str, Any] = json.loads(text)
        except (ValueError, RecursionError) as error:  # not only JSONDecodeError: digits and depth have limits
            raise ValueError(f"{where}: expected a camera as JSON, got {text[:40]!r} ({error})") from None
        if not isinstance(data, dict):
            raise ValueError(f"{where}: expected a JSON object, got {type(data).__name__}")
        if data.get("version") != VERSION:
            raise ValueError(f"{where}: expected camera version {VERSION}, got {repr(data.get('version'))[:80]}")
        try:
            red, green, blue = (float(c) for c in data.get("background") or (0, 0, 0))
            return Camera(
                width=_whole(data["width"]),
                height=_whole(data["height"]),
                fx=float(data["fx"]),
                fy=float(data["fy"]),
                cx=float(data["cx"]),
                cy=float(data["cy"]),
                world_to_camera=np.array(data["world_to_camera"], np.float64),
                background=(red, green, blue),
                asset_sha256=data.get("asset_sha256"),
            )
        except KeyError as error:
            raise ValueError(f"{where}: the camera has no {error}") from None
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{where}: {' '.join(str(error).split())[:200]}") from None


def _whole(value: Any) -> int:
    if int(value) != float(value):
        raise ValueError(f"expected whole pixels, got {value}")
    return int(value)


def look_at(
    eye: Sequence[float] | np.ndarray,
    target: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    *,
    width: int = 512,
    height: int = 512,
    fov: float = 50.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Camera:
    """A camera at `eye` facing `target`. up: the world direction that points up in the picture (any length, not along
    the view). fov: vertical field of view in degrees, above 0 and below 180. Raises ValueError where these give no
    camera."""
    position, aim, upward = (np.asarray(point, np.float64) for point in (eye, target, up))
    if not np.isfinite([position, aim, upward]).all() or (position == aim).all() or not upward.any():
        raise ValueError(f"look_at: expected two different points and an up direction, got {eye}, {target}, {up}")
    if not 0 < fov < 180:
        raise ValueError(f"look_at: expected a fov between 0 and 180 degrees, got {fov}")
    z = aim - position
    z /= np.linalg.norm(z)
    x = np.cross(z, upward)
    if np.linalg.norm(x) < 1e-6 * np.linalg.norm(upward):  # looking straight along up: any horizontal will do
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, z])
    matrix[:3, 3] = -matrix[:3, :3] @ position
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    return Camera(width, height, focal, focal, width / 2, height / 2, matrix, background)


def orbit(
    center: Sequence[float] | np.ndarray,
    radius: float,
    count: int,
    *,
    elevation: float = 15.0,
    start: float = 0.0,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    width: int = 512,
    height: int = 512,
    fov: float = 50.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Camera]:
    """`count` cameras evenly around `center` at `radius` (world units), looking at it. elevation and start: degrees,
    above the horizon and of the first camera around `up`."""
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    front = np.cross(side, axis)
    tilt = math.radians(elevation)
    cameras = []
    for angle in np.radians(start + 360.0 * np.arange(count) / max(count, 1)):
        flat = math.cos(angle) * front + math.sin(angle) * side
        eye = np.asarray(center) + radius * (math.cos(tilt) * flat + math.sin(tilt) * axis)
        cameras.append(look_at(eye, center, axis, width=width, height=height, fov=fov, background=background))
    return cameras


def write_png(path: str | Path, image: np.ndarray, camera: Camera | None = None) -> None:
    """Write [H, W, 3] colours (float 0..1, or uint8) as an 8-bit PNG, with its camera in the tEXt chunk if given.
    It appears whole or not at all. Raises ValueError where it cannot be written."""
    data = encode_png(to_uint8(image), None if camera is None else {CHUNK: camera.to_json()})
    with writing(Path(path)) as file:
        file.write(data)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Float 0..1 -> 0..255, rounded to nearest; uint8 passes through."""
    return image if image.dtype == np.uint8 else quantized(image)


def find_camera(png: str | Path, explicit: str | Path | None = None) -> Camera:
    """The camera of a picture: the explicit JSON file, else the PNG's chunk, else the sidecar NAME.json beside it.
    Raises ValueError when none is there or the one found is broken."""
    text, where = _camera_text(Path(png), None if explicit is None else Path(explicit))
    if text is None:
        sidecar = Path(png).with_suffix(".json")
        raise ValueError(
            f"{png}: no camera; expected one in the PNG ({CHUNK} chunk), in {sidecar.name}, or given with --camera"
        )
    return Camera.from_json(text, where)


def find_alpha(png: str | Path, explicit: str | Path | None = None) -> Alpha | None:
    """How a picture that was rendered without a background keeps its colours, as it says beside its camera, looked for
    as by `find_camera`; None for other pictures. OpenEXR is "straight": its readers take the alpha out again."""
    try:
        text, _ = _camera_text(Path(png), None if explicit is None else Path(explicit))
        data = json.loads(text or "{}")
    except (ValueError, RecursionError):
        return None
    said = data.get(ALPHA) if isinstance(data, dict) else None
    if said not in get_args(Alpha):
        return None
    return "straight" if is_exr(Path(png)) else said


def _camera_text(picture: Path, explicit: Path | None) -> tuple[str | None, str]:
    """(the JSON of a camera or None, where it was found)."""
    from PIL import Image

    if explicit is not None:
        return _read_text(explicit), str(explicit)
    if is_exr(picture):
        text, kind = exr_text(picture, CHUNK, MAX_PICTURE_PIXELS), "EXR header"
    else:
        kind = "PNG chunk"
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Pillow's remarks about damaged tags
                with Image.open(picture) as image:
                    # `text` decodes the picture, to look for chunks behind it: only where none stands ahead.
                    text = image.info.get(CHUNK) or getattr(image, "text", {}).get(CHUNK)
        except Exception as error:  # decoders of damaged files raise anything
            raise ValueError(f"{picture}: cannot be read as a picture ({_reason(error)})") from None
    if text:
        return text, f"{picture} ({kind})"
    sidecar = picture.with_suffix(".json")
    return (_read_text(sidecar), str(sidecar)) if sidecar.exists() else (None, "")


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # editors of Windows begin files with a mark
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: cannot be read as a camera ({_reason(error)})") from None


def _reason(error: BaseException) -> str:
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(said.split())[:200]
