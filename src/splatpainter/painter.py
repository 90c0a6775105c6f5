"""The painter: pure functions from (asset, edits) to asset. Knows no layers and no history.

painter = Painter.load()                      # trained weights where they beat the analytic lift, else that
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
from splatpainter.nn.precision import Arithmetic, Precision, autocast, resolve, setting
from splatpainter.receipts import Receipt, changed_rows, scores, untouched_hashes
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.lift.global_edit import GlobalOptions, Predict
    from splatpainter.lift.local_edit import LocalOptions
    from splatpainter.models.draft import Draft, EditView
    from splatpainter.models.encode import Encoded
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState
    from splatpainter.voxels.grid import VoxelGrid

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
    """An asset that can be edited: its rows, and what a painter keeps beside them. Immutable; edits return new ones,
    and to undo one is to go on from the old."""

    splats: Splats
    receipt: Receipt | None = None
    """Of the edit that made it; None for a fresh one."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N] float32 0..1 after a global edit: seen (1) or predicted (towards 0)."""
    learnt: Learnt | None = field(default=None, repr=False)
    """What a model knows of it; None where no edit has needed that yet."""

    @cached_property
    def grid(self) -> VoxelGrid:
        """The 128^3 voxels of the rows, made on first use."""
        from splatpainter.voxels.grid import voxelize

        return voxelize(self.splats)

    @cached_property
    def normals(self) -> np.ndarray:
        """[N, 3] float32 outward unit normals of the rows, made on first use; zeros for rows that cannot be drawn."""
        from splatpainter.lift.global_edit import outward_normals

        return outward_normals(self.splats)

    @cached_property
    def transfer(self) -> np.ndarray:
        """[N, 10] float32 the light that reaches the rows (`visibility.row_transfer`), made on first use."""
        from splatpainter.lighting import row_transfer

        return row_transfer(self.splats.means, self.normals)


@dataclass(frozen=True)
class Learnt:
    """What a model knows of an asset: its encoding, and what the edits since have taught it."""

    model: SplatPainterModel
    """Whose they are; another one starts afresh."""
    encoded: Encoded
    """Of the asset as it was before all edits."""
    parents: np.ndarray
    """[N] int64 the encoded row whose latent each row of the asset reads: itself, or the one that it was split from."""
    state: RefineState | None = None
    """Fast weights, which the next edit starts from; None before the first."""


