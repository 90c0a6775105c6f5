"""Results of layers as rows of a project file: written and read."""

from __future__ import annotations

import json
import sqlite3
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.replay.delta import Delta, encode
from splatpainter.session.replay.layer_result import LayerResult

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from splatpainter.models.edits_in_turn import EditsSoFar
    from splatpainter.models.refine import RefineState

FACT_KINDS: dict[str, type | tuple[type, ...]] = {
    "rows_touched": int,
    "rows_appended": int,
    "seconds": (int, float),
    "method": str,
    "note": str,
    "problem": str,
    "preset": str,
    "views": list,
}
"""Facts of a result that others read, and what they are."""


def store_result(db: sqlite3.Connection, key: str, result: LayerResult, previous: str | None) -> None:
    """Write a result, in place of the one that the key may have. previous: key of the result that it goes on from."""
    state = None if result.painter_state is None else _pack_state(result.painter_state)
    confidence = None if result.confidence is None else result.confidence.tobytes()
    if previous is None:  # stored again: what it needs is what it needed
        row = db.execute("SELECT previous FROM results WHERE key = ?", (key,)).fetchone()
        previous = None if row is None else row[0]
    db.execute("DELETE FROM results WHERE key = ?", (key,))
    # The parts follow their result: they go with it when it is deleted.
    values = (key, json.dumps(result.facts), confidence, state, previous)
    db.execute("INSERT INTO results (key, facts, confidence, state, previous) VALUES (?, ?, ?, ?, ?)", values)
    for part, data in enumerate(encode(result.delta)):
        db.execute("INSERT INTO deltas VALUES (?, ?, ?)", (key, part, data))


def loaded_result(delta: Delta, facts: str, confidence: bytes | None, state: bytes | None) -> LayerResult:
    """The result of which these are the columns. Raises ValueError, TypeError, RecursionError: damaged."""
    values = None if confidence is None else np.frombuffer(confidence, np.uint8)
    # Damage is found here, where it only means that the result is computed anew.
    count = delta.count + len(delta.appended)
    if values is not None and len(values) != count:
        raise ValueError(f"{len(values)} values of confidence for {count} Gaussians")
    return LayerResult(delta, _facts(facts), values, None if state is None else _unpack_state(state))


def _pack_state(state: RefineState) -> bytes:
    """What a painter has learnt as safetensors, never pickle: tensors named block.K.w0, .w1, .w2 (fast weights) or
    block.K (tokens); detail likewise; so_far.moved, and of the pictures picture.K.left, .mask and .camera (JSON)."""
    import torch
    from safetensors.torch import save

    named = {}
    blocks = [(f"block.{k}", block) for k, block in enumerate(state.blocks)]
    for name, block in [*blocks, ("detail", state.detail)]:
        if block is None:
            continue
        parts = {f"{name}.{k}": v for k, v in block._asdict().items()} if hasattr(block, "_asdict") else {name: block}
        named |= {key: value.detach().cpu().contiguous().clone() for key, value in parts.items()}
    if state.so_far is not None:
        arrays = {"so_far.moved": state.so_far.moved}
        for k, picture in enumerate(state.so_far.pictures):
            camera = np.frombuffer(picture.camera.to_json().encode(), np.uint8)
            parts = {"left": picture.left, "mask": picture.mask, "camera": camera}
            arrays |= {f"picture.{k}.{part}": values for part, values in parts.items()}
        named |= {name: torch.from_numpy(values.copy()) for name, values in arrays.items()}
    return save(named)


def _unpack_state(data: bytes) -> RefineState:
    """The inverse of `_pack_state`, on the CPU. Raises ValueError for other bytes."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    from splatpainter.models.refine import RefineState
    from splatpainter.nn.fast_weights import FastWeights

    try:
        named = load(data)

        def block(name: str):
            if name in named:
                return named[name]
            return FastWeights(*(named[f"{name}.{part}"] for part in FastWeights._fields))

        count = len({key.split(".")[1] for key in named if key.startswith("block.")})
        detail = block("detail") if any(key.split(".")[0] == "detail" for key in named) else None
        return RefineState(tuple(block(f"block.{k}") for k in range(count)), detail, _edits_so_far(named))
    except (SafetensorError, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"project: the painter's state is damaged ({error!r})") from None


def _edits_so_far(named: Mapping[str, Tensor]) -> EditsSoFar | None:
    """None where there were none, and in files of before their pictures were stored: the next edit then starts from the
    asset as it is. Raises KeyError, ValueError for other tensors."""
    from splatpainter.models.edits_in_turn import EditPicture, EditsSoFar

    if "so_far.moved" not in named:
        return None
    count, pictures = len({key.split(".")[1] for key in named if key.startswith("picture.")}), []
    for k in range(count):
        left, mask, camera = (named[f"picture.{k}.{part}"].numpy() for part in ("left", "mask", "camera"))
        view = Camera.from_json(camera.tobytes().decode())
        if left.shape != (view.height, view.width, 3) or mask.shape != left.shape[:2]:
            raise ValueError(f"picture {k} has shapes {left.shape} and {mask.shape} for {view.width}x{view.height}")
        pictures.append(EditPicture(view, left, mask))
    return EditsSoFar(named["so_far.moved"].numpy(), tuple(pictures))


def _facts(text: str) -> dict[str, Any]:
    """Facts of a result. Raises ValueError where one that others read is not what it should be."""
    facts = json.loads(text)
    if not isinstance(facts, dict):
        raise ValueError("its facts are not a JSON object")
    # Facts are shown and compared by others, who must not meet what a stranger wrote.
    for name, kind in FACT_KINDS.items():
        value = facts.get(name, kind() if isinstance(kind, type) else 0)
        if not isinstance(value, kind) or (isinstance(value, (int, float)) and not 0 <= value < 1e15):
            raise ValueError(f"unexpected {name} {value!r:.40}")
    for view in facts.get("views", ()):
        if not isinstance(view, dict):
            raise ValueError(f"unexpected view {view!r:.40}")
        scores = [view.get(name) for name in ("psnr_before", "psnr_after", "psnr_outside")]
        if not all(score is None or (isinstance(score, (int, float)) and abs(score) < 1e15) for score in scores):
            raise ValueError(f"unexpected scores {scores!r:.80}")
    return facts
