"""Put trained weights into the packages: python scripts/ship_weights.py RUN/model

A model that `train rows --recipe compact` has made becomes presets `compact` (the predictor's shard in the core, the
rest in networks/) and `rows` (the same tensors without the predictor); a local network (`--recipe paint`) becomes
preset `local`. What was judged of a predictor stays where it is the same one; all else is judged anew:
`splatpainter train judge src/splatpainter/weights/NAME --write-notes ...`.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from splatpainter.models import checkpoint, weights
from splatpainter.models.checkpoint import INDEX, SHARD_NAME
from splatpainter.models.config import ModelConfig
from splatpainter.models.local_config import LocalConfig
from splattrain import state

ROOT = Path(__file__).resolve().parents[1]
CORE, NETWORKS = ROOT / "src/splatpainter/weights", ROOT / "networks/src/splatpainter_networks"
PREDICTOR = weights.PREDICTOR
SHARED = ("lrm.", "compressor.", "refiner.", "head.")


def ship(source: Path, core: Path = CORE, networks: Path = NETWORKS) -> list[str]:
    """Write; the names of the presets. source: OUT/model of a run. Raises ValueError for weights that do not ship."""
    local = weights.is_local(source)
    held: Any = checkpoint.load(source, kind=LocalConfig if local else ModelConfig)
    # What a card says of a run is beside the weights, and they leave the run here.
    record = state.record(source, held.notes)
    notes = held.notes | {key: record[key] for key in ("loss",) if key in record}
    with TemporaryDirectory() as folder:
        made = Path(folder)
        if local:
            checkpoint.save(made / "local", held.config, held.tensors, notes=notes)
        else:
            _model(made, held.config, held.tensors, notes, core)
        for preset in sorted(made.iterdir()):
            _install(preset, core / preset.name, networks / preset.name)
        return sorted(preset.name for preset in made.iterdir())


def _model(made: Path, config: ModelConfig, tensors: dict[str, Any], notes: dict[str, Any], core: Path) -> None:
    """Folders `compact` and `rows`."""
    if not config.predictor_only or config.edits_locally:
        raise ValueError("ship: expected a predictor and a Stage II of train rows --recipe compact")
    shipped = checkpoint.load_arrays(core / "compact", PREDICTOR) if (core / "compact" / INDEX).is_file() else {}
    same = bool(shipped) and all((tensors[PREDICTOR + name].numpy() == array).all() for name, array in shipped.items())
    kept = (
        {key: v for key, v in checkpoint.notes(core / "compact").items() if key in ("gain", "judged")} if same else {}
    )
    compact = replace(config, preset="compact")
    checkpoint.save(made / "compact", compact, tensors, notes=notes | kept, apart=(PREDICTOR,))
    # Stage II alone: without a predictor it is what makes global edits.
    alone = replace(config, preset="rows", predict=replace(config.predict, features=0, alone=False))
    rest = {name: tensor for name, tensor in tensors.items() if not name.startswith(PREDICTOR)}
    checkpoint.save(made / "rows", alone, rest, notes=notes, base="compact", shared=SHARED)


def _install(made: Path, core: Path, networks: Path) -> None:
    """One preset: its index and the predictor's shard into the core, other shards into the networks."""
    apart = {shard["file"] for shard in checkpoint._index(made)["shards"] if shard.get("holds") == PREDICTOR}
    for folder in (core, networks):
        for old in folder.glob("weights-*") if folder.is_dir() else ():
            old.unlink()
    core.mkdir(parents=True, exist_ok=True)
    for shard in sorted(path for path in made.iterdir() if SHARD_NAME.fullmatch(path.name)):
        target = core if shard.name in apart else networks
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(shard, target)
    shutil.copy(made / INDEX, core)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        print("shipped as", ", ".join(ship(Path(sys.argv[1]))))
    except ValueError as error:
        sys.exit(str(error))
