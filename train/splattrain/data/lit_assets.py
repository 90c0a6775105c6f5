"""Assets whose Gaussians know their materials, so that their colours are known under any light: coarse ones with true
normals, and ones that 3DGS fitted to pictures. What learning on rows is made of (data/gaussian_edits.py).

    assets = LitAssets(MeshFolder("meshes"), recipe, seed=0, environments=hdris, folder=cache)
    asset = assets[3, "fitted"]              # made once, kept on disk

A fitted Gaussian takes the material of the surfel of the dense truth that is nearest to it; how its fitted colour
differs from that surfel's stays with it under every light. N Gaussians of the asset.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from splatpainter.color import base_color, sh_from_color
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lighting import prt_transfer
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.system.atomic import writing
from splatpainter.system.recent import Recent
from splatpainter.transforms import matrix_to_quat, quat_to_matrix
from splattrain.data.lights import Light, random_light, shade_all
from splattrain.data.lit_scenes import SceneObject, mesh_object, render_views
from splattrain.data.object_sources import MeshSource
from splattrain.data.sample_recipes import SampleRecipe
from splattrain.data.surfels import Surfels, to_splats
from splattrain.data.viewpoints import UP_AXIS_ROTATIONS, Optics, ring

AssetKind = Literal["coarse", "fitted"]
ASSET_KINDS: tuple[AssetKind, ...] = ("coarse", "fitted")
VERSION = 1
"""Version of how assets are made: files of another one are made anew."""
RING_COUNT = 3
"""Rings of views in which an edit may be shown."""
RING_VIEWS = 4
"""Views of a ring; an edit is shown in the first, in two that face each other, or in all."""
FIT_VIEWS = 9
"""Pictures that an asset is fitted to."""
FIT_STEPS = 200
"""Steps of 3DGS, from points at true depth."""
FIT_START = {"opacity": 0.9, "size": 0.6}
"""First Gaussians of a fit: true depth is a surface, not a cloud."""
FIT_BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
"""Pictures are fitted over both, so that holes and Gaussians of the background's colour are told apart."""
SURFEL_FIELDS = ("normals", "albedo", "metallic", "roughness", "occlusion", "transfer")
"""Fields of a Gaussian's material and place in the light; y up."""


@dataclass(frozen=True)
class LitAsset:
    """An asset under one light. Arrays are numpy float32."""

    name: str
    """Name of the object."""
    kind: AssetKind
    asset: Splats
    """SH degree 0, turned by one of UP_AXIS_ROTATIONS."""
    normals: np.ndarray = field(repr=False)
    """[N, 3] unit, outwards, turned as the asset: true ones (coarse), those that the painter finds (fitted)."""
    transfer: np.ndarray = field(repr=False)
    """[N, 10] of `lighting.prt_transfer`, turned as the asset."""
    visible_px: np.ndarray = field(repr=False)
    """[RING_COUNT, RING_VIEWS, N] pixels that show each Gaussian."""
    surfels: Surfels = field(repr=False)
    """N, torch: materials, y up; shapes are not theirs."""
    residual: np.ndarray = field(repr=False)
    """[N, 3] base colour of the asset minus that of its materials under its light; zeros where coarse."""
    coefficients: Tensor = field(repr=False)
    """[9, 3] of its light."""
    exposure: Tensor = field(repr=False)
    """[] of its light."""

    def colors(self, surfels: Surfels, coefficients: Tensor, exposure: Tensor) -> np.ndarray:
        """[..., N, 3] base colours, not clamped, of these materials under lights [..., 9, 3] and [...]."""
        return base_colors(surfels, coefficients, exposure) + self.residual


def base_colors(surfels: Surfels, coefficients: Tensor, exposure: Tensor) -> np.ndarray:
    """[..., N, 3] display sRGB of band 0."""
    return base_color(shade_all(surfels, coefficients, exposure, 0)).numpy()


