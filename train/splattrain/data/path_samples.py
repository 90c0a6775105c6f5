"""Samples whose pictures are path traced: the edits of edit_samples.py, pictures made anew by pathtrace.py.

For evaluation, and for training at scale. Only kinds whose truth is the mesh itself in a known light; paint on meshes
is that of edits/on_mesh.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from splattrain.data import edit_samples
from splattrain.data.edit_samples import EditSample, SampleSpec
from splattrain.data.lights import Light, random_light
from splattrain.data.lit_scenes import PosedViews, illuminate, mesh_object
from splattrain.data.object_sources import MeshSource
from splattrain.data.pathtrace import PathOptions, PathTraced, display, path_trace
from splattrain.data.sample_recipes import GLOBAL, SampleRecipe
from splattrain.data.samples import MAX_TRIES, Mode, Sample
from splattrain.data.viewpoints import Optics

PATH_KINDS = ("relight", "zoom", "plain")


@dataclass(frozen=True)
class Traced:
    """A sample and its linear pictures."""

    sample: Sample
    radiance: dict[str, np.ndarray]
    """"base" | "edited" | "before" | "after" -> [V, H, W, 3] linear, premultiplied (of a zoom, `before` is a render of
    the asset, and not here)."""
    exposure: dict[str, float]
    """"before" | "after": linear radiance times this went into lights.tone_map; base views have that of before."""
    repaired: int
    """Pixels that were not finite."""


class PathScene:
    """One object in one light, as SampleStream's scenes are, and its samples by number.

    The asset is shaded as SampleStream's is, by surfels: fitting its colours to the path traced base views (2 to 8
    rounds of lift/colors.py) made novel views 0.3-0.5 dB worse (gso_dino_3): rim pixels and noise reach Gaussians."""

    def __init__(
        self, source: MeshSource, i: int, recipe: SampleRecipe, options: PathOptions, seed: int, environments: Any = ()
    ) -> None:
        """Raises ValueError for a bad mesh, and for kinds that cannot be path traced."""
        refuse_kinds(recipe)
        self.recipe, self.options, self.seed, self.environments = recipe, options, seed, environments
        self.mesh = source.mesh(i)
        rng = self._generator("stage")
        sizes = (recipe.surfels, recipe.rows, float(rng.uniform(*recipe.fuzz)), int(rng.integers(1 << 31)))
        item = mesh_object(source.name(i), self.mesh, *sizes, "cpu")
        background = recipe.backgrounds[rng.integers(len(recipe.backgrounds))]
        optics = Optics(recipe.size, float(rng.uniform(*recipe.fov)), background)
        self.light = random_light(rng, environments)
        scene = illuminate(item, self.light, recipe.sh_degree, optics, recipe.base_views, rng)
        self.base, done = self._traced(scene.base, self.light, 0)
        self.base_radiance, self.repaired = done.radiance, done.repaired
        self.scene = replace(scene, base=self.base)

    def sample(self, step: int) -> Traced:
        """Sample `step` of the scene. Raises ValueError when MAX_TRIES choices made nothing worth learning from."""
        rng = self._generator("kind", step)
        kinds = {kind: weight for kind, weight in self.recipe.kinds.items() if weight > 0}
        weights = np.array(list(kinds.values()))
        kind = str(rng.choice(list(kinds), p=weights / weights.sum()))
        for attempt in range(MAX_TRIES):
            rng = self._generator("take", step, attempt)
            target = random_light(rng, self.environments) if kind == "relight" else self.light
            edit = self._edit(kind, target, 1 - attempt / MAX_TRIES, rng)
            if edit is not None:
                return self._finished(kind, edit, target, step)
        raise ValueError(f"{self.scene.object.name}: {MAX_TRIES} choices of a {kind} changed nothing that can be seen")

    def _edit(self, kind: str, target: Light, strictness: float, rng: np.random.Generator) -> EditSample | None:
        odds = np.array(self.recipe.views)
        spec = SampleSpec(self.recipe, 1 + int(rng.choice(len(odds), p=odds / odds.sum())), strictness)
        if kind == "relight":
            return edit_samples.relight(self.scene, target, spec, rng)
        return (edit_samples.zoom if kind == "zoom" else edit_samples.plain)(self.scene, spec, rng)

    def _finished(self, kind: str, edit: EditSample, target: Light, step: int) -> Traced:
        first = 1000 * (step + 1)  # of the noise's seeds: other than the base views', and other for every view
        after, done = self._traced(edit.after, target, first)
        radiance, repaired = {"base": self.base_radiance, "after": done.radiance}, self.repaired + done.repaired
        before, edited = after, edit.edited
        if kind == "zoom":
            before = edit.before
        elif kind == "relight":
            before, done = self._traced(edit.before, self.light, first + 100)
            radiance["before"], repaired = done.radiance, repaired + done.repaired
        if len(edit.edited):
            edited, done = self._traced(edit.edited, target, first + 200)
            radiance["edited"], repaired = done.radiance, repaired + done.repaired
        mode: Mode = "global" if kind in GLOBAL else "local"
        common = (self.scene.object.name, kind, mode, self.scene.asset, self.base)
        sample = Sample(*common, edited, edit.masks, before, after, edit.near)
        exposure = {"before": float(self.light.exposure), "after": float(target.exposure)}
        return Traced(sample, radiance, exposure, repaired)

    def _traced(self, views: PosedViews, light: Light, first: int) -> tuple[PosedViews, PathTraced]:
        options = replace(self.options, seed=(self.options.seed + self.seed * 7919 + first) % 2**32)
        done = path_trace(self.mesh, light.environment.cpu().numpy(), views.cameras, options)
        colors = torch.from_numpy(display(done, float(light.exposure), views.cameras))
        return PosedViews(views.cameras, colors), done

    def _generator(self, what: str, *numbers: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *what.encode(), *numbers])


def refuse_kinds(recipe: SampleRecipe) -> None:
    """Raises ValueError when a recipe has kinds that cannot be path traced."""
    wrong = [kind for kind, weight in recipe.kinds.items() if weight > 0 and kind not in PATH_KINDS]
    if wrong:
        raise ValueError(
            f"path traced truth: expected kinds of {', '.join(PATH_KINDS)}, got {', '.join(wrong)}; others need surfels"
        )
