"""Encoded assets on disk: encoding takes seconds, an asset is opened again and again.

    FOLDER/<key>.safetensors      latents as float16 (of `copy` also its Gaussians and voxels); the header holds
                                  VERSION and the SHA-256 of the tensors

The key is a hash of everything that the latents depend on. A file is complete or not there; a damaged one is deleted
and its asset encoded again; the least recently used go first. A folder that cannot be used is never an error.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.io.files import remove, writing
from splatpainter.models.encode import Encoded, encode_asset
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system import user_folders
from splatpainter.voxels.grid import VoxelGrid, voxelize

if TYPE_CHECKING:
    from torch import Tensor

    from splatpainter.models.local_network import LocalNetwork
    from splatpainter.models.model import SplatPainterModel

VARIABLE = "SPLATPAINTER_CACHE"
"""Environment variable: the folder, in place of the user's cache folder."""
MAX_CACHE_BYTES = 2 << 30
"""Bytes of all files together, at most."""
VERSION = "1"
"""Version of everything between an asset and its latents; raise it when code changes what an encoding is."""
SUFFIX = ".safetensors"


def cache_folder() -> Path:
    """The folder that VARIABLE names, or `splatpainter` in the user's cache folder of this platform."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else user_folders.cache_folder()


def digest(model: SplatPainterModel | LocalNetwork) -> str:
    """Hex SHA-256 of a model's config and weights."""
    sha = hashlib.sha256(model.config.to_json().encode())
    for name, tensor in sorted(model.state_dict().items()):
        sha.update(f"{name} {list(tensor.shape)} {tensor.dtype}".encode())
        sha.update(_bytes(tensor))
    return sha.hexdigest()


def encode_cached(
    model: SplatPainterModel,
    splats: Splats,
    grid: VoxelGrid | None = None,
    *,
    weights: str | None = None,
    limit: int = MAX_CACHE_BYTES,
) -> Encoded:
    """`encode_asset` with latents in float16, from the cache where it has them; a hit is bitwise what was stored.

    weights: `digest` of the model, if at hand; limit: bytes that the folder may hold. Raises ValueError when no
    Gaussian can be drawn."""
    splats = splats.numpy()
    if not model.config.refine.latents:
        return encode_asset(model, splats, grid)  # there is nothing to keep
    if grid is None or grid.resolution != model.config.compress.resolution:
        grid = voxelize(splats, model.config.compress.resolution)
    path = cache_folder() / (_key(model, splats, weights or digest(model)) + SUFFIX)
    # What is damaged, or of another program, is encoded again: a cache is never a reason to fail.
    cached = _read(path)
    encoded = None if cached is None else _unpacked(model, splats, grid, cached)
    if encoded is None:
        remove(path)
        encoded = encode_half(model, splats, grid)
        _write(path, _packed(model, encoded), limit)
    else:
        with contextlib.suppress(OSError):
            os.utime(path)  # when it was last used
    return encoded


def encode_half(model: SplatPainterModel, splats: Splats, grid: VoxelGrid | None = None) -> Encoded:
    """`encode_asset` with latents in float16, or in float32 where that could not hold them."""
    import torch

    # Half the room; an untrained or strange model may exceed it, and then keeps float32.
    encoded = encode_asset(model, splats, grid, dtype=torch.float16)
    fits = all(bool(torch.isfinite(part).all()) for part in encoded.latents.values.split(1 << 16))
    return encoded if fits else encode_asset(model, splats, grid)


def _key(model: SplatPainterModel, splats: Splats, weights: str) -> str:
    """Splats.sha256 is the file's hash while these are its Gaussians, else that of the attributes."""
    import torch

    device = next(model.parameters()).device.type
    # Arithmetic is in the key: latents in bf16 are others than those in float32.
    rounded = torch.is_autocast_enabled(device)
    arithmetic = f"{device} {torch.get_autocast_dtype(device) if rounded else torch.float32}"
    parts = (VERSION, weights, splats.sha256, f"{splats.antialiased} {splats.color_space}", arithmetic)
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _packed(model: SplatPainterModel, encoded: Encoded) -> dict[str, Tensor]:
    """What is stored of an encoding: the parts that take time to make again."""
    import torch

    cached = {"values": encoded.latents.values}
    if model.config.representation == "copy":
        groups = encoded.latents.groups
        cached |= {name: getattr(encoded.gaussians, name) for name in ATTRIBUTES}
        arrays = {"starts": groups.starts, "centers": groups.centers, "middle": groups.center}
        cached |= {name: torch.from_numpy(array) for name, array in arrays.items()}
        cached["edges"] = torch.tensor([groups.voxel, groups.half_extent], dtype=torch.float64)
    return {name: tensor.detach().cpu().contiguous() for name, tensor in cached.items()}


def _unpacked(model: SplatPainterModel, splats: Splats, grid: VoxelGrid, cached: dict[str, Tensor]) -> Encoded | None:
    """None where it does not fit the asset: a file of another program under this name."""
    from splatpainter.models.compress import Latents
    from splatpainter.models.gaussian_groups import GaussianGroups

    # Groups of the user's own Gaussians are quick to make again, and are not stored.
    device = str(next(model.parameters()).device)
    try:
        values = cached["values"].to(device)
        if model.config.representation == "native":
            groups, gaussians = model.groups(grid).most_opaque(1.0)[0], splats.torch(device)
        else:
            order = np.arange(len(values), dtype=np.int64)
            starts, centers, middle = (cached[name].numpy() for name in ("starts", "centers", "middle"))
            voxel, half = cached["edges"].tolist()
            groups = GaussianGroups(order, starts, centers, voxel, middle, half)
            means, quats, scales, opacities, sh = (cached[name].to(device) for name in ATTRIBUTES)
            gaussians = Splats(means, quats, scales, opacities, sh)
    except (KeyError, ValueError):
        return None
    fits = list(values.shape) == [len(groups), model.config.compress.dim] and groups.starts[-1] == len(groups)
    return Encoded(Latents(values, groups), gaussians) if fits else None


def _read(path: Path) -> dict[str, Tensor] | None:
    """The tensors of a file, or None where there is none, or one that is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
            header = file.metadata() or {}
    except (OSError, SafetensorError, ValueError):
        return None
    return tensors if header == {"version": VERSION, "sha256": _checksum(tensors)} else None


def _write(path: Path, tensors: dict[str, Tensor], limit: int) -> None:
    from safetensors.torch import save

    # One asset larger than the whole folder may hold would push all others out.
    size = sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())
    if size > limit:
        return
    with contextlib.suppress(OSError, ValueError):
        path.parent.mkdir(parents=True, exist_ok=True)
        _evict(path.parent, limit - size)
        with writing(path) as file:
            file.write(save(tensors, {"version": VERSION, "sha256": _checksum(tensors)}))


def _evict(folder: Path, max_bytes: int) -> None:
    """Delete the least recently used files until the rest needs at most `max_bytes`."""
    # By when they were last used; a file that is read has its time set anew.
    paths = [*folder.glob("*" + SUFFIX), *folder.glob(f".*{SUFFIX}.*.part")]  # also what a killed process left
    files = sorted(((p.stat().st_mtime, p.stat().st_size, p) for p in paths), reverse=True)
    for _, size, path in files:
        max_bytes -= size
        if max_bytes < 0:
            remove(path)


def _checksum(tensors: dict[str, Tensor]) -> str:
    sha = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        sha.update(f"{name} {list(tensor.shape)} {tensor.dtype}".encode())
        sha.update(_bytes(tensor))
    return sha.hexdigest()


def _bytes(tensor: Tensor) -> memoryview:
    import torch

    return tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data
