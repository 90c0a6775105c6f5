"""Pinhole cameras: the frozen type, where to stand, and the JSON that travels with every rendered picture.

OpenCV axes (x right, y down, z forward); pixel centres at +0.5; depth is z. Knows no renderer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any, Literal

import numpy as np

from splatpainter.array_types import Floats, FloatsOrTensor
from splatpainter.kernels import portable
from splatpainter.order_statistics import median, quantile
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import GOLDEN_ANGLE, row_max, row_norm, stacked

VERSION = 1
MIN_FRAMED_OPACITY = 0.1
"""Fainter Gaussians are haze and floaters; they do not decide where the asset is."""
FRAME_MARGIN = 1.08
"""Room around an asset in a picture of all of it, as a factor of its radius."""
UPS = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
UpAxis = Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"]
AUTO_UP = "-y"
"""Up of every asset in memory unless its maker thought otherwise: structure from motion has y down, so do INRIA's PLY
files, and the readers of formats with y up (SPZ, GLB) turn what they read into these axes (io/axes.py)."""


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
    world_to_camera: Floats = field(compare=False)
    """[4, 4] float64 rigid transform; not part of ==."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour behind the asset, 0..1, in the asset's colour space."""
    asset_sha256: str | None = None
    """The asset a picture was rendered from, to warn about a wrong one."""
    offset: tuple[float, float, float] | None = field(default=(0.0, 0.0, 0.0), compare=False)
    """World coordinates (float64) of the point that `world_to_camera` takes as the origin, as `Splats.offset`; None:
    that of the asset, whatever it is, as the studio's page has it."""

    def __post_init__(self) -> None:
        matrix = np.array(self.world_to_camera, np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            actual = "NaN or infinity in it" if matrix.shape == (4, 4) else f"shape {matrix.shape}"
            raise ValueError(f"camera: expected a finite 4x4 world_to_camera, got {actual}")
        r = matrix[:3, :3]
        products = (r[:, None] * r[None]).sum(2)  # r r^T
        left_handed = (np.cross(r[0], r[1]) * r[2]).sum() < 0
        if abs(products - np.eye(3)).max() > 0.01 or left_handed or (matrix[3] != (0, 0, 0, 1)).any():
            raise ValueError("camera: expected a rotation and a translation as world_to_camera (last row 0 0 0 1)")
        if not (self.width > 0 and self.height > 0 and self.fx > 0 and self.fy > 0):
            raise ValueError(
                f"camera: size and focal lengths must be positive, got {self.width}x{self.height}, {self.fx}, {self.fy}"
            )
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.background))):
            raise ValueError("camera: focal lengths, principal point and background must be finite")
        if self.offset is not None and not (len(self.offset) == 3 and all(map(math.isfinite, self.offset))):
            raise ValueError(f"camera: expected three finite numbers as offset, got {self.offset}")
        object.__setattr__(self, "world_to_camera", matrix)

    def relative_to(self, offset: tuple[float, float, float]) -> Camera:
        """The same view for points that are relative to another `offset` (of Splats), computed in float64; this camera
        itself where it has that one already, and one of no offset of its own stays where it is beside the asset."""
        if self.offset == offset:
            return self
        if self.offset is None:
            return replace(self, offset=offset)
        matrix = self.world_to_camera.copy()
        matrix[:3, 3] += portable.matmul(matrix[:3, :3], np.array(offset) - np.array(self.offset))
        return replace(self, world_to_camera=matrix, offset=offset)

    def within(self, offset: tuple[float, float, float]) -> Camera:
        """`relative_to`, of no offset of its own any more: for what draws parts of an asset that forgot the offset."""
        camera = self.relative_to(offset)
        return camera if camera.offset == (0, 0, 0) else replace(camera, offset=None)

    @property
    def local(self) -> Camera:
        """The same camera as one of no offset of its own: for cameras that are placed by an asset's own `means`."""
        return replace(self, offset=None)

    @property
    def intrinsics(self) -> np.ndarray:
        """[3, 3] K, pixels."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def position(self) -> np.ndarray:
        """[3] camera centre in world units."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -(rotation * translation[:, None]).sum(0)

    @property
    def camera_to_world(self) -> Floats:
        """[4, 4] float64 inverse of `world_to_camera`."""
        return np.linalg.inv(self.world_to_camera)

    @property
    def forward(self) -> np.ndarray:
        """[3] unit viewing direction in world axes."""
        return self.world_to_camera[2, :3] / portable.length(self.world_to_camera[2, :3])

    def to_camera(self, points: FloatsOrTensor) -> FloatsOrTensor:
        """World points [..., 3] in camera axes; float64 of numpy arrays, the dtype and device of tensors."""
        if isinstance(points, np.ndarray):
            turned = portable.matmul(points.astype(np.float64, copy=False), self.world_to_camera[:3, :3].T)
            return turned + self.world_to_camera[:3, 3]
        import torch

        matrix = torch.as_tensor(self.world_to_camera, dtype=points.dtype, device=points.device)
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3] in camera axes as world points, float64; the inverse of `to_camera`."""
        return portable.matmul(points - self.world_to_camera[:3, 3], self.world_to_camera[:3, :3])

    def project(self, points: FloatsOrTensor) -> tuple[FloatsOrTensor, FloatsOrTensor]:
        """(pixels x, y [..., 2], depths z [...]) of world points [..., 3]; numbers as of `to_camera`. Pixels mean
        something where z > 0 only."""
        local = self.to_camera(points)
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = self.fx * x / z + self.cx, self.fy * y / z + self.cy
        return stacked([u, v], local), z

    def unproject(self, depth: np.ndarray, pixels: np.ndarray | None = None) -> np.ndarray:
        """World points [..., 3], float64, of `pixels` [..., 2] at z-depths [...], the inverse of `project`; without
        pixels of all pixel centres, at depths [H, W]."""
        if pixels is None:
            assert depth.shape == (self.height, self.width)
            lines = self._center_lines()
        else:
            lines = self.sight_lines(pixels)
        return self.to_world(lines * depth[..., None])

    def slopes(self, pixels: np.ndarray) -> np.ndarray:
        """[..., 2] x / z and y / z, in camera axes, of what pixels [..., 2] (x, y; centres at .5) show."""
        return self.sight_lines(pixels)[..., :2]

    def sight_lines(self, pixels: np.ndarray) -> np.ndarray:
        """[..., 3] directions of z = 1, in camera axes, through pixels [..., 2] (x, y; centres at .5)."""
        return self._lines(pixels[..., 0], pixels[..., 1])

    def _center_lines(self) -> np.ndarray:
        """[H, W, 3] `sight_lines` of all pixel centres."""
        return self._lines(np.arange(self.width) + 0.5, np.arange(self.height)[:, None] + 0.5)

    def _lines(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """[..., 3] `sight_lines` of pixels whose x and y broadcast: columns and rows of a picture need not be repeated
        for each pixel."""
        u, v = (x - self.cx) / self.fx, (y - self.cy) / self.fy
        lines = np.ones((*np.broadcast_shapes(u.shape, v.shape), 3), np.result_type(u, v))
        lines[..., 0], lines[..., 1] = u, v
        return lines

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution (aspect ratio may differ by rounding only)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def with_longest_side(self, pixels: int) -> Camera:
        """The same view with so many pixels on its longer side, and at least one on the other."""
        scale = pixels / max(self.width, self.height)
        return self.resized(max(1, round(self.width * scale)), max(1, round(self.height * scale)))

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The window [x, x + width) x [y, y + height) of this view."""
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """(origin [3], directions [H, W, 3]) through the pixel centres, world space, unit length, float32."""
        with np.errstate(
            over="ignore", invalid="ignore", divide="ignore"
        ):  # rays of absurd lenses are NaN and hit nothing
            world = portable.matmul(self._center_lines(), self.world_to_camera[:3, :3])
            world /= np.linalg.norm(world, axis=-1, keepdims=True)
        return self.position.astype(np.float32), world.astype(np.float32)

    def record(self) -> dict[str, Any]:
        """JSON values of all that it is, in the order in which files have them."""
        record = {
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
        if self.offset is None or any(self.offset):
            record["offset"] = None if self.offset is None else list(self.offset)
        return record

    def to_json(self) -> str:
        """The object that pictures carry, as one line (docs/CONVENTIONS.md says what each key means)."""
        return json.dumps(self.record())

    @staticmethod
    def from_json(text: str, where: str = "camera") -> Camera:
        """Parse `to_json`'s object. Raises ValueError naming `where` and the field that is wrong."""
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:  # not only JSONDecodeError: digits and depth have limits
            raise ValueError(f"{where}: expected a camera as JSON, got {text[:40]!r} ({error})") from None
        return Camera.from_record(data, where)

    @staticmethod
    def from_record(data: Any, where: str = "camera") -> Camera:
        """The camera of `record`'s values. Raises ValueError naming `where` and the field that is wrong."""
        if not isinstance(data, dict):
            raise ValueError(f"{where}: expected a JSON object, got {type(data).__name__}")
        if data.get("version") != VERSION:
            other = "" if "version" in data else "; no camera that splatpainter wrote: give another, or move it away"
            raise ValueError(f"{where}: expected camera version {VERSION}, got {repr(data.get('version'))[:80]}{other}")
        if not isinstance(data.get("asset_sha256"), str | None):
            raise ValueError(f"{where}: expected a text as asset_sha256, got {repr(data['asset_sha256'])[:80]}")
        try:
            offset = data.get("offset", (0.0, 0.0, 0.0))
            return Camera(
                width=_pixel_count(data["width"], "width"),
                height=_pixel_count(data["height"], "height"),
                fx=_number(data["fx"], "fx"),
                fy=_number(data["fy"], "fy"),
                cx=_number(data["cx"], "cx"),
                cy=_number(data["cy"], "cy"),
                world_to_camera=_matrix(data["world_to_camera"]),
                background=_three_numbers(data.get("background") or (0, 0, 0), "background"),
                asset_sha256=data.get("asset_sha256"),
                offset=None if offset is None else _three_numbers(offset, "offset"),
            )
        except KeyError as error:
            raise ValueError(f"{where}: the camera has no {error}") from None
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{where}: {' '.join(str(error).split())[:200]}") from None


def _number(value: Any, name: str) -> float:
    """A number of a camera's record, also as text. Python's words for anything else name neither key nor value."""
    try:
        if not isinstance(value, bool):  # float(True) is 1
            return float(value)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"camera: expected a number as {name}, got {repr(value)[:80]}")


