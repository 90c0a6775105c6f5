"""LPIPS v0.1: distance of two pictures in the features of a small classification network, from weights on disk.

Zhang, Isola, Efros, Shechtman & Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric"
(arXiv:1801.03924). The package holds no weights: a folder with lpips_alex.safetensors and lpips_squeeze.safetensors is
given as an argument or in SPLATPAINTER_PERCEPTUAL. Train against "squeeze", report "alex": the score of a network that
was optimised against means nothing.

Weights file: tensors `stages.S.L...` (layer L of stage S of the trunk) and `heads.S` ([C_S] weights of its channels).
"""

from __future__ import annotations

import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from splatpainter.metrics.images import checked
from splatpainter.system.quick_dataclass import dataclass

Net = Literal["alex", "squeeze"]
VARIABLE = "SPLATPAINTER_PERCEPTUAL"
MIN_SIDE_PX = 32
"""Least height and width in pixels: below, the deepest features have no pixel left."""
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Input of the trunk: (2 x - 1 - SHIFT) / SCALE, per channel."""

# One tuple per stage, whose result is a tap: ("conv", stride, padding), ("pool", ceil_mode) or ("fire",) per layer.
_STAGES: dict[str, tuple[tuple[tuple[Any, ...], ...], ...]] = {
    "alex": (
        (("conv", 4, 2),),
        (("pool", False), ("conv", 1, 2)),
        (("pool", False), ("conv", 1, 1)),
        (("conv", 1, 1),),
        (("conv", 1, 1),),
    ),
    "squeeze": (
        (("conv", 2, 0),),
        (("pool", True), ("fire",), ("fire",)),
        (("pool", True), ("fire",), ("fire",)),
        (("pool", True), ("fire",)),
        (("fire",),),
        (("fire",),),
        (("fire",),),
    ),
}
_PARTS = {"conv": ("",), "fire": ("squeeze.", "expand1x1.", "expand3x3."), "pool": ()}


class LpipsUnavailable(ValueError):
    """The weights, or the package that reads them, are not there; the message is one line. Tables print "LPIPS n/a"."""


@dataclass(frozen=True)
class Lpips:
    """A loaded network. Calling it is differentiable in both pictures; the weights are constants."""

    net: Net
    weights: dict[str, Any]
    """Tensors of the weights file, by name."""

    def __call__(self, a: Any, b: Any, mask: Any = None) -> Any:
        """[B] distances, 0 for equal pictures. a, b: [B, 3, H, W] tensors in 0..1, at least 32 pixels each way; mask:
        [B or 1, 1, H, W] weights >= 0 of the pixels that count, averaged down to each tap's pixels."""
        import torch.nn.functional as F

        total = 0
        for stage, (x, y) in enumerate(zip(self.taps(a), self.taps(b), strict=True)):
            head = self.weights[f"heads.{stage}"].view(1, -1, 1, 1)
            values = ((x - y) ** 2 * head).sum(1)
            if mask is None:
                total = total + values.mean((1, 2))
            else:
                # Each tap has pixels of its own size; a pixel of which half is masked counts by half.
                share = F.adaptive_avg_pool2d(mask.to(values), values.shape[1:])[:, 0]
                total = total + (values * share).sum((1, 2)) / share.sum((1, 2))
        return total

    def taps(self, pictures: Any) -> list[Any]:
        """The trunk's features after each stage, unit length over channels: [B, C_S, H_S, W_S]. pictures: [B, 3, H, W]
        in 0..1."""
        import torch
        import torch.nn.functional as F

        height, width = pictures.shape[-2:]
        if pictures.ndim != 4 or pictures.shape[1] != 3 or min(height, width) < MIN_SIDE_PX:
            raise ValueError(
                f"LPIPS: expected pictures [B, 3, H, W] of at least {MIN_SIDE_PX}x{MIN_SIDE_PX}, "
                f"got {tuple(pictures.shape)}"
            )
        # Made at every call: the pictures say on which device and in which precision.
        shift = torch.tensor(SHIFT, dtype=pictures.dtype, device=pictures.device).view(1, 3, 1, 1)
        scale = torch.tensor(SCALE, dtype=pictures.dtype, device=pictures.device).view(1, 3, 1, 1)
        x = (2 * pictures - 1 - shift) / scale

        def conv(x: Any, name: str, stride: int = 1, padding: int = 0) -> Any:
            x = F.conv2d(x, self.weights[name + "weight"], self.weights[name + "bias"], stride, padding)
            return torch.relu(x)

        out = []
        for s, stage in enumerate(_STAGES[self.net]):
            for l, (kind, *options) in enumerate(stage):
                name = f"stages.{s}.{l}."
                if kind == "pool":
                    x = F.max_pool2d(x, 3, 2, ceil_mode=options[0])
                elif kind == "conv":
                    x = conv(x, name, *options)
                else:
                    thin = conv(x, name + "squeeze.")
                    x = torch.cat([conv(thin, name + "expand1x1."), conv(thin, name + "expand3x3.", 1, 1)], 1)
            # The small term inside the root keeps its gradient finite where all features are zero.
            out.append(x / (torch.sqrt((x * x).sum(1, keepdim=True) + 1e-20) + 1e-10))
        return out

    def to(self, device: Any = None, dtype: Any = None) -> Lpips:
        """The same network on another device or in another precision."""
        return replace(self, weights={name: t.to(device=device, dtype=dtype) for name, t in self.weights.items()})

    @staticmethod
    def load(net: Net = "alex", folder: str | Path | None = None) -> Lpips:
        """Read the weights in float32 on the CPU. folder: by default that of SPLATPAINTER_PERCEPTUAL. Raises
        LpipsUnavailable when folder, file or safetensors is missing, ValueError when the file is not these weights."""
        assert net in _STAGES, net
        weights_folder = folder if folder is not None else os.environ.get(VARIABLE)
        if not weights_folder:
            raise LpipsUnavailable(f"LPIPS: no weights; set {VARIABLE} to the folder of lpips_{net}.safetensors")
        path = Path(weights_folder) / f"lpips_{net}.safetensors"
        if not path.is_file():
            raise LpipsUnavailable(f"LPIPS: no weights; expected the file {path} (folder given, or {VARIABLE})")
        return Lpips(net, _read(path, net))


