"""One rendered view: what it shows besides colours (arbitrary output variables, as compositors want them), and the
files that it becomes: the picture with its camera inside, its AOVs, and the sidecar that says how to read them.

A pixel's weights are the renderer's, w_i = alpha_i T_i, so that every pass lies exactly over the picture. PNG holds
display colours (sRGB, IEC 61966-2-1), clipped to 0..1. OpenEXR holds linear light of sRGB primaries, not clipped,
multiplied by alpha as the format wants.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import to_display, to_light
from splatpainter.image_files import (
    ALPHA_KEY,
    CAMERA_KEYWORD,
    HALF_MAX,
    Alpha,
    encode_exr,
    encode_png,
    quantized,
    require_deep,
)
from splatpainter.kernels.portable import matmul
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.pictures.picture_reader import unpremultiplied
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ColorSpace, Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface
from splatpainter.system.quick_dataclass import dataclass

Aov = Literal["alpha", "depth", "normal", "gaussian-ids", "coverage"]
PictureFormat = Literal["png", "exr"]
BITS: dict[PictureFormat, tuple[int, ...]] = {"png": (8, 16), "exr": (16, 32)}
"""Bits of a sample that each format can have, the default first."""
MIN_SURFACE_ALPHA = 0.5
"""Pixels with less alpha show no surface."""
MAX_PNG_IDS = (1 << 24) - 1
"""Gaussians that three 8-bit channels can name."""


@dataclass(frozen=True)
class Passes:
    """One view of a splat asset; H, W: the camera's pixels."""

    colors: np.ndarray
    """[H, W, 3] float32 sum_i w_i c_i + (1 - alpha) background, in the asset's colour space."""
    alpha: np.ndarray
    """[H, W] float32 sum_i w_i, 0..1."""
    depth: np.ndarray
    """[H, W] float32 sum_i w_i z_i / alpha: distance along the viewing direction, world units; 0 where alpha is 0. With
    a surface: that of the surface, where one is trusted."""
    normal: np.ndarray | None = None
    """[H, W, 3] float32 sum_i w_i n_i, made unit length: outward normals in world axes; 0 where nothing is drawn.
    With a surface: that of the surface (towards the viewer), where one is trusted."""
    gaussian_ids: np.ndarray | None = None
    """[H, W] int64 the Gaussian with the largest w_i; -1 where nothing is drawn."""
    coverage: np.ndarray | None = None
    """[H, W, 3] float32 parts of alpha: Gaussians predicted and not seen, Gaussians seen by edited views, Gaussians as
    they were."""


def normals_of(splats: Splats) -> np.ndarray:
    """[N, 3] float32 outward unit normals; zeros for Gaussians that cannot be drawn."""
    return outward_normals(splats) if splats.drawable.any() else np.zeros((len(splats), 3), np.float32)


def draw_passes(
    splats: Splats,
    camera: Camera,
    aovs: Collection[Aov] = (),
    *,
    profile: Profile = "inria",
    normals: np.ndarray | None = None,
    coverage: tuple[np.ndarray, np.ndarray] | None = None,
    surface: Surface | None = None,
) -> Passes:
    """Draw colours, alpha, depth, and what `aovs` names besides.

    splats: numpy attributes. profile: as in `render`. normals: [N, 3] of `normals_of`, computed where they are
    wanted and not given (the same for all views of an asset). coverage: [N] bool Gaussians predicted and [N] bool
    Gaussians seen, both False for Gaussians as they were. surface: where given, depth and normal are the surface's
    wherever it is trusted. Raises ValueError as `render`, and for "coverage" without one."""
    if "coverage" in aovs and coverage is None:
        raise ValueError(
            "coverage: only a session records which Gaussians its edits saw; export the view from a session"
        )
    # One picture gives the first three; most exports want no more.
    drawn = render(splats, camera, profile=profile)
    colors, alpha, depth = drawn.colors[0], drawn.alphas[0, ..., 0], drawn.depths[0, ..., 0]
    on_surface = surface is not None and bool({"normal", "depth"} & {*aovs})
    if not {"normal", "gaussian-ids", "coverage"} & {*aovs} and not on_surface:
        return Passes(colors, alpha, depth)
    normal = gaussian_ids = parts = None
    # Other passes are blends of other values with the same weights, so geometry is projected once. Black behind them,
    # as a background is no part of a sum.
    view = project(splats, replace(camera, background=(0.0, 0.0, 0.0)))

    def blend(values: np.ndarray) -> np.ndarray:
        """[H, W, 3] sum_i w_i v_i of values [N, 3]."""
        image, weight, distance = np.empty_like(colors), np.empty_like(alpha), np.empty_like(depth)
        view.rasterize_into(image, weight, distance, values[view.gaussian_ids].astype(colors.dtype), profile)
        return image

    if "normal" in aovs:
        # Blended normals are shorter where surfaces of different directions show through one another.
        summed = blend(normals_of(splats) if normals is None else normals)
        length = np.linalg.norm(summed, axis=-1, keepdims=True)
        normal = np.where(length > 1e-6, summed / np.maximum(length, 1e-6), 0).astype(np.float32)
    if surface is not None and on_surface:
        # Where the estimated surface is trusted, it takes the place of blends, whose depth lies between layers.
        ys, xs = np.nonzero(alpha > MIN_SURFACE_ALPHA)
        lattice = visible_surface(surface, splats, view, alpha > MIN_SURFACE_ALPHA)
        seen = lattice.at(np.stack([xs, ys], 1) + 0.5)
        trusted = seen.depth > 0
        ys, xs = ys[trusted], xs[trusted]
        depth[ys, xs] = seen.depth[trusted]
        if normal is not None:
            normal[ys, xs] = matmul(seen.normals[trusted], camera.world_to_camera[:3, :3])
    if "gaussian-ids" in aovs:
        gaussian_ids = view.heaviest_gaussians(profile)
    if "coverage" in aovs and coverage is not None:
        predicted, seen = coverage
        parts = blend(np.stack([predicted, seen, ~(predicted | seen)], -1))
    return Passes(colors, alpha, depth, normal, gaussian_ids, parts)


