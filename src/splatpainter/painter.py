"""The painter: pure functions from (asset, edits) to asset. Knows no layers and no history.

painter = Painter.load()                      # trained weights where they beat the analytic lift, else that
asset = painter.encode(splats)                # once per asset
edited = painter.apply(asset, [Edit(picture, camera)])
edited.splats, edited.receipt
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.extras import require
from splatpainter.nn.precision import Arithmetic, Precision, autocast, resolve, setting
from splatpainter.receipts import Receipt, StageClock, ViewScore, scores, untouched_hashes
from splatpainter.splats import Splats, changed_rows

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.lift.global_edit import Predict
    from splatpainter.lift.options import GlobalOptions, LocalOptions
    from splatpainter.lift.side_views import SideViewScore
    from splatpainter.models.encode import Encoded
    from splatpainter.models.model import SplatPainterModel
    from splatpainter.models.refine import RefineState
    from splatpainter.rendering.partial import PartialRender
    from splatpainter.spread.options import SpreadOptions
    from splatpainter.surface.estimate import Surface
    from splatpainter.voxels.grid import VoxelGrid

Mode = Literal["local", "global", "spread"]
Method = Literal["auto", "ttt", "lift", "fit"]
LayerMethod = Literal["auto", "ttt", "lift", "fit", "predictor"]
"""What is asked of a layer, or, once it was made, what made it, as receipts have it."""
MAX_VIEWS = 16
LOW_ASIDE_DB = 20.0
"""Paint that scores less from the side is said to; sound paint on 24 held-out meshes has 29 on average."""
PREDICTOR = "predictor"
"""What receipts call global edits that networks make without test-time training."""
NOT_LOCAL = "Stage II of these weights is for global edits only: the analytic lift"
"""Why a local edit is the lift's, whatever was asked for (ModelConfig.edits_locally)."""
MIN_ASIDE_COVERED = 0.25
"""Share of the paint that side views must be able to check for that."""


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

    def relative_to(self, offset: tuple[float, float, float]) -> Edit:
        """This edit with its camera relative to the offset of an asset (Splats.offset)."""
        camera = self.camera.within(offset)
        return self if camera is self.camera else replace(self, camera=camera)


@dataclass(frozen=True)
class Asset:
    """An asset that can be edited: its Gaussians, and what a painter keeps beside them. Immutable; edits return new
    ones, and to undo one is to go on from the old."""

    splats: Splats
    receipt: Receipt | None = None
    """Receipt of the edit that made this asset; None for an unedited one."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N] float32 0..1 after a global edit: seen (1) or predicted (towards 0); after one of mode spread: how sure it is
    that a Gaussian is of the painted material."""
    encoding: EncodedAsset | None = field(default=None, repr=False)
    """Encoding for a model's edits; None where none has needed it yet."""
    original: Splats | None = field(default=None, repr=False)
    """The first Gaussians of `splats` as they were before all edits, on whose surface sheets are laid; None: `splats`,
    which has not been edited yet."""
    make_grid: Callable[[Splats], VoxelGrid] | None = field(default=None, repr=False, compare=False)
    """Where voxels of Gaussians come from; None: they are made (`voxelize`)."""

    @cached_property
    def grid(self) -> VoxelGrid:
        """The 128^3 voxels of the Gaussians, made on first use."""
        from splatpainter.voxels.grid import voxelize

        return voxelize(self.splats) if self.make_grid is None else self.make_grid(self.splats)

    @cached_property
    def surface(self) -> Surface:
        """Surface of the original; made on first use, and handed on by edits."""
        from splatpainter.surface.estimate import Surface

        return Surface.of(self.splats if self.original is None else self.original)

    @cached_property
    def normals(self) -> np.ndarray:
        """[N, 3] float32 outward unit normals, made on first use; zeros for Gaussians that cannot be drawn."""
        from splatpainter.lift.depth_normals import outward_normals

        return outward_normals(self.splats)

    @cached_property
    def transfer(self) -> np.ndarray:
        """[N, 10] float32 the light that reaches the rows (`lighting.prt_transfer`), made on first use."""
        from splatpainter.lighting import prt_transfer

        return prt_transfer(self.splats.means, self.normals)

    def child(self, splats: Splats, parents: np.ndarray) -> Asset:
        """This asset with other Gaussians. parents: [len(splats)] int64 the Gaussian of this one that each is or was
        split from."""
        encoding = self.encoding
        encoding = None if encoding is None else replace(encoding, parent_ids=encoding.parent_ids[parents])
        original = self.splats if self.original is None else self.original
        result = replace(self, splats=splats, encoding=encoding, original=original)
        return result.with_surface_of(self)

    def with_surface_of(self, other: Asset) -> Asset:
        """This asset; it has the other's surface (of the same original) where that is known already."""
        if "surface" in vars(other):
            vars(self)["surface"] = other.surface
        return self


