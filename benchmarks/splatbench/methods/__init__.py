"""Rows of the tables: every file here is one method, or one family that shares its settings.

A method is one function, `edit(work, budget) -> Done`: it gets what an artist's tool would get, never the truth, and
gives back the edited asset. Files list theirs in METHODS; `all_methods` reads them in the order of the tables.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.cases import Pictures, Step
from splatpainter.splats import ATTRIBUTES, Splats

MODULES = (
    "nothing",
    "lift",
    "learned",
    "transfer",
    "optimized",
    "srgs",
    "genden",
    "oracle",
    "stage_one",
    "ablations",
    "external",
)
"""Files of this folder, in the order of the tables."""


@dataclass(frozen=True)
class Budget:
    """What a method may spend, and where it finds what it needs; the same for every row of a run."""

    steps: int = 1000
    """Of methods that optimise."""
    device: str = "cpu"
    """"cpu" or "cuda"."""
    seed: int = 0
    weights: dict[str, str] = field(default_factory=dict)
    """Name of a model -> folder of its weights, for rows that need other weights than the shipped ones, e.g.
    {"compact": ..., "genden": ..., "cross-attention": ..., "latent-query": ...}."""
    adapters: Path | None = None
    """TOML file that says how systems outside this package are called; None: none is installed."""
    scratch: Path | None = None
    """Folder for a method's own files; None: it makes a temporary one."""
    curve: bool = False
    """Methods that take many steps also return what they had on the way (Done.curve)."""


@dataclass(frozen=True)
class Work:
    """One edit to be made. Everything is as in `Case`; oracle is None except for methods that are upper bounds."""

    protocol: str
    asset: Splats = field(repr=False)
    """Numpy float32, N rows. Not to be changed in place."""
    base: Pictures
    step: Step
    oracle: Pictures | None = None
    memory: Any = None
    """`Done.memory` of the step before, where there was one."""


@dataclass(frozen=True)
class Done:
    """What a method made of it."""

    splats: Splats = field(repr=False)
    """The edited asset; where the method keeps rows, row i is still row i of the asset."""
    setup_seconds: float
    """Once per asset (encoding, fitting the unedited asset): the paper's first number."""
    edit_seconds: float
    """Per edit: its second one."""
    keeps_rows: bool = True
    """False: a new asset, so that "rows untouched" means nothing."""
    numbers: dict[str, float] = field(default_factory=dict)
    """Further figures of this method (row counts of stages, steps done, ...)."""
    note: str = ""
    """One line for the table's notes."""
    memory: Any = None
    """For the next step of the same case (a state, an encoded asset)."""
    curve: tuple[tuple[float, int, Splats], ...] = field(default=(), repr=False)
    """(seconds since the start of the edit, steps done, asset then), with Budget.curve."""


@dataclass(frozen=True)
class Method:
    """A row."""

    name: str
    """On the command line: lower case, no spaces."""
    label: str
    """In tables."""
    edit: Callable[[Work, Budget], Done]
    """Raises ValueError where it cannot do this work; any other exception is a crash. Both become a row's error."""
    protocols: tuple[str, ...]
    """Tables that it has a row in by default."""
    oracle: bool = False
    """An upper bound that sees true edited views."""
    missing: Callable[[Budget], str] = lambda _: ""
    """Why it cannot run here ("not installed: ...", "needs a CUDA GPU", "no weights: ..."), or "". Cheap."""
    version: Callable[[Budget], str] = lambda _: "1"
    """Changes whenever results may: settings, digest of weights. Records of another version are made anew."""


def all_methods() -> dict[str, Method]:
    """Name -> method, in the order of the tables."""
    found: dict[str, Method] = {}
    for module in MODULES:
        for method in import_module(f"{__name__}.{module}").METHODS:
            assert method.name not in found, f"two methods are called {method.name}"
            found[method.name] = method
    return found


def changed(before: Splats, after: Splats) -> np.ndarray:
    """[N] bool rows of `before` (N) of which an attribute has other bits in the same row of `after` (at least N)."""
    touched = np.zeros(len(before), bool)
    for name in ATTRIBUTES:
        a, b = (np.ascontiguousarray(getattr(splats.numpy(), name), np.float32) for splats in (before, after))
        if a.shape[1:] != b.shape[1:]:
            return np.ones(len(before), bool)
        same = a.view(np.int32) == b[: len(a)].view(np.int32)
        touched |= np.logical_not(same.reshape(len(a), -1).all(1))
    return touched
