"""Which objects and which lights a setup means, by name. Knows no protocol and renders nothing.

Objects are meshes that training never sees (the split of train/training_data.py, by the objects' names), richly
textured ones first where a MANIFEST.csv beside the folder tells; without a folder, procedural ones whose seeds no
training uses. Lights are used as their files have them, exposed by the rule of the training data.
"""

from __future__ import annotations

import csv
import hashlib
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from splatbench.cases import Setup
    from splattrain.data.lights import Light
    from splattrain.data.meshes import Mesh

PROCEDURAL_SEED = 0xBE7C4
"""Added to the setup's seed for procedural objects and lights, so that they are none of a training run's."""
TEXTURED_SHARE = 0.5
"""Share of the held-out meshes, those with most texture detail, from which objects are drawn."""
LIGHT_SUFFIXES = (".hdr", ".exr")
DETAIL = re.compile(r"texture detail (\d+(?:\.\d+)?)")


class Objects(NamedTuple):
    """Chosen objects."""

    names: tuple[str, ...]
    load: Callable[[str], Mesh]
    """Name -> mesh, normalised (data/meshes.py). Raises ValueError, naming the file, where it cannot be read."""
    notes: tuple[str, ...]
    """Lines for the table: how they were chosen, what was left out."""


class Environments(NamedTuple):
    """Lights."""

    names: tuple[str, ...]
    """All there are, in an order of the setup's seed."""
    load: Callable[[str], Light]
    """Raises ValueError, naming the file, where it cannot be read."""
    notes: tuple[str, ...]


def objects(setup: Setup) -> Objects:
    """The setup's objects, fewer where there are fewer (a note says so). Cheap: of files only the first bytes are read.
    Raises ValueError: no such folder, no meshes in it, none that is held out, none that is whole."""
    if setup.data is None:
        from splattrain.data.object_sources import ProceduralSource

        source = ProceduralSource(max(setup.objects, 1), PROCEDURAL_SEED + setup.seed, setup.textures)
        chosen = tuple(source.name(i) for i in range(setup.objects))
        note = f"{setup.objects} procedural objects of seeds that training does not use"
        return Objects(chosen, partial(_procedural, textures=setup.textures), (note,))
    return _of_folder(setup, setup.data)


def environments(setup: Setup) -> Environments:
    """The setup's lights. Raises ValueError: no such folder, or no .hdr or .exr file in it."""
    folder = setup.environments
    if folder is None:
        chosen = tuple(f"sky-{PROCEDURAL_SEED + setup.seed}-{i}" for i in range(setup.lights + 1))
        return Environments(chosen, _sky, ("light: procedural skies of seeds that training does not use",))
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; expected a folder of environments (.hdr, .exr)")
    files = sorted(f for f in folder.rglob("*") if f.suffix.lower() in LIGHT_SUFFIXES)
    if not files:
        raise ValueError(f"{folder}: holds no environments (.hdr, .exr)")
    by_name = {f.relative_to(folder).with_suffix("").as_posix(): f for f in files}
    order = np.random.default_rng([setup.seed, *b"environments"]).permutation(len(by_name))
    listed = list(by_name)
    note = f"light: {len(by_name)} environment files, as they are (training may have seen crops of them)"
    return Environments(tuple(listed[int(k)] for k in order), partial(_from_file, by_name=by_name), (note,))


def drawn_lights(names: Sequence[str], name: str, count: int, seed: int) -> list[str]:
    """`count` different lights for the object `name` (all, where there are fewer), in an order of the two and seed."""
    order = generator(seed, "lights", name).permutation(len(names))
    return [names[int(k)] for k in order[:count]]


def generator(seed: int, what: str, name: str) -> np.random.Generator:
    """Random numbers for one purpose and one object: the same whatever other objects there are."""
    return np.random.default_rng([seed, *hashlib.sha256(f"{what}:{name}".encode()).digest()])


def is_splat_folder(folder: Path | None) -> bool:
    """Whether a folder holds more files that can only be splat assets than files that may be meshes (.glb may be
    either)."""
    from splattrain.data.meshes import SUFFIXES
    from splattrain.data.object_sources import SPLAT_SUFFIXES

    if folder is None or not folder.is_dir():
        return False
    suffixes = [file.suffix.lower() for file in folder.rglob("*")]
    splats = sum(suffix in SPLAT_SUFFIXES and suffix not in SUFFIXES for suffix in suffixes)
    return splats > sum(suffix in SUFFIXES for suffix in suffixes)