def _pixel_count(value: Any, name: str) -> int:
    number = _number(value, name)
    if not number.is_integer():  # NaN and infinity are none either
        raise ValueError(f"camera: expected whole pixels as {name}, got {repr(value)[:80]}")
    return int(number)


def _three_numbers(values: Any, name: str) -> tuple[float, float, float]:
    if not isinstance(values, list | tuple) or len(values) != 3:
        raise ValueError(f"camera: expected three numbers as {name}, got {repr(values)[:80]}")
    x, y, z = (_number(value, name) for value in values)
    return x, y, z


def _matrix(rows: Any) -> Floats:
    """[4, 4] float64, if these are such rows; `Camera` judges the numbers."""
    try:
        return np.array(rows, np.float64)
    except (TypeError, ValueError, OverflowError):  # rows of uneven length, words
        raise ValueError(f"camera: expected 4 rows of 4 numbers as world_to_camera, got {repr(rows)[:80]}") from None


def same_camera(a: Camera, b: Camera) -> bool:
    """Whether two cameras show the same view: == leaves the matrix out."""
    return a == b and np.array_equal(a.world_to_camera, b.world_to_camera)


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
    # Judged first: a camera of NaN would be noticed far from here.
    position, aim, upward = (np.asarray(point, np.float64) for point in (eye, target, up))
    if not np.isfinite([position, aim, upward]).all() or (position == aim).all() or not upward.any():
        raise ValueError(f"look_at: expected two different points and an up direction, got {eye}, {target}, {up}")
    if not 0 < fov < 180:
        raise ValueError(f"look_at: expected a fov between 0 and 180 degrees, got {fov}")
    # OpenCV's axes: z into the picture, x to the right, y down, so that y is z cross x.
    z = aim - position
    z /= portable.length(z)
    x = np.cross(z, upward)
    if portable.length(x) < 1e-6 * portable.length(upward):  # looking straight along up: any horizontal will do
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= portable.length(x)
    y = np.cross(z, x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, z])
    matrix[:3, 3] = -(matrix[:3, :3] * position).sum(1)
    half = math.radians(fov) / 2
    focal = height / 2 * portable.cos(half) / portable.sin(half)
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
    # Two directions across the axis; which ones is of no matter but must be the same on every run.
    axis = np.asarray(up, np.float64)
    axis = axis / portable.length(axis)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= portable.length(side)
    front = np.cross(side, axis)
    tilt = math.radians(elevation)
    cameras = []
    # Evenly over the circle without its end, which is its beginning.
    for angle in np.radians(start + 360.0 * np.arange(count) / max(count, 1)):
        flat = portable.cos(angle) * front + portable.sin(angle) * side
        eye = np.asarray(center) + radius * (portable.cos(tilt) * flat + portable.sin(tilt) * axis)
        cameras.append(look_at(eye, center, axis, width=width, height=height, fov=fov, background=background))
    return cameras


