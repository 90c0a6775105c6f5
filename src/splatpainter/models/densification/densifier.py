"""The densifier: an asset and pictures of what it should look like in, the asset with finer rows where they differ out.

    made = densified(model, splats, cameras, colors)       one pass, nothing is optimised

Chosen rows are replaced, not added to: the result is the rows that were not chosen, in their order, then the new ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from splatpainter.cameras import Camera
from splatpainter.models import checkpoint
from splatpainter.models.densification.config import DensifyConfig
from splatpainter.models.densification.looks import Chosen, choose, gather, look
from splatpainter.models.densification.network import Network
from splatpainter.splats import Splats

LEAST = 16
"""Rows to choose from; with fewer there is nothing to densify."""


class Densifier(nn.Module):
    """The network with its weights."""

    notes: dict[str, Any]
    """What the checkpoint said about these weights; empty for untrained ones."""

    def __init__(self, config: DensifyConfig) -> None:
        """Untrained; seed torch before for reproducible weights."""
        super().__init__()
        self.config, self.notes = config, {}
        self.network = Network(config)

    @staticmethod
    def load(folder: Path | str) -> Densifier:
        """The model of a checkpoint, float32 on the CPU, ready to use (eval). Raises ValueError as checkpoint.load and
        checkpoint.fill."""
        held = checkpoint.load(folder, kind=DensifyConfig)
        model = Densifier(held.config)
        checkpoint.fill(model, held.tensors, str(folder))
        model.notes = held.notes
        return model.eval()

    def save(self, folder: Path | str, notes: dict[str, Any] | None = None) -> None:
        """Write a checkpoint in half precision, all or nothing. Raises ValueError as checkpoint.save."""
        checkpoint.save(folder, self.config, self.state_dict(), notes=self.notes if notes is None else notes)

    def forward(self, chosen: Chosen, rng: np.random.Generator | None = None) -> tuple[Splats, Tensor]:
        """As Network.forward, of rows and features that lie anywhere."""
        device = next(self.parameters()).device
        tensors = {name: getattr(chosen, name).to(device) for name in ("axes", "ranks", "features")}
        return self.network(replace(chosen, rows=chosen.rows.torch(str(device)), **tensors), rng)


@dataclass(frozen=True)
class Densified:
    """What came out. Torch."""

    splats: Splats
    """Rows that stayed, then the new ones; differentiable in the weights."""
    chosen: np.ndarray = field(repr=False)
    """[S] int64 ascending: rows of the asset that were replaced."""
    parents: np.ndarray = field(repr=False)
    """[new rows] int64: the row of the asset that each new one replaces a part of."""


def picked(
    config: DensifyConfig,
    splats: Splats,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    device: str = "cpu",
) -> tuple[np.ndarray, Chosen]:
    """(rows to be replaced [S], the same as the network takes them). splats: numpy; colors: V pictures [H, W, 3] over
    their cameras' backgrounds, sizes may differ. Raises ValueError without views, for a picture of another size than
    its camera's, and where the views pull at fewer than LEAST rows."""
    if not cameras or len(cameras) != len(colors):
        raise ValueError(f"densify: expected a picture for each camera, got {len(colors)} for {len(cameras)}")
    for camera, color in zip(cameras, colors, strict=True):
        if color.shape != (camera.height, camera.width, 3):
            raise ValueError(f"densify: expected {camera.width}x{camera.height} RGB pictures, got {list(color.shape)}")
    looks = look(splats, cameras, colors, device)
    chosen = choose(splats, looks.pull, config)
    if len(chosen) < LEAST:
        raise ValueError(f"densify: expected at least {LEAST} rows that the views show, got {len(chosen)}")
    return chosen, gather(splats, chosen, looks, cameras, colors, config)


def densified(
    model: Densifier,
    splats: Splats,
    cameras: Sequence[Camera],
    colors: Sequence[np.ndarray],
    rng: np.random.Generator | None = None,
    most: int = 0,
) -> Densified:
    """One pass. Arguments and errors as `picked`; rng as Network.forward; most: rows to be replaced, 0: as the config
    says."""
    device = str(next(model.parameters()).device)
    config = replace(model.config, most=most or model.config.most)
    chosen, told = picked(config, splats, cameras, colors, "cuda" if device.startswith("cuda") else device)
    fine, parents = model(told, rng)
    stay = np.ones(len(splats), bool)
    stay[chosen] = False
    coarse = replace(splats.take(stay), source=None, origin=None).torch(device)
    return Densified(coarse.append(fine), chosen, chosen[parents.cpu().numpy()])
