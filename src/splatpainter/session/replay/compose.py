"""The asset as a pure function of its original and its layers. Knows no file and no history.

Results of layers are cached under what they depend on: the original, everything below, and the layer's content, which
names the painter that it was made with.

    state = replay.compose(document)        # from the nearest state that is still cached

Where something below a layer changed, and nothing of what the layer read there, its result is renumbered, not painted
again (read_set.py).

A layer that cannot be applied where it now stands (hidden, reordered or reshaped layers below it took its Gaussians
away) changes nothing and says why; it is kept, and works again when they return.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.grading.color_transfer import with_table
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.lift.sheets.view_limits import coarse_surface, left_out
from splatpainter.lights.unlit import unlit_after
from splatpainter.painter import Asset, Edit, Method, Mode, Painter
from splatpainter.painting.edited_picture import LIFTS
from splatpainter.session.document.document import Document, Layer, digest
from splatpainter.session.document.layer_factory import decode_cover, decode_mask, decode_picture, is_cut_out
from splatpainter.session.document.layer_view import View
from splatpainter.session.replay.appearance import base_of_parents, picture_of, with_base
from splatpainter.session.replay.conflicts import EditedIds, policy_strength
from splatpainter.session.replay.covered_preview import (
    Preview,
    changed_layer,
    hidden_layer,
    revealed_layer,
    where_uncovered,
)
from splatpainter.session.replay.delta import Delta, between, no_delta
from splatpainter.session.replay.fingerprint import fingerprint
from splatpainter.session.replay.layer_blending import AdjustmentFunction, adjust_sh, blend_delta
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.session.replay.layer_state import (
    LayerState,
    Progress,
    ResultStore,
    ancestors,
    lineage,
    nbytes,
)
from splatpainter.session.replay.light_below import mix_light, recolored
from splatpainter.session.replay.mask_weights import MaskWeights
from splatpainter.session.replay.painter_adapter import PainterAdapter
from splatpainter.session.replay.read_set import ReadSet, read_set_of, renumber
from splatpainter.session.replay.strokes import (
    MIN_LATEST,
    FoldedStrokes,
    StrokeChains,
    StrokeKeys,
    StrokesState,
    folded,
    folded_key,
    strokes_to_fold,
)
from splatpainter.session.selection.selection import Selection
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent
from splatpainter.voxels.raycast import is_inside

if TYPE_CHECKING:
    from splatpainter.spread.options import SpreadOptions
    from splatpainter.surface.estimate import Surface
    from splatpainter.surface.visible import VisibleSurface

CACHED_STATE_BYTES = 1 << 28
"""Bytes of composed assets that are cached to start from."""
MAX_CACHED_STATES = 64
"""How many of them at most."""
MAX_PLACEMENTS = 4
"""Arrangements that are cached of each layer."""
MAX_PLACED_LAYERS = 1024
"""Layers of which arrangements are cached."""
MAX_READ_IDS = 1 << 23
"""Gaussians that cached arrangements read, in all."""
MAX_SEEN = 4
"""Coarse surfaces that are cached: limits ask for that of the present state, decals for that of the original."""


class Replay:
    """Composes documents over one original."""

    def __init__(
        self,
        original: Splats,
        painter: Painter,
        store: ResultStore,
        adjustments: Mapping[str, AdjustmentFunction],
    ) -> None:
        """original: with `origin`; adjustments: functions by name."""
        self.original, self.painter, self.adjustments = original, painter, adjustments
        self.store = store
        self.adapter = PainterAdapter(original, painter)
        self._states = Recent[LayerState](
            CACHED_STATE_BYTES, lambda state: nbytes(state.splats), most=MAX_CACHED_STATES
        )
        self._placements = Recent[Recent[str]](MAX_PLACED_LAYERS)
        """Key of a layer -> (key of the state below -> key of its result)."""
        self._read_sets = Recent[ReadSet | None](MAX_READ_IDS, lambda read: len(read.gaussian_ids) if read else 0)
        """(key of the state below, key of a layer) -> what it reads there."""
        self._merged: tuple[tuple[str, str], Delta] | None = None
        self._strokes = StrokeChains(store, self._painted_stroke)
        self._masks = MaskWeights(store, original)
        self._seen: Recent[VisibleSurface] = Recent(MAX_SEEN)
        """What views see of states, coarsely: of the latest MAX_SEEN of both."""
        self.base_state = LayerState(digest(f"original {original.sha256}"), original)

    def compose(self, document: Document, progress: Progress | None = None, strict: str | None = None) -> LayerState:
        """The asset of a document. strict: id of the layer whose problem is an error (one that is being added).
        Raises ValueError for it, and whatever `progress` raises."""
        count = sum(len(list(layer.leaves())) for layer in document.layers if _is_visible(layer))
        # Every prefix of layers has a key of its own, so this walks through cached states up to the first change.
        state = self.base_state
        for k, layer in enumerate(document.layers):
            if _is_visible(layer):
                state = self._over(state, layer, document, strict, progress, (k, count))
        return state

    def _over(self, below: LayerState, layer: Layer, document: Document, strict, progress, step) -> LayerState:
        """The state with one more layer. step: (layers done, layers in all)."""
        if layer.layers:
            return self._over_merged(below, layer, document, strict, progress, step)
        if layer.holds_strokes:
            return self._over_strokes(below, layer, document, strict, progress, step)
        # What it makes is named by what it stands on; how much of it shows is named besides, so that a slider finds it.
        strength, depends = policy_strength(below.edited, layer, document, len(below.splats))
        result_key = _result_key(below, layer)
        key = digest(f"{result_key} {layer.opacity!r} {layer.blend} {json.dumps(depends)}{_mask_text(layer)}")
        cached = self._cached(key, below, layer)
        if cached is not None:
            return cached
        if progress is not None:
            progress(*step, layer.name)
        # From the project, or from another arrangement of layers in which it read the same, or else computed.
        stored = _is_stored(layer)
        result = self.store.get(result_key) if stored else None
        if result is None or result.delta.count != len(below.splats):  # the latter: of a damaged file
            result = self._renumbered(below, layer) or self._try(below, layer)
            if result.problem and layer.id == strict:
                raise ValueError(result.problem)
            if stored:
                self.store.put(result_key, result)
        self._note_placement(below, layer, result_key)
        # Colours to mix with are fitted when a mix is asked for the first time: most layers never are.
        if result.delta.base is None and _mixes(layer, strength) and _has_base(layer):
            based = with_base(below.splats, result.delta, [view.camera for view in layer.views])
            if based is not result.delta:
                result = replace(result, delta=based)
                self.store.put(result_key, result)
        mask = self._masks.weights(below, result.delta, layer, result_key)
        # Results hold what layers do in full: opacity, mask and policies come after them and paint nothing anew.
        delta = layer.operation.mix(below.splats, result.delta, layer.opacity, layer.blend, strength, mask)
        splats = (result if delta is result.delta else delta).apply(below.splats)
        span = (len(below.splats), len(splats))
        confidence = None if result.confidence is None else _fit(result.confidence, len(splats))
        state = LayerState(
            key,
            splats,
            np.concatenate([below.parent_ids, delta.parent_ids]),
            (*below.edited, EditedIds(layer, result_key, result.delta.gaussian_ids, span, confidence)),
            (*below.facts, (layer.id, result.facts)),
            (*below.results, result_key) if stored else below.results,
            below.painter_state if result.painter_state is None else result.painter_state,
            _unlit(below, splats, delta.parent_ids, layer, delta.gaussian_ids),
        )
        return self._states.put(key, state)

    def _over_strokes(self, below: LayerState, layer: Layer, document: Document, strict, progress, step) -> LayerState:
        """The strokes of a layer, then its opacity and blend over all they did."""
        if not layer.strokes:
            return replace(below, facts=(*below.facts, (layer.id, {})))
        strength, depends = policy_strength(below.edited, layer, document, len(below.splats))
        chain = StrokeKeys.of(below.key, layer.strokes)
        result_key = chain.results[-1]
        key = digest(f"{result_key} {layer.opacity!r} {layer.blend} {json.dumps(depends)}{_mask_text(layer)}")
        cached = self._cached(key, below, layer)
        if cached is not None:
            return cached
        count = len(layer.strokes)

        def report(k: int) -> None:
            if progress is not None:
                progress(*step, layer.name if k == count - 1 else f"{layer.name}: stroke {k + 1} of {count}")

        # All strokes in full; opacity, blend, mask and policies then act on what they did together, as of one layer.
        painted = self._strokes.compose(below, layer, chain, strict, report)
        splats, parent_ids, changed = painted.state.splats, painted.state.parent_ids, painted.changed
        if strength is not None or _mixes(layer, None):
            delta = self._strokes_delta(below, painted, layer)
            mask = self._masks.weights(below, delta, layer, result_key)
            delta = blend_delta(below.splats, delta, layer.opacity, layer.blend, strength, mask)
            splats, parent_ids = delta.apply(below.splats), np.concatenate([below.parent_ids, delta.parent_ids])
        span = (len(below.splats), len(splats))
        facts = painted.layer_facts(layer, below)
        if "problem" in facts and layer.id == strict:
            raise ValueError(facts["problem"])
        state = LayerState(
            key,
            splats,
            parent_ids,
            (*below.edited, EditedIds(layer, result_key, changed, span)),
            (*below.facts, (layer.id, facts)),
            (*below.results, result_key),
            painted.state.painter_state,
        )
        if below.unlit is not None:
            parents = ancestors(state, len(below.splats))
            state = replace(state, unlit=unlit_after(below.splats, below.unlit, splats, parents, changed))
        return self._states.put(key, state)

    def _strokes_delta(self, below: LayerState, painted: StrokesState, layer: Layer) -> Delta:
        """What all strokes of a layer did, for an opacity, a blend or a policy; the latest one is cached."""
        # One is enough: a slider that is dragged asks for the same strokes at one opacity after the other.
        key = (below.key, painted.state.key)
        if self._merged is None or self._merged[0] != key:
            self._merged = (key, with_base(below.splats, painted.delta(below), layer.cameras))
        return self._merged[1]

    def blend_preview(self, document: Document, layer_id: str, now: Document) -> Preview | None:
        """As a layer of a document will be shown, or hidden, from what is at hand, where composing that takes longer;
        None else. Of a layer that others cover: where these leave it (covered_preview.py). now: the document that is
        shown, which differs in that layer's opacity, blend and visibility alone."""
        at = document.index(layer_id)
        layer, covered = document.layers[at], any(map(_is_visible, document.layers[at + 1 :]))
        seen = _is_visible(now.layers[at])
        # An uncovered layer that comes or goes is composed at once: nothing above it has to be painted anew.
        if not (covered or (seen and _is_visible(layer))):
            return None
        # These three are cached as a rule: they are what is on the screen.
        below = self.compose(replace(document, layers=document.layers[:at]))
        composed = self.compose(now).splats
        before = self.compose(replace(now, layers=now.layers[: at + 1])).splats if seen else below.splats
        if not _is_visible(layer):
            return where_uncovered(hidden_layer(below.splats, before), before, composed) if seen else None
        # Without results at hand a preview would cost what composing costs, and there is none.
        delta = self._delta_at_hand(document, layer, below, covered)
        if delta is None:
            return None
        if not seen:
            return revealed_layer(below.splats, delta, composed)
        preview = changed_layer(below.splats, delta)
        return where_uncovered(preview, before, composed) if covered else preview

    def color_preview(self, document: Document, layer_id: str, now: Document) -> Preview | None:
        """As a layer of a document will look in its base colours, where its operation can say that at a glance; None
        where it cannot, or where layers above hide all of it. now: the document that is shown, which differs in that
        layer's options, opacity and blend alone."""
        at = document.index(layer_id)
        layer = document.layers[at]
        if layer.layers or layer.holds_strokes or not _is_visible(layer) or not _is_visible(now.layers[at]):
            return None
        below = self.compose(replace(document, layers=document.layers[:at]))
        sh = layer.operation.glance(ReplayedWork(self, layer, below, below.splats, self.original))
        if sh is None:
            return None
        # Bands beyond the first stay away from here on: they are most of what mixing and comparing would copy.
        count = len(below.splats)
        base = replace(below.splats, sh=below.splats.sh[:, :1])
        delta = replace(no_delta(base), gaussian_ids=np.arange(count), values=replace(base, sh=sh))
        strength = policy_strength(below.edited, layer, document, count)[0]
        # Masks look at places alone, which are those below whatever the options are.
        key = digest(f"{below.key} as below")
        mask = self._masks.weights(replace(below, splats=base), delta, layer, key)
        mixed = layer.operation.mix(base, delta, layer.opacity, layer.blend, strength, mask)
        preview = (mixed.gaussian_ids, mixed.values)
        if not any(map(_is_visible, document.layers[at + 1 :])):
            return preview
        with_layer = self.compose(replace(now, layers=now.layers[: at + 1])).splats
        uncovered = where_uncovered(preview, with_layer, self.compose(now).splats)
        return uncovered if uncovered is not None and len(uncovered[0]) else None

    def _delta_at_hand(self, document: Document, layer: Layer, below: LayerState, covered: bool) -> Delta | None:
        """What a layer does, with opacity, blend, mask and policies, from results that are stored or cached; None where
        they are not, or where composing takes no time either. Where colours below would have to be fitted, those of
        parents stand for them."""
        try:
            delta, key, fitted = self._stored_delta(document, layer, below)
        except _NotAtHand:
            return None
        strength = policy_strength(below.edited, layer, document, len(below.splats))[0]
        # An uncovered layer whose colours are fitted is composed as quickly as it is previewed.
        unfitted = not fitted and _mixes(layer, strength) and any(map(_has_base, layer.leaves()))
        if delta.count != len(below.splats) or not (covered or unfitted):
            return None
        mask = None
        if _mask_text(layer) and (mask := self._masks.cached(delta, layer, key)) is None:
            return None
        if unfitted:
            delta = replace(delta, base=base_of_parents(below.splats, delta))
        mixed = layer.operation.mix(below.splats, delta, layer.opacity, layer.blend, strength, mask)
        return mixed.complete(below.splats)

    def _stored_delta(self, document: Document, layer: Layer, below: LayerState) -> tuple[Delta, str, bool]:
        """(what a layer does in full, the name of that and the state below, whether colours below were fitted to it).
        Raises _NotAtHand."""
        if layer.layers:
            state = below
            for inner in filter(_is_visible, layer.layers):
                simple = not inner.layers and not inner.holds_strokes
                if simple and _is_stored(inner) and not self.store.has(_result_key(state, inner)):
                    raise _NotAtHand
                state = self._over(state, inner, document, None, None if simple else _refuse, (0, 1))
            # What a slider cached has its colours fitted already, and saves comparing two whole assets.
            if self._merged is not None and self._merged[0] == (below.key, state.key):
                return self._merged[1], state.key, True
            return between(below.splats, state.splats, ancestors(state, len(below.splats))), state.key, False
        if layer.holds_strokes:
            chain = StrokeKeys.of(below.key, layer.strokes)
            painted = self._strokes.compose(below, layer, chain, None, _refuse) if layer.strokes else None
            if painted is None:
                raise _NotAtHand
            if self._merged is not None and self._merged[0] == (below.key, painted.state.key):
                return self._merged[1], chain.results[-1], True
            return painted.delta(below), chain.results[-1], False
        # Results that are not stored are cheap by design, and may be computed even for a preview.
        key = _result_key(below, layer)
        result = self.store.get(key) if _is_stored(layer) else self._try(below, layer)
        if result is None or result.problem:
            raise _NotAtHand
        return result.delta, key, result.delta.base is not None

    def _painted_stroke(self, state: LayerState, stroke: Layer, below: LayerState) -> LayerResult:
        """What a stroke makes of the state after those before it. below: the state below its layer."""
        if stroke.operation.reads_below_layer:
            return self._try(state, stroke, below)
        # Where the stroke read the same in another arrangement, its result is renumbered, not painted again.
        result = self._renumbered(state, stroke) or self._try(state, stroke)
        self._note_placement(state, stroke, StrokeKeys.of(state.key, (stroke,)).results[0])
        return result

    def fold(self, document: Document, layer: str, sizes: Callable[[str], int]) -> FoldedStrokes | None:
        """What is to be stored in place of the results of a layer's first strokes; None: nothing. sizes: bytes that a
        result takes, by its key."""
        # The latest strokes keep results of their own: they are what undo goes back through.
        at = document.index(layer)
        target = document.layers[at]
        if len(target.strokes) <= MIN_LATEST:
            return None
        below = self.compose(replace(document, layers=document.layers[:at]))
        chain = StrokeKeys.of(below.key, target.strokes)
        count = strokes_to_fold(chain.results, sizes)
        if not count:
            return None
        # These strokes are cached or stored as a rule, so that nothing is painted here.
        first = replace(target, strokes=target.strokes[:count])
        painted = self._strokes.compose(below, first, StrokeKeys.of(below.key, first.strokes), None, lambda _: None)
        return FoldedStrokes(
            chain.results[:count], folded_key(chain, count), folded(painted, below), next_key=chain.results[count]
        )

    def painted_on(self, document: Document, layer: str) -> Splats:
        """The Gaussians that the next stroke of a layer is painted on."""
        at = document.index(layer)
        target = document.layers[at]
        if target.layers:  # on all that it is made of, in full
            full = replace(target, opacity=1.0, blend="normal", mask=None, visible=True)
            return self.compose(replace(document, layers=(*document.layers[:at], full))).splats
        below = self.compose(replace(document, layers=document.layers[:at]))
        if not target.strokes:
            return below.splats
        chain = StrokeKeys.of(below.key, target.strokes)
        return self._strokes.compose(below, target, chain, None, lambda _: None).state.splats

    def _over_merged(self, below: LayerState, layer: Layer, document: Document, strict, progress, step) -> LayerState:
        """The layers of a merged one, then its opacity and blend over all they did."""
        state = below
        for inner in layer.layers:
            if _is_visible(inner):
                state = self._over(state, inner, document, strict, progress, step)
        # People see one layer: its facts are the sums of those inside it, which stay in the list too.
        inner_facts = state.facts[len(below.facts) :]
        names = ("rows_touched", "rows_appended", "seconds")
        total = {name: sum(facts.get(name, 0) for _, facts in inner_facts) for name in names}
        facts = (*below.facts, (layer.id, total), *inner_facts)
        # Shown in full, the state of the inner layers is taken as it is: merging changes no bit.
        if not _mixes(layer, None):
            return replace(state, facts=facts)
        delta = self._merged_delta(below, state, layer)
        mask = self._masks.weights(below, delta, layer, state.key)
        lights = all(leaf.operation.relights for leaf in layer.leaves())
        mixing = partial(mix_light, space=below.splats.color_space) if lights else None
        splats = blend_delta(below.splats, delta, layer.opacity, layer.blend, mask=mask, mixing=mixing).apply(
            below.splats
        )
        unlit = state.unlit
        if unlit is not None and not lights:  # what was painted is there by half, and so is its look without light
            bare = replace(below.splats, sh=below.splats.sh[:, :1] if below.unlit is None else below.unlit)
            unlit = blend_delta(bare, recolored(delta, unlit), layer.opacity, layer.blend, mask=mask).apply(bare).sh
        key = digest(f"{below.key} merged {state.key} {layer.opacity!r} {layer.blend}{_mask_text(layer)}")
        return replace(state, key=key, splats=splats, facts=facts, unlit=unlit)

    def _merged_delta(self, below: LayerState, state: LayerState, layer: Layer) -> Delta:
        """What a merged layer did, for another opacity or blend; the latest one is cached, for sliders."""
        key = (below.key, state.key)
        if self._merged is None or self._merged[0] != key:
            delta = between(below.splats, state.splats, ancestors(state, len(below.splats)))
            # Colours to mix with are fitted for cameras of visible layers alone: hidden ones have painted nothing.
            leaves = [leaf for leaf in layer.leaves() if _is_visible(leaf)]
            if any(map(_has_base, leaves)):
                cameras = [camera for leaf in leaves if _has_base(leaf) for camera in leaf.cameras]
                delta = with_base(below.splats, delta, cameras)
            self._merged = (key, delta)
        return self._merged[1]

    def _note_placement(self, below: LayerState, layer: Layer, result_key: str) -> None:
        """Remember where a layer's result can be had from."""
        if not self._has_read_set(layer):
            return
        placements = self._placements.get(layer.key, lambda: Recent(MAX_PLACEMENTS))
        placements.put(below.key, result_key)

    def _renumbered(self, below: LayerState, layer: Layer) -> LayerResult | None:
        """A layer's result of another arrangement, where it read the same there; None: it has to be painted."""
        placements = self._placements.find(layer.key)
        # The latest arrangement first: it is the likeliest to be stored still, and to have read the same.
        for key, result_key in reversed([] if placements is None else [*placements.items.items()]):
            # Equal digests mean that the layer read the same bytes there, so that painting again would make the same.
            old = self._read_set(key, layer)
            new = self._read_set(below.key, layer, below) if old is not None else None
            if old is None or new is None or old.digest != new.digest:
                continue
            result = self.store.get(result_key)
            if result is None or result.problem:
                continue
            delta = renumber(result.delta, old, new, len(below.splats))
            if delta is not None:
                return replace(result, delta=delta)
        return None

    def _read_set(self, key: str, layer: Layer, state: LayerState | None = None) -> ReadSet | None:
        """What a layer reads of a state; None where that cannot be said (any more)."""
        pair = (key, layer.key)
        # What read_set_of could not say is remembered as well: a state of this key never changes.
        if pair in self._read_sets:
            return self._read_sets.find(pair)
        state = state or (self.base_state if key == self.base_state.key else self._states.find(key))
        state = state or self._strokes.state(key)
        if state is None:
            return None
        # Only what its lift reads counts: changes elsewhere leave the layer's result as it is.
        (view,) = layer.views
        grid, splats = self.adapter.grid, state.splats
        read = read_set_of(splats, lambda: grid(splats), view.camera, self.mask(view), len(self.original))
        return self._read_sets.put(pair, read)

    def _has_read_set(self, layer: Layer) -> bool:
        """Whether read_set.py knows what a layer reads: one masked view, lifted locally by the analytic painter."""
        analytic = layer.operation.reads_locally and type(self.painter) is Painter
        return analytic and len(layer.views) == 1 and layer.views[0].mask is not None

    def _try(self, below: LayerState, layer: Layer, erased_to: LayerState | None = None) -> LayerResult:
        """What a layer makes of a state, or why it cannot. erased_to: of a stroke that reads what is below its layer,
        the state there."""
        # A layer that cannot be applied is kept and says why: it works again when what it needs returns.
        start = time.perf_counter()
        try:
            result = self._result(below, layer, erased_to)
        except ValueError as error:
            return LayerResult(no_delta(below.splats), {"problem": str(error)})
        facts: dict[str, Any] = {"rows_touched": len(result.delta.gaussian_ids)}
        facts["rows_appended"] = len(result.delta.appended)
        facts["seconds"] = round(time.perf_counter() - start, 4)
        return replace(result, facts={**facts, **result.facts})

    def _result(self, below: LayerState, layer: Layer, erased_to: LayerState | None = None) -> LayerResult:
        """What a layer makes of a state; nothing is cached. Raises ValueError where it cannot be applied."""
        if erased_to is None:
            return layer.operation.result(ReplayedWork(self, layer, below, below.splats, self.original))
        # Numbered by what is below the layer: that is what its strokes are taken back to.
        splats = replace(below.splats, origin=lineage(below, len(erased_to.splats)))
        return layer.operation.result(ReplayedWork(self, layer, below, splats, erased_to.splats))

    def edit_of(self, view: View, layer: Layer, below: Splats | None = None) -> Edit:
        """A view of a layer, or of a stroke, as it was given. below: what shows where its picture was cut out."""
        assert view.picture is not None, "a painted layer has pictures"
        # A picture that is kept inside its mask only shows what is below beside it, as when it was painted.
        data, where = self.store.blob(view.picture), layer.title
        image = decode_picture(data, view.camera, where, self.original.color_space)
        if below is not None and view.mask is not None and is_cut_out(data, view.camera, where):
            image = np.where(self.mask(view)[..., None], image, picture_of(below, view.camera))
        mask = None if view.mask is None else self.mask(view)
        cover = None if view.mask is None else decode_cover(self.store.blob(view.mask), view.camera, where)
        return Edit(image, view.camera, mask, layer.name, cover)

    def mask(self, view: View) -> np.ndarray:
        """[H, W] bool mask of a view; all of it where it has none."""
        if view.mask is None:
            return np.ones((view.camera.height, view.camera.width), bool)
        return decode_mask(self.store.blob(view.mask), view.camera, "mask")

    def left_out(self, state: LayerState, camera: Camera, limits: Mapping[str, Any]) -> np.ndarray:
        """[H, W] bool: pixels of a view whose paint the limits (of LocalOptions) leave out (lift.view_limits)."""
        # Limits that a layer does not name are the painter's, as when the layer is computed.
        options = replace(self.painter.settings.local_options or LOCAL_DEFAULTS, **limits)
        return left_out(self.coarse_surface(state, camera), camera, options.angle_limit, options.depth_edge_limit)

    def coarse_surface(self, state: LayerState, camera: Camera) -> VisibleSurface:
        """What a view sees of a state's surface, on blocks of pixels (lift.view_limits); the latest ones are cached."""
        # The camera is a part of the key: a coarse surface is what one view sees.
        key = f"{state.key} {camera.to_json()}"
        return self._seen.get(key, lambda: coarse_surface(self.surface, state.splats, camera))

    @property
    def surface(self) -> Surface:
        """Surface of the original."""
        return self.adapter.surface

    def prepare(self, state: LayerState, camera: Camera | None) -> None:
        """Make what a local edit of a state in a view (None: any) needs before anything else."""
        if camera is None:
            self.adapter.grid(state.splats)
        else:
            is_inside(state.splats, lambda: self.adapter.grid(state.splats), camera.position)
        _ = self.adapter.surface.typical_width  # of the samples, which are cached with it

    def forget(self, results: set[str]) -> None:
        """Drop states that were made of results which are no longer stored."""
        self._states.forget(lambda state: bool(results.intersection(state.results)))
        self._strokes.forget(results)

    def _cached(self, key: str, below: LayerState, layer: Layer) -> LayerState | None:
        """A state that is still cached. Its edited ids and facts name layers by id, which its key does not hold."""
        state = self._states.find(key)
        if state is None:
            return None
        edited = (*below.edited, replace(state.edited[-1], layer=layer))
        return replace(state, edited=edited, facts=(*below.facts, (layer.id, state.facts[-1][1])))


