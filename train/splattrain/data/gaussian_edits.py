"""Edits of Gaussians without pictures: a change that is known exactly where one, two or four views show the asset, and
to be predicted where they do not.

    edits = GaussianEditStream(LitAssets(...), kinds={"relight": 1.0}, asset_kinds=("coarse", "fitted"), seed=0)
    edit = edits[17]                         # the same for equal (stream, 17), in any order of access

What is learnt from them (train/stages/gaussian_edit_task.py) can know of the edit only what Gaussians that are seen say
about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import linear_to_srgb, srgb_to_linear
from splatpainter.grading.color_grading import apply_grade, random_grade
from splattrain.data.lights import random_light
from splattrain.data.lit_assets import RING_COUNT, RING_VIEWS, AssetKind, LitAsset, LitAssets

EditKind = Literal["relight", "recolor", "regrade"]
EDIT_KINDS: tuple[EditKind, ...] = get_args(EditKind)
VIEW_ODDS = {1: 0.5, 2: 0.3, 4: 0.2}
"""Number of views -> how often: the fewer, the more has to be predicted."""
VISIBLE_PX = 1.0
"""Pixels of weight above which pictures show a Gaussian, so that its change is known; what shines through others by
less is to be predicted."""
LIGHT_COUNT = 256
"""New lights that relightings choose from."""
MATERIAL_WIDTH = 0.12
"""Width of a recoloured material: the standard deviation, in display colours, within which Gaussians belong to it."""
MIN_CHANGED_SHARE = 0.05
"""Least share of the Gaussians that a recolouring changes by more than MIN_CHANGE; others are drawn again."""
MIN_CHANGE = 0.02
MAX_TRIES = 8
"""Recolourings that are drawn before the last one is taken as it is."""
SMALL_PX = 64
"""Height of the environments that new lights are made of: plenty for nine coefficients."""


@dataclass(frozen=True)
class GaussianEdit:
    """One edit of the N Gaussians of an asset. Arrays are numpy float32."""

    item: LitAsset
    kind: EditKind
    views: int
    """Number of pictures that show it: 1, 2 or 4."""
    change: np.ndarray = field(repr=False)
    """[N, 3] of base colours, between colours within 0..1: the true one."""
    weight: np.ndarray = field(repr=False)
    """[N] pixels that show each Gaussian in these pictures."""
    counts: np.ndarray = field(repr=False)
    """[N] how much each Gaussian counts: pixels that show it from all around."""

    @property
    def name(self) -> str:
        """Name of the object."""
        return self.item.name

    @property
    def seen(self) -> np.ndarray:
        """[N] bool: its change is known."""
        return self.weight > VISIBLE_PX

    @cached_property
    def colors(self) -> np.ndarray:
        """[N, 3] base colours before, 0..1."""
        surfels = self.item.surfels
        before = self.item.colors(surfels, self.item.coefficients, self.item.exposure)
        return np.clip(before, 0, 1).astype(np.float32)


class GaussianEditStream:
    """Endless edits by number: of an object, of its coarse or fitted asset, of one of the kinds."""

    def __init__(
        self,
        assets: LitAssets,
        kinds: Mapping[Any, float],
        asset_kinds: Sequence[AssetKind] = ("coarse", "fitted"),
        seed: int = 0,
        samples_per_object: int = 8,
        objects: int = 0,
    ) -> None:
        """kinds: kind -> weight; samples_per_object: consecutive numbers that share an asset; objects: how many,
        the first of a fixed order, 0: all. Raises ValueError for kinds that there are not, or none of a weight above
        0."""
        unknown = sorted(set(kinds) - set(EDIT_KINDS))
        if unknown or not asset_kinds or sum(kinds.values()) <= 0:
            raise ValueError(f"rows: expected kinds of {', '.join(EDIT_KINDS)} with weights, and assets, got {kinds}")
        self.assets, self.asset_kinds = assets, tuple(asset_kinds)
        self.seed, self.samples_per_object = seed, samples_per_object
        self.kinds: dict[EditKind, float] = {kind: kinds[kind] for kind in EDIT_KINDS if kinds.get(kind, 0) > 0}
        order = np.random.default_rng(0).permutation(len(assets))
        self.order = order[:objects] if objects else order

    def __getitem__(self, index: int) -> GaussianEdit:
        """Raises IndexError below 0, and ValueError as LitAssets."""
        if index < 0:
            raise IndexError(f"rows: expected an index from 0, got {index}")
        block = index // self.samples_per_object
        epoch, position = divmod(block, len(self.order) * len(self.asset_kinds))
        pick = int(self._generator("epoch", epoch).permutation(len(self.order) * len(self.asset_kinds))[position])
        which, part = divmod(pick, len(self.asset_kinds))
        item = self.assets[int(self.order[which]), self.asset_kinds[part]]
        rng = self._generator("edit", index)
        odds = np.array(list(self.kinds.values()))
        kind: EditKind = list(self.kinds)[int(rng.choice(len(odds), p=odds / odds.sum()))]
        views = int(rng.choice(list(VIEW_ODDS), p=list(VIEW_ODDS.values())))
        return self.edit(item, kind, views, rng)

    def edit(self, item: LitAsset, kind: EditKind, views: int, rng: np.random.Generator) -> GaussianEdit:
        """A random edit of this asset, shown in this many views of one of its rings."""
        pixels = item.visible_px[int(rng.integers(RING_COUNT))][:: RING_VIEWS // views].sum(0)
        counts = item.visible_px.sum((0, 1))
        edit = GaussianEdit(item, kind, views, np.zeros_like(item.residual), pixels, counts)
        change = edit.change
        for _ in range(MAX_TRIES):
            after = np.clip(self._after(item, kind, edit.colors, rng), 0, 1)
            change = (after - edit.colors).astype(np.float32)
            if kind != "recolor" or (np.abs(change).max(1) > MIN_CHANGE).mean() > MIN_CHANGED_SHARE:
                break
        return replace(edit, change=change)

    def _after(self, item: LitAsset, kind: EditKind, before: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """[N, 3] base colours after an edit."""
        if kind == "relight":
            coefficients, exposures = self._lights
            pick = int(rng.integers(len(exposures)))
            return item.colors(item.surfels, coefficients[pick], exposures[pick])
        if kind == "regrade":
            return apply_grade(torch.from_numpy(before), random_grade(rng)).numpy()
        surfels = item.surfels
        display = linear_to_srgb(surfels.albedo.clamp(0, 1))
        center = display[int(rng.integers(len(display)))]
        belongs = torch.exp(-(display - center).square().sum(1) / (2 * MATERIAL_WIDTH**2))[:, None]
        paint = torch.from_numpy(rng.uniform(0.05, 0.95, 3).astype(np.float32))
        # The material's own texture stays on the new colour.
        recolored = (paint + 0.7 * (display - center)).clamp(0, 1)
        albedo = srgb_to_linear(torch.lerp(display, recolored, belongs))
        return item.colors(replace(surfels, albedo=albedo), item.coefficients, item.exposure)

    @cached_property
    def _lights(self) -> tuple[Tensor, Tensor]:
        """(SH coefficients [L, 9, 3], exposures [L])."""
        rng = self._generator("lights", 0)
        small = [_small(torch.as_tensor(picture)) for picture in self.assets.environments]
        lights = [random_light(rng, small) for _ in range(LIGHT_COUNT)]
        return torch.stack([x.coefficients for x in lights]), torch.stack([x.exposure for x in lights])

    def _generator(self, what: str, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *b"row edits", *what.encode(), number])


def _small(picture: Tensor) -> Tensor:
    factor = picture.shape[0] // SMALL_PX
    if factor < 2:
        return picture
    return torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)
