"""A table and methods so small that a run takes seconds, for the tests of the runner; this file run as a program is
the child process that knows them too.

The asset is 8 Gaussians; its colour bits are what methods change, and the score is read from them, so that every figure
is known by hand. Where a test wants trouble, it writes NAME into the folder given by the environment variable TROUBLE.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from splatbench import methods
from splatbench import tables as protocols
from splatbench.cases import Budget, Case, CaseKey, EditStep, PosedImages, Setup
from splatbench.methods import EditResult, EditTask, Method
from splatbench.tables import Column

from splatpainter.cameras import Camera
from splatpainter.splats import Splats

ROWS = 8
VARIABLE = "SPLATPAINTER_TEST_TROUBLE"


def trouble(name: str) -> bool:
    """Whether a test asked for it; a file of this name is taken away, so that it happens once."""
    path = Path(os.environ[VARIABLE]) / name
    return path.exists() and (path.unlink() or True)


def count(what: str) -> None:
    """Leave a mark that something was done."""
    (Path(os.environ[VARIABLE]) / f"done.{what}.{time.time_ns()}").touch()


def counted(what: str) -> int:
    return len(list(Path(os.environ[VARIABLE]).glob(f"done.{what}.*")))


def asset(seed: int) -> Splats:
    rng = np.random.default_rng(seed)
    draw = lambda *shape: rng.uniform(0.1, 0.9, shape).astype(np.float32)  # noqa: E731
    return Splats(draw(ROWS, 3), draw(ROWS, 4), draw(ROWS, 3), draw(ROWS), draw(ROWS, 1, 3))


def pictures(level: float, number: int = 2) -> PosedImages:
    camera = Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4))
    return PosedImages((camera,) * number, np.full((number, 4, 4, 3), level, np.float32))


class Toy:
    """Objects toy-0, toy-1, ...; each with a case of one edit and one of two."""

    name = "toy"
    title = "A toy"
    columns = (Column("sum", "Sum", "", "higher"), Column("lpips", "LPIPS", "", "lower", 4))
    split_by = "edits"

    def keys(self, setup: Setup) -> list[CaseKey]:
        names = [f"toy-{k}" for k in range(min(setup.objects, 5))]
        return [CaseKey(f"{name}-{edits}", name, {"edits": edits}) for name in names for edits in (1, 2)]

    def make(self, key: CaseKey, setup: Setup) -> Case:
        count(f"make-{key.label}")
        if trouble(f"kill-make-{key.label}"):
            os.kill(os.getpid(), 9)  # SIGKILL; on Windows TerminateProcess
        if (Path(os.environ[VARIABLE]) / f"broken-{key.name}").exists():
            raise ValueError(f"{key.name}: a broken mesh")
        number = int(key.name.removeprefix("toy-"))
        edits = key.settings["edits"]
        step = EditStep("local", "stroke", pictures(0.75, 1), np.ones((1, 4, 4), bool))
        return Case(
            protocol=self.name,
            name=key.name,
            label=key.label,
            asset=asset(number + setup.seed),
            base=pictures(0.5),
            steps=(step,) * edits,
            before=pictures(0.5),
            after=pictures(1.0),
            near=np.array([True, False]),
            true_views=pictures(1.0),
            facts={"edits": edits, "number": number},
        )

    def score(self, case: Case, done: Sequence[EditResult], perceptual: Any | None) -> dict[str, float | None]:
        """How much the opacities of the edited asset grew, in all."""
        grown = done[-1].splats.opacities[:ROWS].sum() - case.asset.opacities.sum()
        return {"sum": float(round(float(grown), 3)), "lpips": None if perceptual is None else 0.5}

    def pictures(self, case: Case, done: Sequence[EditResult]) -> dict[str, Any]:
        return {"result": np.full((4, 4, 3), 0.25, np.float32), "truth": case.after.colors[0]}


def grow(work: EditTask, budget: Budget) -> EditResult:
    """One more Gaussian is made heavier by 1 at every edit; the Gaussian's number is the number of edits before."""
    assert work.true_views is None, "only methods that say so see the truth"
    count("grow")
    print("methods may print")
    number = work.state or 0
    opacities = work.asset.opacities.copy()
    opacities[number] += 1
    if trouble("slow"):
        time.sleep(60)
    if trouble("swap"):
        (Path(os.environ[VARIABLE]) / "swapped").touch()
    if trouble("kill"):
        os.kill(os.getpid(), 9)
    made = replace(work.asset, opacities=opacities)
    half = replace(work.asset, opacities=opacities - np.float32(0.5) * (np.arange(ROWS) == number).astype(np.float32))
    curve = ((0.5, 10, half), (1.0, 20, made)) if budget.curve else ()
    return EditResult(made, 0.25, 1.0, numbers={"edits": number + 1}, note="grows", state=number + 1, curve=curve)


def raising(work: EditTask, budget: Budget) -> EditResult:
    raise RuntimeError("no such thing\nas two lines")


def cheating(work: EditTask, budget: Budget) -> EditResult:
    work.asset.opacities[:] = 1
    return EditResult(work.asset, 0.0, 0.0)


def bound(work: EditTask, budget: Budget) -> EditResult:
    """Of the truth: a new asset of other Gaussians."""
    assert work.true_views is not None and work.true_views.colors.max() == 1
    return EditResult(replace(asset(7).append(asset(8)), opacities=np.full(2 * ROWS, 3.0, np.float32)), 0, 2, False)


def dying(work: EditTask, budget: Budget) -> EditResult:
    os._exit(3)


def version(budget: Budget) -> str:
    """Of "grow": as its weights are called, and other ones once they are swapped."""
    return budget.weights.get("grow", "1") + ("+" if (Path(os.environ[VARIABLE]) / "swapped").exists() else "")


METHODS = (
    Method("grow", "Grow", grow, ("toy",), version=version),
    Method("raising", "Raising", raising, ("toy",)),
    Method("cheating", "Cheating", cheating, ()),
    Method("dying", "Dying", dying, ()),
    Method("absent", "Absent", grow, ("toy",), missing=lambda _: "not installed: put it there"),
    Method("bound", "Bound", bound, ("toy",), sees_truth=True),
)


def register(patch: Any = None) -> None:
    """Make them the package's own; patch: pytest's monkeypatch."""
    put = setattr if patch is None else patch.setattr
    toy = Toy()
    put(protocols, "table", lambda _: toy)
    put(methods, "all_methods", lambda: {method.name: method for method in METHODS})


if __name__ == "__main__":
    from splatbench import runner

    register()
    runner.work(ready=lambda: None)
