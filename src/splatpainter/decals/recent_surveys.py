"""Surveys of decals that were made last: what is previewed and then laid is surveyed once, in the same place."""

from __future__ import annotations

import threading
from dataclasses import field

import numpy as np

from splatpainter.decals.decal_placement import DecalPlacement
from splatpainter.decals.decals import Decal
from splatpainter.painter import Asset
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.surface.estimate import Surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent

MAX_SURVEYS = 4
"""Places that are remembered: those of a decal that is tried here and there and comes back. One holds some 5 MB."""


@dataclass
class _Entry:
    """Where one decal lies, found out by whoever asks first."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    placement: DecalPlacement | None = None


class RecentSurveys:
    """Decals on one asset after the other. Threads may share it: who asks for a place that another one is looking for
    waits for that."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asset: tuple[Asset, Surface] | None = None
        self._entries: Recent[_Entry] = Recent(MAX_SURVEYS)

    def asset(self, splats: Splats, original: Splats, surface: Surface) -> Asset:
        """An asset of these (numpy; `original` is what the surface is of), the one of before where the Gaussians are
        the very same arrays: they are not written to."""
        with self._lock:
            if self._asset is not None and self._asset[1] is surface and _same_arrays(self._asset[0].splats, splats):
                return self._asset[0]
            asset = Asset(splats, original=original)
            self._asset = asset, surface
            self._entries.clear()
            return asset

    def placement(self, decal: Decal, asset: Asset, surface: Surface) -> DecalPlacement:
        """`decal.placed(asset, surface)`, at hand where a decal of that shape was placed there before; whatever else
        its picture shows. Raises ValueError as that does."""
        with self._lock:
            current = self._asset is not None and self._asset[0] is asset
            entry = self._entries.get(_key(decal, asset), _Entry) if current else _Entry()
        with entry.lock:
            if entry.placement is None:
                entry.placement = decal.placed(asset, surface)
            return entry.placement


def _same_arrays(first: Splats, second: Splats) -> bool:
    same = all(getattr(first, name) is getattr(second, name) for name in ATTRIBUTES)
    return same and first.antialiased == second.antialiased and np.array_equal(first.offset, second.offset)


def _key(decal: Decal, asset: Asset) -> tuple[object, ...]:
    """All that `Decal.placed` reads of a decal."""
    camera = decal.camera.within(asset.splats.offset)
    return (
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.world_to_camera.tobytes()),
        (decal.at, decal.size(asset), decal.longer_px, decal.angle, decal.wrap, decal.level),
    )