class LitAssets:
    """The assets of a source of meshes, by (number of the object, kind). Equal settings give equal assets."""

    def __init__(
        self,
        source: MeshSource,
        recipe: SampleRecipe,
        seed: int = 0,
        environments: Sequence[Any] = (),
        folder: Path | None = None,
        cache_bytes: int = 1 << 30,
    ) -> None:
        """recipe: size, rows, surfels, fuzz and fov count; environments: [h, w, 3] pictures for lights; folder: where
        assets are kept, one file each, None: nowhere; cache_bytes: of assets kept in memory."""
        self.source, self.recipe, self.seed, self.folder = source, recipe, seed, folder
        self.environments = tuple(environments)
        self._assets = Recent[LitAsset](cache_bytes, lambda item: 4 * len(item.asset) * 60)
        self._objects = Recent[SceneObject](1)
        self._bad: dict[int, str] = {}

    def __len__(self) -> int:
        """Objects."""
        return len(self.source)

    def __getitem__(self, key: tuple[int, AssetKind]) -> LitAsset:
        """Raises ValueError, naming the object, where its mesh cannot be used."""
        i, kind = key
        if i in self._bad:
            raise ValueError(self._bad[i])
        return self._assets.get(key, lambda: self._load_or_make(i, kind))

    def has(self, i: int, kind: AssetKind) -> bool:
        """Whether the asset is on disk."""
        path = self._path(i, kind)
        return path is not None and path.is_file()

    def _path(self, i: int, kind: AssetKind) -> Path | None:
        if self.folder is None:
            return None
        recipe = self.recipe
        sizes = (recipe.size, recipe.rows, recipe.surfels, recipe.fuzz, recipe.fov)
        lights = [np.asarray(picture).shape for picture in self.environments]
        identity = json.dumps([VERSION, self.source.name(i), self.seed, sizes, lights, FIT_STEPS, FIT_VIEWS, kind])
        return self.folder / f"{kind}-{hashlib.sha256(identity.encode()).hexdigest()[:20]}.npz"

    def _load_or_make(self, i: int, kind: AssetKind) -> LitAsset:
        path = self._path(i, kind)
        if path is not None and path.is_file():
            stored = _read(path, self.source.name(i), kind)
            if stored is not None:
                return stored
        try:
            asset = self._make(i, kind)
        except ValueError as error:
            self._bad[i] = str(error)
            raise
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, asset)
        return asset

    def _make(self, i: int, kind: AssetKind) -> LitAsset:
        recipe, rng = self.recipe, self._generator(f"asset {kind}", i)
        item = self._objects.get(i, lambda: self._object(i))
        light = random_light(rng, self.environments)
        optics = Optics(recipe.size, float(rng.uniform(*recipe.fov)), (0.5, 0.5, 0.5))
        if kind == "coarse":
            surfels, shapes = item.coarse, item.coarse
            truth = base_colors(surfels, light.coefficients, light.exposure)
            asset, residual = _colored(shapes, truth), np.zeros_like(truth)
            normals = surfels.normals.numpy()
        else:
            asset = fitted(item, light, optics, recipe.rows, rng)
            surfels = _nearest(item.surfels, asset.means)
            truth = base_colors(surfels, light.coefficients, light.exposure)
            residual = base_color(asset.sh) - truth
            normals = outward_normals(asset)
        cameras = [ring(item.radius, optics, RING_VIEWS, rng) for _ in range(RING_COUNT)]
        drawn = [render(asset, views, contributions=True).contributions for views in cameras]
        turn = np.array(UP_AXIS_ROTATIONS[rng.integers(len(UP_AXIS_ROTATIONS))])
        asset, normals = turned(asset, turn), (normals @ turn.T).astype(np.float32)
        transfer = prt_transfer(asset.means, normals).astype(np.float32)
        pixels = np.stack([np.asarray(part) for part in drawn]).astype(np.float32)
        arrays = (normals, transfer, pixels, surfels, residual.astype(np.float32))
        return LitAsset(self.source.name(i), kind, asset, *arrays, light.coefficients, light.exposure)

    def _object(self, i: int) -> SceneObject:
        rng, recipe = self._generator("object", i), self.recipe
        roughness, seed = float(rng.uniform(*recipe.fuzz)), int(rng.integers(1 << 31))
        mesh = self.source.mesh(i)
        return mesh_object(self.source.name(i), mesh, recipe.surfels, recipe.rows, roughness, seed, "cpu")

    def _generator(self, what: str, i: int) -> np.random.Generator:
        digest = hashlib.sha256(f"{self.seed} {what} {self.source.name(i)}".encode()).digest()
        return np.random.default_rng(list(digest[:16]))


