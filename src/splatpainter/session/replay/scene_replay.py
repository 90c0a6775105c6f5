"""The Gaussians of a document with several assets: each asset's layers composed in its own space, then all assets where
they stand, as one. Knows no file and no history.

    [originals of all visible assets, one after the other][what layers appended to the first, to the second, ...]

So the scene has an original, whose Gaussians come first and in whose places they stay, as every asset has. A document
of one asset alone, as it is, is composed by its own Replay, and is the same bit for bit as without any of this.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io.joining import concatenated
from splatpainter.io.positions import NO_OFFSET, Offset
from splatpainter.painter import Painter
from splatpainter.scene.placement import Placement
from splatpainter.session.document.document import Document, digest
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, SceneAsset, find_asset
from splatpainter.session.replay.compose import Replay
from splatpainter.session.replay.conflicts import EditedIds
from splatpainter.session.replay.covered_preview import Preview
from splatpainter.session.replay.layer_blending import AdjustmentFunction
from splatpainter.session.replay.layer_state import LayerState, Progress, ResultStore
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent

PreviewOf = Callable[[Replay, Document, str, Document], Preview | None]
"""`Replay.blend_preview` or another of its previews."""
MAX_CACHED_REPLAYS, MAX_CACHED_SCENES, MAX_CACHED_SURFACES = 8, 4, 2
"""Assets that were added, scenes, and surfaces of scenes, that stay in memory."""


@dataclass(frozen=True)
class ScenePart:
    """One visible asset of a scene."""

    asset: SceneAsset
    original: Splats = field(repr=False)
    state: LayerState = field(repr=False)
    """State in the asset's own space."""
    first: int
    """Index, among the scene's Gaussians, of the first of its original."""
    first_appended: int
    """Index of the first that its layers appended."""
    offset: Offset = NO_OFFSET
    """What the scene's means are relative to (Splats.offset)."""

    @property
    def placement(self) -> Placement:
        """What brings this asset's means to the scene's."""
        return self.asset.placement.between(self.original.offset, self.offset)

    def placed(self, splats: Splats) -> Splats:
        """Gaussians of this asset in the scene."""
        return self.asset.placement.apply(splats, self.offset)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the scene in this asset's own space."""
        return self.asset.placement.camera(camera.relative_to(self.offset), self.original.offset)

    @property
    def scene_ids(self) -> np.ndarray:
        """[N] int64 the scene's Gaussian that each of this asset is."""
        count, total = len(self.original), len(self.state.splats)
        return np.concatenate([self.first + np.arange(count), self.first_appended + np.arange(total - count)])


@dataclass(frozen=True)
class Scene:
    """All visible assets as one."""

    parts: tuple[ScenePart, ...]
    original: Splats = field(repr=False)
    state: LayerState = field(repr=False)
    asset_numbers: np.ndarray = field(repr=False)
    """[N] int64 index in `parts` of the asset of each Gaussian."""


