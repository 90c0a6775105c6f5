"""Adjustment layers: colours of everything, of what masks reach or of a selection, by an adjustment that the session
has by name (layer_blending.ADJUSTMENTS) or as edited pictures of the whole asset show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from typing import Any, ClassVar

from splatpainter.grading.color_transfer import TABLE
from splatpainter.lift.masked_gaussians import reached_gaussians
from splatpainter.painter import Method, Mode, Painter
from splatpainter.session.document.layer_operation import Coverage, LayerOperation, LayerWork
from splatpainter.session.document.layer_view import View, is_hash
from splatpainter.session.kinds.painted_layers import PaintedLayer, views_with_pictures
from splatpainter.session.replay.delta import between
from splatpainter.session.replay.layer_blending import mixed, within
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system.quick_dataclass import dataclass


def look_of(parameters: Mapping[str, Any], selection: str | None = None) -> LookLayer:
    """The operation of what makes the parameters of an adjustment ({"look": name, ...}): GradeSettings.to_dict,
    transfer_parameters, SeamMatch.parameters."""
    settings = {name: value for name, value in parameters.items() if name != "look"}
    return LookLayer(method="lift", look=str(parameters.get("look", "")), settings=settings, selection=selection)


@dataclass(frozen=True)
class LookLayer(PaintedLayer):
    """Colours adjusted by a function with settings; without the name of one, as pictures show the asset."""

    kind: ClassVar[str] = "look"
    by_hand: ClassVar[bool] = False
    lays_paint: ClassVar[bool] = False
    covers: ClassVar[Coverage] = "as below"

    mode: Mode = "global"
    look: str = ""
    """Name of the adjustment: grade, lut, match, recolor, gain, light, or one that the session was given."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of the adjustment, as it reads them; a LUT's table is the hash of a picture."""

    def check(self) -> None:
        if not self.regrades:
            raise ValueError(f"expected mode global of a look, got {self.mode}")
        super().check()

    def blobs(self) -> set[str]:
        table = self.settings.get(TABLE)
        return super().blobs() | ({str(table)} if is_hash(table) else set())

    @property
    def needs_views(self) -> bool:
        return not self.look

    @property
    def takes_pictures(self) -> bool:
        return not self.look

    @property
    def needs_masks(self) -> bool:
        return False

    @property
    def is_local_paint(self) -> bool:
        return False

    def is_stored(self, views: tuple[View, ...]) -> bool:
        return views_with_pictures(views)

    def repainted(self, painter: Painter, method: Method | None = None) -> LayerOperation:
        # No painter is asked of an adjustment, whose weights would be read for its name.
        return replace(self, method="lift") if self.look else super().repainted(painter, method)

    def result(self, work: LayerWork) -> LayerResult:
        # Pictures show what to do and ask the painter; a function by name does not, and is quick.
        if views_with_pictures(work.views):
            return super().result(work)
        adjusted = work.adjusted(self.look, self.settings)
        # Masks without pictures only limit: beside them the Gaussians stay bit for bit.
        if work.views:
            reached = reached_gaussians(work.splats, [(view.camera, work.mask(view)) for view in work.views])
            adjusted = within(reached, work.splats, adjusted)
        if self.selection is not None:
            adjusted = mixed(work.selected(self.selection), work.splats, adjusted)
        return LayerResult(between(work.splats, adjusted))
