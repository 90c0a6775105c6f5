"""Where methods find their networks: `--weights NAME=FOLDER`, or the weights that come with the packages."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from splatbench.cases import Budget
from splatbench.densification.densify_config import DensifyConfig
from splatpainter.models import weights as packaged
from splatpainter.models.checkpoint import INDEX
from splatpainter.models.config import ModelConfig
from splatpainter.models.local_config import LocalConfig

COMPACT = "compact"
"""The name under which the package's model is replaced."""
LATENTS = "latents"
"""The name of a model with LRM and Stage I, which what ships does without; one comes with the benches."""
BENCH_WEIGHTS = Path(__file__).parents[1] / "weights"
"""Folder of weights that come with the benches, beside those of splatpainter."""
VERSION = "1"
"""Version of how methods use their weights."""


@dataclass(frozen=True)
class Weights:
    """The weights that a method needs: where they are looked for, and what they must be."""

    names: tuple[str, ...] = (COMPACT,)
    """Keys of Budget.weights, the first that is there counts."""
    packaged: str = ""
    """Those of the package that serve where none of the names is given; "": none."""
    model: str = ""
    """What model it must be, in words."""
    fits: Callable[[Any], bool] = lambda _: True
    """Whether a config is that of such a model."""
    train: str = ""
    """Arguments of `splatpainter train` that make one."""
    config_class: type[ModelConfig] | type[DensifyConfig] | type[LocalConfig] = ModelConfig

    def folder(self, budget: Budget) -> Path | None:
        """Folder of the weights, or None."""
        for name in self.names:
            if name in budget.weights:
                return Path(budget.weights[name])
        return packaged.find(self.packaged, BENCH_WEIGHTS) if self.packaged else None

    def source(self, budget: Budget) -> str:
        """Which weights they are, in words."""
        given = next((f"weights '{name}'" for name in self.names if name in budget.weights), "")
        return given or f"the shipped weights of '{self.packaged}'"

    def missing(self, budget: Budget) -> str:
        """Why there are none that fit, or ""."""
        folder, name = self.folder(budget), self.names[0]
        if folder is None:
            how = f"train with `splatpainter train {self.train}`, then " if self.train else ""
            return f"no weights: {how}--weights {name}=FOLDER"
        try:
            config = self._described(folder)[0]
        except ValueError as error:
            return f"no weights: {self.source(budget)}: {error}"
        return "" if self.fits(config) else f"no weights: {self.source(budget)} are of no {self.model}"

    def version(self, budget: Budget) -> str:
        """Changes with the weights: of their config and the hashes of their files, which are checked when read."""
        folder = self.folder(budget)
        try:
            return f"{VERSION}-none" if folder is None else f"{VERSION}-{self._described(folder)[1]}"
        except ValueError:
            return f"{VERSION}-none"

    def config(self, budget: Budget) -> Any:
        """Config of the weights, without reading them. Raises ValueError where there are none that fit."""
        return self._described(self._existing(budget))[0]

    def load(self, budget: Budget) -> Any:
        """The network on the budget's device, read once per process. Raises ValueError where there is none that
        fits."""
        folder = self._existing(budget)
        return _loaded(str(folder), self._described(folder)[1], budget.device, self.config_class.format)

    def _existing(self, budget: Budget) -> Path:
        folder, problem = self.folder(budget), self.missing(budget)
        if folder is None or problem:
            raise ValueError(problem)
        return folder

    def _described(self, folder: Path) -> tuple[Any, str]:
        """(config, 16 hex digits that change with config or weights) of a checkpoint, without reading its weights.
        Raises ValueError, without the folder's name: tables are for people elsewhere."""
        try:
            index = json.loads((folder / INDEX).read_bytes())
            if index["format"] != self.config_class.format:
                raise ValueError(f"expected format '{self.config_class.format}', got {index['format']!r}")
            config = self.config_class.from_json(json.dumps(index["config"]), INDEX)
            parts = [index[key] for key in ("config", "tensors", "shards", "base") if key != "base" or key in index]
            text = json.dumps(parts, sort_keys=True)
        except OSError as error:
            raise ValueError(f"expected a folder with {INDEX} and its shards ({error.strerror})") from None
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"expected a {INDEX} of this version ({error})") from None
        return config, hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def _loaded(folder: str, digest: str, device: str, kind: str) -> Any:
    """digest: so that other weights in the same folder are read; kind: format of the config."""
    if kind == DensifyConfig.format:
        from splatbench.densification.densifier import Densifier as Network
    elif kind == LocalConfig.format:
        from splatpainter.models.local_network import LocalNetwork

        return LocalNetwork.load(folder)  # on the CPU, as edits by it are
    else:
        from splatpainter.models.model import SplatPainterModel as Network
    return Network.load(folder).to(device)


SHIPPED = Weights(packaged=COMPACT)
"""The model of the package, or the one in its place."""