def lpips(a: Any, b: Any, mask: Any = None, *, net: Net = "alex", folder: str | Path | None = None) -> float:
    """LPIPS of two pictures [H, W, 3] with values in 0..1, H and W >= 32; mask: [H, W] bool, or weights >= 0, of the
    pixels that count. Label the number with its network ("LPIPS-Alex"). Raises as `Lpips.load`, and ValueError when
    shapes differ or no pixel counts."""
    import torch

    first, second, weights = checked(a, b, mask, "LPIPS")
    if first.shape[2] != 3:
        raise ValueError(f"LPIPS: expected pictures [H, W, 3], got {first.shape}")
    weights_folder = folder if folder is not None else os.environ.get(VARIABLE)
    network = _loaded(net, None if weights_folder is None else str(weights_folder))
    x, y = (torch.from_numpy(p.transpose(2, 0, 1).astype(np.float32))[None] for p in (first, second))
    with torch.no_grad():
        return float(network(x, y, None if weights is None else torch.from_numpy(weights)[None, None]))


@functools.lru_cache(maxsize=4)
def _loaded(net: Net, folder: str | None) -> Lpips:
    return Lpips.load(net, folder)


def _read(path: Path, net: Net) -> dict[str, Any]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError:
        raise LpipsUnavailable(
            "LPIPS: reading weights needs the safetensors package (pip install 'splatpainter[networks]')"
        ) from None
    try:
        weights = {name: tensor.float() for name, tensor in load_file(path).items()}
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: expected a safetensors file ({error})") from None
    # The names are those of one network: a file of the other one must not load in part.
    want = {f"heads.{s}" for s in range(len(_STAGES[net]))} | {
        f"stages.{s}.{l}.{part}{end}"
        for s, stage in enumerate(_STAGES[net])
        for l, layer in enumerate(stage)
        for part in _PARTS[layer[0]]
        for end in ("weight", "bias")
    }
    if set(weights) != want:
        odd = sorted(set(weights) ^ want)
        raise ValueError(f"{path}: expected the {len(want)} tensors of LPIPS {net}; first missing or unknown: {odd[0]}")
    return weights