@dataclass(frozen=True)
class PictureOptions:
    """What files a view becomes. Raises ValueError for what does not go together."""

    format: PictureFormat = "png"
    bits: int | None = None
    """Bits of a colour sample: PNG 8 or 16, OpenEXR 16 or 32 (floats); None: the first of these."""
    transparent: Alpha | None = None
    """No background, an alpha channel instead: PNG with colours as they are ("straight", as the PNG specification
    wants) or multiplied by alpha; OpenEXR only the latter."""
    aovs: tuple[Aov, ...] = ()
    profile: Profile = "inria"
    """Which renderer to match, as in `render`."""
    level: int = 6
    """Level of PNG compression; 1 is fast."""

    def __post_init__(self) -> None:
        # Refused when the options are made: before a minute of rendering, not after it.
        if self.format not in BITS:
            raise ValueError(f"picture: expected the format png or exr, got {self.format!r}")
        if self.bits is not None and self.bits not in BITS[self.format]:
            low, high = BITS[self.format]
            raise ValueError(f"picture: expected {low} or {high} bits of {self.format.upper()}, got {self.bits}")
        if self.transparent not in (None, *get_args(Alpha)):
            raise ValueError(f"picture: expected transparent straight or premultiplied, got {self.transparent!r}")
        if self.format == "exr" and self.transparent == "straight":
            raise ValueError("picture: OpenEXR colours are multiplied by alpha; expected transparent premultiplied")
        for name in self.aovs:
            if name not in get_args(Aov):
                raise ValueError(f"picture: expected AOVs of {', '.join(get_args(Aov))}, got {name!r}")
        if len(set(self.aovs)) < len(self.aovs):
            raise ValueError(f"picture: expected every AOV once, got {', '.join(self.aovs)}")

    @property
    def depth(self) -> int:
        """Bits of a colour sample."""
        return self.bits or BITS[self.format][0]

    def file_names(self, stem: str) -> list[str]:
        """The picture, its AOVs, the sidecar."""
        pictures = [f"{stem}.{self.format}", *(f"{stem}.{name}.{self.format}" for name in self.aovs)]
        return [*pictures, f"{stem}.json"]

    def check_installed(self) -> None:
        """Raises ValueError where these files need a library that is not installed."""
        if self.format == "exr":
            require_deep("OpenEXR")
        elif self.depth == 16:
            require_deep("16-bit colour PNG")


