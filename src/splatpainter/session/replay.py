"""The asset as a pure function of its original and its layers. Knows no file and no history.

Results of layers are cached under what they depend on: the original, everything below, and the layer's content, which
names the painter that it was made with.

    level = replay.compose(document)        # from the nearest level that is still known

Where something below a layer changed, and nothing of what the layer read there, its result is moved, not painted again
(reads.py).

A layer that cannot be applied where it now stands (hidden, reordered or reshaped layers below it took its rows away)
changes nothing and says why; it is kept, and works again when they return.
"""

from __future__ import annotations

import json
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from splatpainter.painter import Edit, Painter
from splatpainter.session import erase, looks
from splatpainter.session.adapter import Adapter, fingerprint
from splatpainter.session.blend import mixed
from splatpainter.session.conflicts import Touch, strengths
from splatpainter.session.deltas import Delta, between, no_delta
from splatpainter.session.layers import Document, Layer, View, digest
from splatpainter.session.pictures import decode_mask, decode_picture
from splatpainter.session.read_set import Read, moved, read_of
from splatpainter.splats import ATTRIBUTES, Splats

KEPT = 1 << 28
"""Bytes of composed assets that are kept to start from, ..."""
MOST_KEPT = 64
"""... and how many at most."""
WITHIN = "within"
"""Name of the parameter {"within": true} of layers of mode global: only rows that their views' masks reach change."""
STANDS = 4
"""Arrangements that are remembered of each layer, ..."""
MOST_STANDS = 1024
"""... of so many layers, ..."""
READ_ROWS = 1 << 23
"""... and the rows that they read, in all."""


@dataclass(frozen=True)
class Painted:
    """What a layer wants on the rows below it, before opacity and blend."""

    delta: Delta = field(repr=False)
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON for people: rows_touched, rows_appended, seconds, method, note, views [{psnr_...}], problem."""
    confidence: np.ndarray | None = field(default=None, repr=False)
    """[N + A] uint8, of a global edit."""
    state: Any = field(default=None, repr=False)
    """What the painter has learnt so far (fast weights), where it learns."""

    @property
    def problem(self) -> str:
        """Why the layer changes nothing; "" where it works."""
        return self.facts.get("problem", "")


class Cache(Protocol):
    """Where pictures and results of layers are kept."""

    def blob(self, sha256: str) -> bytes: ...
    def get(self, key: str) -> Painted | None: ...
    def put(self, key: str, painted: Painted) -> None: ...


@dataclass(frozen=True)
class Level:
    """The asset after some layers."""

    key: str
    """Hash of everything it depends on."""
    splats: Splats
    """`origin`: the original's row that each comes from."""
    parents: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """Of the rows appended to the original: the row that each was split from, -1: none."""
    touches: tuple[Touch, ...] = ()
    facts: tuple[tuple[str, dict[str, Any]], ...] = ()
    """(layer id, Painted.facts) of the visible layers."""
    results: tuple[str, ...] = ()
    """Keys of the cached results it was made of."""
    state: Any = field(default=None, repr=False)


Progress = Callable[[int, int, str], None]
"""(layers done, layers in all, name of the one in work); what it raises ends the work, and nothing has changed."""


