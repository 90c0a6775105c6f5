"""Painted close-ups and zoom-ins as rows: patches of the edited picture, the Gaussians that the lift lays out for them,
and the colour that each of these has in truth. No renderer is needed to learn from them.

    edits = PaintedGaussianStream(source, recipe, seed=0, environments=hdris, folder=cache)
    edit = edits[17]                 # the same for equal (stream, 17), in any order of access

An object is kept for many edits; what is drawn is kept on disk, and after `count` edits they come again. The truth of a
Gaussian is the mean over the painted surfels under its own footprint: of the surface, not of what a picture shows of
it, which the lift has already.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast
from zipfile import BadZipFile

import numpy as np
from scipy.spatial import KDTree

from splatpainter.color import base_color
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import LiftedEdit, lift_local_views
from splatpainter.models.picture_patches import (
    PatchReaders,
    PatchTokens,
    PictureRegion,
    picture_regions,
)
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.system.atomic import writing
from splatpainter.system.recent import Recent
from splatpainter.voxels.grid import VoxelGrid, voxelize
from splattrain.data import edit_samples
from splattrain.data.edit_samples import EditSample, SampleSpec
from splattrain.data.edits.content import EditResources
from splattrain.data.lights import random_light
from splattrain.data.lit_assets import fitted
from splattrain.data.lit_scenes import LitScene, illuminate, mesh_object
from splattrain.data.object_sources import MeshSource
from splattrain.data.sample_recipes import PAINTED, SampleRecipe
from splattrain.data.viewpoints import Optics

if TYPE_CHECKING:
    from torch import Tensor

PaintedAssetKind = Literal["coarse", "fitted"]
PAINTED_KINDS = (*PAINTED, "recolor", "zoom")
"""Kinds of edits that a picture of one view tells."""
VERSION = 3
"""Version of how edits are made: files of another one are made anew."""
MAX_REGIONS = 4
"""Regions of an edit that are kept, a random choice."""
MAX_READERS = 256
"""Gaussians of a region that are kept, a random choice."""
TRUTH_NEIGHBOURS = 16
"""Surfels whose mean is a Gaussian's colour."""
MAX_TRIES = 16


@dataclass(frozen=True)
class PaintedScene:
    """An asset that can be painted, and its truth."""

    scene: LitScene
    kind: PaintedAssetKind
    surface: Surface
    grid: VoxelGrid

    @property
    def asset(self) -> Splats:
        return self.scene.asset


@dataclass(frozen=True)
class PaintedEdit:
    """One edit, whole: for tables in pictures."""

    name: str
    kind: str
    painted: PaintedScene
    sample: EditSample
    view: EditView
    lifted: LiftedEdit
    truth: np.ndarray = field(repr=False)
    """[J, 3] float32 base colours of lifted.ids in truth."""


@dataclass(frozen=True)
class PaintedGaussians:
    """What a step learns from."""

    name: str
    kind: str
    """Of the edit and of the asset."""
    regions: tuple[PictureRegion, ...]
    """Their `index` is into `truth`."""
    truth: np.ndarray = field(repr=False)
    """[R, 3] base colours in truth."""