def _of_folder(setup: Setup, folder: Path) -> Objects:
    from splattrain.data.held_out import HeldOut
    from splattrain.data.object_sources import MeshFolder

    meshes = MeshFolder(folder)
    files = {meshes.name(i): meshes.files[i] for i in range(len(meshes))}
    # Stages and judges of training split these names alike, with these defaults.
    rule = HeldOut() if setup.names is None else HeldOut.of_file(setup.names)
    available = rule.split(list(files), str(folder))[1] if setup.held_out else list(files)
    what = "held-out meshes" if setup.held_out else "meshes"
    if not available:
        raise ValueError(
            f"{folder}: none of its {len(files)} meshes is held out of training (their names decide); add meshes, "
            f"or take any"
        )
    broken = {name: reason for name in available if (reason := _broken(files[name]))}
    notes = [f"{name}: left out, {reason}" for name, reason in broken.items()]
    available = [name for name in available if name not in broken]
    if not available:
        raise ValueError(f"{folder}: none of its {what} can be read; the first: {notes[0]}")
    pool, how = _rich(available, _details(folder), setup.objects)
    order = np.random.default_rng([setup.seed, *b"objects"]).permutation(len(pool))
    chosen = [pool[int(k)] for k in sorted(order[: setup.objects])]
    if len(chosen) < setup.objects:
        notes.append(f"{setup.objects} objects were asked for; there are {len(chosen)} {what}")
    notes.append(f"{len(chosen)} of {len(available)} {what}{how}")
    return Objects(tuple(chosen), partial(_loaded, files=files), tuple(notes))


def _rich(names: Sequence[str], details: dict[str, float], count: int) -> tuple[Sequence[str], str]:
    """(those to draw from, in the given order; what was done, in words)."""
    if not any(name in details for name in names):
        return names, ""
    number = min(max(count, round(TEXTURED_SHARE * len(names))), len(names))
    best = sorted(names, key=lambda name: -details.get(name, 0.0))[:number]
    if number == len(names):
        return names, ""
    return [name for name in names if name in best], f", drawn from the {number} with most texture detail"


def _details(folder: Path) -> dict[str, float]:
    """Name -> texture detail, of a MANIFEST.csv in the folder or beside it (columns path and notes)."""
    for parent in (folder, folder.resolve().parent):
        manifest = parent / "MANIFEST.csv"
        if not manifest.is_file():
            continue
        details = {}
        try:
            with open(manifest, newline="", encoding="utf-8-sig") as file:
                for row in csv.DictReader(file):
                    match = DETAIL.search(row.get("notes") or "")
                    path = (parent / (row.get("path") or "")).resolve()
                    if match and path.is_relative_to(folder.resolve()):
                        details[path.relative_to(folder.resolve()).with_suffix("").as_posix()] = float(match[1])
        except (OSError, ValueError, csv.Error):
            return {}  # somebody else's file of that name
        return details
    return {}


def _broken(file: Path) -> str:
    """Why a file cannot be a mesh, by its first bytes and its length; "" where that says nothing."""
    try:
        size = file.stat().st_size
        if size == 0:
            return "an empty file"
        if file.suffix.lower() != ".glb":
            return ""
        with open(file, "rb") as opened:
            head = opened.read(12)
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    if len(head) < 12 or head[:4] != b"glTF":
        return "not a GLB file"
    announced = int.from_bytes(head[8:12], "little")
    return f"{size} bytes of {announced}: cut short" if size < announced else ""


def _loaded(name: str, files: dict[str, Path]) -> Mesh:
    from splattrain.data.meshes import load_mesh

    if name not in files:
        raise ValueError(f"{name}: no mesh of this name in the folder")
    return load_mesh(files[name])


def _procedural(name: str, textures: Path | None) -> Mesh:
    from splattrain.data.object_sources import object_seed
    from splattrain.data.procedural import random_mesh

    _, seed, number = name.split("-")
    return random_mesh(object_seed(int(seed), int(number)), textures)


def _from_file(name: str, by_name: dict[str, Path]) -> Light:
    from splattrain.data.environments import load_environment
    from splattrain.data.lights import make_light

    if name not in by_name:
        raise ValueError(f"{name}: no environment of this name in the folder")
    return make_light(load_environment(by_name[name]), name)


def _sky(name: str) -> Light:
    from dataclasses import replace

    from splattrain.data.lights import random_light

    _, seed, number = name.split("-")
    return replace(random_light(np.random.default_rng([int(seed), int(number)])), name=name)
