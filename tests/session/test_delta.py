"""Sparse deltas: what goes in comes out, damage is noticed, and a viewer that follows them has the asset."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import zstandard

from splatpainter.session.replay.delta import (
    MAX_VERSIONS,
    PART_BYTES,
    AssetDelta,
    VersionLog,
    between,
    decode,
    encode,
    no_delta,
)
from splatpainter.session.replay.layer_blending import blend_delta
from splatpainter.splats import Splats, changed_rows
from tests.support.lift_scenes import same_bits
from tests.support.session_scenes import asset


def edited(splats: Splats, seed: int) -> Splats:
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(splats), 5, replace=False)
    sh, means = splats.sh.copy(), splats.means.copy()
    sh[rows] = rng.normal(size=sh[rows].shape)
    means[rows[:2]] += 1
    result = replace(splats, sh=sh, means=means)
    return result.append(result.take(rng.choice(len(splats), int(rng.integers(0, 4)))))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_round_trip(degree, seed):
    before = asset(6, degree)
    before.means[2] = np.nan  # equals itself
    after = edited(before, seed)
    parents = np.arange(len(after) - len(before)) - 1
    delta = between(before, after, parents)
    again = decode(encode(delta))
    assert same_bits(again.apply(before), after) and same_bits(delta.apply(before), after)
    np.testing.assert_array_equal(again.parent_ids, parents)
    np.testing.assert_array_equal(again.gaussian_ids, delta.gaussian_ids)


def test_a_base_travels_with_it():
    before = asset(6, 1)
    after = edited(before, 2)
    delta = between(before, after)
    base = np.random.default_rng(0).normal(size=(len(delta.gaussian_ids) + len(delta.appended), 4, 3))
    delta = replace(delta, base=base.astype(np.float32))
    parts = list(encode(delta))
    again = decode(parts)
    assert again.base is not None and same_bits(again.apply(before), after)
    np.testing.assert_array_equal(again.base, delta.base)
    plain = list(encode(replace(delta, base=None)))
    assert len(plain) == len(parts) - 1 and decode(plain).base is None
    for damaged in ([plain[0], *parts[1:]], [parts[0], *plain[1:]], [*parts[:-1], parts[1]]):
        with pytest.raises(ValueError, match=r"^delta: damaged \(.*\)$"):
            decode(damaged)


def test_another_layout_is_refused():
    parts = list(encode(between(asset(6), asset(6))))
    head = json.loads(zstandard.decompress(parts[0]))
    parts[0] = zstandard.compress(json.dumps(head | {"version": head["version"] + 1}).encode())
    with pytest.raises(ValueError, match=r"^delta: damaged \(unknown layout "):
        decode(parts)


@pytest.mark.parametrize("base", [False, True])
def test_of_gaussians_that_only_fade_the_opacity_alone_is_stored(base: bool):
    before = asset(7, 2)
    emptied = replace(before, opacities=before.opacities.copy())
    emptied.opacities[5:35] = 0
    after = replace(emptied, means=emptied.means.copy(), sh=emptied.sh.copy()).append(asset(2, 2))
    after.means[30:34] += 1
    after.sh[2, 8, 1] = -after.sh[2, 8, 1]
    delta = between(before, after, np.array([-1, 5, 6, 6]))
    assert delta.faded is not None
    np.testing.assert_array_equal(delta.gaussian_ids[delta.faded], [*range(5, 30), 34])
    if base:
        delta = replace(delta, base=np.ones((len(delta.gaussian_ids) + 4, 9, 3), np.float32))
    parts = list(encode(delta))
    again = decode(parts)
    full = delta.complete(before)
    assert sum(map(len, parts)) < 0.6 * sum(map(len, encode(replace(full, faded=None))))
    assert same_bits(again.apply(before), after)
    assert same_bits(again.complete(before).values, full.values) and same_bits(again.appended, delta.appended)
    assert same_bits(full.values, after.take(delta.gaussian_ids))
    assert (again.base is not None) == base
    assert list(encode(again)) == parts == list(encode(again.complete(before)))
    half = [blend_delta(before, one, 0.5).apply(before) for one in (delta, again)]
    assert same_bits(*half)
    for damaged in ([*parts[:3], parts[2], *parts[4:]], parts[:3] + parts[4:]):
        with pytest.raises(ValueError, match=r"^delta: damaged \(.*\)$"):
            decode(damaged)


def test_minus_zero_and_nan_payloads_survive():
    before = asset(3)
    after = replace(before, sh=before.sh.copy())
    after.sh[1, 0] = np.array([-0.0, 0.0, 1], np.float32)
    before = replace(before, sh=before.sh.copy())
    before.sh[1, 0] = np.array([0.0, 0.0, 1], np.float32)
    odd = np.array([0x7FC00123], np.uint32).view(np.float32)
    after.sh[2, 1, 0] = odd[0]
    assert same_bits(decode(encode(between(before, after))).apply(before), after)


def test_what_did_not_change_is_shared():
    before = asset()
    after = replace(before, sh=before.sh + 1)
    result = between(before, after).apply(before)
    assert result.means is before.means and result.sh is not before.sh
    assert no_delta(before).apply(before) is before


def test_children_carry_the_origin_of_their_parents():
    before = replace(asset(4), origin=np.arange(16))
    after = before.append(before.take(np.array([5, 9])))
    once = between(before, after, np.array([5, 9])).apply(before)
    assert once.origin is not None and once.origin[16:].tolist() == [5, 9]
    twice = between(once, once.append(once.take(np.array([16]))), np.array([17])).apply(once)
    assert twice.origin is not None and twice.origin[18:].tolist() == [9]


def test_large_deltas_travel_in_bounded_parts():
    before = asset(90, 3)
    delta = between(before, replace(before, sh=before.sh + 1))
    parts = list(encode(delta))
    assert len(parts) > 4
    unpack = zstandard.ZstdDecompressor()
    assert max(len(unpack.decompress(part)) for part in parts) <= PART_BYTES
    assert same_bits(decode(iter(parts)).apply(before), replace(before, sh=before.sh + 1))


def test_damage_is_one_line():
    before = asset(5)
    parts = list(encode(between(before, edited(before, 1))))
    flipped = parts[-1][:-3] + bytes([parts[-1][-3] ^ 1]) + parts[-1][-2:]
    head = zstandard.compress(b'{"version": 1, "count": 1000000000000, "rows": 5, "appended": 0, "coefficients": 4}')
    wrong_rows = zstandard.compress(np.array([30, -4, 1, 1, 1], "<i8").tobytes())
    bomb = zstandard.compress(bytes(64 * PART_BYTES))
    cases = [
        parts[:-1],
        [bomb],
        [parts[0], bomb],
        [*parts, parts[-1]],
        [*parts[:-1], flipped],
        [head, *parts[1:]],
        [b"x"],
        [],
    ]
    cases.append([parts[0], wrong_rows, *parts[2:]])
    for case in cases:
        with pytest.raises(ValueError, match=r"^here: damaged \(.*\)$"):
            decode(case, "here")


def followed(previous: Splats, delta: AssetDelta) -> Splats:
    """What a viewer makes of it."""
    arrays = {}
    for name in ("means", "quats", "scales", "opacities", "sh"):
        retained_values = getattr(previous, name)[: delta.retained].copy()
        retained_values[delta.gaussian_ids] = getattr(delta.values, name)
        arrays[name] = np.concatenate([retained_values, getattr(delta.appended, name)])
    return Splats(**arrays)


def test_viewers_of_any_version_catch_up():
    rng = np.random.default_rng(0)
    changes, versions = VersionLog(), [asset(6)]
    for version in range(2, 40):
        now = versions[-1]
        after = edited(versions[int(rng.integers(0, len(versions)))], version) if rng.random() < 0.5 else edited(now, 1)
        changes.note(version, now, after)
        versions.append(after)
    for since in range(1, 40):
        delta = changes.since(since, 39, versions[-1])
        assert delta.since == since
        assert same_bits(followed(versions[since - 1], delta), versions[-1])


def test_only_what_changed_travels_and_strangers_get_everything():
    changes, now = VersionLog(), asset(6)
    for version in range(2, MAX_VERSIONS + 10):
        after = replace(now, sh=now.sh.copy())
        after.sh[version % 36] += 1
        changes.note(version, now, after)
        now = after
    last = MAX_VERSIONS + 9
    near = changes.since(last - 3, last, now)
    assert near.since == last - 3 and len(near.gaussian_ids) == 3 and len(near.appended) == 0 and near.retained == 36
    assert len(changes.since(last, last, now).gaussian_ids) == 0
    for unknown in (None, 1, last + 5, -4):
        everything = changes.since(unknown, last, now)
        assert everything.since is None and everything.retained == 0 and len(everything.appended) == 36
    assert not len(changed_rows(now, now))