class PaintedGaussianStream:
    """Endless edits by number."""

    def __init__(
        self,
        source: MeshSource,
        recipe: SampleRecipe,
        seed: int = 0,
        environments: Sequence[Any] = (),
        resources: EditResources | None = None,
        folder: Path | None = None,
        count: int = 4096,
        asset_kinds: Sequence[PaintedAssetKind] = ("coarse", "fitted"),
    ) -> None:
        """folder: where edits are kept, None: nowhere; count: edits after which the first comes again. Raises
        ValueError where no kind of the recipe is one that is painted."""
        self.kinds = {kind: recipe.kinds[kind] for kind in PAINTED_KINDS if recipe.kinds.get(kind, 0) > 0}
        if not self.kinds or not asset_kinds or count < 1:
            raise ValueError(f"rows: expected kinds of {', '.join(PAINTED_KINDS)} with weights, got {recipe.kinds}")
        self.source, self.recipe, self.seed, self.folder, self.count = source, recipe, seed, folder, count
        self.environments, self.asset_kinds = tuple(environments), tuple(asset_kinds)
        self.resources = resources or EditResources()
        self.samples_per_object = recipe.steps_per_object
        self._scenes = Recent[PaintedScene](2)
        self._bad: dict[int, str] = {}

    def __getitem__(self, index: int) -> PaintedGaussians:
        """Raises IndexError below 0, and ValueError, naming the object, where it cannot be painted."""
        if index < 0:
            raise IndexError(f"rows: expected an index from 0, got {index}")
        number = index % self.count
        path = self._path(number)
        if path is not None and path.is_file() and (stored := _read(path)) is not None:
            return stored
        edit = self.full_edit(number)
        regions = list(picture_regions(edit.painted.asset, edit.lifted, edit.view))
        if not regions:
            raise ValueError(f"{edit.name}: the picture shows no surface")
        rng = self._generator("readers", number)
        parts, truths, first = [], [], 0
        for k in np.sort(rng.permutation(len(regions))[:MAX_REGIONS]).tolist():
            region = regions[k]
            chosen = np.sort(rng.permutation(len(region.index))[:MAX_READERS])
            rows = np.arange(first, first + len(chosen))
            parts.append(replace(region, readers=region.readers.take(chosen), index=rows))
            truths.append(edit.truth[region.index[chosen]])
            first += len(chosen)
        arrays = _arrays(PaintedGaussians(edit.name, edit.kind, tuple(parts), np.concatenate(truths)))
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with writing(path) as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]
        return _edit(arrays)  # as it comes from the disk

    def full_edit(self, index: int) -> PaintedEdit:
        """The edit of this number with everything around it. Raises ValueError as `[]`."""
        painted = self._scene(index // self.samples_per_object)
        name, rng = painted.scene.object.name, self._generator("edit", index)
        odds = np.array(list(self.kinds.values()))
        kind = str(rng.choice(list(self.kinds), p=odds / odds.sum()))
        problem = "changed nothing that can be seen"
        for attempt in range(MAX_TRIES):
            spec = SampleSpec(self.recipe, 1, 1 - attempt / MAX_TRIES)
            sample = (
                edit_samples.zoom(painted.scene, spec, rng)
                if kind == "zoom"
                else edit_samples.paint(painted.scene, kind, spec, self.resources, rng)
            )
            if sample is None:
                continue
            colors = sample.edited.colors.numpy()
            (view,) = edit_views(painted.asset, sample.edited.cameras, list(colors), list(sample.masks))
            try:
                lifted = lifted_edit(painted, view)
            except ValueError as error:
                problem = str(error)
                continue
            truth = true_colors(sample.truth, lifted.splats.take(lifted.ids))
            return PaintedEdit(name, f"{kind} {painted.kind}", painted, sample, view, lifted, truth)
        raise ValueError(f"{name}: {MAX_TRIES} choices of a {kind} edit: {problem}")

    def _scene(self, block: int) -> PaintedScene:
        return self._scenes.get(block, lambda: self._make_scene(block))

    def _make_scene(self, block: int) -> PaintedScene:
        """The asset of a block: every object once in an epoch, coarse or fitted; bad ones give way to the next."""
        count = len(self.source)
        epoch, position = divmod(block, count)
        first = int(self._generator("epoch", epoch).permutation(count)[position])
        rng = self._generator("scene", block)
        kind = cast(PaintedAssetKind, str(rng.choice(self.asset_kinds)))
        for step in range(count):
            i = (first + step) % count
            if i in self._bad:
                continue
            try:
                return self.scene_of(i, kind, rng)
            except ValueError as error:
                self._bad[i] = str(error)
        reason = next(iter(self._bad.values()), "the source is empty")
        raise ValueError(f"samples: none of the {count} objects can be used; the first: {reason}")

    def scene_of(self, i: int, kind: PaintedAssetKind, rng: np.random.Generator) -> PaintedScene:
        """Object `i` of the source as an asset of this kind. Raises ValueError where it cannot be one."""
        recipe, name = self.recipe, self.source.name(i)
        roughness, seed = float(rng.uniform(*recipe.fuzz)), int(rng.integers(1 << 31))
        item = mesh_object(name, self.source.mesh(i), recipe.surfels, recipe.rows, roughness, seed, "cpu")
        background = recipe.backgrounds[int(rng.integers(len(recipe.backgrounds)))]
        optics = Optics(recipe.size, float(rng.uniform(*recipe.fov)), background)
        light = random_light(rng, self.environments)
        scene = illuminate(item, light, 0, optics, 1, rng)
        if kind == "fitted":
            asset = fitted(item, light, optics, recipe.rows, rng)
            scene = replace(scene, asset=asset, coarse=asset.torch("cpu"))
        return PaintedScene(scene, kind, Surface.of(scene.asset), voxelize(scene.asset))

    def _path(self, number: int) -> Path | None:
        if self.folder is None:
            return None
        recipe = self.recipe
        sizes = (recipe.size, recipe.rows, recipe.surfels, recipe.fuzz, recipe.fov, recipe.share, recipe.window)
        names = [self.source.name(i) for i in range(len(self.source))]
        files = [len(part) for part in (self.resources.decals, self.resources.fonts, self.resources.textures)]
        identity = [VERSION, names, self.seed, sizes, self.kinds, self.asset_kinds, files, recipe.steps_per_object]
        identity += [recipe.zoom, recipe.lit_paint, recipe.backgrounds, len(self.environments)]
        digest = hashlib.sha256(json.dumps(identity, default=str).encode()).hexdigest()[:20]
        return self.folder / f"painted-{digest}" / f"{number:06d}.npz"

    def _generator(self, what: str, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *b"painted", *what.encode(), *numbers])


