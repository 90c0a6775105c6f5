"""An edit in one call: `sp.edit(splats, [(picture, camera), sp.Grade(exposure=0.3)])`; a `Painter` is for many with one
set of weights, and `sp.apply_to_file` for files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import splatpainter.session  # noqa: F401 - whose files regions and looks may name
from splatpainter.cameras import Camera
from splatpainter.decals.decals import Decal
from splatpainter.lights.unlit import unlit_after
from splatpainter.operations.decal import LayDecal
from splatpainter.operations.operation import Operation, Report, Tools
from splatpainter.operations.paint import Paint
from splatpainter.operations.to_file import AppliedOperation, receipt_of_all
from splatpainter.painter import Asset, Edit, Method, Mode, Painter
from splatpainter.splats import Splats

EditedPicture = Edit | tuple[np.ndarray, Camera]
"""An Edit, or [H, W, 3] the edited view (float 0..1 or uint8) and its camera."""


def edit(
    splats: Splats | Asset,
    operations: Sequence[EditedPicture | Decal | Operation],
    *,
    mode: Mode = "local",
    method: Method = "auto",
    preset: str = "auto",
) -> Asset:
    """The asset after operations, in their order; its `splats` are the edited Gaussians and its `receipt` proves which
    stayed as they were. Give an asset that came back to go on from it.

    operations: edited pictures, 1 to 16 beside one another being one edit; decals; operations by files and options
    (sp.Paint, sp.Grade, sp.Fill, ...). mode, of pictures: "local": what was painted changes; "global": one regraded or
    relit view changes everything; "spread": what was painted and the rest of its material. method, preset: as of
    Painter. Raises ValueError as Painter.load, Painter.apply and the operations."""
    start = splats if isinstance(splats, Asset) else Asset(splats.numpy())
    asset, steps = start, list[AppliedOperation]()
    for step in _together(operations):
        if isinstance(step, Operation):
            kind, result = step, step.apply(asset, Tools(), Report())
        else:
            is_decal = isinstance(step, Decal)
            how: Mode = "local" if is_decal else mode
            by: Method = "lift" if is_decal and method == "auto" else method
            painter = Painter.load(preset, modes=[how])
            asset = painter.encode(asset.splats, by, [how]) if asset is start and start is not splats else asset
            edits = step.views(asset) if isinstance(step, Decal) else step
            kind = LayDecal(method=method) if is_decal else Paint(mode=mode, method=method)
            result = painter.apply(asset, edits, how, by)
            if asset.unlit is not None:
                result = replace(result, unlit=unlit_after(asset.splats, asset.unlit, result.splats))
        assert result.receipt is not None
        asset = result
        steps.append(AppliedOperation(kind, result.receipt))
    if not steps:
        raise ValueError("edit: expected 1 to 16 edited views, got 0 (or operations)")
    return replace(asset, receipt=receipt_of_all(start.splats, asset.splats, steps)).with_surface_of(asset)


def _together(operations: Sequence[EditedPicture | Decal | Operation]) -> list[list[Edit] | Decal | Operation]:
    """Pictures that follow one another as one list."""
    out: list[list[Edit] | Decal | Operation] = []
    for number, one in enumerate(operations, 1):
        if isinstance(one, Decal | Operation):
            out.append(one)
            continue
        picture = one if isinstance(one, Edit) else Edit(*one, name=f"picture {number}")
        if out and isinstance(out[-1], list):
            out[-1].append(picture)
        else:
            out.append([picture])
    return out
