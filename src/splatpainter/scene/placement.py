"""Where an asset stands in a scene: scaled, turned, moved, in this order, about the origin of the asset's own axes.

    p' = scale * R p + move

The axes are those of every asset in memory (x right, y down, z forward: right-down-front). What is not moved keeps its
bits: a placement without a turn leaves rotations and SH alone, one without a scale the scales, and the identity all.
Where positions are kept relative to an offset (Splats.offset), a placement is of world coordinates; `between` is what
it does to `means`. Sums are written out, and the matrices of the SH bands rounded to so many decimals
(PLACEMENTS.sh_decimals) that every machine gives equal bits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io.positions import Offset, is_coarse, offset_of, relative, steps_in_sizes
from splatpainter.kernels.portable import arccos, arctan2, cos, length, matmul, sin
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix, sh_rotations, snapped


@dataclass(frozen=True)
class PlacementThresholds:
    """Where an asset of a scene may be placed. Source: what float32 holds, and taste."""

    max_move: float = 1e9
    """World units along each axis."""
    min_scale: float = 1e-6
    """Least factor of size."""
    max_scale: float = 1e6
    """Largest factor of size."""
    max_degrees: float = 36_000.0
    """Degrees of a turn about an axis, at most."""
    max_apart: float = 1000.0
    """Distance of two assets, in widths of the wider one, beyond which they lie in different places of the world."""
    max_step_in_scene: float = 1.0
    """Distance between neighbouring float32 numbers, in sizes of the median Gaussian of an asset, that a scene
    bears."""
    max_sample: int = 1 << 14
    """Gaussians of each asset, evenly spread over its rows, by which an offset for all is chosen."""
    sh_decimals: int = 10
    """Decimals of the matrices that turn SH bands: beyond what float32 holds, and short of what libraries of linear
    algebra differ in."""


PLACEMENTS = PlacementThresholds()


NONE = "none"
EXPECTED = "move=X,Y,Z, turn=X,Y,Z (degrees about x, then y, then z) and scale=S, joined by ':', or none"
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"


@dataclass(frozen=True)
class Placement:
    """A similarity transform."""

    move: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """World units."""
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Rotation w, x, y, z of unit length."""
    scale: float = 1.0

    def __post_init__(self) -> None:
        for name, values, limit in (("move", self.move, PLACEMENTS.max_move), ("quat", self.quat, 1.0 + 1e-6)):
            if not all(math.isfinite(value) and abs(value) <= limit for value in values):
                raise ValueError(f"transform: expected {name} within {limit:g}, got {_listed(values)}")
        if abs(math.sqrt(sum(value * value for value in self.quat)) - 1) > 1e-6:
            raise ValueError(f"transform: expected a quaternion of length 1, got {_listed(self.quat)}")
        if not PLACEMENTS.min_scale <= self.scale <= PLACEMENTS.max_scale:
            limits = f"{PLACEMENTS.min_scale:g} to {PLACEMENTS.max_scale:g}"
            raise ValueError(f"transform: expected a scale of {limits}, got {self.scale:g}")

    def point_before(self, point: np.ndarray) -> np.ndarray:
        """[3] float64 the point of the asset's own axes that a point of the scene is; both in world coordinates."""
        turn = quat_to_matrix(np.array(self.quat)[None])[0]
        return matmul(turn.T, np.asarray(point, float) - np.array(self.move)) / self.scale

    @staticmethod
    def of(
        move: tuple[float, float, float] = (0.0, 0.0, 0.0),
        turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
        scale: float = 1.0,
    ) -> Placement:
        """turn: degrees about the x, then the y, then the z axis of the scene. Raises ValueError."""
        if not all(math.isfinite(angle) and abs(angle) <= PLACEMENTS.max_degrees for angle in turn):
            raise ValueError(
                f"transform: expected angles within {PLACEMENTS.max_degrees:g} degrees, got {_listed(turn)}"
            )
        quat = (1.0, 0.0, 0.0, 0.0)
        for axis, degrees in enumerate(turn):
            # Whole turns are taken off first, so that 360000 degrees lose nothing to rounding.
            half = math.radians(math.remainder(degrees, 720.0)) / 2
            step = [cos(half), 0.0, 0.0, 0.0]
            step[1 + axis] = sin(half)
            quat = _product((step[0], step[1], step[2], step[3]), quat)
        # Right angles give exact numbers: a quarter turn must not leave 1e-17 in every mean.
        w, x, y, z = (float(value) for value in snapped(np.array(quat)))
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return Placement((move[0], move[1], move[2]), (w / norm, x / norm, y / norm, z / norm), scale)

    @staticmethod
    def parse(text: str, where: str = "--transform") -> Placement:
        """`move=1,0,0:turn=0,90,0:scale=2`, each part at most once and in any order, or `none`. Raises ValueError."""
        parts = {} if text.strip() == NONE else _parts(text, where)
        try:
            move, turn = (parts.get(name, (0.0, 0.0, 0.0)) for name in ("move", "turn"))
            (scale,) = parts.get("scale", (1.0,))
            return Placement.of((move[0], move[1], move[2]), (turn[0], turn[1], turn[2]), scale)
        except ValueError as error:
            raise ValueError(str(error).replace("transform:", f"{where} {text[:60]!r}:", 1)) from None

    def record(self) -> dict[str, Any]:
        """JSON object of all fields."""
        return {"move": list(self.move), "quat": list(self.quat), "scale": self.scale}

    @staticmethod
    def from_record(data: Any) -> Placement:
        """The inverse of `record`. Raises ValueError."""
        try:
            move, quat = ([_number(value) for value in data[name]] for name in ("move", "quat"))
            if (len(move), len(quat)) != (3, 4):
                raise ValueError("transform: expected three numbers as move and four as quat")
            return Placement((move[0], move[1], move[2]), (quat[0], quat[1], quat[2], quat[3]), _number(data["scale"]))
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"transform: expected move, quat and scale ({error!r:.60})") from None

    @property
    def is_identity(self) -> bool:
        return self.move == (0, 0, 0) and not self.turns and self.scale == 1

    @property
    def turns(self) -> bool:
        """Whether it is more than a move and a scale."""
        return abs(self.quat[0]) != 1

    @property
    def turn(self) -> tuple[float, float, float]:
        """Degrees about x, then y, then z (`of`); about y within 90."""
        # The inverse of `of`: first z, then y, then x, with the one case where two of them coincide.
        m = self.matrix
        y = arctan2(-m[2, 0], length(m[2, 1:]))
        if abs(m[2, 0]) < 1 - 1e-9:
            x, z = arctan2(m[2, 1], m[2, 2]), arctan2(m[1, 0], m[0, 0])
        else:  # x and z turn about one axis
            x, z = arctan2(-m[1, 2], m[1, 1]), 0.0
        return (math.degrees(x), math.degrees(y), math.degrees(z))

    @property
    def matrix(self) -> np.ndarray:
        """[3, 3] float64 the rotation."""
        return snapped(quat_to_matrix(np.array([self.quat]))[0])

    @property
    def text(self) -> str:
        """Text for people: the parts that do something."""
        parts = []
        if self.move != (0, 0, 0):
            parts.append(f"moved by {_listed(self.move)}")
        if self.turns:
            angle = math.degrees(2 * arccos(min(abs(self.quat[0]), 1.0)))
            parts.append(f"turned by {angle:.4g} degrees")
        if self.scale != 1:
            parts.append(f"scaled by {self.scale:.6g}")
        return ", ".join(parts) or "as it is"

    def between(self, offset: Offset, scene: Offset) -> Placement:
        """What this does to `means` that are relative to `offset`, where the scene's are relative to `scene`; this
        itself where both are zero. float64. Raises ValueError where that moves them beyond PLACEMENTS.max_move."""
        return replace(self, move=self._moved_by(1, offset, scene))

    def in_world(self, offset: Offset, scene: Offset) -> Placement:
        """The inverse of `between`."""
        return replace(self, move=self._moved_by(-1, offset, scene))

    def _moved_by(self, sign: int, offset: Offset, scene: Offset) -> tuple[float, float, float]:
        """The move, and `sign` times from `scene` to where `offset` comes to lie without it."""
        if not any(offset) and not any(scene):
            return self.move
        if self.turns or self.scale != 1:
            offset = tuple(replace(self, move=(0.0, 0.0, 0.0)).points(np.array([offset]))[0].tolist())
        x, y, z = (m + sign * (a - b) for m, a, b in zip(self.move, offset, scene, strict=True))
        return x, y, z

    def apply(self, splats: Splats, scene: Offset | None = None) -> Splats:
        """The Gaussians in the scene (numpy); `source` and `origin` stay, so that what does not change keeps its bytes.
        float64 inside. scene: what the scene's `means` are relative to; None: what those of `splats` are."""
        scene = splats.offset if scene is None else scene
        within = self.between(splats.offset, scene)
        out = splats if within.is_identity else within._applied(splats)
        return out if out.offset == scene else replace(out, offset=scene)

    def _applied(self, splats: Splats) -> Splats:
        """This done to `means` as they are."""
        values: dict[str, np.ndarray] = {}
        with np.errstate(all="ignore"):  # Gaussians that cannot be drawn
            # Arrays that a placement does not touch stay the same, and their bytes with them.
            values["means"] = self.points(splats.means).astype(np.float32)
            if self.scale != 1:
                values["scales"] = (splats.scales.astype(np.float64) * self.scale).astype(np.float32)
            if self.turns:
                columns = _product(self.quat, tuple(splats.quats.astype(np.float64).T))
                values["quats"] = np.stack(columns, 1).astype(np.float32)
                values["sh"] = self._turned_sh(splats.sh)
        return replace(splats, **values)

    def points(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] float64 points of the asset -> the same in the scene."""
        x, y, z = np.asarray(points, np.float64).T
        rows = zip(self.matrix, self.move, strict=True)
        return np.stack([self.scale * (row[0] * x + row[1] * y + row[2] * z) + shift for row, shift in rows], 1)

    def camera(self, camera: Camera, offset: Offset | None = None) -> Camera:
        """A camera of the scene as one of the asset's own space, which shows the asset there as this one shows it here.
        Depths are divided by the scale. offset: what the asset's `means` are relative to; None: what the camera is."""
        if offset is not None and camera.offset is not None and (any(offset) or any(camera.offset)):
            return replace(self.between(offset, camera.offset).camera(camera), offset=offset)
        if self.is_identity:
            return camera
        # The camera goes the other way instead of the asset: nothing has to be copied.
        view = np.asarray(camera.world_to_camera, np.float64)
        inside = np.eye(4)
        inside[:3, :3] = matmul(view[:3, :3], self.matrix)
        inside[:3, 3] = (matmul(view[:3, :3], np.array(self.move)) + view[:3, 3]) / self.scale
        return replace(camera, world_to_camera=inside)

    def _turned_sh(self, sh: np.ndarray) -> np.ndarray:
        """[N, K, 3] float32; the constant band keeps its bits."""
        out = sh.copy()
        degree = math.isqrt(sh.shape[1]) - 1
        for l, exact in enumerate(sh_rotations(self.matrix, degree)[1:], 1):
            band = sh[:, l * l : (l + 1) * (l + 1)].astype(np.float64)
            for a, row in enumerate(np.round(exact, PLACEMENTS.sh_decimals)):
                total = row[0] * band[:, 0]
                # Sums written out in one order: libraries of linear algebra differ in theirs.
                for b in range(1, len(row)):
                    total = total + row[b] * band[:, b]
                out[:, l * l + a] = total
        return out


