"""Rows with trained networks: test-time training, its cross-attention variant, and the reconstruction models alone.

    ttt, ttt-polish      the shipped weights (or --weights compact=FOLDER)
    cross-attention      a model whose Stage II attends to the pictures instead of adapting to them
    lrm                  the Gaussian LRM in one pass over base and edited views: the paper's GS-LRM row
    stage-1              LRM and Stage I of a `copy` model on all views: the paper's "Ours (stage I)"

Weights are read before any clock starts. Their encodings are never taken from the cache on disk, so that set-up is what
a new asset costs. Here is also where rows find their weights (`Needed`), for stage_one.py and ablations.py.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatbench.cases import Pictures
from splatbench.methods import Budget, Done, Method, Work
from splatbench.methods.lift import TABLES, painted
from splatpainter.models.checkpoint import INDEX
from splatpainter.models.config import LrmConfig, ModelConfig

if TYPE_CHECKING:
    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import Copy, SplatPainterModel
    from splatpainter.splats import Splats

SHIPPED = "compact"
"""The name under which the weights of the package are replaced."""
LARGEST = 2
"""Pictures for the reconstruction models: at most this many times the size of those that they were trained on. Twice is
measured to be better than once: 21.1 instead of 18.4 dB near a close-up."""
VERSION = "1"
"""Of how these rows use their weights."""


@dataclass(frozen=True)
class Needed:
    """Weights that a row needs: where they are looked for, and what they must be."""

    names: tuple[str, ...] = (SHIPPED,)
    """Keys of Budget.weights, the first that is there counts; "compact" falls back to the package's own."""
    what: str = ""
    """What model it must be, in words."""
    fits: Callable[[ModelConfig], bool] = lambda _: True
    train: str = ""
    """Arguments of `splatpainter train` that make one."""

    def folder(self, budget: Budget) -> Path | None:
        """Of the weights, or None."""
        from splatpainter.models import weights

        for name in self.names:
            if name in budget.weights:
                return Path(budget.weights[name])
        return weights.find(SHIPPED) if SHIPPED in self.names else None

    def source(self, budget: Budget) -> str:
        """Which of the names it is, in words."""
        given = next((f"weights '{name}'" for name in self.names if name in budget.weights), "")
        return given or f"the shipped weights of '{SHIPPED}'"

    def missing(self, budget: Budget) -> str:
        """Why there are none that fit, or ""."""
        folder, name = self.folder(budget), self.names[0]
        if folder is None:
            how = f"train with `splatpainter train {self.train}`, then " if self.train else ""
            return f"no weights: {how}--weights {name}=FOLDER"
        try:
            config = _described(folder)[0]
        except ValueError as error:
            return f"no weights: {self.source(budget)}: {error}"
        return "" if self.fits(config) else f"no weights: {self.source(budget)} are of no {self.what}"

    def version(self, budget: Budget) -> str:
        """Changes with the weights: of their config and the hashes of their files, which are checked when read."""
        folder = self.folder(budget)
        try:
            return f"{VERSION}-none" if folder is None else f"{VERSION}-{_described(folder)[1]}"
        except ValueError:
            return f"{VERSION}-none"

    def config(self, budget: Budget) -> ModelConfig:
        """Of the weights, without reading them. Raises ValueError where there are none that fit."""
        folder, problem = self.folder(budget), self.missing(budget)
        if folder is None or problem:
            raise ValueError(problem)
        return _described(folder)[0]

    def load(self, budget: Budget) -> SplatPainterModel:
        """The model on the budget's device. Raises ValueError where there is none that fits."""
        folder, problem = self.folder(budget), self.missing(budget)
        if folder is None or problem:
            raise ValueError(problem)
        return _loaded(str(folder), _described(folder)[1], budget.device)


def _described(folder: Path) -> tuple[ModelConfig, str]:
    """(config, 16 hex digits that change with config or weights) of a checkpoint, without reading its weights. Raises
    ValueError, without the folder's name: tables are for people elsewhere."""
    try:
        index = json.loads((folder / INDEX).read_bytes())
        config = ModelConfig.from_json(json.dumps(index["config"]), INDEX)
        told = json.dumps([index["config"], index["tensors"], index["shards"]], sort_keys=True)
    except OSError as error:
        raise ValueError(f"expected a folder with {INDEX} and its shards ({error.strerror})") from None
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"expected a {INDEX} of this version ({error})") from None
    return config, hashlib.sha256(told.encode()).hexdigest()[:16]


