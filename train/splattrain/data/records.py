"""A sample as named files, and back: what stands in a shard under one key. Knows no tar.

    json                    name, kind, mode, cameras, which views are near; of path traced truth: exposures
    asset.ply               the asset (INRIA PLY)
    base_00.png ...         base views           edited_00.png, mask_00.png ...   edited views and their masks
    before_00.png ...       novel views before   after_00.png ...                 and after the edit
    before_00.exr ...       the same as 16-bit linear radiance, premultiplied, where they were path traced (optional)

PNGs are 8-bit display sRGB (masks: 0 or 255), so what is read back differs by up to 1/510 from what was rendered. The
names are WebDataset's: a sample's files are KEY.NAME, and any reader of its tar files can use them.
"""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatpainter.cameras import Camera
from splatpainter.image_files import to_uint8
from splatpainter.io import read, write
from splatpainter.splats import Splats
from splattrain.data.samples import PosedViews, Sample

VERSION = 1
Files = dict[str, bytes]
"""A sample as files: name within the sample ("after_00.png") -> content."""


def encode_sample(sample: Sample, radiance: Mapping[str, np.ndarray] | None = None, **more: Any) -> Files:
    """A sample's files. radiance: {"base" | "edited" | "before" | "after": [V, H, W, 3] linear} to keep as EXR beside
    the PNGs; more: further JSON values for the description."""
    groups = {"base": sample.base, "edited": sample.edited, "before": sample.novel_before, "after": sample.novel_after}
    about = {
        "version": VERSION,
        "name": sample.name,
        "kind": sample.kind,
        "mode": sample.mode,
        "near": sample.near.tolist(),
        "cameras": {name: [camera.record() for camera in group.cameras] for name, group in groups.items()},
        **more,
    }
    files = {"json": json.dumps(about).encode(), "asset.ply": _encode_ply(sample.asset)}
    for name, group in groups.items():
        for k, picture in enumerate(group.colors.detach().cpu().numpy()):
            files[f"{name}_{k:02d}.png"] = _encode_png(to_uint8(picture))
    for k, mask in enumerate(sample.masks):
        files[f"mask_{k:02d}.png"] = _encode_png(mask.astype(np.uint8) * 255)
    for name, pictures in (radiance or {}).items():
        from splattrain.data.environments import encode_exr

        files |= {f"{name}_{k:02d}.exr": encode_exr(picture) for k, picture in enumerate(pictures)}
    return files


def decode_sample(files: Mapping[str, bytes], where: str, asset: Splats | None = None) -> Sample:
    """The sample of `encode_sample`'s files. asset: use this instead of reading asset.ply (it was read before).

    Raises ValueError naming `where` and what is missing or broken."""
    try:
        about = json.loads(files["json"])
        if about.get("version") != VERSION:
            raise ValueError(f"expected a sample of version {VERSION}, got {about.get('version')!r}")
        views = {name: _decode_views(files, name, about["cameras"][name]) for name in about["cameras"]}
        base, edited = views["base"], views["edited"]
        height, width = base.colors.shape[1:3]
        if not len(edited):
            edited = PosedViews((), torch.zeros(0, height, width, 3))
        masks = [_decode_png(files[f"mask_{k:02d}.png"])[..., 0] > 127 for k in range(len(edited))]
        return Sample(
            name=str(about["name"]),
            kind=str(about["kind"]),
            mode=about["mode"],
            asset=decode_asset(files["asset.ply"]) if asset is None else asset,
            base=base,
            edited=edited,
            masks=np.stack(masks) if masks else np.zeros((0, height, width), bool),
            novel_before=views["before"],
            novel_after=views["after"],
            near=np.array(about["near"], bool),
        )
    except KeyError as error:
        raise ValueError(f"{where}: the sample has no {error}") from None
    except (ValueError, TypeError, AttributeError, OSError, SyntaxError) as error:
        raise ValueError(f"{where}: cannot be read as a sample ({error})") from None


def decode_asset(data: bytes) -> Splats:
    """The bytes of asset.ply as splats of no file. Raises ValueError."""
    with tempfile.TemporaryDirectory(prefix="splatpainter-asset-") as folder:
        path = Path(folder) / "asset.ply"
        path.write_bytes(data)
        return replace(read(path), source=None, origin=None)


def decode_radiance(files: Mapping[str, bytes], name: str, where: str) -> np.ndarray:
    """[V, H, W, 3] float32 of a sample's NAME_00.exr ...; V = 0 where it has none. Raises ValueError."""
    from splattrain.data.environments import decode_exr

    names = sorted(key for key in files if key.startswith(f"{name}_") and key.endswith(".exr"))
    pictures = [decode_exr(files[key], f"{where}.{key}") for key in names]
    return np.stack(pictures) if pictures else np.zeros((0, 0, 0, 3), np.float32)


def _decode_views(files: Mapping[str, bytes], name: str, cameras: list[dict[str, Any]]) -> PosedViews:
    parsed = tuple(Camera.from_record(camera, f"{name} camera {k}") for k, camera in enumerate(cameras))
    pictures = []
    for k, camera in enumerate(parsed):
        picture = _decode_png(files[f"{name}_{k:02d}.png"])
        if picture.shape != (camera.height, camera.width, 3):
            raise ValueError(f"{name}_{k:02d}.png: expected {camera.width}x{camera.height}, got {picture.shape}")
        pictures.append(picture)
    stacked = np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.uint8)
    return PosedViews(parsed, torch.from_numpy(stacked.astype(np.float32) / np.float32(255)))


def _encode_ply(splats: Splats) -> bytes:
    with tempfile.TemporaryDirectory(prefix="splatpainter-asset-") as folder:
        path = Path(folder) / "asset.ply"
        write(path, replace(splats, source=None, origin=None))
        return path.read_bytes()


def _encode_png(pixels: np.ndarray) -> bytes:
    """[H, W, 3] or [H, W] uint8."""
    from PIL import Image

    box = io.BytesIO()
    Image.fromarray(pixels).save(box, "PNG", compress_level=6)
    return box.getvalue()


def _decode_png(data: bytes) -> np.ndarray:
    """[H, W, 3] uint8."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"))
