"""Path traced ground truth: a textured mesh in a distant light, seen by this package's cameras, through Mitsuba 3.

Linear radiance out; `lights.tone_map` makes display colours of it, as it does of shaded surfels. Shadows, light between
surfaces and gloss are right here, and only approximate in surfels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from splatpainter.cameras import Camera
from splattrain.data.materials import SRGB_BYTES, Material
from splattrain.data.meshes import Mesh, submesh
from splattrain.data.mitsuba_backend import Variant, use_mitsuba

NEAR, FAR = 1e-3, 1e3
"""World units."""


@dataclass(frozen=True)
class PathOptions:
    """How pictures are path traced."""

    samples: int = 64
    """Paths per pixel."""
    depth: int = 6
    """Longest path: 2 is direct light, each more one bounce."""
    seed: int = 0
    variant: Variant | Literal["auto"] = "auto"
    """Mitsuba's variant; auto: CUDA, else LLVM, else scalar."""
    model: Literal["principled", "diffuse"] = "principled"
    """Surfaces: Mitsuba's principled BSDF (Burley 2012), or Lambert's with the same base colour, for comparisons."""

    def __post_init__(self) -> None:
        if self.samples < 1 or self.depth < 2 or not 0 <= self.seed < 2**32:
            raise ValueError(
                f"path tracing: expected samples from 1, depth from 2 and a 32-bit seed, "
                f"got {self.samples}, {self.depth}, {self.seed}"
            )


@dataclass(frozen=True)
class PathTraced:
    """C views. The light itself is not seen: where there is no surface, all is 0."""

    radiance: np.ndarray
    """[C, H, W, 3] float32 linear, times alpha (premultiplied); not tone mapped, not clamped."""
    alphas: np.ndarray
    """[C, H, W] float32 share of the pixel that is surface, 0..1."""
    depths: np.ndarray
    """[C, H, W] float32 mean z-depth of that share, world units; 0 where alpha is 0."""
    repaired: int = 0
    """Pixels whose radiance was not finite and became 0."""


def path_trace(
    mesh: Mesh, environment: np.ndarray, cameras: Sequence[Camera], options: PathOptions | None = None
) -> PathTraced:
    """Views of `mesh` in the light of `environment` ([h, w, 3] linear radiance, laid out as `lights.Light` has it).

    Box filter: a pixel is the mean over its square. View k has the seed `options.seed + k`: noise differs between
    views; equal calls of one variant give equal pictures. Raises ValueError: no cameras, sizes that differ, pixels that
    are not square, an environment with negative or non-finite pixels, no Mitsuba.
    """
    options = options or PathOptions()
    views = list(cameras)
    if not views or len({(view.width, view.height) for view in views}) > 1:
        raise ValueError(f"path tracing: expected at least one camera, all of one size, got {len(views)}")
    light = np.ascontiguousarray(environment, np.float32)
    if light.ndim != 3 or light.shape[2] != 3 or min(light.shape[:2]) < 2:
        raise ValueError(f"path tracing: expected an environment [h, w, 3], got {list(light.shape)}")
    if not (np.isfinite(light).all() and (light >= 0).all()):
        raise ValueError("path tracing: the environment has pixels that are negative or not finite")
    mi = use_mitsuba(options.variant)
    integrator = {"type": "path", "max_depth": options.depth, "hide_emitters": True}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "aov", "aovs": "place:position", "image": integrator},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(light)},
    }
    parts = _parts(mesh)
    scene |= {f"part{k}": _shape(mi, f"part{k}", part, options.model) for k, part in enumerate(parts)}
    world = mi.load_dict(scene)
    frames = []
    for k, view in enumerate(views):
        seed = (options.seed + k) % 2**32
        frames.append(np.array(mi.render(world, sensor=_sensor(mi, view), spp=options.samples, seed=seed)))
    return _developed(np.stack(frames).astype(np.float32), views)


