"""Small assets, edits and a painter of a few lines of numpy for the tests of the session."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.painter import Asset, Edit, EditSettings, EncodedAsset
from splatpainter.session import Session
from splatpainter.splats import SH_C0, Splats, rows_sha256
from tests.support.lift_scenes import disk, front, sheet

SIZE = 32
CAMERA = front(SIZE)
RED, GREEN, BLUE = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.1, 0.2, 0.9)


@dataclass
class FlatPainter:
    """Rows whose centres lie under the mask take the picture's colour; the first of them gets a child of half its size
    and shrinks. Global: every row moves by a tenth towards the picture's mean colour. It counts its calls."""

    preset: str = "flat"
    settings: EditSettings = EditSettings(precision="float32")
    model: Any = None
    """Any torch module: then it learns."""
    calls: list[str] = field(default_factory=list)

    def choose(self, method: str, mode: str) -> tuple[str, str]:
        if method == "ttt" and self.model is None:
            raise ValueError(
                "method 'ttt' needs a preset with trained weights; use method 'lift' or 'auto' without them"
            )
        return ("lift" if self.model is None else "ttt") if method == "auto" else method, ""

    def reads_pictures(self, mode: str) -> bool:
        return False

    def encodes(self, method: str, mode: str) -> bool:
        return method == "ttt"

    def with_settings(self, **changes: Any) -> FlatPainter:
        return replace(self, settings=replace(self.settings, **changes))

    def encode(self, splats: Splats, method: str = "auto") -> Asset:
        if self.model is None:
            return Asset(splats)
        encoded: Any = None
        return Asset(splats, encoding=EncodedAsset(self.model, encoded, np.arange(len(splats))))

    def apply(self, asset: Asset, edits: list[Edit], mode: str = "local", method: str = "auto") -> Asset:
        self.calls.append(edits[0].name)
        result = asset
        for edit in edits:
            result = self._one(result, edit, mode)
        return result

    def _one(self, asset: Asset, edit: Edit, mode: str) -> Asset:
        splats = asset.splats
        sh = splats.sh.copy()
        if mode == "global":
            goal = (edit.image.reshape(-1, 3).mean(0) - 0.5) / SH_C0
            sh[:, 0] += np.float32(0.1) * (goal - sh[:, 0])
            confidence = np.where(splats.means[:, 0] > 0, 1, 0.25).astype(np.float32)
            return replace(asset, splats=replace(splats, sh=sh), confidence=confidence)
        rows, u, v = under(splats, edit.camera, edit.mask)
        if not len(rows):
            raise ValueError("edit: no Gaussian contributes to the masked pixels")
        sh[rows, 0] = (edit.image[v, u] - 0.5) / SH_C0
        scales = splats.scales.copy()
        scales[rows[0]] /= 2
        result = replace(splats, sh=sh, scales=scales)
        child = result.take(rows[:1])
        result = result.append(replace(child, means=child.means + child.scales))
        encoding = asset.encoding
        if encoding is not None:
            parents = np.append(encoding.parent_ids, encoding.parent_ids[rows[0]])
            encoding = replace(encoding, parent_ids=parents, state=tuned(encoding.state, float(edit.image.mean())))
        return replace(asset, splats=result, encoding=encoding)


def tuned(state: Any, value: float) -> Any:
    """A state of a model's type that depends on the one before."""
    import torch

    from splatpainter.models.refine import RefineState
    from splatpainter.nn.fast_weights import FastWeights

    old = torch.zeros(2, 3) if state is None else state.blocks[0].w0
    weights = FastWeights(old * 0.5 + value, old.T.clone(), old + 1)
    return RefineState((weights, torch.full((4,), value)), None)


def under(splats: Splats, camera: Camera, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows whose centres are under the mask, their pixels' columns, lines)."""
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    x, y, z = (splats.means @ turn.T + shift).T
    with np.errstate(all="ignore"):
        pixels = (np.floor(focal * t / z + c) for focal, t, c in ((camera.fx, x, camera.cx), (camera.fy, y, camera.cy)))
        u, v = (np.clip(np.nan_to_num(values, nan=-1), -1, 1e6).astype(int) for values in pixels)
    ok = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    ok[ok] = True if mask is None else mask[v[ok], u[ok]]
    rows = np.flatnonzero(ok)
    return rows, u[rows], v[rows]


def asset(side: int = 10, degree: int = 1) -> Splats:
    return sheet(side, degree=degree, opacity=0.9)


def dab(color=RED, x: float = 16, y: float = 16, radius: float = 5, camera: Camera = CAMERA) -> Edit:
    """A disk of one colour; 8 bits, so that it goes through a PNG unchanged."""
    mask = disk(camera, x, y, radius)
    image = np.where(mask[..., None], np.round(np.array(color) * 255) / 255, 0.5).astype(np.float32)
    return Edit(np.round(image * 255).astype(np.uint8), camera, mask)


def flat(source: Any = None, project: Any = None, **how: Any) -> Session:
    """A session with the painter above."""
    painter: Any = how.pop("painter", None) or FlatPainter()
    return Session(asset() if source is None else source, project, painter=painter, **how)


def load(path: Path, **how: Any) -> Session:
    """A project with the painter above."""
    painter: Any = FlatPainter()
    return Session.load(path, painter=painter, **how)


def two_layers(path: Path) -> str:
    """A project with two layers and one undone step; the hash of what it shows."""
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        session.layers.add("paint", [dab(BLUE, 19)], name="blue", opacity=0.5)
        session.layers.add("paint", [dab(GREEN)], name="green")
        session.undo()
        return print_of(session)


def print_of(session: Session) -> str:
    """Hash of the shown rows."""
    return rows_sha256(session.splats)
