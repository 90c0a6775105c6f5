"""Materials of meshes: the frozen type, what trimesh makes of a file's (decoding never fails for one bad texture), and
looking up their maps: bilinear, repeating, without further filtering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from splatpainter.color import srgb_to_linear
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run

MIN_UPRIGHT = 0.5
"""Mean of a normal map's third component, below which it is none. Of 242 meshes 24 have normal maps, of 0.78 and more,
and 33 grey pictures of heights or gloss in their place, of 0.36 and less, which would turn their surfaces black."""
MAX_MAP_PX = 4096
"""Per side; larger maps are reduced, nothing here can show more."""
LINEAR_BYTES = (np.arange(256) / 255).astype(np.float32)
"""[256] byte -> 0..1."""
SRGB_BYTES = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
"""[256] sRGB byte -> linear 0..1."""


@dataclass(frozen=True)
class Material:
    """Metallic-roughness material of glTF 2.0: each map times its factor. Maps repeat outside 0..1."""

    base_color: np.ndarray | None = None
    """[h, w, 3] uint8 sRGB, or None: the factor alone."""
    base_factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Linear, 0..1."""
    metallic_roughness: np.ndarray | None = None
    """[h, w, 2] uint8 linear: metallic, roughness."""
    metallic: float = 0.0
    """0..1; multiplies the map."""
    roughness: float = 0.8
    """0..1 perceptual (alpha = roughness^2); multiplies the map."""
    normal_map: np.ndarray | None = None
    """[h, w, 3] uint8 tangent-space normals, 128 = 0, +y up (glTF)."""
    alpha: np.ndarray | None = None
    """[h, w] uint8 coverage for cut-out materials; below 128 there is no surface."""


def convert_material(source: Any) -> Material:
    """A trimesh PBRMaterial, SimpleMaterial or None -> Material. A map that cannot be decoded is left out."""
    if source is None:
        return Material(base_factor=(0.6, 0.6, 0.6))
    if not hasattr(source, "baseColorFactor"):  # SimpleMaterial of OBJ: Kd, map_Kd, Ns
        image = _pixels(getattr(source, "image", None), "RGB")
        diffuse = _factor(getattr(source, "diffuse", None), (0.6, 0.6, 0.6))
        # Exporters write a texture beside a black or grey Kd that they mean to be ignored.
        red, green, blue = srgb_to_linear(np.array(diffuse)).tolist()
        factor = (1.0, 1.0, 1.0) if image is not None else (red, green, blue)
        shine = getattr(source, "glossiness", None)
        roughness = 0.8 if not shine else float(np.clip((2 / (float(shine) + 2)) ** 0.25, 0.2, 1.0))
        return Material(image, factor, roughness=roughness)
    picture = getattr(source, "baseColorTexture", None)
    metal = _pixels(getattr(source, "metallicRoughnessTexture", None), "RGB")
    alpha = None
    if getattr(source, "alphaMode", None) in ("MASK", "BLEND") and _has_alpha(picture):
        coverage = _pixels(picture, "RGBA")
        alpha = None if coverage is None else np.ascontiguousarray(coverage[..., 3])
    return Material(
        base_color=_pixels(picture, "RGB"),
        base_factor=_factor(source.baseColorFactor, (1.0, 1.0, 1.0)),
        metallic_roughness=None if metal is None else np.ascontiguousarray(metal[..., [2, 1]]),
        metallic=_unit(source.metallicFactor, 1.0),
        roughness=_unit(source.roughnessFactor, 1.0),
        normal_map=_normals(getattr(source, "normalTexture", None)),
        alpha=alpha,
    )


def _normals(image: Any) -> np.ndarray | None:
    """As `_pixels`, of a normal map; None: it is another picture."""
    pixels = _pixels(image, "RGB")
    return None if pixels is None or pixels[..., 2].mean() < 128 + 127 * MIN_UPRIGHT else pixels


def _pixels(image: Any, mode: str) -> np.ndarray | None:
    """[h, w, channels] uint8 of a PIL image, or None where there is none or it cannot be decoded."""
    if image is None:
        return None
    try:
        if max(image.size) > MAX_MAP_PX:
            image = image.copy()
            image.thumbnail((MAX_MAP_PX, MAX_MAP_PX))
        pixels = np.asarray(image.convert(mode), np.uint8)
    except Exception:  # a truncated or unknown picture: PIL's plugins raise anything
        return None
    return pixels if pixels.size else None


def _has_alpha(image: Any) -> bool:
    return image is not None and (image.mode in ("RGBA", "LA", "PA") or "transparency" in getattr(image, "info", {}))


def _factor(value: Any, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Three numbers in 0..1 from a float or uint8 colour of three or four."""
    if value is None:
        return default
    raw = np.asarray(value)
    numbers = raw.astype(np.float64).ravel()[:3] / (255.0 if raw.dtype == np.uint8 else 1.0)
    if len(numbers) < 3 or not np.isfinite(numbers).all():
        return default
    red, green, blue = np.clip(numbers, 0, 1).tolist()
    return red, green, blue


def _unit(value: Any, default: float) -> float:
    return default if value is None or not np.isfinite(value) else float(np.clip(value, 0, 1))


def sample_texture(pixels: np.ndarray, uvs: np.ndarray, table: np.ndarray = LINEAR_BYTES) -> np.ndarray:
    """[M, C] float32: table[pixels] interpolated at uvs [M, 2] (v up, repeating). pixels: [h, w, C] uint8."""
    out = np.empty((len(uvs), pixels.shape[2]), np.float32)
    run(
        kernels.sample_bilinear, readonly(pixels, np.uint8), readonly(uvs, np.float32), readonly(table, np.float32), out
    )
    return out