class Replay:
    """Composes documents over one original."""

    def __init__(
        self,
        original: Splats,
        painter: Painter,
        cache: Cache,
        table: Mapping[str, looks.LookFunction],
    ) -> None:
        """original: with `origin`; table: looks by name."""
        self.original, self.painter, self.looks = original, painter, table
        self._cache = cache
        self._adapter = Adapter(original, painter)
        self._levels: OrderedDict[str, Level] = OrderedDict()
        self._stands: OrderedDict[str, dict[str, str]] = OrderedDict()
        """Key of a layer -> {key of the level below: key of its result}, the latest last."""
        self._reads: OrderedDict[tuple[str, str], Read | None] = OrderedDict()
        """(key of the level below, key of a layer) -> what it reads there."""
        self.ground = Level(digest(f"original {original.sha256}"), original)

    def compose(self, document: Document, progress: Progress | None = None, strict: str | None = None) -> Level:
        """The asset of a document. strict: id of the layer whose problem is an error (one that is being added).
        Raises ValueError for it, and whatever `progress` raises."""
        shown = [leaf for layer in document.layers if _matters(layer) for leaf in _parts(layer)]
        level = self.ground
        for k, layer in enumerate(document.layers):
            if _matters(layer):
                level = self._over(level, layer, document, strict, progress, (k, len(shown)))
        return level

    def _over(self, below: Level, layer: Layer, document: Document, strict, progress, at) -> Level:
        if layer.kind == "merged":
            return self._group(below, layer, document, strict, progress, at)
        strength, depends = strengths(below.touches, layer, document, len(below.splats))
        result = digest(f"{below.key} {layer.key}")
        key = digest(f"{result} {layer.opacity!r} {layer.blend} {json.dumps(depends)}")
        found = self._known(key, below, layer, result)
        if found is not None:
            return found
        if progress is not None:
            progress(*at, layer.name)
        stored = layer.kind != "look" or any(view.picture for view in layer.views)
        painted = self._cache.get(result) if stored else None
        if painted is None or painted.delta.count != len(below.splats):  # the latter: of a damaged file
            painted = self._moved(below, layer) or self._try(below, layer)
            if painted.problem and layer.id == strict:
                raise ValueError(painted.problem)
            if stored:
                self._cache.put(result, painted)
        self._stood(below, layer, result)
        delta = mixed(below.splats, painted.delta, layer.opacity, layer.blend, strength)
        splats = delta.apply(below.splats)
        span = (len(below.splats), len(splats))
        confidence = painted.confidence if painted.confidence is None else _fit(painted.confidence, len(splats))
        level = Level(
            key,
            splats,
            np.concatenate([below.parents, delta.parents]),
            (*below.touches, Touch(layer, result, painted.delta.rows, span, confidence)),
            (*below.facts, (layer.id, painted.facts)),
            (*below.results, result) if stored else below.results,
            below.state if painted.state is None else painted.state,
        )
        self._keep(level)
        return level

    def _group(self, below: Level, layer: Layer, document: Document, strict, progress, at) -> Level:
        """The layers of a merged one, then its own opacity and blend over all they did."""
        level = below
        for inner in layer.layers:
            if _matters(inner):
                level = self._over(level, inner, document, strict, progress, at)
        own = level.facts[len(below.facts) :]
        facts = (*below.facts, (layer.id, _summed([facts for _, facts in own])), *own)
        if (layer.opacity, layer.blend) == (1, "normal"):
            return replace(level, facts=facts)
        delta = between(below.splats, level.splats, _hosts(level, len(below.splats)))
        splats = mixed(below.splats, delta, layer.opacity, layer.blend).apply(below.splats)
        key = digest(f"{below.key} merged {level.key} {layer.opacity!r} {layer.blend}")
        return replace(level, key=key, splats=splats, facts=facts)

    def _stood(self, below: Level, layer: Layer, result: str) -> None:
        """Remember where a layer's result can be had from."""
        if not self._reads_little(layer):
            return
        stands = self._stands.setdefault(layer.key, {})
        self._stands.move_to_end(layer.key)
        stands.pop(below.key, None)
        stands[below.key] = result
        if len(stands) > STANDS:
            del stands[next(iter(stands))]
        if len(self._stands) > MOST_STANDS:
            self._stands.popitem(last=False)

    def _moved(self, below: Level, layer: Layer) -> Painted | None:
        """A layer's result of another arrangement, where it read the same there; None: it has to be painted."""
        for key, result in reversed(self._stands.get(layer.key, {}).items()):
            old = self._read(key, layer)
            now = self._read(below.key, layer, below) if old is not None else None
            if old is None or now is None or old.digest != now.digest:
                continue
            painted = self._cache.get(result)
            if painted is None or painted.problem:
                continue
            delta = moved(painted.delta, old, now, len(below.splats))
            if delta is not None:
                return replace(painted, delta=delta)
        return None

    def _read(self, key: str, layer: Layer, level: Level | None = None) -> Read | None:
        """What a layer reads of a level; None where that cannot be said (any more)."""
        place = (key, layer.key)
        if place not in self._reads:
            level = level or (self.ground if key == self.ground.key else self._levels.get(key))
            if level is None:
                return None
            (view,) = layer.views
            grid = self._adapter.grid(level.splats)
            self._reads[place] = read_of(level.splats, grid, view.camera, self.mask(view))
        self._reads.move_to_end(place)
        found = self._reads[place]
        while len(self._reads) > 1 and sum(len(read.rows) for read in self._reads.values() if read) > READ_ROWS:
            self._reads.popitem(last=False)
        return found

    def _reads_little(self, layer: Layer) -> bool:
        """Whether reads.py knows what a layer reads: one masked view, lifted locally by the analytic painter."""
        painted = layer.mode == "local" and layer.method == "lift" and layer.kind in ("paint", "picture", "clone")
        return painted and type(self.painter) is Painter and len(layer.views) == 1 and layer.views[0].mask is not None

    def _try(self, below: Level, layer: Layer) -> Painted:
        start = time.perf_counter()
        try:
            painted = self.paint(below, layer)
        except ValueError as error:
            return Painted(no_delta(below.splats), {"problem": str(error)})
        facts: dict[str, Any] = {"rows_touched": len(painted.delta.rows), "rows_appended": len(painted.delta.appended)}
        facts["seconds"] = round(time.perf_counter() - start, 4)
        return replace(painted, facts={**facts, **painted.facts})

    def paint(self, below: Level, layer: Layer) -> Painted:
        """What a layer wants on a level; nothing is cached. Raises ValueError where it cannot be applied."""
        splats = below.splats
        if layer.kind == "erase":
            rows = erase.reached(splats, [(view.camera, self.mask(view)) for view in layer.views])
            return Painted(erase.erased(splats, self.original, rows))
        if layer.kind == "look" and not any(view.picture for view in layer.views):
            graded = replace(splats, sh=looks.recolored(splats.sh, layer.parameters, self.looks))
            if layer.views:
                rows = erase.reached(splats, [(view.camera, self.mask(view)) for view in layer.views])
                graded = _within(rows, splats, graded)
            return Painted(between(splats, graded))
        return self._apply(below, layer)

    def _apply(self, below: Level, layer: Layer) -> Painted:
        edits = [self._edit(view, layer) for view in layer.views]
        numbered, done = self._adapter.apply(below.splats, below.state, edits, layer.mode, layer.method)
        parents = None if done.splats.origin is None else done.splats.origin[len(numbered) :]
        facts: dict[str, Any] = {}
        if done.receipt is not None:
            record = json.loads(done.receipt.to_json())
            names = ("method", "preset", "note", "views", "precision")
            facts = {name: record[name] for name in names if name in record}
            facts["stages"] = record["seconds"]
        if layer.painter != fingerprint(self.painter, layer.method):
            facts["note"] = "; ".join(
                filter(None, [facts.get("note"), "computed by another painter than it was made with"])
            )
        certain = None if done.confidence is None else (np.clip(done.confidence, 0, 1) * 255 + 0.5).astype(np.uint8)
        state = None if done.encoding is None else done.encoding.state
        splats = done.splats
        if layer.mode == "global" and layer.parameters.get(WITHIN):
            splats = _within(self._reached(below, layer), below.splats, splats)
        return Painted(between(numbered, splats, parents), facts, certain, state)

    def _reached(self, below: Level, layer: Layer) -> np.ndarray:
        """[N] bool: rows that the masks of a layer's views reach."""
        views = [(view.camera, self.mask(view)) for view in layer.views if view.mask is not None]
        if not views:
            raise ValueError(f"layer {layer.name!r}: expected a mask in one of its views to stay within")
        return erase.reached(below.splats, views)

    def _edit(self, view: View, layer: Layer) -> Edit:
        assert view.picture is not None, "a painted layer has pictures"
        where = f"layer {layer.name!r}"
        image = decode_picture(self._cache.blob(view.picture), view.camera, where, self.original.color_space)
        return Edit(image, view.camera, None if view.mask is None else self.mask(view), layer.name)

    def mask(self, view: View) -> np.ndarray:
        """[H, W] bool mask of a view; all of it where it has none."""
        if view.mask is None:
            return np.ones((view.camera.height, view.camera.width), bool)
        return decode_mask(self._cache.blob(view.mask), view.camera, "mask")

    def prepare(self, level: Level) -> None:
        """Make what a local edit of a level needs before anything else."""
        self._adapter.grid(level.splats)

    def forget(self, results: set[str]) -> None:
        """Drop levels that were made of results which are no longer stored."""
        for key in [key for key, level in self._levels.items() if results.intersection(level.results)]:
            del self._levels[key]

    def _known(self, key: str, below: Level, layer: Layer, result: str) -> Level | None:
        """A level that is still at hand. Its touches and facts name layers by id, which its key does not hold."""
        level = self._levels.get(key)
        if level is None:
            return None
        self._levels.move_to_end(key)
        touch = replace(level.touches[-1], layer=layer)
        return replace(
            level,
            touches=(*below.touches, touch),
            facts=(*below.facts, (layer.id, level.facts[-1][1])),
        )

    def _keep(self, level: Level) -> None:
        self._levels[level.key] = level
        size = sum(getattr(level.splats, name).nbytes for name in ATTRIBUTES)
        while len(self._levels) > max(min(KEPT // max(size, 1), MOST_KEPT), 1):
            self._levels.popitem(last=False)


def _within(rows: np.ndarray, below: Splats, above: Splats) -> Splats:
    """`above` on some rows ([N] bool), `below` on the others; attributes in which nothing differs are shared."""
    kept = {}
    for name in ATTRIBUTES:
        old, new = getattr(below, name), getattr(above, name)
        kept[name] = old if old is new else np.where(rows.reshape(-1, *[1] * (old.ndim - 1)), new, old)
    return replace(above, **kept)


def _matters(layer: Layer) -> bool:
    return layer.visible and layer.opacity > 0


def _parts(layer: Layer) -> list[Layer]:
    return [layer] if not layer.layers else [part for inner in layer.layers for part in _parts(inner)]


def _hosts(level: Level, count: int) -> np.ndarray:
    """[A] the row among the first `count` that each later one was split from, over any number of splits."""
    first = len(level.splats) - len(level.parents)
    hosts = level.parents[count - first :].copy()
    while (late := hosts >= count).any():
        hosts[late] = level.parents[hosts[late] - first]
    return hosts


def _fit(confidence: np.ndarray, count: int) -> np.ndarray:
    return np.pad(confidence, (0, max(count - len(confidence), 0)), constant_values=255)[:count]


def _summed(facts: list[dict[str, Any]]) -> dict[str, Any]:
    names = ("rows_touched", "rows_appended", "seconds")
    return {name: sum(entry.get(name, 0) for entry in facts) for name in names}
