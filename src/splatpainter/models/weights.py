"""Where weights are: trained ones of the presets, or a folder that the user names. Knows no torch until it loads."""

from __future__ import annotations

import os
import threading
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from splatpainter.extras import require
from splatpainter.models import checkpoint
from splatpainter.models.checkpoint import INDEX, PACKAGED
from splatpainter.models.config import PRESETS
from splatpainter.models.local_config import LocalConfig
from splatpainter.models.stored_predictor import StoredPredictor, checked

if TYPE_CHECKING:
    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel

VARIABLE = "SPLATPAINTER_WEIGHTS"
"""Environment variable: a folder with one folder of weights per preset, looked into before the package."""
LOCAL = "local"
"""Name of the weights of the local network (models/local_network.py)."""
NAMES = (*PRESETS, "rows")
"""Names under which weights are found: the presets, and "rows": `compact` without its predictor, so that Stage II is
the only carrier of global edits (models/edit_propagation.py), as the paper has it."""


def weight_folders(preset: str) -> list[Path]:
    """Folders that may hold the weights of a preset, in the order in which they are tried."""
    named = os.environ.get(VARIABLE, "")
    return [Path(root) / preset for root in ([named] if named else [])] + [PACKAGED / preset]


def find(preset: str, *more_roots: Path) -> Path | None:
    """The folder with the weights of a preset, or None. more_roots: folders like PACKAGED, tried last."""
    # The user's own folder first: weights trained later take the place of those in the package.
    folders = weight_folders(preset) + [root / preset for root in more_roots]
    return next((folder for folder in folders if (folder / INDEX).is_file()), None)


PREDICTOR = "predictor."
"""Beginning of the names of the predictor's tensors, which have a shard of their own."""


class _DeferredLocal:
    """A local network of which config and notes are known, and which is read when anything else is asked for."""

    def __init__(self, folder: Path) -> None:
        self.config = checkpoint.config(folder, LocalConfig)
        self.notes = checkpoint.notes(folder)
        self._folder, self._reading = folder, threading.Lock()

    @cached_property
    def _network(self) -> LocalNetwork:
        require("torch", f"preset '{LOCAL}'")
        from splatpainter.models.local_network import LocalNetwork

        return LocalNetwork.load(self._folder)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        with self._reading:
            network = self._network
        return getattr(network, name)


class _Deferred:
    """A model of which config, notes and the stored predictor are known, and whose networks are read when anything else
    is asked for: torch and weights are seconds that an edit by the lift should not wait for, and may not be there."""

    def __init__(self, folder: Path) -> None:
        # The index alone says whether networks are needed at all, and it is small.
        self.config, self.notes = checkpoint.config(folder), checkpoint.notes(folder)
        self._folder, self._reading = folder, threading.Lock()

    @cached_property
    def stored_predictor(self) -> StoredPredictor | None:
        """As of SplatPainterModel. Raises ValueError for weights that are damaged."""
        # Its shard is read by itself and without torch, as global edits by the predictor need nothing else.
        if not self.config.predict.features:
            return None
        return checked(checkpoint.load_arrays(self._folder, PREDICTOR), str(self._folder))

    @cached_property
    def _model(self) -> SplatPainterModel:
        from splatpainter.models.model import SplatPainterModel

        return SplatPainterModel.load(self._folder)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        with self._reading:
            model = self._model
        return getattr(model, name)


def deferred(preset: str) -> SplatPainterModel | None:
    """The model of a preset, its weights not yet read; None where there are none. What is wrong with the weights is
    said when they are first needed. Raises ValueError for an index that is not that of a model."""
    folder = find(preset)
    return None if folder is None else cast("SplatPainterModel", _Deferred(folder))


def deferred_local(folder: Path | None = None) -> LocalNetwork | None:
    """The local network of a folder, by default the packaged one, not yet read; None where there is none. Raises
    ValueError for an index that is not that of one."""
    folder = find(LOCAL) if folder is None else folder
    return None if folder is None else cast("LocalNetwork", _DeferredLocal(folder))


def is_local(folder: Path) -> bool:
    """Whether a folder holds a local network."""
    return (folder / INDEX).is_file() and checkpoint.format_of(folder) == LocalConfig.format


def load_all(preset: str) -> tuple[SplatPainterModel | None, LocalNetwork | None]:
    """The networks of a preset or folder: the model, and the network of local edits; of "local" and of a folder that
    holds a local network, that alone. Raises ValueError as `load`."""
    folder = find(LOCAL) if preset == LOCAL else Path(preset)
    if preset == LOCAL and folder is None:
        raise ValueError(f"preset '{LOCAL}': no trained weights; train them (train rows --recipe paint), or use 'lift'")
    # A local network makes no global edits: those stay the lift's.
    if folder is not None and preset not in NAMES and is_local(folder):
        return None, deferred_local(folder)
    return load(preset), deferred_local()


def load(preset: str) -> SplatPainterModel:
    """The model of a preset with its trained weights, or of the checkpoint in a folder; its own config always wins.

    Raises ValueError: neither a preset nor a folder, no weights there, weights of another preset than the name says,
    and as SplatPainterModel.load."""
    if preset in NAMES:
        folder = find(preset)
        if folder is None:
            root = os.environ.get(VARIABLE) or f"a folder that {VARIABLE} names"
            what = f"put {INDEX} and its shards into '{preset}' in {root}, or use 'lift'"
            raise ValueError(f"preset '{preset}': no trained weights; {what}")
    else:
        folder = Path(preset)
        if not folder.is_dir():
            choices = ", ".join(["auto", "lift", *NAMES, LOCAL])
            raise ValueError(f"preset: expected one of {choices}, or a folder of weights, got {preset!r}")
    require("torch", f"preset '{preset}'")
    from splatpainter.models.model import SplatPainterModel

    return SplatPainterModel.load(folder, preset if preset in NAMES else None)
