"""Checkpoints: a folder of safetensors shards of at most 15 MiB and `model.json`, which names them and the config.

    model.json                      {"format", "version", "config", "notes", "tensors": {name: {"shape", "parts"}},
                                     "shards": [{"file", "sha256"}]}
    weights-<sha256[:16]>.safetensors

Shards are named for their content and written first, `model.json` last: at any moment the folder is one complete
checkpoint. A tensor larger than a shard is stored in parts along its first axis, named "name@0", "name@1", ...
"format" says which config it is: the one whose class has that `format`. No pickle anywhere. Knows no architecture:
names and shapes are compared with the module that is to be filled.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Protocol, TypeVar, overload

from splatpainter.io.files import read_all, writing
from splatpainter.models.config import MAX_CONFIG_BYTES, ModelConfig

if TYPE_CHECKING:
    import torch

FORMAT_PREFIX = "splatpainter "
"""What every format begins with."""
VERSION = 1
INDEX = "model.json"
MAX_SHARD_BYTES = 15 << 20
"""Bytes of a shard, at most."""
MAX_PART_BYTES = MAX_SHARD_BYTES - 4096
"""Bytes of a part of a tensor, at most: a shard has a header too."""
SHARD_NAME = re.compile(r"weights-[0-9a-f]{16}\.safetensors")


class Config(Protocol):
    """What a model's config must have to be kept in a checkpoint."""

    format: ClassVar[str]
    """Of the checkpoint: "splatpainter ..."."""

    @property
    def preset(self) -> str: ...
    def to_json(self) -> str: ...
    @staticmethod
    def from_json(text: str, where: str = ..., /) -> Any: ...


AnyConfig = TypeVar("AnyConfig", bound=Config)


@dataclass(frozen=True)
class Checkpoint(Generic[AnyConfig]):
    """What a folder held."""

    config: AnyConfig
    tensors: dict[str, torch.Tensor] = field(repr=False)
    """Name -> tensor, in the stored type, on the CPU."""
    notes: dict[str, Any]
    """What the one who saved it wrote down: training steps, data, figures. JSON values."""