def display(traced: PathTraced, exposure: float, cameras: Sequence[Camera]) -> np.ndarray:
    """[C, H, W, 3] display sRGB 0..1: the one tone map of the training data, over each camera's background; composited
    in display values, as splats are."""
    from splattrain.data.lights import tone_map

    alphas = traced.alphas[..., None]
    surface = tone_map(traced.radiance / np.maximum(alphas, 1e-6), exposure)
    background = np.array([camera.background for camera in cameras], np.float32)[:, None, None]
    return np.clip(surface * alphas + background * (1 - alphas), 0, 1).astype(np.float32)


def _developed(film: np.ndarray, views: list[Camera]) -> PathTraced:
    """film: [C, H, W, 7] premultiplied RGB, alpha, and the position times alpha."""
    radiance, alphas = film[..., :3], np.clip(film[..., 3], 0, 1)
    broken = np.logical_not(np.isfinite(radiance).all(-1))
    radiance = np.where(broken[..., None], np.float32(0), radiance)
    position = film[..., 4:7].astype(np.float64)
    depths = np.zeros(alphas.shape, np.float32)
    for k, view in enumerate(views):
        row = view.world_to_camera[2]
        total = position[k] @ row[:3] + row[3] * film[k, ..., 3]
        depths[k] = np.where(alphas[k] > 0, total / np.maximum(film[k, ..., 3], 1e-12), 0)
    return PathTraced(radiance, alphas, depths, int(broken.sum()))


def _sensor(mi: Any, view: Camera) -> Any:
    """OpenCV axes are Mitsuba's turned half about z (x left, y up, z forward)."""
    if abs(view.fx / view.fy - 1) > 1e-4:
        raise ValueError(f"path tracing: expected square pixels, got focal lengths {view.fx} and {view.fy}")
    to_world = view.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {
        "type": "hdrfilm",
        "width": view.width,
        "height": view.height,
        "pixel_format": "rgba",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(to_world),
            "fov": float(2 * np.degrees(np.arctan(view.width / 2 / view.fx))),
            "fov_axis": "x",
            "principal_point_offset_x": (view.width / 2 - view.cx) / view.width,
            "principal_point_offset_y": (view.height / 2 - view.cy) / view.height,
            "near_clip": NEAR,
            "far_clip": FAR,
            "film": film,
            "sampler": {"type": "independent"},
        }
    )


def _parts(mesh: Mesh) -> list[Mesh]:
    """One mesh per material that is used. Materials with a normal map are split once more by the UVs' handedness:
    Mitsuba's frames are all right-handed, and a mirrored part needs its map's second axis turned."""
    parts = []
    for k, material in enumerate(mesh.materials):
        of = mesh.material_ids == k
        mirrored = _mirrored(mesh) if material.normal_map is not None else np.zeros(len(of), bool)
        for faces, kind in ((of & ~mirrored, material), (of & mirrored, _turned(material))):
            if faces.any():
                ids = np.zeros(int(faces.sum()), np.int64)
                parts.append(replace(submesh(mesh, faces), material_ids=ids, materials=(kind,)))
    return parts


def _mirrored(mesh: Mesh) -> np.ndarray:
    """[F] bool: the texture runs the other way round on this face, seen from where its normals point."""
    corners, uvs = mesh.vertices[mesh.faces].astype(np.float64), mesh.uvs[mesh.faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outside = (cross * mesh.normals[mesh.faces].sum(1)).sum(1)
    a, b = uvs[:, 1] - uvs[:, 0], uvs[:, 2] - uvs[:, 0]
    return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) * outside < 0


def _turned(material: Material) -> Material:
    """The normal map's second axis the other way."""
    if material.normal_map is None:
        return material
    turned = material.normal_map.copy()
    turned[..., 1] = 255 - turned[..., 1]
    return replace(material, normal_map=turned)


