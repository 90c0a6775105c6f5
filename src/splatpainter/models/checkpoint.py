"""Checkpoints: a folder of safetensors shards of at most 15 MiB and `model.json`, which names them and the config.

    model.json                      {"format", "version", "config", "notes", "tensors": {name: {"shape", "parts"}},
                                     "shards": [{"file", "sha256", "holds"}],
                                     "base": {"folder", "sha256": [...], "tensors"}}
    weights-<sha256[:16]>.safetensors

"holds", which most shards lack, is the beginning of the names of all tensors of a shard: what begins so can be read
without the others (`load_arrays`), which may then be missing. What is missing is looked for in the folder of the same
name in the distribution DISTRIBUTION, too: the networks are larger than all else, and most edits do without.

"base", which most lack, names a folder beside this one whose checkpoint holds the tensors "tensors" (beginnings of
names) that both have in common, so that a package need not hold them twice; "sha256" are the base's shards.

Shards are named for their content and written first, `model.json` last: at any moment the folder is one complete
checkpoint. A tensor larger than a shard is stored in parts along its first axis, named "name@0", "name@1", ...
"format" says which config it is: the one whose class has that `format`. No pickle anywhere. Knows no architecture:
names and shapes are compared with the module that is to be filled.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Protocol, TypeVar, overload

from splatpainter.io.files import read_all, writing
from splatpainter.models.config import MAX_CONFIG_BYTES, ModelConfig
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    import numpy as np
    import torch

PACKAGED = Path(__file__).parents[1] / "weights"
"""Folder of the checkpoints that come with the package."""
FORMAT_PREFIX = "splatpainter "
"""What every format begins with."""
VERSION = 1
INDEX = "model.json"
MAX_SHARD_BYTES = 15 << 20
"""Bytes of a shard, at most."""
MAX_PART_BYTES = MAX_SHARD_BYTES - 4096
"""Bytes of a part of a tensor, at most: a shard has a header too."""
BASE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
SHARD_NAME = re.compile(r"weights-[0-9a-f]{16}\.safetensors")
DISTRIBUTION, DISTRIBUTION_PACKAGE = "splatpainter-networks", "splatpainter_networks"
"""The distribution with the large shards of the packaged checkpoints, one folder each, and its only package."""


class CheckpointConfig(Protocol):
    """What a model's config must have to be kept in a checkpoint."""

    format: ClassVar[str]
    """Format of the checkpoint: "splatpainter ..."."""

    @property
    def preset(self) -> str: ...
    def to_json(self) -> str: ...
    @staticmethod
    def from_json(text: str, where: str = ..., /) -> Any: ...


AnyConfig = TypeVar("AnyConfig", bound=CheckpointConfig)


@dataclass(frozen=True)
class Checkpoint(Generic[AnyConfig]):
    """Contents of a checkpoint's folder."""

    config: AnyConfig
    tensors: dict[str, torch.Tensor] = field(repr=False)
    """Name -> tensor, in the stored type, on the CPU."""
    notes: dict[str, Any]
    """What the one who saved it wrote down: training steps, data, figures. JSON values."""