def bounding_sphere(splats: Splats) -> tuple[np.ndarray, float]:
    """([3] centre, relative to the offset, and radius) of a ball around nearly all opaque Gaussians; one in three may
    be a floater, however far.

    (0, 0, 0) and 1 where none can be drawn. Those beyond three median distances from the median centre are left out;
    of the others the middle of the central 98 % per axis is the centre, and 98 % lie within the radius."""
    # Faint Gaussians say nothing about where the object is, and are often far from it.
    arrays = splats.numpy()
    drawable = splats.drawable
    opaque = drawable & (arrays.opacities > MIN_FRAMED_OPACITY)
    means = arrays.means[opaque if opaque.any() else drawable].astype(np.float64)
    if not len(means):
        return np.zeros(3), 1.0
    # The median stands where most Gaussians are, wherever floaters pull the mean.
    distances = row_norm(means - median(means))
    reach = median(distances)
    core = means[distances <= 3 * reach] if reach > 0 else means
    low, high = quantile(core, 0.01), quantile(core, 0.99)
    center = (low + high) / 2
    radius = float(quantile(row_norm(core - center), 0.98))
    typical = float(median(row_max(arrays.scales[drawable])))
    return center, max(radius, 3 * typical, 1e-6)  # one Gaussian, or all at one point, is still something to look at