@dataclass(frozen=True)
class EncodedAsset:
    """An asset encoded for a model, and what the edits since have taught that model."""

    model: SplatPainterModel
    """Another one encodes the asset anew."""
    encoded: Encoded
    """Encoding of the asset as it was before all edits."""
    parent_ids: np.ndarray
    """[N] int64 the encoded Gaussian whose latent each of the asset's reads: itself, or the one it was split from."""
    state: RefineState | None = None
    """Fast weights, which the next edit starts from; None before the first."""


@dataclass(frozen=True)
class Painter:
    """A method with its settings."""

    preset: str = ""
    """What receipts call it; by default the model's preset, or "lift"."""
    local_options: LocalOptions | None = None
    """Settings of local lifts; None: the defaults."""
    global_options: GlobalOptions | None = None
    """Settings of global lifts; None: the defaults."""
    spread_options: SpreadOptions | None = None
    """How far edits of mode spread reach; None: the defaults."""
    model: SplatPainterModel | None = field(default=None, repr=False)
    """The networks for method "ttt", on any device; None: the lift alone."""
    polish: bool = False
    """Two rounds of the lift's colours after the networks, on the Gaussians that the edit may change."""
    cache: bool = False
    """Keep encoded assets on disk (models/cache.py); for models whose weights stay as they are."""
    aside: bool = False
    """Score local edits from the side too (lift/side_views.py), for the receipt: 0.3 s of one core a view."""
    proof: bool = True
    """Hash the asset and what an edit left alone for the receipt; False: it has empty hashes."""
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
        """The painter of a preset: "lift", "compact", "rows", "paper", or a folder of weights; "auto" is "compact"
        where its weights are there, else "lift". Its weights are read when an edit first needs them: with method "ttt",
        or "auto" where they beat the lift (`choose`) in one of the modes that will be asked for. polish, cache,
        precision: as the fields.

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
                why = f"made by the analytic lift: the network of preset 'compact' measured no better{where}"
            return Painter(model=model, polish=polish, cache=cache, why=why, precision=precision)
        if preset == "lift":
            return Painter(why=why, precision=precision)
        return Painter(model=weights.load(preset), polish=polish, cache=cache, precision=precision)

    def encode(self, splats: Splats, method: Method = "auto", modes: Sequence[Mode] = ("local", "global")) -> Asset:
        """Prepare an asset for edits by `method` in these modes: for "ttt", run the LRM and Stage I where they are
        needed (`encodes`). In `copy` representation its Gaussians are then Stage I's. Raises ValueError when it has
        no Gaussian that can be drawn."""
        asset = Asset(splats.numpy())
        if not asset.splats.drawable.any():
            raise ValueError(
                f"asset: none of the {len(splats)} Gaussians can be drawn (NaN, zero scale or zero quaternion)"
            )
        needed = any(self.encodes(self.choose(method, mode)[0], mode) for mode in modes)
        if needed:
            require("torch", f"edit: the network of preset '{self.preset}'")
        return self._encoded(asset) if needed else asset

    def encodes(self, method: Method, mode: Mode) -> bool:
        """Whether edits by this method, not "auto", are made on an encoded asset."""
        if method != "ttt" or self.model is None:
            return False
        config = self.model.config
        return config.edits_locally if mode == "local" else not config.predictor_only

    def apply(self, asset: Asset, edits: Sequence[Edit], mode: Mode = "local", method: Method = "auto") -> Asset:
        """The asset after 1..16 edits; `asset` itself does not change. Later edits win where edits conflict.

        mode "local": only Gaussians that visibly make the edited pixels change, finer ones are appended.
        mode "global": every Gaussian changes; what the views do not show is predicted from what they do.
        mode "spread": as "local", and the change of colour goes on over the rest of the painted material, as far as
        `spread_options` says (spread/spread.py); by the lift alone.
        method "ttt": the networks (pictures of one size); "lift": analytic; "fit": the lift, then steps of 3DGS on the
        Gaussians that it painted, seconds to tens of them; "auto": ttt where the painter has a model that is better in
        this mode, else lift. An asset that its model has not encoded yet is encoded first.
        Gaussians that did not have to change keep their bits, and all old ones their indices.
        Raises ValueError: no edits, an empty mask, an edit that reaches no Gaussian, a camera inside the object."""
        if not 1 <= len(edits) <= MAX_VIEWS:
            raise ValueError(f"edit: expected 1 to {MAX_VIEWS} edited views, got {len(edits)}")
        if mode not in get_args(Mode):
            raise ValueError(f"edit: expected mode {', '.join(get_args(Mode))}, got {mode!r}")
        edits = [edit.relative_to(asset.splats.offset) for edit in edits]
        chosen, note = self.choose(method, mode)
        if mode == "global" and chosen == "fit":
            raise ValueError("edit: method 'fit' is for local edits; use 'lift' with mode 'global'")
        clock, encodes = StageClock(), self.encodes(chosen, mode)
        if encodes:
            _one_size(edits)
            asset = self._encoded(asset)
            clock.record_time("encode")
        partly = mode == "local" and chosen == "lift"
        views = _changed_together([_prepare(asset, edit, mode, partly) for edit in edits], edits)
        clock.record_time("prepare")
        lifted = self._lifted(asset, views, mode, chosen)
        clock.record_time("lift")
        if encodes and not self._carried(chosen, mode):
            result = self._refined(asset, lifted, views)
            clock.record_time("ttt")
        else:
            result = asset.child(lifted.splats, lifted.parent_ids(len(asset.splats)))
            result = replace(result, confidence=lifted.confidence)
        if chosen == "fit":
            result = replace(result, splats=self._optimised(asset.splats, lifted, views))
            clock.record_time("fit")
        if chosen == "ttt" and self.polish:
            recolored = self._recolored(asset.splats, result.splats, lifted, views, mode)
            result = replace(result, splats=recolored)
            clock.record_time("polish")
        receipt = self._receipt(asset, result, lifted, views, mode, chosen, note)
        clock.record_time("receipt")
        return replace(result, receipt=replace(receipt, seconds=clock.seconds)).with_surface_of(asset)

    def _receipt(
        self,
        asset: Asset,
        result: Asset,
        lifted: LiftedEdit,
        views: Sequence[EditView],
        mode: Mode,
        chosen: Method,
        note: str,
    ) -> Receipt:
        notes = [note, _beside(views) if mode != "global" else "", _beyond_limits(views, lifted.limited), lifted.note]
        if chosen == "ttt":
            assert self.model is not None
            notes.append("polished: two rounds of the lift after the network, where they help" if self.polish else "")
            if self.model.config.representation == "copy":
                notes.append(f"the asset is a copy of {len(asset.splats)} Gaussians that the model made")
        # Those that a lift may have changed it names; a proof does not believe it.
        ran = self._ran(chosen, mode)
        by_lift = not self.proof and chosen == "lift" and mode == "local"
        among = lifted.ids[: np.searchsorted(lifted.ids, len(asset.splats))] if by_lift else None
        touched = changed_rows(asset.splats, result.splats, among)
        hashes = untouched_hashes(asset.splats, result.splats, touched) if self.proof else ("", "")
        aside = self._aside(asset, result, views) if self.aside and mode != "global" else ()
        notes.append(_seen_aside(aside))
        judged = _judged(asset, result, views, touched)
        return Receipt(
            asset_sha256=asset.splats.sha256 if self.proof else "",
            asset_rows=len(asset.splats),
            output_sha256="",
            output_rows=len(result.splats),
            mode=mode,
            method=ran,
            preset="lift" if ran in ("lift", "fit") else self.preset,
            touched=touched,
            replaced=lifted.replaced[np.isin(lifted.replaced, touched, assume_unique=True)],
            removed=lifted.removed,
            aside=tuple((score.psnr, score.covered) for score in aside),
            limited_px=tuple(round(value, 1) for value in lifted.limited),
            appended_rows=len(result.splats) - len(asset.splats),
            untouched_sha256_before=hashes[0],
            untouched_sha256_after=hashes[1],
            views=judged,
            seconds={},
            note="; ".join(filter(None, notes)),
            precision=self._arithmetic(chosen, mode),
        )

    def _ran(self, chosen: Method, mode: Mode) -> str:
        """What receipts say made the edit: a method, or of networks that need no test-time training "predictor", or
        "lift" while that is untrained."""
        if chosen != "ttt" or self.encodes(chosen, mode) or self.model is None:
            return chosen
        predictor = self.model.stored_predictor
        return "lift" if predictor is None or predictor.is_untrained else PREDICTOR

    def _aside(self, asset: Asset, result: Asset, views: Sequence[EditView]) -> list[SideViewScore]:
        """Each view's edit from the side; of several the later ones change what the earlier ones show."""
        from splatpainter.lift.side_views import side_view_score

        return [side_view_score(asset.splats, result.splats, view) for view in views]

    def _arithmetic(self, chosen: Method, mode: Mode) -> Arithmetic | Literal[""]:
        """The arithmetic of the networks in an edit; "" where none runs."""
        if chosen != "ttt" or self.model is None:
            return ""
        if self.encodes(chosen, mode):
            return resolve(self.precision, next(self.model.parameters()).device)
        predictor = self.model.stored_predictor
        if predictor is None or predictor.is_untrained:
            return ""
        return "float32"  # it solves for its weights, which are never rounded

    def choose(self, method: Method, mode: Mode) -> tuple[Method, str]:
        """What `apply` does for a method: (method, never "auto", and the one line that says why). Weights whose notes
        hold `gain`, {mode: dB over the lift on objects kept out of training}, are used by "auto" only where that is
        above 0; a Stage II that has learnt global edits alone makes no local ones. Raises ValueError for a method that
        is not known, or needs a model that is not there."""
        if method == "ttt" and self.model is None:
            raise ValueError(
                "method 'ttt' needs a preset with trained weights; use method 'lift' or 'auto' without them"
            )
        if mode == "spread":
            if method not in ("auto", "lift"):
                raise ValueError(f"method: mode spread is made by the lift alone, got {method!r}")
            return "lift", "mode spread: the analytic lift"
        networks = method == "ttt" or (method == "auto" and not self.why)
        if mode == "local" and networks and self.model is not None and not self.model.config.edits_locally:
            return "lift", NOT_LOCAL
        if method == "auto":
            if self.model is not None and not self.why:
                gain = self.model.notes.get("gain", {}).get(mode)
                networks = "test-time training" if self.encodes("ttt", mode) else "the predictor"
                if gain is None:
                    return "ttt", f"weights of preset '{self.preset}': {networks}"
                measured = f"{gain:+.2f} dB over the lift in {mode} edits of objects kept out of training"
                why = f"weights of preset '{self.preset}' ({measured})"
                return ("ttt", f"{why}: {networks}") if gain > 0 else ("lift", f"{why}: the analytic lift")
            return "lift", self.why or "no trained weights: the analytic lift"
        if method not in ("ttt", "lift", "fit"):
            raise ValueError(f"method: expected auto, ttt, lift or fit, got {method!r}")
        return method, ""

    def _encoded(self, asset: Asset) -> Asset:
        """The asset with its encoding for the model; the same one where it has that already."""
        model = self.model
        assert model is not None
        if asset.encoding is not None and asset.encoding.model is model:
            return asset
        from splatpainter.models.cache import encode_cached, encode_half

        with _inference(model, self.precision):
            if self.cache:
                encoded = encode_cached(model, asset.splats, asset.grid, weights=self._digest)
            else:
                encoded = encode_half(model, asset.splats, asset.grid)
        if model.config.representation == "copy":
            asset = Asset(encoded.gaussians.numpy())
        return replace(asset, encoding=EncodedAsset(model, encoded, np.arange(len(asset.splats))))

    @cached_property
    def _digest(self) -> str:
        from splatpainter.models.cache import digest

        assert self.model is not None
        return digest(self.model)

    def _lifted(self, asset: Asset, views: Sequence[EditView], mode: Mode, chosen: Method) -> LiftedEdit:
        """What the lift makes of the views; or, for the networks, what they start from."""
        from splatpainter.lift.edits import lift_global_views, lift_local_views
        from splatpainter.lift.options import GLOBAL_DEFAULTS, LOCAL_DEFAULTS

        if mode == "spread":
            return self._spread(asset, views)
        config = self.model.config.refine if chosen == "ttt" and self.model is not None else None
        base, features = ("lift", False) if config is None else (config.base, config.lift_features)
        if mode == "local":
            options = self.local_options or LOCAL_DEFAULTS
            # Networks have learnt on split Gaussians.
            surface = asset.surface if config is None else None
            originals = len(asset.splats if asset.original is None else asset.original)
            return lift_local_views(
                asset.splats,
                None if surface is not None and options.resurface and len(views) == 1 else asset.grid,
                views,
                base,
                options,
                features=features,
                surface=surface,
                originals=originals,
            )
        return lift_global_views(
            asset.splats,
            views,
            base if self.encodes(chosen, mode) and not self._carried(chosen, mode) else "lift",
            self.global_options or GLOBAL_DEFAULTS,
            features=features,
            normals=asset.normals,
            predict=None if config is None else self._predict(asset),
        )

    def _spread(self, asset: Asset, views: Sequence[EditView]) -> LiftedEdit:
        """The painted material in its new colour all around, and the local lift on that."""
        from splatpainter.rendering import render
        from splatpainter.spread.spread import SPREAD_DEFAULTS, spread

        result = spread(asset.splats, views, self.spread_options or SPREAD_DEFAULTS)
        # Places have not changed.
        below = replace(
            asset, splats=result.splats, original=asset.original or asset.splats, make_grid=lambda _: asset.grid
        )
        vars(below)["surface"] = asset.surface
        again = [replace(view, before=render(result.splats, view.camera).colors[0]) for view in views]
        return result.with_lift(self._lifted(below, again, "local", "lift"))

    def _predict(self, asset: Asset) -> Predict | None:
        """The model's prediction for Gaussians that no view shows; None where it leaves that to the lift."""
        from splatpainter.models.stored_predictor import predicting

        model = self.model
        assert model is not None
        if model.config.carries:
            return self._carrying(asset)
        return predicting(model.stored_predictor, asset.splats, asset.normals, lambda: asset.transfer)

    def _carried(self, chosen: Method, mode: Mode) -> bool:
        """Whether Stage II makes a global edit by what it says of Gaussians that no view shows, within the lift."""
        return chosen == "ttt" and mode == "global" and self.model is not None and self.model.config.carries

    def _carrying(self, asset: Asset) -> Predict:
        """Stage II's prediction; the asset is encoded."""
        from splatpainter.models.edit_propagation import carrying

        model, encoding = self.model, asset.encoding
        assert model is not None and encoding is not None
        latents, ids = encoding.encoded.latents, encoding.encoded.latent_ids[encoding.parent_ids]
        with _inference(model, self.precision):
            predict = carrying(model, latents, ids, asset.splats, asset.normals, lambda: asset.transfer)

        def answer(change: np.ndarray, weight: np.ndarray) -> np.ndarray:
            with _inference(model, self.precision):
                return predict(change, weight)

        return answer

    def _facts(self, asset: Asset, ids: np.ndarray) -> np.ndarray | None:
        """[J, 21] of `gaussian_facts` of these Gaussians, for a Stage II that reads them."""
        from splatpainter.models.gaussian_facts import gaussian_facts

        if self.model is None or not self.model.config.refine.facts:
            return None
        return gaussian_facts(asset.splats, asset.normals, asset.transfer)[ids]

    def _refined(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView]) -> Asset:
        """The asset after the networks have changed a lifted edit of it."""
        from splatpainter.models.apply_edit import assemble, refine_edit

        assert self.model is not None and asset.encoding is not None
        encoding = asset.encoding
        start = replace(lifted, parents=encoding.parent_ids[lifted.parents])
        with _inference(self.model, self.precision):
            state = encoding.state or self.model.initial_state()
            facts = self._facts(asset, lifted.parents)
            state, gaussians, children = refine_edit(self.model, state, encoding.encoded, start, views, facts)
            splats = assemble(lifted, gaussians, children)
        parents = lifted.parent_ids(len(asset.splats))
        parents = parents if children is None else np.append(parents, lifted.parents)
        after = replace(asset.child(splats, parents), confidence=lifted.confidence)
        assert after.encoding is not None
        return replace(after, encoding=replace(after.encoding, state=state))

    def _optimised(self, before: Splats, lifted: LiftedEdit, views: Sequence[EditView]) -> Splats:
        from splatpainter.fit.edited import fit_edited

        return fit_edited(before, lifted.splats, [(v.camera, v.target) for v in views], lifted.ids)

    def _recolored(
        self, before: Splats, after: Splats, lifted: LiftedEdit, views: Sequence[EditView], mode: Mode
    ) -> Splats:
        """Two rounds of the lift's colours on the Gaussians that the edit may change; `after`, where these bring the
        pictures no nearer."""
        from splatpainter.lift.colors import refine_colors_global, refine_colors_local

        if mode == "global":
            recolored = refine_colors_global(after, [(v.camera, v.edited, v.mask) for v in views])
        else:
            editable = np.ones(len(after), bool)
            editable[: len(before)] = False
            editable[lifted.ids] = True
            recolored = refine_colors_local(after, [(v.camera, v.target) for v in views], editable)
        return recolored if _squared_error(recolored, views) < _squared_error(after, views) else after