def save(
    folder: Path | str,
    config: CheckpointConfig,
    tensors: Mapping[str, torch.Tensor],
    *,
    dtype: Literal["float16", "bfloat16", "float32"] = "float16",
    notes: Mapping[str, Any] | None = None,
    base: str = "",
    shared: tuple[str, ...] = (),
    apart: tuple[str, ...] = (),
) -> None:
    """Write a checkpoint, all or nothing; an older one in the folder is replaced.

    tensors: a module's state_dict(); dtype: how floats are stored; apart: tensors whose names begin so get shards of
    their own (`load_arrays`); base: name of a folder beside this one whose
    checkpoint holds the tensors that begin with `shared`, bit for bit, which are then left out. Raises ValueError for a
    tensor that is not finite in that type (half ends at 65,504), for a folder that cannot be written, and for a base
    that is not there or holds others.
    """
    import torch
    from safetensors.torch import save as pack

    target = Path(folder)
    kind = getattr(torch, dtype)
    # Judged before anything is written: a base with other values would change the model silently.
    record = _base_record(target, base, shared, tensors, kind) if base else None
    if record is not None:
        tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith(shared)}
    parts: list[tuple[str, torch.Tensor]] = []
    table = {}
    for name, tensor in tensors.items():
        # An overflow to infinity in half precision is found here, and not in the first edit.
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
    # The name of a shard is its hash, so that new ones never overwrite those that the old index names.
    shards = []
    groups = [(start, [part for part in parts if part[0].startswith(start)]) for start in apart]
    groups.append(("", [part for part in parts if not part[0].startswith(apart)]))
    for start, batch in ((start, batch) for start, group in groups for batch in _batches(group)):
        data = pack(dict(batch))
        digest = hashlib.sha256(data).hexdigest()
        file = f"weights-{digest[:16]}.safetensors"
        with writing(target / file) as out:
            out.write(data)
        shards.append({"file": file, "sha256": digest, **({"holds": start} if start else {})})
    # Written last: until it is there the old checkpoint is whole, and after it the new one.
    index = {
        "format": config.format,
        "version": VERSION,
        "config": json.loads(config.to_json()),
        "notes": dict(notes or {}),
        "tensors": table,
        "shards": shards,
        **({} if record is None else {"base": record}),
    }
    with writing(target / INDEX) as out:
        out.write(json.dumps(index, indent=1).encode())
    # Old shards go when nothing names them any more; one that cannot be removed does no harm.
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
    # The index may be a stranger's: types are judged before anything is looked up by them.
    shards, table, notes = index.get("shards"), index.get("tensors"), index.get("notes")
    if not (isinstance(shards, list) and isinstance(table, dict) and isinstance(notes, dict)):
        raise ValueError(f"{where}: expected lists of shards and tensors, and notes; the file is damaged")
    stored: dict[str, torch.Tensor] = {}
    for shard in shards:
        for name, tensor in _shard(target, shard, where, _unpack_torch).items():
            if name in stored:
                raise ValueError(f"{where}: tensor '{name}' is in two shards")
            stored[name] = tensor
    tensors = _joined(stored, table, where)
    # A name in both would make the order of reading decide.
    for name, tensor in _of_base(target, index, where).items():
        if name in tensors:
            raise ValueError(f"{where}: tensor '{name}' is both here and in its base")
        tensors[name] = tensor
    return Checkpoint(config, tensors, notes)


def load_arrays(folder: Path | str, start: str) -> dict[str, np.ndarray]:
    """The tensors of a checkpoint whose names begin with `start`, without it, in the stored type: of the shards that
    say they hold these, without torch and without the others. Raises ValueError as `load`, and where no shard says
    so."""
    target = Path(folder)
    where, shards = f"{target / INDEX}", _index(target).get("shards")
    # Only the shards that say so are read: that is what they are apart for.
    holding = [s for s in shards if isinstance(s, dict) and s.get("holds") == start] if isinstance(shards, list) else []
    if not holding:
        raise ValueError(f"{where}: no shard holds '{start}...' alone")
    arrays: dict[str, np.ndarray] = {}
    for shard in holding:
        arrays |= _shard(target, shard, where, _unpack_numpy)
    # A shard that holds more than it says would be half a model elsewhere.
    strange = [name for name in arrays if not name.startswith(start)]
    if strange:
        raise ValueError(f"{where}: a shard that holds '{start}...' has '{strange[0]}' too")
    return {name.removeprefix(start): array for name, array in arrays.items()}


@overload
def config(folder: Path | str) -> ModelConfig: ...
@overload
def config(folder: Path | str, kind: type[AnyConfig]) -> AnyConfig: ...
def config(folder: Path | str, kind: type[Any] = ModelConfig) -> Any:
    """The config of the model in a folder, without reading its weights. Raises ValueError as `load`."""
    path = Path(folder)
    return kind.from_json(json.dumps(_index(path, kind.format).get("config")), str(path / INDEX))


