"""Two processes do what one does with the same batch: DDP and FSDP2 over gloo."""

from __future__ import annotations

import csv
import multiprocessing
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from splatpainter.models import checkpoint
from splatpainter.system import processes
from splattrain.build import make_task
from splattrain.distributed import join
from splattrain.loop import sample_numbers
from tests.support.train_scenes import RECIPE, loop, model

STEPS = 2
ONCE = replace(RECIPE, steps=STEPS)
KINDS = ("ddp", "fsdp")


def work(out: Path, rank: int) -> None:
    """What each process of the test runs."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
    torch.set_num_threads(1)
    group = join("cpu")
    for kind in KINDS:
        loop(replace(ONCE, parallel=kind), out / kind, group=group)()  # type: ignore[arg-type]
    group.close()


def all_runs(out: Path) -> int:
    """One process, then both together, forked where the system can: torch is imported, kernels are loaded and samples
    are made once for them. Returns how many failed."""
    import torch._dynamo  # noqa: F401
    import torch.distributed.fsdp  # noqa: F401

    torch.set_num_threads(1)
    loop(ONCE, out / "one")()
    context: Any = multiprocessing.get_context("fork" if hasattr(os, "fork") else "spawn")
    ranks = [context.Process(target=work, args=(out, rank)) for rank in range(2)]
    for process in ranks:
        process.start()
    for process in ranks:
        process.join()
    return sum(process.exitcode != 0 for process in ranks)


def losses(out: Path) -> list[float]:
    with open(out / "log.csv", newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    root = Path(__file__).parents[2]
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}
    shared |= {
        "SPLATPAINTER_THREADS": "1",
        "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")]),
    }
    code = "import sys; from pathlib import Path; from train.tests.test_distributed import all_runs; "
    code += "sys.exit(all_runs(Path(sys.argv[1])))"
    # A process of its own: forking this one, with its threads, would not be sound.
    command = [sys.executable, "-c", code, str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = processes.begin(command, env={**os.environ, **shared}, **pipes)
    try:
        output = process.communicate(timeout=180)[0]
    finally:
        processes.end(process)
    assert process.returncode == 0, output[-3000:]
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_two_processes_are_one(runs: Path, kind: str) -> None:
    one, two = losses(runs / "one"), losses(runs / kind)
    assert len(one) == STEPS and len(set(one)) == STEPS
    torch.testing.assert_close(torch.tensor(two), torch.tensor(one), rtol=2e-4, atol=1e-7)
    a, b = (checkpoint.load(runs / name / "state").tensors for name in ("one", kind))
    assert a.keys() == b.keys()
    start = dict(make_task(ONCE, model(ONCE.model, ONCE.seed), None, lambda line: None).named_parameters())
    # All updates as one vector: Adam makes whole steps of gradients that are nothing but rounding.
    apart, moved = 0.0, 0.0
    for name, value in a.items():
        if name.startswith("weight/"):
            first = start[name.removeprefix("weight/")].detach()
            moved += float((value - first).double().square().sum())
            apart += float((value - b[name]).double().square().sum())
    assert moved > 0 and apart < 0.01**2 * moved, (apart / moved) ** 0.5


def test_numbers_follow_from_the_step_alone() -> None:
    for step in range(9):
        complete = sample_numbers(step, 4, 3)
        assert [*sample_numbers(step, 4, 3, 0, 2), *sample_numbers(step, 4, 3, 1, 2)] == complete
        assert len({number // 3 for number in complete}) == 4  # each lane on an object of its own
    lane = [sample_numbers(step, 4, 3)[1] for step in range(6)]
    assert [number // 3 for number in lane] == [1, 1, 1, 5, 5, 5]
    every = sorted(n for step in range(6) for n in sample_numbers(step, 4, 3))
    assert every == list(range(24))  # nothing twice, nothing left out


def test_a_batch_that_cannot_be_shared_is_refused(tmp_path: Path) -> None:
    from splattrain.distributed import Group

    with pytest.raises(ValueError, match="batch that 3 processes can share evenly, got 2"):
        loop(ONCE, tmp_path, group=Group(0, 3))


def test_a_device_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for name, message in (("cuda", "no CUDA device"), ("cupboard", "expected a device"), ("meta", "cpu or cuda")):
        with pytest.raises(ValueError, match=message):
            join(name)
    assert join().device.type == "cpu"
