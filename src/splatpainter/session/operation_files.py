"""What operations (operations/) read of sessions' files: regions that a project names, a selection that it keeps or
what one of its layers paints; and adjustment layers, which `splatpainter grade` takes as looks.

`splatpainter.session` brings them to operations when it is imported.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.grading.color_grading import GRADE, GradeSettings
from splatpainter.grading.color_match import ColorMap
from splatpainter.grading.color_transfer import TRANSFERS, transfer_function, with_table
from splatpainter.operations.grade import Look
from splatpainter.operations.region import Region as Region
from splatpainter.operations.region import wrong_term
from splatpainter.operations.session_files import Weigh
from splatpainter.session.document.document import Layer
from splatpainter.session.kinds.look_layers import LookLayer
from splatpainter.session.project.asset_files import read_layer
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

SAME_ASSET_SHARE = 0.1
"""Share of an asset's extent by which the median Gaussian may lie elsewhere than in the original of a project."""


@dataclass(frozen=True)
class LayerLook:
    """The look of a layer at its strength."""

    function: ColorMap
    strength: float
    name: str

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        return colors + np.float32(self.strength) * (self.function(colors) - colors)

    def describe(self) -> str:
        return f"layer {self.name}, strength {self.strength:g}"


def look_of_layer(path: Path) -> Look:
    layer, blobs = read_layer(path)
    operation = layer.operation
    if not isinstance(operation, LookLayer) or operation.look not in (GRADE, *TRANSFERS):
        raise ValueError(
            f"{path}: expected an adjustment layer with sliders or other colours, got a layer of kind {layer.kind}"
        )
    # A limit is of the asset that the layer was made on, and would lie anywhere on another.
    if layer.views or operation.selection is not None:
        raise ValueError(f"{path}: is limited to a selection, which grade takes as --where mask=M.png@CAM.json instead")
    if layer.blend != "normal":
        raise ValueError(f"{path}: expected a layer of blend normal, got {layer.blend}")
    if operation.look in TRANSFERS:
        return _transfer_of_layer(path, layer, operation, blobs)
    sliders = GradeSettings.from_dict(operation.settings)
    return replace(sliders, strength=sliders.strength * layer.opacity)


def _transfer_of_layer(path: Path, layer: Layer, operation: LookLayer, blobs: dict[str, bytes]) -> Look:
    """A layer's LUT, colours of a picture or new colour, as they were fitted when it was made."""
    parameters = with_table({**operation.settings, "look": operation.look}, lambda name: blobs.get(name, b""))
    try:
        function = transfer_function(parameters)
        strength = float(parameters.get("strength", 1.0)) * layer.opacity
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {str(error).removeprefix('look: ')}") from None
    return LayerLook(function, strength, ascii(layer.name))


def project_term(name: str, text: str) -> Weigh:
    """A selection that a project keeps, or what one of its layers paints, on an asset made from its original."""
    from splatpainter.session.selection.selection import Selection
    from splatpainter.session.session import Session

    title, at, project = text.rpartition("@")
    if not at or not title:
        raise wrong_term(name, "NAME@PROJECT.splatproj", text)
    # For reading only: a project that is open elsewhere can still be asked.
    with Session.load(project, readonly=True) as session:
        try:
            weights = session.selections.load(title) if name == "selection" else session.layers.painted(title)
        except ValueError as error:
            raise ValueError(f"{project}: {error}") from None
        parts = session.selections.by_asset(weights)

    def weigh(splats: Splats) -> np.ndarray:
        for part in parts:
            if _is_made_from(splats, part.original):
                return Selection.of(part.weights, part.splats, part.original).on(splats, part.original)
        raise ValueError(f"--where {name}={ascii(title)}: expected the asset of {project}, or one made from it")

    return weigh


def _is_made_from(splats: Splats, original: Splats) -> bool:
    """Whether an asset may be one that was made from the original: as many Gaussians or more, where they were."""
    if len(splats) < len(original):
        return False
    # By the median: an edit moves some Gaussians far, and leaves most where they were.
    extent = float(np.ptp(original.means[original.drawable], axis=0).max())
    far = np.linalg.norm(splats.means[: len(original)] - original.means, axis=1)
    return bool(np.median(far) <= SAME_ASSET_SHARE * extent)
