"""Layers that hold strokes: each stroke is painted on those before it, and only the newest is new.

What a stroke makes of the Gaussians below is a result of its own, stored under the hash of all that it depends on, so a
further stroke computes itself alone, and undo takes the last one away. Stored results in a row are written into one
copy of the Gaussians, not one copy each: a layer of hundreds of strokes is soon there again after its project was
opened. Where results take much room, those of all but the latest strokes become one (`strokes_to_fold`); going back
before these computes strokes anew, from their pictures. The layer's opacity, blend and conflicts are those of all its
strokes together, as of one layer (compose.py). Knows no painter and no file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from splatpainter.session.document.document import Layer, digest
from splatpainter.session.replay.delta import Delta, changed_values, without_source
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.session.replay.layer_state import LayerState, ResultStore, ancestors, nbytes
from splatpainter.splats import ATTRIBUTES
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent

CACHED_BYTES = 1 << 27
"""Bytes of Gaussians after strokes that are cached to go on from, or back to."""
MIN_CACHED, MAX_CACHED = 3, 64
"""States that are cached in any case, and at most."""
CHECKPOINT_STROKES = 8
"""Strokes before the last one at which the Gaussians are cached too where many are written in a row: the next undos
start from there."""
SPARE_ROOM = 0.25
"""Share of the Gaussians by which arrays grow when appended ones do not fit."""

MAX_LINKS = 1 << 13
"""Names of strokes that are cached."""

MAX_RESULT_BYTES = 8 << 20
"""Bytes that the results of a layer's strokes may take, each by itself."""
LATEST_BYTES = 5 << 20
"""Beyond MAX_RESULT_BYTES those of the latest strokes go on to take so many, and all before become one result."""
MIN_LATEST = 4
"""Strokes that keep results of their own in any case."""
PROBLEMS = "problems"
"""Name of the fact of a folded result: why some of its strokes change nothing."""

Paint = Callable[[LayerState, Layer, LayerState], LayerResult]
"""(the Gaussians below a stroke, the stroke, those below its layer) -> what it makes of them."""


@dataclass(frozen=True)
class StrokeKeys:
    """Names of what comes of a layer's strokes on a given state; nothing is computed yet."""

    keys: tuple[str, ...]
    """Keys of the states: below the layer, after the first stroke, and so on to the last."""
    results: tuple[str, ...]
    """Result keys of the strokes."""

    @staticmethod
    def of(below_key: str, strokes: tuple[Layer, ...]) -> StrokeKeys:
        keys, results = [below_key], []
        for stroke in strokes:
            # What reads the state below the layer depends on it too, which the state before the stroke does not name.
            result, key = _linked(keys[-1], stroke.key, f" {below_key}" if stroke.operation.reads_below_layer else "")
            results.append(result)
            keys.append(key)
        return StrokeKeys(tuple(keys), tuple(results))


@lru_cache(maxsize=MAX_LINKS)
def _linked(key: str, stroke_key: str, base: str) -> tuple[str, str]:
    """(name of a stroke's result on a state, name of the state after it); cached, as commands share most strokes."""
    result = digest(f"{key} {stroke_key}{base}")
    # Named as a layer in full would be (compose.py): within its layer every stroke counts in full.
    return result, digest(f"{result} 1.0 normal []")


@dataclass(frozen=True)
class StrokesState:
    """The Gaussians after some strokes of a layer."""

    state: LayerState
    changed: np.ndarray = field(repr=False)
    """[T] int64 ascending: Gaussians from below the layer that any stroke changed."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts of the latest stroke."""
    problems: tuple[str, ...] = ()
    """Why strokes change nothing, for those that do not."""
    results: tuple[str, ...] = field(default=(), repr=False)
    """Keys of the strokes' results."""

    def delta(self, below: LayerState) -> Delta:
        """What all strokes did to the state below the layer."""
        count, splats = len(below.splats), self.state.splats
        appended = splats.take(np.arange(count, len(splats)))
        parent_ids = ancestors(self.state, count)
        values, faded = changed_values(below.splats, splats, self.changed)
        return Delta(count, self.changed, values, without_source(appended), parent_ids, faded=faded)

    def layer_facts(self, layer: Layer, below: LayerState) -> dict[str, Any]:
        """Facts of the layer: the latest stroke's, and the counts of all."""
        facts = {**self.facts, "rows_touched": len(self.changed)}
        facts["rows_appended"] = len(self.state.splats) - len(below.splats)
        facts["stroke"] = {name: self.facts.get(name, 0) for name in ("rows_touched", "rows_appended", "seconds")}
        # One stroke that cannot be painted is a note; only where none can has the layer a problem.
        facts.pop("problem", None)
        if self.problems:
            which = f"{len(self.problems)} of {len(layer.strokes)} strokes cannot be painted here"
            facts["problem" if len(self.problems) == len(layer.strokes) else "note"] = f"{which}: {self.problems[0]}"
        return facts