def _squared_error(splats: Splats, views: Sequence[EditView]) -> float:
    """Sum over the edited pixels of all views."""
    from splatpainter.rendering import render

    errors = (np.clip(render(splats, v.camera).colors[0], 0, 1)[v.mask] - v.edited[v.mask] for v in views)
    return sum(float(np.square(error).sum(dtype=np.float64)) for error in errors)


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
        if training:
            model.train()


def _one_size(edits: Sequence[Edit]) -> None:
    from splatpainter.models.image_tokens import one_size

    one_size([edit.camera for edit in edits])


def _prepare(asset: Asset, edit: Edit, mode: Mode, partly: bool) -> EditView:
    """The edit beside what the asset shows; partly: under the edit's mask, where it has one, that is enough. Raises
    ValueError, naming the edit, where there is nothing to do."""
    from splatpainter.lift.edit_views import EditView, errors_name
    from splatpainter.lift.masks import dilated, edited_mask
    from splatpainter.lift.sheets.resurface import RING_PX
    from splatpainter.rendering.cpu.projected_view import tiles_of_mask
    from splatpainter.rendering.cpu.recent_views import recent_view
    from splatpainter.rendering.partial import PartialRender
    from splatpainter.voxels.raycast import is_inside

    with errors_name(edit.name):
        if is_inside(asset.splats, lambda: asset.grid, edit.camera.position):
            raise ValueError("edit: the camera is inside the object; step back until the surface is in view")
        mask = edit.mask
        tiles = beside = view = None
        if partly and mask is not None and mask.any():
            tiles, beside = tiles_of_mask(mask), tiles_of_mask(dilated(mask, RING_PX))
            view = recent_view(asset.splats, edit.camera)
        drawn = PartialRender.of(asset.splats, edit.camera, tiles, beside, view)
        if mask is None:
            mask = drawn.alphas > 0.5 if mode == "global" else edited_mask(edit.image, drawn.colors, drawn.alphas)
        if not mask.any():
            unchanged = (
                "the asset is not in view" if mode == "global" else "the picture does not differ from the render"
            )
            what = unchanged if edit.mask is None else "the mask is empty"
            raise ValueError(f"edit: nothing to do, {what}")
    return EditView(
        edit.camera, edit.image, mask, drawn.colors, drawn.depths, drawn.alphas, edit.name, drawn.tiles, drawn.view
    )