def view_files(
    splats: Splats,
    camera: Camera,
    stem: str,
    options: PictureOptions = PictureOptions(),
    *,
    normals: np.ndarray | None = None,
    coverage: tuple[np.ndarray, np.ndarray] | None = None,
    surface: Surface | None = None,
) -> dict[str, bytes]:
    """Render a view: file name -> its bytes, in the order of `options.file_names(stem)`. Arguments and errors besides
    as `draw_passes`; ValueError also where a library is missing or a PNG cannot number so many Gaussians.

    AOVs. alpha: 0..1. depth: z in world units, in PNG as 16-bit grey, 0 nothing and 1..65535 from `near` to `far`.
    normal: world axes, in PNG 0.5 + 0.5 n. gaussian-ids: index + 1, 0 nothing; in PNG R + 256 G + 65536 B, in
    OpenEXR an unsigned channel "id". coverage: R predicted, G seen by an edited view, B as it was; their sum is
    alpha."""
    options.check_installed()
    if options.format == "png" and "gaussian-ids" in options.aovs and len(splats) > MAX_PNG_IDS:
        raise ValueError(
            f"gaussian-ids: a PNG numbers {MAX_PNG_IDS:,} Gaussians, got {len(splats):,}; use --format exr"
        )
    # The camera travels inside of every picture, so that it can be edited and read back without a sidecar.
    camera = camera.relative_to(splats.offset)  # which the picture carries
    passes = draw_passes(
        splats, camera, options.aovs, profile=options.profile, normals=normals, coverage=coverage, surface=surface
    )
    record = camera.record()
    if options.transparent:
        record[ALPHA_KEY] = options.transparent
    text = {CAMERA_KEYWORD: json.dumps(record)}
    files = {f"{stem}.{options.format}": _picture(passes, camera, options, splats.color_space, text)}
    notes: dict[str, Any] = {}
    for name in options.aovs:
        file = f"{stem}.{name}.{options.format}"
        samples, notes[name] = _aov(name, passes, options)
        notes[name] = {"file": file, **notes[name]}
        if options.format == "png":
            files[file] = encode_png(samples, level=options.level, data=True)
        else:
            channels = {1: ("id" if name == "gaussian-ids" else "Y",), 3: ("R", "G", "B")}[samples.shape[2]]
            files[file] = encode_exr(samples, channels, linear=False)
    # The sidecar says in words what each file's numbers mean, with the range of a depth that only it knows.
    if notes:
        record["aov"] = notes
    files[f"{stem}.json"] = json.dumps(record).encode() + b"\n"
    return files


def _picture(passes: Passes, camera: Camera, options: PictureOptions, space: ColorSpace, text: dict[str, str]) -> bytes:
    colors, alpha = passes.colors, passes.alpha[..., None]
    # The background was blended in; what is left without it is divided by alpha, as files keep colours straight.
    if options.transparent:
        colors = unpremultiplied(colors - (1 - alpha) * np.asarray(camera.background, colors.dtype), passes.alpha)
    if options.format == "exr":
        light = np.nan_to_num(to_light(colors, space))
        if options.transparent:
            light = np.concatenate([light * alpha, alpha], -1)
        samples = np.clip(light, 0, HALF_MAX).astype(np.float16 if options.depth == 16 else np.float32)
        return encode_exr(samples, ("R", "G", "B", "A")[: samples.shape[2]], text)
    display = np.clip(to_display(colors, space), 0, 1)
    if options.transparent:
        display = np.concatenate([display * alpha if options.transparent == "premultiplied" else display, alpha], -1)
    return encode_png(quantized(display, options.depth), text, options.level)


def _aov(name: Aov, passes: Passes, options: PictureOptions) -> tuple[np.ndarray, dict[str, Any]]:
    """(samples as they are stored, what the sidecar says of them)."""
    png = options.format == "png"
    if name == "gaussian-ids":
        assert passes.gaussian_ids is not None
        numbers = (passes.gaussian_ids + 1)[..., None].astype(np.uint32)
        if not png:
            return numbers, {"channel": "id", "meaning": "row + 1, 0 where nothing is drawn"}
        packed = np.concatenate([numbers, numbers >> 8, numbers >> 16], -1) & 255
        return packed.astype(np.uint8), {"meaning": "R + 256 G + 65536 B = row + 1, 0 where nothing is drawn"}
    if name == "depth":
        # 16 bits spread over the range that is drawn, 0 kept for nothing.
        drawn = passes.alpha > 0
        span = passes.depth[drawn] if drawn.any() else np.zeros(1, np.float32)
        near, far = float(span.min()), float(span.max())
        ends = {"near": near, "far": far, "unit": "world units along the viewing direction"}
        if not png:
            return passes.depth[..., None].astype(np.float32), {**ends, "meaning": "z, 0 where nothing is drawn"}
        level = 1 + np.rint((passes.depth.astype(np.float64) - near) / max(far - near, 1e-30) * 65534)
        meaning = "0: nothing; else near + (value - 1) / 65534 (far - near)"
        return np.where(drawn, np.clip(level, 1, 65535), 0).astype(np.uint16), {**ends, "meaning": meaning}
    if name == "normal":
        assert passes.normal is not None
        values, meaning = passes.normal, "outward normal in world axes, 0 where nothing is drawn"
        if png:
            values, meaning = 0.5 + 0.5 * values, "0.5 + 0.5 n, n: " + meaning
    elif name == "coverage":
        assert passes.coverage is not None
        values, meaning = passes.coverage, "parts of alpha: R predicted, G seen by an edited view, B as it was"
    else:
        values, meaning = passes.alpha, "alpha, 0..1"
    if png:
        return quantized(values, options.depth), {"meaning": meaning}
    return values.reshape(*values.shape[:2], -1).astype(np.float32), {"meaning": meaning}