@dataclass(frozen=True)
class ReplayedWork:
    """A layer being composed, as its operation sees it: a LayerWork."""

    _replay: Replay
    _layer: Layer
    _below: LayerState
    splats: Splats
    original: Splats

    @property
    def title(self) -> str:
        return self._layer.title

    @property
    def views(self) -> tuple[View, ...]:
        return self._layer.views

    @property
    def unlit(self) -> np.ndarray | None:
        return self._below.unlit

    @property
    def fades(self) -> bool:
        return _fades(self._layer)

    @property
    def proves_changes(self) -> bool:
        return type(self._replay.painter) is Painter

    def blob(self, sha256: str) -> bytes:
        return self._replay.store.blob(sha256)

    def mask(self, view: View) -> np.ndarray:
        return self._replay.mask(view)

    def edit(self, view: View) -> Edit:
        return self._replay.edit_of(view, self._layer)

    def selected(self, selection: str) -> np.ndarray:
        if not selection:
            raise ValueError(f"{self.title}: expected a selection")
        stored = Selection.from_png(self.blob(selection), len(self._replay.original), self.title)
        return stored.on(self.splats, self._replay.original)

    def adjusted(self, name: str, settings: Mapping[str, Any]) -> Splats:
        parameters = with_table({**settings, "look": name}, self.blob)
        return replace(self.splats, sh=adjust_sh(self.splats.sh, parameters, self._replay.adjustments))

    def paint(
        self, mode: Mode, method: Method, options: Mapping[str, Any], spread: SpreadOptions | None
    ) -> tuple[Splats, Asset]:
        # Painters that look beside the mask get what is below there; the lift does not look, corrected or not.
        below = None if method in LIFTS else self.splats
        edits = [self._replay.edit_of(view, self._layer, below) for view in self.views]
        return self._replay.adapter.apply(self.splats, self._below.painter_state, edits, mode, method, options, spread)

    def fingerprint(self, method: Method, mode: Mode) -> str:
        return fingerprint(self._replay.painter, method, mode)


