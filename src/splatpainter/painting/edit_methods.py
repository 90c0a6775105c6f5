"""The ways in which an edit is made, one class each: what it starts from, what it makes of that, what receipts say.

All of them start from the analytic lift. `method_for` is the only place that knows which mode, method and networks make
which class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from splatpainter.nn.precision import Arithmetic
from splatpainter.painting.asset import Asset
from splatpainter.painting.edit_settings import EditSettings
from splatpainter.painting.edited_picture import Edit, Method, Mode
from splatpainter.painting.networks import Networks, inference
from splatpainter.receipts import StageClock
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.lift.global_edit import Predict
    from splatpainter.lift.options import ResidualBase
    from splatpainter.models.local_network import LocalNetwork

PREDICTOR = "predictor"
"""What receipts call global edits that networks make without test-time training."""


@dataclass(frozen=True)
class EditMethod:
    """The analytic lift, local or global; others are made of it."""

    mode: Mode
    settings: EditSettings
    encodes: ClassVar[bool] = False
    """Whether it works on an encoded asset."""

    @property
    def ran(self) -> str:
        """What receipts say made the edit."""
        return "lift"

    @property
    def names_its_gaussians(self) -> bool:
        """Whether nothing changes but the Gaussians that the lift names, all of them near the edits' masks."""
        return self.mode == "local"

    @property
    def arithmetic(self) -> Arithmetic | Literal[""]:
        """The arithmetic of the networks; "" where none runs."""
        return ""

    def notes(self, asset: Asset) -> list[str]:
        """Lines for the receipt."""
        return []

    def start(self, asset: Asset, edits: Sequence[Edit]) -> Asset:
        """The asset as this method needs it. Raises ValueError for edits that it cannot be made with."""
        return asset

    def preset(self, painter: str) -> str:
        """The weights that receipts name. painter: the painter's preset."""
        return "lift" if self.ran in ("lift", "corrected", "fit") else painter

    def made(self, lifted: LiftedEdit) -> str:
        """What receipts call it, of this edit."""
        return self.ran

    def make(self, asset: Asset, views: Sequence[EditView], clock: StageClock) -> tuple[LiftedEdit, Asset]:
        """(what the lift made of the views, the edited asset without a receipt)."""
        lifted = self.lift(asset, views)
        clock.record_time("lift")
        return lifted, self.finish(asset, lifted, views, clock)

    def lift(self, asset: Asset, views: Sequence[EditView]) -> LiftedEdit:
        """What the lift makes of the views; or, for networks, what they start from."""
        if self.mode == "local":
            return lift_locally(asset, views, self.settings)
        return lift_globally(asset, views, self.settings, self.predict(asset))

    def finish(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        """The edited asset, from what the lift made."""
        result = asset.child(lifted.splats, lifted.parent_ids(len(asset.splats)))
        return replace(result, confidence=lifted.confidence)

    def predict(self, asset: Asset) -> Predict | None:
        """Who answers for Gaussians that no view of a global edit shows; None: the lift."""
        return None


@dataclass(frozen=True)
class CorrectedMethod(EditMethod):
    """The lift, in colours that a small network corrects for views from beside (lift/local/correction.py)."""

    @property
    def ran(self) -> str:
        return "corrected"

    def made(self, lifted: LiftedEdit) -> str:
        return self.ran if lifted.corrected else "lift"

    def lift(self, asset: Asset, views: Sequence[EditView]) -> LiftedEdit:
        from splatpainter.lift.options import LOCAL_DEFAULTS

        options = replace(self.settings.local_options or LOCAL_DEFAULTS, correct=True)
        return lift_locally(asset, views, replace(self.settings, local_options=options))


@dataclass(frozen=True)
class FitMethod(EditMethod):
    """The lift, then steps of 3DGS on the Gaussians that it painted."""

    @property
    def ran(self) -> str:
        return "fit"

    @property
    def names_its_gaussians(self) -> bool:
        return False

    def finish(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        from splatpainter.fit.edited import fit_edited

        result = super().finish(asset, lifted, views, clock)
        # Fitted on top of the lift, whose Gaussians alone may move: the rest of the asset stays as it is.
        targets = [(view.camera, view.target) for view in views]
        result = replace(result, splats=fit_edited(asset.splats, lifted.splats, targets, lifted.ids))
        clock.record_time("fit")
        return result


@dataclass(frozen=True)
class SpreadMethod(EditMethod):
    """The painted material in its new colour all around, and the local lift on that."""

    def lift(self, asset: Asset, views: Sequence[EditView]) -> LiftedEdit:
        from splatpainter.rendering import render
        from splatpainter.spread.soft_edges import on_other_ground
        from splatpainter.spread.spread import SPREAD_DEFAULTS, spread

        result = spread(asset.splats, views, self.settings.spread_options or SPREAD_DEFAULTS)
        # Places have not changed, so surface and voxels are those of the asset.
        below = replace(
            asset, splats=result.splats, original=asset.original or asset.splats, make_grid=lambda _: asset.grid
        )
        vars(below)["surface"] = asset.surface
        # A view at hand holds the colours of the asset before; soft edges of its paint lie over those of now.
        pictures = [(view, render(result.splats, view.camera).colors[0]) for view in views]
        again = [on_other_ground(view, after, asset.splats.color_space) for view, after in pictures]
        return result.with_lift(lift_locally(below, again, self.settings))


@dataclass(frozen=True)
class PredictorMethod(EditMethod):
    """A global edit whose unseen Gaussians the predictor answers for; no test-time training."""

    networks: Networks

    @property
    def ran(self) -> str:
        return "lift" if self.networks.predictor_is_untrained else PREDICTOR

    @property
    def names_its_gaussians(self) -> bool:
        return False

    @property
    def arithmetic(self) -> Arithmetic | Literal[""]:
        # It solves for its weights, which are never rounded.
        return "" if self.networks.predictor_is_untrained else "float32"

    def notes(self, asset: Asset) -> list[str]:
        polished = "polished: two rounds of the lift after the network, where they help" if self.settings.polish else ""
        copies = self.networks.model.config.representation == "copy"
        return [polished, f"the asset is a copy of {len(asset.splats)} Gaussians that the model made" if copies else ""]

    def predict(self, asset: Asset) -> Predict | None:
        return self.networks.predict(asset)

    def finish(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        return self.polished(asset, self.network_result(asset, lifted, views, clock), lifted, views, clock)

    def polished(
        self, asset: Asset, result: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock
    ) -> Asset:
        """`result` after the rounds of the lift that the settings ask for."""
        if self.settings.polish:
            result = replace(result, splats=_recolored(asset.splats, result.splats, lifted, views, self.mode))
            clock.record_time("polish")
        return result

    def network_result(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        """What `finish` polishes."""
        return super().finish(asset, lifted, views, clock)


@dataclass(frozen=True)
class EncodingMethod(PredictorMethod):
    """Stage II, on an asset encoded for it: by LRM and Stage I, or, for a model without them, by its voxels."""

    encodes: ClassVar[bool] = True

    @property
    def ran(self) -> str:
        return "ttt"

    @property
    def arithmetic(self) -> Arithmetic | Literal[""]:
        return self.networks.arithmetic

    def start(self, asset: Asset, edits: Sequence[Edit]) -> Asset:
        from splatpainter.models.image_tokens import one_size

        # Asked before encoding, which is the slow part: an edit that cannot be made should fail at once.
        one_size([edit.camera for edit in edits])
        return self.networks.encode(asset)


@dataclass(frozen=True)
class CarryMethod(EncodingMethod):
    """A global edit that Stage II makes by what it says of Gaussians that no view shows, within the lift."""

    def make(self, asset: Asset, views: Sequence[EditView], clock: StageClock) -> tuple[LiftedEdit, Asset]:
        # The lift asks the network only for what no view shows, so Stage II has to be ready before it.
        turn = self.networks.in_turn(asset, views)
        carried = self.networks.carry(asset, turn.before)
        before = asset
        if turn.before is not asset.splats:
            before = replace(asset, splats=turn.before)
            vars(before)["normals"] = asset.normals  # colours alone differ
        with self.networks.inference():
            lifted = lift_globally(before, [*turn.earlier, *views], self.settings, carried)
        lifted = replace(lifted, note="; ".join(filter(None, (lifted.note, turn.note))))
        clock.record_time("lift")
        result = self.polished(asset, super().network_result(asset, lifted, views, clock), lifted, views, clock)
        if result.encoding is not None and carried.state is not None:  # what the next edit goes on from
            state = replace(carried.state, so_far=turn.after(result.splats, views))
            result = replace(result, encoding=replace(result.encoding, state=state))
        return lifted, result


@dataclass(frozen=True)
class RefineMethod(EncodingMethod):
    """Stage II and the decoder change what the lift made, local or global."""

    def lift(self, asset: Asset, views: Sequence[EditView]) -> LiftedEdit:
        config = self.networks.model.config.refine
        if self.mode == "local":
            # Networks have learnt on split Gaussians: no surface, no sheets.
            return lift_locally(asset, views, self.settings, config.base, config.lift_features, sheets=False)
        predict = self.predict(asset)
        return lift_globally(asset, views, self.settings, predict, config.base, config.lift_features)

    def network_result(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        result = self.networks.refine(asset, lifted, views)
        clock.record_time("ttt")
        return result


@dataclass(frozen=True)
class PicturesMethod(EditMethod):
    """The lift's Gaussians in the colours of the network that reads pictures, held against these."""

    network: LocalNetwork

    @property
    def ran(self) -> str:
        return "ttt"

    @property
    def names_its_gaussians(self) -> bool:
        return False

    @property
    def arithmetic(self) -> Arithmetic | Literal[""]:
        return "float32"

    def preset(self, painter: str) -> str:
        return "local"

    def finish(self, asset: Asset, lifted: LiftedEdit, views: Sequence[EditView], clock: StageClock) -> Asset:
        from splatpainter.models.local_edit_colors import repainted

        # Colours are replaced before the lift's result becomes an asset, so that parents and confidence are the lift's.
        # In float32 whatever the precision: bf16 would round away what its memory holds beside the markers of cells.
        with inference(self.network, "float32"):
            lifted = repainted(self.network, asset.splats, lifted, views, asset.originals)
        result = super().finish(asset, lifted, views, clock)
        clock.record_time("ttt")
        return result


def method_for(
    chosen: Method, mode: Mode, networks: Networks | None, local: LocalNetwork | None, settings: EditSettings
) -> EditMethod:
    """The class that makes an edit. chosen: not "auto" (Painter.choose); local: the network that reads pictures, for
    local edits where the others make none. Raises ValueError for a method that makes no edits of that mode."""
    # What needs no network comes first: these work for a painter that has none.
    if mode == "spread":
        return SpreadMethod(mode, settings)
    if chosen == "lift":
        return EditMethod(mode, settings)
    if chosen in ("corrected", "fit"):
        if mode == "global":
            raise ValueError(f"edit: method '{chosen}' is for local edits; use 'lift' with mode 'global'")
        return (CorrectedMethod if chosen == "corrected" else FitMethod)(mode, settings)
    # A painter's own networks go first where they have learnt local edits.
    if mode == "local" and local is not None and (networks is None or not networks.model.config.edits_locally):
        return PicturesMethod(mode, settings, local)
    assert networks is not None
    # Of networks, the least that the weights can do by themselves: a predictor needs no encoding, a carried edit no
    # decoder.
    config = networks.model.config
    if mode == "global" and config.predictor_only:
        return PredictorMethod(mode, settings, networks)
    if mode == "global" and config.carries:
        return CarryMethod(mode, settings, networks)
    return RefineMethod(mode, settings, networks)


def lift_locally(
    asset: Asset,
    views: Sequence[EditView],
    settings: EditSettings,
    base: ResidualBase = "lift",
    features: bool = False,
    sheets: bool = True,
) -> LiftedEdit:
    """The lift of local views. base, features: what a network starts from (RefineConfig); sheets: lay them on the
    asset's surface where that is sound."""
    from splatpainter.lift.edits import lift_local_views
    from splatpainter.lift.options import LOCAL_DEFAULTS

    options = settings.local_options or LOCAL_DEFAULTS
    surface = asset.surface if sheets else None
    # One view on a surface needs no voxels.
    grid = None if surface is not None and options.resurface and len(views) == 1 else asset.grid
    return lift_local_views(
        asset.splats, grid, views, base, options, features=features, surface=surface, originals=asset.originals
    )


def lift_globally(
    asset: Asset,
    views: Sequence[EditView],
    settings: EditSettings,
    predict: Predict | None = None,
    base: ResidualBase = "lift",
    features: bool = False,
) -> LiftedEdit:
    """The lift of global views. predict: who answers for Gaussians that none of them shows; None: a regression."""
    from splatpainter.lift.edits import lift_global_views
    from splatpainter.lift.options import GLOBAL_DEFAULTS

    options = settings.global_options or GLOBAL_DEFAULTS
    return lift_global_views(
        asset.splats, views, base, options, features=features, normals=asset.normals, predict=predict
    )


def _recolored(before: Splats, after: Splats, lifted: LiftedEdit, views: Sequence[EditView], mode: Mode) -> Splats:
    """Two rounds of the lift's colours on the Gaussians that the edit may change; `after`, where these bring the
    pictures no nearer."""
    from splatpainter.lift.colors import refine_colors_global, refine_colors_local

    if mode == "global":
        recolored = refine_colors_global(after, [(v.camera, v.edited, v.mask) for v in views])
    else:
        # Appended Gaussians are the edit's own; of the others only those that the lift named may change.
        editable = np.ones(len(after), bool)
        editable[: len(before)] = False
        editable[lifted.ids] = True
        recolored = refine_colors_local(after, [(v.camera, v.target) for v in views], editable)
    # Judged by the pictures themselves: polish may never make an edit worse than it was.
    return recolored if _squared_error(recolored, views) < _squared_error(after, views) else after


def _squared_error(splats: Splats, views: Sequence[EditView]) -> float:
    """Sum over the edited pixels of all views."""
    from splatpainter.kernels import portable
    from splatpainter.rendering import render

    errors = (np.clip(render(splats, v.camera).colors[0], 0, 1)[v.mask] - v.edited[v.mask] for v in views)
    return sum(float(portable.total(np.square(error), np.float64)) for error in errors)
