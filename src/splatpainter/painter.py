"""The painter: pure functions from (asset, edits) to asset. Knows no layers and no history.

painter = Painter.load()                      # trained weights where they beat the analytic lift, else that
asset = painter.encode(splats)                # once per asset
edited = painter.apply(asset, [Edit(picture, camera)])
edited.splats, edited.receipt
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, get_args

from splatpainter.extras import require
from splatpainter.nn.precision import Precision
from splatpainter.painting.asset import Asset as Asset
from splatpainter.painting.asset import EncodedAsset as EncodedAsset
from splatpainter.painting.edit_methods import PREDICTOR as PREDICTOR
from splatpainter.painting.edit_methods import method_for
from splatpainter.painting.edit_receipt import edit_receipt
from splatpainter.painting.edit_settings import EditSettings as EditSettings
from splatpainter.painting.edited_picture import MAX_VIEWS as MAX_VIEWS
from splatpainter.painting.edited_picture import Edit as Edit
from splatpainter.painting.edited_picture import LayerMethod as LayerMethod
from splatpainter.painting.edited_picture import Method as Method
from splatpainter.painting.edited_picture import Mode as Mode
from splatpainter.painting.latest_view import keep_view, latest_view
from splatpainter.painting.networks import Networks
from splatpainter.painting.prepared_views import prepared_views
from splatpainter.receipts import StageClock
from splatpainter.splats import Splats
from splatpainter.system.memory import keep_freed_arrays
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel

NOT_LOCAL = "Stage II of these weights is for global edits only: the analytic lift"
"""Why a local edit is the lift's, whatever was asked for (ModelConfig.edits_locally)."""
LIFT_ALONE = "preset 'lift': the analytic lift"
"""Why an edit by "auto" is the lift's, and is not corrected."""
DEFAULT_MODES: tuple[Mode, ...] = ("local", "global")
"""Modes that may be asked for where a caller does not say."""


