"""What trimesh makes of a file's materials, as `Material`; decoding that never fails for one bad texture."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatpainter.data.meshes import Material

LARGEST = 4096
"""Pixels per side; larger maps are reduced, nothing here can show more."""


def convert_material(source: Any) -> Material:
    """A trimesh PBRMaterial, SimpleMaterial or None -> Material. A map that cannot be decoded is left out."""
    if source is None:
        return Material(base_factor=(0.6, 0.6, 0.6))
    if not hasattr(source, "baseColorFactor"):  # SimpleMaterial of OBJ: Kd, map_Kd, Ns
        image = _pixels(getattr(source, "image", None), "RGB")
        diffuse = _factor(getattr(source, "diffuse", None), (0.6, 0.6, 0.6))
        # Exporters write a texture beside a black or grey Kd that they mean to be ignored.
        red, green, blue = (_to_linear(value) for value in diffuse)
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
        normal_map=_pixels(getattr(source, "normalTexture", None), "RGB"),
        alpha=alpha,
    )


def _pixels(image: Any, mode: str) -> np.ndarray | None:
    """[h, w, channels] uint8 of a PIL image, or None where there is none or it cannot be decoded."""
    if image is None:
        return None
    try:
        if max(image.size) > LARGEST:
            image = image.copy()
            image.thumbnail((LARGEST, LARGEST))
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


def _to_linear(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4