def _shape(mi: Any, name: str, part: Mesh, model: str) -> Any:
    """A Mitsuba mesh of a part with one material."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, part, model))
    tinted = _tint(part) is not None
    counts = (len(part.vertices), len(part.faces))
    shape = mi.Mesh(name, *counts, has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    if tinted:
        shape.add_attribute("vertex_color", 3, np.ascontiguousarray(_tint(part), np.float32).ravel())
    fields = mi.traverse(shape)
    uvs = part.uvs * np.array([1, -1], np.float32) + np.array(
        [0, 1], np.float32
    )  # in Mitsuba v = 0 is a picture's first row
    fields["vertex_positions"] = np.ascontiguousarray(part.vertices, np.float32).ravel()
    fields["vertex_normals"] = np.ascontiguousarray(part.normals, np.float32).ravel()
    fields["vertex_texcoords"] = np.ascontiguousarray(uvs, np.float32).ravel()
    fields["faces"] = np.ascontiguousarray(part.faces, np.uint32).ravel()
    fields.update()
    return shape


def _tint(part: Mesh) -> np.ndarray | None:
    """[V, 3] base colours where they come from vertices alone. (With a texture as well, `_base_color` takes the
    vertices' mean: Mitsuba has no product of the two.)"""
    material = part.materials[0]
    if part.colors is None or material.base_color is not None:
        return None
    return np.clip(part.colors * np.array(material.base_factor, np.float32), 0, 1)


def _bsdf(mi: Any, part: Mesh, model: str) -> dict[str, Any]:
    material = part.materials[0]
    if model == "diffuse":
        surface: dict[str, Any] = {"type": "diffuse", "reflectance": _base_color(mi, part)}
    else:
        metallic, roughness = (_scalar(mi, material, k) for k in (0, 1))
        # specular 0.5 is an index of 1.5, glTF's F0 of 0.04.
        surface = {"type": "principled", "base_color": _base_color(mi, part), "specular": 0.5}
        surface |= {"metallic": metallic, "roughness": roughness}
    if material.normal_map is not None:
        # 128 is 0 in glTF, 127.5 in Mitsuba: without the shift, flat maps would tilt everything.
        flat = np.clip(material.normal_map.astype(np.float32) - 0.5, 0, 255) / 255
        surface = {"type": "normalmap", "normalmap": _bitmap(mi, flat), "bsdf": surface}
    surface = {"type": "twosided", "bsdf": surface}
    if material.alpha is not None:
        coverage = (material.alpha[..., None] >= 128).astype(np.float32)
        surface = {"type": "mask", "opacity": _bitmap(mi, coverage), "bsdf": surface}
    return surface


def _base_color(mi: Any, part: Mesh) -> dict[str, Any]:
    material = part.materials[0]
    factor = np.array(material.base_factor, np.float32)
    if _tint(part) is not None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    if material.base_color is None:
        return {"type": "rgb", "value": np.clip(factor, 0, 1).tolist()}
    if part.colors is not None:
        factor = factor * part.colors.mean(0)
    return _bitmap(mi, np.clip(SRGB_BYTES[material.base_color] * factor, 0, 1))


def _scalar(mi: Any, material: Material, channel: int) -> Any:
    """The metallic (0) or roughness (1) of a material: a number or a texture."""
    factor = (material.metallic, material.roughness)[channel]
    low = (0.0, 0.03)[channel]  # a perfect mirror is a delta, which path tracing an environment shows as speckles
    if material.metallic_roughness is None:
        return float(np.clip(factor, low, 1))
    values = material.metallic_roughness[..., channel : channel + 1].astype(np.float32) / 255
    return _bitmap(mi, np.clip(values * factor, low, 1))


def _bitmap(mi: Any, values: np.ndarray) -> dict[str, Any]:
    """A texture of linear values [h, w, 1 or 3] that repeats."""
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(values, np.float32)),
        "raw": True,
        "wrap_mode": "repeat",
    }