@dataclass(frozen=True)
class FoldedStrokes:
    """One result in place of those of the first strokes."""

    keys: tuple[str, ...]
    """Keys of these strokes' states."""
    key: str
    result: LayerResult
    next_key: str
    """Key of the result of the stroke after them."""


class StrokeChains:
    """Composes layers that hold strokes."""

    def __init__(self, store: ResultStore, paint: Paint) -> None:
        self._store, self._paint = store, paint
        self._cache = Recent[StrokesState](
            CACHED_BYTES, lambda painted: nbytes(painted.state.splats), least=MIN_CACHED, most=MAX_CACHED
        )

    def state(self, key: str) -> LayerState | None:
        """A cached state after some stroke."""
        painted = self._cache.find(key)
        return None if painted is None else painted.state

    def painted(self, key: str) -> StrokesState | None:
        """What is cached of the strokes up to a state."""
        return self._cache.find(key)

    def compose(
        self,
        below: LayerState,
        layer: Layer,
        chain: StrokeKeys,
        strict: str | None,
        progress: Callable[[int], None],
    ) -> StrokesState:
        """The Gaussians after all strokes. strict: id of the stroke whose problem is an error; progress: called with
        the index of each stroke that has to be painted. Raises ValueError for the former, and what `progress` does."""
        count = len(layer.strokes)
        # From the latest state that is cached: undo asks for one before the last, painting for the last.
        # Found in the step that asks, for another thread may drop it in between.
        cached = ((k, self._cache.find(chain.keys[k])) for k in range(count, 0, -1))
        start, painted = next((entry for entry in cached if entry[1] is not None), (0, None))
        if painted is not None:
            # The layers below may be described otherwise than when it was cached.
            state = replace(painted.state, edited=below.edited, facts=below.facts, results=below.results)
            painted = replace(painted, state=state)
        else:
            start, painted = self._from_folded(below, chain)
        # From there on results that are stored are written in a row; one that has to be painted ends such a row.
        writer: _Writer | None = None
        for k in range(start, count):
            stroke = layer.strokes[k]
            result = self._store.get(chain.results[k])
            # A result for another number of Gaussians is of a damaged file, and painted again.
            at = len(painted.state.splats) if writer is None else writer.count
            if result is not None and result.delta.count == at:
                # One more stroke shares the arrays that it does not change; the writer would copy them all.
                if k == count - 1 and writer is None:
                    painted = _after(painted, below, result, chain, k + 1)
                    continue
                writer = writer or _Writer(painted, below)
                writer.write(result)
                # States in between are dropped: hundreds of strokes would be hundreds of copies.
                if k == count - 1 - CHECKPOINT_STROKES:
                    self._keep(writer.painted(chain, k + 1))
                continue
            if writer is not None:
                painted, writer = writer.painted(chain, k), None
            progress(k)
            result = self._paint(painted.state, stroke, below)
            if result.problem and stroke.id == strict:
                raise ValueError(result.problem)
            # It names the stroke before it, which a step then needs as well: a step lists the last result only.
            self._store.put(chain.results[k], result, chain.results[k - 1] if k else None)
            painted = _after(painted, below, result, chain, k + 1)
            self._keep(painted)
        if writer is not None:
            painted = writer.painted(chain, count)
        self._keep(painted)
        return painted

    def _from_folded(self, below: LayerState, chain: StrokeKeys) -> tuple[int, StrokesState]:
        """(strokes that one stored result stands for, the Gaussians after them), where the results of all others are
        stored; else none."""
        count = len(chain.results)
        # Strokes with results of their own are skipped from the end: only what is left can be the folded part.
        while count and self._store.has(chain.results[count - 1]):
            count -= 1
        # A folded result of other strokes has another name, so that a change before them is never shown as if it fit.
        result = self._store.get(folded_key(chain, count)) if count else None
        if result is None or result.delta.count != len(below.splats):
            return 0, StrokesState(below, np.zeros(0, np.int64))
        delta = result.delta
        # Facts and problems travel with the folded result: the strokes that could say them are not computed again.
        parent_ids = np.concatenate([below.parent_ids, delta.parent_ids])
        splats = delta.apply(below.splats)
        state = replace(below, key=chain.keys[count], splats=splats, parent_ids=parent_ids)
        if result.painter_state is not None:
            state = replace(state, painter_state=result.painter_state)
        facts = {name: value for name, value in result.facts.items() if name != PROBLEMS}
        problems = tuple(str(problem) for problem in result.facts.get(PROBLEMS, ()))
        return count, StrokesState(state, delta.gaussian_ids, facts, problems, (folded_key(chain, count),))

    def forget(self, results: set[str]) -> None:
        """Drop states that were made of results which are no longer stored."""
        self._cache.forget(lambda painted: bool(results.intersection(painted.results)))

    def _keep(self, painted: StrokesState) -> None:
        self._cache.put(painted.state.key, painted)


