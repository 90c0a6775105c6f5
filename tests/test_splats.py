"""The rows themselves: selection, origins, hashes; torch and numpy hold the same bits."""

from __future__ import annotations

import dataclasses
import hashlib
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import DTypeLike

import splatpainter as sp
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Source, Splats, rows_sha256
from tests.support.lift_scenes import bits, same_bits


def splats(count: int = 6, degree: int = 1, seed: int = 0, dtype: DTypeLike = np.float32) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, 1, (count, 3)).astype(dtype),
        quats=rng.normal(0, 1, (count, 4)).astype(dtype),
        scales=np.exp(rng.normal(-3, 1, (count, 3))).astype(dtype),
        opacities=rng.uniform(0, 1, count).astype(dtype),
        sh=rng.normal(0, 0.3, (count, (degree + 1) ** 2, 3)).astype(dtype),
    )


def from_file(count: int = 6, seed: int = 0) -> Splats:
    """As a reader returns them."""
    values = splats(count, seed=seed)
    return replace(values, source=Source(f"{seed}.ply", "ply", values, f"{seed:064x}"), origin=np.arange(count))


@pytest.mark.parametrize(
    "selection", [[4, 1, 1, 5], [True, False, False, True, True, False], []], ids=["selection", "mask", "none"]
)
def test_take(selection):
    asset, chosen = from_file(), np.array(selection, bool if selection[:1] == [True] else np.int64)
    some = asset.take(chosen)
    order = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
    assert len(some) == len(order) and some.sh_degree == 1
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(
            getattr(some, name), np.array([getattr(asset, name)[k] for k in order]).reshape(getattr(some, name).shape)
        )
    assert some.origin is not None and some.origin.tolist() == list(order)
    assert some.source is asset.source
    assert splats().take(chosen).origin is None


def test_children_carry_their_parents_origin_and_new_gaussians_none():
    asset = from_file()
    children = asset.take(np.array([5, 5, 2]))
    grown = asset.append(children).append(splats(2, seed=9))
    assert grown.origin is not None
    assert grown.origin.tolist() == [0, 1, 2, 3, 4, 5, 5, 5, 2, -1, -1]
    assert same_bits(grown.take(np.arange(6)), asset)
    assert same_bits(grown.take(np.arange(6, 9)), children)
    assert same_bits(grown.take(np.arange(9, 11)), splats(2, seed=9))
    assert len(asset) == 6 and asset.origin is not None and len(asset.origin) == 6
    # Without a source there are no origins, whatever is appended.
    assert splats().append(asset).origin is None


def test_gaussians_of_another_file_do_not_claim_gaussians_of_this_one():
    grown = from_file(4).append(from_file(6, seed=1))
    assert grown.origin is not None and grown.origin.tolist() == [0, 1, 2, 3] + [-1] * 6
    assert grown.source is not None and grown.source.path == "0.ply"


def test_append_refuses_another_degree():
    with pytest.raises(AssertionError, match="degree"):
        splats(degree=1).append(splats(degree=2))


def test_degrees():
    for count, degree in SH_COUNTS.items():
        assert count == (degree + 1) ** 2
        assert splats(2, degree).sh_degree == degree


def test_gaussians_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        splats().means = np.zeros((6, 3))  # type: ignore[misc]


ODD = {
    "NaN mean": ("means", (1,), np.nan),
    "infinite mean": ("means", (2,), -np.inf),
    "NaN rotation": ("quats", (0,), np.nan),
    "zero rotation": ("quats", slice(None), 0),
    "infinite scale": ("scales", (1,), np.inf),
    "zero scale": ("scales", (2,), 0),
    "negative scale": ("scales", (0,), -0.1),
    "NaN opacity": ("opacities", (), np.nan),
    "infinite colour": ("sh", (3, 2), np.inf),
    "opacity above 1": ("opacities", (), 1.001),
    "opacity of float32's end": ("opacities", (), 3.4e38),
    "negative opacity": ("opacities", (), -0.01),
    "centre too far": ("means", (2,), -1e30),
    "scale too large": ("scales", (1,), 1e16),
    "rotation whose square overflows": ("quats", (0,), 1e30),
    "rotation whose square vanishes": ("quats", (), 1e-20),
    "colour too large": ("sh", (3, 1), -1e38),
}


@pytest.mark.parametrize("case", ODD)
@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_gaussians_that_cannot_be_drawn(case, kind):
    name, index, value = ODD[case]
    asset = splats()
    getattr(asset, name)[(2, *index) if isinstance(index, tuple) else 2] = value
    asset = asset if kind == "numpy" else asset.torch()
    assert asset.drawable.tolist() == [True, True, False, True, True, True]


