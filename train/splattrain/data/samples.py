"""Training samples: an asset, edited views of it, and how it should look from new sides afterwards.

    stream = SampleStream(MeshFolder("meshes"), RECIPES["unified"], seed=0, environments=hdris)
    sample = stream[17]                      # the same for equal (source, recipe, seed, 17), in any order of access

Samples that follow each other share their object, light and asset (`sample.asset is before.asset`) for
recipe.steps_per_object steps, so that whoever encodes assets does it once. The truth is a dense set of surfels; edits
and lights change their colours, and every picture is rendered from them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from splatpainter.splats import Splats
from splatpainter.system.recent import Recent
from splattrain.data import edit_samples
from splattrain.data.edit_samples import EditSample, SampleSpec
from splattrain.data.edits.content import EditResources, list_files
from splattrain.data.lights import random_light
from splattrain.data.lit_scenes import LitScene, PosedViews, SceneObject, illuminate, mesh_object, splat_object
from splattrain.data.object_sources import MeshSource, ObjectSource, SplatSource
from splattrain.data.sample_recipes import GLOBAL, KINDS, LOCAL, RECIPES, SampleRecipe
from splattrain.data.viewpoints import Optics

__all__ = ["GLOBAL", "KINDS", "LOCAL", "PosedViews", "RECIPES", "Sample", "SampleRecipe", "SampleStream"]

Mode = Literal["local", "global"]
MAX_TRIES = 20
"""Sub-seeds that are tried before an object counts as one that cannot be edited."""


@dataclass(frozen=True)
class Sample:
    """One training step's data. Everything but `base` and `asset` is about this one edit."""

    name: str
    """Name of the object."""
    kind: str
    mode: Mode
    asset: Splats
    """numpy float32, as an artist has it: coarse, irregular, under the source light."""
    base: PosedViews
    """The unedited truth around the object."""
    edited: PosedViews
    """What the model is given: renders of the edited truth. In a conflict: the first view before the second edit."""
    masks: np.ndarray
    """[V, H, W] bool: what was edited; where the object is, for a zoom and for global kinds."""
    novel_before: PosedViews
    """Novel views before the edit (of a zoom: the asset itself)."""
    novel_after: PosedViews
    """Novel views after it, from the same cameras."""
    near: np.ndarray
    """[W] bool: the view is near the edit."""