def orbit_cameras(
    splats: Splats,
    count: int,
    *,
    size: int,
    up: str = "auto",
    elevation: float = 15.0,
    azimuth: float = 0.0,
    fov: float = 40.0,
    distance: float | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Camera]:
    """`count` square views around the asset, relative to its offset. up: "auto" or a key of UPS; elevation and
    azimuth: degrees, above the horizon and of the first view around `up`; fov: vertical, degrees; distance: of the eye
    from the centre, world units, by default so that the asset fills the picture."""
    # The cone of the field of view touches the ball, with a margin.
    center, radius = bounding_sphere(splats)
    if distance is None:
        distance = FRAME_MARGIN * radius / float(portable.sin(math.radians(fov / 2)))
    axis = UPS[AUTO_UP if up == "auto" else up]
    around = {"elevation": elevation, "start": azimuth, "up": axis, "fov": fov, "background": background}
    cameras = orbit(center, distance, count, width=size, height=size, **around)
    return [replace(camera, offset=splats.offset) for camera in cameras]


def spherical_cameras(
    center: Sequence[float] | np.ndarray,
    distance: float,
    count: int,
    *,
    size: int = 256,
    fov: float = 40.0,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    backgrounds: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 0.0),),
    between: bool = False,
) -> list[Camera]:
    """`count` square views from `distance` (world units) around `center` by Fibonacci's lattice, which gives
    each the same solid angle.

    fov: degrees. backgrounds: taken in turn. between: another lattice, turned by half a step: views that are not those
    of the first."""
    axis = np.asarray(up, np.float64)
    axis = axis / portable.length(axis)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= portable.length(side)
    front = np.cross(axis, side)
    cameras = []
    for k in range(count):
        # Heights in equal steps cut the sphere into bands of equal area (Archimedes); the golden angle spreads them
        # around.
        height = 1 - (2 * k + 1) / count
        angle = GOLDEN_ANGLE * (k + 0.5 * between)
        flat = portable.cos(angle) * side + portable.sin(angle) * front
        eye = np.asarray(center) + distance * (height * axis + np.sqrt(1 - height**2) * flat)
        background = backgrounds[k % len(backgrounds)]
        cameras.append(look_at(eye, center, axis, width=size, height=size, fov=fov, background=background))
    return cameras