def shift_to_the_right(fixed: np.ndarray, moving: np.ndarray, gap: float = 0.1) -> tuple[float, float, float]:
    """The move along x that sets some points to the right of others; where these lie in another place of the world
    altogether (PLACEMENTS.max_apart), to the same height and depth, too. fixed, moving: [P, 3], [Q, 3] world
    coordinates; gap: share of the wider one's width between them. Strays (1 % at either end) do not count."""
    # Strays would push the assets far apart.
    low, high = (np.quantile(points[:, 0], (0.01, 0.99)) for points in (fixed, moving))
    width = max(low[1] - low[0], high[1] - high[0])
    apart = np.median(fixed, axis=0).astype(np.float64) - np.median(moving, axis=0)
    y, z = apart[1:].tolist() if np.abs(apart).max() > PLACEMENTS.max_apart * width else (0.0, 0.0)
    return (float(np.float32(low[1] + gap * width - high[0])), float(np.float32(y)), float(np.float32(z)))


def scene_offset(assets: Sequence[tuple[Splats, Placement]]) -> Offset:
    """What the `means` of several assets are relative to where they stand together: the offset of all, where they have
    the same and float32 holds their positions beside it; else `offset_of` all of them."""
    points, sizes = [], []
    for splats, placement in assets:
        every = slice(None, None, max(1, len(splats) // PLACEMENTS.max_sample))
        points.append(placement.points(splats.world_means[every]))
        sizes.append(splats.scales[every] * np.float32(placement.scale))
    offset = assets[0][0].offset
    if all(splats.offset == offset for splats, _ in assets):
        if not any(is_coarse(relative(some, offset), scales) for some, scales in zip(points, sizes, strict=True)):
            return offset
    return offset_of(np.concatenate(points), np.concatenate(sizes))


def check_near(name: str, splats: Splats) -> None:
    """Raises ValueError where Gaussians, as they stand in a scene, are so far from its offset that float32 rounds their
    positions by more than PLACEMENTS.max_step_in_scene."""
    steps = steps_in_sizes(splats.means, splats.scales)
    if steps > PLACEMENTS.max_step_in_scene:
        x, y, z = splats.middle.tolist()
        raise ValueError(
            f"{name}: lies ({x:.6g}, {y:.6g}, {z:.6g}) from the middle of the scene, where positions are rounded to "
            f"{steps:.2g} sizes of its Gaussians; bring it nearer by its transform (move=X,Y,Z)"
        )


def _product(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
    """Hamilton product of quaternions (w, x, y, z), numbers or columns."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _parts(text: str, where: str) -> dict[str, tuple[float, ...]]:
    parts: dict[str, tuple[float, ...]] = {}
    for part in re.split(r"[:\s]+", text.strip()):
        name, _, numbers = part.partition("=")
        words = numbers.split(",")
        count = {"move": 3, "turn": 3, "scale": 1}.get(name)
        if count is None or name in parts or len(words) != count:
            raise ValueError(f"{where}: expected {EXPECTED}, got {text[:60]!r}")
        if not all(re.fullmatch(_NUMBER, word) for word in words):
            raise ValueError(f"{where}: expected numbers as {name}, got {numbers[:60]!r}")
        parts[name] = tuple(float(word) for word in words)
    return parts


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"transform: expected numbers, got {value!r:.40}")
    return float(value)


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