def folded_key(chain: StrokeKeys, count: int) -> str:
    """Name of the one result of the first `count` strokes."""
    return digest(f"{chain.keys[count]} folded")


def folded(painted: StrokesState, below: LayerState) -> LayerResult:
    """One result of all strokes so far."""
    facts = {**painted.facts, PROBLEMS: list(painted.problems)}
    return LayerResult(painted.delta(below), facts, painter_state=painted.state.painter_state)


def strokes_to_fold(results: Sequence[str], size_of: Callable[[str], int]) -> int:
    """How many of the first strokes are to become one result. results: their keys; size_of: bytes that one takes, 0
    where it is part of one already, as all before it are then."""
    total, count = 0, 0
    # From the latest back: those stay by themselves, and a size of 0 ends it, as all before is folded already.
    for latest, key in enumerate(reversed(results)):
        size = size_of(key)
        total += size
        if not count and total > LATEST_BYTES and latest >= MIN_LATEST:
            count = len(results) - latest
        if not size or (count and total > MAX_RESULT_BYTES):
            break
    return count if total > MAX_RESULT_BYTES else 0


def _after(
    painted: StrokesState, below: LayerState, result: LayerResult, chain: StrokeKeys, count: int
) -> StrokesState:
    """The state with one more stroke, number `count` of the chain."""
    delta, before = result.delta, painted.state
    splats = result.apply(before.splats)
    state = replace(
        before,
        key=chain.keys[count],
        splats=splats,
        parent_ids=np.concatenate([before.parent_ids, delta.parent_ids]),
        painter_state=before.painter_state if result.painter_state is None else result.painter_state,
    )
    # Gaussians that earlier strokes appended are the layer's own, and no change of what lies below it.
    ids = delta.gaussian_ids[: np.searchsorted(delta.gaussian_ids, len(below.splats))]
    changed = np.union1d(painted.changed, ids) if len(ids) else painted.changed
    problems = (*painted.problems, result.problem) if result.problem else painted.problems
    return StrokesState(state, changed, result.facts, problems, chain.results[:count])


class _Writer:
    """Writes stored results, one after the other, into one copy of the Gaussians."""

    def __init__(self, painted: StrokesState, below: LayerState) -> None:
        self._painted, self._below = painted, below
        # Copied once: the state that it starts from may be cached, and on the screen.
        splats = painted.state.splats
        self.count = len(splats)
        self._arrays = {name: getattr(splats, name).copy() for name in ATTRIBUTES}
        self._origin = None if splats.origin is None else splats.origin.copy()
        self._parents = [painted.state.parent_ids]
        self._changed = np.zeros(len(below.splats), bool)
        self._changed[painted.changed] = True
        self._problems = list(painted.problems)
        self._facts, self._painter_state = painted.facts, painted.state.painter_state

    def write(self, result: LayerResult) -> None:
        """Go on with a result whose count is `count`."""
        delta, count = result.delta, self.count
        end = count + len(delta.appended)
        self._grow(end)
        for name, array in self._arrays.items():
            ids, values = delta.written(name)
            array[ids] = values
            array[count:end] = getattr(delta.appended, name)
        if self._origin is not None:
            # The origin goes by way of parents, which may be Gaussians that an earlier stroke appended.
            parents = delta.parent_ids
            self._origin[count:end] = np.where(parents >= 0, self._origin[np.maximum(parents, 0)], -1)
        ids = delta.gaussian_ids
        self._changed[ids[: np.searchsorted(ids, len(self._changed))]] = True
        self._parents.append(delta.parent_ids)
        if result.problem:
            self._problems.append(result.problem)
        if result.painter_state is not None:
            self._painter_state = result.painter_state
        self.count, self._facts = end, result.facts

    def _grow(self, end: int) -> None:
        room = len(self._arrays["opacities"])
        if end <= room:
            return
        # With spare room, as appending one stroke after the other would copy everything each time.
        extra = max(end, int(room * (1 + SPARE_ROOM))) - room

        def longer(array: np.ndarray) -> np.ndarray:
            return np.concatenate([array, np.zeros((extra, *array.shape[1:]), array.dtype)])

        self._arrays = {name: longer(array) for name, array in self._arrays.items()}
        self._origin = None if self._origin is None else longer(self._origin)

    def painted(self, chain: StrokeKeys, count: int) -> StrokesState:
        """What was written so far, `count` strokes of the chain; it shares nothing with what is written later."""
        before = self._painted.state
        # Copied, as what is written later would else change a state that is cached under its key.
        arrays = {name: array[: self.count].copy() for name, array in self._arrays.items()}
        origin = None if self._origin is None else self._origin[: self.count].copy()
        splats = replace(before.splats, **arrays, origin=origin)
        state = replace(
            before,
            key=chain.keys[count],
            splats=splats,
            parent_ids=np.concatenate(self._parents),
            painter_state=self._painter_state,
        )
        changed = np.flatnonzero(self._changed)
        return StrokesState(state, changed, self._facts, tuple(self._problems), chain.results[:count])
