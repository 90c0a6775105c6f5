"""What a table asks of a method: an asset, one or more edits by pictures, and the truth to compare with.

A case knows no method. `Case.save` and `Case.load` keep it on disk, so that ground truth is path traced once.
V views of H x W pixels, N rows.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.painter import Mode
from splatpainter.splats import ATTRIBUTES, Splats

VERSION = 2
"""Of the files: another one is made anew."""


@dataclass(frozen=True)
class Pictures:
    """V pictures of one size and their cameras."""

    cameras: tuple[Camera, ...]
    """V."""
    colors: np.ndarray = field(repr=False)
    """[V, H, W, 3] float32 display sRGB 0..1, over each camera's background."""

    def __post_init__(self) -> None:
        if self.colors.ndim != 4 or self.colors.shape[0] != len(self.cameras) or self.colors.shape[3] != 3:
            raise ValueError(
                f"pictures: expected [{len(self.cameras)}, H, W, 3] for as many cameras, got {list(self.colors.shape)}"
            )

    def __len__(self) -> int:
        return len(self.cameras)

    def take(self, places: Any) -> Pictures:
        """The views at these places (indices, or bools), in their order."""
        chosen = np.arange(len(self))[np.asarray(places)]
        return Pictures(tuple(self.cameras[k] for k in chosen), self.colors[chosen])


@dataclass(frozen=True)
class Step:
    """One edit: what an artist hands in at once."""

    mode: Mode
    kind: str
    """zoom, stroke, text, sticker, photo, recolor, relight, ..."""
    edited: Pictures
    """V >= 1 edited views."""
    masks: np.ndarray = field(repr=False)
    """[V, H, W] bool what was edited; where the object is, for zooms and global kinds."""


@dataclass(frozen=True)
class Case:
    """One question of a table."""

    protocol: str
    name: str
    """Of the object."""
    label: str
    """Of the case among those of its protocol: file-name safe and unique, e.g. "gso_dino_3-relight-2views"."""
    asset: Splats = field(repr=False)
    """As the artist has it: numpy float32, N rows."""
    base: Pictures
    """Views of the unedited truth that the asset was built from."""
    steps: tuple[Step, ...]
    """The edits, in order; most tables have one."""
    before: Pictures
    """Novel views of the object before the edits (truth)."""
    after: Pictures
    """The same views after the last edit (truth)."""
    near: np.ndarray = field(repr=False)
    """[W] bool: the novel view is near the edit."""
    oracle: Pictures | None = None
    """True edited views from all around, for methods that are upper bounds; others never see them. None: there are
    none (edits made on a picture alone)."""
    setup_seconds: float = 0.0
    """What building the asset took, where it was built for this case."""
    facts: dict[str, Any] = field(default_factory=dict)
    """JSON values for notes and plots: views, environment, samples per pixel, source of truth, ..."""

    def save(self, folder: Path) -> None:
        """Write the case as case.json and case.npz (pictures as float16: 66 dB and more)."""
        arrays: dict[str, np.ndarray] = {f"asset_{name}": getattr(self.asset, name) for name in ATTRIBUTES}
        arrays["near"] = self.near
        shown = {"base": self.base, "before": self.before, "after": self.after}
        if self.oracle is not None:
            shown["oracle"] = self.oracle
        shown |= {f"step{k}": step.edited for k, step in enumerate(self.steps)}
        arrays |= {name: pictures.colors.astype(np.float16) for name, pictures in shown.items()}
        arrays |= {f"step{k}_masks": np.packbits(step.masks, axis=-1) for k, step in enumerate(self.steps)}
        told = {
            "version": VERSION,
            "protocol": self.protocol,
            "name": self.name,
            "label": self.label,
            "setup_seconds": self.setup_seconds,
            "facts": self.facts,
            "antialiased": self.asset.antialiased,
            "color_space": self.asset.color_space,
            "steps": [{"mode": step.mode, "kind": step.kind} for step in self.steps],
            "cameras": {name: [c.to_json() for c in pictures.cameras] for name, pictures in shown.items()},
        }
        folder.mkdir(parents=True, exist_ok=True)
        with files.writing(folder / "case.npz") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        with files.writing(folder / "case.json") as file:
            file.write(json.dumps(told, indent=1).encode())

    @staticmethod
    def load(folder: Path) -> Case:
        """Raises ValueError where the folder holds no whole case of this version."""
        try:
            told = json.loads((folder / "case.json").read_bytes())
            if told["version"] != VERSION:
                raise ValueError(f"version {told['version']}")
            with np.load(folder / "case.npz", allow_pickle=False) as arrays:
                return _case(told, dict(arrays))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{folder}: expected a case as `splatpainter bench` keeps it ({error})") from None

    @staticmethod
    def digest(folder: Path) -> str:
        """Of a saved case: 16 hex digits."""
        text = (folder / "case.json").read_bytes() + (folder / "case.npz").read_bytes()
        return hashlib.sha256(text).hexdigest()[:16]


def _case(told: dict[str, Any], arrays: dict[str, np.ndarray]) -> Case:
    def pictures(name: str) -> Pictures:
        cameras = tuple(Camera.from_json(c) for c in told["cameras"][name])
        return Pictures(cameras, arrays[name].astype(np.float32))

    steps = []
    for k, step in enumerate(told["steps"]):
        edited = pictures(f"step{k}")
        masks = np.unpackbits(arrays[f"step{k}_masks"], axis=-1, count=edited.colors.shape[2]).astype(bool)
        steps.append(Step(step["mode"], step["kind"], edited, masks))
    attributes: dict[str, Any] = {name: arrays[f"asset_{name}"] for name in ATTRIBUTES}
    return Case(
        protocol=told["protocol"],
        name=told["name"],
        label=told["label"],
        asset=Splats(**attributes, antialiased=told["antialiased"], color_space=told["color_space"]),
        base=pictures("base"),
        steps=tuple(steps),
        before=pictures("before"),
        after=pictures("after"),
        near=arrays["near"],
        oracle=pictures("oracle") if "oracle" in told["cameras"] else None,
        setup_seconds=told["setup_seconds"],
        facts=told["facts"],
    )
