"""Several processes as one: torchrun's environment, DDP or FSDP2 around a task, and agreement about when to stop.

Gradients are averaged over processes, so that W processes with B / W samples each do the step that one process does
with B. Knows no model. One process needs none of it, and imports no torch.distributed.
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

Parallel = Literal["ddp", "fsdp"]


@dataclass(frozen=True)
class Group:
    """This process among all."""

    rank: int = 0
    world: int = 1
    device: torch.device = torch.device("cpu")

    @property
    def first(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process: all stop together."""
        return bool(self.total(torch.tensor(float(flag))) > 0)

    def total(self, values: Tensor) -> Tensor:
        """The sum over processes."""
        if self.world == 1:
            return values
        import torch.distributed as dist

        moved = values.detach().to(self.device).clone()
        dist.all_reduce(moved)
        return moved.to(values.device)

    def wait(self) -> None:
        """Wait until every process is here."""
        if self.world > 1:
            import torch.distributed as dist

            dist.barrier()

    def close(self) -> None:
        """Leave the group."""
        if self.world > 1:
            import torch.distributed as dist

            dist.destroy_process_group()


def join(device: str = "auto") -> Group:
    """The group that torchrun's environment describes (WORLD_SIZE, RANK, LOCAL_RANK), or this process alone.

    device: "auto" takes CUDA where there is one; processes of a machine share its GPUs by LOCAL_RANK. gloo on CPU,
    nccl on GPU. Raises ValueError for a device that is not there."""
    world, rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
    local = int(os.environ.get("LOCAL_RANK", 0))
    name = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    try:
        chosen = torch.device(name)
    except RuntimeError:
        raise ValueError(f"train: expected a device such as cpu, cuda or cuda:1, got {device!r}") from None
    if chosen.type == "cuda":
        if not torch.cuda.is_available():
            raise ValueError("train: no CUDA device here; use --device cpu, or install a CUDA build of torch")
        if chosen.index is None:
            chosen = torch.device("cuda", local % torch.cuda.device_count())
        torch.cuda.set_device(chosen)
    elif chosen.type != "cpu":
        raise ValueError(f"train: expected device cpu or cuda, got {device!r}")
    if world > 1:
        import torch.distributed as dist

        if not dist.is_initialized():
            dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    return Group(rank, world, chosen)


def spread(task: nn.Module, kind: Parallel, group: Group) -> nn.Module:
    """The task as all processes run it together; itself where there is one.

    fsdp: FSDP2. Transformer blocks that are called as modules are sharded one by one; all else, such as the fast
    weights, which are read outside of a forward, is one shard that is gathered for the whole step."""
    if group.world == 1:
        return task
    if kind == "fsdp":
        from torch.distributed.fsdp import fully_shard

        from splatpainter.nn.layers import PackedBlock

        for module in task.modules():
            if isinstance(module, PackedBlock):
                fully_shard(module)
        fully_shard(task)
        return task
    from torch.nn.parallel import DistributedDataParallel

    # Which weights a step uses depends on its sample: a global edit does not use the detail layer.
    return DistributedDataParallel(task, find_unused_parameters=True)


def quiet(task: nn.Module, last: bool) -> AbstractContextManager[Any]:
    """Inside, gradients are added up without talking to other processes, except for the last sample of a step."""
    if last or not hasattr(task, "no_sync"):
        if hasattr(task, "set_requires_gradient_sync"):
            task.set_requires_gradient_sync(last)  # type: ignore[operator]
        return nullcontext()
    return task.no_sync()  # type: ignore[operator]


def gathered(tensor: Tensor) -> Tensor:
    """A sharded tensor gathered (all processes must call it), any other as it is; on the CPU, detached."""
    gather = getattr(tensor, "full_tensor", None)
    return (gather() if gather is not None else tensor).detach().to("cpu")


def give(target: Tensor, value: Tensor) -> None:
    """Copy a whole tensor into one that may be sharded."""
    with torch.no_grad():
        if hasattr(target, "full_tensor"):
            from torch.distributed.tensor import distribute_tensor

            spread_out = distribute_tensor(value.to(target.device), target.device_mesh, target.placements)  # type: ignore[attr-defined]
            target.copy_(spread_out)
        else:
            target.copy_(value)