@dataclass(frozen=True)
class Painter:
    """A method with its settings."""

    preset: str = ""
    """What receipts call it; by default the model's preset, or "lift"."""
    local: LocalOptions | None = None
    """Settings of local lifts; None: the defaults."""
    whole: GlobalOptions | None = None
    """Settings of global lifts; None: the defaults."""
    model: SplatPainterModel | None = field(default=None, repr=False)
    """The networks for method "ttt", on any device; None: the lift alone."""
    polish: bool = False
    """Two rounds of the lift's colours after the network, on the rows that the edit may change."""
    cache: bool = False
    """Keep encoded assets on disk (models/cache.py); for models whose weights stay as they are."""
    why: str = ""
    """If not empty, method "auto" is the lift, and receipts say this line."""
    precision: Precision = "auto"
    """Arithmetic of the networks (nn.precision); as made, "auto" means that SPLATPAINTER_PRECISION does not say either
    and the model's device decides."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "precision", setting(self.precision))
        if not self.preset:
            object.__setattr__(self, "preset", "lift" if self.model is None else self.model.config.preset)

    @staticmethod
    def load(
        preset: str = "auto",
        *,
        modes: Sequence[Mode] = ("local", "global"),
        polish: bool = False,
        cache: bool = True,
        precision: Precision = "auto",
    ) -> Painter:
        """The painter of a preset: "lift", "compact", "paper", or a folder of weights; "auto" is "compact" where its
        weights are there, else "lift". Its weights are read when an edit first needs them: with method "ttt", or
        "auto" where they beat the lift (`choose`) in one of the modes that will be asked for. polish, cache, precision:
        as the fields.

        Raises ValueError for a preset that is not known, or has no weights or wrong ones, and for a precision that is
        not known, here or in SPLATPAINTER_PRECISION."""
        from splatpainter.models import weights

        why = "preset 'lift': the analytic lift"
        if preset == "auto":
            model = weights.deferred("compact")
            if model is None:
                return Painter(why="no trained weights: the analytic lift", precision=precision)
            gain, why = model.notes.get("gain", {}), ""
            if gain and max((gain[mode] for mode in modes if mode in gain), default=1.0) <= 0:
                # Reading and running them would be for nothing, unless method "ttt" asks for it.
                where = "" if set(modes) >= set(gain) else f" in {' and '.join(modes)} edits"
                why = f"the weights of preset 'compact' do not beat the lift{where} yet: the analytic lift"
            return Painter(model=model, polish=polish, cache=cache, why=why, precision=precision)
        if preset == "lift":
            return Painter(why=why, precision=precision)
        return Painter(model=weights.load(preset), polish=polish, cache=cache, precision=precision)

    def encode(self, splats: Splats, method: Method = "auto", modes: Sequence[Mode] = ("local", "global")) -> Asset:
        """Prepare an asset for edits by `method` in these modes: for "ttt", run the LRM and Stage I where they are
        needed (`encodes`). In `copy` representation the asset's rows are then Stage I's. Raises ValueError when it has
        no row that can be drawn."""
        own = splats.numpy()
        if not own.drawable.any():
            raise ValueError(f"asset: none of the {len(own)} rows can be drawn (NaN, zero scale or zero quaternion)")
        asset = Asset(own)
        wanted = any(self.encodes(self.choose(method, mode)[0], mode) for mode in modes)
        return self._encoded(asset) if wanted else asset

    def encodes(self, method: Method, mode: Mode) -> bool:
        """Whether edits by this method, not "auto", are made on an encoded asset."""
        if method != "ttt" or self.model is None:
            return False
        return mode == "local" or not self.model.config.predicts_alone

    def apply(self, asset: Asset, edits: Sequence[Edit], mode: Mode = "local", method: Method = "auto") -> Asset:
        """The asset after 1..16 edits; `asset` itself does not change. Later edits win where edits conflict.

        mode "local": only rows that visibly make the edited pixels change, rows finer than the old ones are appended.
        mode "global": every row changes; what the views do not show is predicted from what they do.
        method "ttt": the networks (pictures of one size); "lift": analytic; "fit": the lift, then steps of 3DGS on the
        rows that it painted, seconds to tens of them; "auto": ttt where the painter has a model that is better in this
        mode, else lift. An asset that its model has not encoded yet is encoded first.
        Rows that did not have to change keep their bits, and old rows keep their indices.
        Raises ValueError: no edits, an empty mask, an edit that reaches no row, a camera inside the object."""
        if not 1 <= len(edits) <= MAX_VIEWS:
            raise ValueError(f"edit: expected 1 to {MAX_VIEWS} edited views, got {len(edits)}")
        if mode not in ("local", "global"):
            raise ValueError(f"edit: expected mode local or global, got {mode!r}")
        chosen, note = self.choose(method, mode)
        if mode == "global" and chosen == "fit":
            raise ValueError("edit: method 'fit' is for local edits; use 'lift' with mode 'global'")
        clock = _Clock()
        if chosen == "ttt":
            if self.encodes(chosen, mode):
                _one_size(edits)
                asset = self._encoded(asset)
                clock.lap("encode")
        views = [_prepare(asset, edit, mode) for edit in edits]
        clock.lap("prepare")
        result = self._edited(asset, views, mode, chosen, clock)
        notes = [note, _beside(views) if mode == "local" else ""]
        if chosen == "ttt":
            assert self.model is not None
            notes.append("polished: two rounds of the lift after the network" if self.polish else "")
            if self.model.config.representation == "copy":
                notes.append(f"the asset is a copy of {len(asset.splats)} rows that the model made")
        touched = changed_rows(asset.splats, result.splats)
        hashes = untouched_hashes(asset.splats, result.splats, touched)
        judged = scores([(v.before, _draw(result.splats, v.camera)[0], v.target, v.mask, _scored(v)) for v in views])
        clock.lap("receipt")
        receipt = Receipt(
            asset_sha256=asset.splats.sha256,
            asset_rows=len(asset.splats),
            output_sha256="",
            output_rows=len(result.splats),
            mode=mode,
            method=chosen,
            preset=self.preset if chosen == "ttt" else "lift",
            touched=touched,
            appended_rows=len(result.splats) - len(asset.splats),
            untouched_sha256_before=hashes[0],
            untouched_sha256_after=hashes[1],
            views=judged,
            seconds=clock.laps,
            note="; ".join(filter(None, notes)),
            precision=self._arithmetic(chosen, mode),
        )
        return replace(result, receipt=receipt)

    def _arithmetic(self, chosen: Method, mode: Mode) -> Arithmetic | Literal[""]:
        """Of the networks in an edit; "" where none runs."""
        if chosen != "ttt" or self.model is None:
            return ""
        if self.encodes(chosen, mode):
            return resolve(self.precision, next(self.model.parameters()).device)
        predictor = self.model.predictor
        return "" if predictor is None or predictor.silent else "float32"  # it solves for its weights: never rounded

    def _edited(self, asset: Asset, views: Sequence[EditView], mode: Mode, chosen: Method, clock: _Clock) -> Asset:
        """The asset after the views, still with the old receipt."""
        draft = self._draft(asset, views, mode, chosen)
        clock.lap("lift")
        if not self.encodes(chosen, mode):
            splats = draft.splats
            if chosen == "fit":
                from splatpainter.fit.edited import fit_edited

                splats = fit_edited(asset.splats, splats, [(v.camera, v.wanted) for v in views], draft.rows)
                clock.lap("fit")
            elif chosen == "ttt" and self.polish:
                splats = _polished(asset.splats, splats, draft, views, mode)
                clock.lap("polish")
            owners = draft.owners(len(asset.splats))
            return replace(asset, splats=splats, confidence=draft.confidence, learnt=_owned(asset, owners))
        result = self._refined(asset, draft, views)
        clock.lap("ttt")
        if self.polish:
            result = replace(result, splats=_polished(asset.splats, result.splats, draft, views, mode))
            clock.lap("polish")
        return result

    def choose(self, method: Method, mode: Mode) -> tuple[Method, str]:
        """What `apply` does for a method: (method, never "auto", and the one line that says why). Weights whose notes
        hold `gain`, {mode: dB over the lift on objects kept out of training}, are used by "auto" only where that is
        above 0. Raises ValueError for a method that is not known, or needs a model."""
        if method == "ttt" and self.model is None:
            raise ValueError(
                "method 'ttt' needs a preset with trained weights; use method 'lift' or 'auto' without them"
            )
        if method == "auto":
            if self.model is not None and not self.why:
                gain = self.model.notes.get("gain", {}).get(mode)
                if gain is None:
                    return "ttt", f"weights of preset '{self.preset}': test-time training"
                measured = f"{gain:+.2f} dB over the lift in {mode} edits of objects kept out of training"
                told = f"weights of preset '{self.preset}' ({measured})"
                return ("ttt", f"{told}: test-time training") if gain > 0 else ("lift", f"{told}: the analytic lift")
            return "lift", self.why or "no trained weights: the analytic lift"
        if method not in ("ttt", "lift", "fit"):
            raise ValueError(f"method: expected auto, ttt, lift or fit, got {method!r}")
        return method, ""

    def _encoded(self, asset: Asset) -> Asset:
        """The asset with what the model knows of it; the same one where that is there already."""
        model = self.model
        assert model is not None
        if asset.learnt is not None and asset.learnt.model is model:
            return asset
        from splatpainter.models.cache import encode_cached, encode_half

        with _inference(model, self.precision):
            if self.cache:
                encoded = encode_cached(model, asset.splats, asset.grid, weights=self._digest)
            else:
                encoded = encode_half(model, asset.splats, asset.grid)
        if model.config.representation == "copy":
            asset = Asset(encoded.rows.numpy())
        return replace(asset, learnt=Learnt(model, encoded, np.arange(len(asset.splats))))

    @cached_property
    def _digest(self) -> str:
        from splatpainter.models.cache import digest

        assert self.model is not None
        return digest(self.model)

    def _draft(self, asset: Asset, views: Sequence[EditView], mode: Mode, chosen: Method) -> Draft:
        from splatpainter.models.draft import draft_global, draft_local

        config = self.model.config.refine if chosen == "ttt" and self.model is not None else None
        base, features = ("lift", False) if config is None else (config.base, config.lift_features)
        if mode == "global":
            base = base if self.encodes(chosen, mode) else "lift"
            known = {"normals": asset.normals, "predict": None if config is None else self._predict(asset)}
            return draft_global(asset.splats, views, base, self.whole, features=features, **known)
        return draft_local(asset.splats, asset.grid, views, base, self.local, features=features)

    def _predict(self, asset: Asset) -> Predict | None:
        """What the model says of rows that no view shows; None where it leaves that to the lift."""
        from splatpainter.models.predictor import predicting

        assert self.model is not None
        return predicting(self.model, asset.splats, asset.normals, lambda: asset.transfer)

    def _refined(self, asset: Asset, draft: Draft, views: Sequence[EditView]) -> Asset:
        """What the network makes of a draft."""
        from splatpainter.models.draft import assemble, refine_draft

        assert self.model is not None and asset.learnt is not None
        learnt = asset.learnt
        known = replace(draft, parents=learnt.parents[draft.parents])
        with _inference(self.model, self.precision):
            state = learnt.state or self.model.initial_state()
            state, rows, further = refine_draft(self.model, state, learnt.encoded, known, views)
            splats = assemble(draft, rows, further)
        owners = draft.owners(len(asset.splats))
        owners = owners if further is None else np.append(owners, draft.parents)
        after = _owned(asset, owners)
        assert after is not None
        return replace(asset, splats=splats, confidence=draft.confidence, learnt=replace(after, state=state))


@contextmanager
def _inference(model: SplatPainterModel, precision: Precision) -> Iterator[None]:
    """No gradients, arithmetic of this precision, and eval mode; the model's own mode comes back."""
    import torch

    training = model.training
    model.eval()
    try:
        with torch.inference_mode(), autocast(next(model.parameters()).device, precision):
            yield
    finally:
        model.train(training)