def format_of(folder: Path | str) -> str:
    """Which config's checkpoint a folder holds. Raises ValueError as `load`."""
    return str(_index(Path(folder))["format"])


def notes(folder: Path | str) -> dict[str, Any]:
    """What the checkpoint in a folder says about its weights, without reading them. Raises ValueError as `load`."""
    return dict(_index(Path(folder)).get("notes") or {})


def check_files(folder: Path | str) -> None:
    """Raises ValueError where the checkpoint in a folder, or a shard of it, is not there; reads none."""
    target = Path(folder)
    for shard in _index(target).get("shards") or []:
        if isinstance(shard, dict) and SHARD_NAME.fullmatch(str(shard.get("file"))):
            _shard_path(target, shard["file"])


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

    # All names and shapes are compared before the first is copied, so that a refused module is unharmed.
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
    # Bounded before it is parsed, as any file may lie here.
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


def _base_record(
    folder: Path, base: str, shared: tuple[str, ...], tensors: Mapping[str, torch.Tensor], kind: torch.dtype
) -> dict[str, Any]:
    """What model.json says about a base. Raises ValueError where the base holds other values."""
    import torch

    # Compared in the stored type: what is left out has to be what reading it back would give.
    held = _common(folder, {"folder": base, "tensors": list(shared)}, str(folder))
    index = _index(folder.parent / base)
    for name, tensor in tensors.items():
        if not name.startswith(shared):
            continue
        cast = tensor.detach().cpu().to(kind) if tensor.is_floating_point() else tensor.detach().cpu()
        if name not in held or not torch.equal(held[name], cast):
            raise ValueError(f"{folder}: tensor '{name}' is not that of its base '{base}'")
    return {"folder": base, "sha256": [shard["sha256"] for shard in index["shards"]], "tensors": list(shared)}


def _of_base(folder: Path, index: dict[str, Any], where: str) -> dict[str, torch.Tensor]:
    """The tensors that a checkpoint has in common with its base; none where it has no base."""
    record = index.get("base")
    if record is None:
        return {}
    if not isinstance(record, dict):
        raise ValueError(f"{where}: expected a base with folder, sha256 and tensors; the file is damaged")
    tensors = _common(folder, record, where)
    shards = _index(folder.parent / record["folder"]).get("shards")
    # By hash, as a base that was trained further has the same names and shapes.
    digests = [shard.get("sha256") for shard in shards if isinstance(shard, dict)] if isinstance(shards, list) else []
    if digests != record.get("sha256"):
        raise ValueError(f"{where}: its base '{record['folder']}' is not the one it was saved with; copy both folders")
    return tensors


def _common(folder: Path, record: dict[str, Any], where: str) -> dict[str, torch.Tensor]:
    """The tensors of a base that begin with one of record["tensors"], in the stored type."""
    name, shared = record.get("folder"), record.get("tensors")
    # A plain name keeps paths that lead elsewhere away.
    if not isinstance(name, str) or not BASE_NAME.fullmatch(name) or name == folder.name:
        raise ValueError(f"{where}: expected the base as the name of a folder beside this one, got {name!r}")
    if not (isinstance(shared, list) and shared and all(isinstance(item, str) and item for item in shared)):
        raise ValueError(f"{where}: expected beginnings of the names of tensors of the base, got {shared!r}")
    base = folder.parent / name
    if not (base / INDEX).is_file():
        raise ValueError(f"{where}: its base '{name}' is missing beside it; copy both folders")
    if _index(base).get("base") is not None:
        raise ValueError(f"{where}: its base '{name}' has a base itself")
    held = load(base)
    return {key: tensor for key, tensor in held.tensors.items() if key.startswith(tuple(shared))}