class SceneReplay:
    """Composes a session's documents, of one asset or several."""

    def __init__(
        self,
        original: Splats,
        painter: Painter,
        store: ResultStore,
        adjustments: Mapping[str, AdjustmentFunction],
        load: Callable[[SceneAsset], Splats],
    ) -> None:
        """original: that of MAIN_ASSET_ID; load: reads that of an asset that was added."""
        self.main = Replay(original, painter, store, adjustments)
        self.painter, self.adjustments = painter, adjustments
        self._store, self._load = store, load
        self._replays = Recent[Replay](MAX_CACHED_REPLAYS)
        self._scenes = Recent[Scene](MAX_CACHED_SCENES)
        self._surfaces = Recent[Replay](MAX_CACHED_SURFACES)
        """Replays of scenes as if they were one asset, for their surface."""

    def replay(self, document: Document, asset: str) -> Replay:
        """Replay of one asset. Raises ValueError: unknown, or its file is damaged."""
        if asset == MAIN_ASSET_ID:
            return self.main
        # The same bytes read in other axes are another original.
        entry = find_asset(document.assets, asset)
        key = f"{entry.sha256} {entry.axes}"
        return self._replays.get(key, lambda: Replay(self._load(entry), self.painter, self._store, self.adjustments))

    def remember(self, asset: SceneAsset, original: Splats) -> None:
        """An asset whose file is not in the project yet."""
        key = f"{asset.sha256} {asset.axes}"
        self._replays.put(key, Replay(original, self.painter, self._store, self.adjustments))

    def of_layer(self, document: Document, layer: str) -> tuple[Replay, Document]:
        """(the Replay of a layer's asset, the document of that asset alone)."""
        asset = document.layers[document.index(layer)].asset
        return self.replay(document, asset), document.part(asset)

    def compose(
        self, document: Document, progress: Progress | None = None, strict: str | Collection[str] | None = None
    ) -> LayerState:
        """The asset, or the scene, of a document; see Replay.compose. strict: one layer, or several of different
        assets, whose problems are errors."""
        if not document.assets:
            return self.main.compose(
                document, progress, strict if isinstance(strict, str) else next(iter(strict or ()), None)
            )
        return self.scene(document, progress, strict).state

    def scene(
        self, document: Document, progress: Progress | None = None, strict: str | Collection[str] | None = None
    ) -> Scene:
        """The scene of a document with several assets. Hidden ones are composed too, so that their results stay."""
        names = {strict} if isinstance(strict, str) else set(strict or ())
        states, results = [], []
        for asset in document.assets:
            replay, part = self.replay(document, asset.id), document.part(asset.id)
            # Each asset is told only of its own new layer: another's problem is no error of this one.
            layer_ids = {entry.id for layer in part.layers for entry in (layer, *layer.strokes)}
            state = replay.compose(part, progress, next(iter(names & layer_ids), None))
            results += state.results
            states.append((asset, replay.original, state))
        # Hidden assets were composed for their results alone: a step that dropped these would paint them anew.
        visible = [entry for entry in states if entry[0].visible]
        if not visible:
            raise ValueError("asset: expected at least one visible one")
        # Where assets stand decides the scene, and moving one computes no layer anew.
        key = digest(" ".join(f"{state.key} {asset.placement!r}" for asset, _, state in visible))
        scene = self._scenes.get(key, lambda: joined(key, visible, self.main.original.offset))
        # Names, and which layers there are, are no part of the key.
        facts = tuple(fact for _, _, state in states for fact in state.facts)
        parts = tuple(
            replace(part, asset=asset, state=state)
            for part, (asset, _, state) in zip(scene.parts, visible, strict=True)
        )
        edited = tuple(entry for part in parts for entry in _edited(part, len(scene.state.splats)))
        state = replace(scene.state, facts=facts, results=tuple(results), edited=edited)
        return replace(scene, parts=parts, state=state)

    def original_of(self, document: Document) -> Splats:
        """The original of an asset or a scene."""
        return self.scene(document).original if document.assets else self.main.original

    def painted_on(self, document: Document, layer: str) -> Splats:
        """The scene with that on which the next stroke of a layer is painted."""
        replay, part = self.of_layer(document, layer)
        splats = replay.painted_on(part, layer)
        if not document.assets:
            return splats
        asset = document.layers[document.index(layer)].asset
        pieces = [
            one.placed(splats if one.asset.id == asset else one.state.splats) for one in self.scene(document).parts
        ]
        return concatenated(pieces)

    def blend_preview(self, document: Document, layer: str, now: Document) -> Preview | None:
        """See Replay.blend_preview; of a scene by its ids, where its assets stand."""
        if not document.assets:
            return self.main.blend_preview(document, layer, now)
        return self._placed_preview(document, layer, now, Replay.blend_preview)

    def color_preview(self, document: Document, layer: str, now: Document) -> Preview | None:
        """See Replay.color_preview; of a scene by its ids, where its assets stand."""
        if not document.assets:
            return self.main.color_preview(document, layer, now)
        return self._placed_preview(document, layer, now, Replay.color_preview)

    def _placed_preview(self, document: Document, layer: str, now: Document, of: PreviewOf) -> Preview | None:
        asset = document.layers[document.index(layer)].asset
        replay, part = self.of_layer(document, layer)
        preview = of(replay, part, layer, now.part(asset))
        scene = self.scene(now)
        placed = next((one for one in scene.parts if one.asset.id == asset), None)
        if preview is None or placed is None:
            return None
        ids, splats = preview
        count, total = len(placed.state.splats), len(scene.state.splats)
        # Ids beyond the asset's Gaussians become ids beyond the scene's: they are shown, and are in no array yet.
        present = np.searchsorted(ids, count)
        ids = np.concatenate([placed.scene_ids[ids[:present]], total + ids[present:] - count])
        return ids, placed.placed(splats)

    # ---- what Replay has beside; of a scene by its surface as a whole

    @property
    def base_state(self) -> LayerState:
        return self.main.base_state

    def forget(self, results: set[str]) -> None:
        for replay in (self.main, *self._replays.values()):
            replay.forget(results)
        self._scenes.clear()

    def prepare(self, document: Document, state: LayerState, camera: Camera | None) -> None:
        """See Replay.prepare."""
        if not document.assets:
            self.main.prepare(state, camera)
            return
        for part in self.scene(document).parts:
            inside = None if camera is None else part.camera(camera)
            self.replay(document, part.asset.id).prepare(part.state, inside)

    def surfaces(self, document: Document) -> Replay:
        """One whose `surface`, `left_out` and `coarse_surface` are those of the scene; nothing is painted with it."""
        if not document.assets:
            return self.main
        scene = self.scene(document)
        # By originals and places alone: the surface is that before all edits, and paint does not change it.
        key = digest(" ".join(f"{part.original.sha256} {part.asset.placement!r}" for part in scene.parts))
        return self._surfaces.get(key, lambda: Replay(scene.original, self.painter, self._store, self.adjustments))