@cache
def _loaded(folder: str, digest: str, device: str) -> SplatPainterModel:
    """Once per process; digest: so that other weights in the same folder are read."""
    from splatpainter.models.model import SplatPainterModel

    return SplatPainterModel.load(folder).to(device)


def refined(needed: Needed, *, polish: bool = False) -> Callable[[Work, Budget], Done]:
    """A row: Stage II with these weights, and two rounds of the lift afterwards with polish."""

    def edit(work: Work, budget: Budget) -> Done:
        from splatpainter.painter import Painter

        return painted(Painter(model=needed.load(budget), polish=polish), "ttt", work)

    return edit


def sized(pictures: Pictures, config: LrmConfig) -> Pictures:
    """The pictures at a size that the LRM takes: whole patches, at most LARGEST times what it was trained at (pixels
    are averaged; larger ones would take minutes). Those that fit stay as they are."""
    import torch
    from torch.nn.functional import interpolate

    height, width = pictures.colors.shape[1:3]
    scale = min(1.0, LARGEST * config.image_size / max(height, width))
    high, wide = (max(int(edge * scale) // config.patch, 1) * config.patch for edge in (height, width))
    if (high, wide) == (height, width):
        return pictures
    colors = torch.from_numpy(np.ascontiguousarray(pictures.colors, np.float32)).permute(0, 3, 1, 2)
    small = interpolate(colors, size=(high, wide), mode="area").permute(0, 2, 3, 1)
    return Pictures(tuple(camera.resized(wide, high) for camera in pictures.cameras), small.contiguous().numpy())


def all_views(model: SplatPainterModel, work: Work, edited: Pictures) -> AssetViews:
    """Base views, evenly fewer where all would be more than the LRM takes, then the edited ones. With geometry, depth
    and alpha are rendered from the asset, and pictures put before black, as in training. Raises ValueError for
    pictures of several sizes."""
    import torch

    from splatpainter.models.lrm import MOST_VIEWS, AssetViews
    from splatpainter.rendering import render
    from splatpainter.voxels.grid import bounding_cube

    if len(edited) > MOST_VIEWS:
        raise ValueError(f"lrm: expected at most {MOST_VIEWS} edited views in all, got {len(edited)}")
    room = min(MOST_VIEWS - len(edited), len(work.base))
    base = work.base.take(np.arange(room) * len(work.base) // max(room, 1))
    pictures = sized(joined(base, edited), model.config.lrm)
    cameras, colors = pictures.cameras, pictures.colors.astype(np.float32)
    lo, size = bounding_cube(work.asset)
    device = next(model.parameters()).device
    known: dict[str, torch.Tensor] = {}
    if model.config.lrm.geometry:
        drawn = render(work.asset, list(cameras))
        behind = np.array([camera.background for camera in cameras], np.float32)[:, None, None]
        colors = np.clip(colors - (1 - drawn.alphas) * behind, 0, 1)
        known = {"depth": drawn.depths, "alpha": drawn.alphas}
        known = {name: torch.as_tensor(x, dtype=torch.float32).to(device) for name, x in known.items()}
    return AssetViews(cameras, torch.from_numpy(colors).to(device), **known, middle=lo + size / 2, half=size / 2)


def dense(model: SplatPainterModel, views: AssetViews) -> Copy:
    """`model.copy_rows` for views of several focal lengths: one pass of the transformer over all of them, but the
    Gaussians of each view get sizes of that view's own pixels (a close-up's are smaller). Raises ValueError as
    copy_rows."""
    import torch

    from splatpainter.models.gaussian_groups import TokenLinks
    from splatpainter.models.lrm import AssetViews
    from splatpainter.models.model import Copy
    from splatpainter.splats import ATTRIBUTES

    tokens = model.lrm.encode(views)
    parts = []
    for k, part in enumerate(tokens.chunk(len(views.cameras))):
        one = slice(k, k + 1)
        known = {name: x[one] for name in ("depth", "alpha") if (x := getattr(views, name)) is not None}
        own = AssetViews([views.cameras[k]], views.colors[one], **known, middle=views.middle, half=views.half)
        parts.append(model.lrm.decode(part, own))
    whole = {name: torch.cat([getattr(part, name) for part in parts]) for name in ATTRIBUTES}
    splats = replace(parts[0], **whole)
    seen = (splats.opacities > model.config.compress.min_opacity) & model.lrm.shown(views, splats)
    shown = torch.nonzero(seen)[:, 0]
    if len(shown) == 0:
        raise ValueError("encode: the model sees nothing in the views; check that they show the asset")
    patches = (shown // model.config.lrm.patch**2).cpu().numpy()[:, None]
    return Copy(splats.take(shown), tokens, TokenLinks(patches, np.ones(patches.shape, np.float32)))


def compressed(model: SplatPainterModel, copy: Copy) -> tuple[Splats, dict[str, float]]:
    """(what Stage I makes of the LRM's Gaussians, row counts at its ends)."""
    from splatpainter.voxels.grid import voxelize

    grid = voxelize(copy.rows.numpy(), model.config.compress.resolution)
    latents = model.compressor(copy.tokens, copy.rows, copy.links, model.groups(grid))
    splats = model.decode_latents(latents, copy.rows)
    counts = {"gaussians_before": len(copy.rows), "voxels": len(grid.keys), "latents": len(latents.values)}
    return splats, {name: float(count) for name, count in counts.items()} | {"gaussians_kept": float(len(splats))}


def reconstruction(needed: Needed, *, stage_one: bool) -> Callable[[Work, Budget], Done]:
    """A row: a new asset from base and edited views (of all steps so far) in one pass, by the LRM alone or with Stage I
    after it. There is no set-up: every edit is the whole pass."""

    def edit(work: Work, budget: Budget) -> Done:
        import torch

        from splatpainter.nn.precision import autocast

        model = needed.load(budget)
        start = time.perf_counter()
        edited = joined(work.memory, work.step.edited)
        with torch.inference_mode(), autocast(budget.device):
            views = all_views(model, work, edited)
            copy = dense(model, views)
            splats, numbers = compressed(model, copy) if stage_one else (copy.rows, {})
            splats = splats.numpy()
        numbers["lrm_gaussians"] = float(len(copy.rows))
        seconds = time.perf_counter() - start
        told = f"{len(views.cameras)} views of {views.cameras[0].width} px at once; {needed.source(budget)}"
        return Done(splats, 0.0, seconds, keeps_rows=False, numbers=numbers, note=told, memory=edited)

    return edit


def joined(earlier: Pictures | None, new: Pictures) -> Pictures:
    """All of them, in order. Raises ValueError for pictures of several sizes."""
    if earlier is None:
        return new
    if earlier.colors.shape[1:] != new.colors.shape[1:]:
        sizes = " and ".join(f"{p.colors.shape[2]}x{p.colors.shape[1]}" for p in (earlier, new))
        raise ValueError(f"lrm: expected views of one size, got {sizes}")
    return Pictures((*earlier.cameras, *new.cameras), np.concatenate([earlier.colors, new.colors]))


def is_copy(config: ModelConfig) -> bool:
    return config.representation == "copy"


COMPACT = Needed()
CROSS = Needed(
    ("cross-attention",),
    "model with refine.mixer cross_attention",
    lambda config: config.refine.mixer == "cross_attention",
    "refine --model.refine.mixer cross_attention --model.refine.row-tokens 0",
)
COPY = Needed(
    ("copy", "feats-query"),
    "model of representation copy",
    is_copy,
    "compress --model.representation copy",
)


def _method(name: str, label: str, needed: Needed, row: Callable[[Work, Budget], Done], *tables: str) -> Method:
    return Method(name, label, row, tables, missing=needed.missing, version=needed.version)


METHODS = (
    _method("ttt", "Ours (TTT)", COMPACT, refined(COMPACT), *TABLES),
    _method("ttt-polish", "Ours (TTT + polish)", COMPACT, refined(COMPACT, polish=True), *TABLES),
    _method("cross-attention", "Ours (cross-attention)", CROSS, refined(CROSS), *TABLES),
    _method("lrm", "GS-LRM, all views", COMPACT, reconstruction(COMPACT, stage_one=False), "refine"),
    _method("stage-1", "Ours (Stage I)", COPY, reconstruction(COPY, stage_one=True), "refine"),
)
