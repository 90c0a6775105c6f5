"""Mutations that know numbers, bytes, text and JSON trees. Pure functions of a `random.Random`."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

T = TypeVar("T")

INTEGERS = (0, 1, -1, 2, 3, 4, 5, 7, 8, 15, 16, 63, 64, 127, 128, 255, 256, 257, 1023, 65535, 65536, 10**6, 10**7)
INTEGERS += (2**24, 2**27, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53 + 1, 2**63 - 1, 2**63, 2**64 - 1, 10**15, 10**30)
FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 3.4e38, -3.4e38, 1e-45, 1e-38, 88.8, -88.8, 104.0)
FLOATS += (-104.0, 1e30, -1e30, 1e18, 1e9, 1.0, -1.0, 0.5, 1.0000001, 1e5)
TOKENS = (b"nan", b"inf", b"-inf", b"1e999", b"-1e999", b"1e-999", b"0x10", b"1_000", b"--1", b"+1", b".", b"", b"1e38")
TOKENS += (b"9" * 400, b"1e40", b"-0", b"1.", b".5", b"NaN", b"\xff", b"a", b"1,5", b"1e5000", b"\x00", b"3.4028236e38")
TEXTS = ("", "a", "\x00", "\n", "../x", "/", "\\", "C:\\x", "é", "\u2028", "\ud800", "\x1b[2J", "nan", "1e999", "con")
TEXTS += ("x" * 300, "%s%n", "{}", "' OR 1=1 --", "null", "1", "-1", "0" * 70, "KHR_gaussian_splatting", ".", "..")


def few(rng: random.Random, most: int = 6) -> int:
    """1 most often, up to `most`."""
    return min(most, 1 + int(rng.expovariate(0.9)))


def maybe(rng: random.Random, chance: float) -> bool:
    return rng.random() < chance


def bend_integer(rng: random.Random, value: int) -> int:
    """Near the value, or an integer at which programs fail."""
    kind = rng.randrange(6)
    if kind == 0:
        return value + rng.choice((-2, -1, 1, 2))
    if kind == 1:
        return value * rng.choice((2, 3, 256, 1000)) + rng.choice((-1, 0, 1))
    if kind == 2:
        return value // 2
    if kind == 3:
        return -value
    return rng.choice(INTEGERS)


def bend_bytes(rng: random.Random, data: bytes, low: int = 0, high: int | None = None, moves: bool = True) -> bytes:
    """Some changes of a few bytes between `low` and `high`; moves: also what changes the length."""
    out = bytearray(data)
    for _ in range(few(rng)):
        top = len(out) if high is None else min(high, len(out))
        if top <= low:
            break
        at = rng.randrange(low, top)
        action = rng.randrange(10 if moves else 6)
        if action == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif action == 1:
            out[at] = rng.randrange(256)
        elif action == 2:
            _put(out, at, struct.pack("<I", rng.choice(INTEGERS) & 0xFFFFFFFF))
        elif action == 3:
            _put(out, at & ~3, struct.pack("<f", rng.choice(FLOATS)))
        elif action == 4:
            _put(out, at, rng.choice((b"\xff", b"\0")) * rng.choice((1, 2, 4, 8, 32)))
        elif action == 5:
            size = rng.choice((1, 2, 4, 16, 64))
            source = rng.randrange(len(out))
            _put(out, at, bytes(out[source : source + size]))
        elif action == 6:
            del out[at : at + rng.choice((1, 1, 2, 4, 12, 32, 100))]
        elif action == 7:
            out[at:at] = rng.randbytes(rng.choice((1, 1, 2, 4, 32)))
        elif action == 8:
            out[at:at] = out[at : at + rng.choice((1, 4, 32, 256))]
        else:
            del out[at:]
    return bytes(out)


def _put(out: bytearray, at: int, piece: bytes) -> None:
    out[at : at + len(piece)] = piece[: len(out) - at]


def bend_floats(rng: random.Random, data: bytes, order: str = "<") -> bytes:
    """Some aligned float32 words become extreme ones; the length stays."""
    out = bytearray(data)
    if len(out) >= 4:
        for _ in range(few(rng)):
            at = 4 * rng.randrange(len(out) // 4)
            struct.pack_into(order + "f", out, at, rng.choice(FLOATS))
    return bytes(out)


def bend_fields(rng: random.Random, data: bytes, fields: Sequence[tuple[str, int]]) -> bytes:
    """Some of the little-endian fields (struct code, offset) take other values."""
    out = bytearray(data)
    for _ in range(few(rng, 4)):
        code, at = rng.choice(fields)
        size = struct.calcsize("<" + code)
        if at + size > len(out):
            continue
        if code in "fd":
            struct.pack_into("<" + code, out, at, rng.choice(FLOATS))
        else:
            value = bend_integer(rng, struct.unpack_from("<" + code, out, at)[0])
            out[at : at + size] = (value % (1 << (8 * size))).to_bytes(size, "little")
    return bytes(out)


def bend_list(rng: random.Random, items: list[T]) -> list[T]:
    """Entries dropped, doubled or exchanged."""
    out = list(items)
    if not out:
        return out
    at, other = rng.randrange(len(out)), rng.randrange(len(out))
    action = rng.randrange(4)
    if action == 0:
        del out[at]
    elif action == 1:
        out.insert(other, out[at])
    elif action == 2:
        out[at], out[other] = out[other], out[at]
    else:
        del out[at:]
    return out


def hostile_value(rng: random.Random) -> Any:
    """Any JSON value that a reader may not expect."""
    kind = rng.randrange(9)
    if kind == 0:
        return rng.choice((None, True, False))
    if kind == 1:
        return rng.choice(([], {}, [[]], {"": None}, [None], [0, 0, 0], {"a": {"b": []}}))
    if kind == 2:
        return rng.choice(FLOATS)
    if kind in (3, 4):
        return rng.choice(TEXTS)
    if kind == 5:
        deep: Any = rng.choice(([], {}, 1))
        for _ in range(rng.choice((2, 30, 200))):
            deep = [deep] if rng.random() < 0.5 else {"children": deep}
        return deep
    if kind == 6:
        return [rng.choice(INTEGERS)] * rng.choice((1, 2, 3, 4, 16, 300))
    return rng.choice(INTEGERS)


def bend_json(rng: random.Random, tree: Any, hints: Sequence[Any] = ()) -> Any:
    """The tree with some of its nodes changed (in place where it can be). hints: values worth trying anywhere."""
    for _ in range(few(rng, 4)):
        spots = list(_spots(tree))
        if not spots:
            return hostile_value(rng)
        holder, key = rng.choice(spots)
        value = holder[key]
        action = rng.randrange(10)
        if action == 0:
            del holder[key]
        elif action == 1 and isinstance(holder, list):
            holder.insert(key, json.loads(json.dumps(value)))
        elif action == 1:
            holder[rng.choice((*TEXTS, str(key) + "_", str(key).upper()))] = value
        elif action == 2:
            other, there = rng.choice(spots)
            if there in other if isinstance(other, dict) else there < len(other):
                holder[key] = json.loads(json.dumps(other[there]))
        elif action in (3, 4, 5) and type(value) in (int, float):
            holder[key] = bend_integer(rng, value) if type(value) is int else rng.choice(FLOATS)
        elif action == 6 and hints:
            holder[key] = json.loads(json.dumps(rng.choice(hints)))
        elif action == 7 and isinstance(value, str):
            holder[key] = _bend_text(rng, value)
        else:
            holder[key] = hostile_value(rng)
    return tree


def _spots(tree: Any) -> Any:
    # Of a long list (a codebook) the first entries are enough; otherwise hardly anything else would be bent.
    pairs: Any = tree.items() if isinstance(tree, dict) else enumerate(tree[:8]) if isinstance(tree, list) else ()
    for key, value in pairs:
        yield tree, key
        if isinstance(value, dict | list):
            yield from _spots(value)


def _bend_text(rng: random.Random, value: str) -> str:
    at = rng.randrange(len(value) + 1)
    return value[:at] + rng.choice(TEXTS) + value[at + rng.randrange(3) :]


def json_bytes(rng: random.Random, tree: Any) -> bytes:
    """JSON text of the tree; at times text that only looks like it."""
    text = json.dumps(tree).encode()
    if not maybe(rng, 0.12):
        return text
    tricks: tuple[Callable[[], bytes], ...] = (
        lambda: b"\xef\xbb\xbf" + text,
        lambda: text.decode().encode("utf-16"),
        lambda: text.replace(b":", b":" + b"[" * 5000, 1),
        lambda: b"[" * 100_000,
        lambda: text.replace(b"0", b"9" * 5000, 1),
        lambda: text.replace(b"1", b"NaN", 1),
        lambda: text.replace(b"1", b"-Infinity", 1),
        lambda: text.replace(b"1", b"1e400", 1),
        lambda: text.replace(b"{", b'{"count": 1e400, ', 1),
        lambda: text + text,
        lambda: text[: rng.randrange(len(text) + 1)],
        lambda: text.replace(b'"', b'"\xff\xfe', 1),
        lambda: text.replace(b'"', b'"\\ud800', 1),
        lambda: bend_bytes(rng, text),
        lambda: b"",
    )
    return rng.choice(tricks)()
