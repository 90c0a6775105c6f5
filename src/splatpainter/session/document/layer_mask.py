"""Masks of layers: how much of a layer each of its Gaussians shows, 0..1. A factor of the layer's opacity.

A mask starts from all of the layer or nothing of it, and parts change that, one after the other. A part is painted on a
view (a picture of what to show, and how far to go there), is a selection (selection.py: what is not selected is not
shown, from any side), or says by a rule what to show: height, slope, or how well the layers below it were seen.
Where every weight is 0 the layer is not there, bit for bit. Parts are evaluated on what the layer made, so paint that
is finer than what it lies on has a mask that is as fine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

Rule = Literal["height", "slope", "coverage", "curvature"]
MIN_SEEN_PX = 0.02
"""Pixels of weight from which a view shows a Gaussian."""
MAX_PARTS = 256
"""Most parts of one mask. Painting from the same view again changes the part of that view, if it is the last."""
MAX_NOTE = 80
"""Characters of a wrong value in an error."""


@dataclass(frozen=True)
class MaskPart:
    """One change of a mask."""

    camera: Camera | None = None
    """Camera of a painted part."""
    picture: str | None = None
    """Hash of a PNG of the camera's size with two channels: what to show (0: nothing, 255: all), and how far to go
    there (0: as it was)."""
    selection: str | None = None
    """Hash of a Selection's PNG: its weights are factors."""
    rule: Rule | None = None
    """height: share of the way from the lowest to the highest Gaussian, along `axis`; slope: degrees between a
    Gaussian's normal and `axis`; coverage: 0 untouched by the layers below, 1 seen in one of their views, 2 predicted;
    curvature: degrees by which the surface bends around the Gaussian (curvature.py), above 0 on edges, below in
    crevices."""
    low: float = 0.0
    high: float = 1.0
    """What lies between both is shown, all else is not."""
    soft: float = 0.0
    """Width of a ramp on both sides (the rule's unit)."""
    axis: tuple[float, float, float] = (0.0, -1.0, 0.0)
    """Unit vector, world axes."""

    def record(self) -> dict[str, Any]:
        if self.selection is not None:
            return {"selection": self.selection}
        if self.rule is None:
            assert self.camera is not None
            return {"camera": self.camera.record(), "picture": self.picture}
        return {"rule": self.rule, "low": self.low, "high": self.high, "soft": self.soft, "axis": list(self.axis)}


@dataclass(frozen=True)
class LayerMask:
    """A mask."""

    shows: bool = True
    """Whether it starts from all of the layer, or from nothing."""
    parts: tuple[MaskPart, ...] = ()
    enabled: bool = True

    def record(self) -> dict[str, Any]:
        return {"shows": self.shows, "enabled": self.enabled, "parts": [part.record() for part in self.parts]}

    @staticmethod
    def parse(data: Any, where: str) -> LayerMask | None:
        """Raises ValueError, TypeError or KeyError for what is no mask."""
        if data is None:
            return None
        if len(data["parts"]) > MAX_PARTS:
            raise ValueError(f"expected at most {MAX_PARTS} parts of a mask, got {len(data['parts'])}")
        parts = tuple(_parsed_part(part, where) for part in data["parts"])
        return LayerMask(bool(data["shows"]), parts, bool(data["enabled"]))

    def pictures(self) -> set[str]:
        """Hashes of its pictures and selections."""
        return {name for part in self.parts for name in (part.picture, part.selection) if name}


def by_rule(rule: Rule, low: float, high: float, soft: float = 0.0, axis: Any = (0.0, -1.0, 0.0)) -> MaskPart:
    """A part by a rule. Raises ValueError: unknown, not finite, low above high, no axis."""
    if rule not in get_args(Rule):
        raise ValueError(f"mask: expected a rule of {', '.join(get_args(Rule))}, got {str(rule)[:MAX_NOTE]!r}")
    numbers = np.asarray([low, high, soft, *axis], float)
    if numbers.shape != (6,) or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        raise ValueError("mask: expected finite numbers as low, high, soft and an axis of three")
    if low > high or soft < 0:
        raise ValueError(f"mask: expected low up to high, and soft from 0, got {low:g}, {high:g} and {soft:g}")
    # Unit length, as the rules measure heights and angles along it.
    length = portable.length(numbers[3:])
    if length < 1e-9:
        raise ValueError("mask: expected an axis that is not 0")
    x, y, z = (float(value) for value in numbers[3:] / length)
    return MaskPart(rule=rule, low=float(low), high=float(high), soft=float(soft), axis=(x, y, z))