def fitted(item: SceneObject, light: Light, optics: Optics, rows: int, rng: np.random.Generator) -> Splats:
    """At most `rows` Gaussians, SH degree 0, that 3DGS fitted to FIT_VIEWS pictures of the object under a light, from
    points at true depth (y up, numpy)."""
    from splatpainter.fit.optimize import FitOptions, TrainingView, optimize
    from splatpainter.fit.start import from_depths

    cameras = ring(item.radius, optics, FIT_VIEWS, rng)
    truth = to_splats(item.surfels, shade_all(item.surfels, light.coefficients, light.exposure, 0))
    shots = render_views(truth, cameras)
    colors, alphas, depths = (x.numpy() for x in (shots.views.colors, shots.alphas, shots.depths))
    start = from_depths(cameras, colors, depths, alphas, rows, int(rng.integers(1 << 31)), 0, **FIT_START)
    views = []
    for background in FIT_BACKGROUNDS:
        for camera, color, alpha in zip(cameras, colors, alphas, strict=True):
            change = np.subtract(background, camera.background, dtype=np.float32)
            over = color + (1 - alpha[..., None]) * change
            views.append(TrainingView(replace(camera, background=background), over))
    result = optimize(start, views, FitOptions(steps=FIT_STEPS, densify=False, seed=0)).splats
    return result.take(np.flatnonzero(result.drawable))


def turned(splats: Splats, turn: np.ndarray) -> Splats:
    """Gaussians of SH degree 0 in a turned world. turn: [3, 3] rotation."""
    quats = matrix_to_quat(turn @ quat_to_matrix(splats.quats.astype(np.float64)))
    means = (splats.means @ turn.T).astype(np.float32)
    return Splats(means, quats.astype(np.float32), splats.scales, splats.opacities, splats.sh)


def _colored(shapes: Surfels, colors: np.ndarray) -> Splats:
    means, quats, scales, opacities = (x.numpy() for x in (shapes.means, shapes.quats, shapes.scales, shapes.opacities))
    return Splats(means, quats, scales, opacities, sh_from_color(colors)[:, None].astype(np.float32))


def _nearest(surfels: Surfels, points: np.ndarray) -> Surfels:
    """For every point [N, 3] the surfel that is nearest to it."""
    _, ids = KDTree(surfels.means.numpy()).query(points)
    return surfels.take(torch.from_numpy(np.asarray(ids, np.int64)))


def _write(path: Path, item: LitAsset) -> None:
    arrays = {name: getattr(item.asset, name) for name in ("means", "quats", "scales", "opacities", "sh")}
    arrays |= {f"surfel_{name}": getattr(item.surfels, name).numpy() for name in SURFEL_FIELDS}
    arrays |= {name: getattr(item, name) for name in ("normals", "transfer", "visible_px", "residual")}
    arrays |= {"coefficients": item.coefficients.numpy(), "exposure": item.exposure.numpy()}
    with writing(path) as file:
        np.savez_compressed(file, **arrays)


def _read(path: Path, name: str, kind: AssetKind) -> LitAsset | None:
    """None for a file that is damaged, or another program's."""
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            cached = {key: file[key] for key in file.files}
        means, quats, scales, opacities, sh = (cached[key] for key in ("means", "quats", "scales", "opacities", "sh"))
        asset = Splats(means, quats, scales, opacities, sh)
        parts = {key: torch.from_numpy(cached[f"surfel_{key}"]) for key in SURFEL_FIELDS}
        shapes = {f.name: torch.from_numpy(getattr(asset, f.name)) for f in fields(Surfels) if f.name not in parts}
        values = (
            cached["normals"],
            cached["transfer"],
            cached["visible_px"],
            Surfels(**shapes, **parts),
            cached["residual"],
        )
        light = (torch.from_numpy(cached["coefficients"]), torch.from_numpy(cached["exposure"]))
        return LitAsset(name, kind, asset, *values, *light)
    except (OSError, KeyError, ValueError, EOFError, BadZipFile):
        return None
