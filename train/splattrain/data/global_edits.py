"""Global edits as changes of Gaussians, without pictures: what the predictor of unseen Gaussians is trained on.

    stream = GlobalEditStream(SampleStream(source, recipe, seed, environments))
    edit = stream[17]                        # the same for equal (stream, 17), in any order of access

A coarse asset carries its materials (data/surfels.py), so the colours of its Gaussians are known under any light; which
of them a picture shows is known from the asset and the camera alone. So an object costs seconds once, and an edit of it
milliseconds. What pictures tell about a Gaussian is not exact: the error of that is measured for one light per ring of
views, and added to what is true under the others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Literal

import numpy as np
import torch
from scipy.linalg import block_diag
from torch import Tensor

from splatpainter.color import base_color, sh_from_color
from splatpainter.grading.color_grading import random_grade
from splatpainter.lift.colors import MIN_SEEN_PX
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.lift.global_edit import seen_change
from splatpainter.lighting import prt_transfer
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.recent import Recent
from splatpainter.transforms import sh_rotations
from splattrain.data.edits.on_surfels import grade_sh
from splattrain.data.lights import Light, random_light, shade, shade_all
from splattrain.data.lit_scenes import SceneObject, render_views
from splattrain.data.samples import SampleStream
from splattrain.data.surfels import Surfels, to_splats
from splattrain.data.viewpoints import UP_AXIS_ROTATIONS, Optics, ring

RING_COUNT = 3
"""Rings of views per object."""
VIEWS_PER_RING = 4
"""Views of a ring; an edit is shown in the first, in two that face each other, or in all."""
VIEW_ODDS = (0.5, 0.3, 0.2)
"""Odds of one, two and four views: the fewer, the more has to be predicted."""
GAUSSIANS_PER_EDIT = 2000
"""Gaussians of an edit of training, a random choice."""
LIGHT_COUNT = 1024
"""Lights that edits choose from, two at a time: a million pairs."""


@dataclass(frozen=True)
class GlobalEdit:
    """One global edit of N Gaussians of an asset. Arrays are numpy float32."""

    name: str
    """Name of the object."""
    kind: Literal["relight", "regrade"]
    views: int
    """Number of pictures that show the edit."""
    asset: Splats
    """The asset before the edit, SH degree 0."""
    normals: np.ndarray = field(repr=False)
    """[N, 3] unit, outwards, as the painter finds them."""
    transfer: np.ndarray = field(repr=False)
    """[N, 10] of `lighting.prt_transfer`."""
    observed: np.ndarray = field(repr=False)
    """[N, 3] change of base colour as the pictures tell it; zeros for Gaussians that none shows."""
    weight: np.ndarray = field(repr=False)
    """[N] pixels that show each Gaussian, in all pictures."""
    change: np.ndarray = field(repr=False)
    """[N, 3] the true one."""
    counts: np.ndarray = field(repr=False)
    """[N] how much each Gaussian counts: pixels that show it from all around."""


@dataclass(frozen=True)
class _RelitObject:
    """An object, ready to be relit."""

    name: str
    surfels: Surfels
    """The asset's, with materials; torch."""
    normals: np.ndarray
    transfer: np.ndarray
    visible_px: np.ndarray
    """[RING_COUNT, VIEWS_PER_RING, N] float32 pixels that show each Gaussian."""
    errors: np.ndarray
    """[RING_COUNT, 3, N, 3] float32 told minus true change under one light, of 1, 2 and 4 views."""

    @property
    def nbytes(self) -> int:
        return self.visible_px.nbytes + self.errors.nbytes + 4 * len(self.surfels) * 40