@dataclass(frozen=True)
class Painter:
    """Networks, or none, with their settings."""

    model: SplatPainterModel | None = field(default=None, repr=False)
    """The networks for method "ttt", on any device; None: the lift alone."""
    local: LocalNetwork | None = field(default=None, repr=False)
    """The network that reads pictures, for local edits by "ttt" where `model` makes none; on the CPU."""
    settings: EditSettings = field(default_factory=EditSettings)
    """How it paints."""
    why: str | None = None
    """Where it is given, method "auto" is the lift, and receipts say this line."""

    @staticmethod
    def load(
        preset: str = "auto",
        *,
        modes: Sequence[Mode] = DEFAULT_MODES,
        polish: bool = False,
        cache: bool = True,
        precision: Precision = "auto",
    ) -> Painter:
        """The painter of a preset: "lift", "compact", "rows", "paper", "local", or a folder of weights; "auto" is
        "compact" where its weights are there, else "lift". Weights are read when an edit first needs them: with method
        "ttt", or "auto" where they beat the lift (`choose`) in one of the modes that will be asked for. polish, cache,
        precision: as of EditSettings.

        Raises ValueError for a preset that is not known, or has no weights or wrong ones, and for a precision that is
        not known, here or in SPLATPAINTER_PRECISION."""
        # Only here: whoever makes a painter without networks does not import their code.
        from splatpainter.models import weights

        settings = EditSettings(polish=polish, cache=cache, precision=precision)
        alone = EditSettings(precision=precision)
        # The gain was measured and lies beside the weights, so they need not be read to know whether they are of use.
        if preset == "auto":
            model = weights.deferred("compact")
            if model is None:
                return Painter(settings=alone, why="no trained weights: the analytic lift")
            gain, why = model.notes.get("gain", {}), None
            if gain and max((gain[mode] for mode in modes if mode in gain), default=1.0) <= 0:
                # Reading and running them would be for nothing, unless method "ttt" asks for it.
                where = "" if set(modes) >= set(gain) else f" in {' and '.join(modes)} edits"
                why = f"made by the analytic lift: the network of preset 'compact' measured no better{where}"
            return Painter(model, weights.deferred_local(), settings, why=why)
        if preset == "lift":
            return Painter(settings=alone, why=LIFT_ALONE)
        return Painter(*weights.load_all(preset), settings)

    @property
    def preset(self) -> str:
        """What receipts call it: the preset of its networks, or "lift"."""
        network = self.model or self.local
        return "lift" if network is None else network.config.preset

    def encode(self, splats: Splats[Any], method: Method = "auto", modes: Sequence[Mode] = DEFAULT_MODES) -> Asset:
        """Prepare an asset for edits by `method` in these modes: for "ttt", run the LRM and Stage I where they are
        needed (`encodes`). In `copy` representation its Gaussians are then Stage I's. Raises ValueError when it has
        no Gaussian that can be drawn."""
        # Refused before anything is computed, as every way to edit would fail on it later.
        asset = Asset(splats.numpy())
        if not asset.splats.drawable.any():
            raise ValueError(
                f"asset: none of the {len(splats)} Gaussians can be drawn (NaN, zero scale or zero quaternion)"
            )
        if not any(self.encodes(self.choose(method, mode)[0], mode) for mode in modes):
            return asset
        require("torch", f"edit: the network of preset '{self.preset}'")
        assert self._networks is not None
        return self._networks.encode(asset)

    def with_settings(self, **changes: Any) -> Painter:
        """This painter with some fields of its settings changed."""
        return replace(self, settings=replace(self.settings, **changes))

    def encodes(self, method: Method, mode: Mode) -> bool:
        """Whether edits by this method, not "auto", are made on an encoded asset."""
        if method != "ttt" or self.model is None:
            return False
        config = self.model.config
        return config.edits_locally if mode == "local" else not config.predictor_only

    def reads_pictures(self, mode: Mode) -> bool:
        """Whether edits by "ttt" are the local network's. Two networks can make a local edit: the one that reads
        pictures is taken where the other never learnt to."""
        if mode != "local" or self.local is None:
            return False
        return self.model is None or not self.model.config.edits_locally

    def apply(self, asset: Asset, edits: Sequence[Edit], mode: Mode = "local", method: Method = "auto") -> Asset:
        """The asset after 1..16 edits; `asset` itself does not change. Later edits win where edits conflict.

        mode "local": only Gaussians that visibly make the edited pixels change, finer ones are appended.
        mode "global": every Gaussian changes; what the views do not show is predicted from what they do.
        mode "spread": as "local", and the change of colour goes on over the rest of the painted material, as far as
        `spread_options` says (spread/spread.py); by the lift alone.
        method "ttt": the networks (pictures of one size); "lift": analytic; "fit": the lift, then steps of 3DGS on the
        Gaussians that it painted, seconds to tens of them; "corrected": the lift, in colours that a small network
        corrects for views from beside where one view's paint lies on a part of the asset; "auto": ttt where the painter
        has a model that is better in this mode, else corrected in mode "local" and lift in others. An asset that its
        model has not encoded yet is encoded first.
        Gaussians that did not have to change keep their bits, and all old ones their indices.
        Raises ValueError: no edits, an empty mask, an edit that reaches no Gaussian, a camera inside the object."""
        if not 1 <= len(edits) <= MAX_VIEWS:
            raise ValueError(f"edit: expected 1 to {MAX_VIEWS} edited views, got {len(edits)}")
        if mode not in get_args(Mode):
            raise ValueError(f"edit: expected mode {', '.join(get_args(Mode))}, got {mode!r}")

        keep_freed_arrays()
        # Who makes it, and on what.
        chosen, note = self.choose(method, mode)
        how = method_for(chosen, mode, self._networks, self.local, self.settings)
        edits = [edit.relative_to(asset.splats.offset) for edit in edits]
        clock = StageClock()
        asset = how.start(asset, edits)
        if how.encodes:
            clock.record_time("encode")

        # Where pictures and asset differ decides what may change. Held until the edit is made: what is at hand of it.
        at_hand = latest_view(asset, edits[0].camera)
        views = prepared_views(asset, edits, mode, partly=how.names_its_gaussians)
        clock.record_time("prepare")
        lifted, result = how.make(asset, views, clock)

        # The proof, before anybody sees the result.
        receipt, renders = edit_receipt(asset, result, lifted, views, mode, how, self.preset, self.settings, note)
        clock.record_time("receipt")
        result = replace(result, receipt=replace(receipt, seconds=clock.seconds)).with_surface_of(asset)
        del at_hand
        keep_view(asset, result, renders[0])
        return result

    def choose(self, method: Method, mode: Mode) -> tuple[Method, str]:
        """What `apply` does for a method: (method, never "auto", and the one line that says why). Local edits by "auto"
        that no other network makes are the lift's, corrected; those of preset "lift" are not. Weights whose notes
        hold `gain`, {mode: dB over the lift on objects kept out of training}, are used by "auto" only where that is
        above 0; a Stage II that has learnt global edits alone makes no local ones. Raises ValueError for a method that
        is not known, or needs a model that is not there."""
        reads_pictures = self.reads_pictures(mode)
        if method == "ttt" and self.model is None and not reads_pictures:
            if self.local is not None:
                raise ValueError(
                    f"method 'ttt' needs a preset with trained weights for mode {mode}, and '{self.preset}' has those "
                    "for local edits alone; use preset 'rows'"
                )
            raise ValueError(
                "method 'ttt' needs a preset with trained weights; use method 'lift' or 'auto' without them"
            )
        # What was asked for outright is refused where it cannot be done; "auto" falls back and says why.
        if mode == "spread":
            if method not in ("auto", "lift"):
                raise ValueError(f"method: mode spread is made by the lift alone, got {method!r}")
            return "lift", "mode spread: the analytic lift"
        chosen, why = self._choose(method, mode, reads_pictures)
        corrects = (method, mode, chosen) == ("auto", "local", "lift") and self.why != LIFT_ALONE
        return ("corrected" if corrects else chosen), why

    def _choose(self, method: Method, mode: Mode, reads_pictures: bool) -> tuple[Method, str]:
        """As `choose`, where "lift" may still be corrected."""
        networks = method == "ttt" or (method == "auto" and not self.why)
        if reads_pictures and networks:
            assert self.local is not None
            return _local_choice(method, self.local.notes)
        if mode == "local" and networks and self.model is not None and not self.model.config.edits_locally:
            return "lift", NOT_LOCAL
        # A network paints only where it measured better than the lift on objects that it had not seen.
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
        if method not in (methods := get_args(Method)):
            raise ValueError(f"method: expected {', '.join(methods[:-1])} or {methods[-1]}, got {method!r}")
        if method == "ttt" and mode == "global" and not self.encodes(method, mode):
            return method, f"preset '{self.preset}' makes global edits by its predictor; preset 'rows' adapts to them"
        return method, ""

    @cached_property
    def _networks(self) -> Networks | None:
        if self.model is None:
            return None
        return Networks(self.model, self.settings.precision, self.settings.cache)


def _local_choice(method: Method, notes: Mapping[str, Any]) -> tuple[Method, str]:
    """What makes a local edit where the network that reads pictures is at hand, and the line that says why. method:
    "ttt" or "auto", which takes that network only where its notes hold a measured gain, {"gain": {"local": dB over the
    lift}}, above 0."""
    gain = notes.get("gain", {}).get("local")
    if method == "ttt":
        if gain is None or gain > 0:
            return "ttt", ""
        measured = f"{gain:+.2f} dB on held-out objects, lower end"
        return "ttt", f"the local network, as asked for: it measured no better than the lift ({measured})"
    if gain is None:
        return "lift", "made by the analytic lift: the network of preset 'local' was not measured on captures"
    if gain > 0:
        return "ttt", f"weights of preset 'local' ({gain:+.2f} dB over the lift on held-out objects): the local network"
    return "lift", "made by the analytic lift: the network of preset 'local' measured no better"