def save(
    folder: Path | str,
    config: Config,
    tensors: Mapping[str, torch.Tensor],
    *,
    dtype: Literal["float16", "bfloat16", "float32"] = "float16",
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Write a checkpoint, all or nothing; an older one in the folder is replaced.

    tensors: a module's state_dict(); dtype: how floats are stored. Raises ValueError for a tensor that is not finite in
    that type (half ends at 65,504) and for a folder that cannot be written.
    """
    import torch
    from safetensors.torch import save as pack

    target = Path(folder)
    kind = getattr(torch, dtype)
    parts: list[tuple[str, torch.Tensor]] = []
    table = {}
    for name, tensor in tensors.items():
        stored = tensor.detach().to("cpu", kind if tensor.is_floating_point() else tensor.dtype).contiguous()
        if stored.is_floating_point() and not torch.isfinite(stored).all():
            raise ValueError(
                f"{target}: tensor '{name}' has values that {dtype} cannot hold; use float32, or train again"
            )
        pieces = _pieces(stored)
        table[name] = {"shape": list(tensor.shape), "parts": len(pieces)}
        parts += [(name if len(pieces) == 1 else f"{name}@{i}", piece) for i, piece in enumerate(pieces)]
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{target}: the folder cannot be made ({error.strerror or error})") from None
    shards = []
    for batch in _batches(parts):
        data = pack(dict(batch))
        digest = hashlib.sha256(data).hexdigest()
        file = f"weights-{digest[:16]}.safetensors"
        with writing(target / file) as out:
            out.write(data)
        shards.append({"file": file, "sha256": digest})
    index = {
        "format": config.format,
        "version": VERSION,
        "config": json.loads(config.to_json()),
        "notes": dict(notes or {}),
        "tensors": table,
        "shards": shards,
    }
    with writing(target / INDEX) as out:
        out.write(json.dumps(index, indent=1).encode())
    current = {shard["file"] for shard in shards}
    for old in target.iterdir():
        if SHARD_NAME.fullmatch(old.name) and old.name not in current:
            with contextlib.suppress(OSError):
                old.unlink()


@overload
def load(folder: Path | str, preset: str | None = None) -> Checkpoint[ModelConfig]: ...
@overload
def load(folder: Path | str, preset: str | None = None, *, kind: type[AnyConfig]) -> Checkpoint[AnyConfig]: ...
def load(folder: Path | str, preset: str | None = None, *, kind: type[Any] = ModelConfig) -> Checkpoint[Any]:
    """Read a checkpoint. preset: refuse one of another preset; kind: of its config, another one is another format.

    Raises ValueError, naming the file and what is wrong: no checkpoint there, another format or preset, a newer
    version, a config with unknown, missing or wrong keys, shards that are missing, damaged, or hold other tensors than
    `model.json` says.
    """
    target = Path(folder)
    index = _index(target, kind.format)
    where = f"{target / INDEX}"
    config = kind.from_json(json.dumps(index.get("config")), where)
    if preset is not None and config.preset != preset:
        raise ValueError(f"{target}: expected weights of preset '{preset}', these are of preset '{config.preset}'")
    shards, table, notes = index.get("shards"), index.get("tensors"), index.get("notes")
    if not (isinstance(shards, list) and isinstance(table, dict) and isinstance(notes, dict)):
        raise ValueError(f"{where}: expected lists of shards and tensors, and notes; the file is damaged")
    stored: dict[str, torch.Tensor] = {}
    for shard in shards:
        for name, tensor in _shard(target, shard, where).items():
            if name in stored:
                raise ValueError(f"{where}: tensor '{name}' is in two shards")
            stored[name] = tensor
    return Checkpoint(config, _joined(stored, table, where), notes)


def config(folder: Path | str) -> ModelConfig:
    """The config of the model in a folder, without reading its weights. Raises ValueError as `load`."""
    path = Path(folder)
    return ModelConfig.from_json(json.dumps(_index(path, ModelConfig.format).get("config")), str(path / INDEX))


def notes(folder: Path | str) -> dict[str, Any]:
    """What the checkpoint in a folder says about its weights, without reading them. Raises ValueError as `load`."""
    return dict(_index(Path(folder)).get("notes") or {})


def add_notes(folder: Path | str, notes: Mapping[str, Any]) -> None:
    """Put these keys into the notes of a checkpoint; its weights and other notes stay as they are. Raises ValueError
    as `load` does for a folder without checkpoint or with another format."""
    target = Path(folder)
    index = _index(target)
    index["notes"] = {**index.get("notes", {}), **notes}
    with writing(target / INDEX) as out:
        out.write(json.dumps(index, indent=1).encode())


def fill(module: torch.nn.Module, tensors: Mapping[str, torch.Tensor], where: str = "checkpoint") -> None:
    """Give a module these tensors, as float32: copied into its own, or in their place where it is on the meta device.

    Raises ValueError naming the tensors that are unknown, missing or of another shape; the module is then unharmed.
    """
    import torch

    expected = module.state_dict()
    unknown = sorted(tensors.keys() - expected.keys())
    missing = sorted(expected.keys() - tensors.keys())
    wrong = [
        f"{name} {list(tensors[name].shape)} instead of {list(expected[name].shape)}"
        for name in sorted(expected.keys() & tensors.keys())
        if tensors[name].shape != expected[name].shape
    ]
    for problem, names in (("unknown", unknown), ("missing", missing), ("mis-shaped", wrong)):
        if names:
            more = f" and {len(names) - 3} more" if len(names) > 3 else ""
            raise ValueError(f"{where}: {problem} weights: {', '.join(names[:3])}{more}; they are of another model")
    cast = {name: t.to(torch.float32) if t.is_floating_point() else t for name, t in tensors.items()}
    module.load_state_dict(cast, strict=True, assign=any(tensor.is_meta for tensor in expected.values()))


def _index(folder: Path, expected: str = "") -> dict[str, Any]:
    """model.json, checked as far as format (expected, or any of this package's) and version."""
    path = folder / INDEX
    if not path.is_file():
        raise ValueError(f"{folder}: no weights there; expected a folder with {INDEX} and its shards")
    if path.stat().st_size > 4 * MAX_CONFIG_BYTES:
        raise ValueError(f"{path}: expected at most {4 * MAX_CONFIG_BYTES} bytes")
    try:
        data = json.loads(read_all(path))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON ({error})") from None
    name_of_format = str(data.get("format")) if isinstance(data, dict) else ""
    if not (name_of_format == expected if expected else name_of_format.startswith(FORMAT_PREFIX)):
        other = f"'{name_of_format}'" if name_of_format.startswith(FORMAT_PREFIX) else "something else"
        raise ValueError(f"{path}: expected format '{expected or FORMAT_PREFIX + '...'}'; this is {other}")
    version = data.get("version")
    if not isinstance(version, int) or version < 1:
        raise ValueError(f"{path}: expected a version number, got {version!r}")
    if version > VERSION:
        raise ValueError(f"{path}: written by a newer SplatPainter (version {version}, this one reads up to {VERSION})")
    return data


def _shard(folder: Path, shard: Any, where: str) -> dict[str, torch.Tensor]:
    """The tensors of one shard; nothing of it is used before its hash is right."""
    from safetensors import SafetensorError
    from safetensors.torch import load as unpack

    file, digest = (shard.get("file"), shard.get("sha256")) if isinstance(shard, dict) else (None, None)
    # Also keeps paths that lead out of the folder away.
    if not (isinstance(file, str) and SHARD_NAME.fullmatch(file)):
        raise ValueError(f"{where}: expected shards named weights-*.safetensors, got {file!r}")
    path = folder / file
    if not path.is_file():
        raise ValueError(f"{path}: missing; copy the whole folder")
    if path.stat().st_size > MAX_SHARD_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_SHARD_BYTES} bytes, got {path.stat().st_size}")
    data = read_all(path)
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{path}: damaged (its SHA-256 is not the one in {INDEX}); copy it again")
    try:
        return unpack(data)
    except SafetensorError as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None


def _joined(stored: dict[str, torch.Tensor], table: dict[str, Any], where: str) -> dict[str, torch.Tensor]:
    """Whole tensors from their parts, of the shapes that `table` says."""
    import torch

    tensors, max_parts = {}, len(stored)
    for name, entry in table.items():
        parts, shape = (entry.get("parts"), entry.get("shape")) if isinstance(entry, dict) else (None, None)
        if not isinstance(parts, int) or not 1 <= parts <= max_parts:
            raise ValueError(f"{where}: tensor '{name}': expected 1..{max_parts} parts, got {parts!r}")
        pieces = [stored.pop(name if parts == 1 else f"{name}@{i}", None) for i in range(parts)]
        present = [piece for piece in pieces if piece is not None]
        if len(present) < parts:
            raise ValueError(f"{where}: tensor '{name}' is in no shard")
        try:
            tensors[name] = present[0] if parts == 1 else torch.cat(present)
        except (RuntimeError, TypeError):
            raise ValueError(f"{where}: the parts of tensor '{name}' do not fit together") from None
        if list(tensors[name].shape) != shape:
            raise ValueError(f"{where}: tensor '{name}': expected shape {shape}, got {list(tensors[name].shape)}")
    if stored:
        raise ValueError(f"{where}: the shards hold a tensor that it does not name: {sorted(stored)[0]}")
    return tensors


def _pieces(tensor: torch.Tensor) -> list[torch.Tensor]:
    """The tensor, or runs of its first axis that fit in a shard."""
    size = tensor.numel() * tensor.element_size()
    count = math.ceil(size / MAX_PART_BYTES)
    if count <= 1 or tensor.ndim == 0:
        return [tensor]
    assert count <= tensor.shape[0], "a row larger than a shard"
    return [piece.contiguous() for piece in tensor.tensor_split(count)]


def _batches(parts: list[tuple[str, torch.Tensor]]) -> list[list[tuple[str, torch.Tensor]]]:
    """Runs of parts, in order, of at most MAX_SHARD_BYTES bytes with their header."""
    batches: list[list[tuple[str, torch.Tensor]]] = []
    bytes_left = 0
    for name, tensor in parts:
        need = tensor.numel() * tensor.element_size() + len(name) + 100  # its line in the header
        if need > bytes_left or not batches:
            batches.append([])
            bytes_left = MAX_SHARD_BYTES
        batches[-1].append((name, tensor))
        bytes_left -= need
    return batches