class SampleStream:
    """Endless samples by number; equal (source, recipe, seed, index) give equal samples on one kind of device, in any
    order of access. Not for several threads at once.

    source: bad objects are skipped, see `source.skipped`, and the next one serves. Splat assets bring their light: the
    kinds "zoom" and "relight" are left out for them. environments: [h, w, 3] linear pictures for lights (procedural
    ones without). decals, fonts, textures: files, or a folder, for stickers, text and photo patches. device: where
    surfels live and pictures are rendered. cache_bytes: of surfels kept for objects seen lately."""

    def __init__(
        self,
        source: ObjectSource,
        recipe: SampleRecipe,
        seed: int = 0,
        environments: Sequence[Any] = (),
        decals: Sequence[str | Path] | str | Path = (),
        fonts: Sequence[str | Path] | str | Path = (),
        textures: Sequence[str | Path] | str | Path = (),
        device: str = "cpu",
        cache_bytes: int = 1 << 30,
    ) -> None:
        self.source, self.recipe, self.seed, self.device = source, recipe, seed, device
        self.environments = tuple(environments)
        self.resources = EditResources(list_files(decals), list_files(fonts), list_files(textures))
        self.splats = not hasattr(source, "mesh")
        self.kinds = {k: w for k, w in recipe.kinds.items() if w > 0 and not (self.splats and k in ("zoom", "relight"))}
        if not self.kinds:
            raise ValueError(f"samples: none of the kinds {sorted(recipe.kinds)} can be made of splat assets")
        self.retries: Counter[str] = Counter()
        """Kind -> choices that were thrown away because they made no visible edit."""
        self._objects = Recent[SceneObject](cache_bytes, lambda item: item.nbytes)
        self._scenes = Recent[LitScene](2)
        self._bad: dict[int, str] = {}

    def __getitem__(self, index: int) -> Sample:
        """Raises ValueError, naming the object, when MAX_TRIES choices made no visible edit of it, and when the
        source has no good object at all."""
        if index < 0:
            raise IndexError(f"samples: expected an index from 0, got {index}")
        scene = self._scene(index // self.recipe.steps_per_object)
        rng = self._generator("kind", index)
        weights = np.array(list(self.kinds.values()))
        kind = str(rng.choice(list(self.kinds), p=weights / weights.sum()))
        for attempt in range(MAX_TRIES):
            edit = self._edit(scene, kind, 1 - attempt / MAX_TRIES, self._generator("take", index, attempt))
            if edit is not None:
                break
            self.retries[kind] += 1
        else:
            raise ValueError(
                f"{scene.object.name}: {MAX_TRIES} choices of a {kind} edit changed nothing that can be seen"
            )
        mode: Mode = "global" if kind in GLOBAL else "local"
        common = (scene.object.name, kind, mode, scene.asset, scene.base)
        return Sample(*common, edit.edited, edit.masks, edit.before, edit.after, edit.near)

    def scene_object(self, block: int) -> SceneObject:
        """The object of samples block * recipe.steps_per_object and on. Raises ValueError when the source has no good
        object at all."""
        return self._object(block)[0]

    def _edit(self, scene: LitScene, kind: str, strictness: float, rng: np.random.Generator) -> EditSample | None:
        odds = np.array(self.recipe.views)
        spec = SampleSpec(self.recipe, 1 + int(rng.choice(len(odds), p=odds / odds.sum())), strictness)
        if kind == "relight":
            light = random_light(rng, self.environments, self.device)
            return edit_samples.relight(scene, light, spec, rng)
        if kind == "conflict":
            return edit_samples.conflict(scene, spec, self.resources, rng)
        if kind == "zoom":
            return edit_samples.zoom(scene, spec, rng)
        if kind == "regrade":
            return edit_samples.regrade(scene, spec, rng)
        if kind == "plain":
            return edit_samples.plain(scene, spec, rng)
        return edit_samples.paint(scene, kind, spec, self.resources, rng)

    def _scene(self, block: int) -> LitScene:
        return self._scenes.get(block, lambda: self._make_scene(block))

    def _make_scene(self, block: int) -> LitScene:
        item, scale = self._object(block)
        rng, r = self._generator("stage", block), self.recipe
        background = r.backgrounds[rng.integers(len(r.backgrounds))]
        optics = Optics(max(round(r.size * scale), 16), float(rng.uniform(*r.fov)), background)
        light = None if self.splats else random_light(rng, self.environments, self.device)
        return illuminate(item, light, r.sh_degree, optics, r.base_views, rng)

    def _object(self, block: int) -> tuple[SceneObject, float]:
        """The object of a block and the scale of its resolution: every object once per epoch, in an order of that
        epoch; bad ones give way to the next in the source."""
        count = len(self.source)
        epoch, position = divmod(block, count)
        first = int(self._generator("epoch", epoch).permutation(count)[position])
        for step in range(count):
            i = (first + step) % count
            if i in self._bad:
                continue
            try:
                return self._objects.get(i, lambda i=i: self._make_object(i)), self._resolution_scale(i)
            except ValueError as error:
                self._bad[i] = str(error)
        reason = next(iter(self._bad.values()), "the source is empty")
        raise ValueError(f"samples: none of the {count} objects can be used; the first: {reason}")

    def _make_object(self, i: int) -> SceneObject:
        if self.splats:
            return splat_object(cast(SplatSource, self.source), i, self.device)
        rng, r, area = self._generator("subject", i), self.recipe, self._resolution_scale(i) ** 2
        counts = round(r.surfels * area), round(r.rows * area)
        roughness, seed = float(rng.uniform(*r.fuzz)), int(rng.integers(1 << 31))
        mesh = cast(MeshSource, self.source).mesh(i)
        return mesh_object(self.source.name(i), mesh, *counts, roughness, seed, self.device)

    def _resolution_scale(self, i: int) -> float:
        """Resolution factor of object i: 1 for splat assets, which are as they are."""
        low, high = np.log(self.recipe.detail)
        return 1.0 if self.splats else float(np.exp(self._generator("detail", i).uniform(low, high)))

    def _generator(self, what: str, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *what.encode(), *numbers])