def test_tiny_gaussians_and_unnormalised_rotations_can_be_drawn():
    asset = splats()
    asset.quats[0] *= 1e-12
    asset.scales[1] = 1e-30
    asset.opacities[2:4] = 0, 1
    asset.means[4], asset.scales[4], asset.sh[4] = 1e15, 1e15, -1e13
    assert asset.drawable.all()


def test_the_hash_is_that_of_the_values_one_attribute_after_the_other():
    asset = Splats(
        np.array([[1, 2, 3], [4, 5, 6]], np.float32),
        np.array([[1, 0, 0, 0], [0, 1, 0, 0]], np.float32),
        np.array([[0.5, 0.25, 1], [2, 2, 2]], np.float32),
        np.array([0.125, 1], np.float32),
        np.array([[[7, 8, 9]], [[-1, -0.0, np.nan]]], np.float32),
    )
    first = struct.pack("<3f", 1, 2, 3), struct.pack("<4f", 1, 0, 0, 0), struct.pack("<3f", 0.5, 0.25, 1)
    first += struct.pack("<f", 0.125), struct.pack("<3f", 7, 8, 9)
    second = struct.pack("<3f", 4, 5, 6), struct.pack("<4f", 0, 1, 0, 0), struct.pack("<3f", 2, 2, 2)
    second += struct.pack("<f", 1), struct.pack("<2f", -1, -0.0) + b"\x00\x00\xc0\x7f"
    digest = hashlib.sha256(b"".join(a + b for a, b in zip(first, second, strict=True))).hexdigest()
    assert rows_sha256(asset) == asset.sha256 == digest
    assert rows_sha256(asset.torch()) == digest
    assert rows_sha256(asset, np.array([1])) == hashlib.sha256(b"".join(second)).hexdigest()
    assert rows_sha256(asset, np.array([True, False])) == hashlib.sha256(b"".join(first)).hexdigest()
    swapped = hashlib.sha256(b"".join(b + a for a, b in zip(first, second, strict=True))).hexdigest()
    assert rows_sha256(asset, np.array([1, 0])) == swapped
    assert rows_sha256(asset, np.zeros(0, np.int64)) == hashlib.sha256(b"").hexdigest()
    big = replace(asset, **{name: getattr(asset, name).astype(">f4") for name in ATTRIBUTES})
    assert rows_sha256(big) == digest


def test_sha256_is_the_files_until_a_gaussian_changes(tmp_path):
    path = tmp_path / "a.ply"
    sp.write(path, splats())
    asset = sp.read(path)
    assert asset.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    sh = asset.sh.copy()
    sh[3, 0, 1] += 1
    edited = replace(asset, sh=sh)
    assert edited.sha256 == rows_sha256(edited) != asset.sha256
    assert asset.append(asset.take(np.array([0]))).sha256 != asset.sha256


def test_torch_and_numpy_hold_the_same_bits():
    asset = splats(degree=2)
    patterns = np.array([0x7FC00001, 0xFFC12345, 0x00000001, 0x80000000, 0x7F800000, 0x00800000], np.uint32)
    asset.opacities[:] = patterns.view(np.float32)  # NaN with payload, denormal, -0.0, infinity
    there = asset.torch()
    assert all(getattr(there, name).dtype == torch.float32 for name in ATTRIBUTES)
    back = there.numpy()
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(bits(getattr(back, name)), bits(getattr(asset, name)), err_msg=name)
    assert asset.numpy() is asset
    assert len(there) == 6 and there.sh_degree == 2
    assert there.take(torch.tensor([1, 0])).means.tolist() == asset.means[[1, 0]].tolist()
    assert there.append(there.take(torch.tensor([5]))).opacities.shape == (7,)


def test_torch_shares_memory_and_numpy_leaves_the_graph():
    asset = splats()
    assert asset.torch().means.data_ptr() == asset.means.ctypes.data
    asset.sh.flags.writeable = False  # tensors can be written to, so they may not share this one
    apart = asset.torch().sh
    apart[0] = 7
    assert (asset.sh != 7).all() and (apart[0] == 7).all()
    double = asset.torch(dtype=torch.float64)
    assert double.means.dtype == torch.float64
    graph = replace(double, means=double.means.requires_grad_(True))
    np.testing.assert_array_equal(graph.numpy().means, asset.means)
    assert graph.numpy().sh.dtype == np.float32


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_gaussians_of_a_file_become_tensors_without_a_warning(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    sp.write(path, splats(degree=0))
    asset = sp.read(path)
    there = asset.torch()
    assert there.source is asset.source
    np.testing.assert_array_equal(there.means.numpy(), asset.means)