def _judged(asset: Asset, result: Asset, views: Sequence[EditView], touched: np.ndarray) -> tuple[ViewScore, ...]:
    """Each view's score; what the other pictures painted is not outside. touched: [T] Gaussians that changed."""
    from splatpainter.lift.shared_paint import paint_of_other_views

    pairs = [_before_and_after(asset, result, view, touched) for view in views]
    shared = paint_of_other_views(views, [before.depths for before, _ in pairs])
    images = zip(views, pairs, shared, strict=True)
    return scores([(b.colors, a.colors, v.edited, v.mask | other, _scored(v)) for v, (b, a), other in images])


def _before_and_after(
    asset: Asset, result: Asset, view: EditView, touched: np.ndarray
) -> tuple[PartialRender, PartialRender]:
    """Two renders of a view, equal where the edit changed nothing. touched: [T] Gaussians that it changed."""
    from splatpainter.rendering.partial import PartialRender

    assert view.alpha is not None and view.depth is not None and view.tiles is not None
    pictures = (view.before, view.alpha, view.depth)
    drawn = PartialRender(asset.splats, view.camera, view.tiles, *pictures, view.projected)
    return drawn.after(result.splats, touched)


def _changed_together(views: list[EditView], edits: Sequence[Edit]) -> list[EditView]:
    """Where one picture without a mask changed throughout, others of the edit that changed at most pixels did too."""
    from splatpainter.lift.masks import MIN_MEDIAN_CHANGE, median_change

    free = [edit.mask is None and view.alpha is not None for view, edit in zip(views, edits, strict=True)]
    if not any(view.mask.all() for view, unmasked in zip(views, free, strict=True) if unmasked):
        return views
    return [
        replace(view, mask=np.ones(view.mask.shape, bool))
        if unmasked and median_change(view.edited, view.before, np.asarray(view.alpha)) > MIN_MEDIAN_CHANGE
        else view
        for view, unmasked in zip(views, free, strict=True)
    ]


