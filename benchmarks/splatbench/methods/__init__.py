"""Rows of the tables: every file here is one method, or one family that shares its settings.

A method is one function, `edit(task, budget) -> EditResult`: it gets what an artist's tool would get, never the truth,
and gives back the edited asset. Files list theirs in METHODS; `all_methods` reads them in the order of the tables.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from splatbench.cases import Budget, EditStep, PosedImages
from splatpainter.splats import Splats

MODULES = (
    "unedited",
    "lift",
    "lights",
    "ttt",
    "reconstruction",
    "color_fit",
    "gs3d",
    "srgs",
    "genden",
    "fit_to_truth",
    "ablations",
    "external",
)
"""Files of this folder, in the order of the tables."""
ALIASES = {"unedited": "nothing", "truth-fit": "oracle-fit", "truth-fit-all": "oracle-fit-all"}
"""Names that the command line takes as well -> names in records and tables."""


@dataclass(frozen=True)
class EditTask:
    """One edit to be made. Everything is as in `Case`; true_views is None except for methods that see the truth."""

    protocol: str
    asset: Splats = field(repr=False)
    """Numpy float32, N Gaussians. Not to be changed in place."""
    base: PosedImages
    step: EditStep
    true_views: PosedImages | None = None
    state: Any = None
    """`EditResult.state` of the step before, where there was one."""


@dataclass(frozen=True)
class EditResult:
    """Result of a method on one case."""

    splats: Splats = field(repr=False)
    """The edited asset; where the method keeps Gaussians, number i is still number i of the asset."""
    setup_seconds: float
    """Once per asset (encoding, fitting the unedited asset): the paper's first number."""
    edit_seconds: float
    """Per edit: its second one."""
    keeps_gaussians: bool = True
    """False: a new asset, so that "Gaussians untouched" means nothing."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Further figures of this method (Gaussians of stages, steps done, ...)."""
    note: str = ""
    """One line for the table's notes."""
    state: Any = None
    """State for the next step of the same case (a state of the network, an encoded asset)."""
    curve: tuple[tuple[float, int, Splats], ...] = field(default=(), repr=False)
    """(seconds since the start of the edit, steps done, asset then), with Budget.curve."""


@dataclass(frozen=True)
class Method:
    """A method: one row of the tables."""

    name: str
    """Name on the command line: lower case, no spaces."""
    label: str
    """Label in tables."""
    edit: Callable[[EditTask, Budget], EditResult]
    """Raises ValueError where it cannot do this task; any other exception is a crash. Both become a row's error."""
    protocols: tuple[str, ...]
    """Tables that it has a row in by default."""
    sees_truth: bool = False
    """It sees true edited views, which no artist has, so no table marks it as the best."""
    missing: Callable[[Budget], str] = lambda _: ""
    """Why it cannot run here ("not installed: ...", "needs a CUDA GPU", "no weights: ..."), or "". Cheap."""
    version: Callable[[Budget], str] = lambda _: "1"
    """Changes whenever results may: settings, digest of weights. Records of another version are made anew."""


def all_methods() -> dict[str, Method]:
    """Name -> method, in the order of the tables."""
    methods: dict[str, Method] = {}
    for module in MODULES:
        for method in import_module(f"{__name__}.{module}").METHODS:
            assert method.name not in methods, f"two methods are called {method.name}"
            methods[method.name] = method
    return methods


@dataclass
class Curve:
    """Quality against time of a method that takes steps: the asset after 10, 30, 100, 300, ... of them. Pass `watch` to
    fit.optimize. Taking a point is not counted as time."""

    enabled: bool
    """False: collects nothing."""
    start: float = field(default_factory=time.perf_counter)
    """Start of the edit, seconds."""
    overhead: float = 0.0
    """Seconds that taking points took."""
    points: list[tuple[float, int, Splats]] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Since the start, without the points."""
        return time.perf_counter() - self.start - self.overhead

    @property
    def watch(self) -> Callable[[int, Callable[[], Splats]], None] | None:
        """Function to be called after every step, counted from 1."""
        return self._take if self.enabled else None

    def _take(self, step: int, current: Callable[[], Splats]) -> None:
        if not is_curve_point(step):
            return
        seconds, now = self.seconds, time.perf_counter()
        self.points.append((seconds, step, current()))
        self.overhead += time.perf_counter() - now


def is_curve_point(step: int) -> bool:
    """Whether a step is one of 10, 30, 100, 300, 1000 and so on."""
    while step >= 100 and step % 10 == 0:
        step //= 10
    return step in (10, 30)