def _shard(folder: Path, shard: Any, where: str, unpack: Callable[[bytes], dict[str, Any]]) -> dict[str, Any]:
    """The tensors of one shard; nothing of it is used before its hash is right."""
    file, digest = (shard.get("file"), shard.get("sha256")) if isinstance(shard, dict) else (None, None)
    # Also keeps paths that lead out of the folder away.
    if not (isinstance(file, str) and SHARD_NAME.fullmatch(file)):
        raise ValueError(f"{where}: expected shards named weights-*.safetensors, got {file!r}")
    path = _shard_path(folder, file)
    if path.stat().st_size > MAX_SHARD_BYTES:
        raise ValueError(f"{path}: expected at most {MAX_SHARD_BYTES} bytes, got {path.stat().st_size}")
    # The hash comes before the parser, which then never sees bytes that nobody meant.
    data = read_all(path)
    if hashlib.sha256(data).hexdigest() != digest:
        raise ValueError(f"{path}: damaged (its SHA-256 is not the one in {INDEX}); copy it again")
    try:
        return unpack(data)
    except ValueError as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None


def _shard_path(folder: Path, file: str) -> Path:
    """Where a shard is: in its folder, or, of a packaged checkpoint, in the distribution of the networks. Raises
    ValueError where it is in neither."""
    path = folder / file
    if path.is_file():
        return path
    # However it was spelt: from a clone the folder is named by a path that begins with src/.
    if folder.resolve().parent == PACKAGED.resolve():
        spec = importlib.util.find_spec(DISTRIBUTION_PACKAGE)
        for root in spec.submodule_search_locations or () if spec else ():
            if (elsewhere := Path(root, folder.name, file)).is_file():
                return elsewhere
        raise ValueError(
            f"the networks of '{folder.name}' are not installed: expected {file} in {DISTRIBUTION}; "
            f"pip install 'splatpainter[networks]' brings them (edits by the lift and global edits need none)"
        )
    raise ValueError(f"{path}: missing; copy the whole folder")


def _unpack_torch(data: bytes) -> dict[str, torch.Tensor]:
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        return load(data)
    except SafetensorError as error:
        raise ValueError(error) from None


_STORED = {"F32": "<f4", "F64": "<f8", "F16": "<f2", "BF16": "<u2", "I64": "<i8", "I32": "<i4", "U8": "u1"}
"""Names of safetensors' number types -> numpy's; it has no bfloat16, which is the upper half of a float32."""


def _unpack_numpy(data: bytes) -> dict[str, np.ndarray]:
    """As safetensors.numpy.load, whose package has wheels of no free-threaded Python: what the core reads is little.
    bfloat16 becomes float32. Raises ValueError for anything else than the format of https://huggingface.co/docs/safetensors."""
    import numpy as np

    # Bytes of the table as a u64, the table as JSON, then the numbers that its offsets count from there.
    start = 8 + int.from_bytes(data[:8], "little")
    try:
        table = json.loads(data[8:start])
        table.pop("__metadata__", None)
        arrays = {}
        for name, entry in table.items():
            first, end = entry["data_offsets"]
            if not 0 <= first <= end <= len(data) - start:
                raise ValueError(f"the numbers of '{name}' are cut off")
            if (kind := entry["dtype"]) not in _STORED:
                raise ValueError(f"expected numbers of {', '.join(_STORED)}, got {kind} in '{name}'")
            numbers = np.frombuffer(data[start + first : start + end], _STORED[kind])
            if kind == "BF16":
                numbers = (numbers.astype(np.uint32) << 16).view(np.float32)
            arrays[name] = numbers.reshape(entry["shape"])
    except (AttributeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"its table is damaged: {error!r}") from None
    return arrays


def _joined(stored: dict[str, torch.Tensor], table: dict[str, Any], where: str) -> dict[str, torch.Tensor]:
    """Whole tensors from their parts, of the shapes that `table` says."""
    import torch

    tensors, max_parts = {}, len(stored)
    for name, entry in table.items():
        parts, shape = (entry.get("parts"), entry.get("shape")) if isinstance(entry, dict) else (None, None)
        if not isinstance(parts, int) or not 1 <= parts <= max_parts:
            raise ValueError(f"{where}: tensor '{name}': expected 1..{max_parts} parts, got {parts!r}")
        # Taken out one by one, so that what is left at the end is what the index does not name.
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
