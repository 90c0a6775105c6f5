"""Checkpoints: exact round trip, shards, atomic replacement, and one line for everything that can be wrong."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save
from safetensors.torch import load_file
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from splatpainter.models import checkpoint
from splatpainter.models.config import PRESETS

CONFIG = PRESETS["compact"]


def small_net() -> nn.Module:
    torch.manual_seed(5)
    return nn.Sequential(nn.Linear(7, 5), nn.LayerNorm(5), nn.Linear(5, 2, bias=False))


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float32"])
def test_round_trip(tmp_path: Path, dtype: str) -> None:
    net = small_net()
    checkpoint.save(tmp_path / "w", CONFIG, net.state_dict(), dtype=dtype, notes={"steps": 12})  # type: ignore[arg-type]
    back = checkpoint.load(tmp_path / "w", "compact")
    assert back.config == CONFIG and back.notes == {"steps": 12}
    kind = getattr(torch, dtype)
    assert back.tensors.keys() == net.state_dict().keys()
    for name, value in net.state_dict().items():
        assert torch.equal(back.tensors[name], value.to(kind))
    with torch.device("meta"):
        other = nn.Sequential(nn.Linear(7, 5), nn.LayerNorm(5), nn.Linear(5, 2, bias=False))
    checkpoint.fill(other, back.tensors)
    for name, value in other.state_dict().items():
        assert value.dtype == torch.float32 and torch.equal(value, net.state_dict()[name].to(kind).float())
    assert all(p.requires_grad for p in other.parameters())


def test_filling_a_real_module_keeps_its_own_tensors(tmp_path: Path) -> None:
    """An optimizer made before holds the same parameters."""
    net, other = small_net(), small_net()
    for p in other.parameters():
        nn.init.zeros_(p)
    before = list(other.parameters())
    checkpoint.fill(other, net.state_dict())
    assert all(a is b for a, b in zip(before, other.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b in zip(net.parameters(), other.parameters(), strict=True))


def test_shards_stay_below_the_limit_and_large_tensors_are_cut(tmp_path: Path) -> None:
    g = torch.Generator().manual_seed(0)
    tensors = {
        "large": torch.randn(4096, 1500, generator=g),  # 23 MiB in float32
        "exact": torch.randn(15, 1 << 18, generator=g),  # 15 MiB to the byte
        **{f"small{i}": torch.randn(300, 1000, generator=g) for i in range(15)},
        "scalar": torch.tensor(3.5),
        "count": torch.tensor([1 << 40]),
    }
    checkpoint.save(tmp_path, CONFIG, tensors, dtype="float32")
    shards = sorted(tmp_path.glob("*.safetensors"))
    assert len(shards) > 3 and all(path.stat().st_size <= 15 * 1024 * 1024 for path in shards)
    # An independent reader sees the same numbers.
    plain: dict[str, Tensor] = {}
    for path in shards:
        plain |= load_file(path)
    assert torch.equal(torch.cat([plain["large@0"], plain["large@1"]]), tensors["large"])
    back = checkpoint.load(tmp_path).tensors
    assert all(torch.equal(back[name], value) for name, value in tensors.items())


def test_a_new_checkpoint_replaces_the_old_one_whole(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, CONFIG, small_net().state_dict())
    (tmp_path / "README.md").write_text("mine")
    checkpoint.save(tmp_path, replace(CONFIG, preset="other"), {"a": torch.ones(3)})
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".md", ".safetensors"]
    assert checkpoint.load(tmp_path).tensors.keys() == {"a"}


def test_an_interrupted_save_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    net = small_net()
    checkpoint.save(tmp_path, CONFIG, net.state_dict())
    writing = checkpoint.writing

    def fails_at_the_index(path: Path) -> object:
        if path.name == checkpoint.INDEX:
            raise ValueError("disk full")
        return writing(path)

    monkeypatch.setattr(checkpoint, "writing", fails_at_the_index)
    with pytest.raises(ValueError, match="disk full"):
        checkpoint.save(tmp_path, CONFIG, {"a": torch.ones(3)})
    assert checkpoint.load(tmp_path).tensors.keys() == net.state_dict().keys()


def test_values_that_half_cannot_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="tensor 'big' has values that float16 cannot hold"):
        checkpoint.save(tmp_path, CONFIG, {"big": torch.tensor([70000.0])})
    assert not (tmp_path / checkpoint.INDEX).exists()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda d: d.update(version=2), "written by a newer SplatPainter"),
        (lambda d: d.update(version="1"), "expected a version number, got '1'"),
        (lambda d: d.update(format="torch"), "expected format 'splatpainter model'"),
        (lambda d: d["config"].update(colour=1), "unknown key 'colour'"),
        (lambda d: d["config"]["lrm"].pop("dim"), "missing key 'lrm.dim'"),
        (lambda d: d.pop("config"), "expected an object as model config"),
        (lambda d: d.pop("shards"), "expected lists of shards and tensors"),
        (lambda d: d["tensors"].update(ghost={"shape": [1], "parts": 1}), "tensor 'ghost' is in no shard"),
        (lambda d: d["tensors"].pop("2.weight"), "hold a tensor that it does not name: 2.weight"),
        (
            lambda d: d["tensors"]["2.weight"].update(shape=[2, 6]),
            "tensor '2.weight': expected shape [2, 6], got [2, 5]",
        ),
        (lambda d: d["tensors"]["2.weight"].update(parts=10**9), "tensor '2.weight': expected 1.."),
        (lambda d: d["shards"][0].update(sha256="0" * 64), "damaged"),
        (lambda d: d["shards"][0].update(file="../x.safetensors"), "expected shards named weights-"),
        (
            lambda d: d["shards"][0].update(file="weights-0123456789abcdef.safetensors"),
            "missing; copy the whole folder",
        ),
        (lambda d: d["shards"].append(d["shards"][0]), "is in two shards"),
    ],
)
def test_a_wrong_index_is_refused_by_name(tmp_path: Path, change: Callable[[dict], object], complaint: str) -> None:
    checkpoint.save(tmp_path, CONFIG, small_net().state_dict())
    path = tmp_path / checkpoint.INDEX
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError) as caught:
        checkpoint.load(tmp_path)
    assert complaint in str(caught.value) and str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_another_preset_no_folder_and_broken_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no weights there"):
        checkpoint.load(tmp_path / "nowhere")
    checkpoint.save(tmp_path, CONFIG, small_net().state_dict())
    with pytest.raises(ValueError, match="expected weights of preset 'paper', these are of preset 'compact'"):
        checkpoint.load(tmp_path, "paper")
    shard = next(tmp_path.glob("*.safetensors"))
    shard.write_bytes(shard.read_bytes()[:-1])
    with pytest.raises(ValueError, match="damaged"):
        checkpoint.load(tmp_path)
    (tmp_path / checkpoint.INDEX).write_text("{")
    with pytest.raises(ValueError, match="expected JSON"):
        checkpoint.load(tmp_path)


def test_bfloat16_is_read_as_what_torch_makes_of_it() -> None:
    numbers = torch.tensor([0.1, -3e38, 1e-40, 0.0, -7.25, float("inf")])
    read = checkpoint._unpack_numpy(save_tensors({"a": numbers.bfloat16().reshape(2, 3)}))["a"]
    np.testing.assert_array_equal(read, numbers.bfloat16().float().reshape(2, 3).numpy(), strict=True)


def packed(table: object, numbers: bytes = bytes(8)) -> bytes:
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    return len(text).to_bytes(8, "little") + text + numbers


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i4", "i8", "u1"])
def test_arrays_are_read_as_safetensors_reads_them(dtype: str) -> None:
    arrays = {"a": np.arange(6, dtype=dtype).reshape(2, 3), "b.c": np.ones((), dtype), "none": np.zeros((0, 4), dtype)}
    data = save(arrays, {"made": "by hand"})
    read, expected = checkpoint._unpack_numpy(data), load(data)
    assert read.keys() == expected.keys()
    for name, array in read.items():
        assert array.dtype == expected[name].dtype
        np.testing.assert_array_equal(array, expected[name], strict=True)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        packed(b"{")[:-3],
        packed(b"\xff\xfe"),
        packed([]),
        packed(b"[" * 100_000),
        packed({"a": 3}),
        packed({"a": {"dtype": "F32", "shape": [2]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": ["0", "8"]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0.5, 8]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": [8, 16]}}),
        packed({"a": {"dtype": "F32", "shape": [3], "data_offsets": [0, 8]}}),
        packed({"a": {"dtype": "F32", "shape": ["2"], "data_offsets": [0, 8]}}),
        packed({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 7]}}),
        packed({"a": {"dtype": "C64", "shape": [1], "data_offsets": [0, 8]}}),
        packed({"a": {"dtype": ["F32"], "shape": [2], "data_offsets": [0, 8]}}),
    ],
)
def test_a_damaged_table_of_arrays_is_one_line(data: bytes, tmp_path: Path) -> None:
    digest = hashlib.sha256(data).hexdigest()
    shard = {"file": f"weights-{digest[:16]}.safetensors", "sha256": digest, "holds": "a"}
    (tmp_path / shard["file"]).write_bytes(data)
    index = {"format": CONFIG.format, "version": 1, "tensors": {}, "shards": [shard]}
    (tmp_path / checkpoint.INDEX).write_text(json.dumps(index))
    with pytest.raises(ValueError, match=r"^[^\n]*: not a safetensors file \([^\n]*\)$"):
        checkpoint.load_arrays(tmp_path, "a")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda t: t.update(extra=torch.ones(1)), "unknown weights: extra;"),
        (lambda t: t.pop("1.bias"), "missing weights: 1.bias;"),
        (lambda t: t.update({"1.bias": torch.ones(4)}), r"mis-shaped weights: 1.bias \[4\] instead of \[5\];"),
    ],
)
def test_filling_with_other_weights_names_them_and_changes_nothing(
    change: Callable[[dict], object], complaint: str
) -> None:
    tensors = dict(small_net().state_dict())
    net = small_net()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    tensors["0.weight"] = tensors["0.weight"] + 1
    change(tensors)
    with pytest.raises(ValueError, match=complaint):
        checkpoint.fill(net, tensors, "here")
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())


def test_a_checkpoint_on_a_base_holds_what_differs_and_needs_that_very_base(tmp_path: Path) -> None:
    first = {"lrm.a": torch.arange(6.0).reshape(2, 3), "head.b": torch.ones(3)}
    second = {**first, "head.b": torch.full((3,), 2.0)}
    checkpoint.save(tmp_path / "one", CONFIG, first)
    checkpoint.save(tmp_path / "two", CONFIG, second, base="one", shared=("lrm.",))
    sizes = [sum(f.stat().st_size for f in (tmp_path / n).glob("*.safetensors")) for n in ("one", "two")]
    assert sizes[1] < sizes[0]
    held = checkpoint.load(tmp_path / "two").tensors
    assert held.keys() == second.keys() and all(torch.equal(held[name], value.half()) for name, value in second.items())
    with pytest.raises(ValueError, match="tensor 'lrm.a' is not that of its base 'one'"):
        other = {**first, "lrm.a": torch.zeros(2, 3)}
        checkpoint.save(tmp_path / "three", CONFIG, other, base="one", shared=("lrm.",))
    with pytest.raises(ValueError, match="name of a folder beside"):
        checkpoint.save(tmp_path / "three", CONFIG, second, base="../one", shared=("lrm.",))
    with pytest.raises(ValueError, match="has a base itself"):
        checkpoint.save(tmp_path / "three", CONFIG, second, base="two", shared=("lrm.",))
    checkpoint.save(tmp_path / "one", CONFIG, {**first, "lrm.a": torch.zeros(2, 3)})
    with pytest.raises(ValueError, match="not the one it was saved with"):
        checkpoint.load(tmp_path / "two")
    (tmp_path / "one" / "model.json").unlink()
    with pytest.raises(ValueError, match="its base 'one' is missing beside it"):
        checkpoint.load(tmp_path / "two")