class GlobalEditStream:
    """Endless edits by number. Objects, sizes and environments are the stream's; of its kinds "relight" and "regrade"
    count. Not for several threads at once."""

    def __init__(self, stream: SampleStream, gaussians: int = GAUSSIANS_PER_EDIT, cache_bytes: int = 1 << 30) -> None:
        """gaussians: of an edit, 0: all; cache_bytes: of objects kept. Raises ValueError for splat assets, whose light
        nobody knows, and for a recipe without global edits."""
        if stream.splats:
            raise ValueError("train predict: expected meshes or procedural objects, whose materials are known")
        weights = np.array([stream.kinds.get(kind, 0.0) for kind in ("relight", "regrade")])
        if not weights.sum() > 0:
            raise ValueError("train predict: expected --samples.kinds with relight or regrade")
        self.stream, self.gaussians = stream, gaussians
        self._odds = weights / weights.sum()
        self._objects = Recent[_RelitObject](cache_bytes, lambda item: item.nbytes)

    def __getitem__(self, index: int) -> GlobalEdit:
        """Raises IndexError below 0 and ValueError as SampleStream."""
        if index < 0:
            raise IndexError(f"global edits: expected an index from 0, got {index}")
        block = index // self.stream.recipe.steps_per_object
        item, rng = self._object(block), self._generator("edit", index)
        kind: Literal["relight", "regrade"] = "relight" if rng.random() < self._odds[0] else "regrade"
        count = len(item.surfels)
        ids = np.sort(rng.permutation(count)[: self.gaussians]) if self.gaussians else np.arange(count)
        surfels = item.surfels.take(torch.from_numpy(ids))
        before, after = self._colors(surfels, kind, rng)
        which, size = int(rng.integers(RING_COUNT)), int(rng.choice(3, p=VIEW_ODDS))
        views = 2**size
        weight = item.visible_px[which][:: VIEWS_PER_RING // views, ids].sum(0)
        error = item.errors[which, size][ids][:, rng.permutation(3)] * rng.choice([-1, 1]) * rng.uniform(0.4, 1.2)
        change = after - before
        observed = np.where((weight > MIN_SEEN_PX)[:, None], change + error, 0)
        turn = np.array(UP_AXIS_ROTATIONS[rng.integers(len(UP_AXIS_ROTATIONS))])
        asset = Splats(
            (surfels.means.numpy() @ turn.T).astype(np.float32),
            surfels.quats.numpy(),  # shapes play no part
            surfels.scales.numpy(),
            surfels.opacities.numpy(),
            sh_from_color(before)[:, None],
        )
        transfer = item.transfer[ids].copy()
        transfer[:, :9] = transfer[:, :9] @ _sh_rotation(tuple(turn.ravel().tolist())).T
        counts = item.visible_px.sum((0, 1))[ids]
        normals = (item.normals[ids] @ turn.T).astype(np.float32)
        numbers = (observed.astype(np.float32), weight, change, counts)
        return GlobalEdit(item.name, kind, views, asset, normals, transfer.astype(np.float32), *numbers)

    def _colors(self, surfels: Surfels, kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Base colours [N, 3] before and after."""
        coefficients, exposures = self._lights
        degree = self.stream.recipe.sh_degree
        pick = torch.from_numpy(rng.integers(len(exposures), size=2))
        if kind == "relight":
            both = shade_all(surfels, coefficients[pick], exposures[pick], degree)
        else:
            lit = shade_all(surfels, coefficients[pick[0]], exposures[pick[0]], degree)
            both = torch.stack([lit, grade_sh(lit, random_grade(rng))])
        before, after = base_color(both).numpy()
        return before, after

    @property
    def _lights(self) -> tuple[Tensor, Tensor]:
        """(SH coefficients [L, 9, 3], exposures [L]), made once per process."""
        if not hasattr(self, "_pool"):
            rng = self._generator("lights", 0)
            small = [_small(torch.as_tensor(picture)) for picture in self.stream.environments]
            lights = [random_light(rng, small) for _ in range(LIGHT_COUNT)]
            self._pool = torch.stack([x.coefficients for x in lights]), torch.stack([x.exposure for x in lights])
        return self._pool

    def _object(self, block: int) -> _RelitObject:
        count = len(self.stream.source)
        epoch, position = divmod(block, count)
        key = int(self._generator("epoch", epoch).permutation(count)[position])
        return self._objects.get(
            key, lambda: self._prepare(self.stream.scene_object(key), self._generator("object", key))
        )

    def _prepare(self, scene_object: SceneObject, rng: np.random.Generator) -> _RelitObject:
        recipe, surfels = self.stream.recipe, scene_object.coarse.to("cpu")
        visible_px, errors = [], []
        normals = None
        for _ in range(RING_COUNT):
            optics = Optics(recipe.size, float(rng.uniform(*recipe.fov)))
            cameras = ring(scene_object.radius, optics, VIEWS_PER_RING, rng)
            old, new = (random_light(rng, self.stream.environments, self.stream.device) for _ in range(2))
            asset = _lit(surfels, old, recipe.sh_degree)
            normals = outward_normals(asset) if normals is None else normals
            truth = to_splats(scene_object.surfels, shade(scene_object.surfels, new, recipe.sh_degree))
            shots = render_views(truth, cameras)
            pictures = shots.views.colors.cpu().numpy()
            masks = (shots.alphas > 0.5).cpu().numpy()
            views = list(zip(cameras, pictures, masks, strict=True))
            true = SH_C0 * (_lit(surfels, new, recipe.sh_degree).sh[:, 0] - asset.sh[:, 0])
            observed = [seen_change(asset, views[:: VIEWS_PER_RING // number]) for number in (1, 2, VIEWS_PER_RING)]
            visible_px.append([seen_change(asset, [view])[1] for view in views])
            errors.append([np.where((weight > MIN_SEEN_PX)[:, None], change - true, 0) for change, weight in observed])
        assert normals is not None
        transfer = prt_transfer(surfels.means.numpy(), normals)
        arrays = (np.asarray(visible_px, np.float32), np.asarray(errors, np.float32))
        return _RelitObject(scene_object.name, surfels, normals, transfer, *arrays)

    def _generator(self, what: str, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.stream.seed, *b"rows", *what.encode(), *numbers])


def _lit(surfels: Surfels, light: Light, degree: int) -> Splats:
    """The asset under a light, numpy."""
    return to_splats(surfels, shade(surfels, light.to("cpu"), degree)).numpy()


def _small(picture: Tensor) -> Tensor:
    """An environment of at most 64 pixels' height: for nine coefficients that is plenty."""
    factor = picture.shape[0] // 64
    if factor < 2:
        return picture
    return torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)


@cache
def _sh_rotation(turn: tuple[float, ...]) -> np.ndarray:
    """[9, 9] for coefficients of degree 2."""
    return np.asarray(block_diag(*sh_rotations(np.array(turn).reshape(3, 3), 2)))