def _owned(asset: Asset, owners: np.ndarray) -> Learnt | None:
    """What is known of an asset whose rows come from the rows `owners` of this one."""
    return None if asset.learnt is None else replace(asset.learnt, parents=asset.learnt.parents[owners])


def _one_size(edits: Sequence[Edit]) -> None:
    from splatpainter.models.image_tokens import one_size

    one_size([edit.camera for edit in edits])


def _prepare(asset: Asset, edit: Edit, mode: Mode) -> EditView:
    """The edit beside what the asset shows. Raises ValueError, naming the edit, where there is nothing to do."""
    from splatpainter.lift.masks import change_mask
    from splatpainter.models.draft import EditView, errors_name
    from splatpainter.voxels.raycast import inside

    with errors_name(edit.name):
        if inside(asset.grid, asset.grid.occupancy, edit.camera.position):
            raise ValueError("edit: the camera is inside the object; step back until the surface is in view")
        before, depth, alpha = _draw(asset.splats, edit.camera)
        mask = edit.mask
        if mask is None:
            mask = alpha > 0.5 if mode == "global" else change_mask(edit.image, before)
        if not mask.any():
            unchanged = (
                "the asset is not in view" if mode == "global" else "the picture does not differ from the render"
            )
            what = unchanged if edit.mask is None else "the mask is empty"
            raise ValueError(f"edit: nothing to do, {what}")
    return EditView(edit.camera, edit.image, mask, before, depth, alpha, edit.name)


