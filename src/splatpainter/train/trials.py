"""The samples that a trained model is judged on: objects held out of training, kinds in fixed shares.

Which samples these are depends on the data, the sample recipe and a seed alone, never on a model: checkpoints judged
with equal ones see the same samples, and a longer list begins with the shorter one. Knows no model.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatpainter.data.shard_stream import ShardStream
from splatpainter.train.training_data import Supply, is_shards

if TYPE_CHECKING:
    from splatpainter.data.samples import Sample

MANY_VIEWS = "relight"
"""The kind that is judged with several numbers of edited views."""


@dataclass(frozen=True)
class Trial:
    """One sample of the list."""

    number: int
    """Its place in the list, from 0."""
    kind: str
    sample: Sample | str
    """Or why there is none."""


def trials(supply: Supply, kinds: Mapping[str, float], count: int, most_views: int) -> Iterator[Trial]:
    """`count` samples of objects held out of training, made one at a time. kinds: kind -> weight; most_views: edited
    views of every "relight" sample (in shards: of those that have them). Raises ValueError where no object is held
    out, or none of the kinds can be made of this data."""
    stream = _held(supply)
    if is_shards(supply.data):
        streams = {kind: found for kind in kinds if (found := _shards_of(supply, kind)) is not None}
    else:
        streams = {kind: _only(stream, kind, most_views) for kind in kinds if kind in stream.kinds}
    if not streams:
        raise ValueError(f"--data {supply.data}: none of the kinds {', '.join(kinds)} can be made of it")
    order = apportioned({kind: kinds[kind] for kind in streams}, count)
    done = dict.fromkeys(streams, 0)
    for number, kind in enumerate(order):
        source = streams[kind]
        # Shards hold the samples of an object one after another: strides reach other objects.
        place = done[kind] * max(len(source) // order.count(kind), 1) if isinstance(source, ShardStream) else number
        done[kind] += 1
        try:
            made: Sample | str = source[place]
        except ValueError as error:
            made = str(error)
        yield Trial(number, kind, made)


def apportioned(weights: Mapping[str, float], count: int) -> list[str]:
    """`count` names in proportion to their weights > 0, mixed: each next one is the name with the largest weight /
    (2 given + 1) (Webster's method), so that every beginning of the list is in proportion too."""
    given = dict.fromkeys(weights, 0)
    order = []
    for _ in range(count):
        name = max(weights, key=lambda n: weights[n] / (2 * given[n] + 1))
        given[name] += 1
        order.append(name)
    return order


def first_views(sample: Sample, count: int) -> Sample:
    """The same edit shown from `count` of its V edited views, evenly spread over them: views go around the object in
    order, so 2 of 4 face each other, and 1 is among these 2."""
    total = len(sample.edited.cameras)
    assert 1 <= count <= total
    kept = [k * total // count for k in range(count)]
    edited = dataclasses.replace(
        sample.edited, cameras=tuple(sample.edited.cameras[k] for k in kept), colors=sample.edited.colors[kept]
    )
    return dataclasses.replace(sample, edited=edited, masks=sample.masks[kept])


def _held(supply: Supply) -> Any:
    stream = supply.stream(held=True)
    if stream is None:
        raise ValueError(
            f"--data {supply.data}: no object of it is held out of training "
            f"(a share of {supply.share:g} of {supply.counts()[0]}); give more objects"
        )
    return stream


def _only(stream: Any, kind: str, most_views: int) -> Any:
    """The stream with samples of one kind alone. It shares what is remembered of objects with the first one."""
    own = copy.copy(stream)
    own.kinds = {kind: 1.0}
    if kind == MANY_VIEWS:
        own.recipe = dataclasses.replace(stream.recipe, views=(0.0,) * (most_views - 1) + (1.0,))
    return own


def _shards_of(supply: Supply, kind: str) -> Any:
    """The samples of one kind in shards, or None where they hold none of it."""
    recipe = dataclasses.replace(supply.recipe, kinds={kind: 1.0})
    try:
        return dataclasses.replace(supply, recipe=recipe).stream(held=True)
    except ValueError:
        return None