def _parsed_part(data: dict[str, Any], where: str) -> MaskPart:
    if "rule" in data:
        return by_rule(data["rule"], data["low"], data["high"], data["soft"], data["axis"])
    if "selection" in data:
        return MaskPart(selection=_hash(data["selection"], "selection"))
    # A picture is named by its hash alone, so that a part of a file names no path.
    camera = Camera.from_record(data["camera"], where)
    return MaskPart(camera, _hash(data["picture"], "picture"))


def _hash(name: Any, what: str) -> str:
    if not (isinstance(name, str) and len(name) == 64 and set(name) <= set("0123456789abcdef")):
        raise ValueError(f"expected the SHA-256 of a {what}, got {str(name)[:MAX_NOTE]!r}")
    return name


def over(shows: np.ndarray, share: np.ndarray, new_shows: np.ndarray, new_share: np.ndarray) -> tuple[Any, Any]:
    """(what to show, how far), [H, W] 0..1 each, of two painted parts of one view, the new one after the other."""
    # As one layer of paint over another: dabs in a row may then be kept as one part.
    total = share + new_share - share * new_share
    mixed = shows * share * (1 - new_share) + new_shows * new_share
    return np.where(total > 0, mixed / np.maximum(total, 1e-9), 0), total


def changed_weights(
    weights: np.ndarray, splats: Splats, part: MaskPart, picture: np.ndarray | None, coverage: np.ndarray
) -> np.ndarray:
    """[N] float32 weights after one more part. picture: [H, W, 2] 0..1 of a painted one; coverage: [N] uint8
    (conflicts.coverage) of the layers below."""
    if part.rule is None:
        assert picture is not None and part.camera is not None
        return _painted(weights, splats, part.camera, picture)
    # Weights only shrink here: a rule says where a layer shows, and adds nothing to what hides it elsewhere.
    value = _measured(splats, part, coverage)
    if part.soft > 0:
        rise = (value - part.low) / part.soft + 1
        fall = (part.high - value) / part.soft + 1
        inside = np.clip(np.minimum(rise, fall), 0, 1)
    else:
        inside = (value >= part.low) & (value <= part.high)
    return (weights * inside).astype(np.float32)


def _painted(weights: np.ndarray, splats: Splats, camera: Camera, picture: np.ndarray) -> np.ndarray:
    """Each Gaussian that the view shows goes by the means of the picture over its visible footprint."""
    from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask

    share = np.ascontiguousarray(picture[..., 1], np.float32)
    if not share.any():
        return weights
    bare = replace(splats, source=None, origin=None)
    # Only what the painted tiles show may change; how much of it is painted, its whole footprint says.
    touched = project(bare, camera, tiles=tiles_of_mask(share > 0)).gaussian_ids
    near = np.zeros(len(splats), bool)
    near[touched] = True
    near &= splats.opacities > 0
    view = project(bare, camera)
    zeros = np.zeros((*share.shape, 3), np.float32)
    total = view.backproject(zeros, np.ones_like(share)).weight
    goal = view.backproject(zeros, np.ascontiguousarray(share * picture[..., 0], np.float32)).weight
    reach = view.backproject(zeros, share).weight
    seen = near[view.gaussian_ids] & (total > MIN_SEEN_PX)
    ids, out = view.gaussian_ids[seen], weights.copy()
    out[ids] = out[ids] * (1 - reach[seen] / total[seen]) + goal[seen] / total[seen]
    return np.clip(out, 0, 1)


def _measured(splats: Splats, part: MaskPart, coverage: np.ndarray) -> np.ndarray:
    """[N] what a rule goes by."""
    axis = np.array(part.axis)
    if part.rule == "coverage":
        return coverage.astype(float)
    if part.rule == "height":
        heights = (splats.means.astype(float) * axis).sum(1)
        # Emptied Gaussians still have places, and would stretch the scale.
        solid = heights[splats.drawable & (splats.opacities > 0)]
        low, high = (solid.min(), solid.max()) if len(solid) else (0.0, 1.0)
        return (heights - low) / max(high - low, 1e-12)
    if part.rule == "curvature":
        from splatpainter.session.measures.curvature import bend_degrees

        return bend_degrees(splats)
    from splatpainter.lift.depth_normals import outward_normals

    cosines = np.clip((outward_normals(splats) * axis).sum(1), -1, 1)
    return np.degrees(portable.arccos(cosines))