class _NotAtHand(Exception):
    """Something would have to be painted."""


def _refuse(*_: Any) -> None:
    raise _NotAtHand


def _is_visible(layer: Layer) -> bool:
    return layer.visible and layer.opacity > 0


def _is_stored(layer: Layer) -> bool:
    """Whether the result of a layer is stored; else it is made anew as quickly."""
    return layer.operation.is_stored(layer.views)


def _result_key(below: LayerState, layer: Layer) -> str:
    """Name of what a layer that is neither merged nor holds strokes makes of a state."""
    return digest(f"{below.key} {layer.key}{layer.operation.variant(_fades(layer))}")


def _mixes(layer: Layer, strength: np.ndarray | None) -> bool:
    """Whether a layer's opacity and blend, or a policy's factors of the former, mix colours with those below."""
    partial = strength is not None and bool(((strength > 0) & (strength < 1)).any())
    return layer.opacity < 1 or layer.blend != "normal" or partial or bool(_mask_text(layer))


def _mask_text(layer: Layer) -> str:
    """What of a mask decides the result; "" without one."""
    if layer.mask is None or not layer.mask.enabled:
        return ""
    return f" mask {json.dumps(layer.mask.record(), sort_keys=True)}"


def _unlit(
    below: LayerState, splats: Splats, parents: np.ndarray, layer: Layer, changed: np.ndarray
) -> np.ndarray | None:
    """LayerState.unlit after a layer that is not merged, which makes `splats`; parents: [A] of those that it appends,
    counted below; changed: [T] those below that it changed."""
    if layer.operation.relights:
        return below.splats.sh[:, :1] if below.unlit is None else below.unlit
    return unlit_after(below.splats, below.unlit, splats, parents, changed)


def _has_base(layer: Layer) -> bool:
    """Whether a layer's opacity starts from colours fitted to what its views saw before."""
    return layer.operation.lays_paint


def _fades(layer: Layer) -> bool:
    """Whether its opacity or blend mixes a layer with what is below it."""
    return layer.opacity < 1 or layer.blend != "normal"


def _fit(confidence: np.ndarray, count: int) -> np.ndarray:
    return np.pad(confidence, (0, max(count - len(confidence), 0)), constant_values=255)[:count]
