"""The painter: pure functions from (asset, edits) to asset. Knows no files, no layers and no history.

painter = Painter.load()                      # the analytic lift; presets with weights come with the models
asset = painter.encode(splats)                # once per asset
edited = painter.apply(asset, [Edit(picture, camera)])
edited.splats, edited.receipt
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.receipts import Receipt, changed_rows, scores, untouched_hashes
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.lift.local import LocalOptions
    from splatpainter.lift.whole import GlobalOptions
    from splatpainter.voxels import VoxelGrid

Mode = Literal["local", "global"]
Method = Literal["auto", "ttt", "lift", "fit"]
MAX_VIEWS = 16


@dataclass(frozen=True)
class Edit:
    """One edited picture of an asset."""

    image: np.ndarray = field(repr=False)
    """[H, W, 3] the edited view, float 0..1 (or uint8), of the camera's size."""
    camera: Camera
    mask: np.ndarray | None = field(default=None, repr=False)
    """[H, W] bool, pixels that were edited; None: found by comparing with the current render."""
    name: str = "edit"
    """What errors call it, e.g. its file."""

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        size = (self.camera.height, self.camera.width)
        if image.ndim != 3 or image.shape[2] != 3 or image.shape[:2] != size:
            raise ValueError(
                f"edit: expected a picture of shape [{size[0]}, {size[1]}, 3] for its camera, got {list(image.shape)}"
            )
        if image.dtype == np.uint8:
            image = image.astype(np.float32) / 255
        if image.dtype.kind != "f":
            raise ValueError(f"edit: expected a picture of floats in 0..1 or of uint8, got {image.dtype}")
        if not np.isfinite(image).all():
            raise ValueError("edit: the picture has NaN or infinite pixels")
        if np.abs(image).max() > 16:  # a little over 1 is what renders do; 255 is a forgotten division
            raise ValueError(f"edit: expected a picture of floats in 0..1, got values up to {np.abs(image).max():g}")
        object.__setattr__(self, "image", np.ascontiguousarray(image, np.float32))
        if self.mask is not None:
            mask = np.asarray(self.mask)
            if mask.shape != size:
                raise ValueError(f"edit: expected a mask of shape {list(size)}, got {list(mask.shape)}")
            object.__setattr__(self, "mask", mask > 0)


@dataclass(frozen=True)
class Asset:
    """An encoded asset: its rows, and what a painter keeps beside them. Immutable; edits return new ones."""

    splats: Splats
    receipt: Receipt | None = None
    """Of the edit that made it; None for a fresh one."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N] float32 0..1 after a global edit: seen (1) or predicted (towards 0)."""

    @cached_property
    def grid(self) -> VoxelGrid:
        """The 128^3 voxels of the rows, made on first use."""
        from splatpainter.voxels import voxelize

        return voxelize(self.splats)


@dataclass(frozen=True)
class Painter:
    """A method with its settings."""

    preset: str = "lift"
    local: LocalOptions | None = None
    """Settings of local lifts; None: the defaults."""
    whole: GlobalOptions | None = None
    """Settings of global lifts; None: the defaults."""

    @staticmethod
    def load(preset: str = "lift") -> Painter:
        """The painter of a preset. Raises ValueError for one that this version does not have."""
        if preset != "lift":
            raise ValueError(
                f"preset: expected 'lift' (presets with trained weights are not part of this version), got {preset!r}"
            )
        return Painter(preset)

    def encode(self, splats: Splats) -> Asset:
        """Prepare an asset for edits. Raises ValueError when it has no row that can be drawn."""
        own = splats.numpy()
        if not own.finite.any():
            raise ValueError(f"asset: none of the {len(own)} rows can be drawn (NaN, zero scale or zero quaternion)")
        return Asset(own)

    def apply(self, asset: Asset, edits: Sequence[Edit], mode: Mode = "local", method: Method = "auto") -> Asset:
        """The asset after 1..16 edits; `asset` itself does not change. Later edits win where edits conflict.

        mode "local": only rows that visibly make the edited pixels change, rows finer than the old ones are appended.
        mode "global": every row changes; what the views do not show is predicted from what they do.
        Rows that did not have to change keep their bits, and old rows keep their indices.
        Raises ValueError: no edits, an empty mask, an edit that reaches no row, a camera inside the object."""
        if not 1 <= len(edits) <= MAX_VIEWS:
            raise ValueError(f"edit: expected 1 to {MAX_VIEWS} edited views, got {len(edits)}")
        if mode not in ("local", "global"):
            raise ValueError(f"edit: expected mode local or global, got {mode!r}")
        chosen, note = _choose(method)
        clock = _Clock()
        prepared = []
        for edit in edits:
            with _errors_name(edit.name):
                prepared.append(_prepare(asset, edit, mode))
        clock.lap("prepare")
        confidence = None
        if mode == "global":
            if chosen == "fit":
                raise ValueError("edit: method 'fit' is for local edits; use 'lift' with mode 'global'")
            from splatpainter.lift.whole import GlobalOptions, lift_global

            views = [(v.camera, v.target, v.mask) for v in prepared]
            with _errors_name(", ".join(dict.fromkeys(v.name for v in prepared))):
                regraded = lift_global(asset.splats, views, self.whole or GlobalOptions())
            result, confidence = regraded.splats, regraded.confidence
        elif chosen == "fit":
            result = _fit(asset, prepared)
        else:
            result = self._lift_views(asset, prepared)
        clock.lap(chosen)
        images = [(v.before, _draw(result, v.camera)[0], v.target, v.mask, v.scored) for v in prepared]
        beside = sum(int((v.mask & ~v.scored).sum()) for v in prepared)
        if mode == "local" and beside > 0.01 * sum(int(v.mask.sum()) for v in prepared):
            note = "; ".join(filter(None, [note, f"{beside} edited pixels lie beside the asset and cannot be painted"]))
        touched = changed_rows(asset.splats, result)
        hashes = untouched_hashes(asset.splats, result, touched)
        clock.lap("receipt")
        receipt = Receipt(
            asset_sha256=asset.splats.sha256,
            asset_rows=len(asset.splats),
            output_sha256="",
            output_rows=len(result),
            mode=mode,
            method=chosen,
            preset=self.preset,
            touched=touched,
            appended_rows=len(result) - len(asset.splats),
            untouched_sha256_before=hashes[0],
            untouched_sha256_after=hashes[1],
            views=scores(images),
            seconds=clock.laps,
            note=note,
        )
        return Asset(result, receipt, confidence)

    def _lift_views(self, asset: Asset, views: Sequence[_View]) -> Splats:
        """One view after the other, each on the result of those before: the latest wins."""
        from splatpainter.lift.local import LocalOptions, lift_local

        splats = asset.splats
        options = self.local or LocalOptions()
        for k, view in enumerate(views):
            grid = asset.grid if k == 0 else replace(asset, splats=splats).grid
            with _errors_name(view.name):
                allowed = _allowed(grid, splats, view)
                splats = lift_local(splats, view.camera, view.target, view.mask, options, allowed).splats
        return splats