def joined(key: str, visible: Sequence[tuple[SceneAsset, Splats, LayerState]], offset: Offset = NO_OFFSET) -> Scene:
    """Assets (original and state in their own spaces) as one, with means relative to `offset`."""
    total = sum(len(original) for _, original, _ in visible)
    # Originals first, as in one asset: a Gaussian's index then does not depend on what any layer appends.
    parts, first, first_appended = [], 0, total
    for asset, original, state in visible:
        parts.append(ScenePart(asset, original, state, first, first_appended, offset))
        first, first_appended = first + len(original), first_appended + len(state.splats) - len(original)
    placed = [part.placed(part.state.splats) for part in parts]
    counts = [len(part.original) for part in parts]
    heads = [splats.take(np.arange(n)) for splats, n in zip(placed, counts, strict=True)]
    tails = [splats.take(np.arange(n, len(splats))) for splats, n in zip(placed, counts, strict=True)]
    # Each asset counts its own originals from 0; in the scene those of the assets before it come first.
    origins = []
    for part, n in zip(parts, counts, strict=True):
        origin = part.state.splats.origin
        tail = np.full(len(part.state.splats) - n, -1, np.int64) if origin is None else np.asarray(origin[n:])
        origins.append(np.where(tail >= 0, tail + part.first, -1))
    origin = np.concatenate([np.arange(total), *origins])
    splats = replace(concatenated([*heads, *tails]), origin=origin)
    original = concatenated([part.placed(part.original) for part in parts])
    # Parents may be originals or appended, and so go by the scene's id of either.
    parents = [
        np.where(part.state.parent_ids >= 0, part.scene_ids[np.maximum(part.state.parent_ids, 0)], -1) for part in parts
    ]
    numbers = np.empty(len(splats), np.int64)
    for k, part in enumerate(parts):
        numbers[part.scene_ids] = k
    state = LayerState(key, splats, np.concatenate(parents))
    return Scene(tuple(parts), replace(original, origin=np.arange(total)), state, numbers)


def _edited(part: ScenePart, total: int) -> list[EditedIds]:
    """What the layers of an asset edited, by the scene's ids."""
    ids, count = part.scene_ids, len(part.original)
    shift = part.first_appended - count
    out = []
    for entry in part.state.edited:
        # Ids of an asset are no run of the scene's: originals and appended lie in two places.
        confidence = None
        if entry.confidence is not None:
            confidence = np.zeros(total, np.uint8)
            confidence[ids[: len(entry.confidence)]] = entry.confidence
        # What one layer appended is a run in the scene too, so a shift is enough.
        start, end = entry.appended
        changed = np.sort(ids[entry.changed])
        out.append(replace(entry, changed=changed, appended=(start + shift, end + shift), confidence=confidence))
    return out