def _scored(view: EditView) -> np.ndarray:
    """[H, W] bool: edited pixels that the asset covers at all."""
    assert view.alpha is not None
    return view.mask & (view.alpha > 0.5)


def _beside(views: Sequence[EditView]) -> str:
    """A line about edited pixels that no row can paint, or none."""
    edited = sum(int(view.mask.sum()) for view in views)
    beside = edited - sum(int(_scored(view).sum()) for view in views)
    return f"{beside} edited pixels lie beside the asset and cannot be painted" if beside > 0.01 * edited else ""


def _draw(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(colours [H, W, 3], expected depth [H, W], alpha [H, W])."""
    from splatpainter.rendering import render

    picture = render(splats, camera)
    return picture.colors[0], picture.depths[0, ..., 0], picture.alphas[0, ..., 0]


def _polished(before: Splats, after: Splats, draft: Draft, views: Sequence[EditView], mode: Mode) -> Splats:
    from splatpainter.models.color_refine import polish_global, polish_local

    if mode == "global":
        return polish_global(after, [(v.camera, v.target, v.mask) for v in views])
    rows = np.ones(len(after), bool)
    rows[: len(before)] = False
    rows[draft.rows] = True
    return polish_local(after, [(v.camera, v.wanted) for v in views], rows)


class _Clock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = now - self._last
        self._last = now