def lifted_edit(painted: PaintedScene, view: EditView) -> LiftedEdit:
    """The lift's answer, laid out as the painter does."""
    asset = painted.asset
    return lift_local_views(
        asset, painted.grid, [view], "lift", features=False, surface=painted.surface, originals=len(asset)
    )


def true_colors(truth: Splats[Tensor], gaussians: Splats) -> np.ndarray:
    """[R, 3] float32 base colours of Gaussians: means over the nearest surfels of the truth (torch), by distance in the
    Gaussian's own width."""
    points, colors = truth.means.cpu().numpy(), base_color(truth.sh).cpu().numpy()
    spacing = float(np.median(truth.scales[:, 0].cpu().numpy()))
    distances, ids = KDTree(points).query(gaussians.means, k=min(TRUTH_NEIGHBOURS, len(points)))
    width = np.sort(gaussians.scales, 1)[:, 1:].mean(1)
    # Far from all of them the nearest one counts alone.
    width = np.maximum(width, 0.5 * spacing)[:, None]
    weights = np.exp((distances[:, :1] ** 2 - distances**2) / (2 * width**2))
    weights /= weights.sum(1, keepdims=True)
    return np.clip((weights[..., None] * colors[ids]).sum(1), 0, 1).astype(np.float32)


def _arrays(edit: PaintedGaussians) -> dict[str, np.ndarray]:
    """What is kept of an edit, in half precision."""
    tokens, readers = [region.tokens for region in edit.regions], [region.readers for region in edit.regions]
    wide = {
        "values": np.concatenate([part.values for part in tokens]),
        "inside": np.concatenate([part.inside for part in readers]),
        "facts": np.concatenate([part.facts for part in readers]),
        "before": np.concatenate([part.before for part in readers]),
        "truth": edit.truth,
    }
    exact = {
        "cells": np.concatenate([part.cells for part in tokens]),
        "reader_cells": np.concatenate([part.cells for part in readers]),
        "counts": np.array([(len(one.cells), len(two.cells)) for one, two in zip(tokens, readers, strict=True)]),
        "name": np.array(edit.name),
        "kind": np.array(edit.kind),
    }
    return {name: values.astype(np.float16) for name, values in wide.items()} | exact


def _edit(arrays: dict[str, np.ndarray]) -> PaintedGaussians:
    """The inverse of `_arrays`."""
    wide = {key: values.astype(np.float32) for key, values in arrays.items() if values.dtype == np.float16}
    regions, token, reader = [], 0, 0
    for tokens, readers in arrays["counts"].tolist():
        of, by = slice(token, token + tokens), slice(reader, reader + readers)
        asking = PatchReaders(arrays["reader_cells"][by], wide["inside"][by], wide["facts"][by], wide["before"][by])
        patches = PatchTokens(arrays["cells"][of], wide["values"][of])
        regions.append(PictureRegion(patches, asking, np.arange(reader, reader + readers)))
        token, reader = token + tokens, reader + readers
    return PaintedGaussians(str(arrays["name"]), str(arrays["kind"]), tuple(regions), wide["truth"])


def _read(path: Path) -> PaintedGaussians | None:
    """None for a file that is damaged, or another program's."""
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            return _edit({key: file[key] for key in file.files})
    except (OSError, KeyError, ValueError, EOFError, BadZipFile):
        return None
