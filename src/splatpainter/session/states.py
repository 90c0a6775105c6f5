"""What a painter has learnt (fast weights) as bytes: safetensors, never pickle. Imports torch only when used."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatpainter.models.refine import RefineState


def pack_state(state: RefineState) -> bytes:
    """Tensors named block.K.w0, .w1, .w2 (fast weights) or block.K (tokens); detail likewise."""
    from safetensors.torch import save

    named = {}
    for name, memory in [*((f"block.{k}", own) for k, own in enumerate(state.blocks)), ("detail", state.detail)]:
        if memory is None:
            continue
        parts = (
            {f"{name}.{k}": v for k, v in memory._asdict().items()} if hasattr(memory, "_asdict") else {name: memory}
        )
        named |= {key: value.detach().cpu().contiguous().clone() for key, value in parts.items()}
    return save(named)


def on_device(state: RefineState, device: object) -> RefineState:
    """The same state on a torch device."""

    def moved(memory):
        if memory is None:
            return None
        return type(memory)(*(part.to(device) for part in memory)) if isinstance(memory, tuple) else memory.to(device)

    return replace(state, blocks=tuple(moved(own) for own in state.blocks), detail=moved(state.detail))


def unpack_state(data: bytes) -> RefineState:
    """The inverse of `pack_state`, on the CPU. Raises ValueError for other bytes."""
    from safetensors import SafetensorError
    from safetensors.torch import load

    from splatpainter.models.refine import RefineState
    from splatpainter.nn.fast_weights import FastWeights

    try:
        named = load(data)

        def memory(name: str):
            if name in named:
                return named[name]
            return FastWeights(*(named[f"{name}.{part}"] for part in FastWeights._fields))

        count = len({key.split(".")[1] for key in named if key.startswith("block.")})
        detail = memory("detail") if any(key.split(".")[0] == "detail" for key in named) else None
        return RefineState(tuple(memory(f"block.{k}") for k in range(count)), detail)
    except (SafetensorError, KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"project: the painter's state is damaged ({error!r})") from None