@dataclass(frozen=True)
class _View:
    camera: Camera
    target: np.ndarray
    before: np.ndarray
    mask: np.ndarray
    """[H, W] bool pixels that were edited."""
    scored: np.ndarray
    """[H, W] bool: those of them that the asset covers at all (alpha > 0.5)."""
    name: str


@contextmanager
def _errors_name(name: str) -> Iterator[None]:
    """Among several edits, the one that is wrong is named."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {str(error).removeprefix('edit: ')}") from None


def _choose(method: Method) -> tuple[str, str]:
    """(method, the one line that says why)."""
    if method == "ttt":
        raise ValueError("method 'ttt' needs trained weights, which this version does not have; use 'lift' or 'auto'")
    if method == "auto":
        return "lift", "no trained weights: the analytic lift"
    if method not in ("lift", "fit"):
        raise ValueError(f"method: expected auto, ttt, lift or fit, got {method!r}")
    return method, ""


def _prepare(asset: Asset, edit: Edit, mode: Mode) -> _View:
    from splatpainter.lift.masks import change_mask
    from splatpainter.raycast import inside

    if inside(asset.grid, asset.grid.occupancy, edit.camera.position):
        raise ValueError("edit: the camera is inside the object; step back until the surface is in view")
    before, covered = _draw(asset.splats, edit.camera)
    if mode == "global":
        mask = covered > 0.5 if edit.mask is None else edit.mask
    else:
        mask = change_mask(edit.image, before) if edit.mask is None else edit.mask
    if not mask.any():
        unchanged = "the asset is not in view" if mode == "global" else "the picture does not differ from the render"
        what = unchanged if edit.mask is None else "the mask is empty"
        raise ValueError(f"edit: nothing to do, {what}")
    return _View(edit.camera, edit.image, before, mask, mask & (covered > 0.5), edit.name)


def _draw(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(colours [H, W, 3], alpha [H, W])."""
    from splatpainter.render import render

    picture = render(splats, camera)
    return picture.colors[0], picture.alphas[0, ..., 0]


def _allowed(grid: VoxelGrid, splats: Splats, view: _View) -> np.ndarray:
    from splatpainter.raycast import editable_rows

    return editable_rows(grid, splats, view.camera, view.mask)


def _fit(asset: Asset, views: Sequence[_View]) -> Splats:
    from splatpainter.lift.fit import fit_rows
    from splatpainter.lift.local import reached_rows

    splats = asset.splats
    reached = np.zeros(len(splats), bool)
    for view in views:
        with _errors_name(view.name):
            reached |= reached_rows(splats, view.camera, view.mask, _allowed(asset.grid, splats, view))
    targets = [(v.camera, np.where(v.mask[..., None], v.target, v.before)) for v in views]
    return fit_rows(splats, targets, np.flatnonzero(reached))


class _Clock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
