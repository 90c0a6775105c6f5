"""Encodings on disk: a hit is what a miss stored, damage is repaired, the folder stays small and is never an error."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.io import read, write
from splatpainter.models import cache
from splatpainter.models.cache import cache_folder, digest, encode_cached, encode_half
from splatpainter.models.config import ModelConfig
from splatpainter.models.encode import Encoded
from splatpainter.painter import EditSettings, Painter
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system import user_folders
from tests.support.lift_scenes import same_bits
from tests.support.painter_scenes import ASSET_BASE, COPY, RED, built, dab, thing

SPLATS = thing()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one entry with every encoding that is really made."""
    made: list[int] = []

    def counted(*args: object, **kind: object) -> Encoded:
        made.append(1)
        return encode(*args, **kind)  # type: ignore[arg-type]

    encode = cache.encode_asset
    monkeypatch.setattr(cache, "encode_asset", counted)
    return made


@torch.no_grad()
def cached(config: ModelConfig = ASSET_BASE, splats: Splats = SPLATS, seed: int = 7) -> Encoded:
    return encode_cached(built(config, seed=seed), splats)


def same(one: Encoded, two: Encoded) -> bool:
    groups = ("order", "starts", "centers", "center")
    return (
        torch.equal(one.latents.values, two.latents.values)
        and one.latents.values.dtype == two.latents.values.dtype
        and same_bits(one.gaussians.numpy(), two.gaussians.numpy())
        and all(np.array_equal(getattr(one.latents.groups, n), getattr(two.latents.groups, n)) for n in groups)
        and (one.latents.groups.voxel, one.latents.groups.half_extent)
        == (two.latents.groups.voxel, two.latents.groups.half_extent)
    )


@pytest.mark.parametrize("config", [ASSET_BASE, COPY], ids=["native", "copy"])
@torch.no_grad()
def test_a_hit_is_bitwise_what_a_miss_made(folder: Path, count: list[int], config: ModelConfig) -> None:
    miss, hit = cached(config), cached(config)
    assert len(count) == 1 and same(miss, hit)
    assert same(miss, encode_half(built(config), SPLATS)) and miss.latents.values.dtype == torch.float16
    (file,) = folder.glob("*.safetensors")
    assert len(list(folder.iterdir())) == 1 and file.stat().st_size >= miss.latents.values.numel() * 2


@torch.no_grad()
def test_everything_that_matters_is_in_the_key(folder: Path, count: list[int], tmp_path: Path) -> None:
    cached()
    write(tmp_path / "a.ply", SPLATS)
    file = read(tmp_path / "a.ply")
    turned = replace(SPLATS, sh=-SPLATS.sh)
    for n, (config, splats, seed) in enumerate(
        [
            (ASSET_BASE, turned, 7),
            (ASSET_BASE, replace(SPLATS, antialiased=True), 7),
            (ASSET_BASE, SPLATS, 8),  # other weights
            (replace(ASSET_BASE, sh_degree=0), SPLATS, 7),
            (ASSET_BASE, file, 7),  # the file, and then its Gaussians under their own hash
            (ASSET_BASE, replace(file, sh=file.sh * 2), 7),
        ]
    ):
        cached(config, splats, seed)
        assert len(count) == n + 2
    with torch.autocast("cpu", torch.bfloat16):
        cached()
    assert len(count) == 8
    cached()
    cached(splats=turned)
    assert len(count) == 8 and len(list(folder.iterdir())) == 8
    assert len(digest(built())) == 64 and digest(built()) == digest(built()) != digest(built(seed=8))


@pytest.mark.parametrize("how", ["flipped", "truncated", "empty", "another"])
@torch.no_grad()
def test_a_damaged_file_is_deleted_and_made_again(folder: Path, count: list[int], how: str) -> None:
    complete = cached()
    (file,) = folder.iterdir()
    data = bytearray(file.read_bytes())
    if how == "flipped":
        data[-5] ^= 1
    elif how == "another":
        cached(splats=SPLATS.take(np.arange(500)))
        (other,) = (path for path in folder.iterdir() if path != file)
        data = bytearray(other.read_bytes())
        other.unlink()
        count.pop()
    file.write_bytes({"truncated": data[: len(data) // 2], "empty": b""}.get(how, data))
    assert same(cached(), complete) and len(count) == 2
    assert same(cached(), complete) and len(count) == 2  # and is whole again


@torch.no_grad()
def test_the_least_recently_used_go_first(folder: Path, count: list[int]) -> None:
    assets = [SPLATS.take(np.arange(a, a + 400)) for a in (0, 200, 400, 600)]
    model = built()
    size = 0
    for age, asset in enumerate(assets[:3]):
        encode_cached(model, asset)
        newest = max(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        size = newest.stat().st_size
        os.utime(newest, (age, age))
    encode_cached(model, assets[0])  # used again
    assert len(count) == 3
    encode_cached(model, assets[3], limit=3 * size + size // 2)
    assert len(count) == 4 and len(list(folder.iterdir())) == 3
    encode_cached(model, assets[0])
    encode_cached(model, assets[2])
    assert len(count) == 4
    encode_cached(model, assets[1])
    assert len(count) == 5
    encode_cached(model, SPLATS.take(np.arange(300)), limit=100)  # larger than the whole cache
    assert len(list(folder.iterdir())) == 4


@torch.no_grad()
def test_a_folder_that_cannot_be_used_is_no_error(
    folder: Path, count: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = cached()
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(next(folder.iterdir()) / "below a file"))
    assert same(cached(), expected) and same(cached(), expected) and len(count) == 3


@torch.no_grad()
def test_latents_that_half_cannot_hold_stay_float32(folder: Path) -> None:
    model = built()
    for block in model.compressor.decoder:
        block.mlp.outer.weight.mul_(1e8)  # type: ignore[union-attr]
    one, two = encode_cached(model, SPLATS), encode_cached(model, SPLATS)
    assert one.latents.values.dtype == torch.float32 and float(one.latents.values.abs().max()) > 65504
    assert same(one, two)


def test_the_folder_is_the_platforms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPLATPAINTER_CACHE", raising=False)
    assert cache_folder() == user_folders.cache_folder()
    monkeypatch.setenv("SPLATPAINTER_CACHE", "/mine")
    assert cache_folder() == Path("/mine")


def test_a_painter_uses_it_only_if_told(folder: Path, count: list[int]) -> None:
    model = built(awake=0.05)
    results = []
    for painter in (
        Painter(model=model),
        Painter(model=model, settings=EditSettings(cache=True)),
        Painter(model=model, settings=EditSettings(cache=True)),
    ):
        asset = painter.encode(SPLATS)
        results.append(painter.apply(asset, [dab(SPLATS, RED)]))
        assert folder.exists() == painter.settings.cache
    assert all(same_bits(result.splats, results[0].splats) for result in results) and len(count) == 2
    assert all(getattr(results[0].splats, name).dtype == np.float32 for name in ATTRIBUTES)
    # Where the network is not asked, nothing is encoded.
    painter = Painter(model=model, settings=EditSettings(cache=True))
    assert painter.apply(painter.encode(SPLATS, "lift"), [dab(SPLATS, RED)], method="lift").encoding is None
    assert len(count) == 2