def _scored(view: EditView) -> np.ndarray:
    """[H, W] bool: edited pixels that the asset covers at all."""
    assert view.alpha is not None
    return view.mask & (view.alpha > 0.5)


def _beside(views: Sequence[EditView]) -> str:
    """A line about edited pixels that no Gaussian can paint, or none."""
    views = [view for view in views if not view.mask.all()]
    edited = sum(int(view.mask.sum()) for view in views)
    beside = edited - sum(int(_scored(view).sum()) for view in views)
    return f"{beside} edited pixels lie beside the asset and cannot be painted" if beside > 0.01 * edited else ""


def _seen_aside(scores: Sequence[SideViewScore]) -> str:
    """A line about views whose paint looks wrong from the side, or none."""
    low = [
        (k, score.psnr)
        for k, score in enumerate(scores)
        if score.psnr is not None and score.covered > MIN_ASIDE_COVERED and score.psnr < LOW_ASIDE_DB
    ]
    if not low:
        return ""
    which = ", ".join(f"view {k + 1}: {psnr:.1f} dB" for k, psnr in low)
    return f"seen 35 degrees from the side the paint differs from the picture ({which}): look at it from other views"


def _beyond_limits(views: Sequence[EditView], limited: Sequence[float]) -> str:
    """A line about paint that the views' limits left out, or none."""
    edited, left_out = sum(int(view.mask.sum()) for view in views), sum(limited)
    if left_out <= 0.01 * edited:
        return ""
    return (
        f"{left_out:.0f} edited pixels' worth of paint lies beyond the angle or depth-edge limit of its view and was "
        "left out: paint it from the front"
    )
